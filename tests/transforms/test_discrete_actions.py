import pytest
import torch
import worlds
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical
from torchrl.envs import Compose, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.learners import PPO
from coil_rl.testing import check_env, check_transform
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import (
    BiasedAdvice,
    DelayedAdvice,
    DiscreteActions,
    GuideActions,
    JumpStart,
    RemovedAdvice,
    ResidualAction,
    RewardCoupling,
    Takeover,
)


def advised(says, *transforms, choices=5):
    """Cars with a guide that always says the same, to each car its own number."""
    env = ConeTrackEnv(shipped_tracks("test")[:1], len(says), rate=6)
    guide = TensorDictModule(lambda seen: torch.tensor(says).unsqueeze(-1), in_keys=["steering"], out_keys=["action"])
    env = TransformedEnv(env, Compose(GuideActions({"same": guide}), *transforms, DiscreteActions(choices)))
    return env.train()


def stepped(env, *choices):
    return env.step(env.reset().set("action", torch.tensor(choices)))


def near(tensor, numbers):
    return tensor.flatten().tolist() == pytest.approx(numbers)


@pytest.mark.parametrize(
    "transforms",
    [[ResidualAction(0.5), RewardCoupling(0.1), Takeover(0.5)], [JumpStart(3), DelayedAdvice(3)], [RemovedAdvice()]],
)
def test_an_env_with_choices_is_still_an_env(transforms):
    check_env(worlds.cones(*transforms, DiscreteActions(3)).train(), steps=5)


def test_an_env_without_a_guide_may_have_choices_too():
    check_transform(ConeTrackEnv(shipped_tracks("test"), 3), DiscreteActions(7))


def test_choices_are_equally_spaced_from_bound_to_bound():
    env = worlds.pendulum(DiscreteActions(5))
    assert isinstance(env.action_spec, Categorical)
    assert env.transform[-1].values.tolist() == [-2, -1, 0, 1, 2]


def test_the_env_gets_the_number_that_was_chosen_and_the_data_keep_the_choice():
    step = stepped(advised([0.0] * 3, choices=[-0.5, 0.1, 0.75]), 0, 1, 2)
    assert step["action"].tolist() == [0, 1, 2]
    assert near(step["next", "steering"], [-0.5, 0.1, 0.75])


def test_advice_is_one_hot_at_the_nearest_choice_and_stays_as_a_number_beside_it():
    says = [-0.9, -0.7, -0.25, 0.2, 0.26, 1.0]
    env = advised(says)
    for data in (env.reset(), stepped(env, *[2] * 6)["next"]):
        assert torch.equal(data["guide_action"], torch.eye(5)[[0, 1, 1, 2, 3, 4]].unsqueeze(1))
        assert near(data["guide_number"], says)


def test_what_degrades_advice_still_works_on_numbers():
    assert advised([0.3], BiasedAdvice(0.3)).reset()["guide_action"].tolist() == [[[0, 0, 0, 1, 0]]]


def test_a_residual_agent_adds_its_choice_to_what_the_guide_really_says():
    assert near(stepped(advised([0.3, 0.3], ResidualAction(0.5)), 4, 1)["next", "steering"], [0.8, 0.05])


def test_a_guide_that_takes_over_is_not_rounded():
    assert near(stepped(advised([0.3], Takeover(1.0)), 4)["next", "steering"], [0.3])


def test_reward_coupling_charges_for_the_distance_in_action_units():
    """From the number chosen to the number advised: the nearest choice costs least, but not nothing."""
    step = stepped(advised([0.3] * 5, RewardCoupling(1.0)), 0, 1, 2, 3, 4)
    assert near(step["next", "guide_distance"], [1.3, 0.8, 0.3, 0.2, 0.7])


def test_removed_advice_is_the_choice_that_was_taken_last():
    assert stepped(advised([0.3], RemovedAdvice()), 1)["next", "guide_action"].tolist() == [[[0, 1, 0, 0, 0]]]


def test_ppo_chooses_by_a_categorical_policy():
    env = worlds.cones(DiscreteActions(5))
    ppo = PPO(env, ["observation", "guide_action"], epochs=1, minibatches=1)
    batch = Rollout(env, ppo.policy, 4, ppo.keys).collect()
    assert ppo.policy.module[0].module.layers[0].in_features == 25
    assert env.action_spec.is_in(batch["action"][:, 0])
    assert abs(ppo.update(batch)["loss_objective"]) < 1e-6


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        (1, "choices=1 must be at least 2"),
        ([0.5], "must be at least two numbers"),
        ([0.5, 0.5], "each more than the one before it"),
        ([0.0, float("inf")], "must be finite"),
        ([0.0, 1.5], r"choices=\[0.0, 1.5\] must lie between the action's bounds -1.0 and 1.0"),
    ],
)
def test_choices_that_are_none_are_refused(choices, words):
    with pytest.raises(ValueError, match=words):
        worlds.cones(DiscreteActions(choices)).reset()


def test_choices_of_choices_are_refused():
    with pytest.raises(ValueError, match="choices of one number between bounds, but this env's action is Categorical"):
        worlds.carts(DiscreteActions(5)).reset()
