"""``nodeslam collect``: episodes of the expert as a LeRobot data set."""
