"""The run of `method=tune`, as `method.run` names it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from coil_rl.config.parts import OwnRun
from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.ranges import checked
from coil_rl.record import TUNED
from coil_rl.run.run import Run
from coil_rl.tune.numbers import GuideWithNumbers, numbers_to_tune, with_values
from coil_rl.tune.run import TunedRun, read_tuned
from coil_rl.tune.search import Search


@checked
@dataclass(frozen=True)
class Tuning(Search, OwnRun):
    """A run that tunes the numbers of its guide that `tune` names."""

    def check(self, config: DictConfig) -> None:
        """Raise a `UserError` for numbers that cannot be tuned, and for another delivery."""
        require(f"method={config.method.name}", "tune", "cmaes")
        if config.delivery != "tested":
            raise UserError(
                f"delivery={config.delivery}: method={config.method.name} always tests what it "
                "hands over; leave it out"
            )
        numbers, make_guide = numbers_to_tune(config), GuideWithNumbers(config)
        for end in (0.0, 1.0):
            try:
                make_guide({number.name: number.value(end) for number in numbers})
            except UserError as error:
                raise UserError(f"tune: a bound is no value of the guide: {error}") from error

    def maker(self, config: DictConfig) -> Callable[..., Run]:
        """Return what makes the run."""
        numbers, make_guide = numbers_to_tune(config), GuideWithNumbers(config)
        return partial(TunedRun, numbers=numbers, make_guide=make_guide, search=self)

    def found(self, config: DictConfig, folder: Path) -> DictConfig:
        """Return the configuration whose guide has the numbers that the run has found.

        Args:
            config: of the run.
            folder: of the run.
        """
        if not (folder / TUNED.name).is_file():
            return config
        return with_values(config, read_tuned(folder, numbers_to_tune(config)) or {})
