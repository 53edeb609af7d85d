"""A run as a rerun recording, ``replay.rrd``: motion, images, object map and events on one timeline.

https://rerun.io; the timeline ``show_time`` is that of ``app.runs.replay``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from app.errors import MissingExtraError
from app.runs.replay import Recorder, action_text
from perception.errors import install_hint

FILE = "replay.rrd"
TIMELINE = "show_time"
JPEG_QUALITY = 85


def require_rerun() -> None:
    """Raise MissingExtraError if rerun is not installed, before a run that is to be logged."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        raise MissingExtraError(f"--log rerun needs rerun: {install_hint('rerun')}") from None


def write_rerun(recorder: Recorder, folder: Path) -> None:
    """Write a recording to ``replay.rrd`` in a run folder."""
    import rerun as rr

    recording = rr.RecordingStream("nodeslam", recording_id=folder.resolve().name)
    recording.save(str(folder / FILE))
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_bodies(recording, recorder)
    _log_joints(recording, recorder)
    _log_notes(recording, recorder)
    for estimate in recorder.objects:
        mesh = estimate.mesh_world
        shape = rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces)
        recording.log(f"world/map/{estimate.name}", shape)
    recording.disconnect()


def _log_bodies(recording: Any, recorder: Recorder) -> None:
    import rerun as rr

    for name, parts in recorder.meshes.items():
        for index, part in enumerate(parts):
            visual: Any = part.visual
            if visual.kind == "texture":
                visual = visual.to_color()
            colors = np.asarray(visual.vertex_colors)
            shape = rr.Mesh3D(
                vertex_positions=part.vertices, triangle_indices=part.faces, vertex_colors=colors
            )
            recording.log(f"world/bodies/{name}/{index}", shape, static=True)
    poses = np.array(recorder.poses).reshape(len(recorder.times), len(recorder.bodies), 7)
    times = rr.TimeColumn(TIMELINE, duration=recorder.show_times)
    for index, name in enumerate(recorder.bodies):
        position, wxyz = poses[:, index, :3], poses[:, index, 3:]
        columns = rr.Transform3D.columns(translation=position, quaternion=np.roll(wxyz, -1, axis=1))
        recording.send_columns(f"world/bodies/{name}", [times], columns)


def _log_joints(recording: Any, recorder: Recorder) -> None:
    import rerun as rr

    times = rr.TimeColumn(TIMELINE, duration=recorder.show_times)
    for index, positions in enumerate(np.array(recorder.joints).reshape(len(recorder.times), -1).T):
        recording.send_columns(f"joints/{index}", [times], rr.Scalars.columns(scalars=positions))
    recording.send_columns("gripper_width", [times], rr.Scalars.columns(scalars=recorder.widths))


def _log_notes(recording: Any, recorder: Recorder) -> None:
    import rerun as rr

    for note in recorder.notes:
        recording.set_time(TIMELINE, duration=note.time)
        if note.kind == "stage":
            recording.log("events", rr.TextLog(note.data["name"]))
        elif note.kind == "action":
            recording.log("events", rr.TextLog(action_text(note.data)))
        elif note.kind == "look" and note.data["index"] < len(recorder.frames):
            frame = recorder.frames[note.data["index"]]
            lens = frame.intrinsics
            camera = rr.Pinhole(
                focal_length=[lens.fx, lens.fy], principal_point=[lens.cx, lens.cy],
                resolution=[lens.width, lens.height],
            )  # fmt: skip
            if frame.T_world_camera is not None:
                T = frame.T_world_camera
                recording.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            recording.log("world/camera/image", camera)
            recording.log("world/camera/image/rgb", rr.Image(frame.rgb).compress(jpeg_quality=JPEG_QUALITY))
            recording.log("world/camera/image/depth", rr.DepthImage(np.asarray(frame.depth), meter=1.0))
