import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from tensordict.nn import TensorDictModule
from torch.nn import functional as F
from torchrl.envs import TransformedEnv

from coil_rl.envs import TabularEnv
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.ppo import PPO
from coil_rl.tabular import Gridworld, garnet, solve, toymaker, value_iteration
from coil_rl.testing import check_env, check_transform
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import GuideActions


def env_of(mdp, **options):
    return TabularEnv(mdp.P, mdp.R, start=mdp.start, **options)


def follows(policy):
    """A guide that looks its action up."""
    table = torch.as_tensor(policy)
    return TensorDictModule(lambda seen: table[seen.argmax(-1)], in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("mdp", [toymaker(), garnet(5, 3, np.random.default_rng(0)), Gridworld().mdp])
def test_it_is_an_env(mdp):
    check_env(env_of(mdp, num_envs=3, max_steps=4))


def test_transitions_and_rewards_are_those_of_the_tables():
    mdp = garnet(5, 2, np.random.default_rng(1))
    rollout = env_of(mdp, num_envs=400).rollout(60, break_when_any_done=False)
    s, a = rollout["observation"].argmax(-1), rollout["action"]
    following = rollout["next", "observation"].argmax(-1)
    np.testing.assert_allclose(rollout["next", "reward"].squeeze(-1), mdp.R[s, a, following], rtol=1e-6)
    for state in range(5):
        for action in range(2):
            counts = torch.bincount(following[(s == state) & (a == action)], minlength=5).numpy()
            possible = mdp.P[state, action] > 0
            assert counts[~possible].sum() == 0
            expected = mdp.P[state, action, possible] / mdp.P[state, action, possible].sum() * counts.sum()
            assert chisquare(counts[possible], expected).pvalue > 1e-4


def test_an_episode_terminates_where_nothing_can_happen_and_is_truncated_when_its_time_is_up():
    mdp = Gridworld(("S.G",), slip=0).mdp
    right, stay = torch.tensor([1, 1]), torch.tensor([0, 0])
    env = env_of(mdp, num_envs=2, max_steps=2)
    for actions, terminated in ((right, True), (stay, False)):
        data = env.reset()
        for step in range(2):
            data = env.step(data.set("action", actions))["next"]
            assert bool(data["done"].all()) == (step == 1)
        assert data["terminated"].flatten().tolist() == [terminated] * 2
        assert data["truncated"].flatten().tolist() == [not terminated] * 2
        assert data["reward"].flatten().tolist() == pytest.approx([0.96 if terminated else -0.04] * 2)


def test_the_state_dict_holds_all_that_is_to_come():
    mdp = garnet(5, 2, np.random.default_rng(1))
    env, other = env_of(mdp, num_envs=4, seed=3), env_of(mdp, num_envs=4, seed=4)
    actions = torch.tensor([0, 1, 1, 0])
    env.rollout(5)
    other.load_state_dict(env.state_dict())
    for _ in range(20):
        first, second = (e.step(e._observation().set("action", actions)) for e in (env, other))
        assert (first == second).all()


def test_a_guide_gives_one_hot_advice_and_following_it_is_worth_what_its_policy_is():
    mdp = toymaker(gamma=0.8)
    policy = value_iteration(mdp).policy
    env = TransformedEnv(env_of(mdp, num_envs=2_000), GuideActions({"plan": follows(policy)}))
    rollout = env.rollout(60, FollowAdvice(env), break_when_any_done=False)
    assert (rollout["guide_action"][:, :, 0] == F.one_hot(torch.as_tensor(policy), 2)[1]).all()
    assert (rollout["action"] == 1).all()
    returns = (rollout["next", "reward"].squeeze(-1) * 0.8 ** torch.arange(60)).sum(1)
    for state in range(2):
        began = rollout["observation"][:, 0, state] == 1
        error = returns[began].std() / began.sum().sqrt()
        assert returns[began].mean() == pytest.approx(solve(mdp, policy)[state], abs=float(4 * error))


def test_an_env_with_a_guide_is_still_an_env():
    mdp = Gridworld().mdp
    guide = follows(value_iteration(mdp).policy)
    check_transform(env_of(mdp, num_envs=3, max_steps=5), GuideActions({"plan": guide}))


P, R = toymaker().P, toymaker().R


def changed(array, where, value):
    copy = array.copy()
    copy[where] = value
    return copy


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"P": P[0]}, r"must both have the shape \[S, A, S\]; they have \[2, 2\], \[2, 2, 2\]"),
        ({"P": changed(P, (1, 0), [0.5, 0.6])}, r"P\[1, 0\] must be probabilities in this state, of this action"),
        ({"P": changed(P, (1, 0), [1.5, -0.5])}, r"P\[1, 0\]"),
        ({"P": changed(P, (1, 0, 0), np.nan)}, r"P\[1, 0\]"),
        ({"R": changed(R, (0, 1, 1), np.nan)}, r"R\[0, 1, 1\] must be finite"),
        ({"start": [1.0]}, "start must be 2 probabilities"),
        ({"start": [0.5, 0.6]}, "start must be probabilities: none below 0, and a sum of 1"),
        ({"num_envs": 0}, "num_envs=0 must be at least 1"),
        ({"max_steps": 0}, "max_steps=0 must be at least 1"),
    ],
)
def test_what_is_no_world_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        TabularEnv(**({"P": P, "R": R} | arguments))


def test_ppo_with_advice_learns_to_advertise():
    torch.manual_seed(0)
    mdp = toymaker()
    bare = env_of(mdp, num_envs=64, max_steps=1_000)
    env = TransformedEnv(bare, GuideActions({"plan": follows(value_iteration(mdp).policy)}))
    keys = ["observation", "guide_action"]
    ppo = PPO(env, keys, hidden=[16], learning_rate=1e-2, gamma=mdp.gamma, epochs=4, minibatches=4)
    rollout = Rollout(env, ppo.policy, steps=16)
    shares = []
    for _ in range(20):
        batch = rollout.collect()
        ppo.update(batch)
        shares.append(float(batch["action"].double().mean()))
    assert shares[0] == pytest.approx(0.5, abs=0.1)
    assert shares[-1] > 0.75
