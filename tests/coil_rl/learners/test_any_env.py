"""Learners with all kinds of actions and observations."""

import pytest
import torch
from any_env import FLOAT64, AnyEnv, learning
from torch.distributions import Categorical as Choice
from torch.distributions import Normal
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, OneHot, Unbounded
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, Reinforce
from coil_rl.run.rollout import Rollout

ACTIONS = {
    "bounded": Bounded(-1, 1, (2,)),
    "one_number": Bounded(0.0, 2.0, (1,)),
    "scalar": Bounded(-1, 1, ()),
    "matrix": Bounded(-1, 1, (2, 3)),
    "float64": Bounded(-1, 1, (2,), **FLOAT64),
    "half_bounded": Bounded(torch.zeros(2), torch.full((2,), torch.inf), (2,)),
    "unbounded": Unbounded((2,)),
    "unbounded_matrix": Unbounded((2, 2), **FLOAT64),
    "categorical": Categorical(3, ()),
    "categorical_column": Categorical(3, (1,)),
    "one_hot": OneHot(3),
    "multi_categorical": MultiCategorical([2, 4, 3]),
    "binary": Binary(3),
}
UNBOUNDED = ("half_bounded", "unbounded", "unbounded_matrix")
ON_POLICY = [PPO, A2C, Reinforce, TRPO]


def env_with(name, count=8):
    return AnyEnv(count, ACTIONS[name], dtype=torch.float64 if "float64" in name else torch.float32)


def trained(learner, env, updates=2, steps=8):
    """The metrics of some updates."""
    rollout = Rollout(env, learner.policy, steps, learner.keys)
    return [learner.update(rollout.collect(), 0.0) for _ in range(updates)]


NUMBERS = ("bounded", "scalar", "matrix", "float64", "unbounded")
CHOSEN = {SAC: NUMBERS, DQN: ("categorical", "one_hot")} | dict.fromkeys(ON_POLICY, ACTIONS)


@pytest.mark.fast(20)
@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, names in CHOSEN.items() for name in names]
)
def test_learner_updates_with_any_action_of_its_kind(kind, name):
    torch.manual_seed(0)
    env = env_with(name)
    learner, rollout = learning(kind, env)
    if kind is SAC:
        assert learner.target_entropy == -max(ACTIONS[name].shape.numel(), 1)
    before = torch.nn.utils.parameters_to_vector(learner.policy.parameters()).clone()
    for _ in range(2):
        metrics = learner.update(rollout.collect(), 0.0)
    after = torch.nn.utils.parameters_to_vector(learner.policy.parameters())
    assert torch.tensor(list(metrics.values())).isfinite().all()
    assert after.isfinite().all()
    assert not torch.equal(after, before)


@pytest.mark.parametrize("name", ACTIONS)
@pytest.mark.parametrize("squash", [True, False])
def test_log_probability_is_that_of_pytorch(name, squash):
    torch.manual_seed(0)
    env = env_with(name, 64)
    policy = PPO(env, action_gain=2.0, squash=squash).policy
    data = policy(env.reset())
    action, spec = data["action"], env.action_spec
    assert spec.is_in(action) or name in ("binary", "one_hot")  # int64
    if spec.dtype.is_floating_point:
        expected = log_probability(data, spec, squash and name not in UNBOUNDED)
    else:
        index = action.argmax(-1) if name == "one_hot" else action
        expected = Choice(logits=data["logits"]).log_prob(index.long())
    expected = expected.reshape(64, -1).sum(-1)
    torch.testing.assert_close(
        data["action_log_prob"], expected.to(data["action_log_prob"]), rtol=1e-3, atol=1e-3
    )


def log_probability(data, spec, squashed):
    """Return that of each number of an action: squashed, or clipped to the bounds."""
    normal = Normal(data["loc"], data["scale"])
    if not squashed:
        sample = data.get("unclipped_action", data["action"])
        if isinstance(spec, Bounded):
            assert not spec.is_in(sample)
            assert torch.equal(data["action"], sample.clamp(spec.low, spec.high))
        return normal.log_prob(sample)
    half = (spec.high - spec.low) / 2
    raw = ((data["action"] - spec.low) / half - 1).atanh()
    return normal.log_prob(raw) - (half * (1 - raw.tanh().square())).log()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["matrix", "float64", "multi_categorical", "categorical_column", "binary"]
)
def test_deterministic_action_is_the_mode_after_ppo_has_learned_the_best_action(name):
    torch.manual_seed(0)
    env = env_with(name, 64)
    learner = PPO(env, learning_rate=1e-2, minibatches=4)
    trained(learner, env, updates=15)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        reward = env.step(learner.policy(env.reset()))["next", "reward"].mean()
    assert reward > (-0.05 if env.action_spec.dtype.is_floating_point else 0.9)


def test_entries_of_all_kinds_are_read():
    observations = {
        "number": Unbounded((), **FLOAT64),
        ("agents", "observation"): Unbounded((2, 3)),
        "place": Categorical(5, ()),
        "switches": MultiCategorical([2, 3]),
        "flag": Binary(1, dtype=torch.bool),
        "count": Unbounded((1,), dtype=torch.long),
        "image": Bounded(0, 255, (2, 2, 3), dtype=torch.uint8),
    }
    env = AnyEnv(4, observations=observations)
    check_env_specs(env)
    in_keys = [["agents", "observation"], *(key for key in observations if isinstance(key, str))]
    learner = PPO(env, in_keys, minibatches=2)
    concat = next(module for module in learner.policy.modules() if hasattr(module, "width"))
    assert concat.width == 6 + 1 + 5 + 5 + 1 + 1 + 12
    data = env.reset()
    read = concat(*(data[key] for key in learner.policy.in_keys))
    assert read.dtype == torch.float32
    assert torch.equal(read[:, 7:12], torch.nn.functional.one_hot(data["place"], 5).float())
    assert torch.equal(
        read[:, 12:14], torch.nn.functional.one_hot(data["switches"][:, 0], 2).float()
    )
    assert torch.equal(read[:, -12:], data["image"].flatten(1) / 255)
    trained(learner, env)


@pytest.mark.slow
def test_ppo_trains_the_joint_action_of_several_agents_for_the_sum_of_their_rewards():
    torch.manual_seed(0)
    env = AnyEnv(
        64, Bounded(-1, 1, (3, 2)), {("agents", "observation"): Unbounded((3, 4))}, agents=True
    )
    check_env_specs(env)
    learner = PPO(env, [("agents", "observation")], learning_rate=1e-2, minibatches=4)
    trained(learner, env, updates=15)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.step(learner.policy(env.reset()))
    assert data["next", "agents", "reward"].mean() > -0.1
