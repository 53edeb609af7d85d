"""Settings of the SLAM system."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from perception.inference.fit_config import FitConfig
from perception.slam.association import MaskAssociationConfig
from perception.slam.bundle_window import BundleAdjustmentConfig
from perception.slam.detection_schedule import DetectionScheduleConfig
from perception.slam.mask_merging import MaskMergingConfig
from perception.slam.mask_tracking import MaskTrackingConfig
from perception.slam.motion import CameraMotionConfig
from perception.slam.pixels import PixelSelectionConfig
from perception.slam.pose_check import PoseCheckConfig
from perception.slam.relocalise import RelocalisationConfig
from perception.slam.tracking import TrackingConfig


@dataclass(frozen=True)
class LandmarkLifecycleConfig:
    """When landmarks are initialised, refitted and retired, and which frames become keyframes for them.

    Attributes:
        min_pixels: Smallest mask, in pixels, that a landmark is initialised from.
        min_pixels_truncated: The same for a mask that the image border truncates.
        min_support: Number of agreeing landmarks from which truncated masks are not initialised: a shape
            fitted to a part of an object can be far off.
        support_inlier_ratio: Inlier ratio above which a landmark agrees with a frame.
        min_frames_unmatched: Successive frames with detections that an unmatched mask must be visible in
            before it is initialised.
        unseen_ratio: Share of a landmark's pixels outside the view of all keyframes above which the frame
            becomes a keyframe and a truncated landmark is refitted.
        retry_interval: Frames between attempts to initialise the same mask, and least number of frames
            between keyframes that reveal unseen parts.
        retry_interval_weak: The latter while the pose is weak.
        visibility_interval: Least number of frames between checks of which landmarks are visible.
        max_misses: Successive visibility checks that a landmark may fail; no more than its hits.
        see_through_ratio: Share of a landmark's visible pixels that measure the background above which the
            landmark counts as seen through.
        max_see_through: Successive checks in which a landmark may be seen through.
        max_outlier_frames: Successive frames with detections in which most pixels of a landmark may disagree.
        refit_after_outlier_frames: Number of such frames after which it is refitted in the newest view.
        moved_distance: Displacement of a refitted landmark beyond which the object was moved and its older
            views are discarded, in metres.
        max_keyframes: Number of keyframes kept; the oldest are dropped.
        class_log_odds: Log probability by which another class must lead before a landmark is refitted.
    """

    min_pixels: int = 120
    min_pixels_truncated: int = 400
    min_support: int = 3
    support_inlier_ratio: float = 0.6
    min_frames_unmatched: int = 2
    unseen_ratio: float = 0.3
    retry_interval: int = 8
    retry_interval_weak: int = 2
    visibility_interval: int = 4
    max_misses: int = 5
    see_through_ratio: float = 0.6
    max_see_through: int = 2
    max_outlier_frames: int = 12
    refit_after_outlier_frames: int = 3
    moved_distance: float = 0.03
    max_keyframes: int = 80
    class_log_odds: float = 4.0


@dataclass(frozen=True)
class SlamConfig:
    """Settings of the SLAM system, by module.

    Attributes:
        use_bundle_adjustment: Whether keyframes are optimised jointly.
        concurrent: Whether joint optimisation runs in a thread beside tracking; the result is the same.
        joint_delay: Frames after its keyframe at which a joint optimisation is applied; that of the first
            frame, or of one with a weak pose, is applied at once.
    """

    use_bundle_adjustment: bool = True
    concurrent: bool = True
    joint_delay: int = 3
    fit: FitConfig = field(default_factory=lambda: FitConfig(refine=None))  # landmarks have no meshes
    motion: CameraMotionConfig = field(default_factory=CameraMotionConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    pose_check: PoseCheckConfig = field(default_factory=PoseCheckConfig)
    pixels: PixelSelectionConfig = field(default_factory=PixelSelectionConfig)
    merging: MaskMergingConfig = field(default_factory=MaskMergingConfig)
    detection: DetectionScheduleConfig = field(default_factory=DetectionScheduleConfig)
    mask_tracking: MaskTrackingConfig = field(default_factory=MaskTrackingConfig)
    association: MaskAssociationConfig = field(default_factory=MaskAssociationConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    bundle_adjustment: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)
    lifecycle: LandmarkLifecycleConfig = field(default_factory=LandmarkLifecycleConfig)

    def objects_only(self) -> SlamConfig:
        """Return the settings without the support plane as a landmark, as in the paper."""
        return replace(
            self,
            tracking=replace(self.tracking, use_plane=False),
            bundle_adjustment=replace(self.bundle_adjustment, use_plane=False),
        )
