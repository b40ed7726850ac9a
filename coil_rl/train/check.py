"""Check of a configuration before a run starts: ranges, and one small build of every part.

A mistake is found in seconds. Nothing is written except the folder of the run, as the last step.
"""

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import TypeAdapter, ValidationError
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.errors import UserError, did_you_mean
from coil_rl.guides.simple import FollowAdvice
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.train import build
from coil_rl.train.arguments import validation_message
from coil_rl.train.config import TrainConfig
from coil_rl.train.distillation import (
    guides_with_untrained_proxies,
    guides_without_parameters,
    proxy_config,
)
from coil_rl.train.evaluate_run import build_evaluation, build_pictures, recorded
from coil_rl.train.measures import measures_of
from coil_rl.transforms import GuideActions
from coil_rl.transforms.guide_actions import UnfitActionError

# Kind of a learner: description and example.
KINDS = {
    "agent": ("learns from reward", "ppo"),
    "imitation": ("imitates a guide", "forest"),
    "guides": ("improves its guides", "dynamic_coil"),
}
LARGEST_BATCH = 2**28
EPISODE_REWARD = "episode_reward"  # written by a transform of every env


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration of a program that drives, and perhaps trains."""
    check_parts(config)
    make_folder(Path(config.run_dir))


def check_parts(config: DictConfig) -> None:
    """Do the checks of `check` without making the folder of the run."""
    check_values(config)
    trains = OmegaConf.get_type(config) is TrainConfig
    has_agent = trains and config.method.observes is not None
    if has_agent and (kind := build.learner_kind(config)) != config.method.learner:
        learner, (purpose, example) = (
            config.learner["_target_"].rpartition(".")[2],
            KINDS[config.method.learner],
        )
        needed = (
            f"method={config.method.name} needs a learner that {purpose}, such as learner={example}"
        )
        raise UserError(f"{needed}, but {learner} is one that {KINDS[kind][0]}")
    cases, record = len(build_evaluation(config).cases), recorded(build_pictures(config))
    if trains or OmegaConf.select(config, "run") is None:
        _check_drivers(config, cases, record.values())
    build.build_all(config.evaluation.advice, "evaluation.advice")
    if has_agent:
        if not config.label or config.label.split()[:1] == ["guide"] or "/" in config.label:
            raise UserError(
                f"label={config.label} cannot be used: it must not be empty, begin with guide or contain /"
            )
        _check_training(config)
        if config.method.transforms:
            for advice in config.evaluation.advice:
                _check_cases(config, cases, partial(build.build_env, advice=advice))


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
        if (
            isinstance(budget, DictConfig)
            and (frames := budget.num_envs * budget.steps) > LARGEST_BATCH
        ):
            raise UserError(
                f"{name}.num_envs x {name}.steps={frames} must be at most {LARGEST_BATCH}"
            )
    for name in ("device", "env.device"):
        if not isinstance(device := OmegaConf.select(config, name), str):
            continue
        if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
            raise UserError(f"{name}={device} must be cpu, cuda, or one GPU such as cuda:0")
        try:
            torch.empty(0, device=device)
        except (AssertionError, RuntimeError) as error:
            problem = str(error).splitlines()[0]
            raise UserError(
                f"{name}={device} cannot be used ({problem}); take {name}=cpu"
            ) from error


def _unknown_key(config: DictConfig, *path: str) -> str:
    *parents, key = path
    name = ".".join(parents)
    node = OmegaConf.select(config, name) if name else config
    known = [field.name for field in fields(OmegaConf.get_type(node)) if field.name != "defaults"]  # type: ignore[arg-type]
    return f"there is no key {key}; {name or 'the configuration'} has {', '.join(known)}{did_you_mean(key, known)}"


def _check_drivers(config: DictConfig, cases: int, recorded: Iterable[NestedKey]) -> None:
    name = config.env.get("_target_", "it")
    if "num_envs" not in config.env:
        hint = "(for the actions of policies on a recording: coil-replay recording=FILE)"
        raise UserError(
            f"env: {name} has no key num_envs, so no policy can act in it; choose another env {hint}"
        )
    build.check_node(config.env, "env")
    env = build.build_bare_env(config, {**config.evaluation.env, "num_envs": 1})
    check_measures(config, env)
    for key in recorded:
        _check_entry(env, key, "evaluation.pictures")
    if (
        not config.guide
        and not config.method.needs_guide
        and "advice" not in config.method.transforms
    ):
        return
    guides = build.build_guides(config)
    for name, guide in guides.items():
        check_guide_in_env(guide, env, f"guide.{name}")
    build.build_all(config.degrade, "degrade")
    if config.degrade:
        _check_cases(config, cases, partial(build.build_guided_env, guides=guides))


def check_measures(config: DictConfig, env: EnvBase) -> None:
    """Raise a `UserError` if an env does not write an entry that is measured."""
    for name, measure in measures_of(config.evaluation.measures).items():
        for key in (measure.entry, measure.where):
            if key is not None:
                _check_entry(env, key, f"evaluation.measures.{name}")


def _check_entry(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an env does not write an entry; `name` is the key of the configuration that names it."""
    specs = (env.observation_spec, env.full_reward_spec, env.full_done_spec)
    known = {_dotted(each): each for spec in specs for each in spec.keys(True)} | {
        EPISODE_REWARD: EPISODE_REWARD
    }
    if _dotted(key) not in known:
        has = f"{', '.join(sorted(known))}{did_you_mean(_dotted(key), known)}"
        raise UserError(f"{name}={_dotted(key)} is no entry of the env; it has {has}")


def check_guide_in_env(guide: TensorDictModuleBase, env: EnvBase, name: str) -> None:
    """Raise a `UserError` if the env lacks an entry that the guide reads, or the guide's action does not fit."""
    try:
        transform = GuideActions({"guide": guide})
        memory = (key for each in transform.guides.memories.values() for key in each.specs)
        known = [*env.observation_spec.keys(True), *transform.supplied, *memory]
        for key in guide.in_keys:
            if key not in known:
                has = ", ".join(map(_dotted, env.observation_spec.keys()))
                raise UserError(f"{name}: it reads {_dotted(key)}, but the env has only {has}")
        advised = TransformedEnv(env, transform)
        advised.step(FollowAdvice(advised)(advised.reset()))
        advised.state_dict()  # a state that no checkpoint can hold is refused before the training
    except UnfitActionError as error:
        raise UserError(f"{name}: its action {error.problem}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0] if error.args else error}") from error
    except RuntimeError as error:
        problem = str(error).partition("\n")[0]
        raise UserError(
            f"{name}: it cannot act on the observations of this env ({problem})"
        ) from error


def _check_cases(config: DictConfig, cases: int, build_drive: Callable[..., Any]) -> None:
    # Some ways to degrade advice need several rows, and an evaluation has one row a case.
    try:
        build_drive(config, {**config.evaluation.env, "num_envs": cases})
    except UserError as error:
        raise UserError(
            f"each case of the evaluation has one row, {cases} in all: {error}"
        ) from error


def _check_training(config: DictConfig) -> None:
    if not build.observed_keys(config):
        raise UserError(
            "observes=[]: the agent has no observations; give the entries of the env that it observes"
        )
    env = build.build_env(config, config.training.env)
    if build.trains_guides(config) and config.degrade:
        raise UserError(
            f"degrade={list(config.degrade)} has no effect on guides that are trained; leave it out"
        )
    guides = build.build_guides(config) if build.trains_guides(config) else {}
    check_proxies(config, guides_without_parameters(guides))
    learner = build.build_learner(
        config, env, guides_with_untrained_proxies(config) if guides else None
    )
    frames = config.budget.num_envs * config.budget.steps
    try:
        learner.check_batch(frames)
    except ValueError as error:
        raise UserError(
            f"learner.{error}; a batch has budget.num_envs x budget.steps = {frames} frames"
        ) from error
    grouped = config.track and learner.validates_groups
    if grouped and len(build.build(config.track.train, "track.train")) == 1:
        remedy = "set learner.group_key=null, or learner.validate=false"
        raise UserError(
            f"track.train gives one track, which cannot be left out to validate; {remedy}"
        )
    if cases := list(config.evaluation.curve.cases):
        if set(cases) != {EVALUATION, SELECTION}:
            given = ", ".join(cases)
            raise UserError(
                f"evaluation.curve.cases has {given}; give {EVALUATION} and {SELECTION}, or none"
            )
        for name in cases:
            build.build_env(config, build.cases_node(config, name))
    if config.logger:
        build.check_node(config.logger, "logger")
    groups = ("episode", "step")
    for group, keys in config.watch.items():
        if group not in groups:
            raise UserError(
                f"there is no key watch.{group}; watch has episode, step{did_you_mean(group, groups)}"
            )
        for name, key in keys.items():
            if not isinstance(key, ListConfig):
                raise UserError(f"watch.{group}.{name}={key} must be a list, such as [info, lap]")
            _check_entry(env, key, f"watch.{group}.{name}")


def check_proxies(config: DictConfig, guides: Iterable[str]) -> None:
    """Raise a `UserError` for the first mistake in the training of the proxies of guides."""
    for name in guides:
        try:
            check_parts(proxy_config(config, name))
        except UserError as error:
            raise UserError(f"proxy of guide.{name}: {error}") from error


def _dotted(key: str | Iterable[Any]) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def make_folder(folder: Path) -> None:
    """Make the folder of a run, or raise a `UserError` if nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(None, "Permission denied")
    except OSError as error:
        problem = f"the run's folder {folder} cannot be used ({error.strerror})"
        raise UserError(f"{problem}; choose another with hydra.run.dir=FOLDER") from error
