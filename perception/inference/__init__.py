"""Shape and pose estimation of objects from RGB-D images."""
