import numpy as np
import pytest
import torch
from tabular_env import TabularEnv
from torch.nn import functional as F
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from worlds import acting

from coil_paper.tabular import garnet, toymaker, value_iteration
from coil_rl.learners import DQN
from coil_rl.learners.policy import Entries
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.transforms import GuideActions


def table(mdp, num_envs=32, **options):
    return TabularEnv(mdp.P, mdp.R, num_envs, start=mdp.start, **options)


def make(env=None, **options):
    torch.manual_seed(0)
    env = env or table(garnet(5, 3, np.random.default_rng(0)))
    dqn = DQN(
        env,
        **{"hidden": [16], "starts": 0, "batch_size": 32, "updates_per_step": 0.03125} | options,
    )
    return dqn, Rollout(env, dqn.policy, 4, dqn.keys)


@pytest.mark.parametrize("double", [True, False])
def test_loss_is_the_squared_distance_to_the_target(double):
    """y = r + gamma Q'(s', b), b the best action of Q (double) or Q'; y = r at the last step."""
    dqn, rollout = make(double=double, gamma=0.9, tau=0.0, learning_rate=0.1)
    minibatch = Entries(rollout.collect().select(*dqn.keys).reshape(-1).items(True, True))
    minibatch["next", "terminated"][::3] = True
    network = dqn.values.module
    with torch.no_grad():
        vector = dqn.of_values.vector  # network and target network must differ
        vector.add_(torch.randn_like(vector), alpha=0.5)
        after = minibatch["next", "observation"]
        next_values = dqn.target.module(after)
        selecting = network(after) if double else next_values
        best = next_values.gather(-1, selecting.argmax(-1, keepdim=True))
        target = minibatch["next", "reward"] + 0.9 * ~minibatch["next", "terminated"] * best
    value = network(minibatch["observation"]).gather(-1, minibatch["action"].unsqueeze(-1))
    expected = F.mse_loss(value, target)
    found = dqn.losses(minibatch)["loss"]
    torch.testing.assert_close(found, expected)
    written = torch.autograd.grad(expected, list(network.parameters()))
    gradient = torch.autograd.grad(found, vector)[0]
    torch.testing.assert_close(gradient, torch.cat([each.flatten() for each in written]))


def test_epsilon_follows_its_schedule():
    dqn, rollout = make(
        table(toymaker(), 2_000), epsilon=Linear(1.0, 0.2, until=0.5), updates_per_step=0
    )
    shares = []
    for progress in (0.0, 1.0, 1.0):
        batch = rollout.collect()
        with torch.no_grad():
            best = dqn.choice(dqn.values(batch.select("observation")))["action"]
        shares.append(float((batch["action"] != best).float().mean()))
        assert dqn.update(batch, progress)["epsilon"] == pytest.approx(
            1.0 if progress == 0 else 0.2
        )
    assert shares == pytest.approx([0.5, 0.5, 0.1], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mdp", "key"),
    [
        (toymaker(gamma=0.8), "observation"),
        (garnet(4, 2, np.random.default_rng(3)), "observation"),
        (garnet(4, 2, np.random.default_rng(3)), "guide_action"),
    ],
    ids=["toymaker", "garnet", "optimal advice only"],
)
def test_dqn_finds_the_optimal_policy_of_a_table(mdp, key):
    optimal = torch.as_tensor(value_iteration(mdp).policy)
    guide = acting(lambda state: optimal[state.argmax(-1)], "observation")
    env = TransformedEnv(table(mdp, max_steps=1_000), GuideActions({"optimal": guide}))
    options = {
        "gamma": mdp.gamma,
        "updates_per_step": 0.125,
        "batch_size": 64,
        "learning_rate": 1e-2,
        "tau": 0.1,
        "epsilon": 1.0,
    }
    dqn, rollout = make(env, in_keys=[key], **options)
    for _ in range(25):
        dqn.update(rollout.collect())
    batch = Rollout(env, dqn.policy, 8).collect()
    states = batch["observation"].argmax(-1)
    assert states.unique().tolist() == list(range(len(mdp.P)))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        assert torch.equal(dqn.policy(batch)["action"], optimal[states])
