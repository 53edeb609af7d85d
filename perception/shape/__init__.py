"""Shape prior: class-conditional VAE over occupancy grids and its decoders."""
