"""Typed root configuration of `coil-listen`."""

from dataclasses import dataclass

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from coil_rl.config.schema import DrivingConfig, Repeats, open_to_measures


@dataclass
class ListenConfig(DrivingConfig):
    """Configuration of `coil-listen`."""

    run: str = MISSING
    donors: Repeats = 16


ConfigStore.instance().store(name="listen_schema", node=open_to_measures(ListenConfig))
