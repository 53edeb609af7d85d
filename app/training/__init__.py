"""Training of the shipped networks: data, labels, model cards with pictures."""
