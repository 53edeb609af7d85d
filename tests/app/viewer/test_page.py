"""The standalone page, without a browser."""

from app.runs.replay import Recorder
from app.viewer.load import LoadedRun, RunSummary
from app.viewer.page import add_summary, caption_text, is_page, write_page
from app.viewer.snapshot import ObjectOutcome, Snapshot


def test_captions_name_the_stage():
    assert caption_text(Snapshot(stage="execute", caption="Grasping mug 2")) == "Execute: Grasping mug 2"
    assert caption_text(Snapshot(stage="lost")) == "Tracking lost" and caption_text(Snapshot()) == ""


def test_the_summary_shows_the_end_of_the_run_and_escapes_its_title(recording):
    run = LoadedRun(recording, RunSummary(outcomes={0: ObjectOutcome(True, 0.004)}))
    html = add_summary("<head><title>Viser</title></head><body></body>", run, "<Pack>", "1 of 1")
    assert "<title>&lt;Pack&gt; · NodeSLAM</title>" in html and "<Pack>" not in html
    assert "in place, 4 mm from plan" in html and html.endswith("</details></body>")


def test_the_page_is_one_file_of_the_reported_size(tmp_path):
    recorder = Recorder()
    recorder.note("stage", name="scan")
    path = tmp_path / "page.html"
    assert write_page(path, LoadedRun(recorder), "Scan", "") == path.stat().st_size > 10_000
    assert is_page(path)
    assert "<title>Scan · NodeSLAM</title>" in path.read_text(encoding="utf-8")
