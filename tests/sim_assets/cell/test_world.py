"""The simulated robot: stillness, motion, gripping, looking, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.robot import JointTrajectory
from sim_assets.cell import ground_truth
from sim_assets.cell.config import CellConfig
from sim_assets.cell.stepping import SimulationError
from sim_assets.cell.world import FINGER_SPEED, World
from sim_assets.objects import sample_object
from sim_assets.robots.panda_arm import Q_READY


def make_world(seed=1, classes=("mug", "bowl", "bottle", "can"), **options):
    rng = np.random.default_rng(seed)
    return World(CellConfig(tuple(sample_object(c, "test", rng) for c in classes), seed=seed, **options))


@pytest.fixture(scope="module")
def world():
    with make_world() as world:
        yield world


@pytest.fixture
def at_rest(world):
    yield world
    world.move_gripper(0.08)
    world.follow(quintic(world.joint_positions(), Q_READY))


def quintic(start, end, duration=1.2, period=0.004):
    """A joint motion from rest to rest."""
    s = np.arange(0, duration + period / 2, period)[:, None] / duration
    delta = end - start
    return JointTrajectory(
        period,
        start + delta * (10 * s**3 - 15 * s**4 + 6 * s**5),
        delta * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration,
        delta * (60 * s - 180 * s**2 + 120 * s**3) / duration**2,
    )


def test_objects_stand_still_where_they_were_put(world):
    before = ground_truth.object_poses(world)
    world.wait(1.0)
    for index, pose in ground_truth.object_poses(world).items():
        assert np.abs(pose[:3, 3] - before[index][:3, 3]).max() < 2e-4
        assert abs(pose[2, 3]) < 1e-3
        assert pose[2, 2] > np.cos(np.radians(0.5))
        assert ground_truth.touching(world, index) == {"world"}


def test_follow_tracks_within_a_milliradian_and_settles(at_rest):
    world = at_rest
    end = Q_READY + np.array([0.5, 0.3, -0.3, 0.2, 0.4, -0.3, 0.6])
    trajectory = quintic(world.joint_positions(), end)
    samples = []
    world.observe(lambda w: samples.append((w.time, w.joint_positions())), fps=500)
    start = world.time
    world.follow(trajectory)
    world.observe(None)
    times = np.arange(len(trajectory.positions)) * trajectory.period
    for time, q in samples:
        if time - start < trajectory.duration:
            # the command of a step is the sample at its start, one period before
            wanted = [np.interp(time - start - 0.002, times, column) for column in trajectory.positions.T]
            assert np.abs(q - wanted).max() < 3e-3
    np.testing.assert_allclose(world.joint_positions(), end, atol=1e-3)


@pytest.mark.parametrize("duration", [0.2, 1.2])
def test_the_hand_opens_while_the_arm_moves(at_rest, duration):
    """The arm arrives when it does without the hand, and the hand when both have had their time."""
    world = at_rest
    world.move_gripper(0.01)
    end = Q_READY + 0.1 * duration * np.array([1.0, 0.3, -0.3, 0.2, 0.4, -0.3, 0.6])
    start, widths = world.time, []
    world.observe(lambda w: widths.append((w.time - start, w.gripper_width())), fps=500)
    trajectory = quintic(world.joint_positions(), end, duration)
    reached = world.follow_opening(trajectory, 0.07)
    world.observe(None)
    assert reached == world.gripper_width() == pytest.approx(0.07, abs=1e-3)
    np.testing.assert_allclose(world.joint_positions(), end, atol=1e-3)
    halfway = np.interp(0.19, *zip(*widths, strict=True))
    assert halfway == pytest.approx(0.01 + 0.19 * 2 * FINGER_SPEED, abs=0.01)
    opening = 0.06 / (2 * FINGER_SPEED)
    assert world.time - start < max(duration, opening) + 0.25


def test_a_wrong_opening_moves_nothing(at_rest):
    world = at_rest
    before = world.time
    with pytest.raises(RobotError, match=r"gripper width 0\.2 m is outside"):
        world.follow_opening(quintic(world.joint_positions(), Q_READY + 0.1), 0.2)
    assert world.time == before


def test_gripper_opens_to_a_width_and_closes_with_force(at_rest):
    world = at_rest
    assert world.move_gripper(0.05) == pytest.approx(0.05, abs=5e-4)
    assert world.move_gripper(0.0) == pytest.approx(0.0, abs=5e-4)
    assert world.move_gripper(0.08) == pytest.approx(0.08, abs=5e-4)


def test_observer_is_called_at_its_rate(world):
    times = []
    world.observe(lambda w: times.append(w.time), fps=20)
    world.wait(1.0)
    world.observe(None)
    world.wait(0.1)
    assert len(times) in (20, 21)


def test_capture_shows_the_table_at_its_height_with_the_measured_pose(at_rest):
    world = at_rest
    frame = world.capture()
    mask = ground_truth.instance_mask(world)
    v, u = np.indices(mask.shape)
    k = frame.intrinsics
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    T = frame.T_world_camera
    points = (rays * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]
    # Most of the picture shows the table, and 2 mm of noise average out.
    table = (mask < 0) & (np.abs(points[..., 2]) < 0.01) & (points[..., 1] < 0.08)  # short of the box
    heights = points[..., 2][table]
    assert heights.size > 0.3 * mask.size
    assert np.mean(heights) == pytest.approx(0, abs=5e-4)
    assert np.std(heights) == pytest.approx(0.002, abs=4e-4)
    for index, pose in ground_truth.object_poses(world).items():
        seen = points[(mask == index) & (frame.depth > 0)]
        if len(seen) > 500:
            assert np.linalg.norm(np.median(seen, axis=0)[:2] - pose[:2, 3]) < 0.08


@pytest.mark.parametrize(("noise", "is_black"), [("gaussian", True), ("realsense", False)])
def test_depth_images_are_those_of_captures(at_rest, monkeypatch, noise, is_black):
    """Whether colour is rendered changes no measured depth, now or later: runs repeat with either."""
    monkeypatch.setattr(at_rest, "config", replace(at_rest.config, depth_noise=noise))

    def images(*names):
        monkeypatch.setattr(at_rest, "_noise", np.random.default_rng(3))
        return [getattr(at_rest, name)() for name in names]

    for depth, full in zip(images("capture_depth", "capture"), images("capture", "capture"), strict=True):
        np.testing.assert_array_equal(depth.depth, full.depth)
        np.testing.assert_array_equal(depth.T_world_camera, full.T_world_camera)
    assert images("capture_depth")[0].rgb.any() != is_black and images("capture")[0].rgb.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q: q + 0.2, "starts 0.200 rad from the measured"),
        (lambda q: np.where(np.arange(7) == 3, np.nan, q), "NaN or infinite"),
    ],
)
def test_bad_trajectories_are_refused_before_anything_moves(world, change, message):
    q = change(world.joint_positions())[None].repeat(3, axis=0)
    before = world.time
    with pytest.raises(RobotError, match=message):
        world.follow(JointTrajectory(0.002, q, 0 * q, 0 * q))
    assert world.time == before


def test_arm_stops_when_it_is_blocked(at_rest):
    """Driving the hand into the table must end in an error, not in a pushed-through table."""
    world = at_rest
    low = Q_READY + np.array([0, 1.6, 0, 0, 0, 1.6, 0])  # the pads would be 7 cm under the table top
    with pytest.raises(RobotError, match="blocked"):
        world.follow(quintic(world.joint_positions(), low, duration=2.0))
    assert np.abs(world.joint_positions() - low).max() > 0.1


@pytest.mark.parametrize("width", [np.nan, -0.01, 0.2])
def test_impossible_widths_are_refused(world, width):
    with pytest.raises(RobotError, match="outside 0"):
        world.move_gripper(width)


def test_unknown_view_lists_the_known_ones(world):
    with pytest.raises(SimulationError, match="'attic' is none of overview, box, line, side, wrist"):
        world.overview_image(camera="attic")


def test_same_seed_gives_the_same_run():
    def run():
        with make_world(seed=4, classes=("can",)) as world:
            world.follow(quintic(world.joint_positions(), Q_READY + 0.1, duration=0.5))
            return world.capture(), ground_truth.object_poses(world)

    (first, poses), (second, others) = run(), run()
    assert np.array_equal(first.rgb, second.rgb) and np.array_equal(first.depth, second.depth)
    assert all(np.array_equal(poses[i], others[i]) for i in poses)


def test_stop_ends_a_motion_where_the_arm_is_and_refuses_further_ones():
    with make_world(classes=("can",)) as world:
        start, goal = world.joint_positions(), world.joint_positions() + 0.3 * np.eye(7)[0]
        world.observe(lambda cell: cell.stop("a person is near") if cell.joint_positions()[0] > 0.1 else None)
        with pytest.raises(RobotStoppedError, match="the robot was stopped: a person is near"):
            world.follow(quintic(start, goal))
        assert 0.1 < world.joint_positions()[0] - start[0] < 0.2
        with pytest.raises(RobotStoppedError):
            world.move_gripper(0.0)
        assert world.state().time == world.time
