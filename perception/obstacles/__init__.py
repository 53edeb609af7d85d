"""Things of no class as obstacles: what depth shows on the surface beside the known objects."""
