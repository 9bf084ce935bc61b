"""The kinds of shapes that can be generated besides people: their generators by name."""

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
    """A kind of generated shapes, made of so many people, or animals. People are a kind with choices of their own, see
    `meshmatch.generators.bodies.Bodies`. `OptionError` if there is no such kind.
    """

    name: str
    identities: int = 1024

    def __post_init__(self) -> None:
        if self.name not in tuple(GENERATORS):  # anything else may not be hashable
            raise OptionError(f"unknown kind {self.name!r}", f"choose from human, {', '.join(GENERATORS)}")

    def generator(self, seed: int, progress: Progress | None = None) -> Generator:
        """A function of the seed. `OptionError` if what the shapes are made from is not installed."""
        return GENERATORS[self.name](self.identities, seed, progress)
