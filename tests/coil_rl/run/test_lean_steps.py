"""Lean steps give the batches of TorchRL's steps, to the bit."""

import copy
import itertools
from functools import partial

import pytest
import torch
import worlds
from any_env import AnyEnv
from tensordict.nn import TensorDictModule
from torchrl.data import MultiCategorical
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl import GymnasiumEnv
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide, SplineMemoryGuide
from coil_rl.learners import PPO, Anchor, Gru
from coil_rl.run.evaluation import episodes
from coil_rl.run.lean_steps import LeanEnv, LeanSteps
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import (
    DiscreteActions,
    GuideActions,
    NoisyAdvice,
    NormalisedAction,
    ObservationNoise,
    ScaledAdvice,
    Takeover,
)

ADVISED = ["observation", "guide_action"]


def gym(name, **options):
    env = GymnasiumEnv(name, 3, max_steps=9, **options)
    return TransformedEnv(env, Compose(RewardSum(), NormalisedAction()))


PENDULUM, CART_POLE = partial(gym, "Pendulum-v1"), partial(gym, "CartPole-v1")


def brake(state):
    return -state[..., 2:].clamp(-2, 2)


def advised_pendulum():
    env = PENDULUM()
    env.append_transform(
        GuideActions({"brake": TensorDictModule(brake, ["observation"], ["action"])})
    )
    return env


def cones(*transforms):
    return worlds.cones(RewardSum(), *transforms, cars=5)


def choices():
    return cones(ScaledAdvice(0.5), DiscreteActions(3))


def several_choices():
    return TransformedEnv(AnyEnv(action=MultiCategorical([2, 3])), Compose(RewardSum()))


def collected(make_env, correlation, lean, options):
    """Three batches, with what a run logs; the last two after a restored state."""
    torch.manual_seed(0)
    env = make_env()
    ppo = PPO(env, **options)
    keys = [*ppo.keys, "loc", "action", ("next", "episode_reward"), ("next", "info", "lap")]
    known = set(env.observation_spec.keys(True, True))
    keys = [key for key in keys if key[:2] != ("next", "info") or ("info", "lap") in known]
    keys = [key for key in keys if key != "loc" or ppo.policy[-2].out_keys[0] == "loc"]
    rollout = Rollout(env, ppo.policy, 20, keys, correlation)
    assert rollout.lean is not None
    if not lean:
        rollout.lean = None
    batches = [rollout.collect()]
    if ppo.normaliser is not None:
        ppo.normaliser.learn(batches[0])
    rollout.load_state_dict(copy.deepcopy(rollout.state_dict()))
    return [*batches, rollout.collect(), rollout.collect()]


@pytest.mark.fast("choices-0.7")
@pytest.mark.parametrize("correlation", [0.0, 0.7])
@pytest.mark.parametrize(
    ("make_env", "options"),
    [
        pytest.param(cones, {"in_keys": ADVISED}, id="advice"),
        pytest.param(cones, {"in_keys": ADVISED, "squash": False}, id="clipped"),
        pytest.param(choices, {"in_keys": ADVISED}, id="choices"),
        pytest.param(several_choices, {}, id="several choices"),
        pytest.param(advised_pendulum, {"in_keys": ADVISED, "anchor": Anchor()}, id="anchored"),
        pytest.param(PENDULUM, {"normalise": True}, id="pendulum"),
        pytest.param(CART_POLE, {"normalise": "auto"}, id="cart pole"),
    ],
)
def test_lean_steps_are_those_of_torchrl_to_the_bit(make_env, options, correlation):
    ours, theirs = (collected(make_env, correlation, lean, options) for lean in (True, False))
    for one, other in zip(ours, theirs, strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        different = [key for key in one.keys(True, True) if not torch.equal(one[key], other[key])]
        assert not different
    assert any(batch["next", "done"].any() for batch in ours)


@pytest.mark.parametrize("make_env", [cones, PENDULUM, CART_POLE])
def test_episodes_are_those_of_torchrl_to_the_bit(make_env, monkeypatch):
    kept = []
    for lean in (True, False):
        env = make_env()
        torch.manual_seed(0)
        policy = PPO(env, in_keys=["observation"]).policy
        assert LeanEnv.covers(env)
        with monkeypatch.context() as patch, torch.no_grad():
            if not lean:
                patch.setattr(LeanEnv, "covers", lambda env: False)
            steps = itertools.islice(episodes(env, policy, sampled=True), 30)
            kept.append([(after.copy(), running) for _, after, running in steps])
    assert len(kept[0]) == len(kept[1])
    for (one, running), (other, theirs) in zip(*kept, strict=True):
        assert torch.equal(running, theirs)
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        assert all(torch.equal(one[key], other[key]) for key in one.keys(True, True))


@pytest.mark.parametrize("lean", [True, False])
def test_policy_finds_what_it_wrote_in_the_step_before(lean, monkeypatch):
    env, found = bare(), []
    assert LeanEnv.covers(env)
    if not lean:
        monkeypatch.setattr(LeanEnv, "covers", lambda env: False)

    def act(carrier):
        count = carrier.get("count", torch.zeros(4, 1))
        found.append(int(count[0]))
        return carrier.set("action", torch.zeros(4, 1)).set("count", count + 1)

    list(itertools.islice(episodes(env, act), 3))
    assert found == [0, 1, 2]


def bare(*transforms):
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test"), 4), Compose(*transforms))


def covered(env, **options):
    ppo = PPO(env, **options)
    found = LeanSteps.covers(env, ppo.policy, ppo.keys)
    assert (Rollout(env, ppo.policy, 2, ppo.keys).lean is not None) == found
    return found


def test_what_lean_steps_do_not_know_keeps_the_steps_of_torchrl():
    assert covered(bare(GuideActions({"guide": SplineGuide()})), in_keys=ADVISED)
    assert not covered(bare(GuideActions({"guide": SplineMemoryGuide()})), in_keys=ADVISED)
    assert not covered(bare(GuideActions({"guide": SplineGuide()}), Takeover(0.5)))
    assert not covered(bare(GuideActions({"guide": SplineGuide()}), NoisyAdvice()))
    assert not covered(bare(ObservationNoise()))
    gru = Gru(state=4)
    assert not covered(bare(*gru.env_transforms()), network=gru)
    assert not covered(AnyEnv(agents=True))
    assert not covered(worlds.carts())  # an env of TorchRL
    env = bare()
    assert not LeanSteps.covers(env, PPO(env).policy, None)
