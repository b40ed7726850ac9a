import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from worlds import cones, perturbed

from coil_rl.imitation import ForestRegressor, Imitation, LinearRegressor
from coil_rl.learners import DQN, PPO, SAC, Anchor
from coil_rl.run.policy_batch import (
    Acting,
    OnRows,
    TracedPolicy,
    policy_batch,
    traced,
)
from coil_rl.transforms import DiscreteActions

KEYS = ["observation", "guide_action"]
MAKE = {"ppo": PPO, "anchored": partial(PPO, anchor=Anchor()), "sac": SAC, "dqn": DQN}


def observations(env):
    advice = torch.rand(15, *env.observation_spec["guide_action"].shape[1:])
    return TensorDict({"observation": torch.rand(15, 20), "guide_action": advice}, [15])


@pytest.mark.parametrize("learner", ["ppo", "anchored", "sac", "dqn", "linear", "forest"])
def test_batch_of_policies_acts_like_each_of_them(learner):
    env = cones(*([DiscreteActions()] if learner == "dqn" else []))
    states = []
    if learner in ("linear", "forest"):
        regressor = LinearRegressor() if learner == "linear" else ForestRegressor(n_estimators=3)
        imitation = Imitation(env, regressor=regressor, validate=False)
        policy = imitation.policy
        for seed in range(3):
            torch.manual_seed(seed)
            imitation.regressor.fit(torch.rand(30, 20), torch.rand(30, 1))
            states.append(copy.deepcopy(policy.state_dict()))
    else:
        policy = MAKE[learner](env, KEYS).policy
        states = [perturbed(policy, seed) for seed in range(3)]
    rows = observations(env)
    batch = policy_batch(policy, states)
    assert isinstance(batch, OnRows if learner == "forest" else TracedPolicy)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        together = batch(rows.clone())["action"]
        for index, state in enumerate(states):
            policy.load_state_dict(state)
            part = slice(5 * index, 5 * index + 5)
            torch.testing.assert_close(together[part], policy(rows[part].clone())["action"])


@pytest.mark.parametrize("learner", MAKE)
def test_recorded_policy_acts_and_draws_like_the_policy_on_any_number_of_rows(learner):
    env = cones(*([DiscreteActions()] if learner == "dqn" else []))
    policy = MAKE[learner](env, KEYS).policy
    recorded = traced(policy)
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        for count in (15, 4):
            actions = []
            for each in (policy, recorded):
                torch.manual_seed(0)
                with torch.no_grad(), set_exploration_type(kind):
                    actions.append([each(observations(env)[:count])["action"] for _ in range(3)])
            torch.testing.assert_close(*actions)
    assert len(recorded.traced) == 4


@pytest.mark.parametrize("choices", [False, True])
@pytest.mark.parametrize("learner", ["ppo", "anchored"])
def test_recorded_policy_takes_any_layout_in_memory(learner, choices):
    env = cones(*([DiscreteActions()] if choices else []))
    policy = MAKE[learner](env, KEYS).policy
    rows = observations(env)
    turned = rows.apply(lambda entry: entry.movedim(0, -1).contiguous().movedim(-1, 0))
    assert not turned["guide_action"].is_contiguous() or not choices
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = policy(rows.clone())["action"]
        for each in ([rows, turned], [turned, rows]):
            recorded = traced(policy)
            for part in each:
                torch.testing.assert_close(recorded(part.copy())["action"], expected)


@pytest.mark.parametrize("options", [{}, {"squash": False}, {"anchor": Anchor()}])
def test_rows_of_a_partly_sampled_policy_are_those_of_the_policy_to_the_bit(options):
    env = cones()
    policy = PPO(env, KEYS, **options).policy
    policy.load_state_dict(perturbed(policy, 0))
    sampled, rows = torch.arange(15) >= 5, observations(env)
    chosen = Acting(policy, rows=slice(5), whole=True)
    partly = OnRows([chosen, Acting(policy, sampled=True, rows=slice(5, 15), whole=True)])
    actions = []
    for each in (policy, partly):
        for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
            torch.manual_seed(0)
            with torch.no_grad(), set_exploration_type(kind):
                actions.append(each(rows.clone())["action"])
    drawn, deterministic, *parts = actions
    assert not torch.equal(drawn, deterministic)
    for part in parts:
        assert torch.equal(part, torch.where(sampled.unsqueeze(-1), drawn, deterministic))
