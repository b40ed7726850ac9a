"""Further drivers of the evaluation table: what acts once more in each case, beside the policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tensordict.nn import TensorDictModuleBase

from coil_rl.learners.learner import Learner
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.parts import EnvMaker

if TYPE_CHECKING:
    from coil_rl.run.run import Run


@dataclass(frozen=True)
class Driver:
    """A further driver of a table.

    Args:
        name: what follows the label of the policy in tables, such as "or guide".
        policy: writes the action.
        said: returns the sentences for the page, given the episodes of the driver.
    """

    name: str
    policy: TensorDictModuleBase
    said: Callable[[EvaluationResult], Sequence[str]] = lambda result: ()


class Beside(ABC):
    """What makes a further driver of a policy; a YAML file names it in `evaluation.beside`."""

    @abstractmethod
    def check(self, make_env: EnvMaker, learner: Learner, folder: Path) -> None:
        """Raise a `UserError` for a run whose policy cannot have it, before the training."""

    @abstractmethod
    def driver(self, run: Run, policy: TensorDictModuleBase | None) -> Driver:
        """Return the driver.

        Args:
            policy: of the run; None for a run without an agent.
        """
