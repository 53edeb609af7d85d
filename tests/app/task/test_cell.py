from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from app.errors import UsageError
from app.options import EvaluateOptions, PackOptions, ScanOptions, SortOptions
from app.task.arm_cell import ArmCell
from app.task.cell import _draw_models, build_world, check_options, parse_box, parse_objects, robot_of
from manipulation.types import Line
from sim_assets.cell.layout import LayoutError
from sim_assets.cell.world import World
from sim_assets.objects import sample_object
from sim_assets.objects.convex.pieces import IDENTITY, CollisionPiece
from sim_assets.objects.sampling import draw_objects


def rng():
    return np.random.default_rng(0)


def test_a_number_draws_classes_as_evenly_as_it_goes():
    for count in range(1, 13):
        counts = Counter(parse_objects(str(count), rng()))
        assert counts.total() == count and max(counts.values()) - min(counts.values(), default=0) <= 1
        assert len(counts) == min(count, 4)


def test_counts_by_class():
    assert parse_objects(" mug=2, can=1", rng()) == ["mug", "mug", "can"]


@pytest.mark.parametrize(
    "text", ["", "six", "-1", "0", "21", "mug", "mug=", "mug=1,", "spoon=1", "mug=1.5", "mug=1,mug=2", "²"]
)
def test_nonsense_is_refused(text):
    with pytest.raises(UsageError, match="--objects"):
        parse_objects(text, rng())


def test_box():
    assert parse_box("0.34, 0.30,0.08") == (0.34, 0.30, 0.08)


@pytest.mark.parametrize("text", ["", "0.3", "a,b,c", "0.3,0.3,0.3,0.3", "inf,0.3,0.1", "-0.3,0.3,0.1"])
def test_impossible_boxes(text):
    with pytest.raises(UsageError, match="--box"):
        parse_box(text)


def test_the_arm_that_was_asked_for():
    assert len(robot_of(PackOptions()).description.joint_names) == 7
    assert len(robot_of(PackOptions(robot="sixaxis")).description.joint_names) == 6
    with pytest.raises(UsageError, match="--robot"):
        check_options(PackOptions(robot="arm.toml"))


@pytest.fixture
def config_of(monkeypatch):
    """Build the cell of some options without its physics; return its configuration."""

    def build(options, task):
        kept = []
        with monkeypatch.context() as patch:
            patch.setattr(World, "__init__", lambda self, config: kept.append(config))
            build_world(options, task)
        return kept[0]

    return build


def same(a, b):
    return len(a) == len(b) and all(
        np.array_equal(x.mesh.vertices, y.mesh.vertices) and x.category == y.category for x, y in zip(a, b)
    )


@pytest.mark.parametrize(
    ("options", "task"),
    [
        (PackOptions(), "pack"),
        (SortOptions(objects="mug=1,bowl=2,bottle=1,can=1"), "sort"),
        (EvaluateOptions(what="tasks"), "pack"),
        (ScanOptions(), "pack"),
    ],
)
def test_objects_come_from_the_test_families(options, task, config_of):
    models = config_of(options, task).objects
    assert {model.split for model in models} == {"test"}
    assert {model.category for model in models} == {"mug", "bowl", "bottle", "can"}


def test_one_seed_yields_layout_and_objects_from_separate_generators(config_of):
    layout, shapes = np.random.SeedSequence(5).spawn(2)
    config = config_of(PackOptions(seed=5, objects="mug=1,can=2"), "pack")
    assert config.seed == int(layout.generate_state(1)[0])
    expected = draw_objects(Counter({"mug": 1, "can": 2}), "test", np.random.default_rng(shapes))
    assert same(config.objects, expected)
    other = config_of(PackOptions(seed=6, objects="mug=1,can=2"), "pack")
    assert other.seed != config.seed and not same(other.objects, config.objects)


def test_pack_has_a_box_and_sort_a_line(config_of):
    pack = config_of(PackOptions(box="0.4,0.2,0.1", objects="can=1", depth_noise="none"), "pack")
    assert pack.box.inner == (0.4, 0.2, 0.1) and pack.line is None and pack.depth_noise == "none"
    sort = config_of(SortOptions(objects="can=1", robot="sixaxis"), "sort")
    assert sort.box is None and sort.line == (Line().start, Line().end)
    assert len(sort.robot.description.joint_names) == 6 and sort.depth_noise == "gaussian"


def test_a_layout_without_room_names_the_option(monkeypatch):
    def full(self, config):
        raise LayoutError("9 objects do not fit on the table")

    monkeypatch.setattr(World, "__init__", full)
    with pytest.raises(UsageError, match="--objects can=2: 9 objects do not fit on the table"):
        build_world(PackOptions(objects="can=2"), "pack")


def test_objects_that_leave_no_room_are_replaced_by_narrower_ones_of_their_classes(monkeypatch):
    tried = []

    def full_twice(self, config):
        tried.append(config.objects)
        if len(tried) < 3:
            raise LayoutError("3 objects do not fit on the table")

    monkeypatch.setattr(World, "__init__", full_twice)
    build_world(PackOptions(objects="bowl=1,can=2"), "pack")
    assert [[m.category for m in models] for models in tried] == [[m.category for m in tried[0]]] * 3
    changed = [[a is not b for a, b in zip(*pair)] for pair in pairwise(tried)]
    for models, fewer, change in zip(tried, tried[1:], changed):
        assert sum(change) == 1
        index = change.index(True)
        assert fewer[index].radius < models[index].radius


@pytest.fixture
def mesh_folder(tmp_path, monkeypatch):
    """A folder with two mugs and one can; reading it takes no time."""
    models = [sample_object(c, "test", np.random.default_rng(i)) for i, c in enumerate(("mug", "can", "mug"))]
    read = {tmp_path: models}
    monkeypatch.setattr("sim_assets.objects.load_user_objects", lambda folder: read[folder])
    return tmp_path


def test_objects_from_mesh_files(mesh_folder, config_of):
    by_class = config_of(PackOptions(objects="mug=3,can=1", object_meshes=mesh_folder), "pack").objects
    assert [model.category for model in by_class] == ["mug", "mug", "mug", "can"]
    assert len({id(model) for model in by_class[:2]}) == 2  # no repetition before all have been used
    by_number = config_of(PackOptions(objects="3", object_meshes=mesh_folder), "pack").objects
    assert sorted(model.category for model in by_number) == ["can", "mug", "mug"]
    with pytest.raises(UsageError, match=r"--objects asks for a bowl but .* has none"):
        config_of(PackOptions(objects="bowl=1", object_meshes=mesh_folder), "pack")


def test_a_missing_mesh_folder_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"--object-meshes .*absent is no folder"):
        check_options(PackOptions(object_meshes=tmp_path / "absent"))


def test_own_meshes_that_topple_are_refused(tmp_path, monkeypatch):
    """A can whose base is a ball of 1 cm does not stand."""
    can = sample_object("can", "test", rng())
    pieces = (CollisionPiece("capsule", np.array([0, 0, 0.05]), IDENTITY, (0.01, 0.04)),)
    monkeypatch.setattr(
        "sim_assets.objects.load_user_objects", lambda folder: [replace(can, collision=pieces)]
    )
    with pytest.raises(
        UsageError, match=r"can/can does not stand on a table: it topples by \d+ degrees; leave"
    ):
        build_world(PackOptions(objects="1", object_meshes=tmp_path), "pack")


def test_objects_are_high_enough_for_the_fingers():
    cell = ArmCell(0.8, 0.8, 0.04)
    bowls = _draw_models(PackOptions(), ["bowl"] * 6, rng(), cell)
    assert len(bowls) == 6 and min(bowl.height for bowl in bowls) >= 0.04
    assert max(bowl.height for bowl in bowls) <= 0.8 * 0.09 + 1e-6
    usual = _draw_models(PackOptions(), ["bowl"] * 6, rng())
    assert same(usual, draw_objects(Counter(bowl=6), "test", rng()))
