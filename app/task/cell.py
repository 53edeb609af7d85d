"""The simulated cell of a run: validate its options and build it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from app.errors import ProblemsError, UsageError
from app.options import CellOptions
from app.task.arm_cell import ArmCell, arm_cell, box_of
from app.task.scene_options import check_scene, scene_settings
from perception.types import CATEGORIES, Category

if TYPE_CHECKING:
    from app.task.fitting_cell import Freedom
    from sim_assets.cell.world import World
    from sim_assets.objects import ObjectModel
    from sim_assets.robots.simulated_arm import SimulatedArm

MAX_OBJECTS = 20
SET_DOWN_TILT = np.deg2rad(3)
MAX_LEAN = np.deg2rad(8)  # of an own mesh at rest on the table
HIGHER_DRAWS = 20  # of an object that is too low for the fingers
BOX_LIMITS = {"L": (0.10, 0.60), "W": (0.10, 0.50), "H": (0.02, 0.20)}  # [m]: boxes that fit on the table


def parse_objects(
    text: str,
    rng: np.random.Generator,
    most: int = MAX_OBJECTS,
    drawn: Sequence[Category] = CATEGORIES,
) -> list[Category]:
    """Return the classes of ``--objects``: a number draws them evenly, ``mug=2,can=1`` lists them.

    Args:
        text: Value of the option.
        rng: Generator of the drawn classes.
        most: Maximum number of objects.
        drawn: Classes to draw from.

    Raises:
        UsageError: The text has neither form, or the number is out of range.
    """
    usage = f"--objects takes a number (6) or counts by class ({','.join(f'{c}=1' for c in CATEGORIES)})"
    if text.strip().isascii() and text.strip().isdigit():
        count = _count(text.strip())
        _require_room(text, count, most)
        return _mixture(count, rng, drawn)
    classes: list[Category] = []
    total = 0
    for part in text.split(","):
        name, _, count = (piece.strip() for piece in part.partition("="))
        known: Category | None = next((c for c in CATEGORIES if c == name), None)
        if known is None:
            raise UsageError(f"{usage}; '{name}' is none of {', '.join(CATEGORIES)}")
        if not (count.isascii() and count.isdigit()):
            raise UsageError(f"{usage}; '{part.strip()}' has no count")
        if known in classes:
            raise UsageError(f"{usage}; '{name}' is given twice")
        total += _count(count)
        classes.extend(known for _ in range(min(_count(count), most + 1)))
    _require_room(text, total, most)
    return classes


def _count(digits: str) -> int:
    """Return a number of objects; 10**9 for anything beyond, since Python refuses very long integers."""
    return int(digits) if len(digits) < 10 else 10**9


def _mixture(count: int, rng: np.random.Generator, categories: Sequence[Category]) -> list[Category]:
    rounds = math.ceil(count / len(categories))
    drawn = [categories[i] for _ in range(rounds) for i in rng.permutation(len(categories))]
    return drawn[:count]


def _require_room(text: str, count: int, most: int) -> None:
    """Raise UsageError unless the number of objects is possible."""
    if not 1 <= count <= most:
        room = "the table holds 1 to about 12" if most == MAX_OBJECTS else f"1 to {most} are possible"
        asked = f"{count}" if count < 10**9 else "10**9 or more"
        raise UsageError(f"--objects {text[:40]} asks for {asked} objects; {room}")


def parse_box(text: str) -> tuple[float, float, float]:
    """Return the inner length, width and height of ``--box``, in metres.

    Raises:
        UsageError: The text is not three lengths, or the box does not fit on the table.
    """
    try:
        length, width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--box takes three lengths in metres such as 0.34,0.30,0.08, not '{text}'"
        ) from None
    for (name, (low, high)), value in zip(BOX_LIMITS.items(), (length, width, height), strict=True):
        if not low <= value <= high:
            raise UsageError(f"--box {name} = {value:g} m must be in {low:g}..{high:g} m")
    return length, width, height


def check_options(options: CellOptions) -> None:
    """Validate the options of a cell before the simulator is loaded.

    Raises:
        UsageError: An option is invalid; the message names it and its valid values.
    """
    parse_objects(options.objects, np.random.default_rng(0))
    parse_box(options.box)
    check_scene(options)
    if options.object_meshes is not None and not options.object_meshes.is_dir():
        raise UsageError(
            f"--object-meshes {options.object_meshes} is no folder; give DIR of DIR/<class>/*.ply"
        )
    if options.robot != "panda":
        robot_of(options)


def robot_of(options: CellOptions) -> SimulatedArm:
    """Load the arm of the options."""
    return load_arm(options.robot)


def load_arm(spec: str, check: bool = True) -> SimulatedArm:
    """Load the arm of ``--robot``.

    Args:
        spec: Name of a shipped arm, or path of a robot file.
        check: Whether to refuse an arm of a file with which every task would fail.

    Raises:
        ProblemsError: The name is unknown, or the robot file is invalid; lists all problems.
    """
    from sim_assets.errors import RobotFileError
    from sim_assets.robots import SHIPPED, load_robot

    try:
        robot = load_robot(spec)
    except RobotFileError as error:
        raise ProblemsError(error.problems) from None
    if spec in SHIPPED:
        return robot
    robot = _with_views(robot)
    if check:
        _require_usable(spec, robot)
    return robot


def _with_views(robot: SimulatedArm) -> SimulatedArm:
    """Return the arm, which takes near views if it reaches few viewpoints of its cell."""
    from manipulation.viewpoints import with_near_views
    from manipulation.workspace import arm_workspace

    workspace = arm_workspace(robot.description).workspace
    viewpoints = (*workspace.scan_viewpoints(), *workspace.box_viewpoints)
    return replace(robot, description=with_near_views(robot.description, viewpoints))


def _require_usable(spec: str, robot: SimulatedArm) -> None:
    """Raise ProblemsError for an arm with which every task fails: home, reach, camera."""
    from app.robots.checks import loading_faults
    from manipulation.workspace import arm_workspace

    fit = arm_workspace(robot.description)
    faults = loading_faults(robot.description, robot.fovy, fit)
    if faults:
        raise ProblemsError([f"{spec}: {f.subject}: {f.found}: {f.remedy}" for f in faults])


def build_world(options: CellOptions, task: str | None) -> World:
    """Build the cell and let its objects settle: with a line for sorting, otherwise with a box.

    Generated objects come from the test families, which no network was trained on. Layout and objects are
    drawn from separate generators, both seeded by ``options.seed``. Objects that do not fit on the table, or
    do not rest there, are replaced by others of their classes (``fitting_cell``).

    Raises:
        UsageError: The options cannot be satisfied; the message names the option to change.
    """
    layout_seed, shape_seed, thing_seed = np.random.SeedSequence(options.seed).spawn(3)
    rng = np.random.default_rng(shape_seed)
    robot = robot_of(options)
    cell = arm_cell(options, robot)
    classes = parse_objects(options.objects, rng, drawn=cell.categories)
    inner = parse_box(options.box)
    from app.task.fitting_cell import fitting_world
    from sim_assets.cell.config import CellConfig
    from sim_assets.cell.layout import LayoutError

    config = CellConfig(
        objects=tuple(_draw_models(options, classes, rng, cell)),
        box=None if task == "sort" else box_of(options, inner, cell.scale),
        line=_tape(cell.scale) if task == "sort" else None,
        depth_noise=options.depth_noise,
        seed=int(layout_seed.generate_state(1)[0]),
        robot=robot,
        scale=cell.scale,
        **scene_settings(options, len(classes), thing_seed),
    )
    try:
        return fitting_world(config, _freedom(options, rng, thing_seed, cell))
    except LayoutError as error:
        raise UsageError(f"--objects {options.objects}: {error}") from None


def _freedom(
    options: CellOptions, rng: np.random.Generator, thing_seed: np.random.SeedSequence, cell: ArmCell
) -> Freedom:
    """Return what may be changed in a cell that cannot be laid out: nothing that the options ask for."""
    from app.task.fitting_cell import Freedom
    from sim_assets.cell.unknown import draw_unknown

    things = np.random.default_rng(thing_seed.spawn(1)[0])

    def draw(category: Category) -> ObjectModel:
        return _draw_models(replace(options, objects=f"{category}=1"), [category], rng, cell)[0]

    return Freedom(
        draw=draw,
        draw_thing=lambda: draw_unknown(1, things)[0],
        smaller_gap=options.gap is None and not options.clutter,
        fewer_poses=options.clutter,
    )


def _draw_models(
    options: CellOptions, classes: Sequence[Category], rng: np.random.Generator, cell: ArmCell = ArmCell()
) -> list[ObjectModel]:
    """Draw the objects: generated ones that suit the arm, or users' meshes as they are."""
    if options.object_meshes is None:
        from sim_assets.objects.sampling import draw_objects
        from sim_assets.objects.scaled import scaled

        drawn = [scaled(model, cell.object_scale) for model in draw_objects(Counter(classes), "test", rng)]
        return [_high_enough(model, rng, cell) for model in drawn]
    from sim_assets.objects import load_user_objects

    owned: dict[Category, list[ObjectModel]] = {category: [] for category in get_args(Category)}
    for model in load_user_objects(options.object_meshes):
        owned[model.category].append(model)
        _require_standing(model, options.object_meshes)
    if options.objects.strip().isdigit():
        pool = [model for models in owned.values() for model in models]
        return _draw(pool, len(classes), rng)
    drawn = []
    for category in CATEGORIES:
        wanted = classes.count(category)
        if wanted and not owned[category]:
            raise UsageError(f"--objects asks for a {category} but {options.object_meshes} has none")
        drawn += _draw(owned[category], wanted, rng)
    return drawn


def _high_enough(model: ObjectModel, rng: np.random.Generator, cell: ArmCell) -> ObjectModel:
    """Return the object, or the first of a few draws of its class that is high enough for the fingers."""
    from sim_assets.objects import sample_object
    from sim_assets.objects.scaled import scaled

    for _ in range(HIGHER_DRAWS):
        if model.height >= cell.lowest:
            break
        model = scaled(sample_object(model.category, "test", rng), cell.object_scale)
    return model


def _require_standing(model: ObjectModel, folder: Path) -> None:
    """Raise UsageError unless a mesh stands on a table, even when it is set down slightly tilted."""
    from sim_assets.cell.resting import settle, tilt

    T_set_down = np.eye(4)
    c, s = np.cos(SET_DOWN_TILT), np.sin(SET_DOWN_TILT)
    T_set_down[1:3, 1:3] = [[c, -s], [s, c]]
    settled = settle([(model, T_set_down)])
    angle = tilt(settled.poses[0])
    if not settled.at_rest or angle > MAX_LEAN:
        how = f"it topples by {np.rad2deg(angle):.0f} degrees" if angle > MAX_LEAN else "it keeps rocking"
        name = f"{folder}/{model.category}/{model.name}"
        raise UsageError(f"--object-meshes: {name} does not stand on a table: {how}; leave it out")


def _draw(pool: Sequence[ObjectModel], count: int, rng: np.random.Generator) -> list[ObjectModel]:
    """Draw without replacement; start again whenever the pool is exhausted."""
    order = [i for _ in range(math.ceil(count / max(len(pool), 1))) for i in rng.permutation(len(pool))]
    return [pool[i] for i in order[:count]]


def _tape(scale: float) -> tuple[tuple[float, float], tuple[float, float]]:
    from manipulation.types import Line

    line = Line().scaled(scale)
    return line.start, line.end
