"""Layer of the 3-D scene for the camera poses of the images."""

from __future__ import annotations

import cv2
import numpy as np
import viser

from app.drawing import draw_detections
from app.runs.replay import Recorder
from app.viewer.display import DisplayOptions, pose_arguments
from app.viewer.snapshot import Snapshot
from perception.types import RgbdFrame

IMAGE_WIDTH = 160  # [px] of the image in a frustum
FRUSTUM_COLOR, LATEST_COLOR = (110, 116, 128), (235, 120, 20)


class CameraLayer:
    """A frustum with its image for every captured image with a camera pose; the latest one is highlighted."""

    def __init__(self, server: viser.ViserServer, recorder: Recorder) -> None:
        self._server, self._recorder = server, recorder
        self._handles: dict[int, viser.CameraFrustumHandle] = {}
        self._searched: dict[int, bool] = {}  # whether the detections are drawn in the image

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        frames = self._recorder.frames[: snapshot.n_frames]
        for index in [index for index in self._handles if index >= len(frames)]:
            self._handles.pop(index).remove()
            self._searched.pop(index)
        for index, frame in enumerate(frames):
            if frame.T_world_camera is None:
                continue
            searched = index < snapshot.n_searched
            if self._searched.get(index) != searched:
                self._handles[index] = self._add(index, frame, frame.T_world_camera, searched)
                self._searched[index] = searched
            handle = self._handles[index]
            handle.color = LATEST_COLOR if index == snapshot.latest_image else FRUSTUM_COLOR
            handle.visible = options.cameras and snapshot.stage != "execute"

    def _add(
        self, index: int, frame: RgbdFrame, T_world_camera: np.ndarray, searched: bool
    ) -> viser.CameraFrustumHandle:
        image = frame.rgb
        if searched and index < len(self._recorder.detections):
            image = draw_detections(frame, self._recorder.detections[index], by_class=True)
        camera = frame.intrinsics
        height = round(IMAGE_WIDTH * camera.height / camera.width)
        return self._server.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
            aspect=camera.width / camera.height,
            scale=0.05,
            thickness=0.0012,
            color=FRUSTUM_COLOR,
            image=cv2.resize(np.asarray(image), (IMAGE_WIDTH, height), interpolation=cv2.INTER_AREA),
            format="jpeg",
            cast_shadow=False,
            **pose_arguments(T_world_camera),
        )
