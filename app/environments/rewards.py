"""Rewards of the environments, from the simulator's true state.

The sparse reward is the change of the share of objects in place, by the success criteria of the scorer; its
sum over an episode is the share of objects in place at the end. The shaped reward adds the change of a
potential, which leaves the optimal policies unchanged (Ng, Harada, Russell: Policy invariance under reward
transformations, ICML 1999; here without discount).

The criteria are evaluated whenever all objects rest and the hand has left them; until then, the verdicts of
the last evaluation hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from app.environments.privileged import PrivilegedState
from app.options import Task
from app.task.criteria import BoxSpace, judge_pack, judge_sort
from app.task.scoring import read_truth
from manipulation.types import Line
from sim_assets.cell.world import World

RewardKind = Literal["sparse", "shaped"]
MAX_SPEED, MAX_SPIN = 0.01, 0.1  # [m/s], [rad/s] of an object at rest
CLEARANCE = 0.05  # [m] between the TCP and the bounding cylinder of an object that the hand has left
MOVED = 5e-4  # [m], change of a quaternion: smaller changes need no new verdict
NEAR_GOAL = 0.05  # [m]: objects farther from the goal region than this are not in place
CARRY_SCALE, REACH_SCALE = 0.25, 0.10  # [m] of the two terms of the potential
REACH_SHARE = 0.1  # weight of the term that leads the hand to the nearest object


@dataclass(frozen=True)
class Judgement:
    """Reward of one step.

    Attributes:
        reward: The reward.
        placed: Whether each object is in place.
    """

    reward: float
    placed: Bool[np.ndarray, "n"]

    @property
    def success(self) -> bool:
        return bool(self.placed.all())


class TaskReward:
    """Computes the reward of each step of an episode."""

    def __init__(self, world: World, objects: PrivilegedState, task: Task, kind: RewardKind) -> None:
        self._world, self._task, self._kind = world, task, kind
        self._objects = objects
        count = len(objects.heights)
        self._judged = np.full((count, 7), np.inf)  # poses of the last verdicts
        self._placed = np.zeros(count, dtype=bool)
        self._potential = 0.0

    def reset(self, hand: Float[np.ndarray, "3"]) -> None:
        """Begin an episode; what is in place already earns nothing.

        Args:
            hand: Position of the TCP in metres.
        """
        poses, _ = self._objects.read()
        self._placed = self._verdicts(poses)
        self._potential = self._potential_of(poses, hand)

    def step(self, hand: Float[np.ndarray, "3"]) -> Judgement:
        """Return the reward for what happened since the last call.

        Args:
            hand: Position of the TCP in metres.
        """
        poses, velocities = self._objects.read()
        before = self._placed
        if np.abs(poses - self._judged).max() > MOVED and self._at_rest(poses, velocities, hand):
            self._placed = self._verdicts(poses)
        changed = self._placed is not before  # most steps have no new verdict
        reward = float(self._placed.mean() - before.mean()) if changed else 0.0
        if self._kind == "shaped":
            potential = self._potential_of(poses, hand)
            reward += potential - self._potential
            self._potential = potential
        return Judgement(reward, self._placed)

    def _verdicts(self, poses: Float[np.ndarray, "n 7"]) -> Bool[np.ndarray, "n"]:
        """Return whether the criteria hold for each object."""
        self._judged = poses
        if self._goal_distances(poses[:, :3]).min() > NEAR_GOAL:
            return np.zeros(len(poses), dtype=bool)
        objects, box = list(read_truth(self._world).objects.values()), self._world.config.box
        if self._task == "pack":
            assert box is not None
            reasons = judge_pack(objects, BoxSpace(box.center, box.inner[:2], box.floor))
        else:
            line = Line().scaled(self._world.config.scale)
            reasons = judge_sort(objects, [(line.start, line.end)])
        return np.array([not reason for reason in reasons])

    def _at_rest(self, poses: np.ndarray, velocities: np.ndarray, hand: np.ndarray) -> bool:
        """Return whether all objects rest, and the hand has left them."""
        speed = np.linalg.norm(velocities[:, :3], axis=1).max()
        if speed > MAX_SPEED or np.linalg.norm(velocities[:, 3:], axis=1).max() > MAX_SPIN:
            return False
        return bool(self._hand_distances(poses, hand).min() > CLEARANCE)

    def _hand_distances(self, poses: np.ndarray, hand: np.ndarray) -> Float[np.ndarray, "n"]:
        """Return the distances of the TCP from the objects' bounding cylinders, as if upright, in metres."""
        offset = hand - poses[:, :3]
        beside = np.maximum(np.linalg.norm(offset[:, :2], axis=1) - self._objects.radii, 0)
        above = np.maximum(offset[:, 2] - self._objects.heights, 0) + np.maximum(-offset[:, 2], 0)
        return np.hypot(beside, above)

    def _goal_distances(self, bases: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the distances of the objects' bases from the interior of the box, or from the line [m]."""
        if self._task == "pack":
            box = self._world.config.box
            assert box is not None
            away = np.maximum(np.abs(bases[:, :2] - box.center) - np.array(box.inner[:2]) / 2, 0)
            rise = np.maximum(bases[:, 2] - box.inner[2], 0)  # nested bowls stand above the floor
            return np.sqrt((away**2).sum(axis=1) + rise**2)
        line = Line().scaled(self._world.config.scale)
        start, end = np.array(line.start), np.array(line.end)
        along = (end - start) / np.linalg.norm(end - start)
        position = np.clip((bases[:, :2] - start) @ along, 0, np.linalg.norm(end - start))
        away = bases[:, :2] - (start + position[:, None] * along)
        return np.sqrt((away**2).sum(axis=1) + bases[:, 2] ** 2)

    def _potential_of(self, poses: np.ndarray, hand: np.ndarray) -> float:
        """Return the progress in 0..1: objects near their goal, and the hand near the next object."""
        carried = np.where(self._placed, 1.0, 1 - np.tanh(self._goal_distances(poses[:, :3]) / CARRY_SCALE))
        to_hand = np.where(self._placed, np.inf, self._hand_distances(poses, hand)).min()
        reach = 1.0 if self._placed.all() else 1 - float(np.tanh(to_hand / REACH_SCALE))
        return (1 - REACH_SHARE) * float(carried.mean()) + REACH_SHARE * reach
