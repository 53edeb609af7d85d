"""Execution of one pick-and-place plan with its checks: look, grasp, lift, carry, lower, release, look.

The width between the fingers tells whether the object is held; an image from above, whether it is where it
was expected before the grasp and after the release; images of the hand, how it is held after the lift and
before it is lowered.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from manipulation.errors import (
    ApproachBlockedError,
    GoalBlockedError,
    GraspFailedError,
    RobotError,
    SceneChangedError,
    UnknownInTheWayError,
)
from manipulation.hand_collision import HandBoxes, HandClearance
from manipulation.lying_grasps import lies
from manipulation.observation import (
    FEWEST_UNKNOWN,
    SceneObserver,
    Volume,
    classify_grip,
    is_displaced,
    is_turned,
)
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.pushing import Push
from manipulation.recovery import Recovery
from manipulation.robot import JointTrajectory, Robot, follow_opening
from manipulation.stack_settling import StackSettling
from manipulation.trajectories import concatenate
from manipulation.types import Grasp, PickPlacePlan
from perception.geometry import invert, transform_points

logger = logging.getLogger(__name__)

_ABOVE = 0.003  # [m] by which the base of an object is above that of one that carries it, at least
_BEYOND = 0.02  # [m] beyond the shape of a lifted object, from which on a measured point is not of it
_OFF_HAND = 0.015  # [m] from the hand, up to which a point may be of it: its camera pose may be inexact
_NEARBY = 0.1  # [m] from it, up to which such points are looked for
_FURTHER_DOWN = 0.06  # [m] below that shape down to which such points are looked for
_MANY = 1000  # of these points, from which on it reaches beyond its shape, or something hangs on it
_INSIDE = 0.004  # [m] by which a point is in the way of the hand at least, which covers noise
# [m], [rad] in the hand, from which on an object goes another way: it would meet what it was to pass above,
# or arrive beside its goal, or with one side of its base first.
_SHIFTED, _TURNED = 0.006, np.deg2rad(6.0)
_SLIP = 0.005  # [m] by which the fingers close further during the lift, from which on they lose an object
# [m] from its goal, from which on a released object is grasped again: in a box, and in a row.
MISPLACED, OFF_ROW = 0.02, 0.012

Phase = Literal[
    "plan",
    "approach",
    "grasp",
    "transfer",
    "place",
    "retreat",
    "aside",
    "push",
    "placed",
    "retry",
    "deferred",
    "failed",
]


@runtime_checkable
class Notify(Protocol):
    """Receives the phase that begins."""

    def __call__(
        self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None
    ) -> None: ...


class PlanExecution:
    """Executes plans on a robot and checks each step.

    Args:
        robot: the robot.
        planner: planner whose scene follows the objects that are moved.
        observer: looks at the scene.
        config: settings.
        notify: receives the phases.
        misplaced: distance from its goal in [m], from which on a released object is grasped again.

    Attributes:
        recovery: motions after one that failed.
    """

    def __init__(
        self,
        robot: Robot,
        planner: PickPlacePlanner,
        observer: SceneObserver,
        config: ManipulationConfig,
        notify: Notify,
        misplaced: float = MISPLACED,
    ) -> None:
        self.robot, self.planner, self.observer, self.config = robot, planner, observer, config
        self.scene = planner.scene
        self.misplaced = misplaced
        self._notify = notify
        self.recovery = Recovery(robot, planner, observer, config)
        self._settling = StackSettling(
            robot, planner, observer, self.recovery.back_off,
            lambda name: notify("place", name, "leans and is pressed level"),
        )  # fmt: skip

    def run(self, plan: PickPlacePlan, looks_first: bool = True) -> None:
        """Look, grasp, lift, transfer, place, retreat and look; the grasp is verified after each step.

        Args:
            plan: the plan.
            looks_first: whether an image must show the object where it is expected before it is touched.

        Raises:
            SceneChangedError: the object is not where it was expected.
            UnknownInTheWayError: an image shows something unknown where the hand, or what it holds, was about
                to go.
            ApproachBlockedError: the hand met something on its way to the object.
            GraspFailedError: the object is not held, slips between the fingers, is not where it was released,
                or leans there.
            GoalBlockedError: the object met something on its way to the goal.
            RobotError: the robot failed to execute another motion.
        """
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._notify("approach", name, plan=plan)
        try:
            if plan.transit is None:
                robot.move_gripper(grasp.opening)
            else:
                follow_opening(robot, plan.transit, grasp.opening)
            if looks_first:
                self._require_in_place(name)
            self._require_free_way(plan)
            robot.follow(plan.approach)
        except RobotError as error:
            raise ApproachBlockedError(str(error)) from error
        self._notify("grasp", name)
        robot.move_gripper(0.0)
        self._require_held(grasp, f"no object between the fingers after closing on {name}")
        closed = robot.gripper_width()
        robot.follow(plan.lift)
        # The closed width is wide enough for an object that shifts between the pads.
        self._require_held(grasp, f"{name} was lost during the lift")
        self._require_firm(plan, closed)
        self._require_alone(plan)
        T_seen = self._seen_in_hand(plan)
        if T_seen is not None and self._carriers(plan):
            self._require_known(plan, T_seen)
        plan = self._as_held(plan, T_seen, plan.lift)
        self._notify("transfer", name)
        try:
            robot.follow(plan.carry)
            held = self._as_held(plan, self._seen_in_hand(plan), plan.carry)
            if held is not plan:
                robot.follow(held.carry)
                plan = replace(held, carry=concatenate([plan.carry, held.carry]))
            robot.follow(plan.lowering)
        except RobotError as error:
            self.recovery.bring_back(plan)
            raise GoalBlockedError(str(error)) from error
        self._notify("place", name)
        self._require_held(plan.grasp, f"{name} was lost during the transfer")
        self._release(plan)
        for moved, T in plan.poses_after(self.scene.poses()).items():
            self.scene.moved(moved, T)
        self._notify("retreat", name)
        robot.follow(plan.retreat)
        if plan.placement.stack:
            self._settling.settle(plan)
        self._require_released(plan)

    def _require_in_place(self, name: str) -> None:
        """Raise SceneChangedError if an image shows that an object is not where it was expected."""
        if self.observer.glance(self.scene.poses(), (name,)).get(name) == "displaced":
            raise SceneChangedError(f"{name} is not where it was seen before")

    def _require_free_way(self, plan: PickPlacePlan) -> None:
        """Raise UnknownInTheWayError if an image shows something where the hand is about to go.

        The neck of a bottle that was taken for its body alone, for instance, is above what the hand avoids.
        """
        planner, gripper = self.planner, self.robot.arm.gripper
        T_first, T_grasp = (planner.kinematics.forward(plan.approach.positions[k]) for k in (0, -1))
        boxes = HandBoxes.of(gripper, plan.grasp.opening, HandClearance().hand_length)
        boxes = boxes.moved(gripper.pads_middle(plan.grasp.opening))
        back = T_grasp[:3, :3].T @ (T_first - T_grasp)[:3, 3]

        def is_on_the_way(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
            return boxes.swept(transform_points(invert(T_grasp), points), back, -_INSIDE)

        unknown = self.observer.unexpected(self.scene.poses(), self.scene.perceived_obstacles, is_on_the_way)
        if len(unknown) >= FEWEST_UNKNOWN:
            x, y, z = np.median(unknown, axis=0)
            raise UnknownInTheWayError(
                f"something unknown at ({x:.2f}, {y:.2f}, {z:.2f}) m is in the way of the hand to {plan.name}"
            )

    def _require_released(self, plan: PickPlacePlan) -> None:
        """Raise GraspFailedError if a released object is seen elsewhere, or a mug is seen turned."""
        name = plan.name
        if self.observer.glance(self.scene.poses(), (name,)).get(name) != "displaced":
            return
        finding = self.observer.find(name, self.scene.poses())
        if finding.T_world_stand is None:
            return  # the final verification judges what cannot be seen from here
        self.scene.moved(name, finding.T_world_stand)
        if is_displaced(plan.T_world_stand_rest, finding.T_world_stand, self.misplaced):
            raise GraspFailedError(f"{name} is not where it was released")
        is_mug = self.scene.items[name].category == "mug" and not lies(finding.T_world_stand)
        if is_mug and is_turned(plan.T_world_stand_rest, finding.T_world_stand):
            raise GraspFailedError(f"{name} was turned when it was released")

    def _require_firm(self, plan: PickPlacePlan, closed: float) -> None:
        """Lower an object again, and raise GraspFailedError, if the fingers went on closing as it was lifted.

        Pads that hold it at the very edge, or beside the middle of a round body, squeeze it out.

        Args:
            plan: the plan, after its lift.
            closed: width at which the fingers had closed, in [m].
        """
        slip = closed - self.robot.gripper_width()
        if slip > _SLIP:
            self.robot.follow(plan.lift.reversed())
            raise GraspFailedError(f"{plan.name} slips between the fingers ({1e3 * slip:.0f} mm in the lift)")

    def _require_alone(self, plan: PickPlacePlan) -> None:
        """Lower an object again, and raise GraspFailedError, if what it stood in or on was lifted with it.

        A bowl that is pinched at its rim may jam in the mug below, whose collision geometry the transfer does
        not have.
        """
        below = self._carriers(plan)
        if not below:
            return
        kinematics, positions = self.planner.kinematics, plan.lift.positions
        lift = kinematics.forward(positions[-1]) @ np.linalg.inv(kinematics.forward(positions[0]))
        now = self._carried_to(lift @ self.scene.pose(plan.name), plan)
        seen = self.observer.glance(now | {name: lift @ now[name] for name in below}, below)
        stuck = [name for name in below if seen.get(name) == "in_place"]
        if stuck:
            self.robot.follow(plan.lift.reversed())
            raise GraspFailedError(f"{' and '.join(stuck)} was lifted with {plan.name}")

    def _seen_in_hand(self, plan: PickPlacePlan) -> Float[np.ndarray, "4 4"] | None:
        """Return T_world_stand of the object in the hand from one image; None if that does not show it."""
        now = self._carried_to(self._in_hand(plan.grasp), plan)
        return self.observer.held(plan.name, now, self._T_world_tcp())

    def _as_held(
        self, plan: PickPlacePlan, T_seen: Float[np.ndarray, "4 4"] | None, latest: JointTrajectory
    ) -> PickPlacePlan:
        """Return the plan, or one with another way from here if the object has shifted in the hand.

        The pads align themselves with a slanted wall, and a round body slides along them. Where no other way
        is free, the object goes on as planned.

        Args:
            plan: the plan.
            T_seen: (4, 4) T_world_stand of the object as an image shows it; None if that does not.
            latest: the motion of the plan that the arm has completed, from whose end the way leads.
        """
        if T_seen is None or not is_displaced(self._in_hand(plan.grasp), T_seen, _SHIFTED, _TURNED):
            return plan
        T_stand_tcp = invert(T_seen) @ self._T_world_tcp()
        held = self.planner.continued_as_held(plan, T_stand_tcp, latest.positions[-1])
        logger.info("%s has shifted in the hand%s", plan.name, ", with no other way" * (held is None))
        return held or plan

    def _require_known(self, plan: PickPlacePlan, T_seen: Float[np.ndarray, "4 4"]) -> None:
        """Lower an object again, and raise UnknownInTheWayError, if it reaches beyond its shape in the hand.

        Something that it stood in or on may hang on it, as a bowl on the handle of the mug in it, and would
        sweep other objects over. Within a cylinder around its shape may be a handle on another side, or what
        a bowl is filled with. Where its pose in the hand is not seen, as that of a large bowl that sags, what
        is beyond it is not known.
        """
        now = self._carried_to(T_seen, plan)
        region = self._beyond(plan.name, T_seen)
        unknown = self.observer.unexpected(now, self.scene.perceived_obstacles, region)
        if len(unknown) >= _MANY:
            self.robot.follow(plan.lift.reversed())
            x, y, z = np.median(unknown, axis=0)
            raise UnknownInTheWayError(
                f"{plan.name} reaches beyond its shape in the hand, to ({x:.2f}, {y:.2f}, {z:.2f}) m"
            )

    def _beyond(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> Volume:
        """Return the region around the cylinder of a held object, beside the hand."""
        gripper, width = self.robot.arm.gripper, self.robot.gripper_width()
        hand = HandBoxes.of(gripper, width, HandClearance().hand_length).moved(gripper.pads_middle(width))
        T_tcp_world, T_stand_world = invert(self._T_world_tcp()), invert(T_world_stand)
        vertices = self.scene.items[name].vertices
        radius = np.linalg.norm(vertices[:, :2], axis=1).max()
        bottom, top = vertices[:, 2].min(), vertices[:, 2].max()
        lowest = transform_points(T_world_stand, vertices)[:, 2].min() - _FURTHER_DOWN

        def region(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
            x, y, z = transform_points(T_stand_world, points).T
            beyond = np.maximum(np.hypot(x, y) - radius, np.maximum(bottom - z, z - top))
            found = (beyond > _BEYOND) & (beyond < _NEARBY) & (points[:, 2] > lowest)
            found[found] = ~hand.swept(transform_points(T_tcp_world, points[found]), np.zeros(3), _OFF_HAND)
            return found

        return region

    def _T_world_tcp(self) -> Float[np.ndarray, "4 4"]:
        return self.planner.kinematics.forward(self.robot.joint_positions())

    def _in_hand(self, grasp: Grasp) -> Float[np.ndarray, "4 4"]:
        """Return T_world_stand of an object that is held as in a grasp."""
        return self._T_world_tcp() @ invert(grasp.T_stand_tcp)

    def _carried_to(
        self, T_world_stand: Float[np.ndarray, "4 4"], plan: PickPlacePlan
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return the poses of all objects once an object with its contents has been carried to a pose."""
        now = dict(self.scene.poses())
        moved = T_world_stand @ invert(now[plan.name])
        return now | {name: moved @ now[name] for name in (plan.name, *plan.contents)}

    def _carriers(self, plan: PickPlacePlan) -> tuple[str, ...]:
        """Return the names of the objects in or on which an object of a plan stands.

        The floor of a bowl is thin: what stands in one may be estimated to stand as low.
        """
        poses, items = self.scene.poses(), self.scene.items
        place = poses[plan.name][:3, 3]

        def carries(name: str) -> bool:
            apart = poses[name][:3, 3] - place
            outline = np.linalg.norm(items[name].vertices[:, :2], axis=1).max()
            is_bowl = items[name].category == "bowl" and not lies(poses[name])
            return bool(apart[2] < (_ABOVE if is_bowl else -_ABOVE) and np.linalg.norm(apart[:2]) < outline)

        others = poses.keys() - {plan.name, *plan.contents}
        return tuple(name for name in poses if name in others and carries(name))

    def push(self, push: Push) -> None:
        """Push an object along the table with the closed hand; its pose is as expected then.

        Raises:
            RobotError: the robot failed to execute a motion.
        """
        robot = self.robot
        robot.move_gripper(0.0)
        for motion in (push.transit, push.approach, push.push, push.retreat):
            robot.follow(motion)
        self.scene.moved(push.name, push.T_world_stand)

    def _release(self, plan: PickPlacePlan) -> None:
        """Open the gripper; first loosen it, to lower the pads past a lip or cap or to step aside."""
        robot, gap = self.robot, self.config.pick_place.grasp.release_gap
        held = robot.gripper_width()
        if plan.settle is not None:
            robot.move_gripper(min(held + gap + plan.grasp.stand_off, robot.arm.max_width))
            robot.follow(plan.settle)
        robot.move_gripper(min(max(held + 2 * gap, plan.release_opening), robot.arm.max_width))

    def _require_held(self, grasp: Grasp, message: str) -> None:
        """Raise GraspFailedError if the width between the pads is outside the grasp's range."""
        width = self.robot.gripper_width()
        low, high = grasp.closed_width
        if classify_grip(width, grasp) != "held":
            raise GraspFailedError(
                f"{message} (width {1e3 * width:.1f} mm, expected {1e3 * low:.1f} to {1e3 * high:.1f})"
            )
