"""Measures of episodes in a configuration: from files, and from the command line."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.hints import similar
from coil_rl.config.schema import MeasureConfig
from coil_rl.config.sentences import sentence
from coil_rl.errors import UserError

# Columns that evaluation.csv and episodes.csv have besides the measures.
TAKEN = ("driver", "advice", "actions", "case", "reward", "steps", "episodes", "seed")


def complete_measures(config: DictConfig) -> None:
    """Give measures their types, and the values that a person left out.

    The schema leaves them untyped, because OmegaConf adds no typed node by an override. A
    configuration that is complete stays as it is.

    Args:
        config: composed; it is changed in place.

    Raises:
        UserError: for a measure that is no node, has an unknown key or a value of another type, or
            whose name is another column of the tables.
    """
    measures = OmegaConf.select(config, "evaluation.measures")
    schema: Any = None
    for name in measures or ():
        if is_complete(measures, name):
            continue
        if name in TAKEN:
            raise UserError(
                f"evaluation.measures.{name}: {name} is already a column of the tables; give the "
                "measure another name"
            )
        if not isinstance(measures[name], Mapping):
            raise UserError(
                f"evaluation.measures.{name}={measures[name]} is no measure; write "
                f"evaluation.measures.{name}.entry=ENTRY and, where it is not the mean over the "
                "steps, its reduction"
            )
        known = [field.name for field in fields(MeasureConfig)]
        for key in measures[name]:
            if key not in known:
                raise UserError(
                    f"there is no key {key}; evaluation.measures.{name} has {', '.join(known)}"
                    f"{similar(str(key), known)}"
                )
        schema = OmegaConf.structured(MeasureConfig) if schema is None else schema
        try:
            typed = OmegaConf.merge(schema, measures[name])
        except OmegaConfBaseException as error:
            raise UserError(f"evaluation.measures.{name}: {sentence(error)}") from error
        OmegaConf.update(config, f"evaluation.measures.{name}", typed, merge=False)


def is_complete(measures: DictConfig, name: str) -> bool:
    """Return whether a measure has its types, and all its values.

    Args:
        measures: of a configuration, by name.
        name: of the measure.
    """
    return OmegaConf.get_type(measures, name) is MeasureConfig
