"""Stands in for the networks that name masks."""

from dataclasses import replace

import numpy as np


class Namer:
    """Names every mask a can, or something else, and keeps what it stood on."""

    def __init__(self, probabilities=(0.1, 0.0, 0.1, 0.7, 0.1)):
        self.probabilities, self.bases = np.array(probabilities), []

    def complete(self, frame, plane, detections):
        self.bases.append(plane.offset)
        return [replace(d, class_probabilities=self.probabilities) for d in detections]

    def posed(self, frame, plane, detections):
        return [replace(d, pose_probabilities=np.full(10, 0.1)) for d in detections]
