"""Several guides as one, each on its own part of the rows."""

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from coil_rl import GymnasiumEnv
from coil_rl.guides.candidates import Candidates
from coil_rl.guides.classic import ClassicGuide, Oscillator
from coil_rl.guides.controllers import PerRow
from coil_rl.guides.simple import ConstantGuide
from coil_rl.transforms import GuideActions
from coil_rl.transforms.guide_memory import GuideMemory


class Counter:
    """Controller that pushes harder with each step, by its gain."""

    def __init__(self, gain=1.0):
        self.gain, self.steps = gain, 0

    def act(self, observation):
        self.steps += 1
        return [self.gain * self.steps]


def test_each_guide_acts_in_its_own_part_of_the_rows():
    candidates = Candidates([ConstantGuide(1.0), ConstantGuide(2.0), ConstantGuide(3.0)])
    rows = TensorDict({"observation": torch.zeros(6, 4)}, [6])
    assert candidates(rows)["action"].flatten().tolist() == [1, 1, 2, 2, 3, 3]
    candidates.replace([ConstantGuide(5.0), ConstantGuide(6.0)])
    assert candidates(rows)["action"].flatten().tolist() == [5, 5, 5, 6, 6, 6]


def test_controllers_with_a_state_have_one_object_for_each_row():
    guides = [PerRow(lambda gain=gain: Counter(gain)) for gain in (0.1, 0.2)]
    env = GymnasiumEnv("Pendulum-v1", 4)
    env = TransformedEnv(env, GuideActions({"counter": Candidates(guides)}))
    advice = env.rollout(3)["guide_action"].squeeze()
    expected = torch.tensor([[0.1, 0.2, 0.3]] * 2 + [[0.2, 0.4, 0.6]] * 2)
    assert torch.allclose(advice, expected)


def test_memory_of_the_guides_is_declared_once():
    memory = GuideMemory("swim", Candidates([Oscillator(), Oscillator(frequency=0.3)]))
    assert list(memory.specs) == ["swum_steps"]


def test_what_a_guide_reads_and_writes_is_that_of_the_first():
    candidates = Candidates([ClassicGuide("swing_up"), ClassicGuide("swing_up", {"gain": 1.0})])
    assert (candidates.in_keys, candidates.out_keys) == (["observation"], ["action"])
