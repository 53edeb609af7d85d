"""What the sensor models share: how a surface reflects, how it is inclined, and random fields."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import CameraIntrinsics

NEUTRAL = 0.45  # albedo of a surface of which no colour is known
ALBEDO = (0.04, 0.95)  # range of albedos in the near infrared
GAMMA = 1.7  # of the colour image; below 2.2, as many dark materials scatter near infrared well
SATURATED = 248  # value of all three channels from which on the colour camera is saturated
HIGHLIGHT = 0.2  # brightness above the surroundings from which on a spot is a specular highlight
NATIVE_FOCAL_LENGTH = 600.0  # [px], at which the sensors measure; figures in pixels scale with it


@dataclass(frozen=True)
class Surface:
    """How each pixel's surface looks in the near infrared.

    Attributes:
        albedo: share of the light that is scattered back, 0 to 1.
        highlight: specular reflection, 0 (matt) to 1.
    """

    albedo: Float[np.ndarray, "h w"]
    highlight: Float[np.ndarray, "h w"]


def surface_of(
    rgb: UInt8[np.ndarray, "h w 3"] | None, shape: tuple[int, int], rng: np.random.Generator
) -> Surface:
    """Return the near-infrared look of the surfaces in a colour image; grey and matt without one.

    The infrared albedo of a material is related to its colours but not given by them: it is a randomly
    weighted mean of the three channels.
    """
    weights = rng.dirichlet((2.0, 2.0, 2.0)).astype(np.float32)
    if rgb is None:
        return Surface(np.full(shape, NEUTRAL, np.float32), np.zeros(shape, np.float32))
    grey = cv2.transform(rgb, weights[None])
    # The sensor lights the scene itself: how dark the room is says nothing about the surfaces.
    white = max(float(np.percentile(grey[::4, ::4], 95)), 60.0)
    levels = (np.arange(256, dtype=np.float32) / max(white / 0.8, 1)) ** GAMMA
    albedo = cv2.LUT(grey, np.clip(levels, *ALBEDO))
    contrast = grey.astype(np.float32) / 255
    contrast -= box_mean(contrast, max(shape[1] // 16, 3) | 1) + HIGHLIGHT
    highlight = np.where(rgb.min(axis=2) >= SATURATED, np.clip(contrast * 8, 0, 1), 0)
    return Surface(albedo, highlight.astype(np.float32))


def box_mean(image: Float[np.ndarray, "h w"], size: int) -> Float[np.ndarray, "h w"]:
    """Return the mean over a square window of odd ``size`` in pixels."""
    return cv2.blur(image, (size, size), borderType=cv2.BORDER_REPLICATE)


def incidence(depth: Float[np.ndarray, "h w"], intrinsics: CameraIntrinsics) -> Float[np.ndarray, "h w"]:
    """Return the cosine of the angle of incidence: between each pixel's ray and the surface normal.

    With inverse depth q = 1/z over normalised image coordinates (x, y), a plane is q = a x + b y + c and its
    normal (a, b, c). Of the differences to either side the smaller one counts: depth edges are not inclined.
    """
    q = 1 / np.where(depth > 0, depth, 1e3).astype(np.float32)
    a = intrinsics.fx * _smaller_slope(q, 1)
    b = intrinsics.fy * _smaller_slope(q, 0)
    x = (np.arange(depth.shape[1], dtype=np.float32) - np.float32(intrinsics.cx)) / np.float32(intrinsics.fx)
    y = (np.arange(depth.shape[0], dtype=np.float32) - np.float32(intrinsics.cy)) / np.float32(intrinsics.fy)
    x, y = x[None, :], y[:, None]
    c = q - a * x - b * y
    return q / np.sqrt((a * a + b * b + c * c) * (1 + x * x + y * y))


def _smaller_slope(q: Float[np.ndarray, "h w"], axis: int) -> Float[np.ndarray, "h w"]:
    step = np.diff(q, axis=axis)
    if not step.shape[axis]:
        return np.zeros_like(q)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    before, after = np.concatenate([first, step], axis), np.concatenate([step, last], axis)
    return np.where(np.abs(before) < np.abs(after), before, after)


def depth_edges(depth: Float[np.ndarray, "h w"], step: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels at which depth jumps by more than the share ``step``, whatever the slope beside it.

    Second differences of inverse depth vanish on planes.
    """
    q = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
    bend = np.zeros_like(q)
    bend[:, 1:-1] = np.abs(q[:, 2:] + q[:, :-2] - 2 * q[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(q[2:] + q[:-2] - 2 * q[1:-1]))
    return bend > np.float32(step) * np.maximum(q, 0.05)


def correlated(shape: tuple[int, int], pixels: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return approximately standard normal noise, smooth over about ``pixels`` (at least 1)."""
    coarse = tuple(int(np.ceil(n / pixels)) + 3 for n in shape)
    noise = rng.standard_normal(coarse, dtype=np.float32)
    if pixels <= 1:
        return noise[: shape[0], : shape[1]]
    shift = rng.uniform(0, 1, 2) + 0.5
    matrix = np.array([[1 / pixels, 0, shift[0]], [0, 1 / pixels, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    smooth = cv2.warpAffine(noise, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return smooth * np.float32(1.5)  # linear interpolation leaves (2/3)^2 of the variance


def patchy(shape: tuple[int, int], pixels: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return numbers distributed evenly over 0..1 and smooth over about ``pixels``, so that holes cluster."""
    return 1 / (1 + np.exp(-1.7 * correlated(shape, pixels, rng)))


def ramp(values: Float[np.ndarray, "h w"], zero: float, one: float) -> Float[np.ndarray, "h w"]:
    """Return 0 at ``zero``, 1 at ``one``, linear between and constant beyond."""
    return np.clip((values - np.float32(zero)) / np.float32(one - zero), 0, 1)
