"""What envs and controllers of others raise or return is one sentence, and never a wrong number."""

import sys
from fractions import Fraction

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from coil_rl import GymnasiumEnv
from coil_rl.envs.gate import LIMIT, ForeignError, Predictor, predicts

STEP = 3  # at which a `Plant` does what it is told
BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)


class Plant(gymnasium.Env):
    """Answers as Gymnasium wants it, but for one answer."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, space=BOX, answer=None, reset=None, action=None, end=20, render_mode=None):
        self.observation_space, self.answer, self.first, self.end = space, answer, reset, end
        self.action_space = action or spaces.Box(-1, 1, (1,), np.float32)
        self.render_mode = render_mode

    def good(self):
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.time = 0
        return (self.good(), {}) if self.first is None else self.first(self.good())

    def step(self, action):
        self.time += 1
        answer = [self.good(), 1.0, False, self.time == self.end, {}]
        return self.answer(answer) if self.answer and self.time == STEP else tuple(answer)


def answered(**arguments):
    """Return the entries of an env after each step, until the one with the answer."""
    env = GymnasiumEnv(lambda **_: Plant(**arguments), 2, first_seed=7)
    carrier, after = env.reset(), []
    for _ in range(STEP):
        step, carrier = env.step_and_maybe_reset(env.rand_action(carrier))
        after.append(step["next"])
    return after


def put(index, value):
    """Return what replaces one of the five values of a step."""

    def change(answer):
        answer[index] = value
        return tuple(answer)

    return change


def fail(error):
    def change(answer):
        raise error

    return change


PLACE = r"^the env .*\(row 0, seed 7, step 3\): "


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda a: None, "step returned None, not the five of Gymnasium"),
        (lambda a: tuple(a[:4]), "step returned 4 values, not the five"),
        (lambda a: (*a, 1), "step returned 6 values, not the five"),
        (lambda a: np.zeros(5), r"step returned \[0.0, 0.0, .*, not the five"),
        (lambda a: dict(enumerate(a)), "step returned {0: .*, not the five"),
        (lambda a: (a[0], a[1], a[4], a[2], a[3]), "info of step is False, not a dictionary"),
        (put(1, None), "the reward is None, not one number"),
        (put(1, np.zeros(2)), r"the reward is \[0.0, 0.0\], not one number"),
        (put(1, np.zeros(1)), r"the reward is \[0.0\], not one number"),
        (put(1, torch.zeros(1)), r"the reward is \[0.0\], not one number"),
        (put(1, [1.0]), r"the reward is \[1.0\], not one number"),
        (put(1, "1.0"), "the reward is '1.0', not one number"),
        (put(1, 1 + 2j), "the reward is .*, not one number"),
        (put(1, float("nan")), "the reward is nan, not a finite number"),
        (put(1, float("-inf")), "the reward is -inf, not a finite number"),
        (put(1, 1e300), r"the reward is 1e\+300, not a finite number of float32"),
        (put(1, 10**400), "the reward is 1000.*, not one number"),
        (put(2, None), "terminated is None, not True or False"),
        (put(2, "False"), "terminated is 'False', not True or False"),
        (put(3, 0.5), "truncated is 0.5, not True or False"),
        (put(3, np.array([True, False])), r"truncated is \[True, False\], not True"),
        (put(3, {}), "truncated is {}, not True or False"),
        (put(4, None), "info of step is None, not a dictionary"),
        (put(4, [("a", 1)]), "info of step is .*, not a dictionary"),
        (put(0, None), "the observation is None, not an array of numbers"),
        (
            put(0, np.zeros((1, 2))),
            r"the observation has the shape \[1, 2\], but its space has \[2",
        ),
        (put(0, np.zeros(3)), r"the observation has the shape \[3\]"),
        (put(0, 0.5), r"the observation has the shape \[\]"),
        (put(0, ["a", "b"]), "the observation is .*, not an array of numbers"),
        (put(0, [0.0, [1.0]]), "the observation is .*, not an array of numbers"),
        (put(0, [0.0, None]), "the observation is .*, not an array of numbers"),
        (put(0, np.zeros(2, complex)), "the observation is .*, not an array of numbers"),
        (put(0, np.ma.array([0.0, 1.0], mask=[True, False])), "is .*, not an array of numbers"),
        (put(0, {"x": 0.0}), "the observation is .*, not an array of numbers"),
        (put(0, [0.0, np.nan]), "the observation holds nan, not a finite number"),
        (put(0, [0.0, 1e300]), r"the observation holds 1e\+300, not a finite number of float32"),
        (fail(KeyError("pump")), "step raised KeyError: 'pump'"),
        (fail(ZeroDivisionError()), "step raised ZeroDivisionError: without a text"),
        (fail(ValueError("two\n\nlines  " + 500 * "x")), r"step raised ValueError: two lines"),
        (fail(AssertionError()), "step raised AssertionError"),
        (fail(SystemExit(0)), "step raised SystemExit: 0"),
        (fail(StopIteration()), "step raised StopIteration"),
    ],
)
def test_fault_in_a_step_is_one_sentence_with_its_place(answer, message):
    with pytest.raises(ForeignError, match=PLACE + ".*" + message) as caught:
        answered(answer=answer)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_exception_of_an_env_is_chained():
    error = KeyError("pump")
    with pytest.raises(ForeignError) as caught:
        answered(answer=fail(error))
    assert caught.value.__cause__ is error


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        (lambda x: None, r"reset returned None, not the two of Gymnasium \(observation, info\)"),
        (lambda x: x, r"reset returned \[.*\], not the two"),  # two numbers, which would unpack
        (lambda x: (x,), "reset returned 1 values, not the two"),
        (lambda x: (x, 0.0), "info of reset is 0.0, not a dictionary"),
        (lambda x: ({}, x), r"info of reset is \["),
        (lambda x: (x[:1], {}), r"the observation has the shape \[1\]"),
        (lambda x: (x * np.nan, {}), "the observation holds nan"),
        (fail(RuntimeError("no key")), "reset raised RuntimeError: no key"),
    ],
)
def test_fault_in_a_reset_is_one_sentence_with_its_place(reset, message):
    with pytest.raises(ForeignError, match=r"\(row 0, seed 7, step 0\): " + message):
        answered(reset=reset)


DICT = spaces.Dict({"a": BOX, "in": spaces.Dict({"b": spaces.Discrete(3, start=5)})})
TWO = spaces.Tuple([spaces.Discrete(2), BOX])


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (spaces.Box(-1, 1, (2, 3)), np.zeros((3, 2)), r"has the shape \[3, 2\], but .* \[2, 3\]"),
        (spaces.Box(-1, 1, (2, 3)), np.zeros(6), r"has the shape \[6\], but its space has \[2, 3"),
        (spaces.Box(-1, 1, (3,)), np.zeros((3, 1)), r"has the shape \[3, 1\]"),
        (
            spaces.Box(0, 255, (2,), np.uint8),
            [0.5, 0.25],
            "the observation holds 0.5, which is not",
        ),
        (spaces.Box(0, 255, (2,), np.uint8), [0, 256], "the observation holds 256, which is not"),
        (spaces.Box(0, 255, (2,), np.uint8), [0, -1], "the observation holds -1, which is not in"),
        (spaces.MultiBinary(2), [0, 2], "the observation holds 2, which is not in MultiBinary"),
        (spaces.Discrete(3), 3, "the observation holds 3, which is not in Discrete"),
        (spaces.Discrete(3), -1, "the observation holds -1, which is not in Discrete"),
        (spaces.Discrete(3, start=5), 2, "the observation holds 2, which is not in Discrete"),
        (spaces.Discrete(3), 1.5, "the observation holds 1.5, which is not in Discrete"),
        (spaces.Discrete(3), [0, 1], r"has the shape \[2\], but its space has \[\]"),
        (spaces.MultiDiscrete([2, 3]), [2, 0], "the observation holds 2, which is not in Multi"),
        (DICT, {"a": np.zeros(2)}, r"observation.in.b is missing: the observation has \['a'\]"),
        (DICT, {"a": np.zeros(2), "in": {"c": 5}}, r"in.b is missing: .* has \['c'\], but .* 'b'"),
        (DICT, np.zeros(2), "the observation.a is missing"),
        (TWO, (1,), "the observation.1 is missing: the observation is .*, not the tuple"),
        (TWO, {"0": 1}, "the observation.0 is missing"),
    ],
)
def test_observation_that_is_not_in_its_space_is_refused(space, value, message):
    with pytest.raises(ForeignError, match=PLACE + ".*" + message):
        answered(space=space, answer=put(0, value))


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (BOX, [1, 2], [1.0, 2.0]),
        (BOX, (1.0, np.float64(2)), [1.0, 2.0]),
        (BOX, torch.tensor([1.0, 2.0], requires_grad=True), [1.0, 2.0]),
        (BOX, np.array([True, False]), [1.0, 0.0]),
        (spaces.Box(-1, 1, ()), np.float64(0.5), [0.5]),
        (spaces.Box(-1, 1, ()), [0.5], [0.5]),
        (spaces.Box(-1, 1, (1,)), 0.5, [0.5]),
        (spaces.Box(0, 255, (2,), np.uint8), [1.0, 255], [1, 255]),
        (spaces.Discrete(3), np.array([2]), [0, 0, 1]),
        (spaces.Discrete(2), True, [0, 1]),
        (spaces.Discrete(3), 2.0, [0, 0, 1]),
        (spaces.MultiDiscrete([2, 3]), [1, 2], [0, 1, 0, 0, 1]),
        (spaces.MultiBinary(2), [True, False], [1, 0]),
    ],
)
def test_observation_in_another_dress_is_taken(space, value, expected):
    assert answered(space=space, answer=put(0, value))[-1]["observation"][0].tolist() == expected


@pytest.mark.parametrize(
    "reward", [2, np.float64(2), np.array(2.0), torch.tensor(2.0), Fraction(2), np.int64(2)]
)
def test_every_kind_of_number_is_a_reward(reward):
    assert answered(answer=put(1, reward))[-1]["reward"].tolist() == [[2.0], [2.0]]


@pytest.mark.parametrize("flag", [True, np.True_, 1, np.array(True), torch.tensor(True), 1.0])
def test_every_kind_of_flag_ends_an_episode(flag):
    assert answered(answer=put(2, flag))[-1]["terminated"].tolist() == [[True], [True]]


BUFFER = np.zeros(2, np.float32)


class Shared(Plant):
    """Returns one buffer at every step, in all envs of a process."""

    def good(self):
        BUFFER[:] = self.np_random.uniform(size=2)
        return BUFFER


class Own(Plant):
    def good(self):
        return self.np_random.uniform(size=2).astype(np.float32)


def test_buffer_that_all_envs_share_is_harmless():
    def controller(env, observation):
        return observation[:1]

    def driven(kind):
        env = GymnasiumEnv(lambda **_: kind(), 3, seed=1, controllers={"own": controller})
        env.action_spec.rand()
        torch.manual_seed(0)
        return env.rollout(6, break_when_any_done=False)

    shared, own = driven(Shared), driven(Own)
    assert (shared == own).all()
    assert shared["observation"].unique().numel() == 2 * 3 * 6


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (spaces.Box(np.array([-1, 2.0]), np.array([1, 2.0])), "number 1 of .* bounds 2.0 and 2.0"),
        (spaces.Box(0, 0, (1,)), "number 0 of the action of .* has the bounds 0.0 and 0.0"),
        (spaces.Box(-1, 1, (0,)), r"has the shape \[0\]: it has no number"),
        (3, "the action_space of .* is 3, not a space of Gymnasium"),
        (spaces.Text(3), "is a Text space: replace it with a wrapper"),
    ],
)
def test_action_that_leaves_no_choice_is_refused(action, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnv(lambda **_: Plant(action=action))


def test_bounds_that_are_no_numbers_or_in_the_wrong_order_are_refused():
    for low, high in ((np.nan, 1.0), (1.0, -1.0)):
        space = spaces.Box(-1, 1, (1,))
        space.low, space.high = np.array([low]), np.array([high])
        with pytest.raises(ValueError, match=r"number 0 of the action of .* has the bounds"):
            GymnasiumEnv(lambda **_: Plant(action=space))  # noqa: B023


class Broken(Plant):
    @property
    def action_space(self):
        raise NotImplementedError("later")

    @action_space.setter
    def action_space(self, space):
        pass


@pytest.mark.parametrize(
    ("maker", "message"),
    [
        (lambda: None, "the env .* is None, not an env of Gymnasium"),
        (lambda: 1 / 0, "the env .* cannot be made: it raised ZeroDivisionError: division by zero"),
        (lambda: {}["valve"], "the env .* cannot be made: it raised KeyError: 'valve'"),
        (lambda: Broken(), "the env .* cannot be made: it raised NotImplementedError: later"),
        (lambda: sys.exit(3), "the env .* cannot be made: it raised SystemExit: 3"),
        (gymnasium.Env, "the env Env has no action_space: set it in its __init__"),
        (lambda: Plant(space=None), "the env .* has no observation_space"),
        (lambda: Plant(space=[1]), r"the observation_space of .* is \[1\], not a space"),
    ],
)
def test_maker_without_an_env_is_refused(maker, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnv(maker)


def test_maker_that_returns_one_env_twice_is_refused():
    plant = Plant()
    with pytest.raises(ValueError, match=r"the maker of .* returned one env twice"):
        GymnasiumEnv(lambda: plant, 2)


def test_makers_of_envs_with_different_spaces_are_refused():
    sizes = iter([1, 2])
    with pytest.raises(ValueError, match=r"the action_space of .* is Box.* in row 1, but Box.* in"):
        GymnasiumEnv(lambda: Plant(action=spaces.Box(-1, 1, (next(sizes),))), 2)


def test_action_that_is_no_number_does_not_reach_the_env():
    env = GymnasiumEnv(lambda: Plant())
    carrier = env.reset().set("action", torch.full((1, 1), torch.nan))
    with pytest.raises(ForeignError, match="holds a number that is not finite: the policy or its"):
        env.step(carrier)


def ended(env, steps):
    """Return after how many steps the first row ends; None if it does not."""
    carrier = env.reset()
    for step in range(1, steps + 1):
        carrier = env.step(env.rand_action(carrier))["next"]
        if carrier["done"].any():
            return step, bool(carrier["truncated"].any())
    return None


def test_env_without_a_limit_gets_one_that_is_said():
    env = GymnasiumEnv(lambda: Plant(end=None), 2)
    with pytest.warns(UserWarning, match=r"did not end within 1,000 steps, and no TimeLimit"):
        assert ended(env, LIMIT + 5) == (LIMIT, True)


@pytest.mark.filterwarnings("error")
def test_limit_of_an_env_is_its_own():
    assert ended(GymnasiumEnv(lambda: Plant(end=None), max_steps=4), 9) == (4, True)
    assert ended(GymnasiumEnv(lambda: Plant(end=6)), 9) == (6, True)

    class Named(Plant):
        max_steps = 1010

    assert ended(GymnasiumEnv(lambda: Named(end=1010)), 1020) == (1010, True)


@pytest.mark.parametrize(("steps", "expected"), [(10, LIMIT), (np.int64(1010), 1010)])
def test_attribute_only_makes_the_limit_longer(steps, expected):
    class Mistaken(Plant):
        horizon = steps  # of a predictive controller

    env = GymnasiumEnv(lambda: Mistaken(end=None))
    with pytest.warns(UserWarning, match=rf"did not end within {expected:,} steps"):
        assert ended(env, 1020) == (expected, True)


def test_env_that_ignores_its_seed_is_noticed():
    class Own(Plant):
        def good(self):
            return np.random.uniform(size=2).astype(np.float32)

    assert GymnasiumEnv(lambda: Own()).unrepeated() == "observation"
    assert GymnasiumEnv(lambda: Plant()).unrepeated() is None
    assert GymnasiumEnv("CartPole-v1").unrepeated() is None


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((4, 4, 3)),
        np.zeros((4, 4, 2), np.uint8),
        np.zeros((0, 4, 3), np.uint8),
        np.zeros(7, np.uint8),
        "picture",
        None,
        [np.zeros((4, 4, 3), np.uint8)],
    ],
)
def test_garbage_of_render_is_a_warning(picture, monkeypatch):
    monkeypatch.setattr(Plant, "render", lambda self: picture)
    env = GymnasiumEnv(Plant, render=True)
    env.reset()
    with pytest.warns(UserWarning, match="no pictures of the env: render returned .*, not a pict"):
        assert env.render() is None
    assert env.render() is None
    ended(env, 3)


def test_picture_of_another_size_is_a_warning(monkeypatch):
    sizes = iter([4, 4, 5])
    monkeypatch.setattr(
        Plant, "render", lambda self: np.zeros((next(sizes), 4, 3), np.uint8), raising=False
    )
    env = GymnasiumEnv(Plant, render=True)
    env.reset()
    assert env.render() is not None
    assert env.render() is not None
    with pytest.warns(
        UserWarning, match=r"a picture of the shape \[5, 4, 3\] after one of \[4, 4,"
    ):
        assert env.render() is None


@pytest.mark.parametrize("metadata", [None, {}, {"render_fps": "fast"}, {"render_modes": None}])
def test_metadata_may_be_anything(metadata):
    class Odd(Plant):
        pass

    Odd.metadata = metadata
    assert np.isnan(GymnasiumEnv(Odd, render=True).rate)


def test_env_that_cannot_be_closed_is_a_warning(monkeypatch):
    def close(self):
        raise OSError("the port is gone")

    monkeypatch.setattr(Plant, "close", close)
    env = GymnasiumEnv(Plant)
    with pytest.warns(UserWarning, match=r"cannot be closed \(OSError: the port is gone\)"):
        env.close()


@pytest.mark.parametrize(
    ("advice", "message"),
    [
        (lambda env, x: None, "controller pid gave None, not an action of Box"),
        (lambda env, x: (x[:1], None), r"controller pid gave .*, not an action of Box"),
        (lambda env, x: "left", "controller pid gave 'left', not an action of Box"),
        (lambda env, x: x, r"controller pid gave \[.*\], not an action of Box"),
        (lambda env, x: x[:1] * np.nan, r"controller pid gave \[nan\], not an action of Box"),
        (lambda env, x: {}["k"], r"the controller pid beside the env .*: it raised KeyError: 'k'"),
    ],
)
def test_controller_beside_its_env_is_named_with_the_place(advice, message):
    def late(env, observation):
        return advice(env, observation) if env.time == STEP else observation[:1]

    env = GymnasiumEnv(lambda: Plant(), 2, first_seed=7, controllers={"pid": late})
    with pytest.raises(ForeignError, match=message) as caught:
        env.rollout(STEP)
    assert "(row 0, seed 7, step 3)" in str(caught.value)


class Model:
    """As a model of Stable-Baselines3, recurrent; it knows its batches of rows by their calls."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        count = np.zeros(1) if state is None or episode_start[0] else state[0]
        assert deterministic
        return np.float32(observation[:1] * 0 + count), (count + 1,)


def test_model_with_predict_is_a_controller_beside_its_env():
    env = GymnasiumEnv(lambda: Plant(end=4), 2, controllers={"model": Model()})
    advice = env.rollout(6, break_when_any_done=False)["controller", "model"]
    assert advice[..., 0].tolist() == [[0, 1, 2, 3, 0, 1]] * 2


def test_predictor_hands_the_state_on():
    controller = Predictor(Model())
    for _ in range(2):
        controller.reset()
        assert [controller.act(np.zeros(2)).item() for _ in range(3)] == [0, 1, 2]


def test_only_models_with_deterministic_predict():
    class Regressor:
        def predict(self, x):
            return x

    class Both(Model):
        def act(self, x):
            return x

    assert [predicts(each) for each in (Model(), Model, Regressor(), Both(), 3)] == [
        True,
        True,
        False,
        False,
        False,
    ]
