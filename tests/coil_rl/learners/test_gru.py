"""Policies with a memory solve what needs one, and are trained as any other."""

import copy

import pytest
import torch
import worlds
from any_env import AnyEnv, check_same_update
from torchrl.data import Bounded, Categorical, MultiCategorical, Unbounded
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import A2C, PPO, Gru, KickstartLoss, Mlp, Reinforce
from coil_rl.learners.policy import Entries
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.policy_batch import OnRows, policy_batch
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.transforms import Takeover


class Recall(AnyEnv):
    """Rows whose first observation is -1 or 1; after 5 steps of 0 the sign is the right action.

    The reward is 1 or -1 in the last step, else 0.
    """

    def __init__(self, count, seed=0):
        super().__init__(count, Categorical(2, ()), {"observation": Unbounded((1,))}, seed=seed)
        self.cue = torch.zeros(count, 1)

    def observe(self):
        drawn = 2.0 * torch.randint(2, self.cue.shape, generator=self.generator) - 1
        self.cue = torch.where(self.steps == 0, drawn, self.cue)
        return {"observation": self.cue * (self.steps == 0)}

    def _step(self, tensordict):
        after = super()._step(tensordict)
        right = self.cue == 2 * tensordict["action"].unsqueeze(-1) - 1
        after["reward"] = after["done"] * torch.where(right, 1.0, -1.0)
        return after.set("terminated", after["done"])


ADVISED = ["observation", "guide_action"]


def around(env, gru, *transforms):
    return TransformedEnv(env, Compose(RewardSum(), *transforms, *gru.env_transforms()))


def learnt(network, updates, rows=32, steps=20):
    torch.manual_seed(0)
    env = around(Recall(rows), Gru(state=16))
    ppo = PPO(env, network=network, learning_rate=Linear(1e-2, 0.0), minibatches=4)
    rollout = Rollout(env, ppo.policy, steps, ppo.keys)
    for update in range(updates):
        ppo.update(rollout.collect(), update / updates)
    return ppo.policy


def share_of_right_answers(policy):
    return (evaluate_policy(around(Recall(200, seed=1), Gru(state=16)), policy).mean_reward + 1) / 2


@pytest.mark.slow
def test_policy_with_a_memory_solves_what_needs_one_and_one_without_cannot():
    assert share_of_right_answers(learnt(Gru((16,), state=16), updates=20)) > 0.95
    assert 0.4 < share_of_right_answers(learnt(Mlp((16,)), updates=3)) < 0.6


ACTIONS = {
    "bounded": Bounded(-1, 1, (2,)),
    "unbounded": Unbounded((2,)),
    "choice": Categorical(3, ()),
    "choices": MultiCategorical([2, 4]),
}


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    ("action", "options", "dtype"),
    [
        *((action, {}, torch.float32) for action in ACTIONS),
        ("bounded", {"normalise": True}, torch.float32),
        ("bounded", {"squash": False}, torch.float64),
    ],
)
def test_update_sees_the_log_probabilities_and_states_of_the_rollout(action, options, dtype):
    torch.manual_seed(0)
    default, gru = torch.get_default_dtype(), Gru(state=6)
    torch.set_default_dtype(dtype)
    try:
        env = around(AnyEnv(8, ACTIONS[action], dtype=dtype), gru)
        learner = PPO(env, network=gru, minibatches=2, action_gain=3.0, **options)
        rollout = Rollout(env, learner.policy, 12, learner.keys)
        learner.update(rollout.collect())
        batch = rollout.collect()  # begins within episodes, which have 5 steps
    finally:
        torch.set_default_dtype(default)
    assert batch["is_init"].squeeze(-1).sum(1).eq(2).all()
    assert not batch["is_init"][:, 0].any()
    begins = batch["is_init"].squeeze(-1)
    assert (batch["policy_state"][begins] == 0).all()
    assert (batch["policy_state"][~begins] != 0).any(-1).all()
    goes_on = ~batch["next", "done"][:, :-1].squeeze(-1)
    after = batch["next", "policy_state"][:, :-1]
    assert torch.equal(after[goes_on], batch["policy_state"][:, 1:][goes_on])
    rows = learner.prepare(batch, 0.0)
    order = torch.randperm(len(batch))
    steps = learner.sampler.remember(Entries({key: each[order] for key, each in rows.items()}))
    expected = batch[order].reshape(-1)["action_log_prob"]
    assert expected.std() > 0.1
    torch.testing.assert_close(learner.head.density(steps).log_prob(steps["action"]), expected)
    assert torch.equal(steps["observation"], batch["observation"][order].flatten(0, 1))


def test_critic_values_the_state_in_which_a_truncated_episode_ended():
    torch.manual_seed(0)
    env = around(AnyEnv(4), gru := Gru(state=6))
    learner = PPO(env, network=gru, minibatches=2)
    batch = Rollout(env, learner.policy, 7, learner.keys).collect()
    after = batch["next"][:, 4].copy()
    expected = learner.critic(after.copy())["state_value"]
    forgotten = learner.critic(after.set("policy_state", 0 * after["policy_state"]))["state_value"]
    assert not torch.allclose(forgotten, expected)
    learner.prepare(batch, 0.0)
    torch.testing.assert_close(batch["next", "state_value"][:, 4], expected)
    torch.testing.assert_close(batch["next", "state_value"][:, 3], batch["state_value"][:, 4])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (PPO, {"entropy": 0.01, "auxiliary": [KickstartLoss()]}),
        (A2C, {}),
        (Reinforce, {}),
        (Reinforce, {"baseline": "none"}),
    ],
)
def test_on_policy_learners_train_all_parts_also_where_a_guide_acts(kind, options):
    torch.manual_seed(0)
    gru = Gru((8,), state=8)
    env = worlds.cones(Takeover(Linear(0.5, 0.5)), *gru.env_transforms())
    learner = kind(env, ADVISED, network=gru, minibatches=3, action_gain=1.0, **options)
    before = copy.deepcopy(learner.state_dict())
    rollout = Rollout(env, learner.policy, 8, learner.keys)
    batch = rollout.collect()
    assert 0 < batch["agent_acts"].float().mean() < 1
    assert torch.tensor(list(learner.update(batch).values())).isfinite().all()
    for part in ("policy", "critic"):
        assert not any(
            torch.equal(value, before[part][name])
            for name, value in learner.state_dict()[part].items()
        )
    second = kind(env, ADVISED, network=gru, minibatches=3, **options)
    second.load_state_dict(copy.deepcopy(learner.state_dict()))
    check_same_update(learner, second, rollout.collect())


def test_batch_of_kept_policies_acts_and_remembers_like_each_of_them():
    torch.manual_seed(0)
    gru = Gru((8,), state=8)
    policies = [PPO(around(Recall(5), gru), network=gru, action_gain=3.0).policy for _ in range(3)]
    batch = policy_batch(policies[0], [copy.deepcopy(policy.state_dict()) for policy in policies])
    assert isinstance(batch, OnRows)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        together = around(Recall(15), gru).rollout(12, batch, break_when_any_done=False)
        for index, policy in enumerate(policies):
            part = together[5 * index : 5 * index + 5]
            for step in part.unbind(1):
                alone = policy(step.select(*policy.in_keys))
                assert torch.equal(alone["action"], step["action"])
                torch.testing.assert_close(
                    alone["next", "policy_state"], step["next", "policy_state"]
                )
    assert (together["policy_state"][:, 1] != 0).any()
    assert (together["policy_state"][:, 5] == 0).all()
