from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.standing import to_standing

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


def test_grasps_are_sorted_by_descending_score(shapes):
    scores = [grasp.score for grasp in grasp_candidates(standing(shapes, "bottle", shapes.bottle())).grasps]
    assert scores == sorted(scores, reverse=True) and scores[0] > scores[-1]
