"""Files of recordings, object maps and meshes."""
