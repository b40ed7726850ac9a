"""Check of a configuration before a run starts: ranges, and one small build of every part.

A mistake is found in seconds. So is a word of the command line that nothing reads: it would have
no effect, and is refused. Some nodes are read by some runs only, or only where another value refers
to them.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.config import parts
from coil_rl.config.compose import REFERENCE, check_values, covers, key_of
from coil_rl.config.folder import run_folder
from coil_rl.config.nodes import build, build_all, check_node
from coil_rl.config.schema import TrainConfig, passive
from coil_rl.errors import UserError, did_you_mean
from coil_rl.extras import require
from coil_rl.foreign.batch import optional_entries
from coil_rl.foreign.faults import ForeignError
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.learner import Learner
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.measures import measures_of
from coil_rl.output import say
from coil_rl.plain_yaml import is_part, leaves
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.run import checkpoint
from coil_rl.run.experiment import INIT
from coil_rl.run.folder import HANDED_OVER, weights_file
from coil_rl.run.parts import SOME_ROWS, TEST, TRAIN, EnvMaker, transformed, try_out
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import nested_key, written_key

# Kind of a learner: description and example.
KINDS = {
    "agent": ("learns from reward", "ppo"),
    "imitation": ("imitates a guide", "forest"),
    "guides": ("improves its guides", "dynamic_coil"),
}
WATCHED = ("episode", "step")  # groups of `watch`
EPISODE_REWARD = "episode_reward"  # written by a transform of every env
# Nodes that other values refer to, and that nothing else reads; and a fact about the method, which
# is no choice.
REFERRED = (
    "preset",
    "track",
    "recording",
    "training.learning_rate",
    "training.imitation_env",
    "budget.minibatches",
    "method.needs_guide",
)
NOISE = "training.noise_correlation"
OF_A_LEARNER = (
    *("learner", "network", "checkpoint_every", "evaluation.repeats"),
    *("budget.num_envs", "budget.steps", "training.normalise", "training.scale_rewards"),
)
OF_A_TRAINING = (
    *("training", "budget", "logger", "watch", "observes", "action", "compile"),
    *("evaluation.curve", "evaluation.guides", "evaluation.policy"),
)
# The packages of TorchRL's loggers, which are extras of this one.
PACKAGES = {
    "MLFlowLogger": "mlflow",
    "TensorboardLogger": "tensorboard",
    "TrackioLogger": "trackio",
    "WandbLogger": "wandb",
}


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
    own = parts.own_run(config)
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
    if parts.disturbances(config, TEST):
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
    replaced = parts.guides_without_parameters(guides)
    check_proxies(config, replaced)
    _check_frames_of_proxies(config, replaced)
    untrained = parts.guides_with_untrained_proxies(config) if guides else None
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
        groups = kind.whole_pass(config.env)[0]
    else:
        groups = len(build(config.track.train, "track.train"))
    if groups == 1:
        raise UserError(
            "there is one track or episode, which cannot be left out to validate; give several, or "
            "set learner.group_key=null"
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
            check(parts.proxy_config(config, name))
        except UserError as error:
            raise UserError(f"proxy of guide.{name}: {error}") from error


def _check_frames_of_proxies(config: DictConfig, guides: Iterable[str]) -> None:
    """Raise a `UserError` if the proxies of guides take all frames of a run."""
    taken, budget = parts.frames_of_proxies(config, guides), config.budget
    if taken >= budget.frames:
        raise UserError(
            f"budget.frames={budget.frames} leaves nothing to the run, as the proxies of its "
            f"guides take {taken} frames; give at least "
            f"{taken + budget.num_envs * budget.steps}, or a smaller proxy.budget.frames"
        )


def check_passive(config: DictConfig, make_env: EnvMaker) -> None:
    """Check a training in an env that does not react, and print what there is to learn from.

    Raises:
        UserError: for a method that needs the effect of its actions, for a budget that does not
            reach all steps, and if nothing can be learned.
    """
    kind = passive(config)
    if kind is None:
        return
    env: Any = make_env.bare(None, TRAIN, None)  # first, because it says if there are no data
    explores = False
    for node in config.method.transforms.values():
        probability = OmegaConf.select(node, "probability")
        explores = explores or (probability is not None and probability != 1.0)
    if config.method.learner != "imitation" or explores:
        raise UserError(
            f"{kind.__name__} does not react to actions, so method={config.method.name} cannot "
            "learn there; imitate what it shows with method=oil, and go on from there in an env "
            "that reacts: method=dagger env=ENV learner.dataset=FOLDER/dataset.pt"
        )
    _check_pass(config, env, kind.whole_pass(config.env)[0])
    try:
        for line in env.demonstrations():
            say(line)
    except ValueError as error:
        raise UserError(f"env: {error}") from error


def _check_pass(config: DictConfig, env: Any, episodes: int) -> None:
    """Raise a `UserError` for a training that ends before all steps of all episodes were seen."""
    rows, longest = env.batch_size[0], int(env.length.max())
    if rows < episodes:
        raise UserError(
            f"env.num_envs={rows} leaves out episodes, of which there are {episodes}; leave "
            f"budget.num_envs and env.num_envs out, or give at least {episodes}"
        )
    steps = config.budget.steps
    seen = math.ceil(config.budget.frames / (rows * steps)) * steps
    if seen < longest:
        raise UserError(
            f"budget.frames={config.budget.frames} is {seen} steps of each episode, and the "
            f"longest has {longest}, so the others would be left out; leave budget.frames "
            f"out, or give at least {rows * longest}"
        )


def check_measures(measures: Any, env: EnvBase) -> None:
    """Raise a `UserError` for a measure of an entry that is missing or not one number per row.

    So it is for a `where` that is neither true or false in each row nor a number of Gymnasium's
    info.

    Args:
        measures: nodes by name.
    """
    for name, measure in measures_of(measures).items():
        place = f"evaluation.measures.{name}"
        check_number(env, nested_key(measure.entry), place)
        if measure.where is not None:
            _check_flag(env, nested_key(measure.where), place)


def check_number(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an entry does not have exactly one number per row, or per agent."""
    groups = check_entry(env, key, name)
    rewards = [env.full_reward_spec[each].shape for each in env.reward_keys]
    for group in groups:
        spec = group[key]
        parent = group[key[:-1]] if isinstance(key, tuple) and len(key) > 1 else group
        shape = spec.shape[len(parent.shape) :]
        is_one = shape.numel() == 1 or spec.shape in rewards  # of each agent, for some envs
        if isinstance(spec, Composite) or spec.dtype is None or not is_one:
            numbers = f"{shape.numel()} numbers" if shape.numel() > 1 else "no number"
            raise UserError(
                f"{name}={dotted(key)} has {numbers} a row, and one is needed; name an entry of "
                "one number, or let the env write one"
            )


def _check_flag(env: EnvBase, key: NestedKey, name: str) -> None:
    """Raise a `UserError` if an entry is not a flag with one value per row.

    It is a boolean, or a number of Gymnasium's info, where flags are numbers too.
    """
    found = [group[key] for group in check_entry(env, key, name)]
    rows = env.batch_size.numel()
    of_info = key in optional_entries(env)
    if not any(
        (of_info or spec.dtype == torch.bool) and spec.shape.numel() == rows for spec in found
    ):
        raise UserError(
            f"{name}.where={dotted(key)} must be a flag, true or false once a row, or a number of "
            "Gymnasium's info (env.info); name another entry, or leave it out"
        )


def check_entry(env: EnvBase, key: NestedKey, name: str) -> list[Composite]:
    """Return the specs of what an env writes in a step that have an entry.

    There is none for the sum of rewards.

    Args:
        name: the key that names the entry, for the message.

    Raises:
        UserError: if the env does not write it.
    """
    groups = [env.observation_spec, env.full_reward_spec, env.full_done_spec]
    known = {EPISODE_REWARD, *(dotted(each) for group in groups for each in group.keys(True))}
    given = dotted(key)
    if given not in known:
        raise UserError(
            f"{name}={given} is no entry of the env; it has {', '.join(sorted(known))}"
            f"{did_you_mean(given, known)}"
        )
    return [group for group in groups if key in group.keys(True)]


def check_guide_in_env(guide: TensorDictModuleBase, env: EnvBase, name: str) -> None:
    """Check that a guide can act in an env.

    Args:
        env: of any number of rows; it is stepped once.
        name: key of the guide, for the message.

    Raises:
        UserError: if the env lacks an entry that the guide reads, or its action does not fit.
    """
    try:
        transform = GuideActions({name.rpartition(".")[2]: guide})
        memory = (key for each in transform.guides.memories.values() for key in each.specs)
        known = [*env.observation_spec.keys(True), *transform.supplied, *memory]
        for key in guide.in_keys:
            if key not in known:
                has = ", ".join(map(written_key, env.observation_spec.keys(True, True)))
                remedy = getattr(guide, "remedy", "")  # what gives the entry that it reads
                raise UserError(
                    f"{name}: it reads {dotted(key)}, but the env has only {has}"
                    f"{remedy and '; '}{remedy}"
                )
        advised = TransformedEnv(env, transform)
        advised.step(FollowAdvice(advised)(advised.reset()))
        advised.state_dict()  # a state that no checkpoint can hold is refused before the training
    except ForeignError as error:  # its sentence says whether the env or the guide is at fault
        raise UserError(str(error)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0] if error.args else error}") from error
    except RuntimeError as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{name}: it cannot act on the observations of this env ({first})"
        ) from error


def dotted(key: str | Iterable[Any]) -> str:
    """Return the name of an entry as in a configuration, such as "info.lap".

    Args:
        key: of the entry, perhaps nested.
    """
    return key if isinstance(key, str) else ".".join(map(str, key))


def check_read(config: DictConfig, task: Iterable[str]) -> None:
    """Refuse a word of the command line that a run does not read.

    Raises:
        UserError: for the first word without an effect.
    """
    for sentence in unread(config, task):
        raise UserError(sentence)


def unread(config: DictConfig, task: Iterable[str]) -> Iterator[str]:
    """Yield a sentence for each word of the command line that a run does not read."""
    closed = [*_unread_nodes(config)]
    references = set(_references(config, closed))
    for text in task:
        key = key_of(text)
        is_read = not is_part(key, (*closed, *REFERRED))
        if key == NOISE:
            is_read = is_read and _adds_noise(config)
        if not is_read and not any(covers(key, other) for other in references):
            yield (
                f"{text} has no effect: nothing in this run reads {key} "
                f"(method={config.method.name}); leave it out"
            )


def _unread_nodes(config: DictConfig) -> Iterator[str]:
    """Yield the nodes that a run does not read, whatever they hold."""
    has_agent = config.method.observes is not None
    learns = has_agent and not config.method.run
    anchored = OmegaConf.select(config, "learner.anchor") is not None
    if not has_agent:
        yield from OF_A_TRAINING
    if not learns:
        yield from (*OF_A_LEARNER, NOISE)
    if not (anchored or config.delivery == "tested"):
        yield "training.tests"
    if not parts.trains_guides(config):
        yield "proxy"
    if not parts.advises(config):
        yield "evaluation.advice"


def _references(config: DictConfig, closed: Sequence[str]) -> Iterator[str]:
    """Yield the keys to which values refer, except values in nodes that are not read.

    A run without a learner has one row for each case, whatever the number of rows in its env.
    """
    left_out = (*closed, "env.num_envs") if "learner" in closed else closed
    values: Any = OmegaConf.to_container(config, resolve=False)
    for key, value in leaves(values).items():
        if isinstance(value, (str, list)) and not is_part(key, left_out):
            yield from (name for name in REFERENCE.findall(str(value)) if name != key)


def _adds_noise(config: DictConfig) -> bool:
    """Return whether noise is added to the actions of a training, which are numbers then."""
    if parts.learner_kind(config) == "imitation":
        return False
    env = parts.env_maker(config)()
    return bool(env.full_action_spec[env.action_key].dtype.is_floating_point)


def check_logger(node: Mapping[str, Any]) -> None:
    """Check that the package of a logger is installed, before a run is begun.

    Raises:
        UserError: if it is missing.
    """
    package = PACKAGES.get(str(node["_target_"]).rpartition(".")[2])
    if package is not None:
        require("this logger (logger=none needs no package)", package, package)
