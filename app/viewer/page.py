"""Standalone HTML page: a replay with viser's client in one file, which opens offline in any browser."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from app.viewer import charts
from app.viewer.display import DisplayOptions
from app.viewer.load import LoadedRun
from app.viewer.scene import SceneView
from app.viewer.server import open_server
from app.viewer.snapshot import STAGE_TITLES, Snapshot
from app.viewer.surroundings import Surroundings, surroundings_of
from app.viewer.timeline import Timeline
from app.viewer.viewer import set_initial_view
from perception.io.files import read_bytes, write_atomically

TITLE_END = " · NodeSLAM</title>"
MAX_PAGE_BYTES = 2**30
STEP = 0.1  # [s] between snapshots
CELL_CAPTION = (0.30, 0.0, 1.02)  # [m] position of the caption in a cell, above the arm
CAPTION_HEIGHT = 0.35  # [m] above the ground elsewhere
_CARD = (
    "position:fixed;left:12px;top:12px;z-index:10;max-width:min(22em,calc(100vw - 48px));padding:0.8em 0.2em;"
    "background:rgba(255,255,255,0.92);border-radius:10px;box-shadow:0 2px 12px rgba(20,25,40,0.18);"
    "color:#22252b;max-height:70vh;overflow:auto"
)


def write_page(path: Path, run: LoadedRun, title: str, subtitle: str) -> int:
    """Write the page and return its size in bytes."""
    timeline, surroundings = Timeline(run.recorder), surroundings_of(run.recorder)
    server = open_server(port=0)  # no client connects: viser records the messages of a server only
    try:
        set_initial_view(server, surroundings)
        scene, options = SceneView(server, run.recorder, surroundings), DisplayOptions()
        scene.draw(timeline.at(0.0), options)
        caption = server.scene.add_label(
            "/caption", "", position=_caption_position(surroundings), anchor="bottom-center"
        )
        serializer = server.get_scene_serializer()
        for time in np.arange(0.0, timeline.end + STEP, STEP):
            snapshot = timeline.at(float(time))
            scene.draw(snapshot, options)
            if caption.text != (text := caption_text(snapshot)):
                caption.text = text
            serializer.insert_sleep(STEP)
        html = serializer.as_html()
    finally:
        server.stop()
    page = add_summary(html, run, title, subtitle)
    write_atomically(path, page)
    return len(page.encode())


def is_page(path: Path) -> bool:
    """Return whether a file is a page that was written here.

    Raises:
        InvalidInputError: It is not a regular file, or larger than any page.
    """
    return TITLE_END.encode() in read_bytes(path, MAX_PAGE_BYTES)


def caption_text(snapshot: Snapshot) -> str:
    """Return the title of the stage and the caption."""
    stage = STAGE_TITLES.get(snapshot.stage, "")
    return f"{stage}: {snapshot.caption}" if snapshot.caption else stage


def add_summary(html: str, run: LoadedRun, title: str, subtitle: str) -> str:
    """Return the page with its title and a card with the results of the run."""
    timeline = Timeline(run.recorder)
    objects = timeline.at(timeline.end).objects
    card = (
        f'<details open style="{_CARD}"><summary style="cursor:pointer;padding:0 0.75em">NodeSLAM</summary>'
        f"{charts.header(title, subtitle)}"
        f"{charts.object_table(objects, run.recorder.objects, run.summary.outcomes)}</details>"
    )
    html = html.replace("</body>", f"{card}</body>")
    return html.replace("<title>Viser</title>", f"<title>{escape(title)}{TITLE_END}")


def _caption_position(surroundings: Surroundings) -> np.ndarray:
    if surroundings.has_floor:
        return np.array(CELL_CAPTION)
    return surroundings.T_world_ground[:3, 3] + CAPTION_HEIGHT * surroundings.up
