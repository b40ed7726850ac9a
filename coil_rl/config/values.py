"""Check of the values of a configuration: unknown keys, types and ranges."""

import re
from dataclasses import fields
from functools import cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import TypeAdapter, ValidationError

from coil_rl.config.messages import similar
from coil_rl.errors import UserError
from coil_rl.measures import measures_of
from coil_rl.ranges import validation_message

LARGEST_BATCH = 2**28  # frames


def check_values(config: DictConfig) -> None:
    """Check the values of the configuration of any program.

    Args:
        config: composed by Hydra, or read from a folder.

    Raises:
        UserError: for an unknown key, or a value out of range.
    """
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    schema: Any = OmegaConf.get_type(config)
    try:
        _adapter(schema).validate_python(values)
    except ValidationError as error:
        for detail in error.errors():
            if detail["type"] == "unexpected_keyword_argument":
                raise UserError(_unknown_key(config, *map(str, detail["loc"]))) from None
        raise UserError(validation_message(error, values)) from None
    measures_of(values.get("evaluation", {}).get("measures", {}))
    for name in ("budget", "proxy.budget"):
        budget = OmegaConf.select(config, name)
        if (
            isinstance(budget, DictConfig)
            and (frames := budget.num_envs * budget.steps) > LARGEST_BATCH
        ):
            raise UserError(
                f"{name}.num_envs x {name}.steps={frames} must be at most {LARGEST_BATCH}"
            )
    for name in ("device", "env.device"):
        if isinstance(device := OmegaConf.select(config, name), str):
            _check_device(config, name, device)


def _check_device(config: DictConfig, name: str, device: str) -> None:
    """Raise a `UserError` for a device that is unknown, is not there or cannot do what is asked."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise UserError(f"{name}={device} must be cpu, cuda, or one GPU such as cuda:0")
    if device != "cpu" and OmegaConf.select(config, "compile"):
        raise UserError(
            f"compile=true is for the CPU only, not for {name}={device}; take compile=false"
        )
    import torch  # here, so that help and a wrong word do not wait for it

    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:
        problem = str(error).splitlines()[0]
        raise UserError(f"{name}={device} cannot be used ({problem}); take {name}=cpu") from error


@cache
def _adapter(schema: type) -> TypeAdapter[Any]:
    """Return the validator of a schema, which takes longer to make than to use."""
    return TypeAdapter(schema)


def _unknown_key(config: DictConfig, *path: str) -> str:
    *parents, key = path
    name = ".".join(parents)
    node = OmegaConf.select(config, name) if name else config
    known = [field.name for field in fields(OmegaConf.get_type(node)) if field.name != "defaults"]  # type: ignore[arg-type]
    return (
        f"there is no key {key}; {name or 'the configuration'} has {', '.join(known)}"
        f"{similar(key, known)}"
    )
