import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.nn import Linear
from torchrl.envs import PendulumEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import ZeroGuide
from coil_rl.learners.networks import FastTensorDictModule, actor, critic
from coil_rl.transforms import GuideActions


def test_actions_of_a_bounded_env_stay_in_its_bounds():
    env = PendulumEnv()
    policy = actor(env, ["th"], scale=10.0)
    with set_exploration_type(ExplorationType.RANDOM):
        action = policy(env.reset().expand(500).clone())["action"]
    assert action.abs().max() <= 2
    assert action.abs().max() > 1.5


def test_advice_is_flattened_into_the_observation():
    env = TransformedEnv(ConeTrackEnv(shipped_tracks("test"), 4), GuideActions({"a": ZeroGuide(), "b": ZeroGuide()}))
    policy, value = actor(env, ["observation", "guide_action"]), critic(env, ["observation", "guide_action"])
    data = value(policy(env.reset()))
    assert policy.module[0].module.network.layers[0].in_features == 22
    assert data["action"].shape == data["state_value"].shape == (4, 1)


def test_fast_module_computes_what_a_tensordict_module_computes():
    split = Linear(3, 4)
    ours, theirs = (
        kind(lambda x: tuple(split(x).chunk(2, -1)), ["x"], ["a", "b"])
        for kind in (FastTensorDictModule, TensorDictModule)
    )
    data = TensorDict({"x": torch.randn(5, 3)}, [5])
    assert (ours(data.clone()) == theirs(data.clone())).all()
