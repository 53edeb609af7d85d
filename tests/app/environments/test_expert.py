"""The expert: a pipeline that asks for actions and images; a short episode in the cell."""

import numpy as np
import pytest

from app.environments.actions import JointActions
from app.environments.environment import PackEnv
from app.environments.expert import Expert, _Abandoned, _Move, _SteppedRobot
from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.trajectories import JointLimits, MotionConfig, joint_move
from perception.pipeline import Perception
from sim_assets.robots import panda

ARM = panda().description
HOME = np.array(ARM.q_home)


def observed(q, width=0.08):
    return {"state": np.concatenate([q, np.zeros(7), [width]]).astype(np.float32)}


class Answers:
    """Queue whose answers follow from the last request."""

    def __init__(self, respond):
        self.respond, self.moves = respond, []

    def put(self, request):
        self.moves.append(request)

    def get(self):
        return self.respond(self.moves[-1])


def robot_that(respond):
    robot = _SteppedRobot(ARM, JointActions(Kinematics(ARM)), 0.05, observed(HOME))
    robot.requests = robot.answers = Answers(respond)
    return robot


def test_a_motion_becomes_one_action_per_period():
    robot = robot_that(lambda move: observed(move.q, move.width))
    motion = joint_move(HOME, HOME + 0.2, JointLimits.of(ARM, MotionConfig()))
    robot.follow(motion)
    moves = robot.answers.moves
    assert len(moves) == int(np.ceil(motion.duration / 0.05))
    np.testing.assert_allclose(moves[-1].q, HOME + 0.2)
    np.testing.assert_allclose(robot.joint_positions(), HOME + 0.2, atol=1e-6)
    np.testing.assert_allclose(moves[0].q, motion.positions[25], atol=1e-9)


def test_a_blocked_arm_is_an_error():
    robot = robot_that(lambda move: observed(HOME))
    with pytest.raises(RobotError, match="blocked"):
        robot.follow(joint_move(HOME, HOME + 0.5, JointLimits.of(ARM, MotionConfig())))
    np.testing.assert_allclose(robot._target, HOME, atol=1e-6)


def test_a_grasp_has_its_full_force_before_it_ends():
    """The fingers stop on an object after two actions; the command needs ten to arrive at zero."""
    robot = robot_that(lambda move: observed(HOME, 0.066))
    assert robot.move_gripper(0.0) == pytest.approx(0.066)
    assert len(robot.answers.moves) >= 10 and {move.width for move in robot.answers.moves} == {0.0}


def test_an_abandoned_episode_ends_the_pipeline():
    robot = robot_that(lambda move: _Abandoned())
    with pytest.raises(_Abandoned):
        robot.move_gripper(0.0)


def fake_perception():
    return Perception.__new__(Perception)


@pytest.fixture
def pipeline(monkeypatch):
    """Replace the pipeline by a function of the robot."""

    def install(work):
        monkeypatch.setattr("app.environments.expert.run_pipeline", work)

    return install


@pytest.fixture(scope="module")
def env():
    env = PackEnv(objects="can=1")
    env.reset(seed=1)
    yield env
    env.close()


def test_the_policy_acts_images_and_ends(env, pipeline):
    class Result:
        failure = "no plan"

    def work(robot, perception, request, observer):
        with observer.stage("scan"):
            assert robot.capture().rgb.shape == (480, 640, 3)
            robot._ask(_Move(HOME + 0.01, 0.04))
        return Result

    pipeline(work)
    expert = Expert(env, fake_perception())
    observation = observed(HOME)
    expert.reset(observation)
    action = expert.act(observation)
    np.testing.assert_allclose(action, [*(HOME + 0.01), 0.04], rtol=1e-6)
    assert expert.phase == "scan" and not expert.finished
    last = expert.act(observation)
    assert expert.finished and expert.failure == "no plan" and env.action_space.contains(last)


def test_unexpected_errors_reach_the_caller(env, pipeline):
    def work(*arguments):
        raise ZeroDivisionError

    pipeline(work)
    expert = Expert(env, fake_perception())
    expert.reset(observed(HOME))
    with pytest.raises(ZeroDivisionError):
        expert.act(observed(HOME))


def test_a_new_episode_abandons_the_old_one(env, pipeline):
    def work(robot, *arguments):
        while True:
            robot._ask(_Move(HOME, 0.08))

    pipeline(work)
    expert = Expert(env, fake_perception())
    for _ in range(2):
        expert.reset(observed(HOME))
        expert.act(observed(HOME))
    thread = expert._run._thread
    expert.close()
    assert not thread.is_alive()
