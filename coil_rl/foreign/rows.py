"""Plants side by side, in one process or in several."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey

from coil_rl.foreign.codec import Codec
from coil_rl.foreign.guard import Guard
from coil_rl.foreign.plant import GymnasiumPlant, Plant

Entries = dict[NestedKey, NDArray[Any]]
AnyPlant = TypeVar("AnyPlant", bound=Plant)


class Rows(Generic[AnyPlant]):
    """Plants that are stepped one after the other in one process.

    Args:
        plants: one a row.
        guard: around each batch of their calls.
    """

    def __init__(self, plants: Iterable[AnyPlant] = (), guard: Guard | None = None) -> None:
        self.plants, self.guard = list(plants), guard or Guard()

    def begin(
        self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]]
    ) -> list[Entries]:
        """Begin episodes, take some actions in each, and return the entries of each process.

        Args:
            seeds: by row.
            actions: by row, as the env takes them; a row that is missing takes none.
        """
        with self.guard:
            for row, seed in seeds.items():
                self.plants[row].begin(seed)
                for action in actions.get(row, ()):
                    self.plants[row].step(action)
        return self._done()

    def step(self, actions: Any) -> list[Entries]:
        """Take a step in all rows, and return the entries of each process.

        Args:
            actions: of all rows, as the env takes them.
        """
        with self.guard:
            for plant, action in zip(self.plants, actions, strict=True):
                plant.step(action)
        return self._done()

    def _done(self) -> list[Entries]:
        """Return the entries; from here on rows that use the global numbers have their own."""
        if self.guard.touched:
            for plant in self.plants:
                plant.numbers.use(plant.seed)
        return [self.entries()]

    def entries(self) -> Entries:
        """Return the entries of all rows, [rows, ...], if they are arrays."""
        return {}


class GymnasiumRows(Rows[GymnasiumPlant]):
    """Gymnasium envs that are stepped one after the other in one process.

    Args:
        codec: of their spaces.
        info: names of numbers in Gymnasium's info.
    """

    def __init__(self, codec: Codec, info: Sequence[str], guard: Guard | None = None) -> None:
        super().__init__(guard=guard)
        self.codec, self.info, self.unseen = codec, tuple(info), set(info)

    def extend(self, plants: Iterable[GymnasiumPlant]) -> "GymnasiumRows":
        """Take further plants, and return all; a `ValueError` for one with other spaces."""
        with self.guard:
            made = list(plants)
        for plant in made:
            self.codec.check_same(plant.env, plant.row)
            plant.codec = self.codec
            self.plants.append(plant)
        return self

    def entries(self) -> Entries:
        """Return the entries of all rows, [rows, ...], and their rewards."""
        plants = self.plants
        found: Entries = {
            "terminated": np.array([plant.terminated for plant in plants]),
            "truncated": np.array([plant.truncated for plant in plants]),
            "reward": np.array([plant.reward for plant in plants], self.codec.floats),
        }
        found["done"] = found["terminated"] | found["truncated"]
        for entry in self.codec.entries:
            found[entry.key] = np.array([plant.values[entry.key] for plant in plants])
        if self.unseen:
            self._look_for_info()
        for name in self.info:
            numbers = [plant.number_of(name) for plant in plants]
            found["info", name] = np.array(numbers, self.codec.floats)
        for name in plants[0].controllers:
            found["controller", name] = np.array([plant.advice[name] for plant in plants])
        return found

    def _look_for_info(self) -> None:
        """Warn of a name that no info has had when the first episode is over."""
        self.unseen.difference_update(*(plant.info for plant in self.plants))
        if self.unseen and any(plant.is_over for plant in self.plants):
            missing = ", ".join(sorted(self.unseen))
            known = sorted({str(name) for plant in self.plants for name in plant.info})
            warnings.warn(
                f"the env {self.codec.name} had no {missing} in the info of an episode, so it is "
                "NaN there, a number without a value; at its end info has "
                f"{', '.join(known) or 'nothing'}",
                stacklevel=2,
            )
            self.unseen.clear()

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Return a picture of a row."""
        with self.guard:
            return self.plants[row].render()

    def close(self) -> None:
        """Close all envs."""
        with self.guard:
            for plant in self.plants:
                plant.close()
