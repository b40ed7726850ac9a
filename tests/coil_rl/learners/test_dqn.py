import numpy as np
import pytest
import torch
import worlds
from tabular_env import TabularEnv
from tensordict.nn import TensorDictModule
from torch.nn import functional as F
from torchrl.envs import GymEnv, PendulumEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import DQN
from coil_rl.schedules import Linear
from coil_rl.tabular import garnet, toymaker, value_iteration
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import DiscreteActions, GuideActions


def table(mdp, num_envs=32, **options):
    return TabularEnv(mdp.P, mdp.R, num_envs, start=mdp.start, **options)


def learner(env=None, **options):
    torch.manual_seed(0)
    env = env or table(garnet(5, 3, np.random.default_rng(0)))
    dqn = DQN(env, **{"hidden": [16], "starts": 0, "batch_size": 32, "ratio": 1} | options)
    return dqn, Rollout(env, dqn.policy, 4, dqn.keys)


def best(dqn, states):
    """The choice in each state of a table, by the deterministic policy."""
    data = TabularEnv(np.eye(states)[:, None], np.zeros((states, 1, states)), states).reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return dqn.policy(data.set("observation", torch.eye(states)))["action"].tolist()


@pytest.mark.parametrize("double", [True, False])
def test_one_step_moves_the_network_down_the_squared_distance_to_the_target(double):
    """y = r + gamma Q'(s', b) with b the best choice of Q (double) or of Q', and y = r where an episode terminated."""
    dqn, rollout = learner(double=double, gamma=0.9, tau=0.0, learning_rate=0.1)
    minibatch = rollout.collect().select(*dqn.keys).reshape(-1)
    minibatch["next", "terminated"][::3] = True
    network, copy = dqn.network.module[0].module, dqn.loss.target_value_network_params
    with torch.no_grad():
        for parameter in network.parameters():  # so that the network is not its copy any more
            parameter.add_(torch.randn_like(parameter), alpha=0.5)
        seen, following = minibatch["observation"], minibatch["next", "observation"]
        with copy.to_module(dqn.network):
            judged = network(following)
        chosen = network(following) if double else judged
        later = judged.gather(-1, chosen.argmax(-1, keepdim=True))
        target = minibatch["next", "reward"] + 0.9 * ~minibatch["next", "terminated"] * later
    value = network(seen).gather(-1, minibatch["action"].unsqueeze(-1))
    wanted = F.mse_loss(value, target)
    torch.testing.assert_close(dqn.loss(minibatch)["loss"], wanted)
    gradients = torch.autograd.grad(wanted, list(network.parameters()))
    dqn.loss(minibatch)["loss"].backward()
    for parameter, gradient in zip(network.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_the_copy_follows_the_network_by_tau():
    dqn, rollout = learner(tau=0.25)
    copy = dqn.loss.target_value_network_params
    before = copy.clone()
    dqn.replay.ratio = 1 / 4  # one minibatch
    assert dqn.update(rollout.collect())["minibatches"] == 1
    network = dqn.loss.value_network_params
    for key, value in copy.items(True, True):
        torch.testing.assert_close(value, 0.75 * before[key] + 0.25 * network[key].detach())


def test_epsilon_follows_its_schedule_and_deterministic_there_is_none():
    dqn, rollout = learner(table(toymaker(), 2_000), epsilon=Linear(1.0, 0.2, until=0.5), ratio=0)
    shares = []
    for progress in (0.0, 1.0, 1.0):
        batch = rollout.collect()
        with torch.no_grad():
            greedy = dqn.network(batch.select("observation"))["action"]
        shares.append(float((batch["action"] != greedy).float().mean()))
        assert dqn.update(batch, progress)["epsilon"] == pytest.approx(1.0 if progress == 0 else 0.2)
    assert shares == pytest.approx([0.5, 0.5, 0.1], abs=0.02)
    assert len(set(best(dqn, 2) + best(dqn, 2))) <= 2


@pytest.mark.parametrize("mdp", [toymaker(gamma=0.8), garnet(4, 2, np.random.default_rng(3))])
def test_it_finds_the_optimal_policy_of_a_table(mdp):
    dqn, rollout = learner(
        table(mdp, max_steps=1_000), gamma=mdp.gamma, ratio=4, batch_size=64, learning_rate=1e-2, tau=0.1, epsilon=1.0
    )
    for _ in range(25):
        dqn.update(rollout.collect())
    assert best(dqn, len(mdp.P)) == value_iteration(mdp).policy.tolist()


def test_with_advice_the_optimal_policy_needs_no_state():
    """Actions and advice are one-hot or numbers of a finite set alike: it sees the advice alone, and follows it."""
    mdp = garnet(4, 2, np.random.default_rng(3))
    plan = torch.as_tensor(value_iteration(mdp).policy)
    guide = TensorDictModule(lambda seen: plan[seen.argmax(-1)], in_keys=["observation"], out_keys=["action"])
    env = TransformedEnv(table(mdp, max_steps=1_000), GuideActions({"plan": guide}))
    dqn, rollout = learner(
        env, in_keys=["guide_action"], gamma=mdp.gamma, ratio=4, batch_size=64, learning_rate=1e-2, tau=0.1, epsilon=1.0
    )
    for _ in range(25):
        dqn.update(rollout.collect())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        step = dqn.policy(env.reset())
    assert torch.equal(step["action"], step["guide_action"][:, 0].argmax(-1))


def test_one_hot_actions_are_chosen_too():
    env = GymEnv("CartPole-v1")
    dqn, rollout = learner(env, ratio=8)
    assert dqn.update(rollout.collect())["minibatches"] == 1
    assert env.action_spec.is_in(dqn.policy(env.reset())["action"])


def test_steering_is_chosen_with_and_without_advice():
    env = worlds.cones(DiscreteActions(5))
    for keys in (["observation"], ["observation", "guide_action"]):
        dqn, rollout = learner(env, in_keys=keys, ratio=4)
        assert dqn.update(rollout.collect())["minibatches"] == 3
        assert dqn.network.module[0].module.layers[0].in_features == 15 + 5 * len(keys)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gamma": 1.5}, "gamma=1.5 must be"), ({"tau": 2}, "tau=2 must be"), ({"epsilon": -1}, "epsilon=-1 must be"),
        ({"epsilon": Linear(0.5, 2.0)}, "epsilon=2.0 must be"), ({"learning_rate": -1}, "learning_rate=-1 must be"),
        ({"action_gain": -1}, "action_gain=-1"), ({"hidden": [0]}, "hidden=0"), ({"batch_size": 0}, "batch_size=0"),
        ({"max_grad_norm": 0}, "max_grad_norm=0"),
    ],
)  # fmt: skip
def test_numbers_outside_their_range_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        learner(**options)


def test_an_env_that_takes_numbers_is_refused():
    with pytest.raises(ValueError, match=r"DQN takes one of .* DiscreteActions around it: action=choices"):
        DQN(PendulumEnv(), ["th"])
