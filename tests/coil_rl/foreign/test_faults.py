"""What envs and controllers of others do wrong is one sentence with its place, or no harm."""

import asyncio
import decimal
import fractions
import itertools
import logging
import os
import random
import shlex
import signal
import sys
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import ClipReward
from plants import Drift
from programs import called, read_csv
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose, TransformedEnv

import coil_rl
from coil_rl import GymnasiumEnv
from coil_rl.foreign.faults import ForeignError
from coil_rl.foreign.guard import SETTINGS, hold
from coil_rl.guides import (
    ConstantGuide,
    ControllerGuide,
    PerRow,
    RandomGuide,
    ZeroGuide,
)
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.normaliser import RawObservations, normaliser
from coil_rl.run.stopping import resume_command
from coil_rl.transforms import GuideActions, RandomAdvice
from coil_rl.transforms.normalised_action import normalising

STEP = 3  # at which a plant or controller does what it is told
BOX, PLANE = spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
BYTES, NAN = spaces.Box(0, 255, (2,), np.uint8), float("nan")
DICT = spaces.Dict({"a": BOX, "in": spaces.Dict({"b": spaces.Discrete(3, start=5)})})
TWO = spaces.Tuple([spaces.Discrete(2), BOX])
ARRAY = "not an array of numbers"


class Plant(gymnasium.Env):
    """Answers as Gymnasium wants it, but for one answer."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, space=BOX, answer=None, reset=None, action=PLANE, render_mode=None):
        self.observation_space, self.action_space = space, action
        self.answer, self.first, self.render_mode = answer, reset, render_mode

    def good(self):
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.time = 0
        return (self.good(), {}) if self.first is None else self.first(self.good())

    def step(self, action):
        self.time += 1
        answer = [self.good(), 1.0, False, self.time == 20, {}]
        return self.answer(answer) if self.answer and self.time == STEP else tuple(answer)


def put(index, value):
    """Return what replaces one of the five values of a step."""
    return lambda answer: (*answer[:index], value, *answer[index + 1 :])


def fail(error):
    def change(*_):
        raise error

    return change


seen, reward, end, cut, info = (partial(put, index) for index in range(5))


def stepped(guide=None, rows=2, id=None, **plant):
    """Return the entries before each step; row 0 begins with the seed 7."""
    beside = plant.pop("controllers", None)
    env = GymnasiumEnv(id or (lambda **_: Plant(**plant)), rows, first_seed=7, controllers=beside)
    if guide is not None:
        env = TransformedEnv(env, GuideActions({"theirs": guide}))
    return env.rollout(STEP + 2, break_when_any_done=False)


def is_one_sentence(caught, length=400):
    return "\n" not in str(caught.value) and len(str(caught.value)) < length


IN_A_STEP = [
    (lambda a: None, "step returned None, not the five of Gymnasium"),
    (lambda a: tuple(a[:4]), "step returned 4 values, not the five"),
    (lambda a: np.zeros(5), r"step returned \[0.0, 0.0, .*, not the five"),
    (lambda a: dict(enumerate(a)), "step returned {0: .*, not the five"),
    (lambda a: (a[0], a[1], a[4], a[2], a[3]), "info of step is False, not a dictionary"),
    (reward(None), "the reward is None, not one number"),
    (reward(np.zeros(1)), r"the reward is \[0.0\], not one number"),
    (reward("1.0"), "the reward is '1.0', not one number"),
    (reward(10**400), "the reward is 1000.*, not one number"),
    (reward(NAN), "the reward is nan, not a finite number"),
    (reward(-np.inf), "the reward is -inf, not a finite number"),
    (reward(1e300), r"the reward is 1e\+300, not a finite number of float32"),
    (end(None), "terminated is None, not True or False"),
    (end("False"), "terminated is 'False', not True or False"),
    (cut(0.5), "truncated is 0.5, not True or False"),
    (cut(np.array([True, False])), r"truncated is \[True, False\], not True"),
    (info(None), "info of step is None, not a dictionary"),
    (seen(None), f"the observation is None, {ARRAY}"),
    (seen(np.zeros((1, 2))), r"has the shape \[1, 2\], but its space has \[2\]"),
    (seen(0.5), r"the observation has the shape \[\]"),
    (seen(["a", "b"]), ARRAY),
    (seen([0.0, [1.0]]), ARRAY),
    (seen(np.zeros(2, complex)), ARRAY),
    (seen(np.ma.array([0.0, 1.0], mask=[True, False])), ARRAY),
    (seen([0.0, NAN]), "the observation holds nan, not a finite number"),
    (seen([0.0, 1e300]), r"the observation holds 1e\+300, not a finite number of float32"),
    (fail(KeyError("pump")), "step raised KeyError: 'pump'"),
    (fail(ZeroDivisionError()), "step raised ZeroDivisionError: without a text"),
    (fail(ValueError("two\n\nlines  " + 500 * "x")), "step raised ValueError: two lines"),
    (fail(SystemExit(0)), "step raised SystemExit: 0"),
    (fail(StopIteration()), "step raised StopIteration"),
    (fail(asyncio.CancelledError()), "step raised CancelledError: without a text"),
]
IN_A_RESET = [
    (lambda x: None, r"reset returned None, not the two of Gymnasium \(observation, info\)"),
    (lambda x: x, r"reset returned \[.*\], not the two"),  # two numbers, which would unpack
    (lambda x: (x, {}, 1), "reset returned 3 values, not the two"),
    (lambda x: (x, 0.0), "info of reset is 0.0, not a dictionary"),
    (lambda x: (x[:1], {}), r"the observation has the shape \[1\]"),
    (fail(RuntimeError("no key")), "reset raised RuntimeError: no key"),
]
NOT_IN_ITS_SPACE = [
    (spaces.Box(-1, 1, (2, 3)), np.zeros((3, 2)), r"shape \[3, 2\], but .* has \[2, 3\]"),
    (BYTES, [0.5, 0.25], "the observation holds 0.5, which is not"),
    (BYTES, [0, 256], "the observation holds 256, which is not"),
    (BYTES, [0, -1], "the observation holds -1, which is not in"),
    (spaces.MultiBinary(2), [0, 2], "the observation holds 2, which is not in MultiBinary"),
    (spaces.Discrete(3), 3, "the observation holds 3, which is not in Discrete"),
    (spaces.Discrete(3, start=5), 2, "the observation holds 2, which is not in Discrete"),
    (spaces.Discrete(3), 1.5, "the observation holds 1.5, which is not in Discrete"),
    (spaces.MultiDiscrete([2, 3]), [2, 0], "the observation holds 2, which is not in Multi"),
    (DICT, {"a": np.zeros(2)}, r"observation.in.b is missing: the observation has \['a'\]"),
    (DICT, {"a": np.zeros(2), "in": {"c": 5}}, r"in.b is missing: .* has \['c'\], but .* 'b'"),
    (DICT, np.zeros(2), "the observation.a is missing"),
    (TWO, (1,), "the observation.1 is missing: the observation is .*, not the tuple"),
    (TWO, {"0": 1}, "the observation.0 is missing"),
]


@pytest.mark.parametrize(
    ("plant", "step", "message"),
    [
        *(({"answer": answer}, STEP, message) for answer, message in IN_A_STEP),
        *(({"reset": reset}, 0, message) for reset, message in IN_A_RESET),
        *(
            ({"space": space, "answer": seen(value)}, STEP, message)
            for space, value, message in NOT_IN_ITS_SPACE
        ),
    ],
)
def test_fault_of_an_env_has_its_place(plant, step, message):
    place = rf"^the env .*row 0, seed 7, step {step}\): "
    with pytest.raises(ForeignError, match=f"{place}.*{message}") as caught:
        stepped(**plant)
    assert is_one_sentence(caught)
    assert " raised " not in message or caught.value.__cause__ is not None


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (BOX, (1.0, np.float64(2)), [1.0, 2.0]),
        (BOX, torch.tensor([1.0, 2.0], requires_grad=True), [1.0, 2.0]),
        (BOX, np.array([True, False]), [1.0, 0.0]),
        (spaces.Box(-1, 1, ()), [0.5], [0.5]),
        (spaces.Box(-1, 1, (1,)), 0.5, [0.5]),
        (BYTES, [1.0, 255], [1, 255]),
        (spaces.Discrete(3), np.array([2]), [0, 0, 1]),
        (spaces.Discrete(2), True, [0, 1]),
        (spaces.MultiDiscrete([2, 3]), [1, 2], [0, 1, 0, 0, 1]),
        (spaces.MultiBinary(2), [True, False], [1, 0]),
    ],
)
def test_observation_in_another_dress_is_taken(space, value, expected):
    data = stepped(space=space, answer=seen(value))
    assert data["next", "observation"][0, STEP - 1].tolist() == expected


ODD_NUMBERS = [2, True, np.int64(2), np.array(0.5), torch.tensor(2.0), np.bool_(True)]


@pytest.mark.parametrize("value", [*ODD_NUMBERS, fractions.Fraction(1, 2), decimal.Decimal("0.5")])
def test_every_kind_of_number_is_a_reward(value):
    rewards = stepped(answer=reward(value))["next", "reward"]
    assert rewards[:, STEP - 1].tolist() == [[float(value)]] * 2


@pytest.mark.parametrize("flag", [True, np.True_, 1, np.array(True), torch.tensor(True), 1.0, 0])
def test_every_kind_of_flag_ends_an_episode_where_it_is_true(flag):
    ends = stepped(answer=end(flag))["next", "terminated"]
    assert ends[:, STEP - 1].tolist() == [[bool(flag)]] * 2


def test_buffer_that_all_envs_share_is_harmless():
    buffer = np.zeros(2, np.float32)

    class Shared(Plant):
        def good(self):
            buffer[:] = self.np_random.uniform(size=2)
            return buffer

    data = stepped(id=lambda: Shared(), controllers={"own": lambda env, seen: seen[:1]})
    assert len(data["observation"].unique()) == data["observation"].numel()
    assert torch.equal(data["controller", "own"], data["observation"][..., :1])


def bounded(low, high):
    space = spaces.Box(-1, 1, (1,))
    space.low, space.high = np.array([low]), np.array([high])
    return space


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (spaces.Box(np.array([-1, 2.0]), np.array([1, 2.0])), "number 1 of .* bounds 2.0 and 2.0"),
        (bounded(NAN, 1.0), r"number 0 of the action of .* has the bounds nan"),
        (bounded(1.0, -1.0), r"number 0 of the action of .* has the bounds 1.0 and -1.0"),
        (spaces.Box(-1, 1, (0,)), r"has the shape \[0\]: it has no number"),
        (spaces.Box(0, 10**6, (1,), np.int64), "which are choices, but only up to 32 of each"),
        (3, "the action_space of .* is 3, not a space of Gymnasium"),
        (None, "the action_space of .* is None, .* set it in its __init__"),
        (spaces.Text(3), "is a Text space: replace it with a wrapper"),
        (TWO, "is a Tuple space: replace it with a wrapper"),
        (spaces.Sequence(BOX), "is a Sequence space: replace it with a wrapper"),
    ],
)
def test_action_that_leaves_no_choice_is_refused(action, message):
    with pytest.raises(ValueError, match=message):
        stepped(action=action, rows=1)


ONE, SIZES = Plant(), itertools.count(1)


class Broken(Plant):
    action_space = property(fail(NotImplementedError("later")), lambda self, space: None)


@pytest.mark.parametrize(
    ("maker", "message"),
    [
        (lambda: None, "the env .* is None, not an env of Gymnasium"),
        (
            lambda: gymnasium.vector.SyncVectorEnv([Plant]),
            "not an env of Gymnasium: give the env of one row, of which a run makes budget.num_env",
        ),
        (lambda: {}["valve"], "the env .* cannot be made: it raised KeyError: 'valve'"),
        (lambda: Broken(), "the env .* cannot be made: it raised NotImplementedError: later"),
        (lambda: sys.exit(3), "the env .* cannot be made: it raised SystemExit: 3"),
        (partial(Plant, space=None), "^the observation_space of Plant is None, not a space"),
        (lambda: Plant(space=[1]), r"the observation_space of .* is \[1\], not a space"),
        (lambda: Plant(spaces.Box(-1, 1, (0,))), "which has no numbers; observe at least one"),
        (lambda: ONE, "the maker of .* returned one env twice"),
        (
            lambda: Plant(action=spaces.Box(-1, 1, (next(SIZES),))),
            r"the action_space of .* is Box.* in row 1, but Box.* in row 0",
        ),
    ],
)
def test_maker_without_envs_is_refused(maker, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnv(maker, 2)


def test_action_that_is_no_number_does_not_reach_the_env():
    env = GymnasiumEnv(lambda: Plant())
    carrier = env.reset().set("action", torch.full((1, 1), torch.nan))
    with pytest.raises(ForeignError, match="holds a number that is not finite: the policy or its"):
        env.step(carrier)


PICTURES = [np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8), np.zeros(7, np.uint8), "x", None]
LATER = [np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)]  # of another size


@pytest.mark.parametrize("pictures", [*([each] for each in PICTURES), LATER, []])
def test_garbage_of_render_is_a_warning_and_the_env_runs_on(pictures, monkeypatch):
    given = iter(pictures)

    def render(self):
        for picture in given:
            return picture
        raise RuntimeError("no display")

    monkeypatch.setattr(Plant, "render", render, raising=False)
    env = GymnasiumEnv(Plant, render=True)
    env.reset()
    assert all(env.render() is not None for _ in pictures[1:])
    fault = "render returned" if pictures else "no display"
    with pytest.warns(UserWarning, match=f"no pictures of the env: {fault}"):
        assert env.render() is None
    assert env.render() is None
    env.rollout(3)


@pytest.mark.parametrize("metadata", [None, {}, {"render_fps": "fast"}, {"render_modes": None}])
def test_metadata_may_be_anything(metadata, monkeypatch):
    monkeypatch.setattr(Plant, "metadata", metadata)
    assert np.isnan(GymnasiumEnv(Plant, render=True).rate)


def test_env_that_cannot_be_closed_is_a_warning(monkeypatch):
    monkeypatch.setattr(Plant, "close", fail(OSError("the port is gone")))
    env = GymnasiumEnv(Plant)
    with pytest.warns(UserWarning, match=r"cannot be closed \(OSError: the port is gone\)"):
        env.close()


class Gives:
    """Gives some answers, one after the other, and then the last one; a function is called."""

    def __init__(self, *answers):
        self.answers = answers

    def reset(self):
        self.calls = -1

    def act(self, observation):
        self.calls += 1
        answer = self.answers[min(self.calls, len(self.answers) - 1)]
        return answer() if callable(answer) else answer


WELL = [[0.5]] * STEP


@pytest.mark.parametrize("beside", [False, True], ids=["guide", "beside its env"])
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, f"the action is None, {ARRAY}"),
        (np.nan, r"the action is \[nan\], which is not finite"),
        ("left", f"the action is 'left', {ARRAY}"),
        ((np.zeros(1), None), "the action is the tuple .*; return the action alone"),
        (1j, f"the action is 1j, {ARRAY}"),
        (fail(IndexError("no joint 7")), "act raised IndexError: no joint 7"),
        (fail(SystemExit(1)), "act raised SystemExit: 1"),
        ([0.5, 0.5], r"has the shape \[2\], but|returned \[0.5, 0.5\], no action of Box"),
        ([], r"has the shape \[0\], but|returned \[\], no action of Box"),
    ],
)
def test_fault_of_a_controller_has_its_place(answer, message, beside):
    makers = iter([Gives(*WELL), Gives(*WELL, answer)])
    given = {"controllers": {"pid": Gives(*WELL, answer)}}
    if not beside:
        given = {"guide": PerRow(lambda: next(makers), title="PID")}
    with pytest.raises(ForeignError, match=message) as caught:
        stepped(**given)
    place = "the controller PID (row 1, step 3): "
    if beside:
        assert str(caught.value).startswith("the controller pid beside the env ")
        place = "row 0, seed 7, step 3): "
    assert place in str(caught.value)
    assert is_one_sentence(caught)


class Network(nn.Module):
    """Acts by a function, and keeps a number in an attribute."""

    kept = 0.0

    def __init__(self, act):
        super().__init__()
        self.acts = act

    def forward(self, observation):
        return self.acts(self, observation)


SWING, CART = {"id": "Pendulum-v1"}, {"id": "CartPole-v1"}
NO_WEIGHTS = Network(fail(RuntimeError("no weights\nat all")))
ROW = r"Gives \(row 0, step"


@pytest.mark.parametrize(
    ("plant", "controller", "message"),
    [
        (SWING, lambda x: None, "the action is None"),
        (SWING, lambda x: (x[..., :1], None), "the action is the tuple"),
        (SWING, lambda x: x / "a", "it raised TypeError: "),
        (SWING, lambda x: x[..., :1] * np.nan, "is not finite"),
        (SWING, lambda x: x, r"has the shape \[2, 3\], but must have \[2, 1\]"),
        (SWING, nn.Identity(), r"Identity: its action has the shape .* but must have"),
        (SWING, NO_WEIGHTS, "Network: it raised RuntimeError: no weights at"),
        (CART, lambda x: -1, r"is neither a number from \[0\] to \[1\] nor a one-hot vector"),
        (CART, lambda x: 2, r"is neither a number from \[0\] to \[1\] nor a one-hot vector"),
        (CART, lambda x: 0.5, "is no whole number, but must be the number of a choice"),
        ({"action": PLANE}, Gives([1.0, 2.0]), rf"{ROW} 0.*\[1.0, 2.0\], .*\[2\], .* have \[1"),
        (
            {"action": spaces.Discrete(2)},
            Gives(0, 1, 2),
            rf"{ROW} 2\): act returned \[2\], which is neither a number from \[0\]",
        ),
        (
            {"action": spaces.Discrete(3, start=5)},
            Gives(0.5),
            rf"{ROW}.*neither a number from \[5\] to \[7\] nor a one-",
        ),
        (
            {"action": spaces.MultiBinary(2)},
            Gives(6),
            rf"{ROW}.*returned \[6\], which has the shape \[1\], but must have",
        ),
        (
            {"action": spaces.MultiDiscrete([3, 2], start=[1, 10])},
            Gives([1, 1]),
            rf"{ROW}.*from \[1, 10\] to \[3, 11\] nor",
        ),
        (
            {"action": spaces.Box(-1, 1, (2, 3))},
            Gives(np.zeros((3, 2))),
            rf"{ROW}.*shape \[3, 2\], but must have \[2, 3\]",
        ),
    ],
)
def test_action_that_does_not_fit_is_told_as_it_was_returned(plant, controller, message):
    with pytest.raises(ForeignError, match=f"^the controller .*{message}") as caught:
        stepped(ControllerGuide(controller), **plant)
    assert is_one_sentence(caught)


def test_object_that_cannot_be_copied_asks_for_its_class():
    message = rf"{ROW} 0\): it cannot be copied for each row \(TypeError: .*; give its class, of"
    with pytest.raises(ForeignError, match=message) as caught:
        stepped(ControllerGuide(Gives(number for number in WELL)))
    assert is_one_sentence(caught)


def test_what_a_controller_does_with_its_observation_changes_nothing():
    def spoils(*given):
        given[-1][...] = 0.0
        return given[-1][..., :1]

    class Own(Plant):
        def reset(self, **options):
            self.state = np.zeros(2, np.float32)
            return super().reset(**options)

        def good(self):
            self.state += 1
            return self.state

    data = stepped(ControllerGuide(spoils), id=lambda: Own(), controllers={"careless": spoils})
    assert data["observation"][0, :, 0].tolist() == [1, 2, 3, 4, 5]


def test_old_name_of_a_time_limit_beside_a_termination_is_said():
    old = {"TimeLimit.truncated": True}
    with pytest.warns(UserWarning, match=r"TimeLimit.truncated at a step with terminated=True"):
        ends = stepped(answer=lambda a: (a[0], a[1], True, False, old))["next", "terminated"]
    assert ends[:, STEP - 1].all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stepped(answer=lambda a: (a[0], a[1], False, True, old))


class Seeds(Drift):
    """Seeds the process at each reset, and draws from it."""

    def begin(self, seed):
        torch.manual_seed(seed), np.random.seed(seed), random.seed(seed)
        super().begin(seed)

    def draw(self):
        return torch.rand(()).item() + np.random.rand() + random.random()


class Draws(Seeds):
    """Draws from the process without a seed."""

    def begin(self, seed):
        self.state = [self.draw(), 0.0]


def actions(env, count=30):
    """Return the entries of steps with given actions."""
    generator, rows = torch.Generator().manual_seed(0), []
    carrier = env.reset()
    for _ in range(count):
        action = torch.rand(env.action_spec.shape, generator=generator)
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        rows.append(torch.cat([step["observation"], step["next", "reward"]], -1))
    return torch.stack(rows)


@pytest.mark.parametrize("id", [Drift, Seeds, Draws])
def test_rows_that_use_the_numbers_of_the_process_are_separate_and_repeat(id):
    one, again, workers = (
        actions(GymnasiumEnv(id, 3, seed=5, workers=number)) for number in (0, 0, 2)
    )
    assert torch.equal(one, again)
    assert torch.equal(one, workers)
    alone = actions(GymnasiumEnv(id, 1, first_seed=7), 10)
    beside = GymnasiumEnv(id, 2, first_seed=7)
    if id is not Drift:  # the actions of a row are drawn for all
        assert torch.equal(alone[0, 0], actions(beside, 10)[0, 0])


CHANGES = {
    "torch": lambda: torch.manual_seed(0),
    "torch drawn": lambda: torch.rand(3),
    "numpy": lambda: np.random.seed(0),
    "numpy drawn": lambda: np.random.rand(),
    "random": lambda: random.seed(0),
    "random drawn": random.random,
    "folder": lambda: os.chdir("/"),
    "dtype": lambda: torch.set_default_dtype(torch.float64),
    "grad": lambda: torch.set_grad_enabled(False),
    "autocast": lambda: torch.autocast("cpu").__enter__(),
    "threads": lambda: torch.set_num_threads(3),
    "printing": lambda: np.set_printoptions(precision=1),
    "torch printing": lambda: torch.set_printoptions(precision=1),
    "errors": lambda: np.seterr(all="raise"),
    "warnings": lambda: warnings.simplefilter("ignore"),
    "level": lambda: logging.root.setLevel(1),
    "disable": lambda: logging.disable(logging.CRITICAL),
    "output": lambda: setattr(sys, "stderr", sys.stdout),
    "device": lambda: torch.set_default_device("meta"),
    "path": lambda: sys.path.clear(),
    "recursion": lambda: sys.setrecursionlimit(900),
    "signal": lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN),
    "deterministic": lambda: torch.use_deterministic_algorithms(True),
}


def state():
    """Return what belongs to the process."""
    drawn = (torch.rand(()).item(), float(np.random.rand()), random.random())
    filters = [each[0] for each in warnings.filters]
    return (*drawn, filters, *(repr(get()) for get, put in SETTINGS))


def seeded():
    torch.manual_seed(9), np.random.seed(9), random.seed(9)


def acts_that(change):
    """Return controllers that change the process, by what they are."""

    class Controller:
        def act(self, observation):
            change()
            return [0.0]

    def function(observation):
        change()
        return observation[..., :1]

    class Module(TensorDictModuleBase):
        in_keys, out_keys = ["observation"], ["action"]

        def forward(self, tensordict):
            return tensordict.set("action", function(tensordict["observation"]))

    return {"act": Controller, "function": function, "module": Module}


ACTS = tuple(acts_that(None))


@pytest.mark.parametrize("place", ["the maker", "reset", "step", *ACTS])
@pytest.mark.parametrize("change", CHANGES)
def test_process_is_as_before_whatever_foreign_code_does_to_it(change, place):
    do = CHANGES[change]

    class Does(Drift):
        def __init__(self, **options):
            super().__init__(**options)
            self.at("the maker")

        def at(self, here):
            if here == place:
                do()

        def begin(self, seed):
            self.at("reset")
            super().begin(seed)

        def move(self, action):
            self.at("step")
            super().move(action)

    seeded()
    before = state()
    seeded()
    env = GymnasiumEnv(Does, 2, first_seed=0)
    if place in ACTS:
        guide = ControllerGuide(acts_that(do)[place])
        env = TransformedEnv(env, GuideActions({"theirs": guide}))
    carrier = env.reset()
    for _ in range(6):
        carrier = env.step_mdp(env.step(carrier.set("action", torch.zeros(2, 1))))
    assert state() == before


class Dithers(TensorDictModuleBase):
    """A guide that seeds the process in its first call, and draws from it in each."""

    in_keys, out_keys = ["observation"], ["action"]

    def forward(self, tensordict):
        if not hasattr(self, "calls"):
            self.calls = torch.manual_seed(0)
        drawn = torch.rand(()) + np.random.rand() + random.random()
        return tensordict.set("action", tensordict["observation"][..., :1] * 0 + drawn)


def test_random_numbers_of_a_guide_are_its_own_and_in_its_state():
    data = TensorDict({"observation": torch.zeros(2, 3)}, [2])
    seeded()
    plain = torch.rand(4)
    seeded()
    guide, drawn = hold(Dithers()), []
    for _ in range(4):
        drawn.append(torch.rand(()))
        guide(data)
    assert torch.equal(torch.stack(drawn), plain)
    saved = guide.state_dict()
    later = [float(guide(data)["action"][0]) for _ in range(3)]
    assert len(set(later)) == 3
    again = hold(Dithers())
    again.calls = 0
    again.load_state_dict(saved)
    assert [float(again(data)["action"][0]) for _ in range(3)] == later


@pytest.mark.parametrize("sets_back", [False, True])
def test_foreign_code_finds_again_what_it_has_set_until_it_sets_it_back(sets_back):
    seen = []

    class Home(Drift):
        def __init__(self, **options):
            super().__init__(**options)
            os.chdir("/tmp")
            torch.set_default_dtype(torch.float64)

        def move(self, action):
            seen.append((os.getcwd(), torch.get_default_dtype()))
            if sets_back:
                torch.set_default_dtype(torch.float32)

    GymnasiumEnv(Home, 1).rollout(3)
    later = torch.float32 if sets_back else torch.float64
    assert seen == [("/tmp", torch.float64), ("/tmp", later), ("/tmp", later)]


REMEMBERS = r"for the same observation: .* must not remember or draw .*; write a class with act"


def advice(guide, *calls):
    """Return the actions in consecutive calls, for the numbers that the rows observe."""
    data = [TensorDict({"observation": torch.tensor(rows)[:, None]}, [len(rows)]) for rows in calls]
    return [guide(each)["action"].flatten().tolist() for each in data]


def integral(of):
    """Return a function that adds up what it observes: numbers of a row, or of a batch."""
    total = [0.0]

    def act(observation):
        total[0] = total[0] + 0.1 * of(observation)
        return -observation - total[0]

    return act


def filtered(network, observation):
    network.kept = 0.9 * network.kept + 0.1 * observation
    return network.kept


def amplified(network, observation):
    """Give a number that an observation of 0 does not show to be remembered."""
    network.kept += 0.1 * float(observation.abs().max())
    return (1 + network.kept) * observation


@pytest.mark.parametrize(
    "make",
    [
        lambda: integral(lambda row: float(row[0])),
        lambda: integral(lambda batch: batch.sum(-2, keepdim=True)),
        lambda: Network(filtered),
        lambda: Network(amplified),
        lambda: Network(lambda _, observation: observation + torch.rand_like(observation)),
    ],
    ids=["of a row", "of a batch", "filter", "gain", "noise"],
)
@pytest.mark.parametrize("rows", [1, 3])
def test_memory_is_found_where_the_plant_begins_at_rest(make, rows):
    with pytest.raises(ForeignError, match=REMEMBERS):
        advice(ControllerGuide(make()), *([float(step)] * rows for step in range(4)))


@pytest.mark.parametrize("mixed", [lambda x: x - x.mean(0), lambda x: x.argsort(0)])
@pytest.mark.parametrize("rows", [[1.0], [0.5], [0.0, 0.0], [3.0, -1.0, 2.0]])
def test_network_that_mixes_the_rows_is_refused(mixed, rows):
    message = r"for an observation alone, but \[.*\] for it in a batch of 3: it mixes the rows"
    with pytest.raises(ForeignError, match=message):
        advice(ControllerGuide(Network(lambda _, observation: mixed(observation))), rows)


def test_a_percent_of_the_largest_number_is_rounding_and_more_is_a_mixture_of_rows():
    def beside(share):
        return Network(lambda _, rows: rows * (1 + share * (len(rows) > 1)))

    advice(ControllerGuide(beside(0.009)), [1.0, -0.5])
    with pytest.raises(ForeignError, match="mixes the rows"):
        advice(ControllerGuide(beside(0.012)), [1.0, -0.5])


@pytest.mark.parametrize("network", [False, True])
def test_check_asks_in_the_first_call_only(network):
    asked = []

    def act(observation):
        asked.append(observation)
        return 2.0 * observation

    guide = ControllerGuide(Network(lambda _, observation: act(observation)) if network else act)
    advice(guide, [1.0])
    asked.clear()
    assert advice(guide, *([float(step)] for step in range(100))) == [[2.0 * n] for n in range(100)]
    assert len(asked) == 100


# What a whole run shows.
TINY = ["budget.num_envs=2", "budget.steps=16", "evaluation.cases=2", "logger=none"]
TINY += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1", "evaluation.gif=false"]
PPO = [*TINY, "learner=ppo", "learner.minibatches=2"]
PENDULUM = ["env=pendulum", "method=ppo", *PPO]


class Valve(Plant):
    """Its best action is 0.3 + 0.2 x of its range, and it shows x in a unit."""

    def __init__(self, low=0.0, high=1.0, unit=1.0, offset=0.0):
        self.low, self.span, self.unit, self.offset = low, high - low, unit, offset
        observed = spaces.Box(-np.inf, np.inf, (1,))
        super().__init__(observed, action=spaces.Box(low, high, (1,), np.float32))

    def good(self):
        self.x = self.np_random.uniform(-1, 1)
        return np.float32([self.offset + self.unit * self.x])

    def step(self, action):
        share = (float(np.ravel(action)[0]) - self.low) / self.span
        pay = -abs(share - 0.3 - 0.2 * self.x)
        self.time += 1
        return self.good(), pay, False, self.time == 10, {}


def got(space, guide, *transforms, rows=1, controllers=None):
    """Return the actions that an env gets while its guide acts."""
    seen = []

    class Gets(Plant):
        def step(self, action):
            seen.append(np.ravel(action).tolist())
            return super().step(action)

    env = GymnasiumEnv(lambda: Gets(action=space), rows, controllers=controllers)
    parts = [*normalising(env), GuideActions({"theirs": guide}), *transforms]
    env = TransformedEnv(env, Compose(*parts)).eval()
    env.rollout(10, FollowAdvice(env))
    return seen


# Kind 1: actions in a unit and a numbering of the env.


@pytest.mark.parametrize(
    ("space", "guide"),
    [
        (spaces.Box(200, 1000, (1,)), [RandomGuide()]),
        (spaces.Box(0, 4, (1,)), [RandomGuide()]),
        (spaces.Box(-2, 2, (1,), np.int64), [RandomGuide()]),
        (spaces.Discrete(3, start=1), [RandomGuide()]),
        (spaces.MultiDiscrete([3, 2]), [RandomGuide()]),
        (spaces.MultiDiscrete([3, 2]), [ZeroGuide(), RandomAdvice()]),
    ],
)
def test_random_guide_is_uniform(space, guide):
    found = np.array(got(space, *guide, rows=60))
    _, counts = np.unique(found, axis=0, return_counts=True)
    if space.dtype == np.float32:
        counts, _ = np.histogram(found, 6, (space.low[0], space.high[0]))
    assert counts.sum() == 600  # none beyond the bounds
    statistic = np.square(counts - 600 / len(counts)).sum() / (600 / len(counts))
    assert statistic < 20.5  # chi-square, 5 degrees, 0.1 %


def test_advice_is_clamped_where_a_bound_is_finite():
    space = spaces.Box(np.float32([-1, -np.inf]), np.float32([1, np.inf]))
    assert got(space, ConstantGuide([5.0, 5.0]))[0] == [1.0, 5.0]


# Kind 2: observations and rewards in a unit of the env.


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["ppo", "sac"])
def test_physical_units_are_normalised(learner, tmp_path, capsys):
    words = ["learner.starts=16", "learner.batch_size=8", *TINY] if learner == "sac" else PPO
    env, options = partial(Valve, unit=40.0, offset=322.0), [f"learner={learner}", *words]
    run = coil_rl.prepare(env, method="ppo", frames=64, folder=tmp_path, overrides=options)
    run.train()
    assert "normalise: observation is normalised: [0] mean" in capsys.readouterr().err
    acts = run.controller()
    assert np.ptp([acts.act(np.float32([322 + 40 * x])) for x in (-1, 1)]) > 1e-4  # not saturated


@pytest.mark.parametrize("wrapper", ["NormalizeObservation", "NormalizeReward"])
def test_statistics_of_a_wrapper_are_refused(wrapper):
    with pytest.raises(ValueError, match=r"statistics.* leave it out"):
        GymnasiumEnv(lambda: ClipReward(getattr(gymnasium.wrappers, wrapper)(Valve()), -1, 1))


@pytest.mark.parametrize(
    ("holds", "space"),
    [
        ("it holds bytes, which", spaces.Box(0, 255, (4,), np.uint8)),
        ("it is a picture", spaces.Box(0, 1, (8, 8, 3), np.float32)),
        ("it holds choices", spaces.Discrete(3)),
    ],
)
def test_normalising_is_said_to_leave_what_it_cannot_scale(holds, space):
    with pytest.warns(UserWarning, match=f"leaves observation as it is: {holds}"):
        normaliser(GymnasiumEnv(partial(Plant, space)), ["observation"], normalise=True)


def test_picture_of_real_numbers_up_to_255_is_named():
    env = GymnasiumEnv(partial(Plant, spaces.Box(0, 255, (8, 8, 3), np.float32)), 2)
    raw = RawObservations(env, ["observation"], None)
    with pytest.warns(UserWarning, match=r"far out of scale.* needs a space of uint8, or a divis"):
        raw.finish(env.rollout(4), 0.0)


# Kind 5: what a person writes into a file.


def test_file_that_is_no_yaml_is_named_with_its_line(tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("a: [1,\nb: }\n")
    said = called("train", "--config-dir", str(tmp_path), "+experiment=mine", code=2).stderr
    assert "mine.yaml, line 2: it is no YAML: " in said


# Kind 6: how a run goes on.


def test_command_that_goes_on_is_quoted_and_keeps_its_trust(tmp_path):
    words = shlex.split(resume_command(tmp_path / "it's a run", ["one", "two"]))
    assert words[1:] == [f"resume={tmp_path}/it's a run", "trust=[one,two]"]


# Kind 7: what a reader expects to work.


@pytest.mark.slow
def test_run_and_resume_take_one_spelling(tmp_path):
    words = [*PENDULUM, "budget.frames=32", "existing=resume"]
    for number, quotes in enumerate(("", "'", '"'), 1):
        name = f"{quotes}a=b ü{quotes}"  # the first trains, the others find its run
        called("train", *words, f"hydra.run.dir={name}", cwd=tmp_path)
        called("train", f"resume={name}", cwd=tmp_path)
        again = [f"hydra.run.dir={number}", "evaluation.gif=false"]
        called("evaluate", f"run={name}", *again, cwd=tmp_path)
    found = sorted(path.parent.name for path in tmp_path.rglob("evaluation.csv"))
    assert found == ["1", "2", "3", "a=b ü"]


# Kind 10: code that changes under a run.


# Kind 12: what is asked of a run that has begun.


@pytest.mark.slow
def test_resumed_run_takes_another_number_of_processes(tmp_path):
    words = [*PENDULUM, "env.workers=0", f"hydra.run.dir={tmp_path}/run"]
    called("train", *words, "budget.frames=64")
    called("train", f"resume={tmp_path}/run", "env.workers=2", "budget.frames=128")
    assert float(read_csv(tmp_path / "run" / "metrics.csv")[-1]["frames"]) == 128


@pytest.mark.slow
def test_finished_run_is_drawn_where_it_is_asked_for(tmp_path):
    called("train", *PENDULUM, f"hydra.run.dir={tmp_path}/run", "budget.frames=32")
    for value in ("true", "false"):
        again = [f"evaluation.gif={value}", "evaluation.repeats=1"]
        called("evaluate", f"run={tmp_path}/run", *again, f"hydra.run.dir={tmp_path}/{value}")
        assert (tmp_path / value / "episode.webp").exists() == (value == "true")
