"""Differentiable rendering of occupancy grids to depth and mask."""
