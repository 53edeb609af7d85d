"""Reconstructions as files for other tools: GLB, MJCF, URDF; convex pieces that keep a cavity open."""
