"""The brake of an anchored policy, on a pendulum that its guide swings up."""

import pytest
import torch
from hydra import compose, initialize_config_module
from torchrl.envs import EnvBase

from coil_rl.config.build import assemble, build_learner, env_maker
from coil_rl.errors import UserError
from coil_rl.measures import Measure
from coil_rl.run.cases import SelectionCases

pytest.importorskip("gymnasium.envs.classic_control")
FAST = Measure("reward", "min", at_most=-10.0)  # true for an episode that was ever far from upright


def configured(*overrides):
    """Return the configuration of a run and its learner."""
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose(
            "train", ["method=coil_anchored", "budget.num_envs=2", "run_dir=unused", *overrides]
        )
    torch.manual_seed(0)
    return config, build_learner(config, env_maker(config)())


def built(*overrides, failure=None):
    """Return the anchor of a learner, its brake, and the cases in which the brake evaluates it."""
    config, learner = configured("env=pendulum", *overrides)

    def build(policies: int, count: int) -> EnvBase:
        return env_maker(config)(policies * count, "selection", count=count)

    (brake,) = learner.callbacks(SelectionCases(learner.policy, build, 5, failure))
    return brake.anchored, brake, brake.cases


@pytest.mark.parametrize(
    ("overrides", "cases"),
    [
        ("env=pendulum", 24),
        ("env=cone_track preset=paper", 96),
        ("env=cone_track", 224),
        ("learner.anchor.cases=7", 7),
    ],
)
def test_check_up_has_more_cases_where_failures_are_counted(overrides, cases):
    config, learner = configured(*overrides.split())
    (brake,) = learner.callbacks(assemble(config).selection(learner))
    assert brake.cases.count == cases
    assert brake.cases.build(2, cases).batch_size == (2 * cases,)


@pytest.mark.parametrize("action", ["continuous", "choices"])
def test_first_policy_is_within_two_percent_of_the_guide(action):
    anchor, brake, cases = built(f"action={action}")
    first = brake.after_update(0)["look/return"]
    env = cases.build(1, cases.count)
    returns = cases._totals(env, lambda data: data.set("action", guided(data, action)))["return"]
    assert anchor.weight == 1
    assert first == pytest.approx(float(returns.mean()), rel=0.02)
    assert float(anchor.best_returns.mean()) == pytest.approx(first)


def guided(data, action):
    advice = data["guide_action"][..., 0, :]
    return advice.argmax(-1) if action == "choices" else advice


def test_opposite_of_a_reversed_guide_is_as_good_as_the_guide():
    anchor, brake, _ = built("degrade=adversarial")
    brake.after_update(0)
    good, brake_of_good, _ = built()
    brake_of_good.after_update(0)
    assert anchor.head.weight.tolist() == [-1]
    assert torch.allclose(anchor.best_returns, good.best_returns)


@pytest.mark.parametrize("degrade", ["random", "zeroed"])
def test_guide_that_is_of_no_use_does_not_hold(degrade):
    anchor, brake, _ = built(f"degrade={degrade}")
    brake.after_update(0)
    assert anchor.weight == 0
    assert not any(brake.due(update, 20, {}) for update in range(1, 20))


def state_of(policy):
    return {name: value.clone() for name, value in policy.state_dict().items()}


def test_check_up_leaves_policy_and_random_numbers_alone_and_can_be_repeated():
    _, brake, _ = built("learner.anchor.step=0", "learner.anchor.margin=0", failure=FAST)
    brake.after_update(0)
    before, random_state = state_of(brake.policy), torch.get_rng_state()
    first, second = brake.after_update(1), brake.after_update(2)
    assert first == second
    assert first["look/return"] == first["look/lower_return"]
    assert first["look/failures"] == 5, "every episode begins far from upright"
    assert first["look/back"] == 0
    assert torch.equal(torch.get_rng_state(), random_state)
    after = brake.policy.state_dict()
    assert all(torch.equal(value, before[name]) for name, value in after.items())


def test_weight_falls_where_the_network_does_what_the_guide_did_and_a_bad_policy_goes_back():
    anchor, brake, _ = built()
    brake.after_update(0)
    brake.after_update(1)
    assert anchor.weight in (1.0, pytest.approx(0.95))
    first = {name: value.clone() for name, value in anchor.best_state.items()}
    for value in brake.policy.parameters():
        value.data += 1
    anchor.best_returns += 1000
    assert brake.after_update(2)["look/back"] == 1
    after = brake.policy.state_dict()
    assert all(torch.equal(value, first[name]) for name, value in after.items())


def test_random_actions_are_those_of_seed_0_whatever_the_random_numbers_of_the_run():
    _, _, cases = built()
    env = cases.build(1, cases.count)
    torch.manual_seed(0)
    expected = cases._totals(env, env.rand_action)["return"]
    for seed in (1, 2):
        torch.manual_seed(seed)
        assert torch.equal(cases.evaluate_random(), expected)


def test_weight_of_the_guide_is_the_only_difference_between_the_candidates():
    anchor, brake, cases = built()
    anchor.set_weight(0.5)
    results = brake._evaluate([torch.tensor([0.5]), torch.tensor([0.0])])
    present = cases.evaluate([brake.policy.state_dict()])
    assert torch.equal(results.returns[0], present.returns[0])
    assert not torch.equal(results.returns[1], present.returns[0])


def test_run_without_cases_is_told_what_an_anchor_needs():
    config, learner = configured("env=pendulum")
    config.evaluation.curve.cases = {}
    (brake,) = learner.callbacks(assemble(config).selection(learner))
    with pytest.raises(UserError, match=r"learner.anchor needs evaluation.curve.cases.selection"):
        brake.after_update(0)
