"""Controllers that draw random numbers which no seed of a run reaches."""

import random
import warnings

import numpy as np
import pytest
import torch

from coil_rl.config.check import check
from coil_rl.config.python import composed, named
from coil_rl.foreign.controllers import ControllerGuide
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.foreign.trial import STEPS, Trial


class Still:
    """Controller that draws nothing, and counts its calls."""

    calls = 0

    def __init__(self):
        self.past = 0.0

    def act(self, observation):
        Still.calls += 1
        self.past = 0.9 * self.past + 0.1 * float(observation[0])
        return [self.past + self.draw()]

    def draw(self):
        return 0.0


class Global(Still):
    def draw(self):
        return np.random.randn()


class Python(Still):
    def draw(self):
        return random.gauss(0.0, 1.0)


class Late(Still):
    def draw(self):
        self.step = getattr(self, "step", 0) + 1
        return np.random.randn() if self.step == STEPS else 0.0


class AtReset(Still):
    def reset(self):
        self.past = np.random.randn()


class Seeded(Still):
    def __init__(self, seed=0):
        super().__init__()
        self.generator = np.random.default_rng(seed)

    def draw(self):
        return self.generator.standard_normal()


class Unseeded(Seeded):
    def __init__(self):
        super().__init__(None)


class Inside(Still):
    """Controller whose generator is in a part of it, of the older kind."""

    def __init__(self, seed=None):
        super().__init__()
        self.parts = {"noise": [np.random.RandomState(seed)]}

    def draw(self):
        return self.parts["noise"][0].randn()


class Unused(Unseeded):
    """Controller with a generator that it does not use."""

    def draw(self):
        return 0.0


class OfTorch(Still):
    def draw(self):
        return torch.randn(()).item()


class Fails(Global):
    def draw(self):
        raise RuntimeError("no device")


def found(of):
    """Return the sentences of a trial of a controller, by their kind."""
    trial = Trial(GymnasiumEnv("Pendulum-v1", 2, first_seed=0))
    trial.ask_controller(ControllerGuide(of))
    return dict(trial.findings)


@pytest.mark.fast(2)
@pytest.mark.parametrize("of", [Unseeded, Unseeded(), Inside, Inside()])
def test_controller_that_draws_what_no_seed_reaches_is_found(of):
    sentence = found(of)["draws"]
    name = of.__name__ if isinstance(of, type) else type(of).__name__
    assert sentence.startswith(f"the controller {name} gives other actions for the same")
    assert "reads the clock" in sentence


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    "of",
    [
        *(Still, Still(), Seeded, Seeded(3), Inside(3), Unused(), OfTorch, Fails),
        *(Global, Global(), Python, Late, AtReset),
    ],
)
def test_controller_that_a_run_repeats_is_not_found(of):
    assert not found(of)


def test_function_is_not_asked():
    def function(observation):
        raise AssertionError

    assert not found(function)


def test_global_random_numbers_go_on_as_without_the_trial():
    def drawn():
        return random.random(), np.random.rand(), torch.rand(()).item()

    def seed():
        random.seed(5), np.random.seed(6), torch.manual_seed(7)

    seed()
    expected = drawn()
    seed()
    assert not found(Global)
    assert drawn() == expected


def test_controller_is_asked_in_few_steps():
    Still.calls = 0
    found(Still)
    assert 0 < Still.calls <= 9 * (STEPS + 1)


@pytest.mark.parametrize(("of", "count"), [(Still, 0), (Unseeded, 1)])
def test_run_warns_once_of_a_controller_by_its_name(of, count, tmp_path):
    given = named("Pendulum-v1", of, str(tmp_path))
    config = composed(given, tmp_path).config
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(config)
    said = [str(each.message) for each in caught if "no seed of the run" in str(each.message)]
    assert len(said) == count
    assert all(f":{of.__name__} gives other actions" in text for text in said)


def test_generator_that_all_objects_share_is_left_alone():
    shared = np.random.default_rng()
    before = shared.bit_generator.state

    class Shares(Still):
        def __init__(self):
            super().__init__()
            self.generator = shared

    found(Shares)
    assert shared.bit_generator.state == before
