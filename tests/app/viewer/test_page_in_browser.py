import pytest

from app.errors import UsageError
from app.options import ViewOptions
from app.screen import Screen
from app.viewer.command import run


def test_the_standalone_page_opens_from_a_file(run_folder, tmp_path, open_page):
    path = tmp_path / "page.html"
    report = run(ViewOptions(run=run_folder, html=path), Screen(quiet=True))
    assert report.success and report.metrics["bytes"] == path.stat().st_size < 5e6
    content = path.read_text()
    assert "<title>Pack, seed 3 · NodeSLAM</title>" in content
    page = open_page(str(path))
    page.page.get_by_text("can 0", exact=True).first.wait_for()  # in the card of results
    page.page.locator("canvas").last.wait_for()
    assert page.problems == []  # no request to any network


def test_a_page_needs_a_run(tmp_path):
    with pytest.raises(UsageError, match="view RUN --html FILE"):
        run(ViewOptions(html=tmp_path / "page.html"), Screen(quiet=True))
