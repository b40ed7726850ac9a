"""The brake of an anchored policy, on a pendulum that its guide swings up."""

from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_module
from torchrl.envs import EnvBase

from coil_rl.config.build import build_env, build_learner, cases_node
from coil_rl.report.measures import Measure
from coil_rl.run.brake import Brake
from coil_rl.run.run import _probe

pytest.importorskip("gymnasium.envs.classic_control")
FAST = Measure("reward", "min", at_most=-10.0)  # true for an episode that was ever far from upright


def configured(*overrides):
    """Return the configuration of a run and its learner."""
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose(
            "train", ["method=coil_anchored", "budget.num_envs=2", "run_dir=unused", *overrides]
        )
    torch.manual_seed(0)
    return config, build_learner(config, build_env(config))


def built(*overrides, failure=None):
    """Return learner, brake, and a function that makes the env of the brake."""
    config, learner = configured("env=pendulum", *overrides)

    def build(policies: int) -> EnvBase:
        return build_env(config, cases_node(config, "selection", policies))

    return learner, Brake(learner.anchor, learner.policy, build, failure), partial(build, 1)


@pytest.mark.parametrize(
    ("overrides", "cases"),
    [
        ("env=pendulum", 24),
        ("env=cone_track preset=paper", 96),
        ("env=cone_track", 224),
        ("learner.anchor.cases=7", 7),
    ],
)
def test_look_has_more_cases_where_failures_are_counted(overrides, cases):
    assert _probe(*configured(*overrides.split())).build(2).batch_size == (2 * cases,)


@pytest.mark.parametrize("action", ["continuous", "choices"])
def test_first_policy_is_within_two_percent_of_the_guide(action):
    learner, brake, build = built(f"action={action}")
    first = brake(0)["look/return"]
    guide = build()
    returns = brake._drive(guide, lambda data: data.set("action", guided(data, action)))["return"]
    assert learner.anchor.weight == 1
    assert first == pytest.approx(float(returns.mean()), rel=0.02)
    assert float(learner.anchor.best.mean()) == pytest.approx(first)


def guided(data, action):
    advice = data["guide_action"][..., 0, :]
    return advice.argmax(-1) if action == "choices" else advice


def test_opposite_of_a_reversed_guide_is_as_good_as_the_guide():
    learner, brake, _ = built("degrade=adversarial")
    brake(0)
    good, brake_of_good, _ = built()
    brake_of_good(0)
    assert learner.anchor.head.weight.tolist() == [-1]
    assert torch.allclose(learner.anchor.best, good.anchor.best)


@pytest.mark.parametrize("degrade", ["random", "zeroed"])
def test_guide_that_is_of_no_use_does_not_hold(degrade):
    learner, brake, _ = built(f"degrade={degrade}")
    brake(0)
    assert learner.anchor.weight == 0
    assert not any(brake.due(update, 20, {}) for update in range(1, 20))


def test_look_leaves_the_policy_and_the_random_numbers_alone_and_can_be_repeated():
    learner, brake, _ = built("learner.anchor.step=0", "learner.anchor.margin=0", failure=FAST)
    brake(0)
    before, state = (
        {name: value.clone() for name, value in learner.policy.state_dict().items()},
        torch.get_rng_state(),
    )
    first, second = brake(1), brake(2)
    assert first == second
    assert first["look/return"] == first["look/lower_return"]
    assert first["look/failures"] == 5, "every episode begins far from upright"
    assert first["look/back"] == 0
    assert torch.equal(torch.get_rng_state(), state)
    assert all(
        torch.equal(value, before[name]) for name, value in learner.policy.state_dict().items()
    )


def test_weight_falls_where_the_network_does_what_the_guide_did_and_a_bad_policy_goes_back():
    learner, brake, _ = built()
    brake(0)
    brake(1)
    assert learner.anchor.weight in (1.0, pytest.approx(0.95))
    first = {name: value.clone() for name, value in learner.anchor.kept.items()}
    for value in learner.policy.parameters():
        value.data += 1
    learner.anchor.best += 1000
    assert brake(2)["look/back"] == 1
    assert all(
        torch.equal(value, first[name]) for name, value in learner.policy.state_dict().items()
    )
