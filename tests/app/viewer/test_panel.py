"""Controls, images and plots of the panel."""

from dataclasses import replace

import numpy as np
import pytest

from app.viewer.display import DisplayOptions
from app.viewer.panel import BLANK_IMAGE, IMAGE_WIDTH, MISSING_DEPTH, Panel, depth_image, selected
from app.viewer.player import Player
from app.viewer.snapshot import ObjectOutcome, Snapshot
from app.viewer.timeline import Timeline


@pytest.fixture
def panel(server, recording):
    return Panel(server, Player(Timeline(recording), lambda: None))


def test_near_is_yellow_far_is_purple_and_missing_is_grey(make_frame):
    frame = make_frame(0.0)
    depth = np.repeat(np.linspace(0.4, 1.2, 64, dtype=np.float32)[None], 48, axis=0)
    depth[:, 28:36] = 0
    image = depth_image(replace(frame, depth=depth))
    assert image.shape == (IMAGE_WIDTH * 3 // 4, IMAGE_WIDTH, 3)
    assert image[180, 2, 0] > 200 > 60 > image[180, 2, 2]  # yellow
    assert image[180, -3, 2] > image[180, -3, 1]  # purple
    np.testing.assert_array_equal(image[180, 240], [MISSING_DEPTH] * 3)


def test_options_are_those_selected(panel):
    assert panel.options == DisplayOptions() and panel.view == "free"
    panel._boxes["goals"].value = False
    panel._coloring.value, panel._source.value = "uncertainty", "both"
    assert panel.options == DisplayOptions(objects="both", goals=False, coloring="uncertainty")


def test_shadows_are_off_by_default_in_a_live_view(server, recording):
    panel = Panel(server, Player(Timeline(recording), lambda: None, live=True))
    assert not panel.options.shadows and panel.options.goals


def test_an_invalid_selection_counts_as_the_first_option(server):
    dropdown = server.gui.add_dropdown("Name", ("a", "b", "c"), initial_value="b")
    assert selected(dropdown, ("a", "b")) == "b" and selected(dropdown, ("c", "a")) == "c"


def test_the_latest_image_is_shown_and_none_before_the_first(panel):
    panel._draw_images(Snapshot(stage="scan", n_frames=2))
    assert "Image 2 of 2" in panel._image_note.content
    without = panel._color.image
    panel._draw_images(Snapshot(stage="detect", n_frames=2, n_searched=1))
    assert "Image 1 of 2" in panel._image_note.content
    assert not np.array_equal(panel._color.image, without)  # with its detections
    panel._draw_images(Snapshot())
    assert panel._image_note.content == "" and np.array_equal(panel._color.image, BLANK_IMAGE)


def test_the_panel_shows_the_end_of_a_run(panel, recording):
    panel.set_title("Pack", "1 of 1", {0: ObjectOutcome(True, 0.004)})
    panel._player.time = recording.now
    for _ in range(2):  # the list of shape codes is known after the first time
        panel.draw(Timeline(recording).at(recording.now))
    assert "4 mm from plan" in panel._objects.content
    assert "Execute" in panel._stages.content and "can 0" in panel._curves.content
    assert panel._code_of.options == ("can_0",) and panel._bars.content.count("<rect") == 16
    assert panel._slider.value == pytest.approx(recording.now, abs=0.05)
    assert ">4.0<" in panel._curves.content  # residuals in millimetres


def test_playback_controls_show_the_state_of_the_player(panel):
    panel._player.pause()
    panel._draw_playback()
    assert panel._play.label == "Play" and not panel._follow.visible
    panel._player.live = True
    panel._player.play()
    panel._draw_playback()
    assert panel._play.label == "Pause" and panel._follow.visible
