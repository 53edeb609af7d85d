"""Surfaces that objects stand on: their planes, their extents, and what stands on them."""
