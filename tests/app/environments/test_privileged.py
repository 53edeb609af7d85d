"""True states of objects as a table."""

import numpy as np

from app.environments.privileged import COLUMNS, PrivilegedState
from app.task.scoring import read_truth
from perception.types import CATEGORIES


def test_rows_have_pose_class_and_size(cell_world):
    objects = PrivilegedState(cell_world)
    table, truth = objects.table(), read_truth(cell_world)
    assert table.shape == (2, len(COLUMNS)) and table.dtype == np.float32
    for row, (number, model) in zip(table, truth.models.items(), strict=True):
        entries = dict(zip(COLUMNS, row, strict=True))
        np.testing.assert_allclose(row[:3], truth.poses[number][:3, 3], atol=1e-6)
        w, x, y, z = row[3:7]
        assert np.isclose(w * w + x * x + y * y + z * z, 1, atol=1e-5)
        assert np.isclose(2 * (x * y + w * z), truth.poses[number][1, 0], atol=1e-5)
        assert [entries[name] for name in CATEGORIES] == [model.category == name for name in CATEGORIES]
        np.testing.assert_allclose(
            (entries["height"], entries["radius"]), (model.height, model.radius), rtol=1e-6
        )


def test_objects_at_rest_have_no_velocity(cell_world):
    _, velocities = PrivilegedState(cell_world).read()
    assert velocities.shape == (2, 6) and np.abs(velocities).max() < 0.05
