"""Convex decomposition of the object families (exact), CAD meshes (coacd) and perceived meshes (polar)."""
