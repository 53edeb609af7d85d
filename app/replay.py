"""The replay of a run: what the joints did, and when what happened, for a viewer to play back."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.files import write_atomically


@dataclass
class Recorder:
    """Collects joint positions over simulated time, and named events."""

    times: list[float] = field(default_factory=list)
    joints: list[Float[np.ndarray, "n"]] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)

    def sample(self, time: float, joints: Float[np.ndarray, "n"], width: float) -> None:
        """One moment: time [s], joint positions [rad], gripper width [m]."""
        self.times.append(time)
        self.joints.append(joints)
        self.widths.append(width)

    def event(self, time: float, text: str) -> None:
        self.events.append((time, text))

    def write(self, path: Path) -> None:
        """Time (t,) [s], joint_positions (t, n) [rad], gripper_width (t,) [m], and the events as text."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            time=np.array(self.times),
            joint_positions=np.array(self.joints) if self.joints else np.zeros((0, 0)),
            gripper_width=np.array(self.widths),
            event_time=np.array([time for time, _ in self.events]),
            event=np.array([text for _, text in self.events], dtype=np.str_),
        )
        write_atomically(path, buffer.getvalue())
