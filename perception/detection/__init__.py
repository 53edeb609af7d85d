"""Detection of objects: instance masks, classes and yaw of handles."""
