"""What lies and stands on desks: laptops, screens, keyboards, phones, cameras, books, lamps, pens, paper."""

from __future__ import annotations

import numpy as np

from sim_assets.datasets.distractors.basic import book
from sim_assets.datasets.distractors.shapes import (
    Mesh,
    ball,
    between,
    box,
    cylinder,
    hull,
    lathe,
    moved,
    rounded_box,
    sheet,
    thing,
    tube,
    turned,
)


def laptop(rng: np.random.Generator) -> Mesh:
    """An open laptop."""
    x, y = rng.uniform((0.20, 0.28), (0.26, 0.37))
    thick, open_by = rng.uniform(0.010, 0.020), rng.uniform(1.5, 2.2)
    body = rounded_box((x, y, thick), 0.008, (0, 0, thick / 2))
    keys = box((0.45 * x, 0.85 * y, 0.002), (-0.12 * x, 0, thick))
    lid = moved(rounded_box((x, y, 0.006), 0.008), x / 2)
    screen = moved(box((0.9 * x, 0.93 * y, 0.001)), x / 2, 0, -0.0035)
    for part in (lid, screen):  # opened about the rear edge
        moved(turned(part, -open_by, (0, 1, 0)), -x / 2, 0, thick)
    shell = ("metal", "black", "plastic")[rng.integers(3)]
    return thing((shell, [body, lid]), ("keys", [keys]), ("screen", [screen]))


def monitor(rng: np.random.Generator) -> Mesh:
    """A flat screen on a foot, or a tablet on a stand."""
    width = rng.uniform(0.22, 0.42)
    height, lift = width * rng.uniform(0.56, 0.7), rng.uniform(0.02, 0.12)
    lift = min(lift, 0.43 - height)
    case = box((0.025, width, height), (0, 0, lift + height / 2))
    screen = box((0.001, 0.95 * width, 0.92 * height), (0.0131, 0, lift + height / 2))
    neck = box((0.02, 0.05, lift + 0.3 * height), (-0.022, 0, (lift + 0.3 * height) / 2))
    foot = box((rng.uniform(0.12, 0.18), 0.5 * width, 0.012), (-0.01, 0, 0.006))
    return thing(("black", [case, neck, foot]), ("screen", [screen]))


def picture_frame(rng: np.random.Generator) -> Mesh:
    """A picture in a frame that leans on its stand."""
    width, height = rng.uniform((0.09, 0.12), (0.28, 0.34))
    edge, tilt = rng.uniform(0.008, 0.03), rng.uniform(0.1, 0.35)
    bars = [box((0.015, width, edge), (0, 0, at)) for at in (edge / 2, height - edge / 2)]
    bars += [box((0.015, edge, height), (0, s * (width - edge) / 2, height / 2)) for s in (-1, 1)]
    picture = box((0.006, width - edge, height - edge), (0, 0, height / 2))
    stand = between((0, 0, 0.7 * height), (-0.55 * height * np.tan(tilt) - 0.06, 0, 0.01), 0.004, 6)
    for part in (*bars, picture):
        turned(part, -tilt, (0, 1, 0))
    return thing((("wood", "black", "metal")[rng.integers(3)], [*bars, stand]), ("picture", [picture]))


def keyboard(rng: np.random.Generator) -> Mesh:
    """A keyboard."""
    x, y, z = rng.uniform((0.11, 0.26, 0.012), (0.16, 0.44, 0.025))
    keys = box((0.85 * x, 0.96 * y, 0.006), (0, 0, z + 0.002))
    return thing((("black", "white")[rng.integers(2)], [box((x, y, z), (0, 0, z / 2))]), ("keys", [keys]))


def mouse(rng: np.random.Generator) -> Mesh:
    """A computer mouse, with its cable or without."""
    x, y, z = rng.uniform((0.045, 0.026, 0.03), (0.06, 0.034, 0.042))
    half = ball((x, y, z))
    shell = hull(np.column_stack([half.vertices[:, :2], np.maximum(half.vertices[:, 2], 0)]))
    if rng.random() < 0.5:
        return thing((("black", "white", "plastic")[rng.integers(3)], [shell]))
    t = np.linspace(0, 1, 24)
    wave = rng.uniform(0.01, 0.05) * np.sin(t * rng.uniform(3, 9))
    cord = tube(np.column_stack([x + rng.uniform(0.1, 0.25) * t, wave, np.full(24, 0.003)]), 0.002, 6)
    return thing(("black", [shell, cord]))


def phone(rng: np.random.Generator) -> Mesh:
    """A phone or a remote control, lying."""
    x, y, z = rng.uniform((0.045, 0.12, 0.007), (0.08, 0.19, 0.022))
    body = rounded_box((x, y, z), 0.2 * x, (0, 0, z / 2))
    front = box((0.9 * x, 0.86 * y, 0.001), (0, 0, z))
    return thing(("black", [body]), (("screen", "keys")[rng.integers(2)], [front]))


def camera(rng: np.random.Generator) -> Mesh:
    """A camera with a lens and a grip."""
    x, y, z = rng.uniform((0.03, 0.09, 0.06), (0.06, 0.14, 0.10))
    length, radius = rng.uniform(0.015, 0.09), rng.uniform(0.35, 0.48) * z
    lens = cylinder(radius, length, (x / 2 + length / 2, 0, z / 2), "x", 24)
    glass = cylinder(0.8 * radius, 0.002, (x / 2 + length, 0, z / 2), "x", 24)
    grip = rounded_box((x + 0.02, 0.25 * y, 0.9 * z), 0.01, (0.008, 0.38 * y, 0.45 * z))
    hump = box((0.8 * x, 0.35 * y, 0.02), (0, 0, z + 0.009))
    body = rounded_box((x, y, z), 0.008, (0, 0, z / 2))
    return thing(
        ("black", [lens, grip]), (("black", "metal")[rng.integers(2)], [body, hump]), ("screen", [glass])
    )


def headphones(rng: np.random.Generator) -> Mesh:
    """Headphones that lie on their side."""
    radius = rng.uniform(0.07, 0.09)
    angle = np.linspace(-0.2, np.pi + 0.2, 24)
    path = np.stack([radius * np.cos(angle), 1.15 * radius * np.sin(angle), 0 * angle + 0.035], axis=1)
    pads = []
    for s in (-1, 1):
        pad = lathe([(0.015, 0), (0.038, 0), (0.042, 0.015), (0.03, 0.03), (0, 0.03)], 20)
        turned(pad, s * np.pi / 2, (0, 1, 0))
        pads.append(moved(pad, s * (radius - 0.015), -0.02, 0.042))
    return thing(("black", [tube(path, 0.007, 8)]), (("black", "plastic")[rng.integers(2)], pads))


def standing_books(rng: np.random.Generator) -> Mesh:
    """One to six books in a row, upright or leaning, or one open a little."""
    covers, pages, at, lean = [], [], 0.0, rng.random() < 0.4
    for _ in range(rng.integers(1, 7)):
        height, depth, thick = rng.uniform((0.15, 0.11, 0.01), (0.30, 0.21, 0.05))
        tilt = rng.uniform(0.05, 0.3) if lean else 0.0
        for index, part in enumerate(book(depth, height, thick)):
            turned(part, np.pi / 2, (0, 1, 0))  # spine up
            turned(part, np.pi / 2, (1, 0, 0))  # then forwards, the height along z
            moved(part, 0, 0, height / 2)
            turned(part, tilt, (0, 1, 0))
            moved(part, at)
            (pages if index == 3 else covers).append(part)
        at += thick / np.cos(tilt) + (0.0 if lean else rng.exponential(0.002))
        if at > 0.2:
            break
    return thing(("cover", covers[::3] + covers[1::3]), ("cover", covers[2::3]), ("pages", pages))


def lamp(rng: np.random.Generator) -> Mesh:
    """A desk lamp: a foot, a jointed or straight arm, a shade."""
    height, reach = rng.uniform(0.2, 0.38), rng.uniform(0.0, 0.16)
    radius = rng.uniform(0.04, 0.08)
    foot = lathe([(0, 0), (radius, 0), (radius, 0.012), (0.01, 0.02), (0, 0.02)], 28)
    elbow = np.array([-0.4 * reach, 0, 0.6 * height])
    arm = [between((0, 0, 0.01), elbow, 0.005, 8), between(elbow, (reach, 0, height), 0.005, 8)]
    wide, thin, long = rng.uniform(0.04, 0.10), rng.uniform(0.015, 0.04), rng.uniform(0.05, 0.12)
    shade = lathe(
        [(wide - 0.002, 0), (wide, 0), (thin, long), (0, long), (0, long - 0.003), (wide - 0.002, 0)], 28
    )
    turned(shade, rng.uniform(0, 0.7) if reach > 0.05 else 0.0, (0, 1, 0))
    moved(shade, reach, 0, min(height, 0.42 - long) - 0.3 * long)
    return thing((("black", "metal", "white")[rng.integers(3)], [foot, *arm]), ("plastic", [shade]))


def pens(rng: np.random.Generator) -> Mesh:
    """One to five markers or pens, lying."""
    bodies, caps = [], []
    for _ in range(rng.integers(1, 6)):
        radius, length = rng.uniform(0.0035, 0.011), rng.uniform(0.11, 0.16)
        parts = [
            cylinder(radius, length, (0, 0, radius), "x", 12),
            cylinder(1.1 * radius, 0.3 * length, (0.4 * length, 0, 1.1 * radius), "x", 12),
        ]
        turn, shift = rng.normal(0, 0.5), rng.normal(0, 0.015, 2)
        for part in parts:
            moved(turned(part, turn), *shift)
        bodies.append(parts[0])
        caps.append(parts[1])
    return thing(("any", bodies), ("plastic", caps))


def papers(rng: np.random.Generator) -> Mesh:
    """Sheets of paper, flat or curled, or an open magazine."""
    x, y = rng.uniform((0.14, 0.18), (0.22, 0.31))
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.5, 0.5, 16), indexing="ij")
    curl = rng.uniform(0.0, 0.06) * np.abs(u * np.cos(rng.uniform(0, 3)) + v) ** 2
    fold = rng.uniform(0.0, 0.02) * np.abs(np.sin(2 * np.pi * v)) if rng.random() < 0.4 else 0.0
    flat = sheet(np.stack([x * u, y * v, curl + fold + 0.006], axis=-1), 0.005)
    return thing((("paper", "picture")[rng.integers(2)], [flat]))


def box_of_electronics(rng: np.random.Generator) -> Mesh:
    """A router, a plug, a hard disk or a loudspeaker: a dark box with a front, perhaps with aerials."""
    x, y, z = rng.uniform((0.05, 0.08, 0.02), (0.16, 0.22, 0.28))
    body = rounded_box((x, y, z), 0.006, (0, 0, z / 2))
    front = box((0.001, 0.8 * y, 0.8 * z), (x / 2, 0, z / 2))
    aerials = [
        between((-x / 2, s * 0.4 * y, 0.5 * z), (-x / 2, s * 0.5 * y, z + 0.1), 0.005, 8)
        for s in (-1, 1)
        if z < 0.1 and rng.random() < 0.4
    ]
    return thing((("black", "white", "wood")[rng.integers(3)], [body, *aerials]), ("keys", [front]))


KINDS = (
    laptop, laptop, monitor, monitor, picture_frame, picture_frame, keyboard, mouse, phone, camera,
    headphones, standing_books, standing_books, standing_books, lamp, pens, papers, box_of_electronics,
    box_of_electronics,
)  # fmt: skip
