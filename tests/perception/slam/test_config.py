"""Settings of the system."""

from perception.slam.config import SlamConfig


def test_objects_only_removes_the_plane_from_tracking_and_bundle_adjustment():
    config = SlamConfig()
    assert config.tracking.use_plane and config.bundle_adjustment.use_plane
    changed = config.objects_only()
    assert not changed.tracking.use_plane and not changed.bundle_adjustment.use_plane
    assert changed.lifecycle == config.lifecycle and changed.use_bundle_adjustment


def test_landmarks_are_fitted_without_mesh_refinement():
    assert SlamConfig().fit.refine is None


def test_a_lost_camera_is_recovered_only_where_it_would_not_be_lost_again():
    check = SlamConfig().pose_check
    assert check.weak_position_std < check.recovered_position_std < check.lost_position_std
    assert check.lost_position_std < check.local_search_position_std
