"""How generated planes are made, drawn at random."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.experiments.makers.furniture_pieces import FLAT, Draw, Parts, X, Y, Z, board, rod
from meshmatch.experiments.makers.furniture_solids import Rod, Slab, plane

# planes: parts 0 fuselage, 1 wings, 2 tail


def aeroplane(draw: Draw) -> tuple[Parts, float]:
    """Any plane: liners, fighters, gliders and propeller planes, with a nose at +z."""
    thick, nose = draw(0.04, 0.09), draw(0.08, 0.3)
    ends = np.array([0.5, -0.5])
    z = np.linspace(0.5, -0.5, 15)
    profile = (
        np.minimum(np.sqrt(np.clip((0.5 - z) / nose, 0.02, 1)), 1.0)
        if draw.chance(0.6)
        else np.clip((0.5 - z) / nose + 0.15, 0, 1)
    )
    fade, end = draw(0.25, 0.5), draw(0.15, 0.4)
    profile = profile * np.where(z > ends[1] + fade, 1, end + (1 - end) * np.clip((z + 0.5) / fade, 0, 1))
    rise = draw(0.0, 0.5) * thick * np.clip(-(z + 0.5 - fade) / fade, 0, 1)
    body = Rod(np.stack([0 * z, rise, z], 1), np.maximum(thick * profile, 0.012))
    parts: Parts = [(0, body)]
    if draw.chance(0.25):  # a cockpit
        at = draw(0.1, 0.3)
        parts.append((0, rod([(0, 0.75 * thick, at), (0, 0.75 * thick, at - draw(0.08, 0.2))], 0.6 * thick)))
    kind = draw.one(straight=3.0, swept=4.0, delta=1.0)
    root = {"straight": draw(0.08, 0.14), "swept": draw(0.09, 0.17), "delta": draw(0.2, 0.3)}[kind]
    span = {"straight": draw(0.4, 0.68), "swept": draw(0.36, 0.6), "delta": draw(0.28, 0.42)}[kind]
    narrow = {"straight": draw(0.0, 0.5), "swept": draw(0.35, 0.75), "delta": draw(0.75, 0.9)}[kind]
    sweep = {"straight": draw(-0.12, 0.08), "swept": draw(-0.75, -0.3), "delta": draw(-0.7, -0.4)}[kind]
    level = draw(-0.7, 0.8) * thick
    place = draw(-0.02, 0.14) if kind != "delta" else draw(-0.12, 0.0)
    half = draw(0.013, 0.022)
    lift = draw(-0.05, 0.25)
    wing = Slab(
        np.array([0, level, place]),
        FLAT,
        (span, root),
        (half, 0.8 * half),
        draw(5, 14),
        0,
        0.8 * half,
        lift,
        sweep,
        narrow,
    )
    parts.append((1, wing))
    if kind == "straight" and draw.chance(0.12):  # a biplane
        over = 0.14 + thick
        upper = Slab(wing.center + over * Y, FLAT, wing.half, wing.thick, wing.power, 0, wing.edge, lift, sweep, narrow)
        parts.append((1, upper))
        for x in (-0.6 * span, -0.12, 0.12, 0.6 * span):
            foot = np.array([x, level + lift * x * x, place + sweep * abs(x)])
            parts.append((1, rod([foot, foot + over * Y], 0.011)))
    tail(draw, parts, thick, float(rise[-1]), kind == "delta")
    engines(draw, parts, wing, thick)
    return parts, draw(0.008, 0.03)


def tail(draw: Draw, parts: Parts, thick: float, rise: float, tailless: bool) -> None:
    """Fin and tailplane: low, on the fin like a T, with two fins, or like a V."""
    kind = draw.one(low=6.0, high=2.5, twin=1.0, vee=0.7)
    if tailless and draw.chance(0.5):
        kind = "fin"
    chord, tall = draw(0.05, 0.1), draw(0.11, 0.22)
    span, back = draw(0.14, 0.26), -0.5 + chord + draw(0.0, 0.05)
    lean, slim = draw(-0.9, -0.1), draw(0.2, 0.6)
    half = draw(0.012, 0.016)

    def stabiliser(height: float, z: float) -> None:
        at, shape = np.array([0, height, z]), (span, 0.8 * chord)
        sweep = draw(-0.6, -0.05)
        parts.append((2, Slab(at, plane(X, Z), shape, (half, 0.85 * half), 8.0, 0, half, 0, sweep, slim)))

    if kind == "vee":
        for side in (-1, 1):
            _fin(
                parts,
                np.array([0, rise, back]),
                np.array([side * draw(0.7, 1.0), 0.8, 0]),
                tall * 1.1,
                (chord, half),
                lean,
                slim,
            )
        return
    if kind == "twin":
        stabiliser(rise, back)
        for side in (-1, 1):
            _fin(
                parts, np.array([side * 0.85 * span, rise, back - 0.3 * span]), Y, 0.7 * tall, (chord, half), lean, slim
            )
        return
    _fin(parts, np.array([0, rise, back]), Y, tall, (chord, half), lean, slim)
    if kind == "low":
        stabiliser(rise + draw(-0.1, 0.4) * thick, back - draw(0.0, 0.02))
    elif kind == "high":
        stabiliser(rise + draw(0.85, 0.97) * tall, back + lean * 0.9 * tall)


def _fin(
    parts: Parts, foot: Floats, up: Floats, tall: float, size: tuple[float, float], lean: float, slim: float
) -> None:
    """A fin from its foot upwards, leaning back and slimmer at the top."""
    chord, half = size
    along = tall * (up / np.linalg.norm(up) + lean * Z)
    length = float(np.linalg.norm(along))
    axes = plane(np.cross(along, np.cross(Z, up)), along)
    half_size = chord * (1 - 0.5 * slim), 0.5 * length
    parts.append((2, Slab(foot + 0.5 * along, axes, half_size, (half, half), 7.0, -0.6 * slim, half)))


def engines(draw: Draw, parts: Parts, wing: Slab, thick: float) -> None:
    """Jets under the wings or beside the tail, engines in the wings, a propeller, or none."""
    kind = draw.one(none=4, under=4, rear=2, within=1, propeller=1.5)
    size, length = draw(0.018, 0.03), draw(0.06, 0.12)
    for side in (-1, 1) if kind in ("under", "within", "rear") else ():
        spots = [draw.count(30, 45) / 100] if draw.chance(0.6) else [0.3, 0.55]
        if kind == "rear":
            at = np.array([side * (0.9 * thick + size), 0.4 * thick, -0.28])
            parts.append((0, rod([at + 0.5 * length * Z, at - 0.5 * length * Z], size)))
            parts.append((0, rod(np.stack([at, 0.3 * thick * Y - 0.28 * Z]), 0.012)))
            continue
        for share in spots:
            x = side * share * wing.half[0]
            at = wing.center + np.array(
                [x, wing.bend * x * x, wing.sweep * abs(x) + 0.6 * wing.half[1] * (1 - wing.narrow * share)]
            )
            at = at - (1.3 * size if kind == "under" else 0.2 * size) * Y
            parts.append((1, rod([at + 0.5 * length * Z, at - 0.5 * length * Z], size, 0.85 * size)))
    if kind == "propeller":
        blade, tip = draw(0.08, 0.13), np.array([0, 0, 0.5 + draw(0.0, 0.02)])
        parts.append((0, board(tip - blade * X, tip + blade * X, Y, (0.018, 0.011))))
