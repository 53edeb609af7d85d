import pytest

from manipulation.errors import NoPlanError, PlanningError


def test_a_missing_plan_names_what_is_in_the_way():
    with pytest.raises(PlanningError, match="No plan for can_1") as error:
        raise NoPlanError("No plan for can_1", ("bowl_2", "thing_0"))
    assert isinstance(error.value, NoPlanError) and error.value.blockers == ("bowl_2", "thing_0")
    assert NoPlanError("No plan for can_1").blockers == ()
