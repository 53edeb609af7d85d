"""Object-level SLAM as a command: a sequence through the system, its recording and its pictures."""
