"""What tables of training runs in one world, and in others beside it, have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from coil_rl.reproduce.result import Result


class OfWorlds(Result):
    """A table of methods in one world, and in others.

    Args:
        experiments: in one world.
        worlds: from the name of another world to the experiment in it.
        against: label that the others are compared with.
        resamples: of the bootstrap.
        seed: of the bootstrap.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        worlds: Mapping[str, str] | None = None,
        against: str = "ppo",
        resamples: int = 2000,
        seed: int = 0,
    ) -> None:
        if resamples < 1:
            raise ValueError(f"resamples={resamples} must be at least 1")
        self.worlds = {"": list(experiments)} | {name: [of_world] for name, of_world in (worlds or {}).items()}
        self.experiments = [experiment for of_world in self.worlds.values() for experiment in of_world]
        self.against, self.resamples, self.seed = against, resamples, seed


def heading(world: str) -> list[str]:
    """Above the part of a page about another world; none above that about the first, which has no name."""
    return [f"### {world[:1].upper()}{world[1:]}"] if world else []
