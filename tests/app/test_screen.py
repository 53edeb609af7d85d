import pytest

from app.screen import Screen


def test_results_go_to_standard_output_and_progress_to_standard_error(capsys):
    screen = Screen()
    with screen.stage("Planning"):
        screen.update("1 of 2")
        screen.note("a [note]")
    screen.show("a result")
    out, err = capsys.readouterr()
    assert out == "a result\n"
    assert "Planning" in err and "a [note]" in err and "a result" not in err


def test_a_quiet_screen_prints_nothing(capsys):
    screen = Screen(quiet=True)
    with screen.stage("Planning"):
        screen.update("1 of 2")
        screen.note("a note")
    screen.show("a result")
    assert capsys.readouterr() == ("", "")


def test_an_error_passes_through_a_stage():
    with pytest.raises(KeyError), Screen().stage("Planning"):
        raise KeyError


def test_an_update_outside_a_stage_is_ignored(capsys):
    Screen().update("1 of 2")
    assert capsys.readouterr() == ("", "")
