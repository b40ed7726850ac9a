"""Everything that a run will need, built once before it starts: a mistake shall cost seconds, not the night.

Nothing is written, but for the folder of the run as the very last step.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.errors import UserError
from coil_rl.signature import near
from coil_rl.train.build import (
    build,
    build_all,
    build_bare_env,
    build_env,
    build_guided_env,
    build_guides,
    build_learner,
    check_node,
    learner_kind,
    trains_guides,
)
from coil_rl.train.config import Train
from coil_rl.train.distillation import guides_with_untrained_proxies

LARGEST = 2**63 - 1
# What a learner may be there for, in words, and the name of one.
LEARNERS = {
    "agent": ("learns from reward", "ppo"),
    "imitation": ("imitates a guide", "forest"),
    "guides": ("improves its guides", "dynamic_coil"),
}
# Lowest and highest value; most of the highest only keep a slip of the keyboard from filling the memory.
LIMITS = {
    "seed": (0, LARGEST),
    "threads": (1, 1024),
    "budget.frames": (1, LARGEST),
    "budget.cars": (1, 2**20),
    "budget.steps": (1, 2**16),
    "evaluation.repeats": (1, 10_000),
    "checkpoint_every": (1, LARGEST),
}
LARGEST_BATCH = 2**28
CHOICES = {
    "evaluation.policy": ("last", "best"),
    "evaluation.guides": ("phases", "ends"),
    "existing": ("refuse", "resume"),
    "policy": ("last", "best"),
    "method.learner": tuple(LEARNERS),
}


def check(config: DictConfig) -> None:
    """Refuse a configuration that could not be run to its end.

    Args:
        config: of a program; one with a `learner` trains.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    check_values(config)
    training = OmegaConf.get_type(config) is Train
    if training and config.method.observes is not None:
        _check_learner(config)
    parts = ("train", "test") if training else ("test",)
    tracks = {part: len(build(config.track.get(part), f"track.{part}")) for part in parts}
    for part, count in tracks.items():
        if not count:
            raise UserError(f"track.{part} gives no tracks; give at least one")
    if training or OmegaConf.select(config, "run") is None:
        check_node(config.env, "env")
        env = build_bare_env(config, {**config.evaluation.env, "num_cars": 1})
        guides = build_guides(config)
        for name, guide in guides.items():
            check_guide(guide, env, f"guide.{name}")
        build_all(config.degrade, "degrade")
        if config.degrade:
            for part, count in tracks.items():
                _check_drive(config, part, count, partial(build_guided_env, guides=guides))
    build_all(config.evaluation.advice, "evaluation.advice")
    if training and config.method.observes is not None:
        if not config.label or config.label.split()[:1] == ["guide"] or "/" in config.label:
            raise UserError(
                f"label={config.label} cannot name an agent: it must not be empty, not guide, and have no /; "
                "take another"
            )
        _check_training(config, tracks["train"])
        if config.method.transforms:
            for advice in config.evaluation.advice:
                _check_drive(config, "test", tracks["test"], partial(build_env, advice=advice))
    make_folder(Path(config.run_dir))


def check_values(config: DictConfig) -> None:
    """Refuse keys that there are not, and numbers and choices outside of what is possible.

    Args:
        config: of any program.

    Raises:
        UserError: for the first of them.
    """
    for name in ("", "budget", "evaluation", "method"):
        node = OmegaConf.select(config, name) if name else config
        if node is not None:  # not every program has all of these
            check_keys(node, name or "the configuration")
    for name, (low, high) in LIMITS.items():
        value = OmegaConf.select(config, name)
        if value is not None and not low <= value <= high:
            raise UserError(f"{name}={value} must be {f'at least {low}' if value < low else f'at most {high}'}")
    for name, choices in CHOICES.items():
        value = OmegaConf.select(config, name)
        if value is not None and value not in choices:
            raise UserError(f"{name}={value} must be one of {', '.join(choices)}")
    if "budget" in config and (frames := config.budget.cars * config.budget.steps) > LARGEST_BATCH:
        raise UserError(f"budget.cars x budget.steps={frames} must be at most {LARGEST_BATCH}")
    for name in ("device", "env.device"):
        if isinstance(device := OmegaConf.select(config, name), str):
            _check_device(name, device)


def check_keys(node: DictConfig, name: str = "the configuration") -> None:
    """Refuse a key that a node made from a dataclass does not have.

    Raises:
        UserError: naming it, and those that there are.
    """
    known = [field.name for field in fields(node._metadata.object_type) if field.name != "defaults"]
    for key in sorted(set(node).difference(known)):
        raise UserError(f"there is no key {key}; {name} has {', '.join(known)}{near(str(key), known)}")


def _check_device(key: str, name: str) -> None:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UserError(f"{key}={name} must be cpu, cuda, or one GPU such as cuda:0")
    try:
        torch.empty(0, device=name)
    except (AssertionError, RuntimeError) as error:
        raise UserError(f"{key}={name} cannot be used ({str(error).splitlines()[0]}); take {key}=cpu") from error


def check_guide(guide: TensorDictModuleBase, env: EnvBase, name: str) -> None:
    """Refuse a guide that cannot act in an env.

    Args:
        guide: any.
        env: any.
        name: what a person calls it.

    Raises:
        UserError: if it reads what the env does not write, or its action has another shape.
    """
    data = env.reset()
    for key in guide.in_keys:
        if key not in data.keys(True):
            raise UserError(f"{name}: it reads {key}, but the env has only {', '.join(map(_name, data.keys()))}")
    action = guide(data)["action"]
    shape, wanted = action.shape, env.action_spec.shape
    if shape != wanted:
        raise UserError(f"{name}: its action has the shape {list(shape)}, but the env takes {list(wanted)}")


def _check_drive(config: DictConfig, part: str, tracks: int, build_it: Callable[..., Any]) -> None:
    """Some ways to degrade advice need several cars; where guides and agents are judged there is one on each track."""
    try:
        build_it(config, {**config.evaluation.env, "num_cars": tracks})
    except UserError as error:
        raise UserError(f"track.{part} gives {tracks} to drive on, one car each: {error}") from error


def _check_learner(config: DictConfig) -> None:
    """A method whose learner is of another kind than it means would still run, and be something else."""
    kind, (purpose, example) = learner_kind(config), LEARNERS[config.method.learner]
    if kind != config.method.learner:
        given = config.learner["_target_"].rpartition(".")[2]
        raise UserError(
            f"method={config.method.name} needs a learner that {purpose}, such as learner={example}, "
            f"but {given} is one that {LEARNERS[kind][0]}"
        )


def _check_training(config: DictConfig, tracks: int) -> None:
    if not config.method.observes:
        raise UserError("method.observes=[] lets the agent see nothing; name entries of the env, or null for no agent")
    env = build_env(config)
    if trains_guides(config) and config.degrade:
        raise UserError(f"degrade={list(config.degrade)} has no effect on guides that are trained; leave it out")
    learner = build_learner(config, env, guides_with_untrained_proxies(config) if trains_guides(config) else None)
    frames = config.budget.cars * config.budget.steps
    minibatches = getattr(learner, "minibatches", 0)  # not every learner has them
    if 2 * minibatches > frames:
        raise UserError(
            f"learner.minibatches={minibatches} leaves less than 2 frames of a batch to each, too few to standardise "
            f"advantages; a batch has cars x steps of budget, here {frames}"
        )
    if tracks == 1 and getattr(learner, "validate", False) and learner.group_key is not None:
        raise UserError(
            "track.train gives one track, which cannot be left out to validate; set learner.group_key=null, "
            "or learner.validate=false"
        )
    if config.logger:
        check_node(config.logger, "logger")
    known = {_name(key): key for spec in (env.observation_spec, env.full_reward_spec) for key in spec.keys(True)}
    for group, keys in config.watch.items():
        if group not in ("episode", "step"):
            raise UserError(f"there is no key watch.{group}; watch has episode, step{near(group, ('episode', 'step'))}")
        for name, key in keys.items():
            if _name(key) not in known:
                raise UserError(
                    f"watch.{group}.{name}={list(key)} is no entry of the env; it has "
                    f"{', '.join(sorted(known))}{near(_name(key), known)}"
                )


def _name(key: str | Iterable[Any]) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def make_folder(folder: Path) -> None:
    """Make the folder of a run.

    Raises:
        UserError: if nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(None, "Permission denied")
    except OSError as error:
        raise UserError(
            f"the run's folder {folder} cannot be used ({error.strerror}); choose another with hydra.run.dir=FOLDER"
        ) from error
