"""Generated chairs, tables and planes whose parts are known: watertight meshes with a label for every vertex.

Every shape is drawn at random, a function of the kind, the seed and its number alone. Chairs have a seat, a back, legs and
sometimes arms; tables a top, legs and sometimes shelves; planes a fuselage, wings (with what hangs on them) and a tail.
y is up and z to the front (a plane's nose); chairs and tables are in metres, a plane is about 1 long.

`furniture` gives the solids themselves: their mesh, samples with normals and parts, and signed distances anywhere.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.experiments.makers.furniture_solids import (
    FLAT,
    Assembly,
    Draw,
    Parts,
    Rod,
    Slab,
    X,
    Y,
    Z,
    board,
    corners,
    curve,
    height_in,
    inside,
    legs_of,
    pedestal,
    plane,
    ring,
    rod,
    sled,
    stretchers,
)

# chairs: parts 0 seat, 1 back, 2 legs, 3 arms


def chair(draw: Draw) -> tuple[Parts, float]:
    """Any chair: dining chairs with posts and rails, windsor, office and arm chairs."""
    w, d, h = draw(0.19, 0.3), draw(0.19, 0.29), draw(0.38, 0.5) if draw.chance(0.9) else draw(0.6, 0.75)
    thick = draw(0.014, 0.035) if draw.chance(0.75) else draw(0.04, 0.07)
    power = draw(2.0, 3.0) if draw.chance(0.3) else draw(4.0, 12.0)
    taper = draw(-0.05, 0.22)
    size = w / (1 + max(taper, 0) / 2), d
    seat = Slab(h * Y, FLAT, size, (thick, thick), power, taper, 0.6 * thick, draw(0.0, 0.25))
    parts: Parts = [(0, seat)]
    lean, tall = draw(0.0, 0.3), draw(0.32, 0.62)
    up = np.array([0.0, np.cos(lean), -np.sin(lean)])
    half = w * draw(0.72, 0.98)
    base = inside(np.array([[half if power > 4 else 0.7 * half, h, -0.9 * d]]), seat, 0.92)[0]
    rear, base = base[0], base * [0, 1, 1]
    backs(draw, parts, base, up, (rear, half), tall)
    radius = draw(0.013, 0.03)
    below = draw.one(four=6.0, pedestal=0.8, swivel=1.2, sled=1.0, boards=0.4)
    if below in ("pedestal", "swivel"):
        parts += pedestal(draw, 2, seat, max(radius, 0.02), below == "swivel")
    elif below == "sled":
        parts += sled(draw, 2, seat, max(0.8 * radius, 0.013))
    elif below == "boards" and power > 4:
        for x in (-0.75 * w, 0.75 * w):
            parts.append((2, board(x * X, x * X + h * Y, Z, (0.75 * d, 0.016))))
    else:
        _four_legs(draw, parts, seat, rear, radius)
    if draw.chance(0.45):
        arms(draw, parts, seat, base, up, rear)
    return parts, draw(0.008, 0.03)


def _four_legs(draw: Draw, parts: Parts, seat: Slab, back: float, radius: float) -> None:
    w, d = seat.half
    tops = corners(0.82 * w, 0.8 * d, height_in(seat, radius))
    tops[:2, 0] *= 1 + 0.6 * seat.taper
    tops[2:, 0] = np.array([-1, 1]) * min(0.82 * w * (1 - 0.6 * seat.taper), back)
    tops[2:, 2] = -0.86 * d
    tops = inside(tops, seat)
    splay, kick = draw(0.9, 1.25), draw(1.0, 1.35)
    feet = tops * [splay, 0, draw(0.95, 1.2)] + 0.8 * radius * Y
    feet[2:, 2] = tops[2:, 2] * kick
    style = draw.one(straight=3, tapered=3, square=2, curved=2)
    parts += legs_of(draw, 2, tops, feet, radius, style)
    if style != "curved":
        stretchers(draw, parts, 2, tops, feet, 0.8 * min(radius, 0.015))


def backs(
    draw: Draw, parts: Parts, base: Float[Floats, " 3"], up: Float[Floats, " 3"], half: tuple[float, float], tall: float
) -> None:
    """The back: a panel, posts with a panel, bars or rails between them, a hoop with spindles, or a splat."""
    kind = draw.one(solid=2.0, panel=3.0, bars=3.0, rails=2.0, hoop=1.6, splat=1.0)
    low, high = half
    hollow = -draw(0.0, 0.5)  # the sides come to the front
    radius = draw(0.012, 0.022)
    axes = plane(X, up)

    def at(x: float, y: float) -> Float[Floats, " 3"]:
        """A point of the back: across in half widths, up in heights."""
        wide = (low + y * (high - low)) * x
        return np.asarray(base + wide * X + y * tall * up + hollow * wide**2 * axes[2])

    def panel(bottom: float, top: float, share: float = 1.0, thick: float = 0.014) -> None:
        middle, wide = 0.5 * (bottom + top), low + 0.5 * (bottom + top) * (high - low)
        size = (share * wide, 0.5 * (top - bottom) * tall)
        round_top = draw(2.5, 4.0) if draw.chance(0.25) and bottom > 0.3 else draw(5.0, 14.0)
        flare = (high - low) / (high + low) if share == 1 else 0.0
        slab = Slab(base + middle * tall * up, axes, size, (thick, thick), round_top, flare, 0.8 * thick, hollow)
        parts.append((1, slab))

    if kind == "solid":
        panel(-0.04, 1.0, thick=draw(0.012, 0.022) if draw.chance(0.6) else draw(0.03, 0.06))
        return
    if kind == "hoop":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
        power = draw(0.5, 1.0)
        line = [at(float(np.sign(np.sin(a)) * abs(np.sin(a)) ** power), float(np.cos(a) ** power)) for a in angle]
        parts.append((1, rod(line, radius)))
        for x in np.linspace(-0.6, 0.6, draw.count(2, 5)) if draw.chance(0.8) else ():
            top = (1 - abs(x) ** (2 / power)) ** (power / 2)
            parts.append((1, rod([at(float(x) * 0.8, 0.0), at(float(x), top)], 0.011)))
        return
    post = draw(0.95, 1.05)
    for side in (-1, 1):
        parts.append((1, rod([at(side, y) for y in np.linspace(-0.02, post, 5)], radius, radius * draw(0.7, 1.0))))
    rail = draw(0.7, 0.88) if kind != "panel" else draw(0.45, 0.78)
    panel(rail, draw(0.97, 1.06), thick=draw(0.011, 0.02))
    if kind == "bars":
        foot = draw(0.15, 0.3) if draw.chance(0.4) else 0.0
        if foot:
            panel(foot - 0.05, foot + 0.05)
        for x in np.linspace(-1, 1, draw.count(2, 5) + 2)[1:-1]:
            parts.append((1, rod([at(float(x), foot), at(float(x), rail + 0.05)], draw(0.011, 0.015))))
    elif kind == "rails":
        ticks = np.linspace(draw(0.1, 0.3), rail, draw.count(1, 3) + 1)[:-1]
        for y in ticks:
            panel(float(y), float(y) + draw(0.1, 0.14))
    elif kind == "splat":
        panel(-0.02, rail + 0.05, draw(0.25, 0.45))


def arms(draw: Draw, parts: Parts, seat: Slab, base: Floats, up: Floats, half: float) -> None:
    """Two arms: rods or boards on a support, or closed sides. The back stands at ``base``, and is there so wide."""
    (w, d), h = seat.half, float(seat.center[1])
    rise, reach = draw(0.15, 0.24), draw(0.2, 0.85)
    kind = draw.one(rods=3, boards=3, closed=1.5)
    thick = draw(0.014, 0.022)
    for side in (-1, 1):
        rear = base + rise / up[1] * up + side * half * X
        foot = inside(np.array([[side * max(0.9 * w, half), h, 0.9 * reach * d]]), seat, 0.92)[0]
        front = np.array([1.04 * foot[0], h + rise, foot[2] + 0.02])
        bend = 0.4 * front + 0.6 * foot + 0.015 * Z
        if kind == "closed" and seat.power > 4:
            middle = np.array([foot[0], h + 0.5 * rise - 0.02, 0.5 * (foot[2] + base[2])])
            span = (0.5 * float(foot[2] - base[2]), 0.5 * rise + 0.02)
            parts.append((3, Slab(middle, plane(Z, Y), span, (1.5 * thick, 1.5 * thick), draw(3, 10), edge=thick)))
        elif kind == "boards":
            parts += [(3, board(rear, front + 0.02 * Z, X, (1.8 * thick, 0.9 * thick))), (3, rod([front, foot], thick))]
        else:
            parts.append((3, rod([*curve(rear, front, 0.02 * Y, 5), bend, foot], thick)))


# tables: parts 0 top, 1 legs, 2 shelves


def table(draw: Draw) -> tuple[Parts, float]:
    """Any table: from low round ones to desks, with legs, a column, boards or runners."""
    outline = draw.one(rectangle=4, round=3, oval=2)
    w = draw(0.3, 0.85)
    d = w if outline == "round" else w * draw(0.45, 1.0)
    h = draw(0.35, 0.8) if draw.chance(0.6) else max(0.2, w * draw(0.3, 0.9))
    thick = min(draw(0.014, 0.035), 0.1 * h)
    power = draw(6, 16) if outline == "rectangle" else draw(2.0, 2.4)
    top = Slab(h * Y, FLAT, (w, d), (thick, thick), power, edge=draw(0.3, 1.0) * thick)
    parts: Parts = [(0, top)]
    if draw.chance(0.25):
        inset, deep = draw(0.7, 0.88), draw(0.3, 0.8) * min(0.06, 0.12 * h)
        parts.append((0, Slab((h - deep) * Y, FLAT, (inset * w, inset * d), (deep, deep), power, edge=0.01)))
    below = draw.one(four=6.0, ring=3.0, pedestal=2.0, boards=1.0, sled=0.7, trestle=0.8)
    radius = min(draw(0.018, 0.05) * min(1.0, 0.5 + w), 0.12 * h)
    if below in ("four", "ring"):
        _table_legs(draw, parts, top, radius, below == "ring")
    elif below == "pedestal":
        parts += pedestal(draw, 1, top, max(radius, 0.025))
        if draw.chance(0.3):
            share, wide = draw(0.35, 0.7), draw(0.5, 0.85)
            parts.append((2, Slab(share * h * Y, FLAT, (wide * w, wide * d), (0.014, 0.014), power)))
    elif below == "sled":
        parts += sled(draw, 1, top, max(0.6 * radius, 0.016))
    else:
        reach, deep = draw(0.55, 0.85) * w, draw(0.55, 0.8) * d
        _sides(draw, parts, top, reach, deep, below == "boards")
    return parts, draw(0.01, 0.05)


def _table_legs(draw: Draw, parts: Parts, top: Slab, radius: float, round_about: bool) -> None:
    (w, d), height = top.half, height_in(top, radius)
    if round_about:
        reach, count = draw(0.45, 0.85), int(draw.one(**{"3": 3, "4": 4, "6": 1, "8": 1}))
        tops = ring(count, (reach * w, reach * d), height, draw.count(0, 1) / 2 / count)
    else:
        tops = corners(draw(0.55, 0.9) * w, draw(0.55, 0.9) * d, height)
    tops = inside(tops, top)
    feet = tops * ([1, 0, 1] * np.array(draw(0.7, 1.35) if draw.chance(0.5) else 1.0)) + 0.9 * radius * Y
    style = draw.one(straight=3, tapered=3, square=2, curved=2)
    parts += legs_of(draw, 1, tops, feet, radius, style)
    if style == "curved":
        return
    if len(tops) == 4 and draw.chance(0.3):
        stretchers(draw, parts, 1, tops, feet, 0.6 * radius)
    if draw.chance(0.4):
        for share in [draw(0.45, 0.8)] if draw.chance(0.7) else [draw(0.3, 0.45), draw(0.65, 0.85)]:
            at = (1 - share) * tops + share * feet
            out = np.abs(at[:, [0, 2]] / top.half) ** top.power
            size = 1.06 * float((out.sum(1) ** (1 / top.power)).max())
            parts.append((2, Slab(at[0, 1] * Y, FLAT, (size * w, size * d), (0.014, 0.014), top.power)))


def _sides(draw: Draw, parts: Parts, top: Slab, reach: float, deep: float, closed: bool) -> None:
    """Boards under both ends, perhaps with shelves between them; or posts on feet."""
    h = float(top.center[1])
    if not closed:
        radius = draw(0.02, 0.035)
        for x in (-reach, reach):
            parts.append((1, rod([(x, 0.03, 0), (x, height_in(top, radius), 0)], radius)))
            parts.append((1, rod([(x, 0.03, -deep), (x, 0.03, deep)], 0.028)))
        if draw.chance(0.5):
            parts.append((1, rod([(-reach, 0.3 * h, 0), (reach, 0.3 * h, 0)], 0.02)))
        return
    if top.power < 4:
        reach, deep = 0.75 * reach, 0.75 * deep
    for x in (-reach, reach):
        parts.append((1, board(x * X, x * X + h * Y, Z, (deep, draw(0.014, 0.024)))))
    for share in np.linspace(0.1, 1, draw.count(1, 3) + 1)[:-1] if draw.chance(0.7) else ():
        middle = (float(share) * h + 0.02) * Y
        parts.append((2, Slab(middle, FLAT, (reach, 0.95 * deep), (0.014, 0.014), 12.0)))


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


DESIGNS = {"chair": chair, "plane": aeroplane, "table": table}
KINDS = {
    "chair": ("seat", "back", "legs", "arms"),
    "table": ("top", "legs", "shelves"),
    "plane": ("fuselage", "wings", "tail"),
}


def furniture(kind: str, seed: int, number: int) -> Assembly:
    """One of the shapes of a kind, always the same for a seed and a number. `OptionError` for an unknown kind."""
    if kind not in KINDS:
        raise OptionError(f"unknown kind {kind!r}", f"choose from {', '.join(KINDS)}")
    solids, fillet = DESIGNS[kind](Draw(np.random.default_rng([seed, number, sorted(KINDS).index(kind)])))
    return Assembly(kind, KINDS[kind], tuple(solids), fillet)
