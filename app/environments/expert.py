"""The shipped pipeline as a policy: observations in, actions out, for the environments of the cell.

The pipeline calls a robot and waits for it; a policy is called. A thread therefore runs the pipeline on a
robot whose motions are sequences of actions, and stops wherever the next observation is needed. It sees what
every robot measures: joint positions, gripper width, and images of the wrist camera taken on request.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from app.environments.actions import ActionCodec
from app.environments.environment import CellEnv, Observation
from app.options import Shapes, TaskOptions
from app.task.episode import request_of
from app.task.pipeline import run as run_pipeline
from app.task.run_observer import RunObserver, Stage
from app.task.task_types import TaskRequest
from manipulation.errors import RobotError, RobotStoppedError
from manipulation.execution import TaskEvent
from manipulation.robot import ArmDescription, JointTrajectory, RobotState
from perception.pipeline import Perception, load_perception
from perception.threads import single_threaded
from perception.types import RgbdFrame
from sim_assets.cell.world import FINGER_SPEED, REACHED_ERROR, STOP_ERROR

SETTLE_ERROR = 1e-3  # [rad]: the arm has reached the end of a motion
LAG = 0.05  # [rad]: an arm that is farther from its target is given time to catch up
CATCH_UP_STEPS = 10  # actions
SETTLE_STEPS = 12  # actions that the arm is given to come to rest
STILL = 2e-4  # [m] per action: fingers at rest
STILL_STEPS = 3  # actions that the fingers have been at rest
MORE_FINGER_STEPS = 20  # actions that the fingers are given beyond those of a free motion


class _Abandoned(Exception):
    """The episode has ended before the pipeline."""


@dataclass(frozen=True)
class _Move:
    """Request of the next action: joint targets [rad] and gripper width [m]."""

    q: Float[np.ndarray, "n"]
    width: float


Request = _Move | Literal["image", "end"]


class Expert:
    """Policy that carries out the task of an environment by perception and planning.

    Attributes:
        phase: Present stage of the pipeline, or phase of its execution.
        target: Name of the object that is being moved; empty outside the execution.
        failure: Error that ended the pipeline; empty if none did.
        finished: Whether the pipeline has ended; the policy then holds its posture.
    """

    def __init__(
        self,
        env: CellEnv,
        perception: Perception | None = None,
        shapes: Shapes = "nodeslam",
        scan_views: int = TaskOptions.scan_views,
    ) -> None:
        """Prepare the policy.

        Args:
            env: Environment, unwrapped.
            perception: Networks; loaded if None.
            shapes: Source of the object estimates, as in ``nodeslam pack --shapes``.
            scan_views: Number of images of the scan.
        """
        self._env = env
        self._options = TaskOptions(shapes=shapes, scan_views=scan_views)
        self._perception = perception or load_perception("auto")
        self._run: _PipelineThread | None = None
        self.phase, self.target, self.failure, self.finished = "scan", "", "", False

    def reset(self, observation: Observation) -> None:
        """Begin an episode; call it after ``env.reset``."""
        self.close()
        self.phase, self.target, self.failure, self.finished = "scan", "", "", False
        period = self._env.cell.control.period
        request = request_of(self._env.cell.world, self._env.task, self._options)
        robot = _SteppedRobot(self._env.robot.description, self._env.codec, period, observation)
        self._run = _PipelineThread(robot, self._perception, request, _Phases(self))

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next action.

        Raises:
            Exception: The pipeline failed unexpectedly.
        """
        assert self._run is not None, "call reset() first"
        control = self._env.cell.control
        answer: Any = observation
        while not self.finished:
            request = self._run.next_request(answer)
            if isinstance(request, _Move):
                return self._env.codec.encode(request.q, request.width, control.q)
            if request == "end":
                self.finished, self.failure = True, self._run.failure
            else:  # taken in this thread: a GL context belongs to one
                answer = self._env.cell.world.capture()
        return self._env.codec.encode(control.q, self._run.robot.width, control.q)

    def close(self) -> None:
        """End the pipeline of an unfinished episode."""
        if self._run is not None:
            self._run.abandon()
            self._run = None


class _SteppedRobot:
    """Implements ``manipulation.robot.Robot`` with one request per action or image."""

    def __init__(
        self, arm: ArmDescription, codec: ActionCodec, period: float, observation: Observation
    ) -> None:
        """Begin where the arm is.

        Args:
            arm: The arm.
            codec: Kind of actions that the requests will become.
            period: Duration of an action in seconds.
            observation: Present observation.
        """
        self._arm, self._codec, self._period = arm, codec, period
        self.requests: SimpleQueue[Request] = SimpleQueue()
        self.answers: SimpleQueue[Any] = SimpleQueue()
        self._measure(observation)
        self._target = self._q
        self.width = self._width
        self._time = 0.0
        self._stop_reason = ""

    @property
    def arm(self) -> ArmDescription:
        return self._arm

    def state(self) -> RobotState:
        return RobotState(self._time, self._q.copy(), self._width)

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        return self._q.copy()

    def gripper_width(self) -> float:
        return self._width

    def capture(self) -> RgbdFrame:
        return self._ask("image")

    def follow(self, trajectory: JointTrajectory) -> None:
        times = np.arange(len(trajectory.positions)) * trajectory.period
        n_actions = max(int(np.ceil(trajectory.duration / self._period)), 1)
        for time in np.minimum(self._period * np.arange(1, n_actions + 1), trajectory.duration):
            self._move(np.array([np.interp(time, times, column) for column in trajectory.positions.T]))
            for _ in range(CATCH_UP_STEPS):
                if self._codec.deviation(self._q, self._target) < LAG:
                    break
                self._move(self._target)
            self._require_within(STOP_ERROR)
        for _ in range(SETTLE_STEPS):
            if self._codec.deviation(self._q, self._target) < SETTLE_ERROR:
                return
            self._move(self._target)
        self._require_within(REACHED_ERROR)

    def move_gripper(self, width: float) -> float:
        self.width = float(np.clip(width, 0, self._arm.max_width))
        # A grasp has its full force when the command has arrived at the goal, long after contact.
        n_free = int(np.ceil(abs(self.width - self._width) / 2 / (FINGER_SPEED * self._period)))
        still = 0
        for count in range(1, n_free + MORE_FINGER_STEPS):
            before = self._width
            self._move(self._target)
            still = still + 1 if abs(self._width - before) < STILL else 0
            if count >= n_free + STILL_STEPS and still >= STILL_STEPS:
                break
        return self._width

    def stop(self, reason: str) -> None:
        self._stop_reason = reason

    def _move(self, q: Float[np.ndarray, "n"]) -> None:
        if self._stop_reason:
            raise RobotStoppedError(f"the robot was stopped: {self._stop_reason}")
        self._time += self._period
        self._target = q
        self._measure(self._ask(_Move(q, self.width)))

    def _ask(self, request: Request) -> Any:
        self.requests.put(request)
        answer = self.answers.get()
        if isinstance(answer, _Abandoned):
            raise answer
        return answer

    def _measure(self, observation: Observation) -> None:
        state = observation["state"].astype(np.float64)
        self._q, self._width = state[: len(self._arm.joint_names)], float(state[-1])

    def _require_within(self, limit: float) -> None:
        error = self._codec.deviation(self._q, self._target)
        if error > limit:
            self._target = self._q.copy()
            raise RobotError(f"the arm is blocked {error:.3f} rad from its command; it stopped")


class _PipelineThread:
    """The pipeline in a thread of its own, which runs only while the policy waits for its next request."""

    def __init__(
        self, robot: _SteppedRobot, perception: Perception, request: TaskRequest, observer: RunObserver
    ) -> None:
        self.robot, self.failure = robot, ""
        self._error: BaseException | None = None
        self._work = (perception, request, observer)
        self._thread = threading.Thread(target=self._main, name="expert", daemon=True)
        self._started = False

    def next_request(self, answer: Any) -> Request:
        """Answer the last request, and return the next one."""
        if self._started:
            self.robot.answers.put(answer)
        else:
            self._started = True
            self._thread.start()
        request = self.robot.requests.get()
        if self._error is not None:
            raise self._error
        return request

    def abandon(self) -> None:
        if self._started:
            self.robot.answers.put(_Abandoned())
            self._thread.join()

    def _main(self) -> None:
        perception, request, observer = self._work
        try:
            with single_threaded():
                self.failure = run_pipeline(self.robot, perception, request, observer).failure
        except _Abandoned:
            return
        except Exception as error:
            self._error = error
        self.robot.requests.put("end")


class _Phases(RunObserver):
    """Reports stages and phases to the policy."""

    def __init__(self, expert: Expert) -> None:
        super().__init__()
        self._expert = expert

    def stage(self, name: Stage) -> Any:
        self._expert.phase, self._expert.target = name, ""
        return super().stage(name)

    def on_event(self, event: TaskEvent) -> None:
        self._expert.phase, self._expert.target = event.phase, event.name
