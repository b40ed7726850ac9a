"""The recorded steering as a guide that demonstrates."""

import torch
from tensordict import TensorDict

from coil_robot import RecordingGuide


def test_action_is_the_recorded_steering():
    steering = torch.tensor([[0.25], [-0.5]])
    data = TensorDict({"observation": torch.zeros(2, 20), "info": {"recorded": steering}}, [2])
    assert RecordingGuide()(data)["action"].equal(steering)


def test_where_nothing_was_recorded_the_action_is_straight():
    data = TensorDict({"observation": torch.ones(3, 20), "info": {"lap": torch.ones(3, 1)}}, [3])
    assert RecordingGuide()(data)["action"].equal(torch.zeros(3, 1))
    assert RecordingGuide.demonstrates
