"""The panel beside the scene: what happens, time, pictures, objects, plots, and what to show.

A person's choices are read here and nowhere else; text goes through ``charts``, which escapes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import cv2
import numpy as np
import viser
from jaxtyping import UInt8

from app.drawing import draw_detections
from app.viewer import charts
from app.viewer.meshes import UNSURE, UNSURE_COLORS
from app.viewer.player import Player
from app.viewer.scene import Coloring, Objects, Shown
from app.viewer.snapshot import Moment
from perception.types import RgbdFrame

SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x", "8x")
CAMERAS = ("free", "follow the motion", "through the camera")
IMAGE_WIDTH = 480  # [px]
DEPTH_SHARES = (1, 99)  # [%] of the measurements between which the depth picture has its colours
_TICK = 0.05  # [s] step of the time slider
_NOTHING = np.full((IMAGE_WIDTH * 3 // 4, IMAGE_WIDTH, 3), 236, np.uint8)


class Panel:
    """All controls of the viewer but those of a run that happens now."""

    def __init__(self, server: viser.ViserServer, player: Player) -> None:
        self._server, self._player = server, player
        self._results: Mapping[int, Mapping[str, Any]] = {}
        self._html: dict[str, str] = {}
        self._picture: tuple[int, bool] | None = None
        self._moving = False  # the slider, by us rather than by a person
        gui = server.gui
        gui.set_panel_label("NodeSLAM")
        gui.configure_theme(
            control_layout="collapsible",
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(31, 111, 208),
        )
        self._header = gui.add_html("", order=0)
        self._timeline = gui.add_html("", order=2)
        with gui.add_folder("Replay", order=3):
            self._playback(gui)
        tabs = gui.add_tab_group(order=4)
        with tabs.add_tab("Camera", viser.Icon.CAMERA):
            self._view = gui.add_html("")
            self._color = gui.add_image(_NOTHING, label="Colour, with what was found", format="jpeg")
            self._depth = gui.add_image(_NOTHING, label="Depth, near to far", format="jpeg")
        with tabs.add_tab("Objects", viser.Icon.CUBE):
            self._objects = gui.add_html("")
        with tabs.add_tab("Plots", viser.Icon.CHART_LINE):
            self._curves = gui.add_html("")
            self._of: viser.GuiDropdownHandle[Any] = gui.add_dropdown("Shape code of", ("-",))
            self._bars = gui.add_html("")
        with tabs.add_tab("Show", viser.Icon.EYE):
            self._choices(gui)

    def _playback(self, gui: viser.GuiApi) -> None:
        player = self._player
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._slider = gui.add_slider("Time [s]", 0.0, 1.0, _TICK, 0.0)
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        self._jump = gui.add_button_group("Jump to", tuple(player.story.stage_titles.values()))
        self._live = gui.add_button("Back to now", icon=viser.Icon.PLAYER_SKIP_FORWARD, visible=False)

        @self._play.on_click
        def _(_: viser.GuiEvent) -> None:
            player.pause() if player.playing else player.play()

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                player.seek(float(self._slider.value))

        @self._speed.on_update
        def _(_: viser.GuiEvent) -> None:
            if self._speed.value in SPEEDS:
                player.speed = float(self._speed.value.rstrip("x"))

        @self._jump.on_click
        def _(_: viser.GuiEvent) -> None:
            for span in player.story.stages:
                if span.title == self._jump.value:
                    player.seek(span.begin)

        @self._live.on_click
        def _(_: viser.GuiEvent) -> None:
            player.follow()

    def _choices(self, gui: viser.GuiApi) -> None:
        gui.add_html(charts.legend())
        self._which = gui.add_dropdown(
            "Objects", get_args(Objects), hint="As reconstructed, as they truly are in the simulator, or both"
        )
        self._boxes = {
            "goals": gui.add_checkbox("Goals of the plan", True),
            "motion": gui.add_checkbox("Path and grasp candidates", True),
            "cameras": gui.add_checkbox("Cameras of the scan", True),
            "labels": gui.add_checkbox("Names", True),
            # A browser that draws without a GPU shares the processor with a run beside it.
            "shadows": gui.add_checkbox("Shadows", not self._player.live, hint="Dear without a GPU"),
        }
        self._coloring = gui.add_dropdown("Colour by", get_args(Coloring))
        gui.add_html(charts.scale("sure", f"{1000 * UNSURE:.0f} mm of deviation", UNSURE_COLORS))
        self._camera = gui.add_dropdown("View", CAMERAS)

    @property
    def shown(self) -> Shown:
        """What a person chose to see."""
        flags = {name: bool(box.value) for name, box in self._boxes.items()}
        return Shown(
            **flags,
            coloring=chosen(self._coloring, get_args(Coloring)),
            objects=chosen(self._which, get_args(Objects)),
        )

    @property
    def camera(self) -> str:
        """How the view moves; one of CAMERAS."""
        return chosen(self._camera, CAMERAS)

    def title(self, title: str, subtitle: str, results: Mapping[int, Mapping[str, Any]]) -> None:
        """What is shown, and what the report says of each object, by id."""
        self._results = results
        self._set(self._header, charts.header(title, subtitle))

    def draw(self, moment: Moment) -> None:
        """Bring the panel to a moment; only what has changed is sent."""
        player, story = self._player, self._player.story
        self._set(
            self._timeline, charts.timeline(story.stages, moment.time, moment.caption, story.stage_titles)
        )
        self._draw_playback(player)
        self._draw_picture(moment)
        estimates = story.recorder.objects
        self._set(self._objects, charts.object_table(moment.objects, estimates, self._results))
        self._draw_plots(moment)

    def _draw_playback(self, player: Player) -> None:
        label = "Pause" if player.playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if player.playing else viser.Icon.PLAYER_PLAY
        end = max(round(player.story.end, 2), _TICK)
        if self._slider.max != end:
            self._slider.max = end
        self._slider.value = min(round(player.time / _TICK) * _TICK, end)
        behind = player.live and not player.following
        if self._live.visible != behind:
            self._live.visible = behind

    def _draw_picture(self, moment: Moment) -> None:
        recorder = self._player.story.recorder
        index = (moment.n_found if moment.stage == "detect" else moment.n_frames) - 1
        found = index < moment.n_found and index < len(recorder.detections)
        if not 0 <= index < len(recorder.frames) or self._picture == (index, found):
            return
        self._picture = (index, found)
        frame = recorder.frames[index]
        color = draw_detections(frame, recorder.detections[index], by_class=True) if found else frame.rgb
        self._color.image, self._depth.image = _small(np.asarray(color)), depth_picture(frame)
        self._set(self._view, charts.note(f"Image {index + 1} of {len(recorder.frames)}"))

    def _draw_plots(self, moment: Moment) -> None:
        story = self._player.story
        lines: dict[str, charts.Curve] = {
            believed.name: (*_millimetres(*story.residuals(number, moment.time)), believed.category)
            for number, believed in moment.objects.items()
        }
        self._set(self._curves, charts.curves("Depth residual of the fits", lines, "mm"))
        names = tuple(believed.name for believed in moment.objects.values()) or ("-",)
        if self._of.options != names:
            self._of.options = names
        chosen = [one for one in moment.objects.values() if one.name == self._of.value]
        for believed in chosen:
            self._set(self._bars, charts.bars("Shape code", believed.code.tolist(), believed.category))

    def _set(self, handle: viser.GuiHtmlHandle, content: str) -> None:
        if handle.content != content:
            handle.content = content


def chosen(menu: viser.GuiDropdownHandle[Any], options: tuple[Any, ...]) -> Any:
    """What a menu says; its first option where a client has sent what is none."""
    return menu.value if menu.value in options else options[0]


def _millimetres(iterations: list[int], residuals: list[float]) -> tuple[list[int], list[float]]:
    return iterations, [1000 * residual for residual in residuals]


def depth_picture(frame: RgbdFrame) -> UInt8[np.ndarray, "h w 3"]:
    """Depth in colours, what was not measured in grey."""
    measured = frame.depth[frame.depth > 0]
    near, far = np.percentile(measured, DEPTH_SHARES) if measured.size else (0.0, 1.0)
    share = 1 - np.clip((frame.depth - near) / max(far - near, 1e-3), 0, 1)
    picture = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    picture = np.where((frame.depth > 0)[..., None], picture, 60).astype(np.uint8)
    return _small(picture)


def _small(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "k l 3"]:
    height = round(IMAGE_WIDTH * image.shape[0] / image.shape[1])
    return cv2.resize(np.ascontiguousarray(image), (IMAGE_WIDTH, height), interpolation=cv2.INTER_AREA)
