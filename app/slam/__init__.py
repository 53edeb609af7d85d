"""The SLAM command: a run on a sequence, its recording and its pictures."""
