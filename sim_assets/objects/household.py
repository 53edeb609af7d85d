"""Objects of the families in the sizes met in homes, whether or not an 80 mm gripper can grasp them.

A sample of the family is stretched across and along its axis; walls, floors and seams keep the thickness of
their material. The ranges are of packages and crockery on sale (diameter x height in mm): tuna 85 x 33, soup
66 x 101, coffee 102 x 139, crisps 75 x 250, spice 45 x 90, drink can 66 x 122; bowls 90 to 280 wide; mugs
from espresso cups (54 x 55) to 110 x 125; bottles and jars 35 to 115 wide and 85 to 340 high.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from perception.types import Category
from sim_assets.objects.bottle import BottleParameters
from sim_assets.objects.bowl import BowlParameters, bowl_section, bowl_vessel
from sim_assets.objects.can import SLIGHT_BENDS, CanParameters
from sim_assets.objects.families import Parameters, Split, sample_parameters
from sim_assets.objects.mug import MugParameters, mug_vessel
from sim_assets.objects.solids import closed_tube
from sim_assets.rendering.texture_coordinates import ATTRIBUTE, along_faces, in_cell

CAN_RADIUS, CAN_HEIGHT = (0.020, 0.055), (0.025, 0.260)
BOTTLE_RADIUS, BOTTLE_HEIGHT = (0.0175, 0.0575), (0.085, 0.340)
BOWL_RADIUS, BOWL_HEIGHT = (0.045, 0.140), (0.024, 0.120)
MUG_RADIUS, MUG_HEIGHT = (0.027, 0.055), (0.055, 0.125)
# Height over diameter of flat, usual and tall cans and of tubes, with equal shares.
CAN_PROPORTIONS = ((0.30, 0.70), (0.70, 1.70), (1.70, 2.40), (2.40, 3.60))
CURVED = 0.75  # share of the straight training cans that are ribbed or slightly curved
JARS = 0.2  # share of the bottles with a neck that is turned into a wide mouth
FILL = (0.30, 0.85)  # level of the contents over the depth of the cavity
CLEARANCE = 0.0005  # between contents and wall [m]
AROUND = 40  # vertices on a ring of the contents


def sample_household(category: Category, split: Split, rng: np.random.Generator) -> Parameters:
    """Sample the parameters of an object of the split's families in a size met in homes."""
    p = sample_parameters(category, split, rng)
    match p:
        case CanParameters():
            return _can(p, split, rng)
        case BottleParameters():
            return _bottle(p, rng)
        case BowlParameters():
            return _bowl(p, rng)
        case MugParameters():
            return _mug(p, rng)


def _within(value: float, limits: tuple[float, float]) -> float:
    return float(np.clip(value, *limits))


def _can(p: CanParameters, split: Split, rng: np.random.Generator) -> CanParameters:
    shape = CAN_PROPORTIONS[rng.integers(len(CAN_PROPORTIONS))]
    radius = float(rng.uniform(*CAN_RADIUS))
    if shape[0] > 2.0:
        radius = min(radius, 0.042)  # tubes are slim
    height = _within(2.0 * radius * rng.uniform(*shape), CAN_HEIGHT)
    lid = _within(rng.uniform(0.005, 0.020), (0.0, 0.3 * height)) if p.kind == "canister" else p.rim
    can = replace(p, radius=radius, height=height, rim=lid)
    if p.kind == "drink" and (height < 0.06 or height > 3.0 * 2.0 * radius):  # no drink is sold like that
        can = replace(can, kind="food", neck=0.0, neck_height=0.001, dome=0.0, foot=0.0)
    if split == "train" and can.kind in ("food", "plain") and rng.random() < CURVED:
        kind = tuple(SLIGHT_BENDS)[rng.integers(len(SLIGHT_BENDS))]
        seam, bend = float(rng.uniform(0.0006, 0.0018)), float(rng.uniform(*SLIGHT_BENDS[kind]))
        can = replace(can, kind=kind, seam=seam, recess=float(rng.uniform(0.0, 0.004)), bend=bend)
    return can


def _bottle(p: BottleParameters, rng: np.random.Generator) -> BottleParameters:
    closed_cup = p.top in ("lid", "dome")
    jar = not closed_cup and p.top == "screw" and rng.random() < JARS
    slim = (1.15, 2.2) if jar else (1.3, 3.2) if closed_cup else (1.8, 5.0)
    radius = float(rng.uniform(*BOTTLE_RADIUS))
    height = _within(2.0 * radius * rng.uniform(*slim), BOTTLE_HEIGHT)
    across, along = radius / p.radius, height / p.height
    bottle = replace(
        p,
        radius=radius,
        height=height,
        body_top=along * p.body_top,
        neck_bottom=along * p.neck_bottom,
        cap_bottom=along * p.cap_bottom,
        neck_radius=across * p.neck_radius,
        cap_radius=across * p.cap_radius,
        base_fillet=min(p.base_fillet, 0.2 * radius, 0.1 * height),
    )
    return _wide_mouthed(bottle, rng) if jar else bottle


def _wide_mouthed(p: BottleParameters, rng: np.random.Generator) -> BottleParameters:
    """Return a jar: a short shoulder and a lid nearly as wide as the body."""
    cap_bottom = p.height - min(rng.uniform(0.010, 0.022), 0.2 * p.height)
    neck_bottom = cap_bottom - 0.001
    mouth = p.radius * p.aspect * rng.uniform(0.75, 0.93)
    return replace(
        p,
        cap_bottom=cap_bottom,
        neck_bottom=neck_bottom,
        body_top=neck_bottom - rng.uniform(0.004, 0.12 * p.height),
        bend=min(p.bend, 0.06),
        neck_radius=float(mouth),
        cap_radius=float(mouth + rng.uniform(0.0008, 0.0025)),
    )


def _bowl(p: BowlParameters, rng: np.random.Generator) -> BowlParameters:
    radius = float(rng.uniform(*BOWL_RADIUS))
    height = _within(2.0 * radius * rng.uniform(0.25, 0.60), BOWL_HEIGHT)
    wall = replace(
        p.wall,
        base=min(p.wall.base, 0.12 * height),
        rim=min(p.wall.rim, 0.12 * height),
        floor=min(p.wall.floor, 0.18 * height),
        foot_height=min(p.wall.foot_height, 0.12 * height),
        base_fillet=min(p.wall.base_fillet, 0.1 * height),
        inner_fillet=min(p.wall.inner_fillet, 0.3 * height),
    )
    scale = radius / p.radius
    return replace(p, radius=radius, height=height, base_radius=scale * p.base_radius, wall=wall)


def _mug(p: MugParameters, rng: np.random.Generator) -> MugParameters:
    radius = float(rng.uniform(*MUG_RADIUS))
    height = _within(2.0 * radius * rng.uniform(0.62, 1.6), MUG_HEIGHT)
    across, along = radius / p.radius, height / p.height
    less = min(across, along)
    wall = replace(
        p.wall,
        base_fillet=less * p.wall.base_fillet,
        inner_fillet=less * p.wall.inner_fillet,
        floor=min(p.wall.floor, 0.08 * height),
    )
    ring = p.handle.curve == "ring"  # a circle's arc only if its depth follows its span
    depth = along * p.handle.depth if ring else _within(along * p.handle.depth, (0.016, 0.042))
    thick = _within(0.5 * (across + along), (0.7, 1.15))
    handle = replace(
        p.handle,
        depth=depth,
        top=along * p.handle.top,
        bottom=along * p.handle.bottom,
        thickness=thick * p.handle.thickness,
        width=thick * p.handle.width,
    )
    return replace(p, radius=radius, height=height, wall=wall, handle=handle)


def contents_of(vessel_of: Parameters, rng: np.random.Generator) -> trimesh.Trimesh | None:
    """Return what a bowl or a mug holds: a liquid with a flat surface, or food in a low heap.

    Returns:
        A watertight mesh in the object's frame (z up, base of the vessel on z = 0), between the floor and
        the rim, with texture coordinates and ``metadata["surfaces"]`` as distractors have; None for bottles
        and cans, and for a cavity less than 1 cm deep.
    """
    if not isinstance(vessel_of, (MugParameters, BowlParameters)):
        return None
    bowl = isinstance(vessel_of, BowlParameters)
    vessel = bowl_vessel(vessel_of) if bowl else mug_vessel(vessel_of)
    depth = vessel.height - vessel.floor
    if depth < 0.01:
        return None
    level = vessel.floor + depth * rng.uniform(*FILL)
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    section = bowl_section(vessel_of) if bowl else None
    relative = 1.0 + (section.modulation(np.cos(angle), np.sin(angle)) if section else np.zeros(AROUND))
    z = np.linspace(vessel.floor + CLEARANCE, level, 7)
    r = np.maximum(vessel.inner_radius(z) - 2.0 * CLEARANCE, 0.002)
    rings = _rings(r[:, None] * relative, z[:, None], angle)
    solid_food = bowl and rng.random() < 0.6
    rise = min(0.5 * r[-1], 0.9 * (vessel.height - level)) * rng.uniform(0.2, 1.0) if solid_food else 0.0
    inwards = np.array([0.9, 0.7, 0.5, 0.3, 0.12])
    heap = level + rise * (1.0 - inwards[:, None] ** 2)
    if solid_food:  # lumps; never above the rim nor far below the edge of the heap
        lumps = rng.normal(0.0, rng.uniform(0.05, 0.25) * rise + 1e-4, (len(inwards), AROUND))
        heap = np.clip(heap + lumps, level - 0.2 * (level - vessel.floor), vessel.height)
    top = _rings((r[-1] * inwards)[:, None] * relative, heap, angle)
    middle = (0.0, 0.0, float(top[-1, :, 2].mean()))
    mesh = closed_tube(np.concatenate([rings, top]), (0.0, 0.0, float(z[0])), middle)
    mesh.face_attributes[ATTRIBUTE] = in_cell(along_faces(mesh)[0], np.zeros(len(mesh.faces), dtype=int))
    mesh.metadata["surfaces"] = ("food",) if solid_food else ("liquid",)
    return mesh


def _rings(r: np.ndarray, z: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return (k, n, 3) points at the radii (k, n) and heights (k, 1) or (k, n)."""
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z, r.shape)], axis=-1)
