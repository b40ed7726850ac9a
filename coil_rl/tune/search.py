"""The search for better numbers of a guide: CMA-ES over complete episodes, all of them counted.

A generation is a few candidates, each of which acts in the same few new cases; the next candidates
are drawn where the better ones were. At the end the mean of the last generation, its best candidate
and the guide with its own numbers act in further new cases, and the guide keeps its own numbers
unless others are clearly better. Hansen 2016, The CMA evolution strategy: a tutorial.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.guides.simple import FollowAdvice
from coil_rl.ranges import Count, Ge, Interval, checked
from coil_rl.run.cases import LEAST_CASES, TrainingCases
from coil_rl.tune.candidates import Candidates

OWN, MEAN, BEST = "own", "mean", "best"  # the candidates of the test at the end
FIRST_CASES = 4  # of that test
Values = dict[str, float]  # of the numbers, by name
MakeGuide = Callable[[Mapping[str, float]], TensorDictModuleBase]


@dataclass(frozen=True)
class Number:
    """A number of a guide and where it is searched.

    Args:
        name: of the number.
        low: smallest value.
        high: largest value.
        own: value of the guide as it is.
        log: whether it is searched by its logarithm.
        whole: whether it is an integer.
    """

    name: str
    low: float
    high: float
    own: float
    log: bool = False
    whole: bool = False

    def place(self, value: float) -> float:
        """Return where a value lies between the bounds, from 0 to 1."""
        low, high, value = map(self._scaled, (self.low, self.high, value))
        return min(max((value - low) / (high - low), 0.0), 1.0)

    def value(self, place: float) -> float:
        """Return the value at a place from 0 to 1 between the bounds, rounded to six digits."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        scaled = low + place * (high - low)
        value = float(f"{math.exp(scaled) if self.log else scaled:.6g}")
        value = min(max(value, self.low), self.high)
        return float(round(value)) if self.whole else value

    def _scaled(self, value: float) -> float:
        return math.log(max(value, self.low)) if self.log else value


@checked
@dataclass(frozen=True)
class Search:
    """Settings of the search.

    Args:
        population: candidates of a generation; None: 4 + 3 ln n for n numbers, at least 6.
        cases: new ones of each generation, in which all its candidates act.
        spread: standard deviation of the first candidates, as a share of the bounds' distance.
        share: of the frames that is kept for the test at the end.

    Raises:
        ValueError: for a value out of range.
    """

    population: Annotated[int, Ge(3)] | None = None
    cases: Count = 4
    spread: Annotated[float, Interval(gt=0, le=1)] = 0.25
    share: Annotated[float, Interval(gt=0, le=0.5)] = 0.15

    def size(self, numbers: int) -> int:
        """Return the number of candidates in a generation."""
        return self.population or max(6, 4 + math.floor(3 * math.log(numbers)))


@dataclass(eq=False)
class Tuner:
    """A search, generation by generation.

    What it draws follows from the seed and from the returns that it was told, so that these are its
    state.

    Args:
        numbers: what is searched, at least one.
        make_guide: makes the guide with some values.
        candidates: the guide of the env, which acts by the guides that are compared.
        cases: makes new cases, counts their steps.
        search: settings.
        seed: of the draws.

    Attributes:
        told: mean returns of the candidates, by generation.
        best: numbers of the best candidate of the last generation.
        spread: standard deviation of the last candidates, as a share of the bounds' distance.
    """

    numbers: Sequence[Number]
    make_guide: MakeGuide
    candidates: Candidates
    cases: TrainingCases
    _: KW_ONLY
    search: Search
    seed: int = 0

    def __post_init__(self) -> None:
        self.largest = 0  # steps of a generation
        self.spread = self.search.spread
        self._begin()
        self.best = self.own

    @property
    def own(self) -> Values:
        """The guide's own numbers."""
        return {number.name: number.own for number in self.numbers}

    @property
    def mean(self) -> Values:
        """The numbers around which the next candidates are drawn; at first the guide's own."""
        return self._values(self.cma.mean) if self.told else self.own

    @property
    def converged(self) -> bool:
        """Whether CMA-ES says that its search has ended."""
        return bool(self.cma.should_stop())

    def may_go_on(self) -> bool:
        """Return whether the frames allow a further generation; they always do for the first."""
        frames = self.cases.frames * (1 - self.search.share)
        return not self.told or self.cases.steps + self.largest <= frames

    def generation(self) -> list[float]:
        """Try the candidates of a generation, and return their mean returns."""
        before = self.cases.steps
        places = self._ask()
        returns = self.returns([self._values(each) for each in places], self.search.cases)
        means = [float(each.mean()) for each in returns]
        self._tell(places, means)
        self.spread = float(np.std(places, axis=0).mean())
        self.largest = max(self.largest, self.cases.steps - before)
        return means

    def returns(self, values: Sequence[Values], cases: int) -> list[Tensor]:
        """Return the returns of guides with some values in the same new cases, [C] each.

        They act side by side in the rows of one env, if its rows can have the same case, and else
        one after the other.

        Args:
            cases: C, number of new cases.
        """
        guides = [self.make_guide(each) for each in values]
        beside = [guides] if self.cases.can_copy() else [[guide] for guide in guides]
        self.cases.renew(cases)
        return [part for each in beside for part in self._act(each).split(cases)]

    def test(self) -> dict[str, Tensor]:
        """Return the returns of `OWN`, `MEAN` and `BEST` in the same further new cases, [C]."""
        values = {OWN: self.own, MEAN: self.mean, BEST: self.best}
        reserve = self.cases.frames - self.cases.steps
        first = FIRST_CASES
        if self.cases.episodes:
            length = self.cases.steps / self.cases.episodes
            first = max(LEAST_CASES, min(first, int(reserve / (len(values) * length))))
        parts = [
            self.returns(list(values.values()), count)
            for count in self.cases.blocks(first, reserve)
        ]
        return dict(zip(values, map(torch.cat, zip(*parts, strict=True)), strict=True))

    def state_dict(self) -> dict[str, Any]:
        """Return what the next generation depends on."""
        return {"told": self.told, "largest": self.largest, "cases": self.cases.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, by drawing and telling everything again."""
        self._begin()
        for means in state["told"]:
            self._tell(self._ask(), list(means))
        self.largest = int(state["largest"])
        self.cases.load_state_dict(state["cases"])

    def _begin(self) -> None:
        """Begin the search at the guide's own numbers."""
        from cmaes import CMA  # imports scipy.stats, which takes a second in every training

        self.told: list[list[float]] = []
        first = np.array([number.place(number.own) for number in self.numbers])
        self.cma = CMA(
            first,
            self.search.spread,
            bounds=np.tile([0.0, 1.0], (len(first), 1)),
            seed=self.seed % 2**32,
            population_size=self.search.size(len(first)),
        )

    def _ask(self) -> list[NDArray[np.float64]]:
        """Return the places of the candidates of the next generation."""
        return [self.cma.ask() for _ in range(self.cma.population_size)]

    def _tell(self, places: Sequence[NDArray[np.float64]], means: list[float]) -> None:
        """End a generation with the mean returns of its candidates."""
        self.cma.tell([(place, -mean) for place, mean in zip(places, means, strict=True)])
        self.best = self._values(places[int(np.argmax(means))])
        self.told.append(means)

    def _values(self, places: NDArray[np.float64]) -> Values:
        pairs = zip(self.numbers, places.tolist(), strict=True)
        return {number.name: number.value(place) for number, place in pairs}

    def _act(self, guides: Sequence[TensorDictModuleBase]) -> Tensor:
        """Return the returns of guides in the present rows, [rows]."""
        self.candidates.replace(guides)
        return self.cases.returns(FollowAdvice(self.cases.env_of(len(guides))), len(guides))


def chosen(returns: Mapping[str, Tensor]) -> str:
    """Return whose numbers the guide gets: its own, unless others are better.

    Others are better if the mean of the paired differences is above two of its standard errors.

    Args:
        returns: of `OWN` and others in the same cases, [C] each.
    """
    means = {name: float(values.mean()) for name, values in returns.items()}
    best = max(means, key=lambda name: (means[name], name == OWN))
    differences = returns[best] - returns[OWN]
    error = float(differences.std()) / len(differences) ** 0.5
    return best if float(differences.mean()) > 2 * error else OWN
