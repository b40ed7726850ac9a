"""Envs and controllers of other people, each with something unusual, for `test_odd_inputs.py`."""

import decimal
import fractions

import gymnasium
import numpy as np
from gymnasium import spaces


class Plain(gymnasium.Env):
    """Two numbers; the best action is the first of them. An episode has ten steps."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.look(), {}

    def step(self, action):
        reward = -abs(float(self.seen[0]) - float(np.sum(np.asarray(action, np.float64))))
        self.steps += 1
        return self.look(), reward, False, self.steps >= 10, {}

    def look(self):
        self.seen = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.seen


class Odd(Plain):
    """The answer of one call has one thing replaced, from a step on.

    Args:
        part: observation, reward, terminated, truncated, info, step or reset.
        kind: name in `ODD`.
        at: step from which on.
    """

    def __init__(self, part="reward", kind="none", at=0):
        self.part, self.kind, self.at = part, kind, at

    def reset(self, *, seed=None, options=None):
        answer = super().reset(seed=seed)
        if self.part == "reset":
            return ODD[self.kind]
        if self.part == "first":
            return ODD[self.kind], answer[1]
        return answer

    def step(self, action):
        answer = list(super().step(action))
        if self.steps <= self.at:
            return tuple(answer)
        if self.part == "step":
            return ODD[self.kind]
        names = ("observation", "reward", "terminated", "truncated", "info")
        if self.part in names:
            answer[names.index(self.part)] = ODD[self.kind]
        return tuple(answer)


ODD = {
    "none": None,
    "text": "high",
    "infinite": float("inf"),
    "no_number": float("nan"),
    "complex": 1 + 2j,
    "list": [1.0],
    "two": [1.0, 2.0],
    "dict": {"a": 1},
    "empty": (),
    "six": (np.zeros(2, np.float32), 0.0, False, False, {}, 1),
    "three": (np.zeros(2, np.float32), {}, 1),
    "matrix": np.zeros((2, 1), np.float32),
    "column": np.zeros((1, 2), np.float32),
    "long": np.zeros(3, np.float32),
    "huge": np.array([1e30, 0.0]),
    "numbers": [0.25, 0.5],
    "objects": np.array([None, 1], object),
    "decimal": decimal.Decimal("0.5"),
    "fraction": fractions.Fraction(1, 2),
    "int": 2,
    "yes": True,
    "one": 1,
    "half": 0.5,
    "array": np.array(0.5),
    "array1": np.array([0.5]),
    "bytes": b"a",
    "set": {1},
    "pairs": [("a", 1)],
    "npbool": np.bool_(True),
}


class Raises(Plain):
    """It raises in one of its calls.

    Args:
        call: reset, step or init.
        error: name of an exception.
    """

    def __init__(self, call="step", error="ValueError"):
        self.call, self.error = call, getattr(__import__("builtins"), error)
        if call == "init":
            raise self.error("the valve\nis stuck")

    def reset(self, *, seed=None, options=None):
        if self.call == "reset":
            raise self.error("the valve\nis stuck")
        return super().reset(seed=seed)

    def step(self, action):
        if self.call == "step":
            raise self.error("the valve\nis stuck")
        return super().step(action)


SPACES = {
    "plane": spaces.Box(-1, 1, (1,)),
    "wide": spaces.Box(200, 1000, (1,)),
    "unit": spaces.Box(0, 1, (1,)),
    "half": spaces.Box(np.float32([0.0]), np.float32([np.inf])),
    "free": spaces.Box(-np.inf, np.inf, (1,)),
    "point": spaces.Box(3, 3, (1,)),
    "scalar": spaces.Box(0, 10, ()),
    "matrix": spaces.Box(-2, 2, (2, 2)),
    "whole": spaces.Box(-2, 2, (1,), np.int64),
    "many": spaces.Box(0, 10**6, (1,), np.int64),
    "from5": spaces.Discrete(3, start=5),
    "from_minus": spaces.Discrete(3, start=-1),
    "single": spaces.Discrete(1),
    "multi": spaces.MultiDiscrete([3, 2]),
    "multi_start": spaces.MultiDiscrete([3, 2], start=[1, 10]),
    "flags": spaces.MultiBinary(2),
    "flags2": spaces.MultiBinary((2, 2)),
    "dict": spaces.Dict({"a": spaces.Discrete(2)}),
    "tuple": spaces.Tuple((spaces.Discrete(2),)),
    "text": spaces.Text(5),
    "sequence": spaces.Sequence(spaces.Discrete(2)),
    "zero": spaces.Box(-1, 1, (0,)),
    "half_floats": spaces.Box(-1, 1, (1,), np.float16),
    "missing": None,
}


class Acts(Plain):
    """Its action space is one of `SPACES`.

    Args:
        space: the name.
    """

    def __init__(self, space="wide"):
        self.action_space = SPACES[space]


class Sees(Plain):
    """Its observation space is one of `SPACES`, and it observes a sample of it.

    Args:
        space: the name.
    """

    def __init__(self, space="wide"):
        self.observation_space = SPACES[space]

    def look(self):
        self.seen = np.zeros(2)
        return self.observation_space.sample()


def none(observation):
    return None


def text(observation):
    return "left"


def nan(observation):
    return float("nan")


def state_too(observation):
    return observation[:1], None


def two(observation):
    return observation[:2]


def first(observation):
    return observation[:1]


def number(observation):
    return float(observation[0])


def seven(observation):
    return 7


def six(observation):
    return 6


def half(observation):
    return 0.5


def raises(observation):
    raise RuntimeError("no map\nloaded")


def exits(observation):
    raise SystemExit(3)


def keyed(observation):
    return {"action": observation[:1]}


def far(observation):
    return np.array([5e6])


class NoAct:
    pass


class TwoNumbers:
    def act(self, observation):
        return [1.0, 2.0]


class NeedsPath:
    def __init__(self, path):
        self.path = path

    def act(self, observation):
        return observation[:1]


class LateNone:
    """It forgets to return an action after the first step."""

    def __init__(self):
        self.steps = 0

    def act(self, observation):
        self.steps += 1
        return observation[:1] if self.steps < 2 else None


class BadReset:
    def act(self, observation):
        return observation[:1]

    def reset(self):
        raise KeyError("gain")


constant = 3
