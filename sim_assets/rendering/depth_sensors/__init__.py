"""Models of depth cameras: active stereo, structured light, time of flight, and colour-depth registration."""
