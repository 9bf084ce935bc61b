"""Proportions of four-legged animals relative to the dog's: a table of kinds, which are mixed and varied at random."""

from __future__ import annotations

import numpy as np

# Traits relative to the dog, whose values are 1, or 0 for `EXTRAS`.
TRAITS = {
    # name: standard deviation of the logarithm; for `EXTRAS`, of the value itself
    "leg": 0.13, "thick": 0.15, "cannon": 0.12, "wide": 0.1, "tall": 0.08, "long": 0.09, "belly": 0.2, "hump": 0.25,
    "neck": 0.15, "neck_thick": 0.1, "neck_down": 12.0, "head": 0.1, "snout": 0.18, "snout_wide": 0.12,
    "snout_deep": 0.1, "muzzle": 0.1, "ear": 0.22, "ear_out": 0.25, "tail": 0.25, "tail_thick": 0.2, "bush": 0.3,
    "tuft": 0.2, "mane": 0.18, "fleece": 0.08, "hoof": 0.12, "straight": 0.25,
    "plush": 0.1,
}  # fmt: skip
# Traits that are 0 for the dog.
EXTRAS = {"belly", "hump", "neck_down", "muzzle", "ear_out", "bush", "tuft", "mane", "fleece", "hoof", "straight",
        "plush"}  # fmt: skip
KINDS: dict[str, dict[str, float]] = {
    "dog": {"ear": 0.7, "tail": 0.8, "tail_thick": 1.3, "belly": 0.1},
    "wolf": {"wide": 1.1, "neck": 0.9, "neck_thick": 1.3, "neck_down": 20, "ear": 0.65, "tail": 0.75, "bush": 1.0,
             "mane": 0.3, "snout_wide": 1.1, "tail_thick": 1.5, "belly": 0.2},
    "cat": {"leg": 0.9, "thick": 1.3, "wide": 1.1, "long": 1.1, "belly": 0.35, "neck": 0.7, "neck_thick": 1.3,
            "neck_down": 30, "head": 1.05, "snout": 0.45, "snout_wide": 1.25, "snout_deep": 1.1, "ear": 0.4,
            "ear_out": 0.3, "tail": 1.15, "tail_thick": 1.5, "tuft": 0.3},
    "lion": {"leg": 0.9, "thick": 1.55, "wide": 1.2, "tall": 1.05, "long": 1.08, "belly": 0.4, "neck": 0.65,
             "neck_thick": 1.6, "neck_down": 30, "head": 1.25, "snout": 0.6, "snout_wide": 1.4, "snout_deep": 1.2,
             "ear": 0.35, "ear_out": 0.3, "tail": 1.05, "tail_thick": 1.5, "tuft": 0.7, "mane": 0.7},
    "cow": {"leg": 0.95, "thick": 1.25, "cannon": 1.5, "wide": 1.5, "tall": 1.25, "long": 1.25, "belly": 0.65,
            "hump": 0.2, "neck": 0.75, "neck_thick": 1.35, "neck_down": 40, "head": 1.15, "snout": 1.25,
            "snout_wide": 1.2, "snout_deep": 1.15, "muzzle": 0.2, "ear": 0.6, "ear_out": 1.0, "tail": 0.95,
            "tail_thick": 1.2, "tuft": 0.5, "hoof": 1.0, "straight": 0.6},
    "horse": {"leg": 1.1, "thick": 1.15, "cannon": 1.6, "wide": 1.35, "tall": 1.2, "long": 1.05, "belly": 0.5,
              "hump": 0.1, "neck": 1.15, "neck_thick": 1.5, "neck_down": 10, "head": 1.15, "snout": 1.6,
              "snout_wide": 1.05, "snout_deep": 1.2, "ear": 0.45, "tail": 0.7, "tail_thick": 1.8, "bush": 0.7,
              "mane": 0.3, "hoof": 1.0, "straight": 0.7},
    "deer": {"leg": 1.1, "thick": 0.95, "cannon": 1.6, "wide": 1.15, "long": 1.0, "belly": 0.5, "neck": 1.15,
             "neck_down": 5, "head": 1.0, "snout": 1.15, "snout_wide": 0.95, "ear": 0.75, "ear_out": 0.5,
             "tail": 0.25, "tail_thick": 1.5, "hoof": 0.9, "straight": 0.5},
    "hippo": {"leg": 0.8, "thick": 1.8, "cannon": 0.9, "wide": 2.0, "tall": 1.6, "long": 1.3, "belly": 0.9,
              "neck": 0.5, "neck_thick": 2.0, "neck_down": 45, "head": 1.4, "snout": 1.7, "snout_wide": 1.8,
              "snout_deep": 1.4, "muzzle": 0.6, "ear": 0.22, "ear_out": 0.3, "tail": 0.3, "tail_thick": 1.4,
              "hoof": 0.6, "straight": 0.8},
    "bear": {"leg": 0.88, "thick": 2.0, "cannon": 0.7, "wide": 1.6, "tall": 1.3, "long": 1.05, "belly": 0.65,
             "hump": 0.4, "neck": 0.65, "neck_thick": 1.8, "neck_down": 40, "head": 1.2, "snout": 0.8,
             "snout_wide": 1.1, "ear": 0.3, "ear_out": 0.4, "tail": 0.15, "tail_thick": 1.8, "mane": 0.3,
             "fleece": 0.2, "straight": 0.7},
    "sheep": {"leg": 0.75, "thick": 1.15, "cannon": 1.2, "wide": 1.45, "tall": 1.2, "long": 1.1, "belly": 0.65,
              "neck": 0.65, "neck_thick": 1.4, "neck_down": 25, "head": 1.05, "snout": 0.95, "ear": 0.5,
              "ear_out": 1.0, "tail": 0.35, "tail_thick": 2.0, "mane": 0.3, "fleece": 0.7, "hoof": 0.9,
              "straight": 0.6},
    "rat": {"leg": 0.65, "thick": 0.75, "cannon": 0.8, "wide": 1.25, "tall": 1.15, "long": 1.15, "belly": 0.5, "neck": 0.5,
            "neck_thick": 1.7, "neck_down": 25, "head": 1.15, "snout": 0.8, "snout_wide": 0.8, "ear": 0.55, "ear_out": 0.4,
            "tail": 1.7, "tail_thick": 0.9, "hump": 0.2, "straight": -0.5},
    "toy": {"leg": 0.6, "thick": 4.0, "cannon": 0.5, "wide": 1.7, "tall": 1.5, "long": 0.65, "belly": 0.4,
            "neck": 0.6, "neck_thick": 2.2, "neck_down": 0, "head": 2.1, "snout": 0.6, "snout_wide": 1.5,
            "snout_deep": 1.3, "muzzle": 0.3, "ear": 0.5, "ear_out": 0.6, "tail": 0.35, "tail_thick": 2.0,
            "hoof": 0.4, "straight": 1.0, "plush": 1.0},
    "cub": {"leg": 0.7, "thick": 2.8, "cannon": 0.7, "wide": 1.4, "tall": 1.3, "long": 0.75, "belly": 0.3, "neck": 0.7,
            "neck_thick": 1.8, "neck_down": 10, "head": 1.8, "snout": 0.5, "snout_wide": 1.3, "snout_deep": 1.2,
            "ear": 0.8, "ear_out": 0.5, "tail": 0.6, "tail_thick": 2.5, "straight": 0.6, "plush": 0.6},
    "pig": {"leg": 0.7, "thick": 1.35, "wide": 1.55, "tall": 1.25, "long": 1.15, "belly": 0.8, "neck": 0.45,
            "neck_thick": 1.8, "neck_down": 40, "head": 1.25, "snout": 1.2, "snout_wide": 1.1, "snout_deep": 1.2,
            "ear": 0.6, "ear_out": 0.5, "tail": 0.3, "hoof": 0.8, "straight": 0.6},
}  # fmt: skip


def draw_traits(rng: np.random.Generator) -> dict[str, float]:
    """Random traits: an interpolation between two kinds, with noise."""
    first, second = rng.choice(list(KINDS), 2)
    share = rng.beta(0.45, 0.45)
    traits = {}
    for name, spread in TRAITS.items():
        dog_value = 1.0 if name not in EXTRAS else 0.0
        a, b = (KINDS[kind].get(name, dog_value) for kind in (first, second))
        if name in EXTRAS:
            traits[name] = share * a + (1 - share) * b + spread * rng.normal()
        else:
            traits[name] = float(np.exp(share * np.log(a) + (1 - share) * np.log(b) + spread * rng.normal()))
    for name in ("bush", "tuft", "mane", "fleece", "muzzle", "hump"):
        traits[name] = max(traits[name], 0.0)
    if rng.uniform() < 0.35:  # sometimes a tail of any length
        traits["tail"] = rng.uniform(0.5, 1.3) * (1 - 0.7 * np.clip(traits["plush"], 0, 1))
    if rng.uniform() < 0.2:
        traits["bush"] = rng.uniform(0.4, 1.5)
    return traits | {"shoulder": traits["tall"]}
