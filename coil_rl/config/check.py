"""Check of a configuration before a run starts: ranges, and one small build of every part.

A mistake is found in seconds.
"""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.config import parts
from coil_rl.config.fits import (
    check_entry,
    check_guide_in_env,
    check_measures,
    check_number,
)
from coil_rl.config.folder import run_folder
from coil_rl.config.nodes import build, build_all, check_node
from coil_rl.config.own_run import own_run
from coil_rl.config.passive import check_passive, passive
from coil_rl.config.proxies import (
    frames_of_proxies,
    guides_with_untrained_proxies,
    guides_without_parameters,
    proxy_config,
)
from coil_rl.config.schema import TrainConfig
from coil_rl.config.trust import check_logger
from coil_rl.config.values import check_values
from coil_rl.errors import UserError, did_you_mean
from coil_rl.learners.learner import Learner
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.run import checkpoint
from coil_rl.run.folder import HANDED_OVER, weights_file
from coil_rl.run.parts import SOME_ROWS, TEST, TRAIN, EnvMaker, transformed, try_out
from coil_rl.run.training import INIT
from coil_rl.transforms.action_space import nested_key

# Kind of a learner: description and example.
KINDS = {
    "agent": ("learns from reward", "ppo"),
    "imitation": ("imitates a guide", "forest"),
    "guides": ("improves its guides", "dynamic_coil"),
}
WATCHED = ("episode", "step")  # groups of `watch`


def check(config: DictConfig) -> None:
    """Check the configuration of a program that acts or trains; nothing is written.

    Raises:
        UserError: for the first mistake.
    """
    check_values(config)
    trains = OmegaConf.get_type(config) is TrainConfig
    has_agent = trains and config.method.observes is not None
    if has_agent:
        _check_kind(config)
    if trains:
        _check_own_run(config)
        _check_delivery(config, has_agent=has_agent)
    make_env = parts.env_maker(config)
    cases = len(parts.build_evaluation(config).cases)
    if trains:
        check_passive(config, make_env)
    if trains or OmegaConf.select(config, "run") is None:  # an evaluated run has its own env
        recorded = parts.recorded(parts.build_pictures(config))
        _check_env(config, make_env, cases, recorded.values())
    build_all(config.evaluation.advice, "evaluation.advice")
    if has_agent:
        _check_label(config.label)
        _check_training(config, make_env)
        if config.method.transforms:
            for advice in config.evaluation.advice:
                _check_cases(cases, partial(make_env, cases, TEST, advice))


def _check_kind(config: DictConfig) -> None:
    """Raise a `UserError` if the learner is of another kind than the method needs.

    The same if it is given arguments that it does not take: to make an env first may take long.
    """
    kind, needed = parts.learner_kind(config), config.method.learner
    if kind != needed:
        purpose, example = KINDS[needed]
        learner = config.learner["_target_"].rpartition(".")[2]
        raise UserError(
            f"method={config.method.name} needs a learner that {purpose}, such as "
            f"learner={example}, but {learner} is one that {KINDS[kind][0]}"
        )
    node: Any = OmegaConf.to_container(config.learner, resolve=True, throw_on_missing=True)
    check_node({**node, "_partial_": True}, "learner")  # the program adds the others


def _check_own_run(config: DictConfig) -> None:
    """Raise a `UserError` for what the own run of a method cannot do, or for `tune` without one."""
    own = own_run(config)
    if own is not None:
        own.check(config)
    elif config.tune:
        raise UserError(
            f"tune has no effect: method={config.method.name} does not tune its guide; give "
            "method=tune, or leave tune out"
        )


def _check_delivery(config: DictConfig, *, has_agent: bool) -> None:
    """Raise a `UserError` if a run would evaluate another policy than it hands over.

    So it is for values that need a policy, where none is trained.
    """
    trains_policy = has_agent and not config.method.run
    beside = config.evaluation.beside
    for word, without_policy in (
        (f"beside={','.join(beside)}", beside and not trains_policy),
        (f"init={config.init}", config.init and not trains_policy),
        ("delivery=tested", config.delivery == "tested" and not has_agent),
    ):
        if without_policy:
            raise UserError(
                f"{word} has no effect: method={config.method.name} trains no policy; leave it out"
            )
    if has_agent and config.evaluation.policy != HANDED_OVER:
        raise UserError(
            f"evaluation.policy={config.evaluation.policy}: a training evaluates what it hands "
            "over; give delivery=tested or delivery=last, or evaluate another policy afterwards: "
            f"coil-evaluate run=FOLDER evaluation.policy={config.evaluation.policy}"
        )


def _check_label(label: str) -> None:
    if not label or label.split()[:1] == ["guide"] or "/" in label:
        raise UserError(
            f"label={label} cannot be used: it must not be empty, begin with guide or contain /"
        )


def _check_env(
    config: DictConfig, make_env: EnvMaker, cases: int, recorded: Iterable[NestedKey]
) -> None:
    """Check the env, what is measured in it, and that its guides can act."""
    if "num_envs" not in config.env:
        raise UserError(
            f"env: {config.env.get('_target_', 'it')} has no key num_envs, so no policy can act in "
            "it; choose another env"
        )
    check_node(config.env, "env")
    env = make_env.bare(SOME_ROWS, TEST, None)
    check_measures(config.evaluation.measures, env)
    for key in recorded:
        check_entry(env, key, "evaluation.pictures")
    guides = _check_guides(config, make_env, cases, env)
    try_out(env, guides)


def _check_guides(
    config: DictConfig, make_env: EnvMaker, cases: int, env: EnvBase
) -> dict[str, TensorDictModuleBase]:
    """Check that the guides can act in the env, and return them."""
    advises = config.method.needs_guide or "advice" in config.method.transforms
    if not config.guide and not advises:
        if config.degrade:
            raise UserError(
                f"degrade=[{','.join(map(str, config.degrade))}] has no effect, because there is "
                "no guide whose advice could be degraded; leave it out, or give guide=NAME"
            )
        return {}
    guides = parts.build_guides(config)
    demonstrations = parts.of_guides(config, "demonstrates")
    for name, guide in guides.items():
        its_env = make_env.bare(1, TRAIN, None) if name in demonstrations else env
        check_guide_in_env(guide, its_env, f"guide.{name}")
    build_all(config.degrade, "degrade")
    if parts.build_disturbances(config, TEST):
        transformed(env, make_env.disturb(TEST), "disturb")
    if config.degrade:
        _check_cases(cases, partial(make_env.guided, cases, TEST, guides))
    return guides


def _check_cases(cases: int, make: Callable[[], Any]) -> None:
    """Make the env of an evaluation: some ways to degrade advice need several rows."""
    try:
        make()
    except UserError as error:
        raise UserError(
            f"each case of the evaluation has one row, {cases} in all: {error}"
        ) from error


def _check_training(config: DictConfig, make_env: EnvMaker) -> None:
    if config.method.run:
        _check_curve(config, make_env)
        make_env()
        return
    env = make_env()
    if not parts.observed_keys(config, env):
        raise UserError(
            "observes=[]: the agent has no observations; give the entries of the env that it "
            "observes, or null for all"
        )
    trains = parts.trains_guides(config)
    if trains and config.degrade:
        raise UserError(
            f"degrade={list(config.degrade)} has no effect on guides that are trained; leave it out"
        )
    guides = parts.build_guides(config) if trains else {}
    replaced = guides_without_parameters(guides)
    check_proxies(config, replaced)
    _check_frames_of_proxies(config, replaced)
    untrained = guides_with_untrained_proxies(config) if guides else None
    learner = parts.build_learner(config, env, untrained)
    for each in parts.build_beside(config):
        each.check(make_env, learner, Path(config.run_dir))
    _check_init(config, learner)
    _check_batch(config, learner)
    _check_validation(config, learner)
    _check_curve(config, make_env)
    if config.logger:
        check_logger(check_node(config.logger, "logger"))
    _check_watch(config, env)


def _check_init(config: DictConfig, learner: Learner) -> None:
    """Raise a `UserError` if the run begins with the policy of another one that does not fit."""
    if not config.init or (Path(config.run_dir) / INIT).exists():  # it has begun already
        return
    path = weights_file(run_folder(config.init))
    state = checkpoint.load(path)
    try:
        learner.policy.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(
            f"init={config.init}: its policy does not fit this run; give the method, the entries "
            f"that it observes and the network of {path.parent / 'config.yaml'}"
        ) from error


def _check_batch(config: DictConfig, learner: Learner) -> None:
    """Raise a `UserError` if batches are too small, or the run ends before learning starts."""
    rows, steps, frames = config.budget.num_envs, config.budget.steps, config.budget.frames
    try:
        learner.check_batch(rows, steps)
    except ValueError as error:
        raise UserError(
            f"learner.{error}; a batch has budget.num_envs x budget.steps = {rows} x {steps} frames"
        ) from error
    starts = learner.starts if isinstance(learner, OffPolicy) else 0
    if frames <= starts:
        raise UserError(
            f"budget.frames={frames} ends before learning starts, after learner.starts={starts} "
            f"stored steps; give more frames, or a learner.starts such as {frames // 4}"
        )


def _check_validation(config: DictConfig, learner: Learner) -> None:
    """Raise a `UserError` if tracks are to be left out to validate, and there is only one."""
    if not config.track or not learner.validates_groups:
        return
    kind = passive(config)
    if kind is not None:
        if kind.whole_pass(config.env)[0] == 1:
            raise UserError(
                "there is one episode, which cannot be left out to validate; give several, or set "
                "learner.group_key=null"
            )
        return
    if len(build(config.track.train, "track.train")) == 1:
        raise UserError(
            "track.train gives one track, which cannot be left out to validate; set "
            "learner.group_key=null, or learner.validate=false"
        )


def _check_curve(config: DictConfig, make_env: EnvMaker) -> None:
    cases = list(config.evaluation.curve.cases)
    if not cases:
        return
    if set(cases) != {EVALUATION, SELECTION}:
        raise UserError(
            f"evaluation.curve.cases has {', '.join(cases)}; give {EVALUATION} and {SELECTION}, or "
            "none"
        )
    for name in cases:
        make_env(make_env.sizes[name], name)


def _check_watch(config: DictConfig, env: EnvBase) -> None:
    for group, keys in config.watch.items():
        if group not in WATCHED:
            raise UserError(
                f"there is no key watch.{group}; watch has episode, step"
                f"{did_you_mean(group, WATCHED)}"
            )
        for name, key in keys.items():
            if not isinstance(key, ListConfig):
                raise UserError(f"watch.{group}.{name}={key} must be a list, such as [info, lap]")
            check_number(env, nested_key(key), f"watch.{group}.{name}")


def check_proxies(config: DictConfig, guides: Iterable[str]) -> None:
    """Raise a `UserError` for the first mistake in the training of the proxies of guides."""
    for name in guides:
        try:
            check(proxy_config(config, name))
        except UserError as error:
            raise UserError(f"proxy of guide.{name}: {error}") from error


def _check_frames_of_proxies(config: DictConfig, guides: Iterable[str]) -> None:
    """Raise a `UserError` if the proxies of guides take all frames of a run."""
    taken, budget = frames_of_proxies(config, guides), config.budget
    if taken >= budget.frames:
        raise UserError(
            f"budget.frames={budget.frames} leaves nothing to the run, as the proxies of its "
            f"guides take {taken} frames; give at least "
            f"{taken + budget.num_envs * budget.steps}, or a smaller proxy.budget.frames"
        )
