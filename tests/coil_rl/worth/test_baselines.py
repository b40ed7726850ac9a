"""What acts without learning in a comparison: its delay, and its file."""

import pytest
from hydra import compose, initialize_config_module

import coil_rl.config.schema  # noqa: F401 registers the configuration schema
from coil_rl.config.build import build_evaluation, env_maker
from coil_rl.errors import UserError
from coil_rl.report import write_csv
from coil_rl.run.parts import TEST
from coil_rl.worth.arms import GUIDE
from coil_rl.worth.baselines import FILE, measure_delayed, read_baselines

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


def test_delay_is_one_step_more_than_the_env_has():
    found = measure_delayed(GUIDE, None, car(action_delay=2))
    assert list(found["reward"]) == rewards_of_the_guide(car(observation_delay=1, action_delay=3))
    assert list(found["reward"]) != rewards_of_the_guide(car(observation_delay=1, action_delay=1))


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
