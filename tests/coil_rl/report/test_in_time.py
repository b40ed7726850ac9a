import numpy as np
import pytest
import torch
from gymnasium import spaces
from plants import Plant
from torchrl.envs import Compose, TransformedEnv

from coil_rl import GuideActions, GymnasiumEnv, NormalisedAction
from coil_rl.report import InTime
from coil_rl.transforms import DiscreteActions


def drive(plant, actions, *transforms):
    """Return the trace of a policy that takes these actions."""
    env = TransformedEnv(GymnasiumEnv(lambda: plant, max_steps=9), Compose(*transforms))
    picture, data = InTime(), env.reset()
    for action in actions:
        before = data.set("action", torch.tensor([action]))
        both, data = env.step_and_maybe_reset(before)
        picture.watch(env, {"policy": 0}, before, both["next"])
    return picture.traces["policy"]


def up(observation):
    return np.array([150.0])


def test_numbers_among_which_an_agent_chooses_are_drawn_as_the_env_is_given_them():
    plant = Plant(actions=spaces.Box(100, 200, (1,)))
    transforms = NormalisedAction(), GuideActions({"up": up}), DiscreteActions(5)
    trace = drive(plant, [0, 1, 4], *transforms)
    assert trace["action"] == np.array(plant.given).tolist() == [[100], [125], [200]]
    assert trace["guide_action"] == [[150]] * 3


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (spaces.Discrete(3, start=-2), [0, 2]),
        (spaces.MultiDiscrete([2, 3], start=[5, -1]), [[0, 2], [1, 0]]),
        (spaces.Box(np.float32([0, -1e3]), np.float32([1, 1e3])), [[0.5, -1.0], [-1.0, 0.25]]),
    ],
)
def test_actions_are_drawn_in_the_units_and_the_numbering_of_the_env(space, actions):
    plant = Plant(actions=space)
    transforms = [NormalisedAction()] if isinstance(space, spaces.Box) else []
    drawn = drive(plant, actions, *transforms)["action"]
    assert drawn == np.reshape(plant.given, (2, -1)).tolist()


def test_all_entries_but_pictures_are_drawn_of_an_env_without_one_observation():
    pair = spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.Discrete(9, start=7)])
    pixels = spaces.Box(0, 255, (4, 4, 3), np.uint8)
    plant = Plant(pair)
    trace = drive(plant, [[0.0]])
    assert trace["observation.0"] == [plant.shown[0][0].tolist()]
    assert trace["observation.1"] == [[float(plant.shown[0][1])]]
    named = Plant(spaces.Dict({"camera": pixels, "speed": spaces.Box(-1, 1, (1,))}))
    assert drive(named, [[0.0]]).keys() == {"speed", "action"}
