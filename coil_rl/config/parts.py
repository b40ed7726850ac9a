"""The parts that a configuration describes: its envs, guides, learner and evaluation.

Proxies are networks that imitate guides without parameters, for methods that train their guides. A
proxy is the policy of an imitation run. The configuration of that run follows from the guide, the
env and the key `proxy`; its hash is part of the folder name, so that a proxy is trained once. For
objects and code of a user, which the configuration only names, there is a second hash. A run copies
its proxies into its own folder.
"""

import hashlib
import math
import re
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import get_object
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, Transform, TransformedEnv

from coil_rl.config.nodes import (
    build,
    build_all,
    code_of_run,
    find_target,
    identity_of,
    kept_objects,
)
from coil_rl.config.schema import TrainConfig, fingerprint
from coil_rl.errors import UserError
from coil_rl.files import temporary, whole_file
from coil_rl.foreign.guard import hold
from coil_rl.foreign.gymnasium_env import NOT_OBSERVED, GymnasiumEnv
from coil_rl.guides import ControllerGuide
from coil_rl.learners.learner import Learner
from coil_rl.measures import MEAN_CASE, measures_of
from coil_rl.plain_yaml import entries
from coil_rl.report import Returns
from coil_rl.report.pictures import Picture
from coil_rl.run.beside import Beside
from coil_rl.run.judge import Evaluation
from coil_rl.run.parts import TEST, TESTS, TRAIN, EnvMaker
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.normalised_action import in_unit_of

if TYPE_CHECKING:
    from coil_rl.run.run import Run

# Parts of a configuration that name entries of the env of a method; its guides are parts of
# `method.transforms`.
READERS = ["observes", "method", "watch", "learner", "degrade", "action", "evaluation"]
PROXIES = "proxies"  # subfolder of a run with the networks that replace guides without parameters
FILES = ("config.yaml", "policy_last.pt")  # files of a run that are needed to load its policy


def build_evaluation(
    config: DictConfig, record: Mapping[str, NestedKey] | None = None
) -> Evaluation:
    """Return the cases and measures of a configuration.

    `record` names entries of every step that are kept.

    Raises:
        UserError: if the configuration names no cases, or one like the row of their means.
    """
    cases = config.evaluation.cases
    names = build(cases, "evaluation.cases") if isinstance(cases, DictConfig) else cases
    if isinstance(names, int):
        names = list(range(names))
    if not isinstance(names, (list, tuple, ListConfig)) or not names:
        raise UserError(f"evaluation.cases={cases} must be at least 1, or the names of the cases")
    titles = list(map(str, names))
    if MEAN_CASE in titles:
        raise UserError(
            f"evaluation.cases: a case cannot be called {MEAN_CASE}, which names the means of all "
            "cases in evaluation.csv; give it another name"
        )
    return Evaluation(titles, measures_of(config.evaluation.measures), record or {})


def build_pictures(config: DictConfig) -> list[Picture]:
    """Return the pictures of a configuration; without any, the returns."""
    nodes = config.evaluation.pictures.items()
    pictures = [build(node, f"evaluation.pictures.{name}") for name, node in nodes if node]
    return pictures or [Returns()]


def build_beside(config: DictConfig) -> list[Beside]:
    """Return what makes the further drivers of the evaluation table."""
    nodes = config.evaluation.beside.items()
    return [build(node, f"evaluation.beside.{name}", Beside) for name, node in nodes]


def recorded(pictures: list[Picture]) -> dict[str, NestedKey]:
    """Return the entries that pictures need, by name."""
    entries: dict[str, NestedKey] = {}
    for picture in pictures:
        entries |= picture.record
    return entries


def advises(config: DictConfig) -> bool:
    """Return whether a method adds the advice of guides to the env."""
    return GuideActions in _added(config)


def advises_only(config: DictConfig) -> bool:
    """Return whether all that a method adds to the env of its guides is their advice."""
    return _added(config) == {GuideActions} and not config.degrade and not config.action


def _added(config: DictConfig) -> set[Any]:
    """Return the classes of the transforms of a method."""
    return {get_object(node["_target_"]) for node in config.method.transforms.values()}


def env_maker(config: DictConfig) -> EnvMaker:
    """Return the maker of the envs of a configuration, whose run may have found numbers of a guide.

    Args:
        config: of `coil-train`, composed or read from a folder.
    """
    seconds: dict[str, float | None] = {}  # of a step of its envs

    def made(
        rows: int | None, cases: str, count: int | None, without: Collection[str] = ()
    ) -> EnvBase:
        env = build_bare_env(config, cases_node(config, rows, cases, count), without)
        if isinstance(env, GymnasiumEnv):
            env.seconds = seconds
        return env

    def transforms(advice: str) -> list[Transform]:
        own = own_run(config)
        found = config if own is None else own.found(config, Path(config.run_dir))
        return build_transforms(found, advice)

    def of_agent(rows: int | None, cases: str, count: int | None) -> EnvBase:
        return made(rows, cases, count, unread_controllers(config))

    def alone(rows: int | None, cases: str, count: int | None) -> EnvBase:
        return made(rows, cases, count, OmegaConf.select(config, "env.controllers") or ())

    curve = config.evaluation.curve
    return EnvMaker(
        made,
        of_agent=of_agent,
        alone=alone,
        disturb=lambda cases: build_all(disturbances(config, cases), "disturb"),
        transforms=transforms,
        guides=lambda: build_nodes_of_guides(driving_guides(config)),
        degrade=partial(build_all, config.degrade, "degrade"),
        sizes={str(cases): curve.num_envs for cases in curve.cases},
    )


def cases_node(
    config: DictConfig, rows: int | None, cases: str, count: int | None
) -> dict[str, Any]:
    """Return the overrides of `env` for a set of cases.

    Args:
        config: with `env`, `training` and `evaluation`.
        rows: number of rows; None for that of the training.
        cases: name of the set: TRAIN, TESTS, TEST, or one of `evaluation.curve.cases`.
        count: number of different cases, instead of that of the set.
    """
    own = {} if rows is None else {"num_envs": rows}
    if cases == TRAIN:
        return {**config.training.env, **own}
    if cases == TESTS:
        return {**config.training.env, **config.training.tests, **own}
    if cases == TEST:
        number = {} if count is None else {"cases": count}
        return {**config.evaluation.env, **number, **own}
    curve = config.evaluation.curve
    number = {curve.count_key: count or curve.num_envs}
    return {**curve.env, **number, **curve.cases[cases], **own}


def build_bare_env(
    config: DictConfig,
    overrides: Mapping[str, Any] | None = None,
    without: Collection[str] = (),
) -> EnvBase:
    """Return the env of a configuration without transforms, and `without` some controllers."""
    node = env_node(config, overrides)
    if without:
        beside = node["controllers"].items()
        node["controllers"] = {name: thing for name, thing in beside if name not in without}
    env: EnvBase = build(node, "env", EnvBase)
    return env


def env_node(config: DictConfig, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the node `env` with overrides and all references resolved."""
    overrides = overrides or {}
    if "_target_" in overrides:  # another env, such as that of the test of a policy
        return {key: _resolved(value) for key, value in overrides.items()}
    with open_dict(config):  # `build` checks the keys
        node = OmegaConf.merge(config.env, dict(overrides))
        for key, value in overrides.items():
            # The arguments of another target replace those of the first one.
            if isinstance(value, (Mapping, DictConfig)) and "_target_" in value:
                OmegaConf.update(node, key, value, merge=False)
    return dict(_resolved(node))


def _resolved(value: Any) -> Any:
    """Return a value of a configuration with all references resolved."""
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def disturbances(config: DictConfig, cases: str) -> dict[str, Any]:
    """Return the nodes of the delays and noise of the env in a set of cases, by name.

    They are `disturb` with the overrides of the training or of the evaluation; null leaves one out.
    """
    part = config.training if cases in (TRAIN, TESTS) else config.evaluation
    with open_dict(config):  # `build` checks the keys
        merged = OmegaConf.merge(config.disturb, part.disturb)
    nodes: Any = OmegaConf.to_container(merged, resolve=True)
    return {name: node for name, node in nodes.items() if node is not None}


def build_transforms(config: DictConfig, advice: str = "") -> list[Transform]:
    """Return the transforms of an env.

    They are those of the method, `degrade` if they have advice, `advice`, `action` and network.
    """
    transforms = build_all(config.method.transforms, "method.transforms")
    if any(isinstance(part, GuideActions) for part in transforms):
        transforms += build_all(config.degrade, "degrade")
    if advice:
        node = config.evaluation.advice[advice]
        transforms.append(build(node, f"evaluation.advice.{advice}", Transform))
    if config.action:
        transforms.append(build(config.action, "action", Transform))
    network = OmegaConf.select(config, "learner.network")
    if network:  # one with a memory needs an env that carries it
        transforms += getattr(build(network, "learner.network"), "env_transforms", list)()
    return transforms


def build_learner(
    config: DictConfig, env: EnvBase, guides: Mapping[str, TensorDictModuleBase] | None = None
) -> Learner:
    """Return the learner of a configuration for an env.

    It observes the entries `observes` and `method.observes`.

    `guides` are for a learner that trains guides.
    """
    arguments: dict[str, Any] = {"guides": dict(guides or {})} if trains_guides(config) else {}
    keys = observed_keys(config, env)
    learner: Learner = build(config.learner, "learner", Learner, env=env, in_keys=keys, **arguments)
    return learner


def observed_keys(config: DictConfig, env: EnvBase) -> list[NestedKey]:
    """Return the keys of the entries that the agent of a configuration observes in an env.

    Of `observes=null` they are all that the env itself writes, but for what is no observation.
    """
    own = config.observes
    if own is None:
        base = env.base_env if isinstance(env, TransformedEnv) else env
        own = [
            key
            for key in base.observation_spec.keys(True, True)
            if isinstance(key, str) or key[0] not in NOT_OBSERVED
        ]
    return [nested_key(key) for key in (*own, *(config.method.observes or ()))]


def learner_kind(config: DictConfig) -> str:
    """Return the attribute `kind` of the learner class: `agent`, `imitation` or `guides`.

    It is `none` for a method that has no learner.
    """
    if config.method.learner == "none":
        return "none"
    target = find_target(config.learner.get("_target_"), "learner")
    if isinstance(target, type) and issubclass(target, Learner):
        return target.kind
    return "agent"


def trains_guides(config: DictConfig) -> bool:
    """Return whether the learner of a configuration trains guides besides the agent."""
    return config.method.observes is not None and learner_kind(config) == "guides"


def of_guides(config: DictConfig, attribute: str) -> dict[str, Any]:
    """Return the value of an attribute of each guide whose class sets it, by the guide's name.

    Args:
        attribute: `sees`, what a guide may know more than an agent; or `demonstrates`, for one
            whose actions were recorded, which has no advice in the env in which a policy is tested.
    """
    found = {}
    for name, node in config.guide.items():
        value = getattr(find_target(node.get("_target_"), f"guide.{name}"), attribute, None)
        if value:
            found[str(name)] = value
    return found


def build_guides(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """Return the guides of a configuration by name.

    Errors are those of `build`, also for no guide, or one without a name.
    """
    if "_target_" in config.guide:
        raise UserError(
            "guide: a guide needs a name, because there may be several: begin its file with "
            "# @package guide.NAME, or give +guide.NAME._target_"
        )
    if not config.guide:
        raise UserError(
            f"guide: there is none, but method={config.method.name} needs one; give guide=NAME, or "
            "method=ppo"
        )
    return build_nodes_of_guides(config.guide)


def build_nodes_of_guides(nodes: Mapping[str, Any]) -> dict[str, TensorDictModuleBase]:
    """Return guides by name."""
    guides = {}
    for name, node in nodes.items():
        guides[str(name)] = hold(build(node, f"guide.{name}", TensorDictModuleBase))
    return guides


def driving_guides(config: DictConfig) -> dict[str, Any]:
    """Return the nodes of the guides that can drive, by name."""
    if "_target_" in config.guide:  # `build_guides` says what is wrong
        return {}
    nodes: Any = OmegaConf.to_container(config.guide, resolve=True)
    left_out = of_guides(config, "demonstrates")
    return {name: node for name, node in nodes.items() if name not in left_out}


def unread_controllers(config: DictConfig) -> set[str]:
    """Return the names of the controllers beside an env that its agent does without.

    They are those that neither a transform reads nor any part of the configuration names: the
    observation, the method, what is logged, measures and pictures.
    """
    names = set(OmegaConf.select(config, "env.controllers") or ())
    if not names:
        return names
    kinds = ("", *config.evaluation.advice)
    transforms = [part for advice in kinds for part in build_transforms(config, advice)]
    keys = [key for part in transforms for key in (part.in_keys or ())]
    named = {part for key in keys for part in ((key,) if isinstance(key, str) else key)}
    read = OmegaConf.to_container(OmegaConf.masked_copy(config, READERS))
    named |= {value for _, _, value in entries(read, lists=True) if isinstance(value, str)}
    return {name for name in names if not any(_mentions(text, name) for text in named)}


def _mentions(text: str, name: str) -> bool:
    """Return whether a text has a name as a whole word."""
    return re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) is not None


class OwnRun(ABC):
    """How a method does its run without a learner; `method.learner` is then "none"."""

    @abstractmethod
    def check(self, config: DictConfig) -> None:
        """Raise a `UserError` for a configuration that this run cannot have."""

    @abstractmethod
    def maker(self, config: DictConfig) -> "Callable[..., Run]":
        """Return a function that makes the run; it takes the arguments of `Run`."""

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


def guides_without_parameters(guides: Mapping[str, nn.Module]) -> list[str]:
    """Return the names of the guides without parameters."""
    return [name for name, guide in guides.items() if not any(True for _ in guide.parameters())]


def proxy_config(config: DictConfig, name: str) -> DictConfig:
    """Return the configuration of the run that trains the proxy of one guide of a training run.

    The env is that of the training run, with its delays and noise. The key `proxy` must describe a
    network.
    """
    if config.proxy is None or config.proxy.method.observes is None:
        raise UserError("proxy.method.observes: a proxy needs observations; give proxy=network")
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    guide, proxy = {name: resolved["guide"][name]}, resolved["proxy"]
    values = {
        **{key: resolved[key] for key in ("preset", "track", "observes", "device", "threads")},
        **{key: proxy[key] for key in ("method", "learner", "budget", "seed")},
        "env": resolved["env"] | resolved["training"]["imitation_env"] | proxy["env"],
        "disturb": _drawn_anew(resolved["disturb"], proxy["seed"]),
        "training": {"disturb": _drawn_anew(resolved["training"]["disturb"], proxy["seed"])},
        "guide": guide,
        "label": f"proxy of {name}",
        "evaluation": {key: resolved["evaluation"][key] for key in ("cases", "measures", "env")}
        | {"disturb": _drawn_anew(resolved["evaluation"]["disturb"], proxy["seed"]), "gif": False},
        "existing": "resume",
    }
    merged: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), values)
    OmegaConf.update(merged, "method.transforms.advice.guides", guide, merge=False, force_add=True)
    parts = [name, fingerprint(merged), *_hash_of_user(merged, name)]
    merged.run_dir = f"{proxy['folder']}/{'_'.join(parts)}"
    return merged


def _drawn_anew(nodes: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return the nodes of disturbances with another seed, so that runs share their proxies."""
    has_seed = [
        name for name, node in nodes.items() if isinstance(node, Mapping) and "seed" in node
    ]
    return {**nodes, **{name: {**nodes[name], "seed": seed} for name in has_seed}}


def _hash_of_user(config: DictConfig, name: str) -> list[str]:
    """Return one hash of a user's code and objects in a guide and an env; empty without any."""
    guide = config.guide[name]
    things = kept_objects(config, "env")
    if find_target(guide.get("_target_"), f"guide.{name}") is ControllerGuide:
        things += kept_objects(config, "guide")
    found = [*map(identity_of, things), *code_of_run(config).values()]
    if not found:
        return []
    return [hashlib.sha256(" ".join(found).encode()).hexdigest()[:10]]


def distil(config: DictConfig, folder: Path, run: Callable[[DictConfig], float]) -> int:
    """Put a proxy of each guide without parameters into the folder of a run, unless it is there.

    Args:
        run: does the run of a proxy, or finishes it.

    Returns:
        The frames that the proxies took, now or earlier. Their last batch is a whole one.
    """
    names = guides_without_parameters(build_guides(config))
    proxies = {name: proxy_config(config, name) for name in names}
    if not (folder / PROXIES).is_dir():
        for proxy in proxies.values():
            run(proxy)
        copy_proxies({name: Path(proxy.run_dir) for name, proxy in proxies.items()}, folder)
    return frames_of_proxies(config, names)


def frames_of_proxies(config: DictConfig, guides: Iterable[str]) -> int:
    """Return the frames that the proxies of the guides of a run take.

    Args:
        guides: names of the guides that get a proxy.
    """
    return sum(frames_of(config.proxy.budget) for _ in guides)


def frames_of(budget: DictConfig) -> int:
    """Return the frames that a training without tests takes: whole batches.

    Args:
        budget: of the training, with `frames`, `num_envs` and `steps`.
    """
    batch = int(budget.num_envs) * int(budget.steps)
    return math.ceil(budget.frames / batch) * batch


def copy_proxies(runs: Mapping[str, Path], folder: Path) -> None:
    """Copy proxies into the folder of the run that uses them, all at once.

    `runs` are their run folders by the name of the guide. A file in their place is a `UserError`.
    """
    proxies = folder / PROXIES
    if proxies.is_file():
        raise UserError(f"{proxies} is a file, but a folder is to be made there; remove it")
    unfinished = temporary(proxies)
    try:
        unfinished.mkdir(parents=True, exist_ok=True)  # guides with parameters need no proxy
        for name, run in runs.items():
            for file in FILES:
                with whole_file(unfinished / name / file) as copy:
                    shutil.copyfile(run / file, copy)
        unfinished.rename(proxies)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def guides_with_untrained_proxies(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """Return the guides of a configuration.

    A guide without parameters is replaced by an untrained proxy.
    """
    guides = build_guides(config)
    for name in guides_without_parameters(guides):
        proxy = proxy_config(config, name)
        env = env_maker(proxy)()
        guides[name] = in_unit_of(env, build_learner(proxy, env).policy)
    return guides
