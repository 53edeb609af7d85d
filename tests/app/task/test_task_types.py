import pytest

from app.task.task_types import TaskRequest
from manipulation.types import Box

OTHER = Box(center=(0.5, 0.2))


@pytest.mark.parametrize(
    ("task", "box", "filled"),
    [("pack", OTHER, OTHER), ("pack", None, Box()), ("sort", OTHER, None), ("sort", None, None)],
)
def test_a_box_is_filled_in_packing_alone(task, box, filled):
    assert TaskRequest(task, box).filled_box == filled
