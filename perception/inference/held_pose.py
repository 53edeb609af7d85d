"""Pose in the hand of an object that may have shifted between the pads.

The hand tells most of it: two parallel pads leave an object little freedom across them, and some along them.
A Gaussian prior on the motion of the object relative to the hand expresses this; an image of the wrist camera
measures that motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, invert, se3_exp, se3_log
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise
from perception.inference.pose_search import PoseSearch, RefitConfig
from perception.inference.refit import PoseCheck, checked
from perception.rendering.pose import ObjectPose
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane


@dataclass(frozen=True)
class HeldConfig:
    """Settings of the fit of a pose in the hand.

    Attributes:
        turn_sigma: Standard deviations of the turn in the hand about the axes of the TCP, in radians: x lies
            in the pads, which turn a slanted wall about it until it fits; y is their normal; z points out of
            the hand.
        shift_sigma: Standard deviations of the shift along them, in metres: a round body slides along x.
        measurements: Number of independent measurements that all pixels amount to: errors of the estimated
            shape are common to neighbouring pixels.
        reach: Largest depth residual of an inlier, in metres.
        iterations: Number of iterations.
        search: Settings of the pixels and of the decision. A pose that explains nearly half of the visible
            pixels is the object's: it is known to be in the hand, and the rim of a coarse shape is wide in an
            image from so near.
    """

    turn_sigma: tuple[float, float, float] = (0.087, 0.026, 0.070)
    shift_sigma: tuple[float, float, float] = (0.008, 0.0015, 0.003)
    measurements: float = 20.0
    reach: float = 0.03
    iterations: int = 20
    search: RefitConfig = RefitConfig(min_share=0.45, min_own=0.0)


def refit_held(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    T_expected: Float[np.ndarray, "4 4"],
    T_world_tcp: Float[np.ndarray, "4 4"],
    others: Sequence[ObjectEstimate] = (),
    config: HeldConfig = HeldConfig(),
) -> PoseCheck:
    """Find the pose of the object between the pads.

    The cost is that of the measured depth, weighted as ``config.measurements`` measurements, plus
    ``xi^T Sigma^-1 xi`` of the twist xi by which the object has moved in the frame of the TCP.

    Args:
        estimate: Object, of which only the mesh is used; it must be watertight.
        frames: Views of the hand, with camera poses, without depth of the hand itself.
        T_expected: (4, 4) pose T_world_object if nothing has shifted.
        T_world_tcp: (4, 4) pose of the TCP: y is the direction in which the pads close, z points out of the
            hand.
        others: Objects nearby at their poses; depth that they explain better is not attributed to the object.
        config: Settings.
    """
    search = PoseSearch(estimate, frames, T_expected, others, SupportPlane(), config.search)
    expected = ObjectPose.of(T_expected, search.scale)
    if not len(search.measured):
        return checked(search, expected, expected)
    T_tcp_object = invert(T_world_tcp) @ T_expected
    sigma = np.array([*config.turn_sigma, *config.shift_sigma])

    def evaluate(T_held: Float[np.ndarray, "4 4"]) -> Evaluation:
        pose = ObjectPose.of(T_held @ T_tcp_object, search.scale)
        measured = search.linearised(pose, config.reach)
        share = min(1.0, config.measurements / max(np.count_nonzero(measured.weights), 1))
        by_twist = object_by_hand(T_held, T_tcp_object).astype(np.float32)
        return Evaluation(
            np.concatenate([measured.residuals, se3_log(invert(T_world_tcp) @ T_held)]),
            np.concatenate([measured.jacobian @ by_twist, np.eye(6, dtype=np.float32)]),
            np.concatenate([share * measured.weights, sigma**-2]),
        )

    held = minimise(
        evaluate,
        lambda T_held, twist: T_held @ se3_exp(twist),
        np.asarray(T_world_tcp, dtype=np.float64),
        LmConfig(max_iterations=config.iterations, damping=1e-3),
        np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01]),
    )
    return checked(search, ObjectPose.of(held.state @ T_tcp_object, search.scale), expected)


def object_by_hand(
    T_world_hand: Float[np.ndarray, "4 4"], T_hand_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "6 6"]:
    """Return the motion of an object that a small motion Exp(xi) of the hand on its right causes.

    Rows: the object's turn (own frame) and move (world); columns: xi = (rotation, translation), hand frame.
    """
    R = T_world_hand[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = T_hand_object[:3, :3].T
    out[3:, :3] = -R @ hat(T_hand_object[:3, 3])
    out[3:, 3:] = R
    return out
