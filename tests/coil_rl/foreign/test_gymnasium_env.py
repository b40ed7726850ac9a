import itertools
import math
import warnings
from contextlib import nullcontext
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.data import Bounded, Categorical, MultiCategorical, Unbounded
from torchrl.envs import GymEnv, PendulumEnv
from worlds import drive, reloaded, same

from coil_rl import EnvBatch, GymnasiumEnv
from coil_rl.testing import check_env

LIMIT = 7  # steps of an episode of `Echo`


class Echo(gymnasium.Env):
    """Shows its last action and the time, in spaces of all kinds."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, action_space=None, leak=0.0, render_mode=None):
        self.action_space = action_space or spaces.Box(-2.0, 3.0, (2,), np.float64)
        self.leak, self.resets, self.render_mode = leak, 0, render_mode
        self.observation_space = spaces.Dict(
            {
                "real": spaces.Box(-np.inf, np.inf, (3,), np.float64),
                "image": spaces.Box(0, 10, (4, 5, 3), np.uint8),
                "pixels": spaces.Box(0, 255, (2,), np.uint8),
                "cars": spaces.Box(0, 9, (2,), np.uint8),
                "place": spaces.Discrete(LIMIT + 1, start=10),
                "inner": spaces.Dict(
                    {"pair": spaces.MultiDiscrete([2, 3]), "bits": spaces.MultiBinary(3)}
                ),
                "both": spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1, (), np.float32)]),
                "mission": spaces.Text(8),
            }
        )

    def observe(self):
        return {
            "real": np.array([self.time, self.noise, np.sum(self.last)]),
            "image": np.full((4, 5, 3), self.time, np.uint8),
            "pixels": np.full(2, self.time, np.uint8),
            "cars": np.full(2, self.time, np.uint8),
            "place": 10 + self.time,
            "inner": {"pair": np.array([1, self.time % 3]), "bits": np.array([0, 1, 1], np.int8)},
            "both": (1, np.float32(0.25)),
            "mission": "go",
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.last = 0, np.zeros(1)
        self.noise = self.np_random.uniform() + self.leak * self.resets
        self.resets += 1
        return self.observe(), {}

    def step(self, action):
        assert self.time < LIMIT, "stepped after its end"
        assert self.action_space.contains(np.asarray(action)), action
        self.time, self.last = self.time + 1, action
        return (
            self.observe(),
            1.0,
            self.time == LIMIT,
            False,
            {"success": self.time > 3, "words": "x"},
        )

    def render(self):
        return np.full((2, 2, 3), self.time, np.uint8)


gymnasium.register("Echo-v0", Echo)


class Counter:
    """Controller whose action is the number of its calls in this episode, in steps of `size`."""

    def __init__(self, env, size=1.0):
        self.size, self.shape = size, env.action_space.shape

    def reset(self):
        self.calls = 0

    def act(self, observation):
        self.calls += 1
        return np.full(self.shape, self.calls * self.size)


def first_real(env, observation):
    return observation["real"][:2] * (env.unwrapped.time >= 0)


ENVS = {
    "CartPole-v1": {},
    "Pendulum-v1": {},
    "Echo-v0": {"info": ["success"], "controllers": {"count": Counter}},
    "LunarLander-v3": {"options": {"continuous": True}},
    "BipedalWalker-v3": {"fresh": True},
}


SINGLE = {"Pendulum": PendulumEnv, "CartPole": partial(GymEnv, "CartPole-v1")}  # of TorchRL
ALL = [*ENVS, *SINGLE]


def build(id, num_envs=3, **arguments):
    if id in SINGLE:
        return EnvBatch(SINGLE[id], num_envs, **arguments)
    if id in ("LunarLander-v3", "BipedalWalker-v3"):
        pytest.importorskip("Box2D", reason="Box2D is not installed")
    return GymnasiumEnv(id, num_envs, **(ENVS.get(id, {}) | arguments))


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    ("id", "options"),
    [
        *itertools.product(ENVS, ({"dtype": torch.float32}, {"dtype": torch.float64})),
        *((id, {}) for id in SINGLE),
    ],
)
def test_env_fits_its_specs(id, options):
    check_env(build(id, **options), steps=30)


@pytest.mark.fast("CartPole-v1", "Pendulum")
@pytest.mark.parametrize("id", ALL)
def test_seed_determines_all_episodes(id):
    one, other, third = (drive(build(id, seed=seed), 60)[0] for seed in (1, 1, 2))
    assert same(one, other)
    assert not same(one, third)


@pytest.mark.fast("Echo-v0-0", "Echo-v0-45", "CartPole-45")
@pytest.mark.parametrize("steps", [0, 45])
@pytest.mark.parametrize("id", ALL)
def test_saved_env_goes_on_to_the_bit(id, steps):
    env = build(id, 4, seed=5)
    _, carrier = drive(env, steps)
    state, start = reloaded(env.state_dict()), carrier.clone()
    later = drive(env, 60, carrier, seed=1)[0]
    other = build(id, 4, seed=6)
    drive(other, 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other.load_state_dict(state)
    assert other.continues
    assert same(later, drive(other, 60, start, seed=1)[0])


def test_env_saved_before_its_first_reset_draws_the_same_episodes():
    env, other = build("CartPole-v1", seed=5), build("CartPole-v1", seed=6)
    other.load_state_dict(reloaded(env.state_dict()))
    assert same(drive(env, 30)[0], drive(other, 30)[0])


def test_env_that_keeps_something_at_a_reset_is_noticed():
    env = build("Echo-v0", options={"leak": 0.5})
    drive(env, 2 * LIMIT + 2)
    other = build("Echo-v0", options={"leak": 0.5})
    with pytest.warns(
        UserWarning, match=r"cannot go on with its running episodes to the bit.*fresh=true"
    ) as caught:
        other.load_state_dict(reloaded(env.state_dict()))
    assert len(caught) == 1
    assert not other.continues
    drive(other, 5)
    fresh, other = (build("Echo-v0", options={"leak": 0.5}, fresh=True) for _ in range(2))
    drive(fresh, 2 * LIMIT + 2)
    other.load_state_dict(reloaded(fresh.state_dict()))
    assert other.continues


def test_episode_longer_than_the_memory_is_not_repeated(monkeypatch):
    monkeypatch.setattr("coil_rl.foreign.batch.REMEMBERED", 20)
    env = build("Pendulum-v1")
    drive(env, 25)
    with pytest.warns(UserWarning, match="cannot go on"):
        env.load_state_dict(reloaded(env.state_dict()))


def test_actions_are_kept_for_running_episodes_only():
    env = build("Echo-v0")
    drive(env, 5 * LIMIT + 2)
    assert len(env.actions) == 2


def test_rows_begin_with_the_seeds_of_their_cases():
    env = build("Pendulum-v1", 5, first_seed=40, cases=2)
    alone = [gymnasium.make("Pendulum-v1").reset(seed=seed)[0] for seed in (40, 41, 40, 41, 40)]
    for _ in range(2):
        np.testing.assert_array_equal(env.reset()["observation"].numpy(), alone)
    drawn = build("Pendulum-v1", 5)
    assert not torch.equal(drawn.reset()["observation"], drawn.reset()["observation"])


def test_numbers_are_those_of_gymnasium():
    env, single = build("Pendulum-v1", 1, first_seed=3), gymnasium.make("Pendulum-v1")
    carrier, _ = env.reset(), single.reset(seed=3)
    for action in np.linspace(-3, 3, 20, dtype=np.float32):  # beyond the bounds, which are 2
        after = env.step(carrier.set("action", torch.full((1, 1), float(action))))["next"]
        carrier = after.clone()
        observation, reward, *_ = single.step(np.clip([action], -2, 2))
        np.testing.assert_array_equal(after["observation"][0].numpy(), observation)
        assert after["reward"].item() == np.float32(reward)


def test_spaces_become_entries():
    env = build("Echo-v0", dtype=torch.float64)
    after = drive(env, 4)[0][-1]
    real, place, pair = after["real"], after["place"], after["inner", "pair"]
    assert real.dtype == place.dtype == pair.dtype == after["inner", "bits"].dtype == torch.float64
    assert real[:, 0].tolist() == [4.0] * 3
    assert after["image"].dtype == after["pixels"].dtype == torch.uint8
    assert after["cars"].dtype == torch.float64, "small numbers that are no pixels"
    assert after["cars"].tolist() == [[4.0, 4.0]] * 3
    assert after["image"].shape == (3, 4, 5, 3)
    assert after["image"].unique().tolist() == [4]
    assert place.tolist() == [[0, 0, 0, 0, 1, 0, 0, 0]] * 3
    assert pair.tolist() == [[0, 1, 0, 1, 0]] * 3  # 1 of 2, 1 of 3
    assert after["inner", "bits"].tolist() == [[0, 1, 1]] * 3
    assert after["both", "0"].tolist() == [[0, 1]] * 3
    assert after["both", "1"].tolist() == [[0.25]] * 3
    assert "mission" not in after
    assert after["info", "success"].tolist() == [[1.0]] * 3
    assert env.reset()["info", "success"].isnan().all(), "a reset has no info here"
    assert build("Echo-v0").reset()["real"].dtype == torch.float32


@pytest.mark.parametrize(
    ("space", "spec", "shape"),
    [
        (spaces.Box(-2.0, 3.0, (2,), np.float64), Bounded, (2,)),
        (spaces.Box(-1, 1, (), np.float32), Bounded, (1,)),
        (spaces.Box(-np.inf, np.inf, (2, 2), np.float32), Unbounded, (4,)),
        (spaces.Discrete(3, start=5), Categorical, ()),
        (spaces.MultiDiscrete([2, 4]), MultiCategorical, (2,)),
        (spaces.MultiBinary(3), torch.int8, (3,)),
    ],
)
def test_actions_of_a_space_reach_the_env(space, spec, shape):
    # `Echo` verifies that what arrives is in its space.
    env = GymnasiumEnv("Echo-v0", 2, options={"action_space": space})
    assert (
        env.action_spec.dtype == spec
        if isinstance(spec, torch.dtype)
        else isinstance(env.action_spec, spec)
    )
    assert env.action_spec.shape == (2, *shape)
    carrier = env.reset()
    action = env.rand_action()["action"]
    given = action.double().reshape(2, -1).sum(-1) + float(np.sum(getattr(space, "start", 0)))
    torch.testing.assert_close(
        env.step(carrier.set("action", action))["next", "real"][:, 2].double(), given
    )


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)]
)
def test_all_spaces_have_the_same_digits_in_processes(space):
    outcomes = []
    for workers in (0, 2):
        env = GymnasiumEnv("Echo-v0", 3, options={"action_space": space}, workers=workers)
        outcomes.append(drive(env, 12)[0])
    assert same(*outcomes)


class Place(gymnasium.Env):
    """Moves a millimetre a step, from an offset on.

    Args:
        pay: what the reward sways around; None: it is 0.
    """

    action_space, observation_space = spaces.Discrete(2), spaces.Box(-np.inf, np.inf, (1,), float)

    def __init__(self, offset=0.0, step=0.001, dtype=float, pay=None):
        self.offset, self.step_size, self.dtype, self.pay = offset, step, dtype, pay

    def reset(self, *, seed=None, options=None):
        self.place = self.offset
        return np.array([self.place], self.dtype), {}

    def step(self, action):
        self.place += self.step_size
        reward = 0.0 if self.pay is None else self.pay + math.sin(self.place)
        return np.array([self.place], self.dtype), reward, False, False, {}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((5_412_345.67,), "number 0 of the observation goes from 5412345.67"),
        ((1000.0,), None),
        ((5e6, 0.0), None),
        ((293.15, 1e-13), None),
        *(
            ((1_700_000_000, 1, dtype), "number 0 of the observation goes from 1700000000.0")
            for dtype in (np.int32, np.uint32, np.int64, float)
        ),
        *(((0.0, 0.1, float, pay), ": the reward goes from ") for pay in (1e8, -1e6)),
        ((0.0, 0.1, float, 100.0), None),
    ],
)
def test_numbers_too_fine_for_the_dtype_are_said(given, said):
    env = GymnasiumEnv(partial(Place, *given), num_envs=2, max_steps=1000)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env.rollout(300, break_when_any_done=False)
    texts = [str(each.message) for each in caught if "float32 has steps of" in str(each.message)]
    assert bool(texts) == (said is not None)
    assert said is None or said in texts[0]


@pytest.mark.parametrize(
    ("low", "high", "own", "fits"),
    [
        (1e7, 1e7 + 10, np.float64, False),
        (-1e9 - 1, -1e9, np.float64, False),
        (1e7, 1e7 + 10, np.float32, True),  # as coarse itself
        (0, 1e7, np.float64, True),
        (-1, np.inf, np.float64, True),
        (-1e38, 1e38, np.float64, True),
    ],
)
def test_actions_too_fine_for_the_dtype_are_refused(low, high, own, fits):
    class Acts(Place):
        action_space = spaces.Box(low, high, (2,), own)

    with nullcontext() if fits else pytest.raises(ValueError, match="float32 has too few steps"):
        GymnasiumEnv(Acts)


@pytest.mark.parametrize(("name", "said"), [("success", False), ("sucess", True)])
def test_name_that_is_never_in_info_is_said(name, said):
    class Ends(Place):
        def step(self, action):
            observation, reward, *_ = super().step(action)
            over = self.place > 0.0025
            return observation, reward, over, False, {"success": True} if over else {}

    env = GymnasiumEnv(Ends, info=[name])
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        env.rollout(10)
    texts = [str(each.message) for each in found]
    expected = (
        "had no sucess in the info of an episode, so it is NaN there, a number without a value"
    )
    found = [text for text in texts if expected in text]
    assert bool(found) == said
    assert all(text.endswith("; at its end info has success") for text in found)


class Rare(Place):
    """Place that has its step number in info in every second step only."""

    def __init__(self):
        super().__init__(step=1.0)

    def step(self, action):
        observation, reward, *ends, _ = super().step(action)
        return observation, reward, *ends, {} if self.place % 2 else {"time": self.place}


@pytest.mark.parametrize("workers", [0, 2])
def test_number_that_is_missing_in_a_step_has_no_value_there(workers):
    env = GymnasiumEnv(Rare, 2, info=["time"], workers=workers)
    times = env.rollout(5)["next", "info", "time"].squeeze(-1)
    env.close()
    nan = float("nan")
    assert np.array_equal(times, 2 * [[nan, 2, nan, 4, nan]], equal_nan=True)
    if not workers:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of no limit of steps
            check_env(GymnasiumEnv(Rare, 2, info=["time"]))


def test_mask_of_actions_is_said_not_to_be_used():
    class Masked(Place):
        def reset(self, **options):
            return super().reset(**options)[0], {"action_mask": np.ones(2)}

    with pytest.warns(UserWarning, match="has action_mask in info, which is not used"):
        GymnasiumEnv(Masked).reset()


@pytest.mark.parametrize("id", ["Echo-v0", "CartPole"])
def test_finished_row_stays_as_it_is(id):
    env = build(id)
    carrier = env.reset()
    action = env.rand_action(carrier)["action"].clone()
    for _ in range(15):  # to one side only, a cart is over after about ten steps
        before, carrier = carrier, env.step(carrier.set("action", action))["next"]
    assert carrier["terminated"].all()
    shown = [key for key in env.observation_spec.keys(True, True) if key[0] != "info"]
    assert (before.select(*shown) == carrier.select(*shown)).all()
    assert carrier["reward"].tolist() == [[0.0]] * 3
    assert id == "CartPole" or carrier["real"][:, 0].tolist() == [LIMIT] * 3


@pytest.mark.parametrize("workers", [0, 2])
def test_episodes_begin_with_the_options_of_reset(workers):
    env = GymnasiumEnv(
        "CartPole-v1", 2, reset_options={"low": 0.2, "high": 0.21}, seed=1, workers=workers
    )
    for _ in range(3):  # also after an episode
        first = env.rollout(200, break_when_any_done=True)["observation"][:, 0]
        assert ((first >= 0.2) & (first <= 0.21)).all()
    env.close()


def test_wrappers_are_applied_in_order():
    double, shift = (
        partial(gymnasium.wrappers.TransformReward, func=func)
        for func in (lambda r: 2 * r, lambda r: r + 3)
    )
    after = drive(build("Echo-v0", wrappers=[double, shift]), 1)[0][0]
    assert after["reward"].tolist() == [[5.0]] * 3


def test_controllers_act_beside_their_envs():
    controllers = {"count": Counter, "fast": partial(Counter, size=10), "real": first_real}
    env = build("Echo-v0", controllers=controllers)
    carrier = env.reset()
    for steps in range(LIMIT - 1):
        assert carrier["controller", "count"].tolist() == [[steps + 1.0] * 2] * 3
        assert (
            carrier["controller", "fast"].tolist() == [[steps * 10 + 10.0] * 2] * 3
        )  # out of bounds, as given
        assert torch.equal(carrier["controller", "real"], carrier["real"][:, :2])
        step, carrier = env.step_and_maybe_reset(env.rand_action(carrier))
        assert torch.equal(step["next", "controller", "count"], carrier["controller", "count"])
    step, carrier = env.step_and_maybe_reset(env.rand_action(carrier))
    assert step["next", "terminated"].all()
    assert step["next", "controller", "count"].tolist() == [[float(LIMIT)] * 2] * 3
    assert carrier["controller", "count"].tolist() == [[1.0] * 2] * 3


def test_pictures_show_the_first_row():
    env = build("Echo-v0", render=True)
    drive(env, 3)
    assert env.rate == 20
    assert env.render().tolist() == np.full((2, 2, 3), 3).tolist()
    assert build("Echo-v0").render() is None
    assert [plant.env.render_mode for plant in env.held.plants] == ["rgb_array", None, None]


def test_env_is_drawn_without_a_screen_in_silence(capfd, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    env = GymnasiumEnv("CartPole-v1", 1, render=True)
    env.reset()
    assert env.render().any()
    assert capfd.readouterr().err == ""


def renamed(env):
    """Return an env whose observation is an entry that the project uses itself."""
    space = spaces.Dict(info=env.observation_space)
    return gymnasium.wrappers.TransformObservation(env, lambda seen: {"info": seen}, space)


@pytest.mark.parametrize(
    ("id", "arguments", "message"),
    [
        ("CartPol-v1", {}, "the env CartPol-v1 cannot be made: .*Did you mean: `CartPole`"),
        ("MyPlant-v0", {}, "or PACKAGE:MyPlant-v0 if a package registers"),
        ("cart_poles.Cart", {}, "write MODULE:NAME for an env of a module, or PACKAGE:cart_poles"),
        ("odd_parts:Plan", {}, "registers none of this name; did you mean Plain\\?$"),
        ("gymnasium:CartPol-v1", {}, "; did you mean CartPole-v1\\?$"),
        ("no_such_module:X-v0", {}, "there is no module no_such_module; install its package"),
        ("CartPole-v1", {"options": {"colour": 1}}, "unexpected keyword argument 'colour'$"),
        ("CartPole-v1", {"cases": 3}, "cases=3 needs first_seed"),
        ("CartPole-v1", {"wrappers": [renamed]}, "has an entry 'info'"),
        ("CartPole-v1", {"controllers": {"pid": "math:PID"}}, "of=math:PID: math has no PID"),
        (
            "CartPole-v1",
            {"controllers": {"pid": str}},
            r"controller pid: str needs a method act\(obs",
        ),
        (
            "Echo-v0",
            {"options": {"action_space": spaces.Text(3)}},
            "the action of Echo-v0 is a Text space",
        ),
    ],
)
def test_mistake_is_one_sentence(id, arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        GymnasiumEnv(id, **arguments)
    assert "\n" not in str(caught.value)


def test_missing_package_is_named(monkeypatch):
    def fail(*args, **settings):
        raise gymnasium.error.DependencyNotInstalled("MuJoCo is not installed")

    monkeypatch.setattr(gymnasium, "make", fail)
    with pytest.raises(ValueError, match=r"python -m pip install 'coil-rl\[mujoco\]'"):
        GymnasiumEnv("Ant-v5")
