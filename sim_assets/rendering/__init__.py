"""Camera images of MuJoCo scenes, depth noise and materials."""
