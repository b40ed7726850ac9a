"""Controllers of others: what they raise or return that is no action is one sentence."""

import itertools

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sklearn.linear_model import LinearRegression
from tensordict import TensorDict
from torch import nn
from torchrl.envs import TransformedEnv
from worlds import continued

from coil_rl import GymnasiumEnv
from coil_rl.envs.gate import ForeignError
from coil_rl.guides import ControllerGuide, PerRow, RecordedGuide
from coil_rl.learners import PPO
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions

STEP = 3  # at which a controller does what it is told


def driven(guide, id="Pendulum-v1", rows=2, **arguments):
    """Return the steps of an env with advice of a guide."""
    env = TransformedEnv(GymnasiumEnv(id, rows, **arguments), GuideActions({"theirs": guide}))
    return env.rollout(STEP + 2, break_when_any_done=False)


class Late:
    """Acts well until a step."""

    def __init__(self, answer):
        self.answer = answer

    def reset(self):
        self.calls = -1

    def act(self, observation):
        self.calls += 1
        return self.answer() if self.calls == STEP else [0.5]


def raising(error):
    def answer():
        raise error

    return answer


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda: None, "the action is None, not an array of numbers"),
        (lambda: np.nan, r"the action is \[nan\], which is not finite"),
        (lambda: [np.inf], r"the action is \[inf\], which is not finite"),
        (lambda: "left", "the action is 'left', not an array of numbers"),
        (lambda: {"action": 1}, "the action is {'action': 1}, not an array of numbers"),
        (lambda: (np.zeros(1), None), "the action is the tuple .*; return the action alone"),
        (lambda: (np.zeros(1), np.zeros(3)), "the action is the tuple .*; return the action alone"),
        (lambda: (torch.zeros(1), ()), "the action is the tuple .*; return the action alone"),
        (lambda: [0.5, [1.0]], "the action is .*, not an array of numbers"),
        (lambda: 1j, "the action is 1j, not an array of numbers"),
        (lambda: object(), "the action is <object .*, not an array of numbers"),
        (raising(IndexError("no joint 7")), "act raised IndexError: no joint 7"),
        (raising(SystemExit(1)), "act raised SystemExit: 1"),
        (lambda: [0.5, 0.5], r"the action has the shape \[2\], but that of row 0 has \[1\]"),
        (lambda: [], r"the action has the shape \[0\], but that of row 0 has \[1\]"),
    ],
)
def test_fault_of_a_controller_is_one_sentence_with_its_place(answer, message):
    makers = iter([Late(lambda: [0.5]), Late(answer)])
    with pytest.raises(ForeignError, match=message) as caught:
        driven(PerRow(lambda: next(makers), title="PID"))
    assert str(caught.value).startswith("the controller PID (row 1, step 3): ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("id", "answer", "message"),
    [
        ("Pendulum-v1", lambda x: None, "the controller <lambda>: .*the action is None"),
        ("Pendulum-v1", lambda x: (x[..., :1], None), "the action is the tuple"),
        ("Pendulum-v1", lambda x: x / "a", "it raised TypeError: "),
        ("Pendulum-v1", lambda x: {}["gain"], "it raised KeyError: 'gain'"),
        ("Pendulum-v1", lambda x: x[..., :1] * np.nan, "is not finite"),
        ("Pendulum-v1", lambda x: x, r"has the shape \[2, 3\], but must have \[2, 1\]"),
        ("CartPole-v1", lambda x: 2, "is neither an index below 2 nor a one-hot vector"),
        ("CartPole-v1", lambda x: 0.5, "is no whole number, but must be the number of a choice"),
        ("CartPole-v1", lambda x: -1, "is neither an index below 2 nor a one-hot vector"),
    ],
)
def test_fault_of_a_function_is_one_sentence(id, answer, message):
    with pytest.raises(ForeignError, match=message) as caught:
        driven(ControllerGuide(answer), id)
    assert str(caught.value).startswith("the controller <lambda>")
    assert "\n" not in str(caught.value)


class Squeezed(nn.Module):
    def forward(self, observation):
        return 2.0 * observation[..., 0]


def predictor(targets):
    x = np.eye(3)
    return LinearRegression(fit_intercept=False).fit(x, 2.0 * x[:, :1].repeat(targets, 1)).predict


@pytest.mark.parametrize(
    "controller",
    [
        LinearRegression(fit_intercept=False).fit(np.eye(3), [2.0, 0.0, 0.0]).predict,  # gives [B]
        predictor(1),  # gives [B, 1]
        Squeezed(),
        lambda x: 2.0 * x[..., 0],
    ],
)
def test_one_number_for_each_row_is_an_action_of_one_number(controller):
    data = driven(ControllerGuide(controller), "Pendulum-v1")
    expected = (2.0 * data["observation"][..., :1]).clamp(-2.0, 2.0)
    torch.testing.assert_close(data["guide_action"][..., 0, :], expected)


def test_numbers_that_are_not_one_for_each_row_are_refused():
    for controller in (predictor(2), predictor(3)):
        with pytest.raises(ForeignError, match="but must have"):
            driven(ControllerGuide(controller), "Pendulum-v1")


def test_action_is_checked_at_every_step():
    class Drifts:
        def reset(self):
            self.calls = -1

        def act(self, observation):
            self.calls += 1
            return self.calls  # an index, and no index of the env from the third call on

    place = (
        r"^the controller Drifts \(row 0, step 2\): act returned \[2\], which is neither an index"
    )
    with pytest.raises(ForeignError, match=place):
        driven(ControllerGuide(Drifts()), "CartPole-v1")


@pytest.mark.parametrize("guide", [ControllerGuide, lambda thing: PerRow(lambda: thing)])
def test_action_of_another_shape_is_that_of_the_controller_without_the_batch(guide):
    class Two:
        def act(self, observation):
            return [1.0, 2.0]

    with pytest.raises(
        ForeignError, match=r"\(row 0, step 0\): act returned \[1.0, 2.0\]"
    ) as caught:
        driven(guide(Two()))
    assert str(caught.value).endswith("which has the shape [2], but must have [1]")


def test_action_of_a_network_that_does_not_fit_names_the_network():
    with pytest.raises(ForeignError, match=r"^the controller Identity: its action has the shape"):
        driven(ControllerGuide(nn.Identity()))


def test_network_that_fails_is_named():
    class Broken(nn.Module):
        def forward(self, x):
            raise RuntimeError("no weights\nat all")

    with pytest.raises(ForeignError, match=r"^the controller Broken: it raised RuntimeError: no"):
        driven(ControllerGuide(Broken()))


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
    rollout = driven(guide, id)
    assert guide.guide.for_batch is for_batch
    found = rollout["guide_action"][:, :, 0]
    found = found[..., 1] if id == "CartPole-v1" else found[..., 0]
    expected = action(rollout["observation"]).reshape(found.shape)
    torch.testing.assert_close(found, expected.to(found.dtype))


def test_function_that_remembers_is_refused():
    calls = itertools.count()
    for action in (lambda x: float(next(calls)), lambda x: x[:, :1] * 0 + next(calls)):
        with pytest.raises(ForeignError, match=r"for the same observation: .* a class"):
            driven(ControllerGuide(action))


def test_function_cannot_change_what_the_agent_sees():
    def spoils(observation):
        observation *= 0
        return observation[..., :1]

    assert (driven(ControllerGuide(spoils))["observation"] != 0).any()


class Model:
    """As a model of Stable-Baselines3 with a memory: its action is the number of the call."""

    observation_space = spaces.Box(-10, 10, (3,), np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert observation.shape == (3,)
        assert deterministic
        count = np.zeros(1) if state is None or episode_start[0] else state[0]
        return np.float32(count / 10), (count + 1,)


def test_model_of_another_library_is_a_controller():
    advice = driven(ControllerGuide(Model()), max_steps=4)["guide_action"]
    torch.testing.assert_close(advice[..., 0, 0], torch.tensor([[0, 0.1, 0.2, 0.3, 0]] * 2))
    assert (driven(ControllerGuide(Model), max_steps=4)["guide_action"] == advice).all()


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
            seen.append(observation)
            return 0, None

    class Grid(gymnasium.Env):
        observation_space = Reads.observation_space
        action_space = spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {"place": 4, "pair": np.array([1, 2])}, {}

        def step(self, action):
            return {"place": 5, "pair": np.array([0, 1])}, 0.0, False, False, {}

    driven(ControllerGuide(Reads()), lambda: Grid(), 1)
    assert seen[0]["place"] == 4
    assert seen[0]["pair"].tolist() == [1, 2]
    assert seen[1]["place"] == 5


def test_object_with_a_predict_of_another_kind_is_refused():
    class Regressor:
        def predict(self, x):
            return x

    with pytest.raises(ValueError, match=r"or a model with predict\(observation, deterministic=T"):
        ControllerGuide(Regressor())
    with pytest.raises(ValueError, match="is an object, which takes no options"):
        ControllerGuide(Model(), options={"gain": 1})


def test_saved_model_of_stable_baselines3_is_a_guide(tmp_path):
    """Its advice is what the library itself computes."""
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    for algorithm, id in ((sb3.PPO, "CartPole-v1"), (sb3.SAC, "Pendulum-v1")):
        algorithm("MlpPolicy", id, seed=0, device="cpu").save(tmp_path / "model")
        model = algorithm.load(tmp_path / "model", device="cpu")
        rollout = driven(ControllerGuide(model), id)
        observations = rollout["observation"].reshape(-1, rollout["observation"].shape[-1])
        expected, _ = model.predict(observations.numpy(), deterministic=True)
        advice = rollout["guide_action"].reshape(len(observations), -1)
        if id == "CartPole-v1":
            assert advice.argmax(-1).tolist() == expected.tolist()
        else:
            np.testing.assert_allclose(advice.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "actions"),
    [
        ("\ufeff0.1\n0.2\n", [[0.1], [0.2]]),
        ("\ufeffpower\n0.1\n", [[0.1]]),
        ("\u22120.1,\u20130.2\n", [[-0.1, -0.2]]),
        ("# of Tuesday\n0.1,0.2 # the first\n\n# end\n", [[0.1, 0.2]]),
        ("0.1;0.2\n", [[0.1, 0.2]]),
        ("a;b\n0,1;-0,2\n", [[0.1, -0.2]]),
        ("0.1 0.2\n0.3\t0.4\n", [[0.1, 0.2], [0.3, 0.4]]),
        ('"0.1" , "0.2"\r\n', [[0.1, 0.2]]),
        ("1e-1\n", [[0.1]]),
    ],
)
def test_actions_of_a_file_in_another_dress(text, actions, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_bytes(text.encode())
    torch.testing.assert_close(RecordedGuide(file).actions, torch.tensor(actions))


@pytest.mark.parametrize(
    "text", ["0.1,0.2\n0.1;0.2;0.3\n", "a,0.1\n0.1,0.2\n", "0.1,,0.2\n", "\x00"]
)
def test_file_that_is_no_table_of_numbers_is_refused(text, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"actions.csv (cannot be read|must hold)"):
        RecordedGuide(file)
