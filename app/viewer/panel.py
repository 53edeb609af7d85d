"""The panel beside the scene: stages, playback, images, objects, plots and display options.

The choices of the user are read and validated here only; all text goes through ``charts``, which escapes it.
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
from app.viewer.display import Coloring, DisplayOptions, ObjectSource
from app.viewer.meshes import MAX_DEVIATION, UNCERTAINTY_COLORS
from app.viewer.player import Player
from app.viewer.snapshot import ObjectOutcome, Snapshot
from perception.types import RgbdFrame

SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x", "8x")
VIEWS = ("free", "follow the gripper", "wrist camera")
_, FOLLOW, THROUGH_CAMERA = VIEWS
IMAGE_WIDTH = 480  # [px]
DEPTH_PERCENTILES = (1, 99)  # ends of the colour scale of depth
MISSING_DEPTH = 60  # grey value
TIME_STEP = 0.05  # [s] of the time slider
BLANK_IMAGE = np.full((IMAGE_WIDTH * 3 // 4, IMAGE_WIDTH, 3), 236, np.uint8)


class Panel:
    """All controls of the viewer except those of a live run."""

    def __init__(self, server: viser.ViserServer, player: Player) -> None:
        self._player = player
        self._outcomes: Mapping[int, ObjectOutcome] = {}
        self._drawn: tuple[RgbdFrame, bool] | None = None  # frame, and whether with its detections
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
        self._stages = gui.add_html("", order=2)
        with gui.add_folder("Playback", order=3):
            self._add_playback(gui)
        tabs = gui.add_tab_group(order=4)
        with tabs.add_tab("Camera", viser.Icon.CAMERA):
            self._image_note = gui.add_html("")
            self._color = gui.add_image(BLANK_IMAGE, label="Colour with detections", format="jpeg")
            self._depth = gui.add_image(BLANK_IMAGE, label="Depth", format="jpeg")
        with tabs.add_tab("Objects", viser.Icon.CUBE):
            self._objects = gui.add_html("")
        with tabs.add_tab("Plots", viser.Icon.CHART_LINE):
            self._curves = gui.add_html("")
            self._code_of: viser.GuiDropdownHandle[Any] = gui.add_dropdown("Shape code of", ("-",))
            self._bars = gui.add_html("")
        with tabs.add_tab("Display", viser.Icon.EYE):
            self._add_options(gui)

    def _add_playback(self, gui: viser.GuiApi) -> None:
        player = self._player
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._slider = gui.add_slider("Time [s]", 0.0, 1.0, TIME_STEP, 0.0)
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        self._jump = gui.add_button_group("Jump to", tuple(player.timeline.stage_titles.values()))
        self._follow = gui.add_button("Follow live", icon=viser.Icon.PLAYER_SKIP_FORWARD, visible=False)

        @self._play.on_click
        def _(_: viser.GuiEvent) -> None:
            player.pause() if player.playing else player.play()

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:  # moved by a user, not by the playback
                player.seek(float(self._slider.value))

        @self._speed.on_update
        def _(_: viser.GuiEvent) -> None:
            player.speed = float(selected(self._speed, SPEEDS).rstrip("x"))

        @self._jump.on_click
        def _(_: viser.GuiEvent) -> None:
            for span in player.timeline.stages:
                if span.title == self._jump.value:
                    player.seek(span.begin)

        @self._follow.on_click
        def _(_: viser.GuiEvent) -> None:
            player.follow()

    def _add_options(self, gui: viser.GuiApi) -> None:
        gui.add_html(charts.legend())
        self._source = gui.add_dropdown(
            "Objects", get_args(ObjectSource), hint="Reconstructed, true in the simulator, or both"
        )
        self._boxes = {
            "goals": gui.add_checkbox("Goal poses", True),
            "motion": gui.add_checkbox("Path and grasp candidates", True),
            "cameras": gui.add_checkbox("Camera poses", True),
            "labels": gui.add_checkbox("Names", True),
            # Without a GPU the browser competes with a live run for the processor.
            "shadows": gui.add_checkbox("Shadows", not self._player.live, hint="Slow without a GPU"),
        }
        self._coloring = gui.add_dropdown("Colour by", get_args(Coloring))
        gui.add_html(
            charts.color_scale("0", f"{1000 * MAX_DEVIATION:.0f} mm standard deviation", UNCERTAINTY_COLORS)
        )
        self._view = gui.add_dropdown("View", VIEWS)

    @property
    def options(self) -> DisplayOptions:
        """The display options that are selected."""
        flags = {name: bool(box.value) for name, box in self._boxes.items()}
        return DisplayOptions(
            **flags,
            coloring=selected(self._coloring, get_args(Coloring)),
            objects=selected(self._source, get_args(ObjectSource)),
        )

    @property
    def view(self) -> str:
        """The motion of the view; one of VIEWS."""
        return selected(self._view, VIEWS)

    def set_title(self, title: str, subtitle: str, outcomes: Mapping[int, ObjectOutcome]) -> None:
        """Set the header, and the outcomes of the objects by id."""
        self._outcomes = outcomes
        _set_html(self._header, charts.header(title, subtitle))

    def draw(self, snapshot: Snapshot) -> None:
        """Update the panel to a snapshot; only changes are sent to the browsers."""
        timeline = self._player.timeline
        stages = charts.stage_bar(timeline.stages, snapshot.time, snapshot.caption, timeline.stage_titles)
        _set_html(self._stages, stages)
        self._draw_playback()
        self._draw_images(snapshot)
        estimates = timeline.recorder.objects
        _set_html(self._objects, charts.object_table(snapshot.objects, estimates, self._outcomes))
        self._draw_plots(snapshot)

    def _draw_playback(self) -> None:
        player = self._player
        label = "Pause" if player.playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if player.playing else viser.Icon.PLAYER_PLAY
        end = max(round(player.timeline.end, 2), TIME_STEP)
        if self._slider.max != end:
            self._slider.max = end
        self._slider.value = min(round(player.time / TIME_STEP) * TIME_STEP, end)
        behind = player.live and not player.following
        if self._follow.visible != behind:
            self._follow.visible = behind

    def _draw_images(self, snapshot: Snapshot) -> None:
        recorder, index = self._player.timeline.recorder, snapshot.latest_image
        if not 0 <= index < len(recorder.frames):
            if self._drawn is not None:
                self._drawn, self._color.image, self._depth.image = None, BLANK_IMAGE, BLANK_IMAGE
                _set_html(self._image_note, "")
            return
        frame = recorder.frames[index]
        searched = index < snapshot.n_searched and index < len(recorder.detections)
        if self._drawn is not None and self._drawn[0] is frame and self._drawn[1] == searched:
            return
        self._drawn = frame, searched
        color = draw_detections(frame, recorder.detections[index], by_class=True) if searched else frame.rgb
        self._color.image, self._depth.image = _resized(np.asarray(color)), depth_image(frame)
        _set_html(self._image_note, charts.note(f"Image {index + 1} of {len(recorder.frames)}"))

    def _draw_plots(self, snapshot: Snapshot) -> None:
        timeline, objects = self._player.timeline, snapshot.objects
        lines: dict[str, charts.Curve] = {}
        for id, state in objects.items():
            iterations, residuals = timeline.residuals(id, snapshot.time)
            lines[state.name] = charts.Curve(iterations, [1000 * r for r in residuals], state.category)
        _set_html(self._curves, charts.curves("Depth residual of the fits", lines, "mm"))
        names = tuple(state.name for state in objects.values()) or ("-",)
        if self._code_of.options != names:
            self._code_of.options = names
        for state in objects.values():
            if state.name == self._code_of.value:
                _set_html(self._bars, charts.bars("Shape code", state.code.tolist(), state.category))


def selected(dropdown: viser.GuiDropdownHandle[Any], options: tuple[Any, ...]) -> Any:
    """Return the selected option; the first one if a client has sent an invalid value."""
    return dropdown.value if dropdown.value in options else options[0]


def depth_image(frame: RgbdFrame) -> UInt8[np.ndarray, "h w 3"]:
    """Return the depth in colours from yellow (near) to purple (far), and missing depth in grey."""
    measured = frame.depth[frame.depth > 0]
    near, far = np.percentile(measured, DEPTH_PERCENTILES) if measured.size else (0.0, 1.0)
    share = 1 - np.clip((frame.depth - near) / max(far - near, 1e-3), 0, 1)
    image = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    image = np.where((frame.depth > 0)[..., None], image, MISSING_DEPTH).astype(np.uint8)
    return _resized(image)


def _resized(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "k l 3"]:
    height = round(IMAGE_WIDTH * image.shape[0] / image.shape[1])
    return cv2.resize(np.ascontiguousarray(image), (IMAGE_WIDTH, height), interpolation=cv2.INTER_AREA)


def _set_html(handle: viser.GuiHtmlHandle, content: str) -> None:
    if handle.content != content:
        handle.content = content
