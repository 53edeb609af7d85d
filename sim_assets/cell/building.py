"""A cell whose objects rest where they were put: layouts are drawn until nothing falls."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sim_assets.cell.arm_drive import ArmDrive
from sim_assets.cell.arrangement import Arrangement, Group, arrange, rest_unknown
from sim_assets.cell.config import CellConfig
from sim_assets.cell.free_bodies import Pose, set_friction
from sim_assets.cell.layout import FreePose, PlanarPose, UnstableError, draw_together, sample_roomy_layout
from sim_assets.cell.resting import damped
from sim_assets.cell.scene import build_scene
from sim_assets.cell.settling import fallen_after_nudge, settle_bodies
from sim_assets.cell.stepping import advance
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjData, MjModel, MjSpec, mujoco

LAYOUTS = 4  # tried for one in which nothing falls
REARRANGED = 2  # layouts after which other objects lie or are stacked
LOOSENED = 0.001  # [m] added to the gap of objects that are drawn together, from one layout to the next
_SPARE = 0.008  # [m] of the opening of the hand, beyond the diameter of what it turns over
SETTLING = 0.5  # [s] for which the arm and upright objects settle


def build_settled(
    config: CellConfig, layout: np.random.Generator, look_seed: np.random.SeedSequence
) -> tuple[MjModel, MjData]:
    """Build a cell and let it settle; a layout in which something falls is replaced by another.

    So is one in which something falls when nudged, if there is a better one.

    Args:
        config: the cell.
        layout: draws poses and resting poses.
        look_seed: of colours, materials and friction.

    Returns:
        The scene and its state: the arm at its home posture with its hand open, the objects at rest.

    Raises:
        LayoutError: the objects do not fit on the table.
        UnstableError: something falls in every layout.
    """
    fallen, balanced = None, None  # the latter: the first cell in which nothing falls unless it is nudged
    names = [f"object{i}" for i in range(len(config.objects))]
    names += [f"unknown{i}" for i in range(len(config.unknown))]
    groups, others = _groups(config, layout)
    for attempt in range(LAYOUTS):
        if attempt == REARRANGED and config.arrangement != Arrangement():
            groups, others = _groups(config, layout)
        places, unknown = _sample_places(config, groups, others, layout, LOOSENED * attempt)
        look = np.random.default_rng(look_seed)
        things = tuple(zip(config.unknown, unknown, strict=True))
        scene = build_scene(config.objects, places, config.box, look, config.line, config.robot, things)
        if config.friction is not None:
            set_friction(scene, config.friction, look)
        model = _compiled(scene)
        data: MjData = mujoco.MjData(model)
        ArmDrive(model, data, config.robot).reset()
        if config.is_tidy:
            advance(model, data, SETTLING)
            return model, data
        with damped(model, names):  # objects in contact may start inside each other by a hair
            advance(model, data, SETTLING)
        fallen = settle_bodies(model, data, names)
        if fallen is None:
            if fallen_after_nudge(model, data, names) is None:
                return model, data
            balanced = balanced or (model, data)
    if balanced is not None:
        return balanced
    assert fallen is not None
    reason = f"the objects do not rest stably in any of {LAYOUTS} layouts: {fallen.reason}"
    raise UnstableError(reason, fallen.name)


def _compiled(scene: MjSpec) -> MjModel:
    """Compile the cell. The checks of a robot file leave out the meshes that are only seen.

    Raises:
        RobotFileError: MuJoCo cannot read one of them.
    """
    try:
        return scene.compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()).removeprefix("Error: ")
        raise RobotFileError(f"the cell does not compile: {reason}; repair the model of the arm") from None


def _groups(config: CellConfig, rng: np.random.Generator) -> tuple[list[Group], list[Group]]:
    """Return the objects and the things of no class in groups that the layout places as one."""
    if config.arrangement == Arrangement():
        groups = [Group({index: None}, model.mesh) for index, model in enumerate(config.objects)]
    else:
        span = config.robot.description.gripper.max_width - _SPARE
        groups = arrange(config.objects, config.arrangement, rng, span)
    return groups, [rest_unknown(thing, f"unknown{i}") for i, thing in enumerate(config.unknown)]


def _sample_places(
    config: CellConfig, groups: list[Group], things: list[Group], rng: np.random.Generator, loosened: float
) -> tuple[list[Pose], list[Pose]]:
    """Return the initial poses of the objects and of the things of no class.

    Those that are drawn together keep ``loosened`` [m] more than the smallest gap.
    """
    meshes = [group.mesh for group in (*groups, *things)]
    layout = sample_roomy_layout(meshes, rng, config.region, config.min_gap, config.scale)
    if config.drawn_together:
        layout = draw_together(meshes, layout, config.min_gap + loosened)
    places: dict[int, Pose] = {}
    for group, pose in zip(groups, layout[: len(groups)], strict=True):
        places |= {i: _place(pose, T) for i, T in group.Ts_group_object.items()}
    around = zip(things, layout[len(groups) :], strict=True)
    return [places[i] for i in range(len(places))], [
        _place(pose, thing.Ts_group_object[0]) for thing, pose in around
    ]


def _place(pose: PlanarPose, T_group_object: Float[np.ndarray, "4 4"] | None) -> Pose:
    """Return the initial pose of a member of a group that lies at a pose in the layout."""
    return pose if T_group_object is None else FreePose.of(pose.matrix @ T_group_object)
