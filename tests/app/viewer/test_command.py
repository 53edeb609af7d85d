"""The view command, and watching a run."""

from pathlib import Path

import pytest

from app.errors import UsageError
from app.options import PackOptions, ViewOptions
from app.runs.replay import Recorder
from app.screen import Screen
from app.task.run_control import RunControl
from app.viewer import command
from app.viewer.load import LoadedRun, RunSummary
from perception.errors import InvalidInputError

QUIET = Screen(quiet=True)


@pytest.fixture
def opened(monkeypatch, server):
    """Addresses at which a server was opened; the first wait for an interrupt is interrupted."""
    addresses = []

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "open_server", lambda *address: addresses.append(address) or server)
    monkeypatch.setattr(command.time, "sleep", interrupt)
    monkeypatch.setattr(server, "stop", lambda: addresses.append("stopped"))
    return addresses


@pytest.mark.parametrize(
    ("summary", "expected"),
    [
        (RunSummary("pack", 3, "1 of 1"), ("Pack, seed 3", "1 of 1")),
        (RunSummary("slam", 3, "done"), ("SLAM", "done")),
        (RunSummary(), ("folder", "")),
    ],
)
def test_titles_name_the_command_and_the_seed_of_its_scene(summary, expected):
    assert command.titles(LoadedRun(Recorder(), summary), Path("runs/folder")) == expected


def test_a_replay_is_served_locally_until_interrupted(run_folder, opened):
    report = command.run(ViewOptions(run=run_folder), QUIET)
    assert opened == [("127.0.0.1", None), "stopped"]
    assert report.success and report.reason == f"{run_folder} was shown"


def test_a_page_needs_a_run(tmp_path):
    with pytest.raises(UsageError, match="view RUN --html FILE"):
        command.run(ViewOptions(html=tmp_path / "page.html"), QUIET)
    with pytest.raises(UsageError, match="is a folder: give a file"):
        command.run(ViewOptions(run=tmp_path, html=tmp_path), QUIET)


def test_the_folder_of_a_page_must_exist(run_folder, tmp_path):
    with pytest.raises(UsageError, match="pages is no folder: create it, or give another file"):
        command.run(ViewOptions(run=run_folder, html=tmp_path / "pages" / "page.html"), QUIET)
    assert not (tmp_path / "pages").exists()


def test_only_pages_are_replaced_by_a_page(run_folder, tmp_path):
    options = ViewOptions(run=run_folder, html=tmp_path / "thesis.html")
    options.html.write_text("<title>Thesis</title>")
    with pytest.raises(UsageError, match="is no page of this program: give another file"):
        command.run(options, QUIET)
    assert options.html.read_text() == "<title>Thesis</title>"
    with pytest.raises(InvalidInputError, match="/dev/null is a device, not a regular file"):
        command.run(ViewOptions(run=run_folder, html=Path("/dev/null")), QUIET)


def test_the_viewer_of_a_run_closes_with_it(opened, server, monkeypatch):
    titles = []
    monkeypatch.setattr(command.Viewer, "set_title", lambda _, *title: titles.append(title))
    options = PackOptions(seed=4, host="192.0.2.7", port=8123)
    with pytest.raises(ValueError, match="failed"), command.watch(options, Recorder(), RunControl(), QUIET):
        assert opened == [("192.0.2.7", 8123)]
        raise ValueError("failed")
    assert opened[-1] == "stopped" and titles == [("Pack, seed 4", "running")]
