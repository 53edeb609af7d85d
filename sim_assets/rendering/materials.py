"""Procedural surface finishes: textures and gloss, and meshes that wear them."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from sim_assets.rendering.colors import (
    Color,
    Texture,
    mixed,
    random_color,
    to_bytes,
    to_tuple,
)
from sim_assets.rendering.grounds import cardboard, random_ground, wood
from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.rendering.packaging import wrapped
from sim_assets.rendering.surfaces import ATLAS_SIZE, atlas
from sim_assets.rendering.texture_coordinates import ATTRIBUTE, around

__all__ = [
    "ATLAS_SIZE", "TEXTURE_SIZE", "Color", "Finish", "Texture", "add_material", "add_mesh", "around",
    "cardboard", "distractor_finish", "household_finish", "packaging_finish", "random_finish",
    "random_ground", "wood",
]  # fmt: skip

TEXTURE_SIZE = (128, 256)  # rows (bottom to top of the object) x columns (once around it)

# Bounds of hue, saturation and value of crockery: white, cream, blue, black, any glaze.
_CROCKERY = (
    ((0.0, 1.0), (0.0, 0.05), (0.85, 1.0)), ((0.09, 0.14), (0.08, 0.3), (0.7, 0.98)),
    ((0.55, 0.66), (0.35, 0.9), (0.2, 0.8)), ((0.0, 1.0), (0.0, 0.25), (0.03, 0.2)),
    ((0.0, 1.0), (0.2, 0.95), (0.2, 0.95)),
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
        wild: probability of household colours or of an arbitrary colour and pattern, half and half, instead
            of the palette (training of detectors).
    """
    anything = rng.random() < wild
    if anything and rng.random() < 0.5:
        return household_finish(rng, category)
    body, accent = random_color(rng, anything), random_color(rng, anything)
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


def household_finish(rng: np.random.Generator, category: str = "") -> Finish:
    """Sample a finish met in homes: mostly plain crockery, saturated prints on cans and bottles."""
    if category in ("mug", "bowl"):
        bounds = _CROCKERY[rng.choice(len(_CROCKERY), p=(0.45, 0.15, 0.1, 0.1, 0.2))]
        body = colorsys.hsv_to_rgb(*(float(rng.uniform(low, high)) for low, high in bounds))
        texture = solid(body)
        draw = rng.random()
        if draw < 0.12:
            texture = speckle(body, (0.5 * body[0], 0.5 * body[1], 0.5 * body[2]), rng)
        elif draw < 0.3:
            texture[-int(rng.integers(3, 12)) :] = to_bytes(random_color(rng, True))  # a coloured rim
        elif draw < 0.45:
            texture = _with_picture(texture, rng)
        return Finish(texture, specular=float(rng.uniform(0.2, 0.9)), shininess=float(rng.uniform(0.4, 1.0)))
    texture = wrapped(TEXTURE_SIZE, rng)
    if category == "can":
        ends = int(rng.integers(2, 10))
        texture[:ends] = texture[-ends:] = int(rng.integers(120, 210))
    if category == "bottle" and rng.random() < 0.7:  # a label on glass or plastic, and a cap
        bottom, top = (
            int(rng.uniform(0.0, 0.3) * TEXTURE_SIZE[0]),
            int(rng.uniform(0.45, 0.8) * TEXTURE_SIZE[0]),
        )
        body = to_bytes(random_color(rng, True))
        texture[:bottom] = texture[top:] = body
        texture[-int(rng.integers(6, 24)) :] = to_bytes(random_color(rng, True))
    return Finish(texture, specular=float(rng.uniform(0.05, 0.8)), shininess=float(rng.uniform(0.1, 0.9)))


def _with_picture(texture: Texture, rng: np.random.Generator) -> Texture:
    """Print a logo or a picture on one side, beside the handle at azimuth 0."""
    rows, columns = texture.shape[:2]
    height, width = int(rng.uniform(0.3, 0.6) * rows), int(rng.uniform(0.1, 0.25) * columns)
    image = wrapped((height, 2 * width), rng)[:, :width]
    row = int(rng.integers(rows // 10, rows - height - rows // 12))
    column = int(rng.choice((columns // 4, 3 * columns // 4))) - width // 2
    shown = rng.random() < 0.4 or np.abs(image.astype(int) - image[0, 0]).sum(axis=2, keepdims=True) > 40
    patch = texture[row : row + height, column : column + width]
    patch[:] = np.where(shown, image, patch)
    return texture


def packaging_finish(rng: np.random.Generator) -> Finish:
    """Sample the print of one package as an atlas (``texture_coordinates.faces``)."""
    return distractor_finish(rng, ("print", "print", "print"))


def distractor_finish(rng: np.random.Generator, surfaces: Sequence[str] = (), wild: float = 0.1) -> Finish:
    """Sample a finish for a mesh of ``sim_assets.datasets.distractors``; the texture has ATLAS_SIZE.

    Args:
        rng: random generator.
        surfaces: the mesh's ``metadata["surfaces"]``; all cells get any surface if there are none.
        wild: probability of an arbitrary surface for each cell.
    """
    texture = atlas(surfaces or ("any",) * 6, rng, wild)
    glossy = rng.random() < 0.4
    return Finish(
        texture,
        specular=float(rng.uniform(0.3, 0.9) if glossy else rng.uniform(0.0, 0.35)),
        shininess=float(rng.uniform(0.4, 1.0) if glossy else rng.uniform(0.05, 0.5)),
    )


def solid(body: Color, accent: Color | None = None, rng: np.random.Generator | None = None) -> Texture:
    """Paint a single colour."""
    del accent, rng
    return np.broadcast_to(to_bytes(body), (*TEXTURE_SIZE, 3)).copy()


def bands(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint one to three horizontal bands."""
    texture = solid(body)
    rows = TEXTURE_SIZE[0]
    for _ in range(rng.integers(1, 4)):
        start, thickness = rng.integers(0, rows - 6), rng.integers(4, rows // 5)
        texture[start : start + thickness] = to_bytes(accent)
    return texture


def two_tone(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a second glaze up to a random height."""
    texture = solid(body)
    texture[: int(TEXTURE_SIZE[0] * rng.uniform(0.2, 0.7))] = to_bytes(accent)
    return texture


def stripes(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint vertical or slanted stripes."""
    rows, columns = TEXTURE_SIZE
    row, column = np.mgrid[:rows, :columns]
    count, slant = rng.integers(4, 14), rng.integers(-2, 3)
    phase = (count * column / columns + slant * row / rows) % 1
    return mixed(body, accent, phase < rng.uniform(0.15, 0.6))


def speckle(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint fine dots of the second colour, as on stoneware."""
    rows, columns = TEXTURE_SIZE
    field = cv2.GaussianBlur(rng.random((rows, columns), dtype=np.float32), (0, 0), rng.uniform(0.7, 1.6))
    return mixed(body, accent, field > np.quantile(field, rng.uniform(0.85, 0.97)))


def dots(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a regular pattern of dots or checks."""
    rows, columns = TEXTURE_SIZE
    row, column = np.mgrid[:rows, :columns]
    around, up = 2 * int(rng.integers(4, 9)), rng.uniform(3, 7)
    u, v = (column / columns * around) % 1 - 0.5, (row / rows * up) % 1 - 0.5
    return mixed(body, accent, np.hypot(u, v) < rng.uniform(0.2, 0.36))


def label(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a printed label: a band of paper with a headline, blocks, lines of text and a bar code."""
    texture = solid(body)
    rows, columns = TEXTURE_SIZE
    bottom, top = int(rows * rng.uniform(0.08, 0.25)), int(rows * rng.uniform(0.6, 0.92))
    texture[bottom:top] = to_bytes(accent)
    ink = to_bytes((0.95, 0.95, 0.92) if sum(accent) < 1.5 else (0.1, 0.1, 0.14))
    texture[bottom : bottom + 3] = texture[top - 3 : top] = ink
    third = columns // 3
    for start in (0, third, 2 * third):  # the front repeats around the can
        x = start + int(rng.integers(4, 10))
        high = top - int(rng.integers(8, 14))
        cv2.rectangle(
            texture, (x, high - rng.integers(8, 16).item()), (x + third - 24, high), to_tuple(ink), -1
        )
        for line in range(int(rng.integers(2, 5))):
            y = bottom + 8 + 5 * line
            cv2.line(texture, (x, y), (x + int(rng.integers(15, third - 20)), y), to_tuple(ink), 2)
        center = (x + third // 2 - 10, (bottom + top) // 2 + 2)
        cv2.circle(texture, center, int(rng.integers(6, 12)), to_tuple(to_bytes(body)), -1)
    for bar in range(12):
        x = columns - 40 + 2 * bar
        if rng.random() < 0.6:
            texture[bottom + 6 : bottom + 18, x : x + int(rng.integers(1, 3))] = (20, 20, 20)
    return texture


def gradient(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a gradient of two glazes from bottom to top."""
    share = np.linspace(0, 1, TEXTURE_SIZE[0])[:, None, None] ** rng.uniform(0.6, 2.0)
    mixed = (1 - share) * to_bytes(body) + share * to_bytes(accent)
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
        ink = to_tuple(to_bytes(accent if rng.random() < 0.6 else (grey, grey, grey)))
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
    return (
        share * texture + (1 - share) * (to_bytes(body) if rng.random() < 0.5 else to_bytes(accent))
    ).astype(np.uint8)


def packaging(body: Color, accent: Color, rng: np.random.Generator) -> Texture:
    """Paint a package's print once around, in a brand's own colours."""
    del body, accent
    return wrapped(TEXTURE_SIZE, rng)


Pattern = Callable[[Color, Color, np.random.Generator], Texture]
_ALL_PATTERNS: tuple[Pattern, ...] = (
    solid, bands, two_tone, stripes, speckle, dots, label, gradient, metal,
)  # fmt: skip
_WILD_PATTERNS = (*_ALL_PATTERNS, writing, collage, packaging)
_PATTERNS: dict[str, tuple[tuple[Pattern, float], ...]] = {
    "mug": ((solid, 5), (bands, 2), (two_tone, 2), (stripes, 1), (speckle, 2), (dots, 1), (gradient, 1)),
    "bowl": ((solid, 5), (bands, 2), (two_tone, 1), (speckle, 2), (gradient, 2)),
    "bottle": ((solid, 2), (label, 5), (gradient, 1)),
    "can": ((metal, 5), (label, 3), (bands, 1)),
}


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
    """Add a visible mesh to a specification and return its name.

    ``textured``: map the texture with the mesh's own coordinates (``texture_coordinates.ATTRIBUTE``), or wrap
    it around z if it has none.
    """
    texture = {}
    if textured:
        own = mesh.face_attributes.get(ATTRIBUTE)
        coordinates = around(mesh) if own is None else np.asarray(own).reshape(-1, 2)
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
