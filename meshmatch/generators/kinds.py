"""Registry of the generated kinds other than people: their generators by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from meshmatch.errors import OptionError
from meshmatch.generators.generator import Generator
from meshmatch.generators.hands import hand_generator
from meshmatch.generators.heads import head_generator
from meshmatch.generators.quadrupeds import quadruped_generator
from meshmatch.progress import Progress

GENERATORS: dict[str, Callable[[int, int, Progress | None], Generator]] = {
    "quadruped": quadruped_generator,
    "hand": hand_generator,
    "head": head_generator,
}


@dataclass(frozen=True)
class Kind:
    """A kind of generated shapes, made from ``identities`` random people or animals.

    Human bodies have more options, see `meshmatch.generators.bodies.Bodies`. `OptionError` if the name is unknown.
    """

    name: str
    identities: int = 1024

    def __post_init__(self) -> None:
        if self.name not in tuple(GENERATORS):  # a tuple, as the name may not be hashable
            raise OptionError(f"unknown kind {self.name!r}", f"choose from human, {', '.join(GENERATORS)}")

    def generator(self, seed: int, progress: Progress | None = None) -> Generator:
        """Build the generator, which is determined by the seed; `OptionError` if a required package is not installed."""
        return GENERATORS[self.name](self.identities, seed, progress)
