"""What acts without learning, in the cases of the table: measured once, and kept in a file."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from coil_rl.comparison.arms import GUIDE, NETWORK, OPPOSITE, RANDOM, ZERO
from coil_rl.comparison.entry import FIRST_CHOICE, MIDDLE, ZERO_ACTIONS
from coil_rl.config.assemble import assemble
from coil_rl.config.folder import read_config
from coil_rl.config.nodes import build_all
from coil_rl.config.parts import build_evaluation, env_maker
from coil_rl.errors import file_of_a_run
from coil_rl.report import write_csv
from coil_rl.run import checkpoint
from coil_rl.run.curve import POLICIES
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.parts import TEST
from coil_rl.transforms.action_space import ActionSpace

FILE = "baselines.csv"
NAME = "baseline"  # column with the name
ACTION = "baseline_action"  # column with the words for the action of `zero`
REVERSED = {"_target_": "coil_rl.transforms.ScaledAdvice", "gain": -1.0}
# Beside the delays of the env, which are kept: so names and memories are of their own.
ONE = {"min_lag": 1, "max_lag": 1}  # steps
LATE = {
    "one_more_observation": {
        "_target_": "coil_rl.transforms.ObservationDelay",
        "memory_key": "one_more_late_observations",
        **ONE,
    },
    "one_more_action": {
        "_target_": "coil_rl.transforms.ActionDelay",
        "memory_key": "one_more_late_actions",
        **ONE,
    },
}


Policy = Callable[[TensorDictBase], TensorDictBase]


def space_of(env: EnvBase) -> ActionSpace:
    """Return the actions of an env, in its own unit."""
    return ActionSpace(env.full_action_spec[env.action_key], env.batch_dims)


def neutral(env: EnvBase) -> tuple[Policy, str]:
    """Return a policy with the neutral action, and what that is in words.

    It is 0 in each number only where each range is around 0.
    """
    space = space_of(env)
    vector = space.neutral()
    action = space.actions(vector.expand(*env.batch_size, *vector.shape))
    words = FIRST_CHOICE
    if space.units is not None:
        words = ZERO_ACTIONS if (space.units.centre == 0).all() else MIDDLE
    return lambda tensordict: tensordict.set(env.action_key, action.clone()), words


def uniform(env: EnvBase, seed: int = 0) -> Policy:
    """Return a policy with random actions, uniform in those of the env."""
    space, generator = space_of(env), torch.Generator().manual_seed(seed)
    shape = (*env.batch_size, *space.agents, space.size)

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        draws = torch.rand(shape, generator=generator).to(space.spec.device, space.dtype)
        return tensordict.set(env.action_key, space.actions(space.random(draws)))

    return act


def measure_baselines(config: DictConfig, folder: Path) -> None:
    """Let guide, opposite, zero and random act in the cases of the table, unless that is done."""
    if (folder / FILE).exists():
        return
    evaluation, make_env = build_evaluation(config), env_maker(config)
    cases = len(evaluation.cases)
    opposite = replace(
        make_env,
        degrade=lambda: [*make_env.degrade(), *build_all({"opposite": REVERSED}, "degrade")],
    )
    rows: list[dict[str, Any]] = []
    for name, (env, policy) in {
        GUIDE: make_env.guided(cases, TEST),
        OPPOSITE: opposite.guided(cases, TEST),
    }.items():
        rows += _rows(name, evaluation.run(env, policy))
    env = make_env.plain(cases, TEST)
    policy, words = neutral(env)
    rows += [row | {ACTION: words} for row in _rows(ZERO, evaluation.run(env, policy))]
    env = make_env.plain(cases, TEST)
    rows += _rows(RANDOM, evaluation.run(env, uniform(env, config.seed)))
    write_csv(rows, folder / FILE)


def measure_network(folder: Path, run: Path) -> None:
    """Let the first network of a run act in the cases of the table, unless that is done.

    Args:
        run: folder of a finished run that kept its policies.
    """
    file = folder / "first_network.csv"
    first = min((run / POLICIES).glob("*.pt"), default=None)
    if file.exists() or first is None:
        return
    opened = assemble(read_config(run, "run"))
    env = opened.make_env(len(opened.trial.evaluation.cases), TEST)
    policy = opened.make_learner(env).policy  # type: ignore[misc]
    checkpoint.put_weights(policy, checkpoint.load(first), first)
    write_csv(_rows(NETWORK, opened.trial.evaluation.run(env, policy)), file)


def measure_delayed(name: str, run: Path | None, config: DictConfig) -> pd.DataFrame:
    """Return the episodes of a policy with one more step of delay on observation and action.

    Args:
        run: folder of its run; None for a guide or its opposite.
        config: of a training with a guide, for these.
    """
    late = copy.deepcopy(config) if run is None else read_config(run, "run")
    with open_dict(late):
        late.disturb = OmegaConf.merge(late.disturb, LATE)
        if name == OPPOSITE:
            late.degrade = OmegaConf.merge(late.degrade, {"opposite": REVERSED})
    evaluation = build_evaluation(late)
    cases = len(evaluation.cases)
    if run is None:
        env, policy = env_maker(late).guided(cases, TEST)
    else:
        opened = assemble(late)
        env = opened.make_env(cases, TEST)
        policy = opened.policy(env)
    return pd.DataFrame(_rows(name, evaluation.run(env, policy)))


def read_baselines(folder: Path) -> pd.DataFrame:
    """Return the rows of all that was measured in the cases of the table.

    Raises:
        UserError: if a file is empty or damaged.
    """
    tables = []
    for file in (folder / FILE, folder / "first_network.csv"):
        if file.exists():
            with file_of_a_run(file, "remove it and compare again, which writes it anew"):
                table = pd.read_csv(file)
                tables.append(table.astype({NAME: str, "reward": float, "steps": int}))
    return pd.concat(tables, ignore_index=True)


def action_words(table: pd.DataFrame) -> str:
    """Return what the action of `zero` is, in words; a file without them has zero actions."""
    return str(table[ACTION].iloc[0]) if ACTION in table else ZERO_ACTIONS


def _rows(name: str, result: EvaluationResult) -> list[dict[str, Any]]:
    return [{NAME: name, **episode} for episode in result.episodes]
