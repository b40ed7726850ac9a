"""Whatever acts as a guide: objects, functions, networks, models of other libraries."""

import importlib
import textwrap
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hosted_guides import cones, driven, steps_of_episode
from plants import Plant
from sklearn.linear_model import LinearRegression
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import TransformedEnv
from worlds import continued

from coil_rl import GymnasiumEnv
from coil_rl.guides import ControllerGuide, FollowAdvice, PerRow
from coil_rl.learners import PPO
from coil_rl.run import checkpoint
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions

SOURCE = """
from tensordict.nn import TensorDictModuleBase

class Guide(TensorDictModuleBase):
    in_keys, out_keys = ["steering"], ["action"]

    def __init__(self, gain=1.0):
        super().__init__()
        self.gain = gain

    def forward(self, tensordict):
        return tensordict.set("action", self.gain * tensordict["steering"])

class Counter:
    def __init__(self, step=0.01):
        self.step, self.count = step, 0

    def reset(self):
        self.count = 0

    def act(self, observation):
        assert observation.shape == (20,)
        self.count += 1
        return self.step * self.count

    def state_dict(self):
        return {"count": self.count}

    def load_state_dict(self, state):
        self.count = state["count"]

class Other:
    pass

class OfThree:
    def act(self, one, two, three):
        return one

def half(observation, gain=0.5):
    return gain * observation[..., :1]

number = 3
"""


@pytest.fixture(scope="module", autouse=True)
def control(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    (folder / "my_control.py").write_text(textwrap.dedent(SOURCE))
    (folder / "my_needy.py").write_text("import no_such_package\n")
    (folder / "my_broken.py").write_text("1 / 0\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module("my_control")


@pytest.mark.parametrize(("name", "in_keys"), [("Guide", None), ("half", ["steering"])])
def test_class_of_guides_and_function_act_on_their_entries_with_their_options(name, in_keys):
    guide = ControllerGuide(f"my_control:{name}", in_keys, {"gain": 0.25})
    rollout, advice = driven(cones(guide))
    assert torch.equal(advice, rollout["steering"] / 4)


@pytest.mark.parametrize("wrapped", [False, True])
def test_network_that_is_an_object_is_copied(wrapped):
    network = torch.nn.Linear(2, 1)
    module = TensorDictModule(network, ["observation"], ["action"]) if wrapped else network
    guide, ones = ControllerGuide(module), torch.ones(1, 2)
    action = guide(TensorDict({"observation": ones}, [1]))["action"]
    torch.testing.assert_close(action, network(ones))
    before = network.weight.clone()
    with torch.no_grad():
        for parameter in guide.parameters():
            parameter.add_(1.0)
    assert torch.equal(network.weight, before)


def test_python_objects_are_one_a_row_and_reset_with_their_episodes():
    rollout, advice = driven(cones(ControllerGuide("my_control:Counter", options={"step": 0.001})))
    torch.testing.assert_close(advice.squeeze(-1), 0.001 * steps_of_episode(rollout))


class Static:
    @staticmethod
    def act(observation):
        return -0.5


class OfClass:
    gain = 0.25

    @classmethod
    def act(cls, observation):
        return cls.gain


class Plain:
    def __init__(self, gain, sign=1):
        self.gain, self.sign = gain, sign

    def act(self, observation):
        return self.sign * self.gain


@pytest.mark.parametrize(
    ("of", "options", "action"),
    [
        (Static, {}, -0.5),
        (Static(), {}, -0.5),
        (OfClass, {}, 0.25),
        (OfClass(), {}, 0.25),
        (partial(Plain, 0.125), {}, 0.125),
        (partial(Plain, gain=0.125), {"sign": -1}, -0.125),
        (partial(partial(Plain, sign=-1), 0.125), {}, -0.125),
        (partial(lambda observation, gain: gain, gain=0.125), {}, 0.125),
    ],
)
def test_class_and_object_act_however_their_act_is_defined(of, options, action):
    guide = ControllerGuide(of, options=options)
    assert cones(guide).reset()["guide_action"].unique().tolist() == [action]


def test_object_without_reset_is_made_anew_for_each_episode():
    class Forgetful:
        count = 0

        def act(self, observation, steering):
            observation[:], self.count = 9.0, self.count + 1
            return np.float32(self.count / 1000)

    rollout, advice = driven(cones(PerRow(Forgetful, ["observation", "steering"])))
    torch.testing.assert_close(advice.squeeze(-1), 0.001 * steps_of_episode(rollout))
    assert (rollout["observation"] < 9).all(), (
        "what a controller does with its array should not change the data"
    )


class Halves:
    """Changes in place what it is given."""

    def __init__(self, gains):
        self.gains = gains

    def act(self, observation=None):
        self.gains["now"][0] /= 2
        return self.gains["now"]


class Halving(Plant):
    """Pays halves of the options of its maker, and of its resets."""

    def __init__(self, gains):
        super().__init__(end=3)
        self.made = Halves(gains)

    def reset(self, *, seed=None, options=None):
        self.begun = Halves(options)
        return super().reset(seed=seed)

    def step(self, action):
        paid = self.begun.act()[0] + 10 * self.made.act()[0]
        observation, _, *ends = super().step(action)
        return observation, paid, *ends


class PaysMore(gymnasium.RewardWrapper):
    def __init__(self, env, gains):
        super().__init__(env)
        self.wrapped = Halves(gains)

    def reward(self, reward):
        return reward + 100 * self.wrapped.act()[0]


def test_arguments_belong_to_one_row_and_one_episode():
    gains = {"now": [1.0]}
    theirs = partial(Halves, gains=gains)
    env = GymnasiumEnv(
        Halving,
        2,
        options={"gains": gains},
        reset_options=gains,
        wrappers=[partial(PaysMore, gains=gains)],
        controllers={"beside": theirs},
        fresh=True,
    )
    env = TransformedEnv(env, GuideActions({"theirs": ControllerGuide(theirs)}))
    data = env.rollout(5, break_when_any_done=False)
    halves = torch.tensor([0.5, 0.25, 0.125, 0.5, 0.25]).expand(2, -1)[..., None]
    assert torch.equal(data["guide_action"][..., 0, :], halves)
    assert torch.equal(data["controller", "beside"], halves)
    assert torch.equal(data["next", "reward"], 111 * halves)


def test_states_of_the_objects_are_in_the_checkpoint():
    def rollout(seed):
        policy = TensorDictModule(lambda x: torch.tanh(x[:, :1]), ["observation"], ["action"])
        return Rollout(cones(ControllerGuide("my_control:Counter"), seed=seed), policy, 8)

    expected, resumed = continued(rollout)
    assert (expected == resumed).all()
    assert expected["guide_action"][:, 0].max() > 0.02, "episodes should go on"


class Stateless:
    def act(self, observation):
        return 0.0


def test_state_of_numbers_of_numpy_comes_back_as_it_was_and_an_array_is_refused(tmp_path):
    values = [np.float64(0.1), np.float32(0.1), np.int64(3), np.bool_(True), 0.1]

    class Stateful(Stateless):
        def state_dict(self):
            return {"values": getattr(self, "values", values)}

        def load_state_dict(self, state):
            self.values = state["values"]

    guide = PerRow(Stateful)
    env = cones(guide, cars=2)
    env.rollout(2)
    checkpoint.save(env.state_dict(), tmp_path / "state.pt")
    env.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    found = guide.hosts[1].thing.values
    assert [(type(each), each) for each in found] == [(type(each), each) for each in values]
    guide.hosts[1].thing.values = np.zeros(2)
    message = r"state_dict\(\) of the controller Stateful may hold numbers, .*; convert NumPy"
    with pytest.raises(ValueError, match=message):
        env.state_dict()


def test_new_episodes_begin_if_a_controller_cannot_save_its_state():
    guide = PerRow(Stateless)
    env = cones(guide, cars=2)
    env.rollout(2)
    with pytest.warns(UserWarning, match="the controller Stateless has no state_dict"):
        env.load_state_dict(env.state_dict())
    assert not guide.continues


class Regressor:
    """A model of a library whose `predict` is of another kind."""

    def predict(self, x):
        return x


class OfOneEntry:
    def predict(self, observation, deterministic=True):
        return observation


@pytest.mark.parametrize(
    ("of", "given", "message"),
    [
        ("my_control", {}, "of=my_control must be MODULE:NAME, such as my_package.control:MyPID"),
        ("my_contrl:Net", {}, "no module my_contrl; install its package, or add its folder to PYT"),
        ("my_needy:Net", {}, "my_needy needs no_such_package, which is missing; install it"),
        ("my_broken:Net", {}, r"my_broken cannot be imported \(ZeroDivisionError: division by z"),
        ("my_control:Conter", {}, "my_control has no Conter; did you mean Counter"),
        ("my_control:number", {}, "my_control:number is int; name a class or an object with act"),
        (Regressor(), {}, r"or a model with predict\(observation, deterministic=T.*:NAME\.predict"),
        (
            "my_control:Other",
            {},
            r"is a class without act\(observation\); name a class or an object",
        ),
        (Static(), {"options": {"gain": 1}}, "is an object, which takes no options"),
        (
            "my_control:Counter",
            {"options": {"stpe": 1}},
            r"takes \(step=0.01\), but is called with \(stpe=\): .* mean step",
        ),
        (
            partial(Plain),
            {"options": {"gian": 1}},
            r"^Plain takes \(gain, .*\(gian=\): .* mean gain",
        ),
        (
            "my_control:half",
            {"options": {"k": 1}},
            r"takes \(observation, gain=0.5\), but is called with \(observation, k=\)",
        ),
        (
            "my_control:OfThree",
            {"in_keys": ["a", "b"]},
            r"takes \(self, one, two, three\), but is called with \(a, b\): .*; in_keys=",
        ),
        (
            "my_control:Guide",
            {"in_keys": ["a", "b"]},
            r"of=my_control:Guide has its own in_keys=\['steering'\]; leave in_keys out",
        ),
        (
            OfOneEntry(),
            {"in_keys": ["a", ("b", "c")]},
            r"of=OfOneEntry predicts from one entry.*in_keys names a, \[b,c\]; name one",
        ),
    ],
)
def test_controller_that_cannot_be_used_is_refused_in_one_sentence(of, given, message):
    with pytest.raises(ValueError, match=message) as error:
        ControllerGuide(of, **given)
    assert "\n" not in str(error.value)


def test_matrix_of_a_controller_is_the_matrix_that_the_env_gets():
    plant, matrix = Plant(actions=spaces.Box(-1, 1, (2, 3))), np.arange(6.0).reshape(2, 3) / 10

    class Gives:
        def act(self, observation):
            return matrix

    env = GymnasiumEnv(lambda: plant, controllers={"beside": Gives()}, max_steps=9)
    assert env.action_spec.shape == (1, 6)
    env = TransformedEnv(env, GuideActions({"theirs": PerRow(Gives)}))
    data = env.reset()
    assert data["guide_action"].shape == (1, 1, 6)
    actions = [FollowAdvice(env, guide)(data.clone())["action"] for guide in (0, [0])]
    for action in (*actions, data["controller", "beside"]):
        env.step(data.clone().set("action", action))
        np.testing.assert_allclose(plant.given[-1], matrix, rtol=1e-6)


TWO = spaces.Box(-9.0, 9.0, (2,))


def first_two(numbers):
    """Return two of the numbers of an observation, as an action."""
    return np.resize(np.ravel(numbers), 2)


class Reader:
    def act(self, observation):
        assert isinstance(observation, (np.ndarray, np.int64, np.float32))
        if observation.dtype.kind == "f":
            return [float(observation)] * 2  # a number, not an array with one
        assert observation.dtype.kind == "i"  # it may be an index
        return first_two(observation)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([7, 4], start=[-3, 1]),
        spaces.MultiDiscrete([[3, 2], [2, 4]]),
        spaces.MultiBinary(3),
        spaces.Box(-3, 8, (2,), np.int16),
        spaces.Box(0, 9, (2, 2), np.uint8),
        spaces.Box(-3, 9, (), np.int64),
        spaces.Box(-3, 9, (), np.float32),
    ],
    ids=str,
)
@pytest.mark.parametrize(
    "controller",
    [Reader, Reader(), first_two, lambda batch: batch.view(len(batch), -1)[:, [0, -1]]],
    ids=["class", "object", "function", "batch"],
)
def test_controller_reads_an_observation_as_the_env_gives_it(space, controller):
    plant = Plant(space, TWO)
    env = GymnasiumEnv(lambda: plant, max_steps=9)
    advised = TransformedEnv(env, GuideActions({"reader": ControllerGuide(controller)}))
    advice = advised.rollout(5)["guide_action"].reshape(-1, 2)
    batched = not isinstance(controller, (type, Reader)) and controller is not first_two
    seen = [np.ravel(each) for each in plant.shown[-6:-1]]
    expected = [each[[0, -1]] if batched else first_two(each) for each in seen]
    assert np.array_equal(advice.numpy(), np.array(expected, np.float32))


GEAR, POSE = spaces.Discrete(3, start=-1), spaces.Box(-1, 1, (2,))
SHIP = spaces.Dict(nav=spaces.Dict(gear=GEAR, pose=POSE), draught=spaces.Box(0, 9, ()))
OF_SHIP = [["nav", "gear"], ["nav", "pose"], "draught"]
OF_PAIR = [["observation", "0"], ["observation", "1"]]


@pytest.mark.parametrize(
    ("space", "keys", "read"),
    [
        (SHIP, OF_SHIP, lambda whole: [whole["nav"]["gear"], whole["draught"]]),
        (SHIP, OF_SHIP[:2], lambda whole: whole["nav"]["pose"]),
        (spaces.Tuple((GEAR, POSE)), OF_PAIR, lambda whole: [whole[0], whole[1][1]]),
        (
            spaces.Dict({"1": GEAR, "0": POSE}),
            ["0", "1"],
            lambda whole: [whole["1"], whole["0"][0]],
        ),
        (
            spaces.Dict(observation=SHIP["nav"]),
            [["observation", "gear"], ["observation", "pose"]],
            lambda whole: whole["observation"]["pose"] + whole["observation"]["gear"],
        ),
    ],
    ids=["dictionary", "part of it", "tuple", "numbered", "one name"],
)
@pytest.mark.parametrize("kind", ["class", "object", "function"])
def test_controller_of_one_argument_gets_several_entries_as_one_observation(
    space, keys, read, kind
):
    class Acts:
        def act(self, observation):
            return read(observation)

    plant = Plant(space, TWO)
    of = {"class": Acts, "object": Acts(), "function": read}[kind]
    guide = GuideActions({"it": ControllerGuide(of, keys)})
    env = TransformedEnv(GymnasiumEnv(lambda: plant, max_steps=9), guide)
    advice = env.rollout(5)["guide_action"].reshape(-1, 2)
    expected = [read(shown) for shown in plant.shown[-6:-1]]
    np.testing.assert_array_equal(advice, np.array(expected, np.float32))


@pytest.mark.parametrize("rows", [1, 3])
def test_table_of_numpy_gives_an_action_for_each_row_also_for_one(rows):
    table = np.arange(10, dtype=np.float32).reshape(5, 2)
    env = GymnasiumEnv(partial(Plant, spaces.Discrete(5), TWO), rows, max_steps=9)
    guide = ControllerGuide(lambda place: table[place])
    data = TransformedEnv(env, GuideActions({"table": guide})).rollout(3)
    expected = table[data["observation"].argmax(-1).numpy()]
    assert np.array_equal(data["guide_action"][..., 0, :].numpy(), expected)


STEPS = 5


def advised(guide, id="Pendulum-v1", rows=2, **arguments):
    """Return the steps of an env with advice of a guide."""
    env = TransformedEnv(GymnasiumEnv(id, rows, **arguments), GuideActions({"theirs": guide}))
    return env.rollout(STEPS, break_when_any_done=False)


class Squeezed(nn.Module):
    def forward(self, observation):
        return 2.0 * observation[..., 0]


def predicting(targets):
    return LinearRegression(fit_intercept=False).fit(np.eye(3), targets).predict


@pytest.mark.parametrize(
    "controller",
    [
        predicting([2.0, 0.0, 0.0]),  # gives [B]
        predicting([[2.0], [0.0], [0.0]]),  # gives [B, 1]
        Squeezed(),
        lambda x: 2.0 * x[..., 0],
    ],
)
def test_one_number_for_each_row_is_an_action_of_one_number(controller):
    data = advised(ControllerGuide(controller))
    expected = (2.0 * data["observation"][..., :1]).clamp(-2.0, 2.0)
    torch.testing.assert_close(data["guide_action"][..., 0, :], expected)


@pytest.mark.parametrize(
    "action",
    [
        lambda x: -x[0],  # of two entries that are 0 at first
        lambda x: (x - x.mean())[..., :1],
        lambda x: (x / max(1.0, float(abs(x).max())))[..., :1],
    ],
    ids=["first entry", "less the mean", "scaled by the largest"],
)
def test_function_of_one_observation_does_not_mix_the_rows(action):
    guide = ControllerGuide(action)
    guide(TensorDict({"observation": torch.zeros(1, 2)}, [1]))
    observations = torch.tensor([[1.0, 2.0], [40.0, -70.0]])
    found = guide(TensorDict({"observation": observations}, [2]))["action"].flatten()
    torch.testing.assert_close(found, torch.tensor([float(action(each)) for each in observations]))


@pytest.mark.parametrize(
    ("id", "action", "for_batch"),
    [
        ("Pendulum-v1", lambda x: -x[..., 0], False),
        ("Pendulum-v1", lambda x: 1 * (x[..., 0] > 0), False),
        ("Pendulum-v1", lambda x: -x[..., :1], True),
        ("CartPole-v1", lambda x: 1 * (x[..., 2] > 0), True),
        ("CartPole-v1", lambda x: 1.0 * (x[..., 2] > 0), True),
    ],
)
def test_function_is_for_a_batch_only_if_its_answer_has_the_form_of_actions(id, action, for_batch):
    guide = ControllerGuide(action)
    rollout = advised(guide, id)
    assert guide.guide.for_batch is for_batch
    found = rollout["guide_action"][:, :, 0]
    found = found[..., 1] if id == "CartPole-v1" else found[..., 0]
    expected = action(rollout["observation"]).reshape(found.shape)
    torch.testing.assert_close(found, expected.to(found.dtype))


class Model:
    """As a model of Stable-Baselines3 with a memory: its action is the number of the call."""

    observation_space = spaces.Box(-10, 10, (3,), np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert observation.shape == (3,)
        assert deterministic
        count = np.zeros(1) if state is None or episode_start[0] else state[0]
        return np.float32(count / 10), (count + 1,)


def test_model_of_another_library_is_a_controller():
    advice = advised(ControllerGuide(Model()), max_steps=4)["guide_action"]
    torch.testing.assert_close(advice[..., 0, 0], torch.tensor([[0, 0.1, 0.2, 0.3, 0]] * 2))
    assert (advised(ControllerGuide(Model), max_steps=4)["guide_action"] == advice).all()


def test_memory_of_a_model_is_in_the_checkpoint():
    def rollout(seed):
        env = GymnasiumEnv("Pendulum-v1", 2, seed=seed, max_steps=7)
        env = TransformedEnv(env, GuideActions({"model": ControllerGuide(Model())}))
        return Rollout(env, PPO(env, ["observation", "guide_action"]).policy, 5)

    expected, resumed = continued(rollout)
    torch.testing.assert_close(expected["guide_action"], resumed["guide_action"])
    assert expected["guide_action"].max() > 0.5


def test_model_gets_choices_and_dictionaries_as_its_spaces_have_them():
    seen = []

    class Reads:
        observation_space = spaces.Dict(
            {"place": spaces.Discrete(4, start=2), "pair": spaces.MultiDiscrete([2, 3])}
        )

        def predict(self, observation, deterministic=True):
            seen.append((int(observation["place"]), observation["pair"].tolist()))
            return np.zeros(2), None

    plant = Plant(Reads.observation_space, TWO)
    advised(ControllerGuide(Reads()), lambda: plant, 1, max_steps=9)
    shown = [(each["place"], each["pair"].tolist()) for each in plant.shown]
    assert seen[:STEPS] == shown[:STEPS]


def test_saved_model_of_stable_baselines3_is_a_guide(tmp_path):
    """Its advice is what the library itself computes."""
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    for algorithm, id in ((sb3.PPO, "CartPole-v1"), (sb3.SAC, "Pendulum-v1")):
        algorithm("MlpPolicy", id, seed=0, device="cpu").save(tmp_path / "model")
        model = algorithm.load(tmp_path / "model", device="cpu")
        rollout = advised(ControllerGuide(model), id)
        observations = rollout["observation"].reshape(-1, rollout["observation"].shape[-1])
        expected, _ = model.predict(observations.numpy(), deterministic=True)
        advice = rollout["guide_action"].reshape(len(observations), -1)
        if id == "CartPole-v1":
            assert advice.argmax(-1).tolist() == expected.tolist()
        else:
            np.testing.assert_allclose(advice.numpy(), expected, atol=1e-5)
