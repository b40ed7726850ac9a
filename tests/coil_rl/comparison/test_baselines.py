"""What acts without learning in a comparison: its delay, and its file."""

import numpy as np
import pytest
from gymnasium import spaces
from plants import Plant
from programs import composed

import coil_rl.config.schema  # noqa: F401 registers the configuration schema
from coil_rl.comparison.arms import GUIDE
from coil_rl.comparison.baselines import (
    FILE,
    measure_baselines,
    measure_delayed,
    neutral,
    read_baselines,
)
from coil_rl.comparison.outcome import read_outcome
from coil_rl.config.parts import build_evaluation, env_maker
from coil_rl.errors import UserError
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.report import write_csv
from coil_rl.run.parts import TEST

pytest.importorskip("gymnasium.envs.classic_control")


def car(**lags):
    """Return the configuration of a short training with fixed delays."""
    words = [f"disturb=[{','.join(lags)}]"]
    for name, lag in lags.items():
        words += [f"disturb.{name}.min_lag={lag}", f"disturb.{name}.max_lag={lag}"]
    small = ["env.max_steps=30", "evaluation.cases=2", "run_dir=x"]
    return composed("env=pendulum", "method=coil", *small, *words)


def rewards_of_the_guide(config):
    evaluation = build_evaluation(config)
    result = evaluation.run(*env_maker(config).guided(len(evaluation.cases), TEST))
    return [episode["reward"] for episode in result.episodes]


@pytest.mark.slow
def test_delay_is_one_step_more_than_the_env_has():
    found = measure_delayed(GUIDE, None, car(action_delay=2))
    assert list(found["reward"]) == rewards_of_the_guide(car(observation_delay=1, action_delay=3))
    assert list(found["reward"]) != rewards_of_the_guide(car(observation_delay=1, action_delay=1))


@pytest.mark.slow
def test_words_for_the_action_are_kept_with_what_was_measured(tmp_path):
    measure_baselines(car(), tmp_path)
    outcome = read_outcome(tmp_path, [], {})
    assert outcome.entries["zero"].action == "zero actions"
    assert set(outcome.entries) == {"guide", "opposite", "zero", "random"}


def box(low, high):
    return spaces.Box(np.array(low), np.array(high), dtype=np.float32)


@pytest.mark.parametrize(
    ("space", "action", "words"),
    [
        (box([-2, -2], [2, 2]), [0, 0], "zero actions"),
        (box([-1, -9], [1, 9]), [0, 0], "zero actions"),
        (box([-np.inf], [np.inf]), [0], "zero actions"),
        (box([0], [20]), [10], "the middle of the action's range"),
        (box([-1, 2], [1, 50]), [0, 26], "the middle of the action's range"),
        (spaces.Discrete(3, start=5), 0, "the first choice"),
        (spaces.MultiDiscrete([2, 4]), [0, 0], "the first choice"),
    ],
)
def test_neutral_action_is_called_what_it_is(space, action, words):
    env = GymnasiumEnv(lambda: Plant(actions=space))
    policy, said = neutral(env)
    assert policy(env.reset())["action"][0].tolist() == action
    assert said == words


def test_table_says_what_the_action_of_zero_is_and_old_files_have_zero_actions(tmp_path):
    rows = [{"baseline": name, "reward": 1.0, "steps": 3} for name in ("zero", "random")]
    for words, note in (("the first choice", "the first choice"), ("zero actions", ""), (None, "")):
        said = {} if words is None else {"baseline_action": words}
        write_csv([rows[0] | said, rows[1]], tmp_path / FILE)
        found = read_outcome(tmp_path, [], {})
        assert [row["note"] for row in found.rows] == [note, ""]
        assert found.entries["zero"].action == (words or "zero actions")


@pytest.mark.parametrize("text", ["", "baseline,rew", "baseline,reward,steps\nguide,1,2\nze"])
def test_damaged_file_is_one_sentence(text, tmp_path):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(UserError, match=r"baselines.csv is damaged .*; remove it and compare"):
        read_baselines(tmp_path)
