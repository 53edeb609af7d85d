"""The simulated cell: layout, scene, robot interface and ground truth."""
