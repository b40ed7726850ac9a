"""The same problem in other units of the action gives the same digits, for every method."""

import math
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from programs import read_csv, shipped
from torchrl.envs import ExplorationType, set_exploration_type

import coil_rl

METHODS = shipped("method")
WITHOUT_GUIDE = ("ppo",)
IN_ALL_BOXES = ("coil", "residual")

TINY = ["budget.num_envs=4", "budget.steps=16", "evaluation.cases=2", "logger=none"]
TINY += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1", "evaluation.gif=false"]
ON_POLICY = ["learner.minibatches=2", "learner.epochs=3"]
REPLAY = ["learner.starts=16", "learner.updates_per_step=0.015625", "learner.batch_size=16"]
FOREST = ["learner.regressor.n_estimators=3"]
OPTIONS = dict.fromkeys(("cheq", "ibrl", "policy_decorator", "rlpd", "wsrl", "q_filter"), REPLAY)
OPTIONS |= {"dagger": FOREST, "oil": FOREST, "coil_anchored": ["learner=ppo", *ON_POLICY]}
PROXY = ["proxy.budget.frames=64", "proxy.budget.num_envs=4", "proxy.budget.steps=16"]

INF = math.inf
BOXES = {
    "unit": ([-1, -1], [1, 1]),
    "0 to 1": ([0, 0], [1, 1]),
    "0 to 2000": ([0, 0], [2000, 2000]),
    "shifted": ([200, -7], [1000, -3]),
    "different": ([0, -5], [1, 3000]),
}
HALF = {
    "from -1": ([-1, -1], [INF, INF]),
    "from 0": ([0, 0], [INF, INF]),
    "from 16": ([16, -32], [INF, INF]),
}


class Units:
    """Centre and half width of the coordinates of a box; 1 from a bound to the centre."""

    def __init__(self, low, high):
        self.low, self.high = np.array(low, np.float64), np.array(high, np.float64)
        top = np.where(np.isfinite(self.high), self.high, self.low + 2)
        self.centre, self.unit = (self.low + top) / 2, (top - self.low) / 2

    def normalised(self, action):
        return (np.asarray(action, np.float64) - self.centre) / self.unit

    def own(self, number):
        return self.centre + self.unit * number


class Plant(gymnasium.Env):
    """Two numbers that the normalised action pushes; the best action depends on them."""

    def __init__(self, low, high, reward_unit=1.0, render_mode=None):
        self.units, self.reward_unit = Units(low, high), reward_unit
        self.observation_space = Box(-10, 10, (2,), np.float32)
        self.action_space = Box(np.float32(low), np.float32(high), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.state.astype(np.float32), {}

    def step(self, action):
        pushed = np.clip(self.units.normalised(action), -1, 3)
        reward = -float(np.square(pushed - best(self.state)).sum())
        self.state = 0.8 * self.state + 0.3 * pushed
        self.steps += 1
        over = self.steps >= 10
        return self.state.astype(np.float32), self.reward_unit * reward, False, over, {}


def best(state):
    return -0.4 + 0.2 * np.asarray(state, np.float64)


class Near:
    """A controller that advises, in the unit of the env, a little more than the best action."""

    def __init__(self, units):
        self.units = units

    def act(self, observation):
        return self.units.own(best(observation) + 0.1)


def run_in(folder, box, method, *overrides, frames=128, reward_unit=1.0):
    low, high = box
    words = [*TINY, *OPTIONS.get(method, ON_POLICY)]
    if method.startswith("dynamic_coil"):
        words += [*PROXY, f"proxy.folder={folder}_proxies"]
    return coil_rl.prepare(
        partial(Plant, low, high, reward_unit),
        guide=None if method in WITHOUT_GUIDE else Near(Units(low, high)),
        method=method,
        frames=frames,
        folder=folder,
        overrides=[*words, *overrides],
    )


def learned(folder, box, method, *overrides, **options):
    """Return a run that has learned, and its actions in ten states, normalised."""
    run = run_in(folder, box, method, *overrides, **options)
    run.begin()
    run.learn()
    controller, units = run.controller(), Units(*box)
    states = np.random.default_rng(0).uniform(-1, 1, (10, 2)).astype(np.float32)
    return run, np.ravel([units.normalised(controller.act(s)) for s in states]).tolist()


def digits(folder, box, method, *overrides):
    """Return the numbers of the log of a run, and the returns of its policy, normalised actions."""
    run, actions = learned(folder, box, method, *overrides)
    rows = read_csv(run.folder / "metrics.csv")
    numbers = {name: [float(row[name] or "nan") for row in rows] for name in rows[0]}
    numbers = {name: values for name, values in numbers.items() if "time" not in name}
    return numbers | {"actions": actions}


def check_equal(folder, boxes, method, *overrides):
    (first, *others) = boxes.items()
    expected = digits(folder / "first", first[1], method, *overrides)
    assert np.ptp(expected["actions"]) > 0
    for name, box in others:
        found = digits(folder / name, box, method, *overrides)
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_allclose(
                found[key], values, rtol=1e-3, atol=2e-4, err_msg=f"{method} in {name}: {key}"
            )


# There is nothing to tune.
@pytest.mark.slow
@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("guide", "tune")])
def test_every_method_has_equal_digits_in_every_box(method, tmp_path):
    boxes = BOXES
    if method not in IN_ALL_BOXES:
        boxes = {name: BOXES[name] for name in ("unit", "different")}
    check_equal(tmp_path, boxes, method)


# What is added to the reward by rfc is in its unit, and there is nothing to tune.
@pytest.mark.slow
@pytest.mark.parametrize("method", sorted({*METHODS} - {"guide", "tune", "rfc", "coil_rfc"}))
def test_every_method_learns_the_same_in_every_unit_of_the_reward(method, tmp_path):
    frames = 256  # two updates with a policy that has learned
    found = [
        learned(tmp_path / str(unit), BOXES["unit"], method, frames=frames, reward_unit=unit)[1]
        for unit in (1.0, 2.0**14)
    ]
    assert np.ptp(found[0]) > 0
    assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    ["coil", "residual", "q_filter", "coil_anchored", "rlpd", "cheq", "ibrl", "residual_coil"],
)
def test_half_bounded_actions_have_equal_digits_wherever_the_bound_is(method, tmp_path):
    boxes = HALF
    if method != "residual":
        boxes = {name: HALF[name] for name in ("from -1", "from 16")}
    check_equal(tmp_path, boxes, method)


@pytest.mark.slow
def test_random_actions_earn_the_same_wherever_the_bound_is(tmp_path):
    earned = [run_in(tmp_path / name, box, "coil").trial.chance() for name, box in HALF.items()]
    assert earned == pytest.approx([earned[0]] * len(HALF), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("squash", ["true", "false"])
def test_clipped_actions_have_equal_digits_too(squash, tmp_path):
    boxes = {name: BOXES[name] for name in ("unit", "shifted")}
    check_equal(tmp_path, boxes, "ppo", f"learner.squash={squash}")


@pytest.mark.slow
@pytest.mark.parametrize("box", [*BOXES, *HALF])
@pytest.mark.parametrize("method", ["residual", "residual_coil", "policy_decorator"])
def test_residual_policy_is_its_guide_at_first(method, box, tmp_path):
    box = (BOXES | HALF)[box]
    run = run_in(tmp_path / "run", box, method)
    env = run.make_env(3).eval()
    policy = run.make_learner(env).policy
    units = Units(*box)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        carrier = env.reset()
        for _ in range(5):
            seen = carrier["observation"].numpy()
            _, carrier = env.step_and_maybe_reset(policy(carrier))
            executed = env.base_env._decode(env.base_env.actions[-1])
            expected = Near(units).act(seen)
            np.testing.assert_allclose(
                units.normalised(executed), units.normalised(expected), rtol=0, atol=1e-5
            )
