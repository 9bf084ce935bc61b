"""Names of the user's choices, apart from what carries them out: a command line can list them without loading it."""

from typing import Literal, get_args

Refine = Literal["none", "latent", "nodes"]
"""How a fit is refined, see `meshmatch.fitting.refinement.REFINEMENTS`."""
Partial = Literal["auto", "yes", "no"]
"""Whether a shape may be a part of a whole, such as a scan from one side."""
Way = Literal["field", "codes"]
"""What is blended between fits, see `meshmatch.fitting.blend.Blend`."""
ON_NODES: tuple[Refine, ...] = ("nodes",)
"""Refinements that move node vectors themselves: the model's field must have nodes; landmarks hold and fits agree."""
REFINE_NAMES: tuple[Refine, ...] = get_args(Refine)
PARTIALS: tuple[Partial, ...] = get_args(Partial)
WAYS: tuple[Way, ...] = get_args(Way)
