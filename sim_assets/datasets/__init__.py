"""Synthetic RGB-D images and sequences with ground truth."""
