"""What acts without learning in a comparison: its delay, and its file."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hydra import compose, initialize_config_module

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
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose("train", ["env=pendulum", "method=coil", *small, *words])


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


@pytest.mark.parametrize(
    ("space", "action", "words"),
    [
        (spaces.Box(-2.0, 2.0, (2,)), [0, 0], "zero actions"),
        (
            spaces.Box(np.array([-1, -9]), np.array([1, 9]), dtype=np.float32),
            [0, 0],
            "zero actions",
        ),
        (spaces.Box(-np.inf, np.inf, (1,)), [0], "zero actions"),
        (spaces.Box(0.0, 20.0, (1,)), [10], "the middle of the action's range"),
        (
            spaces.Box(np.array([-1, 2]), np.array([1, 50]), dtype=np.float32),
            [0, 26],
            "the middle of the action's range",
        ),
        (spaces.Discrete(3, start=5), 0, "the first choice"),
        (spaces.MultiDiscrete([2, 4]), [0, 0], "the first choice"),
    ],
)
def test_neutral_action_is_called_what_it_is(space, action, words):
    class Plant(gymnasium.Env):
        observation_space, action_space = spaces.Box(-1, 1, (1,)), space

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

    env = GymnasiumEnv(Plant)
    policy, said = neutral(env)
    assert policy(env.reset())["action"][0].tolist() == action
    assert said == words


def test_table_says_what_the_action_of_zero_is_and_old_files_have_zero_actions(tmp_path):
    rows = [{"baseline": name, "reward": 1.0, "steps": 3} for name in ("zero", "random")]
    for words, note in (("the first choice", "the first choice"), ("zero actions", ""), (None, "")):
        if words is not None:
            write_csv([rows[0] | {"baseline_action": words}, rows[1]], tmp_path / FILE)
        else:
            write_csv(rows, tmp_path / FILE)
        found = read_outcome(tmp_path, [], {})
        assert [row["note"] for row in found.rows] == [note, ""]
        assert found.entries["zero"].action == (words or "zero actions")


@pytest.mark.parametrize("text", ["", "baseline,rew", "baseline,reward,steps\nguide,1,2\nze"])
def test_damaged_file_is_one_sentence(text, tmp_path):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(UserError, match=r"baselines.csv is damaged .*; remove it and compare"):
        read_baselines(tmp_path)


def test_rows_of_what_acted_are_read(tmp_path):
    write_csv([{"baseline": "zero", "reward": -1.0, "steps": 3}], tmp_path / FILE)
    assert read_baselines(tmp_path).to_dict("records") == [
        {"baseline": "zero", "reward": -1.0, "steps": 3}
    ]
