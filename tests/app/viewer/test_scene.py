"""Lights, ground and layers of the scene."""

import numpy as np

from app.runs.replay import Recorder
from app.viewer.display import DisplayOptions
from app.viewer.scene import SceneView
from app.viewer.surroundings import surroundings_of
from app.viewer.timeline import Timeline


def test_all_layers_are_drawn_and_the_key_light_casts_shadows_on_request(server, node, recording):
    scene, timeline = SceneView(server, recording, surroundings_of(recording)), Timeline(recording)
    approach = next(note.time for note in recording.notes if note.data.get("phase") == "approach")
    scene.draw(timeline.at(approach), DisplayOptions())
    names = ("/cell/hand", "/objects/0", "/goals/can_0", "/cameras/1", "/motion/path", "/motion/selected")
    assert all(node(name) is not None for name in names)
    assert node("/light/key").cast_shadow and node("/ground") is None
    scene.draw(timeline.at(approach), DisplayOptions(shadows=False))
    assert not node("/light/key").cast_shadow


def test_without_a_floor_there_is_a_grid_on_the_support_plane(server, node, make_can):
    recorder = Recorder(objects=(make_can(),))
    SceneView(server, recorder, surroundings_of(recorder))
    np.testing.assert_allclose(node("/ground").position, (0.4, -0.2, 0.0), atol=1e-6)
