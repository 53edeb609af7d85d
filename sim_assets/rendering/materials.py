"""Procedural surface finishes: textures, gloss, and texture coordinates of meshes."""

from __future__ import annotations

import colorsys
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from sim_assets.rendering.headless import MjSpec, mujoco

Color = tuple[float, float, float]
Texture = UInt8[np.ndarray, "h w 3"]

TEXTURE_SIZE = (128, 256)  # rows (bottom to top of the object) x columns (once around it)

# Palette of glazes, paints and prints: (hue, saturation, value).
_PALETTE = (
    (0.00, 0.82, 0.75), (0.60, 0.80, 0.70), (0.13, 0.85, 0.90), (0.38, 0.70, 0.58), (0.08, 0.85, 0.90),
    (0.79, 0.60, 0.55), (0.51, 0.75, 0.68), (0.10, 0.05, 0.93), (0.95, 0.45, 0.85), (0.58, 0.35, 0.80),
    (0.30, 0.45, 0.70), (0.07, 0.55, 0.45), (0.62, 0.55, 0.30), (0.11, 0.22, 0.85),
)  # fmt: skip


@dataclass(frozen=True)
class Finish:
    """A surface finish.

    Attributes:
        texture: (H, W, 3) image, wrapped once around the object, first row at the bottom.
        specular, shininess, reflectance: MuJoCo's material parameters, in 0..1.
    """

    texture: Texture
    specular: float = 0.4
    shininess: float = 0.5
    reflectance: float = 0.0


def random_finish(rng: np.random.Generator, category: str = "", wild: float = 0.0) -> Finish:
    """Sample a finish: glazed crockery for mugs and bowls, printed labels for cans and bottles.

    Args:
        wild: probability of an arbitrary colour and pattern instead of the palette (training of detectors).
    """
    anything = rng.random() < wild
    body, accent = _color(rng, anything), _color(rng, anything)
    if anything:
        pattern = _WILD_PATTERNS[rng.integers(len(_WILD_PATTERNS))]
    elif category not in _PATTERNS:
        pattern = _ALL_PATTERNS[rng.integers(len(_ALL_PATTERNS))]
    else:
        patterns, weights = zip(*_PATTERNS[category], strict=True)
        pattern = patterns[rng.choice(len(patterns), p=np.array(weights) / sum(weights))]
    return Finish(
        texture=pattern(body, accent, rng),
        specular=float(rng.uniform(*((0.0, 1.0) if anything else (0.15, 0.8)))),
        shininess=float(rng.uniform(*((0.05, 1.0) if anything else (0.3, 0.9)))),
    )


def _color(rng: np.random.Generator, anything: bool) -> Color:
    if anything:
        return colorsys.hsv_to_rgb(rng.random(), rng.random() ** 0.7, rng.uniform(0.05, 1.0))
    hue, saturation, value = _PALETTE[rng.integers(len(_PALETTE))]
    jitter = rng.normal(0, (0.012, 0.05, 0.04))
    return colorsys.hsv_to_rgb(
        (hue + jitter[0]) % 1,
        float(np.clip(saturation + jitter[1], 0, 1)),
        float(np.clip(value + jitter[2], 0, 1)),
    )


def solid(body: Color, accent: Color | None = None, rng: np.random.Generator | None = None) -> Texture:
    """Paint a single colour."""
    del accent, rng
    return np.broadcast_to(_byte(body), (*TEXTURE_SIZE, 3)).copy()


def bands(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint one to three horizontal bands."""
    texture = solid(body)
    rows = TEXTURE_SIZE[0]
    for _ in range(rng.integers(1, 4)):
        start, thickness = rng.integers(0, rows - 6), rng.integers(4, rows // 5)
        texture[start : start + thickness] = _byte(accent)
    return texture


def two_tone(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a second glaze up to a random height."""
    texture = solid(body)
    texture[: int(TEXTURE_SIZE[0] * rng.uniform(0.2, 0.7))] = _byte(accent)
    return texture


def stripes(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint vertical or slanted stripes."""
    rows, columns = TEXTURE_SIZE
    row, column = np.mgrid[:rows, :columns]
    count, slant = rng.integers(4, 14), rng.integers(-2, 3)
    phase = (count * column / columns + slant * row / rows) % 1
    return _mix(body, accent, phase < rng.uniform(0.15, 0.6))


def speckle(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint fine dots of the second colour, as on stoneware."""
    rows, columns = TEXTURE_SIZE
    field = cv2.GaussianBlur(rng.random((rows, columns), dtype=np.float32), (0, 0), rng.uniform(0.7, 1.6))
    return _mix(body, accent, field > np.quantile(field, rng.uniform(0.85, 0.97)))


def dots(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a regular pattern of dots or checks."""
    rows, columns = TEXTURE_SIZE
    row, column = np.mgrid[:rows, :columns]
    around, up = 2 * int(rng.integers(4, 9)), rng.uniform(3, 7)
    u, v = (column / columns * around) % 1 - 0.5, (row / rows * up) % 1 - 0.5
    return _mix(body, accent, np.hypot(u, v) < rng.uniform(0.2, 0.36))


def label(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a printed label: a band of paper with a headline, blocks, lines of text and a bar code."""
    texture = solid(body)
    rows, columns = TEXTURE_SIZE
    bottom, top = int(rows * rng.uniform(0.08, 0.25)), int(rows * rng.uniform(0.6, 0.92))
    texture[bottom:top] = _byte(accent)
    ink = _byte((0.95, 0.95, 0.92) if sum(accent) < 1.5 else (0.1, 0.1, 0.14))
    texture[bottom : bottom + 3] = texture[top - 3 : top] = ink
    third = columns // 3
    for start in (0, third, 2 * third):  # the front repeats around the can
        x = start + int(rng.integers(4, 10))
        high = top - int(rng.integers(8, 14))
        cv2.rectangle(
            texture, (x, high - rng.integers(8, 16).item()), (x + third - 24, high), _tuple(ink), -1
        )
        for line in range(int(rng.integers(2, 5))):
            y = bottom + 8 + 5 * line
            cv2.line(texture, (x, y), (x + int(rng.integers(15, third - 20)), y), _tuple(ink), 2)
        center = (x + third // 2 - 10, (bottom + top) // 2 + 2)
        cv2.circle(texture, center, int(rng.integers(6, 12)), _tuple(_byte(body)), -1)
    for bar in range(12):
        x = columns - 40 + 2 * bar
        if rng.random() < 0.6:
            texture[bottom + 6 : bottom + 18, x : x + int(rng.integers(1, 3))] = (20, 20, 20)
    return texture


def gradient(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a gradient of two glazes from bottom to top."""
    share = np.linspace(0, 1, TEXTURE_SIZE[0])[:, None, None] ** rng.uniform(0.6, 2.0)
    mixed = (1 - share) * _byte(body) + share * _byte(accent)
    return np.broadcast_to(mixed.astype(np.uint8), (*TEXTURE_SIZE, 3)).copy()


def metal(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint bare metal above and below a printed band."""
    texture = label(body, accent, rng)
    texture[: TEXTURE_SIZE[0] // 14] = texture[-TEXTURE_SIZE[0] // 10 :] = (185, 188, 194)
    return texture


def writing(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint lines of print in random sizes."""
    texture = np.ascontiguousarray(solid(body))
    letters = np.array(list("ABCDEFGHKLMNOPRSTUVXYZ&0123456789 abcdeghiklmnorstu"))
    for _ in range(rng.integers(2, 7)):
        text = "".join(rng.choice(letters, rng.integers(3, 14)))
        at = int(rng.integers(-20, texture.shape[1] - 60)), int(rng.integers(12, texture.shape[0]))
        grey = rng.random()
        ink = _tuple(_byte(accent if rng.random() < 0.6 else (grey, grey, grey)))
        cv2.putText(
            texture, text, at, int(rng.integers(0, 8)), rng.uniform(0.4, 1.8), ink, int(rng.integers(1, 4))
        )
    return texture[::-1].copy()  # the first row is the bottom


def collage(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint patches of many colours and shades, as on a photograph or gift wrap."""
    rows, columns = TEXTURE_SIZE
    texture = cv2.resize(
        rng.integers(0, 256, (rng.integers(2, 9), rng.integers(2, 17), 3), dtype=np.uint8),
        (columns, rows), interpolation=(cv2.INTER_NEAREST, cv2.INTER_CUBIC)[rng.integers(2)],
    )  # fmt: skip
    share = rng.uniform(0.2, 0.9)
    return (share * texture + (1 - share) * (_byte(body) if rng.random() < 0.5 else _byte(accent))).astype(
        np.uint8
    )


Pattern = Callable[[Color, Color, np.random.Generator], Texture]
_ALL_PATTERNS: tuple[Pattern, ...] = (
    solid, bands, two_tone, stripes, speckle, dots, label, gradient, metal,
)  # fmt: skip
_WILD_PATTERNS = (*_ALL_PATTERNS, writing, collage)
_PATTERNS: dict[str, tuple[tuple[Pattern, float], ...]] = {
    "mug": ((solid, 5), (bands, 2), (two_tone, 2), (stripes, 1), (speckle, 2), (dots, 1), (gradient, 1)),
    "bowl": ((solid, 5), (bands, 2), (two_tone, 1), (speckle, 2), (gradient, 2)),
    "bottle": ((solid, 2), (label, 5), (gradient, 1)),
    "can": ((metal, 5), (label, 3), (bands, 1)),
}


def wood(rng: np.random.Generator, color: Color, size: tuple[int, int] = (512, 512)) -> Texture:
    """Return a texture of planks with grain along the rows' direction."""
    rows, columns = size
    planks = 6
    image = np.empty((rows, columns, 3), dtype=np.float32)
    base = np.array(color, dtype=np.float32)
    bounds = np.linspace(0, rows, planks + 1).astype(int)
    for start, stop in itertools.pairwise(bounds):
        noise = rng.standard_normal((stop - start, columns), dtype=np.float32)
        grain = cv2.GaussianBlur(
            noise, (0, 0), sigmaX=columns / 10, sigmaY=1.1, borderType=cv2.BORDER_REFLECT
        )
        waves = cv2.GaussianBlur(
            noise[::-1], (0, 0), sigmaX=columns / 5, sigmaY=7, borderType=cv2.BORDER_REFLECT
        )
        tone = 1 + 0.035 * grain / grain.std() + 0.03 * waves / waves.std() + rng.normal(0, 0.035)
        image[start:stop] = base * tone[..., None]
        image[start : start + 1] *= 0.72  # the joint between two planks
    return (255 * np.clip(image, 0, 1)).astype(np.uint8)


def cardboard(rng: np.random.Generator, color: Color, size: tuple[int, int] = (128, 128)) -> Texture:
    """Return a texture of fine fibres with low contrast."""
    noise = cv2.GaussianBlur(rng.standard_normal(size, dtype=np.float32), (0, 0), sigmaX=4, sigmaY=0.8)
    tone = 1 + 0.018 * noise / noise.std()
    return (255 * np.clip(np.array(color) * tone[..., None], 0, 1)).astype(np.uint8)


def random_ground(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return a texture of planks, card, stone, tiles or paint in common or arbitrary colours."""
    if rng.random() < 0.6:  # most tables are brown, grey or white
        warm, cold = rng.uniform(0.2, 1.0), rng.uniform(0.6, 1.0)
        grey = 0.9 * warm
        color, other = (warm, warm * rng.uniform(0.65, 1.0), warm * cold * 0.8), (grey, grey, grey)
    else:
        color, other = _color(rng, True), _color(rng, True)
    rows, columns = size
    kind = rng.integers(5)
    if kind == 0:
        return wood(rng, color, size)
    if kind == 1:
        return cardboard(rng, color, size)
    if kind == 2:  # stone: smooth noise between two colours
        field = cv2.GaussianBlur(rng.standard_normal(size, dtype=np.float32), (0, 0), rng.uniform(1, 12))
        share = np.clip(0.5 + 0.25 * field / field.std(), 0, 1)[..., None]
        return (share * _byte(color) + (1 - share) * _byte(other)).astype(np.uint8)
    if kind == 3:  # tiles or checks
        row, column = np.mgrid[:rows, :columns]
        side = int(rng.integers(12, 64))
        return _mix(color, other, (row // side + column // side) % 2 == 0)
    return np.broadcast_to(_byte(color), (rows, columns, 3)).copy()


def around(mesh: trimesh.Trimesh) -> Float[np.ndarray, "c 2"]:
    """Return a mesh's texture coordinates by face corner: once around z horizontally, upwards vertically.

    Returns:
        (3 F, 2), face by face; a face across the seam exceeds 1 instead of spanning the texture backwards.
    """
    corners = mesh.vertices[mesh.faces]
    u = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi) + 0.5
    u = np.where((u.max(axis=1, keepdims=True) - u) > 0.5, u + 1, u)
    low, high = mesh.bounds[:, 2]
    v = (corners[..., 2] - low) / max(high - low, 1e-9)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def add_material(spec: MjSpec, name: str, finish: Finish, repeat: tuple[float, float] = (1.0, 1.0)) -> str:
    """Add a finish to a specification as a texture and a material of the same name, and return the name."""
    rows, columns, _ = finish.texture.shape
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=columns, height=rows, nchannel=3
    )
    texture.data = np.ascontiguousarray(finish.texture).tobytes()
    material = spec.add_material(
        name=name, specular=finish.specular, shininess=finish.shininess, reflectance=finish.reflectance,
        texrepeat=repeat, rgba=(1, 1, 1, 1),
    )  # fmt: skip
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    return name


def add_mesh(spec: MjSpec, name: str, mesh: trimesh.Trimesh, textured: bool = True) -> str:
    """Add a visible mesh to a specification and return its name; ``textured`` wraps the texture around z."""
    texture = {}
    if textured:
        coordinates = around(mesh)
        texture = {
            "usertexcoord": coordinates.astype(np.float32).ravel(),
            "userfacetexcoord": np.arange(len(coordinates), dtype=np.int32),
        }
    spec.add_mesh(
        name=name, uservert=mesh.vertices.astype(np.float32).ravel(),
        userface=mesh.faces.astype(np.int32).ravel(), smoothnormal=False,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, **texture,
    )  # fmt: skip
    return name


def _byte(color: Color) -> UInt8[np.ndarray, "3"]:
    return np.round(255 * np.clip(np.array(color), 0, 1)).astype(np.uint8)


def _tuple(color: UInt8[np.ndarray, "3"]) -> tuple[int, int, int]:
    return int(color[0]), int(color[1]), int(color[2])


def _mix(body: Color, accent: Color, where: np.ndarray) -> Texture:
    return np.where(where[..., None], _byte(accent), _byte(body)).astype(np.uint8)
