"""Methods that do their run themselves: `method.run` in their YAML file says by which class."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from coil_rl.config.nodes import build

if TYPE_CHECKING:
    from coil_rl.run.run import Run


class OwnRun(ABC):
    """How a method does its run without a learner; `method.learner` is then "none"."""

    @abstractmethod
    def check(self, config: DictConfig) -> None:
        """Raise a `UserError` for a configuration that this run cannot have."""

    @abstractmethod
    def maker(self, config: DictConfig) -> "Callable[..., Run]":
        """Return what makes the run; its arguments are those of `Run`."""

    def found(self, config: DictConfig, folder: Path) -> DictConfig:
        """Return the configuration with what the run in a folder has found so far.

        Args:
            config: of the run; it stays as it is.
        """
        return config


def own_run(config: DictConfig) -> OwnRun | None:
    """Return how the method of a configuration does its run; None for those that train."""
    if not config.method.run:
        return None
    own: OwnRun = build(config.method.run, "method.run", OwnRun)
    return own
