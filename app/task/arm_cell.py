"""The cell that suits an arm: its scale, the size of its objects, and what the arm cannot do with them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.options import CellOptions
from perception.types import CATEGORIES, Category

if TYPE_CHECKING:
    from manipulation.kinematics import Kinematics
    from manipulation.robot import GripperGeometry
    from manipulation.workspace import ReachFit
    from sim_assets.cell.scene import BoxConfig
    from sim_assets.cell.world import World
    from sim_assets.objects import ObjectModel
    from sim_assets.robots.simulated_arm import SimulatedArm

FULL_OPENING = 0.075  # [m] that the generated objects need: cans and caps of 70 mm, with clearance
SMALLEST = 0.5  # scale of objects below which fingers do not fit into cups
BELOW_RIM = 0.018  # [m] of an object besides the fingertips: depth of the pads, floor, clearance
SLENDER = 0.5  # least scale of bottles and cans, which have room for each other in any cell
HELD_BY_WALL = ("mug", "bowl")
THINNEST_WALL = 0.003  # [m] to which a hand must close for these
INNER_WIDTH = {"mug": 0.075, "bowl": 0.110}  # [m] of typical ones of standard size
BESIDE_FINGER = 0.015  # [m] inside that a finger needs besides its thickness
CLEARANCE = 0.002  # [m] of an opening beyond a body
GRAVITY = 9.81
FRICTION = 0.6  # least coefficient between pads and objects
RESERVE = 0.5  # share of force and torque limits that a load may take at rest


@dataclass(frozen=True)
class ArmCell:
    """Scales of an arm's cell relative to the standard one.

    Attributes:
        scale: of places, box and viewpoints.
        object_scale: of generated objects; no larger, but for bottles and cans alone.
        lowest: least height of a generated object in [m], which the fingertips need beyond the pads.
        categories: classes that objects are drawn from: those that the hand can hold.
    """

    scale: float = 1.0
    object_scale: float = 1.0
    lowest: float = 0.0
    categories: tuple[Category, ...] = CATEGORIES


def arm_cell(options: CellOptions, robot: SimulatedArm) -> ArmCell:
    """Return the scales of the cell that suit an arm; shipped arms have the standard one."""
    from sim_assets.robots import SHIPPED

    if options.robot in SHIPPED:
        return ArmCell()
    from manipulation.workspace import arm_workspace

    return scales_of(arm_workspace(robot.description), robot)


def scales_of(fit: ReachFit, robot: SimulatedArm) -> ArmCell:
    """Return the scales by reach and by opening."""
    by_opening = max(SMALLEST, robot.description.max_width / FULL_OPENING)
    scale = fit.workspace.scale
    object_scale = round(min(scale, by_opening), 3)
    gripper = robot.description.gripper
    categories: tuple[Category, ...] = tuple(
        c for c in CATEGORIES if c not in HELD_BY_WALL or _fits_wall(c, gripper, object_scale)
    )
    if not set(categories) & set(HELD_BY_WALL):
        object_scale = round(min(max(scale, SLENDER), by_opening), 3)
    return ArmCell(scale, object_scale, gripper.tip + BELOW_RIM, categories)


def _fits_wall(category: Category, gripper: GripperGeometry, object_scale: float) -> bool:
    """Return whether a hand closes to the walls of a class, and its finger fits inside."""
    inside = object_scale * INNER_WIDTH[category]
    return gripper.min_width <= THINNEST_WALL and inside >= gripper.finger_thickness + BESIDE_FINGER


def box_of(options: CellOptions, inner: tuple[float, float, float], scale: float) -> BoxConfig:
    """Return the box: scaled unless its size is given, at its scaled place."""
    from sim_assets.cell.scene import BoxConfig

    box = BoxConfig(inner=inner).scaled(scale)
    return box if options.box == CellOptions.box else BoxConfig(inner=inner, center=box.center)


def cell_remarks(world: World) -> Iterator[str]:
    """Yield the scale of a cell that is not standard, and each object that the arm can't open for or lift."""
    arm = world.arm
    if world.config.scale != 1.0:
        yield f"the cell has {100 * world.config.scale:.0f} % of its standard size, by the arm's reach"
    load = payload(world)
    least = arm.gripper.min_width
    for index, model in enumerate(world.config.objects):
        width = narrowest_grip(model)
        if model.category in HELD_BY_WALL and least > THINNEST_WALL:
            yield (
                f"object {index} ({model.category}) is held by its wall, the hand closes to "
                f"{1e3 * least:.0f} mm: it will be left"
            )
        if width > arm.max_width - CLEARANCE:
            yield (
                f"object {index} ({model.category}) is {1e3 * width:.0f} mm wide, the hand opens to "
                f"{1e3 * arm.max_width:.0f} mm: it will be left"
            )
        if model.mass > load:
            yield (
                f"object {index} ({model.category}) weighs {1e3 * model.mass:.0f} g, the arm lifts "
                f"{1e3 * load:.0f} g at full reach: it may be dropped"
            )


def narrowest_grip(model: ObjectModel) -> float:
    """Return the smallest width [m] that a hand must open for: of a wall, cap, or body."""
    if model.category in HELD_BY_WALL:
        return 0.0
    vertices = np.asarray(model.mesh.vertices)
    top = vertices[vertices[:, 2] > vertices[:, 2].max() - 0.03]
    return float(np.ptp(top[:, :2], axis=0).min())


def payload(world: World) -> float:
    """Return the mass [kg] that the arm holds at the farthest places of its cell, by torque and friction.

    A load m at the tool frame needs the torque m g dz/dq of each joint, and m g / 2 of friction at each pad.
    """
    from manipulation.kinematics import Kinematics
    from manipulation.workspace import place_poses

    kinematics = Kinematics(world.arm)
    torques = world.torque_limits()
    most = 2 * FRICTION * world.grip_force() * RESERVE / GRAVITY
    for T in place_poses(kinematics, world.config.scale):
        result = kinematics.inverse(T, kinematics.seeds_toward(T, 2), name="a place")
        if result.converged:
            levers = np.abs(_heights_by_joint(kinematics, result.q))
            most = min(most, float((RESERVE * torques / np.maximum(levers, 1e-6)).min()) / GRAVITY)
    return most


def _heights_by_joint(kinematics: Kinematics, q: np.ndarray) -> np.ndarray:
    """Return the change of the tool frame's height with each joint [m/rad], by central differences."""
    step = 1e-5
    return np.array(
        [
            (kinematics.forward(q + dq)[2, 3] - kinematics.forward(q - dq)[2, 3]) / (2 * step)
            for dq in step * np.eye(len(q))
        ]
    )
