"""Generated four-legged animals, made from the dog of dm_control: registered watertight meshes, determined by a seed.

All have the same vertices and triangles (exactly symmetric in topology), face +z and stand along y. An animal mixes the
proportions of two kinds (`meshmatch.generators.quadruped_traits.KINDS`) and varies them. Its bones are scaled along and
across, and rotated within the limits of their joints: it stands, walks, runs, sits, lies, crouches, jumps or grazes, with
its mouth open or closed. Manes, bushy tails and fleeces are displacements of the skin. The meshes have the dog's licence,
Apache-2.0.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.generator import Generator, RestShape, draw_any
from meshmatch.generators.quadruped_rig import LIMITS, AnimalRig, group_of, load_rig, ramp, skinned, smooth_step
from meshmatch.generators.quadruped_traits import EXTRAS, TRAITS, draw_traits
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

_NODES = NodeConfig("geodesic", 320, 0.13)
# Prefixes of the names of bones.
_TRUNK, _LIMBS = ("torso", "L_", "pelvis"), ("upper_leg", "scapula", "upper_arm")
_SOFT = (*_TRUNK, *_LIMBS, "lower", "foot", "hand", "Ca_1", "Ca_2", "Ca_3", "Ca_4", "Ca_5")
# Standard deviation of random rotations, degrees; 5 for other groups.
_NOISE = {"trunk": 1.2, "tail": 3.0, "neck": 3.0, "jaw": 0.5, "knee": 4.0, "elbow": 4.0, "pelvis": 3.0}
# Probability of each pose.
POSES = {"stand": 0.12, "walk": 0.24, "run": 0.16, "gallop": 0.14, "sit": 0.09, "lie": 0.09, "crouch": 0.08,
         "jump": 0.08}  # fmt: skip
# Swing of the legs (degrees), and phase lag of the right and of the hind legs (radians).
_GAITS = {"stand": (5.0, np.pi, 0.0), "walk": (18.0, np.pi, 0.5 * np.pi), "run": (28.0, np.pi, 0.0),
          "gallop": (38.0, 0.35, np.pi)}  # fmt: skip
# Angles of the hind legs and of the forelegs in poses without a gait, degrees.
_STILL: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "sit": ({"hip": -52, "knee": 82, "hock": -45, "toe": 8}, {"shoulder": 22, "scapula": 12}),
    "lie": ({"hip": -58, "knee": 98, "hock": -92, "toe": 15}, {"scapula": 10, "shoulder": 38, "elbow": -98, "wrist": 5}),
    "crouch": ({"hip": -30, "knee": 55, "hock": -48, "toe": 10}, {"shoulder": 28, "elbow": -58, "wrist": 20}),
    "jump": ({"hip": 25, "knee": -20, "hock": 22, "toe": 20}, {"shoulder": -25, "elbow": -60, "wrist": 70}),
}  # fmt: skip
_FOLDED = {"elbow": -85.0, "wrist": 120.0}  # alternative angles of forelegs folded under a lying body


def morphed(rig: AnimalRig, traits: dict[str, float]) -> Float[Floats, "V 3"]:
    """The rest shape with changed snout, ears, belly and hump, before bones are scaled."""
    verts = rig.verts.copy()
    head = rig.share("skull", "jaw")
    # The snout grows forward from the eyes.
    along = head * ramp(verts[:, 2], 0.345, 0.385)
    front = head * smooth_step(verts[:, 2], 0.35, 0.43)
    end = head * smooth_step(verts[:, 2], 0.40, 0.46)
    verts[:, 2] += (traits["snout"] - 1) * along
    verts[:, 0] *= 1 + (traits["snout_wide"] - 1) * front + traits["muzzle"] * end
    verts[:, 1] += (traits["snout_deep"] - 1 + 0.5 * traits["muzzle"] * end) * front * (verts[:, 1] - 0.645)
    for side in (1.0, -1.0):
        root, tip = np.array([side * 0.05, 0.715, 0.293]), np.array([side * 0.091, 0.806, 0.298])
        axis = (tip - root) / np.linalg.norm(tip - root)
        offset = verts - root
        t = np.where((side * offset[:, 0] > -0.02) & (head > 0.5) & (offset[:, 2] < 0.025), offset @ axis, -1.0)
        across = offset - np.outer(t, axis)
        blend = smooth_step(t, 0.005, 0.045)
        size = max(traits["ear"], 0.12)
        scaled = verts + np.outer((size - 1) * ramp(t, 0.005, 0.045), axis)
        scaled += (blend * (size**0.6 - 1))[:, None] * across
        turn = Rotation.from_euler("z", -side * 70 * traits["ear_out"], degrees=True).as_matrix()
        rotated = (scaled - root) @ turn.T + root
        verts = np.where((t > 0)[:, None], scaled + blend[:, None] * (rotated - scaled), verts)
    trunk = rig.smoothed(rig.share(*_TRUNK) + 0.7 * rig.share(*_LIMBS), 12)
    x, y, z = verts.T
    waist = trunk * np.exp(-(((z + 0.16) / 0.14) ** 2)) * traits["belly"]
    verts[:, 1] -= 0.085 / traits["tall"] * waist * np.clip((0.47 - y) / 0.08, 0, 1)
    verts[:, 0] += 0.035 / traits["wide"] * waist * np.clip(x / 0.05, -1, 1)
    verts[:, 1] += 0.06 * traits["hump"] * trunk * np.exp(-(((z - 0.13) / 0.07) ** 2)) * smooth_step(y, 0.45, 0.56)
    return verts


def scales(rig: AnimalRig, traits: dict[str, float], rng: np.random.Generator) -> Float[Floats, "B 3 3"]:
    """Scale matrix of every bone, along and across it; the girth of necks and tails changes gradually from bone to bone."""
    groups = [group_of(name) for name in rig.names]
    drawn = np.exp(0.07 * rng.normal(size=(len(LIMITS), 2)))
    length, girth = (dict(zip(LIMITS, column, strict=True)) for column in drawn.T)
    for group in ("hip", "knee", "hock", "shoulder", "elbow", "wrist"):
        length[group] *= traits["leg"]
        girth[group] *= traits["thick"]
    for group in ("hock", "wrist"):
        length[group] *= traits["cannon"]
    for group in ("toe", "finger"):
        length[group] *= float(np.sqrt(traits["thick"])) * (1 - 0.25 * np.clip(traits["hoof"], 0, 1))
        girth[group] *= traits["thick"] * (1 - 0.1 * np.clip(traits["hoof"], 0, 1))
    length["scapula"] *= traits["shoulder"]
    length["neck"] *= traits["neck"]
    girth["neck"] *= traits["neck_thick"]
    length["tail"] *= traits["tail"]
    girth["tail"] *= traits["tail_thick"]
    body = np.array([traits["wide"], traits["tall"], traits["long"]])
    across = float(np.sqrt(body[0] * body[1]))
    tails = sum(group == "tail" for group in groups)
    result = np.zeros((len(groups), 3, 3))
    for bone, group in enumerate(groups):
        thick = girth[group]
        if group in ("trunk", "pelvis", "skull", "jaw"):
            result[bone] = np.diag(body) if group in ("trunk", "pelvis") else traits["head"] * np.eye(3)
            continue
        number = int(rig.names[bone].split("_")[1]) if group in ("neck", "tail") else 0
        if group == "neck":  # interpolate from the trunk's girth to the head's
            share = (7 - number) / 6
            thick = np.interp(share, [0, 0.35, 1], [across, 0.5 * (thick + across), traits["head"]])
        elif group == "tail":
            thick = np.interp(number / tails, [0, 0.2, 1], [0.5 * (across + thick), thick, thick])
        elif group in ("hip", "shoulder", "scapula"):
            thick = 0.5 * (thick + across)
        axis = rig.axis(bone, groups)
        result[bone] = thick * np.eye(3) + (length[group] - thick) * np.outer(axis, axis)
    return result


def draw_angles(rig: AnimalRig, traits: dict[str, float], rng: np.random.Generator) -> Float[Floats, "B 3"]:
    """Random pose: rotation of every bone about x, y and z in degrees, within the joints' `LIMITS`."""
    kind = str(rng.choice(list(POSES), p=list(POSES.values())))
    angles = {name: np.zeros(3) for name in rig.names}
    groups = {name: group_of(name) for name in rig.names}

    def add(group: str, bend: float, side: str = "", share: float = 1.0) -> None:
        for name in rig.names:
            if groups[name] == group and name.endswith(side):
                angles[name][0] += share * bend

    swing, right_lag, hind_lag = _GAITS.get(kind, (0.0, np.pi, 0.0))
    swing = swing * rng.uniform(0.7, 1.2)
    phase = rng.uniform(0, 2 * np.pi)
    right_lag, hind_lag = right_lag + rng.normal(0, 0.25), hind_lag + rng.normal(0, 0.3)
    for side, lag in (("_L", 0.0), ("_R", right_lag)):
        for hind in (True, False):
            at = phase + lag + (hind_lag if hind else np.pi)
            back, lift = swing * np.cos(at), 1.6 * swing * max(np.sin(at), 0.0)
            if kind in _STILL:
                chain = _STILL[kind][0 if hind else 1]
            elif hind:
                chain = {"hip": back - 0.3 * lift, "knee": lift, "hock": -0.8 * lift, "toe": 0.4 * lift}
            else:
                chain = {"scapula": 0.3 * back, "shoulder": 0.7 * back, "elbow": -lift, "wrist": 1.2 * lift}
            if kind == "lie" and not hind and rng.uniform() < 0.4:
                chain = chain | _FOLDED
            share = rng.uniform(0.75, 1.1) * np.clip(1.35 / traits["thick"], 0.3, 1)
            for group, bend in chain.items():
                add(group, bend, side, share)
    add("pelvis", {"sit": -25.0, "lie": -10.0, "gallop": -10 * np.cos(phase)}.get(kind, 0.0))
    add("trunk", {"sit": -2.0, "gallop": -2.5 * np.cos(phase)}.get(kind, 0.0))
    straight = np.clip(traits["straight"], -0.5, 1.2)
    stance = {"knee": -22 * straight, "hock": 20 * straight, "hip": -5 * straight}
    for group, bend in (stance | {"toe": 48 * traits["hoof"], "finger": 40 * traits["hoof"]}).items():
        add(group, bend)
    carriage = rng.choice(["normal", "down", "up", "side"], p=[0.5, 0.2, 0.1, 0.2])
    bow = {"down": rng.uniform(45, 100), "up": rng.uniform(-65, -15)}.get(carriage, 0.0)
    bow = traits["neck_down"] + bow + 10 * rng.normal()
    turn = rng.normal() * {"side": 45.0}.get(carriage, 12.0)
    n_bones = {group: sum(each == group for each in groups.values()) for group in ("neck", "tail")}
    curl, sway = rng.uniform([-70, -80], [75, 100]), rng.normal(size=2) * [25, 45]
    for name in rig.names:
        if groups[name] == "neck":
            angles[name][:2] += np.array([bow, turn]) / n_bones["neck"]
        elif groups[name] == "tail":
            near_root = int(name.split("_")[1]) <= 5
            angles[name][:2] += np.array([curl[1 - near_root], sway[1 - near_root]]) / (
                5 if near_root else n_bones["tail"] - 5
            )
    add("skull", -rng.uniform(0.4, 0.9) * (traits["neck_down"] if carriage == "down" else bow))
    p_wide = 0.25 + 0.3 * min(traits["muzzle"], 1.0)  # probability of a wide open mouth, higher for hippos
    jaw_angle = rng.choice(
        [rng.uniform(-34, -28), rng.uniform(-28, -8), rng.uniform(-8, 65)], p=[0.8 - p_wide, 0.2, p_wide]
    )
    if traits["plush"] > 0.5:
        jaw_angle = -30.0
    add("jaw", jaw_angle)
    add("skull", -max(jaw_angle, 0.0) * rng.uniform(0.1, 1.1))
    result = np.zeros((len(rig.names), 3))
    bias = rng.normal(size=3) * [1.0, 2.8, 1.5]  # bend of the whole back
    for bone, name in enumerate(rig.names):
        group = groups[name]
        noise = _NOISE.get(group, 5.0) * rng.normal(size=3) * [1, 0.6, 0.8]
        low, high = np.transpose(LIMITS[group])
        result[bone] = np.clip(angles[name] + noise + bias * (group == "trunk"), low, high)
    result[rig.parents < 0] = 0
    return result


def with_fur(rig: AnimalRig, verts: Float[Floats, "V 3"], traits: dict[str, float]) -> Float[Floats, "V 3"]:
    """Add a mane, a bushy or tufted tail and a fleece, by displacement along smoothed normals."""
    along = np.array([int(name[3:]) if name.startswith("Ca_") else 0 for name in rig.names])
    tail = rig.share("Ca_")
    position = rig.weights @ along / np.maximum(tail, 1e-9) / max(along.max(), 1)
    amount = tail * (0.055 * traits["bush"] * np.sin(np.pi * np.clip(position, 0, 1) ** 0.8))
    amount += tail * 0.025 * traits["tuft"] * np.exp(-(((position - 0.9) / 0.07) ** 2))
    amount += 0.05 * traits["mane"] * (rig.share("C_") + rig.share("torso") * smooth_step(rig.verts[:, 2], 0.08, 0.2))
    amount += 0.035 * traits["fleece"] * (rig.share(*_TRUNK, "C_") + 0.6 * rig.share(*_LIMBS))
    amount = rig.smoothed(amount, 8)
    return verts + amount[:, None] * rig.smoothed(vertex_normals(verts, rig.faces), 4)


def plush(rig: AnimalRig, verts: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
    """The animal as a stuffed toy: swollen, without creases and edges, with rounded ends of the legs as feet."""
    feet = rig.smoothed(rig.share("toe", "finger", "hand", "foot"), 6)
    for _ in range(3):
        thickness = 0.012 + 0.03 * feet
        inflated = verts + thickness[:, None] * rig.smoothed(vertex_normals(verts, rig.faces), 6)
        inflated = rig.smoothed(inflated, 12)
        verts = inflated + feet[:, None] * (rig.smoothed(inflated, 20) - inflated)
    return verts


def make_animal(rig: AnimalRig, seed: int, number: int) -> Float[Floats, "V 3"]:
    """Make one animal, about as large as a dog; it is determined by ``seed`` and ``number``."""
    rng = np.random.default_rng([seed, number])
    traits = draw_traits(rng)
    posed = skinned(rig, morphed(rig, traits), scales(rig, traits, rng), draw_angles(rig, traits, rng))
    posed = with_fur(rig, posed, traits)
    # Smooth away the toes of hooves and the creases of thick limbs.
    smoothing = rig.share("toe", "finger") * np.clip(traits["hoof"] + rng.uniform(0, 0.6), 0, 1)
    thickness = np.clip(1.5 * (traits["thick"] * np.sqrt(traits["wide"]) - 1.2), 0, 1)
    smoothing += thickness * rig.smoothed(rig.share(*_SOFT), 3)
    posed += np.clip(smoothing, 0, 1)[:, None] * (rig.smoothed(posed, 10) - posed)
    posed += np.clip(traits["plush"], 0, 1) * (plush(rig, posed) - posed)
    centers = posed[rng.integers(len(posed), size=12)]
    reach = rng.uniform(0.08, 0.25, 12)
    bump_weights = np.exp(-np.square(np.linalg.norm(posed[:, None] - centers, axis=2) / reach))
    return np.asarray(posed + bump_weights @ rng.normal(0, 0.007, (12, 3)))


def resting_animal(rig: AnimalRig) -> Float[Floats, "V 3"]:
    """The symmetric animal that becomes the template: average proportions, mouth slightly open."""
    traits = {name: float(name not in EXTRAS) for name in TRAITS}
    traits |= {"leg": 0.85, "thick": 1.3, "wide": 1.25, "tall": 1.1, "belly": 0.5, "neck_thick": 1.25, "ear": 0.6,
               "ear_out": 0.3, "tail_thick": 1.6, "neck": 0.85, "straight": 0.3, "shoulder": 1.0}  # fmt: skip
    angles = np.zeros((len(rig.names), 3))
    for bone, name in enumerate(rig.names):
        angles[bone, 0] = {"jaw": -14.0, "neck": 3.0, "skull": -12.0}.get(group_of(name), 0.0)
    return skinned(rig, morphed(rig, traits), scales(rig, traits, np.random.default_rng(0)), angles)


def body_parts(rig: AnimalRig) -> tuple[Int[Ints, " V"], tuple[str, ...]]:
    """Label of every vertex by the bone with the largest weight, and the names of the labels, left and right separate."""
    sides = {"_L": "left ", "_R": "right "}
    names, label = np.unique([sides.get(name[-2:], "") + group_of(name) for name in rig.names], return_inverse=True)
    return label[rig.weights.argmax(1)].astype(np.int64), tuple(names.tolist())


def quadruped_generator(identities: int, seed: int, progress: Progress | None = None) -> Generator:
    """Generator that draws from ``identities`` animals, each in one pose.

    `TemplateError` if the rig is missing or damaged.
    """
    rig = load_rig()
    labels, parts = body_parts(rig)
    source = "the dog of dm_control (Apache-2.0), at rest, proportions changed"
    rest_shape = RestShape(
        Shape(resting_animal(rig), rig.faces, "quadruped"), labels, parts, None, _NODES, source, "Apache-2.0"
    )
    verts = np.zeros((identities, len(rig.verts), 3), np.float32)
    for number in range(identities):
        verts[number] = make_animal(rig, seed, number)
        if progress is not None:
            progress((number + 1) / identities)
    animals = torch.from_numpy(verts)
    description = (
        f"{identities} four-legged animals generated from the dog of dm_control (Apache-2.0), of random kinds and poses"
    )
    return Generator("quadruped", rest_shape.template(), partial(draw_any, animals), description)
