"""Check of a configuration before a run starts: ranges, and one small build of every part.

A mistake is found in seconds. Nothing is written except the folder of the run, as the last step.
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
from pydantic import TypeAdapter, ValidationError
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.errors import UserError, did_you_mean
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.train.arguments import validation_message
from coil_rl.train.build import (
    build,
    build_all,
    build_bare_env,
    build_env,
    build_guided_env,
    build_guides,
    build_learner,
    cases_node,
    check_node,
    learner_kind,
    trains_guides,
)
from coil_rl.train.config import TrainConfig
from coil_rl.train.distillation import guides_with_untrained_proxies, guides_without_parameters, proxy_config
from coil_rl.train.evaluation import INFO

# Kind of a learner: description and example.
KINDS = {
    "agent": ("learns from reward", "ppo"),
    "imitation": ("imitates a guide", "forest"),
    "guides": ("improves its guides", "dynamic_coil"),
}
LARGEST_BATCH = 2**28


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration of a program that drives, and perhaps trains."""
    check_parts(config)
    make_folder(Path(config.run_dir))


def check_parts(config: DictConfig) -> None:
    """Do the checks of `check` without making the folder of the run."""
    check_values(config)
    trains = OmegaConf.get_type(config) is TrainConfig
    has_agent = trains and config.method.observes is not None
    if has_agent:
        _check_learner_kind(config)
    tracks = {}
    for split in ("train", "test") if trains else ("test",):
        tracks[split] = len(build(config.track.get(split), f"track.{split}"))
        if not tracks[split]:
            raise UserError(f"track.{split} gives no tracks; give at least one")
    if trains or OmegaConf.select(config, "run") is None:
        _check_guides(config, tracks)
    build_all(config.evaluation.advice, "evaluation.advice")
    if has_agent:
        if not config.label or config.label.split()[:1] == ["guide"] or "/" in config.label:
            raise UserError(f"label={config.label} cannot be used: it must not be empty, begin with guide or contain /")
        _check_training(config, tracks["train"])
        if config.method.transforms:
            for advice in config.evaluation.advice:
                _check_drive(config, "test", tracks["test"], partial(build_env, advice=advice))


def check_values(config: DictConfig) -> None:
    """Raise a `UserError` for an unknown key, or a value out of range, in the configuration of any program."""
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    schema: Any = OmegaConf.get_type(config)
    try:
        TypeAdapter(schema).validate_python(values)
    except ValidationError as error:
        for detail in error.errors():
            if detail["type"] == "unexpected_keyword_argument":
                raise UserError(_unknown_key(config, *map(str, detail["loc"]))) from None
        raise UserError(validation_message(error, values)) from None
    for name in ("budget", "proxy.budget"):
        budget = OmegaConf.select(config, name)
        if isinstance(budget, DictConfig) and (frames := budget.cars * budget.steps) > LARGEST_BATCH:
            raise UserError(f"{name}.cars x {name}.steps={frames} must be at most {LARGEST_BATCH}")
    for name in ("device", "env.device"):
        if isinstance(device := OmegaConf.select(config, name), str):
            _check_device(name, device)


def _unknown_key(config: DictConfig, *path: str) -> str:
    *parents, key = path
    name = ".".join(parents)
    node = OmegaConf.select(config, name) if name else config
    known = [field.name for field in fields(OmegaConf.get_type(node)) if field.name != "defaults"]  # type: ignore[arg-type]
    return f"there is no key {key}; {name or 'the configuration'} has {', '.join(known)}{did_you_mean(key, known)}"


def _check_device(key: str, device: str) -> None:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise UserError(f"{key}={device} must be cpu, cuda, or one GPU such as cuda:0")
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:
        raise UserError(f"{key}={device} cannot be used ({str(error).splitlines()[0]}); take {key}=cpu") from error


def _check_learner_kind(config: DictConfig) -> None:
    kind, (purpose, example) = learner_kind(config), KINDS[config.method.learner]
    if kind != config.method.learner:
        learner = config.learner["_target_"].rpartition(".")[2]
        raise UserError(
            f"method={config.method.name} needs a learner that {purpose}, such as learner={example}, "
            f"but {learner} is one that {KINDS[kind][0]}"
        )


def _check_guides(config: DictConfig, tracks: dict[str, int]) -> None:
    env = _evaluation_env(config)
    guides = build_guides(config)
    for name, guide in guides.items():
        check_guide_in_env(guide, env, f"guide.{name}")
    build_all(config.degrade, "degrade")
    if config.degrade:
        for split, count in tracks.items():
            _check_drive(config, split, count, partial(build_guided_env, guides=guides))


def _evaluation_env(config: DictConfig) -> EnvBase:
    """Return the env with one car, or raise a `UserError` if drivers cannot be evaluated in it."""
    name = config.env.get("_target_", "it")
    # First, because methods and evaluation set further keys of envs with tracks.
    if "tracks" not in config.env:
        raise UserError(
            f"env: {name} has no key tracks, so nothing can drive in it; choose another env "
            "(for the steering of policies on a recording: coil-replay recording=FILE)"
        )
    check_node(config.env, "env")
    env = build_bare_env(config, {**config.evaluation.env, "num_cars": 1})
    missing = [f"info.{key}" for key in INFO if ("info", key) not in env.observation_spec.keys(True)]
    if missing or (config.evaluation.gif and not hasattr(env, "rate")):
        needs = f"entries {', '.join(missing)}" if missing else "attribute rate (steps per second) for evaluation.gif"
        raise UserError(f"env: {name} lacks the {needs}; the evaluation reads them")
    return env


def check_guide_in_env(guide: TensorDictModuleBase, env: EnvBase, name: str) -> None:
    """Raise a `UserError` if the env lacks an entry that the guide reads, or the guide's action has a wrong shape."""
    data = env.reset()
    for key in guide.in_keys:
        if key not in data.keys(True):
            raise UserError(f"{name}: it reads {key}, but the env has only {', '.join(map(_dotted, data.keys()))}")
    shape, expected = guide(data)["action"].shape, env.action_spec.shape
    if shape != expected:
        raise UserError(f"{name}: its action has the shape {list(shape)}, but the env takes {list(expected)}")


def _check_drive(config: DictConfig, split: str, tracks: int, build_drive: Callable[..., Any]) -> None:
    # Some ways to degrade advice need several cars, and an evaluation has one car a track.
    try:
        build_drive(config, {**config.evaluation.env, "num_cars": tracks})
    except UserError as error:
        raise UserError(f"track.{split} has {tracks} tracks, with one car each: {error}") from error


def _check_training(config: DictConfig, tracks: int) -> None:
    if not config.method.observes:
        raise UserError("method.observes=[]: the agent has no observations; give some, or null for no agent")
    env = build_env(config, config.training.env)
    if trains_guides(config) and config.degrade:
        raise UserError(f"degrade={list(config.degrade)} has no effect on guides that are trained; leave it out")
    guides = build_guides(config) if trains_guides(config) else {}
    check_proxies(config, guides_without_parameters(guides))
    learner = build_learner(config, env, guides_with_untrained_proxies(config) if guides else None)
    frames = config.budget.cars * config.budget.steps
    minibatches = getattr(learner, "minibatches", 0)
    if 2 * minibatches > frames:
        raise UserError(
            f"learner.minibatches={minibatches} leaves less than 2 frames to each minibatch, too few to standardise "
            f"advantages; a batch has budget.cars x budget.steps = {frames} frames"
        )
    if tracks == 1 and getattr(learner, "validate", False) and learner.group_key is not None:
        raise UserError(
            "track.train gives one track, which cannot be left out to validate; set learner.group_key=null, "
            "or learner.validate=false"
        )
    if cases := list(config.evaluation.curve.cases):
        if set(cases) != {EVALUATION, SELECTION}:
            given = ", ".join(cases)
            raise UserError(f"evaluation.curve.cases has {given}; give {EVALUATION} and {SELECTION}, or none")
        for name in cases:
            build_env(config, cases_node(config, name))
    if config.logger:
        check_node(config.logger, "logger")
    _check_watch(config, env)


def check_proxies(config: DictConfig, guides: Iterable[str]) -> None:
    """Raise a `UserError` for the first mistake in the training of the proxies of guides."""
    for name in guides:
        try:
            check_parts(proxy_config(config, name))
        except UserError as error:
            raise UserError(f"proxy of guide.{name}: {error}") from error


def _check_watch(config: DictConfig, env: EnvBase) -> None:
    known = {_dotted(key) for spec in (env.observation_spec, env.full_reward_spec) for key in spec.keys(True)}
    groups = ("episode", "step")
    for group, keys in config.watch.items():
        if group not in groups:
            raise UserError(f"there is no key watch.{group}; watch has episode, step{did_you_mean(group, groups)}")
        for name, key in keys.items():
            if _dotted(key) not in known:
                raise UserError(
                    f"watch.{group}.{name}={list(key)} is no entry of the env; it has "
                    f"{', '.join(sorted(known))}{did_you_mean(_dotted(key), known)}"
                )


def _dotted(key: str | Iterable[Any]) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def make_folder(folder: Path) -> None:
    """Make the folder of a run, or raise a `UserError` if nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(None, "Permission denied")
    except OSError as error:
        raise UserError(
            f"the run's folder {folder} cannot be used ({error.strerror}); choose another with hydra.run.dir=FOLDER"
        ) from error
