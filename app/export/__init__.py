"""Export of reconstructions as GLB, MJCF and URDF, with convex pieces that keep cavities open."""
