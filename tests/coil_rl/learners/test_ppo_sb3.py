"""`learner=ppo_sb3` is PPO of Stable-Baselines3 with its default values."""

import copy
from functools import partial

import gymnasium
import pytest
import torch
import worlds
from cart_poles import CartPoles
from omegaconf import OmegaConf
from programs import CONF
from tensordict import TensorDict
from torch import nn

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.envs.gym import ConeTrackGym
from coil_rl.learners import A2C, PPO, TRPO, Reinforce
from coil_rl.run.rollout import Rollout

CONFIG = OmegaConf.to_container(OmegaConf.load(CONF / "learner" / "ppo_sb3.yaml"))
OPTIONS = {
    key: value
    for key, value in CONFIG["learner"].items()
    if key not in ("_target_", "seed", "normalise", "scale_rewards")
}  # without normaliser: the defaults of Stable-Baselines3 have none


@pytest.mark.fast(2)
@pytest.mark.parametrize("kind", [PPO, A2C, TRPO, Reinforce])
def test_learners_learn_from_the_unclipped_sample(kind):
    torch.manual_seed(0)
    env = worlds.cones(cars=16)
    learner = kind(env, action_scale=3.0, squash=False, minibatches=2)
    batch = Rollout(env, learner.policy, 8).collect()
    weights = []
    for offset in (0.0, 0.0, 0.1):
        other = copy.deepcopy(learner)
        rows = batch.clone()
        rows["action"] *= 0
        rows["unclipped_action"] += offset
        other.update(rows)
        weights.append(nn.utils.parameters_to_vector(other.policy.parameters()))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def linears(*modules):
    return [
        layer for module in modules for layer in module.modules() if isinstance(layer, nn.Linear)
    ]


def stable_baselines3(env, **options):
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    return sb3.PPO("MlpPolicy", env, seed=0, device="cpu", **options)


def batch_of(model):
    """Return the rollout of a model of Stable-Baselines3, [1, T].

    Rewards of truncated steps contain the last value.
    """
    buffer = model.rollout_buffer
    names = ("observations", "actions", "rewards", "episode_starts", "log_probs")
    parts = {name: torch.from_numpy(getattr(buffer, name).copy()).transpose(0, 1) for name in names}
    observation, action = parts["observations"], parts["actions"]
    starts = parts["episode_starts"].unsqueeze(-1)
    done = torch.cat(
        [starts[:, 1:], torch.from_numpy(model._last_episode_starts)[:, None, None]], 1
    ).bool()
    after = torch.cat([observation[:, 1:], torch.from_numpy(model._last_obs)[:, None]], 1)
    ends = {"reward": parts["rewards"].unsqueeze(-1), "done": done, "terminated": done}
    rows = {"observation": observation, "next": {"observation": after} | ends}
    rows |= {
        "unclipped_action": action,
        "action": action.squeeze(-1).long(),
        "action_log_prob": parts["log_probs"],
    }
    return TensorDict(rows, done.shape[:2])


@pytest.mark.parametrize(
    ("env", "gym_env"),
    [
        (
            partial(ConeTrackEnv, shipped_tracks("test"), 1),
            partial(ConeTrackGym, shipped_tracks("test")),
        ),
        (partial(CartPoles, 1), partial(gymnasium.make, "CartPole-v1")),
    ],
    ids=["continuous", "discrete"],
)
def test_update_gives_the_weights_of_stable_baselines3(env, gym_env):
    torch.manual_seed(0)
    default = stable_baselines3(gym_env())
    budget, minibatches = CONFIG["budget"], default.n_steps // default.batch_size
    assert (default.n_envs, default.n_steps, minibatches) == (
        budget["num_envs"],
        budget["steps"],
        OPTIONS["minibatches"],
    )

    # One minibatch, as their order is drawn in another way.
    model = stable_baselines3(gym_env(), n_steps=256, batch_size=256)
    _, callback = model._setup_learn(256)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 256)
    ours, theirs = PPO(env(), **OPTIONS | {"minibatches": 1}), model.policy
    extractor = theirs.mlp_extractor
    their_layers = linears(
        extractor.policy_net, theirs.action_net, extractor.value_net, theirs.value_net
    )
    layers = list(zip(linears(ours.policy, ours.critic), their_layers, strict=True))
    for one, other in layers:
        torch.testing.assert_close(one.weight.norm(), other.weight.norm())
        one.load_state_dict(other.state_dict())
    own, other = ({**dict(policy.named_parameters())} for policy in (ours.policy, theirs))
    scales = [(own[name], other["log_std"]) for name in own if name.endswith("log_scale")]
    for one, other in scales:
        torch.testing.assert_close(one, other)

    batch = batch_of(model)
    assert batch["next", "done"].any()
    before = [one.weight.detach().clone() for one, _ in layers]
    ours.update(batch)
    model.train()
    for one, other in [*((one.weight, other.weight) for one, other in layers), *scales]:
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
    assert all(
        (one.weight - old).abs().max() > 1e-4 for (one, _), old in zip(layers, before, strict=True)
    )
