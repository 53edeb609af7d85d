"""Pack and sort: an episode in the simulated cell from the first look to the score. Start at ``pipeline``."""
