"""Small envs with a guide, and the measures of the cone world."""

import copy
import io
import math
from functools import cache

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, GymEnv, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl import compose_train
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide
from coil_rl.measures import Measure, measures_of
from coil_rl.transforms import GuideActions

# The cone world as the authors of the paper have it, see preset=authors.
AUTHORS = {
    "rate": 60.0,
    "spline": "quadratic",
    "cone_bonus": "every_sighting",
    "held_steps": 2,
    "sight": 7.03125,
    "hold_boundary": True,
    "finish_in_sight": True,
}


@cache
def driving_measures(env="cone_track") -> dict[str, Measure]:
    """Return what an evaluation measures in an env of conf/env."""
    return measures_of(compose_train([f"env={env}"]).evaluation.measures)


def cones(*transforms, cars=6) -> TransformedEnv:
    """Return cars with the advice of the spline guide."""
    env = ConeTrackEnv(shipped_tracks("test"), cars, rate=6)
    return TransformedEnv(env, Compose(GuideActions({"spline": SplineGuide()}), *transforms))


def acting(function, *keys, out="action") -> TensorDictModule:
    """Return a module that writes what a function makes of some entries."""
    return TensorDictModule(function, in_keys=[*keys], out_keys=[out])


def pendulum(*transforms) -> TransformedEnv:
    """Return one pendulum without a batch, torque in [-2, 2]; the guide damps it."""
    damp = acting(lambda speed: -speed.unsqueeze(-1).clamp(-2, 2), "thdot")
    return TransformedEnv(PendulumEnv(), Compose(GuideActions({"damp": damp}), *transforms))


def carts(*transforms, categorical=True) -> TransformedEnv:
    """Return two cart poles with two discrete actions; the guide pushes to where the pole leans."""

    def lean(observation):
        choice = (observation[..., 2] > 0).long()
        return choice if categorical else torch.nn.functional.one_hot(choice, 2)

    def make() -> EnvBase:
        return GymEnv("CartPole-v1", categorical_action_encoding=categorical)

    guide = acting(lean, "observation")
    return TransformedEnv(SerialEnv(2, make), Compose(GuideActions({"lean": guide}), *transforms))


def road(left, right, steering=0.0, slots=16):
    """Return the arguments of `steer` of a guide of cones, for one car."""
    cones = torch.zeros(1, 2, slots, 2, dtype=torch.float64)
    for side, points in enumerate((left, right)):
        for slot, point in enumerate(sorted(points, key=lambda p: math.hypot(*p))):
            cones[0, side, slot] = torch.tensor(point, dtype=torch.float64)
    count = torch.tensor([[len(left), len(right)]])
    return cones, count, torch.full((1, 1), steering, dtype=torch.float64)


def perturbed(policy, seed):
    """Return the state of a policy with noise on its parameters."""
    torch.manual_seed(seed)
    changed = copy.deepcopy(policy)
    for parameter in changed.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return changed.state_dict()


def drive(env, steps, carrier=None, seed=0):
    """Return the entries after each step, under actions that a seed determines, and the carrier."""
    carrier = env.reset() if carrier is None else carrier
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        actions = [env.rand_action()["action"] for _ in range(steps)]
    after = []
    for action in actions:
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        after.append(step["next"])
    return after, carrier


def same(one, other):
    """Return whether two lists of entries are equal."""
    return all((a == b).all() for a, b in zip(one, other, strict=True))


def reloaded(state):
    """Return a state as a checkpoint gives it back."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def continued(make):
    """Return the second batch of a rollout, and that of a restored one.

    The latter has another seed and was restored after the first batch.
    """
    first, second = make(3), make(4)
    first.collect()
    second.load_state_dict(reloaded(first.state_dict()))
    return first.collect(), second.collect()


class Script(EnvBase):
    """Rows that show given numbers step by step, also after their episodes have ended.

    `lengths` [*B] are numbers of steps; `reward` and the other entries are [T, *B, ...], those of
    the steps.
    """

    rate = 5.0

    def __init__(self, lengths, reward, **entries):
        super().__init__(batch_size=lengths.shape)
        entries["reward"] = reward
        self.lengths, self.entries, self.time = lengths.unsqueeze(-1), entries, 0
        flag = Categorical(2, (*lengths.shape, 1), dtype=torch.bool)
        shown = {name: Unbounded(v.shape[1:], dtype=v.dtype) for name, v in entries.items()}
        self.full_reward_spec = Composite(reward=shown.pop("reward"), shape=self.batch_size)
        self.observation_spec = Composite(shown, shape=self.batch_size)
        self.action_spec = Bounded(-1, 1, (*self.batch_size, 1))
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), shape=self.batch_size)

    def _reset(self, tensordict=None, **_):
        self.time = 0
        zeros = {**self.observation_spec.zero(), **self.full_done_spec.zero()}
        return TensorDict(zeros, self.batch_size)

    def _step(self, tensordict):
        shown = {name: v[min(self.time, len(v) - 1)] for name, v in self.entries.items()}
        self.time += 1
        ended = self.time >= self.lengths
        return TensorDict({**shown, "done": ended, "terminated": ended}, self.batch_size)

    def _set_seed(self, seed):
        pass
