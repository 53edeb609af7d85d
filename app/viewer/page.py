"""The standalone page: a recording with viser's client in one HTML file that opens offline in any browser."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from app.viewer import charts
from app.viewer.load import Run
from app.viewer.meshes import Meshes
from app.viewer.scene import SceneView, Shown
from app.viewer.server import open_server
from app.viewer.snapshot import MAPPING, STAGE_NAMES, Moment
from app.viewer.surroundings import surroundings_of
from app.viewer.timeline import Story
from app.viewer.viewer import look_from_home
from perception.io.files import write_atomically

STEP = 0.1  # [s] between the recorded moments
CAPTION_AT = (0.30, 0.0, 1.02)  # [m] above the arm of a cell
CAPTION_UP = 0.35  # [m] above the support elsewhere
_CARD = (
    "position:fixed;left:12px;top:12px;z-index:10;max-width:min(22em,calc(100vw - 48px));padding:0.8em 0.2em;"
    "background:rgba(255,255,255,0.92);border-radius:10px;box-shadow:0 2px 12px rgba(20,25,40,0.18);"
    "color:#22252b;max-height:70vh;overflow:auto"
)


def write_page(path: Path, shown: Run, title: str, subtitle: str) -> int:
    """Write the page and return its size in bytes."""
    story = Story(shown.recorder)
    server = open_server(port=0)  # nobody is told of it: it only serves to record its messages
    try:
        around = surroundings_of(shown.recorder)
        look_from_home(server, around)
        scene = SceneView(server, shown.recorder, Meshes(shown.recorder), around)
        scene.draw(story.at(0.0), Shown())
        at = CAPTION_AT if around.known else around.T_world_ground[:3, 3] + CAPTION_UP * around.up
        caption = server.scene.add_label("/caption", "", position=at, anchor="bottom-center")
        serializer = server.get_scene_serializer()
        for time in np.arange(0.0, story.end + STEP, STEP):
            moment = story.at(float(time))
            scene.draw(moment, Shown())
            if caption.text != _caption(moment):
                caption.text = _caption(moment)
            serializer.insert_sleep(STEP)
        html = serializer.as_html()
    finally:
        server.stop()
    page = _with_card(html, shown, story, title, subtitle)
    write_atomically(path, page)
    return len(page.encode())


def _caption(moment: Moment) -> str:
    stage = (STAGE_NAMES | MAPPING).get(moment.stage, "")
    return f"{stage}: {moment.caption}" if moment.caption else stage


def _with_card(html: str, shown: Run, story: Story, title: str, subtitle: str) -> str:
    """The page with a card that says what it shows and how it went."""
    end = story.at(story.end)
    objects = shown.report.get("objects")
    results = {entry.get("id"): entry for entry in objects} if isinstance(objects, list) else {}
    card = (
        f'<details open style="{_CARD}"><summary style="cursor:pointer;padding:0 0.75em">NodeSLAM</summary>'
        f"{charts.header(title, subtitle)}"
        f"{charts.object_table(end.objects, shown.recorder.objects, results)}</details>"
    )
    html = html.replace("</body>", f"{card}</body>")
    return html.replace("<title>Viser</title>", f"<title>{escape(title)} · NodeSLAM</title>")
