import cv2
import numpy as np

from app.task.video import END, FOOTER, FPS, SCENE, SHOW, SIDE, SPEED, RunVideo
from manipulation.execution import TaskEvent
from manipulation.types import PickPlacePlan


def images_in(path):
    video = cv2.VideoCapture(str(path))
    images = [image for good, image in iter(video.read, (False, None)) if good]
    video.release()
    return images


def test_video_has_its_length_and_appears_only_when_complete(tmp_path, still_world, overhead_frame, can_at):
    video = RunVideo(tmp_path / "video.mp4", "Pack", still_world)
    video.begin_stage("scan")
    for _ in range(4):
        video.sample()
        video.sample()  # no image is due yet
        still_world.time += SPEED / FPS
    video.on_image(overhead_frame)
    video.on_frames([overhead_frame])
    video.on_objects([can_at()])
    assert not (tmp_path / "video.mp4").exists()
    video.close()
    images = images_in(tmp_path / "video.mp4")
    assert len(images) == 4 + 1 + round(SHOW * FPS) + 1 + round(END * FPS)
    assert images[0].shape == (SCENE[1] + FOOTER, SCENE[0] + SIDE[0], 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["video.mp4", "video.webp"]
    assert still_world.drawn == 2  # cell and wrist once: nothing moved afterwards


def test_a_placed_object_moves_in_the_map_image(tmp_path, still_world, overhead_frame, can_at, pack_plan):
    video = RunVideo(tmp_path / "video.mp4", "Pack", still_world)
    video.on_frames([overhead_frame])
    video.on_objects([can_at(0), can_at(1, 0.5)])
    video.on_plan(pack_plan)
    video.begin_stage("execute")
    before = video.map_image.copy()
    rest = np.eye(4)
    rest[:3, 3] = (0.5, 0.27, 0.004)
    motions = object.__new__(PickPlacePlan)  # the resting pose is the only attribute that is read
    object.__setattr__(motions, "T_world_stand_rest", rest)
    video.on_event(TaskEvent("approach", "can_0", 0, 1, plan=motions))
    np.testing.assert_array_equal(video.map_image, before)
    video.on_event(TaskEvent("placed", "can_0", 1, 1))
    after = video.map_image.copy()
    assert (after != before).any()
    video.on_event(TaskEvent("placed", "can_0", 1, 1))  # again, after it was set aside
    np.testing.assert_array_equal(video.map_image, after)
    video.on_objects([can_at(0), can_at(1, 0.5)])  # of a further round
    video.on_plan(pack_plan)
    np.testing.assert_array_equal(video.map_image, after)
    video.discard()
    assert not list(tmp_path.glob("*.mp4"))
