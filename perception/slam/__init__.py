"""Object SLAM: camera tracking, data association and sliding-window bundle adjustment."""
