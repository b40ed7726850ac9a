"""Small envs with a guide."""

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, EnvBase, GymEnv, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide
from coil_rl.transforms import GuideActions


def cones(*transforms, cars=6) -> TransformedEnv:
    """Return cars with the advice of the spline guide."""
    env = ConeTrackEnv(shipped_tracks("test"), cars, rate=6)
    return TransformedEnv(env, Compose(GuideActions({"spline": SplineGuide()}), *transforms))


def without_rate(**options) -> ConeTrackEnv:
    """Return cars whose control rate is not known."""
    env = ConeTrackEnv(**options)
    del env.rate
    return env


def pendulum(*transforms) -> TransformedEnv:
    """Return one pendulum without a batch, torque in [-2, 2]; the guide damps it."""
    damp = TensorDictModule(lambda speed: -speed.unsqueeze(-1).clamp(-2, 2), in_keys=["thdot"], out_keys=["action"])
    return TransformedEnv(PendulumEnv(), Compose(GuideActions({"damp": damp}), *transforms))


def carts(*transforms, categorical=True) -> TransformedEnv:
    """Return two cart poles with two discrete actions; the guide pushes to where the pole leans."""

    def lean(observation):
        choice = (observation[..., 2] > 0).long()
        return choice if categorical else torch.nn.functional.one_hot(choice, 2)

    def make() -> EnvBase:
        return GymEnv("CartPole-v1", categorical_action_encoding=categorical)

    guide = TensorDictModule(lean, in_keys=["observation"], out_keys=["action"])
    return TransformedEnv(SerialEnv(2, make), Compose(GuideActions({"lean": guide}), *transforms))
