import pytest
from hydra import compose, initialize_config_module


@pytest.mark.parametrize(
    ("overrides", "label"),
    [
        ("", "coil"),
        ("method=ppo", "ppo"),
        ("method=ppo learner=a2c", "a2c"),
        ("method=coil learner=trpo", "coil_trpo"),
        ("method=rfc learner=reinforce", "rfc_reinforce"),
        ("learner._target_=others.Q", "coil_q"),
        ("method=oil learner=linear", "oil"),
        ("method=dynamic_coil_stochastic", "dynamic_coil_stochastic"),
        ("method=ppo learner=a2c label=mine", "mine"),
    ],
)
def test_an_agent_is_called_by_its_method_and_by_a_learner_that_is_not_the_usual_one(overrides, label):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        assert compose("train", [*overrides.split(), "run_dir=unused"]).label == label
