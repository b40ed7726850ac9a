"""Guides drive alone, beside the agents that they advise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from coil_rl.train.build import build_guided_env, env_node
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy


def drive_guides(
    config: DictConfig,
    overrides: Mapping[str, Any],
    names: Sequence[str],
    guides: Mapping[str, TensorDictModuleBase] | None = None,
) -> dict[str, EvaluationResult]:
    """Each guide of a run alone, on each track once, by what it goes as in tables: `guide`, or `guide NAME` of several.

    Args:
        config: of the run.
        overrides: what to change in `env`; its tracks, one car each.
        names: of the tracks.
        guides: others than those of the configuration.
    """
    if guides:
        return _drive_guides(config, overrides, names, guides)
    known = {key: OmegaConf.to_container(config[key], resolve=True) for key in ("guide", "degrade")}
    return dict(_driven_before(OmegaConf.to_yaml({"env": env_node(config, overrides), **known}), tuple(names)))


# The runs of a sweep share their guides, which drive the same lines again: as long as an agent takes to be judged.
@lru_cache(maxsize=64)
def _driven_before(known: str, names: tuple[str, ...]) -> dict[str, EvaluationResult]:
    config: Any = OmegaConf.create(known)
    return _drive_guides(config, {}, names)


def driver_names(guides: Iterable[str]) -> list[str]:
    """What guides of these names go as in tables: `guide`, or `guide NAME` of several."""
    names = list(guides)
    return ["guide"] if len(names) == 1 else [f"guide {name}" for name in names]


def _drive_guides(
    config: DictConfig,
    overrides: Mapping[str, Any],
    names: Sequence[str],
    guides: Mapping[str, TensorDictModuleBase] | None = None,
) -> dict[str, EvaluationResult]:
    env, policy = build_guided_env(config, {**overrides, "num_cars": len(names)}, guides)
    drivers = driver_names(guides or config.guide)
    with tqdm(unit="step", desc="guides", leave=False, mininterval=0.5) as bar:
        driven = evaluate_policy(env, policy, names=names, tick=bar.update)
    return dict(zip(drivers, driven.split(len(drivers)), strict=True))
