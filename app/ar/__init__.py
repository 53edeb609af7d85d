"""Augmented reality: toys dropped onto the reconstructed scene and drawn into the recorded frames."""
