from collections import Counter
from dataclasses import replace

import numpy as np
import trimesh

from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates, grasps_from_above
from manipulation.standing import to_standing
from manipulation.top_grasps import top_grasps

CONFIG = GraspConfig()


def standing(shapes, category, mesh, **where):
    return to_standing(shapes.estimate(1, category, mesh, **where))


def test_grasp_types_follow_the_category(shapes):
    kinds = {
        category: {grasp.kind for grasp in grasp_candidates(standing(shapes, category, mesh)).grasps}
        for category, mesh in (
            ("mug", shapes.mug()), ("bowl", shapes.bowl()), ("can", shapes.can()), ("bottle", shapes.bottle())
        )
    }  # fmt: skip
    assert kinds == {"mug": {"rim"}, "bowl": {"rim"}, "can": {"top"}, "bottle": {"top"}}


def test_open_tumbler_too_wide_for_the_hand_is_held_by_its_rim(shapes):
    found = grasp_candidates(standing(shapes, "bottle", shapes.cup(radius=0.045, height=0.15)), CONFIG)
    assert found.grasps and {grasp.kind for grasp in found.grasps} == {"rim"}


def test_closed_bodies_too_wide_for_the_hand_have_no_rim_grasps(shapes):
    assert not grasp_candidates(standing(shapes, "bottle", shapes.can(radius=0.045, height=0.15))).grasps


def test_what_tapers_all_the_way_up_is_held_at_any_angle_of_the_hand(shapes):
    """A ball that goes on as a cone: the pads do not reach its middle from above."""
    angle = np.linspace(-np.pi / 2, np.deg2rad(33), 30)
    ball = np.stack([0.035 * np.cos(angle), 0.035 * (1 + np.sin(angle))], axis=1)
    profile = np.concatenate([np.maximum(ball, [0.0, 0.0]), [[0.003, 0.095], [0.0, 0.095]]])
    item = standing(shapes, "bottle", trimesh.creation.revolve(profile, sections=48))
    sections = CrossSectionCache(item.vertices, item.faces)
    assert not top_grasps(item, sections, CONFIG, Counter()), "the shape cannot be held from above"
    found = grasp_candidates(item, CONFIG).grasps
    assert found and {grasp.kind for grasp in found} == {"antipodal"}
    assert all(grasp.opening <= CONFIG.gripper.max_width + 1e-9 for grasp in found)
    vertical = replace(CONFIG, max_tilt=0.0, max_inward_tilt=0.0)  # the hand of an arm with five joints
    assert not grasp_candidates(item, vertical).grasps and not grasps_from_above(item, CONFIG).grasps


def test_grasps_are_sorted_by_descending_score(shapes):
    scores = [grasp.score for grasp in grasp_candidates(standing(shapes, "bottle", shapes.bottle())).grasps]
    assert scores == sorted(scores, reverse=True) and scores[0] > scores[-1]
