"""Poses in the toolkit's CSV: frames, units, numbers of scenes and classes, field of view."""

import csv

import numpy as np
import pytest
import trimesh

from perception.io.bop_results import HEADER, PosedImage, in_view, model_pose, write_bop_results
from perception.types import CameraIntrinsics, ObjectEstimate, TriangleMesh

LENS = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)


def can(score=0.8):
    """A can whose canonical origin is 2 cm below the centre of its bounding box, turned by 90 degrees."""
    mesh = trimesh.creation.box((0.06, 0.06, 0.1))
    T = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.0], [0, 0, 1, 0.03], [0, 0, 0, 1]], dtype=float)
    vertices = mesh.vertices + np.array([0, 0, 0.02])
    return ObjectEstimate(
        3, "can", np.zeros(16), T, np.full(3, 0.05), TriangleMesh(vertices, mesh.faces), score=score
    )


def overhead(id, x=0.1):
    """A camera 0.5 m above the table, looking down, image x along world x."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (x, 0, 0.5)
    return PosedImage(id, T, LENS)


def rows(path):
    with path.open() as file:
        return list(csv.reader(file))


def test_poses_of_the_bounding_box_in_millimetres(tmp_path):
    write_bop_results(tmp_path / "bop.csv", tmp_path / "000007", [can()], [overhead(4), overhead(9)], 3.0)
    header, first, second = rows(tmp_path / "bop.csv")
    assert ",".join(header) == HEADER
    assert [first[0], first[1], first[2], first[3], first[6]] == ["7", "4", "4", "0.800000", "1.500000"]
    assert second[1] == "9"
    R, t = (np.array(text.split(), dtype=float) for text in first[4:6])
    np.testing.assert_allclose(t, (0, 0, 450), atol=1e-3)
    np.testing.assert_allclose(R.reshape(3, 3), [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-9)
    np.testing.assert_allclose(model_pose(can())[:3, 3], (0.1, 0, 0.05))


def test_objects_outside_the_image_have_no_line(tmp_path):
    write_bop_results(tmp_path / "bop.csv", tmp_path, [can()], [overhead(0, x=1.0)], 1.0)
    assert rows(tmp_path / "bop.csv") == [HEADER.split(",")]


def test_folders_that_are_no_number_are_scene_0(tmp_path):
    write_bop_results(tmp_path / "bop.csv", tmp_path / "mine", [can(score=1.7)], [overhead(0)], 1.0)
    assert rows(tmp_path / "bop.csv")[1][0] == "0" and rows(tmp_path / "bop.csv")[1][3] == "1.000000"


def test_objects_of_which_a_part_is_in_the_image_have_a_line(tmp_path):
    # At the height of the table the image ends 0.266 m beside its middle; the can is 0.03 m to each side.
    for x, seen in ((0.1 + 0.266 + 0.025, True), (0.1 + 0.266 + 0.035, False)):
        write_bop_results(tmp_path / "bop.csv", tmp_path, [can()], [overhead(0, x=x)], 1.0)
        assert len(rows(tmp_path / "bop.csv")) == 1 + seen


@pytest.mark.parametrize(
    ("points", "seen"),
    [
        ([(0, 0, 1)], True),
        ([(0, 0, -1)], False),
        ([(0, 0, 0)], False),
        ([(0.54, 0, 1)], False),
        ([(0, -0.41, 1)], False),
        ([(0.54, 0, 1), (0.52, 0, 1)], True),
        ([(0.54, 0, 1), (0, 0.41, 1)], False),  # u is in the image in one, v in the other
    ],
)
def test_the_field_of_view(points, seen):
    assert in_view(np.array(points, dtype=float), LENS) == seen
