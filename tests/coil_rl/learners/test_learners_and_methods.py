"""Learners beside methods: each pair is a choice of two files."""

import pytest
from hydra import compose, initialize_config_module

from coil_rl.train.build import build_env, build_learner
from coil_rl.train.rollout import Rollout


@pytest.mark.parametrize("learner", ["a2c", "reinforce", "trpo"])
@pytest.mark.parametrize("method", ["residual_coil", "jump_start", "kickstart"])
def test_a_learner_learns_by_any_method(learner, method):
    small = ["track=generated", "track.train.count=1", "budget.cars=8", "learner.minibatches=2", "run_dir=unused"]
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("train", [*small, f"method={method}", f"learner={learner}"])
    env = build_env(config)
    made = build_learner(config, env)
    before = [weight.clone() for weight in made.policy.parameters()]
    metrics = made.update(Rollout(env, made.policy, 8, made.keys).collect(0.5), 0.5)
    assert ("loss_guide" in metrics) == (method == "kickstart")
    assert any((old != new).any() for old, new in zip(before, made.policy.parameters(), strict=True))
