"""Which object rests on which, and the gap between solids."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stacking
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.stacking import (
    LEAST_BASE,
    MeasuredExtent,
    ending_below,
    find_stacks,
    gap,
    rest_on,
    stacked,
)
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

PLANE = SupportPlane()
NO_POINTS = np.zeros((0, 3))


def square(x: float = 0.0, half: float = 0.03) -> np.ndarray:
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    return corners + np.array([x, 0.0])


def as_mesh(shape: trimesh.Trimesh, *at: float) -> TriangleMesh:
    return TriangleMesh(np.asarray(shape.vertices) + at, np.asarray(shape.faces))


def estimate(id: int, mesh: TriangleMesh, **changes) -> ObjectEstimate:
    return ObjectEstimate(id, "can", np.zeros(16), np.eye(4), np.full(3, 0.05), mesh, **changes)


def test_an_object_above_the_outline_of_another_rests_on_it() -> None:
    extents = {
        4: MeasuredExtent(square(), 0.001, 0.1),
        2: MeasuredExtent(square(0.01), 0.1, 0.15),
        3: MeasuredExtent(square(0.2), 0.0, 0.1),
    }
    assert stacked(extents) == {2: 4}


def test_a_tower_is_listed_from_below() -> None:
    extents = {k: MeasuredExtent(square(), 0.05 * (3 - k), 0.05 * (4 - k)) for k in (1, 2, 3)}
    assert list(stacked(extents).items()) == [(2, 3), (1, 2)]


@pytest.mark.parametrize(
    ("base", "x", "top"), [(LEAST_BASE / 2, 0.0, 0.15), (0.05, 0.1, 0.15), (0.05, 0.0, 0.1)]
)
def test_an_object_on_the_plane_or_beside_or_inside_another_rests_on_the_plane(base, x, top) -> None:
    """The last: an object whose foot is hidden, as high as the one that its outline overlaps."""
    extents = {1: MeasuredExtent(square(), 0.0, 0.1), 2: MeasuredExtent(square(x), base, top)}
    assert stacked(extents) == {}


def test_gap_between_boxes() -> None:
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = as_mesh(box, 0, 0, 0.05)
    assert gap(as_mesh(box, 0.02, 0, 0.17), lower, PLANE) == pytest.approx(0.02)
    assert gap(as_mesh(box, 0.02, 0, 0.14), lower, PLANE) == pytest.approx(-0.01)
    assert gap(as_mesh(box, 0.1, 0, 0.17), lower, PLANE) is None


def test_gap_to_the_floor_of_a_bowl() -> None:
    """A box over a tube with a floor: it can be lowered to the floor, not to the rim."""
    tube, floor = trimesh.creation.annulus(0.05, 0.055, 0.06), trimesh.creation.cylinder(0.05, 0.01)
    tube.apply_translation((0, 0, 0.03))
    floor.apply_translation((0, 0, 0.005))
    bowl = as_mesh(trimesh.util.concatenate([tube, floor]), 0, 0, 0)
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    assert gap(as_mesh(box, 0, 0, 0.08), bowl, PLANE) == pytest.approx(0.05, abs=1e-6)
    assert gap(as_mesh(box, 0.05, 0, 0.08), bowl, PLANE) == pytest.approx(0.0, abs=1e-6)  # on the rim


@pytest.mark.parametrize(
    ("category", "base", "height"),
    [
        ("can", 0.08, 0.088),
        ("can", 0.095, 0.1),
        ("can", 0.06, 0.068),
        ("can", 0.04, 0.1),
        ("can", 0.13, 0.13),
        ("can", 0.15, 0.1),
        ("bowl", 0.08, 0.088),
        ("bowl", 0.13, 0.1),  # whose rim is seen
    ],
)
def test_what_is_hidden_below_an_object_ends_where_that_begins(category, base, height) -> None:
    """Its foot stays on the plane; where both hardly overlap, or the height is far off, it is as it was."""
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    T = np.eye(4)
    T[2, 3] = 0.05
    lower = replace(
        estimate(3, as_mesh(box, 0, 0, 0)), category=category, T_world_object=T, resting="upright"
    )
    upper = estimate(4, as_mesh(box, 0.01, 0, 0.05 + base))
    found = ending_below(lower, upper, PLANE, NO_POINTS)
    heights = found.mesh_world.vertices[:, 2]
    assert heights.min() == pytest.approx(0.0, abs=1e-9) and heights.max() == pytest.approx(height, abs=1e-6)
    np.testing.assert_allclose(found.scale, lower.scale * [1, 1, height / 0.1])
    np.testing.assert_allclose(np.ptp(found.mesh.vertices[:, :2], axis=0), 0.06)
    assert ending_below(replace(lower, resting="lying"), upper, PLANE, NO_POINTS).height == pytest.approx(0.1)
    beside = estimate(4, as_mesh(box, 0.1, 0, 0.05 + base))
    assert ending_below(lower, beside, PLANE, NO_POINTS).height == pytest.approx(0.1)


@pytest.mark.parametrize(("highest", "height"), [(0.05, 0.068), (0.1, 0.1)])
def test_a_rim_that_is_measured_stays_where_it_is(highest, height) -> None:
    """The handle of a mug may be estimated through the rim of the bowl that it is in."""
    side = np.stack([np.full(50, -0.03), np.zeros(50), np.linspace(0.0, highest, 50)], axis=1)
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    T = np.eye(4)
    T[2, 3] = 0.05
    mesh = as_mesh(box, 0, 0, 0)
    lower = replace(estimate(3, mesh), category="bowl", T_world_object=T, resting="upright")
    upper = estimate(4, as_mesh(box, 0.04, 0, 0.05 + 0.06))
    assert ending_below(lower, upper, PLANE, side).height == pytest.approx(height, abs=1e-6)


def test_a_handle_that_ends_up_too_low_does_not_contradict() -> None:
    box, handle = trimesh.creation.box((0.06, 0.06, 0.1)), trimesh.creation.box((0.03, 0.01, 0.01))
    handle.apply_translation((-0.045, 0, 0.01))
    T = np.eye(4)
    T[2, 3] = 0.05
    mesh = as_mesh(trimesh.util.concatenate([box, handle]), 0, 0, 0)
    lower = replace(estimate(3, mesh), category="mug", T_world_object=T, resting="upright")
    upper = estimate(4, as_mesh(box, 0, 0, 0.05 + 0.06))
    outer = np.stack([np.full(50, -0.06), np.zeros(50), np.full(50, 0.062)], axis=1)  # of the handle
    assert ending_below(lower, upper, PLANE, outer).height == pytest.approx(0.068, abs=1e-6)


def test_the_upper_object_is_fitted_on_the_contact(make_table) -> None:
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = estimate(3, as_mesh(box, 0.4, -0.1, -0.05 + 0.02))  # its top is 2 cm above the plane
    offsets, free = [], []

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        offsets.append(plane.offset)
        free.append(config.noise.support_sigma > 0.01)
        return estimate(7, as_mesh(box, 0.4, -0.1, 0.05 + 0.03))  # its foot is 3 cm above the plane

    above = rest_on(views, lower, PLANE, FitConfig(), fit)
    assert above.rests_on == 3
    np.testing.assert_allclose(offsets, [0.02, 0.02], atol=1e-9)
    assert free == [True, False]


@pytest.mark.parametrize(
    ("category", "on_contact", "floating", "height"),
    [
        ("can", 0.9, 0.03, 0.03),
        ("can", 0.9, 0.015, 0.015),
        ("can", 0.9, 0.013, 0.02),  # far inside the can
        ("can", 0.96, 0.03, 0.02),
        ("bowl", 0.9, 0.03, 0.02),
        ("bowl", 0.5, 0.03, 0.03),
    ],
)
def test_the_hidden_top_of_what_is_below_does_not_pull_an_object_down(
    make_table, monkeypatch, category, on_contact, floating, height
) -> None:
    """The fit at any height is kept on a can if it is as good; on a vessel only if it is clearly better."""
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = replace(estimate(3, as_mesh(box, 0.4, -0.1, -0.05 + 0.02)), category=category)
    seen = replace(MeasuredExtent.of(views, PLANE), base=0.03)
    monkeypatch.setattr(MeasuredExtent, "of", lambda *_: seen)
    monkeypatch.setattr(stacking, "unexplained", lambda *_: 0.01)

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        is_free = config.noise.support_sigma > 0.01
        base, score = (floating, 0.91) if is_free else (0.02, on_contact)
        return estimate(7, as_mesh(box, 0.4, -0.1, 0.05 + base), score=score)

    found = rest_on(views, lower, PLANE, FitConfig(), fit)
    assert found.mesh_world.vertices[:, 2].min() == pytest.approx(height)


@pytest.mark.parametrize(("low_share", "stands_high"), [(0.3, True), (0.04, False), (0.012, False)])
def test_the_lower_object_may_be_taller_than_what_is_seen_of_it(
    make_table, monkeypatch, low_share, stands_high
) -> None:
    """A can that a bowl hides ends at 2 cm; what is measured of the bowl begins at 6 cm above the plane."""
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = estimate(3, as_mesh(box, 0.4, -0.1, -0.05 + 0.02))
    seen = replace(MeasuredExtent.of(views, PLANE), base=0.06)
    starts = []

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        starts.append(round(plane.offset, 3))
        return estimate(7, as_mesh(box, 0.4, -0.1, 0.05 + plane.offset))

    def share(_: np.ndarray, shapes: list[ObjectEstimate]) -> float:
        return 0.01 if shapes[0].mesh_world.vertices[:, 2].min() > 0.04 else low_share

    monkeypatch.setattr(MeasuredExtent, "of", lambda *_: seen)
    monkeypatch.setattr(stacking, "unexplained", share)
    found = rest_on(views, lower, PLANE, FitConfig(), fit)
    poor = low_share >= 0.05  # only then a second start is worth a fit
    assert starts == ([0.02, 0.05, 0.02] if poor else [0.02, 0.02]) and found.rests_on == 3
    assert found.mesh_world.vertices[:, 2].min() == pytest.approx(0.05 if stands_high else 0.02, abs=1e-6)


@pytest.mark.parametrize(("base", "floats"), [(0.073, True), (0.077, False)])
def test_what_was_measured_below_the_contact_does_not_rest_on_it(
    make_table, monkeypatch, base, floats
) -> None:
    """A mug whose rim a bowl hides is estimated too high, and the floor of the bowl in it is below that."""
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = replace(estimate(3, as_mesh(box, 0.4, -0.1, -0.05 + 0.08)), category="mug")
    seen = MeasuredExtent(square() + np.array([0.4, -0.1]), base, 0.15)
    monkeypatch.setattr(MeasuredExtent, "of", lambda *_: seen)
    monkeypatch.setattr(stacking, "unexplained", lambda *_: 0.01)

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        bottom = 0.06 if config.noise.support_sigma == stacking.FREE else plane.offset
        return estimate(7, as_mesh(box, 0.4, -0.1, 0.05 + bottom))

    found = rest_on(views, lower, PLANE, FitConfig(), fit)
    assert found.rests_on == 3
    assert found.mesh_world.vertices[:, 2].min() == pytest.approx(0.06 if floats else 0.08, abs=1e-6)


@pytest.mark.parametrize(
    ("category", "shares", "residuals", "leans"),
    [
        ("bowl", (0.3, 0.01), (0.006, 0.006), True),
        ("bowl", (0.3, 0.25), (0.006, 0.006), False),  # the tilt explains hardly more
        ("bowl", (0.04, 0.01), (0.006, 0.006), False),  # upright explains nearly all, and as closely
        ("bowl", (0.01, 0.01), (0.006, 0.0045), True),
        ("can", (0.3, 0.01), (0.006, 0.0045), False),  # nothing leans on the top of a can
    ],
)
def test_what_leans_in_a_vessel_is_tilted_if_that_explains_it_better(
    make_table, monkeypatch, category, shares, residuals, leans
) -> None:
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = replace(estimate(3, as_mesh(box, 0.4, -0.1, 0.05)), category=category)
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        upper = estimate(7, as_mesh(box, 0.4, -0.1, 0.07))  # its foot is below the rim
        if config.noise.tilt_sigma < 0.1:
            return replace(upper, residual=residuals[0])
        assert config.noise.support_sigma > 0.01 and config.max_tilt > np.deg2rad(30)
        return replace(upper, T_world_object=tilt, residual=residuals[1])

    def share(points: np.ndarray, shapes: list[ObjectEstimate]) -> float:
        return shares[int(shapes[0].T_world_object[2, 2] < 0.99)]

    monkeypatch.setattr(stacking, "unexplained", share)
    found = rest_on(views, lower, PLANE, FitConfig(), fit)
    assert (found.T_world_object[2, 2] < 0.99) == leans and found.rests_on == 3


@pytest.mark.parametrize("lower_x, upper_x, fits", [(0.4, 2.0, 2), (1.0, 0.4, 1)])
def test_an_object_beside_the_other_one_stands_on_the_plane(make_table, lower_x, upper_x, fits) -> None:
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    lower = estimate(3, as_mesh(trimesh.creation.box((0.06, 0.06, 0.1)), lower_x, -0.1, -0.03))
    offsets = []

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        offsets.append((plane.offset, config.noise.support_sigma))
        return estimate(7, as_mesh(trimesh.creation.box((0.06, 0.06, 0.1)), upper_x, 0, 0))

    found = rest_on(views, lower, PLANE, FitConfig(), fit)
    assert found.rests_on is None and len(offsets) == fits
    assert offsets[-1] == (PLANE.offset, FitConfig().noise.support_sigma)


@pytest.mark.parametrize("beside, rests_on", [(0.012, None), (0.002, 3), (-0.02, 3)])
def test_an_object_whose_middle_is_beside_the_other_one_stands_on_the_plane(
    make_table, beside, rests_on
) -> None:
    """Their outlines overlap, and the measured part of the upper one is above the lower one's edge."""
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = estimate(3, as_mesh(box, 0.4, -0.1, -0.03))
    planes = []

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        planes.append(plane)
        return estimate(7, as_mesh(box, 0.4 + 0.03 + beside, -0.1, 0.05 + plane.offset))

    assert rest_on(views, lower, PLANE, FitConfig(), fit).rests_on == rests_on
    assert (planes[-1] == PLANE) == (rests_on is None)


def test_nothing_stands_on_an_object_on_its_side(make_table) -> None:
    """It hides the foot of what stands behind it, whose lowest measured points are above it."""
    table = make_table("can", (), yaw=0.0)
    views = ObjectViews(7, "can", 1.0, tuple(table.observations((0.0,))))
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    lower = estimate(3, as_mesh(box, 0.4, -0.1, -0.03), resting="lying")
    planes = []

    def fit(_: ObjectViews, plane: SupportPlane, config: FitConfig) -> ObjectEstimate:
        planes.append((plane, config))
        return estimate(7, as_mesh(box, 0.4, -0.1, 0.08))

    assert rest_on(views, lower, PLANE, FitConfig(), fit).rests_on is None
    assert planes == [(PLANE, FitConfig())]


def test_one_object_is_not_measured() -> None:
    assert find_stacks([ObjectViews(1, "can", 1.0, ())], {1: PLANE}) == {}
