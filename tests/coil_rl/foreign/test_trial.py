"""What a trial finds: what rows share, what lives by the clock, and draws without a seed."""

import random
import re
import time
import warnings

import numpy as np
import pytest
import torch
from plants import Drift

from coil_rl.config.check import check
from coil_rl.config.python import composed, named
from coil_rl.foreign.controllers import ControllerGuide
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.foreign.trial import STEPS, Trial

MEMORY = []


class SharesDefault(Drift):
    def __init__(self, state=[0.0, 0.0], **options):  # noqa: B006
        super().__init__(**options)
        self.state = state

    def begin(self, seed):
        self.state[:] = [self.np_random.uniform(), 0.0]


class SharesAttribute(SharesDefault):
    shared = [0.0, 0.0]  # noqa: RUF012

    def __init__(self, **options):
        super().__init__(self.shared, **options)


class Slow(Drift):
    """Moves with the time that has passed."""

    def begin(self, seed):
        super().begin(seed)
        self.began = time.monotonic()

    def move(self, action):
        super().move(action)
        self.state[1] = float(time.monotonic() - self.began > 0.03)


class Still:
    """A controller of each row alone; its variants share something or draw."""

    def __init__(self):
        self.memory = []

    def act(self, observation):
        self.memory.append(float(observation[0]))
        return [0.1 * sum(self.memory[-3:]) + self.draw()]

    def draw(self):
        return 0.0


class OfClass(Still):
    memory = []  # noqa: RUF012

    def __init__(self):
        pass

    def reset(self):
        pass


class OfClassCleared(OfClass):
    def reset(self):
        self.memory.clear()


class OfModule(OfClass):
    def act(self, observation):
        MEMORY.append(float(observation[0]))
        return [0.1 * sum(MEMORY[-3:])]


class OfClock:
    """Gives a new output only after 10 ms, as a PID controller of a package does."""

    def __init__(self):
        self.last, self.output = -np.inf, [0.0]

    def reset(self):
        self.last = -np.inf

    def act(self, observation):
        now = time.monotonic()
        if now - self.last > 0.01:
            self.last, self.output = now, [float(observation[0])]
        return self.output


class OfDate(OfClock):
    """Gives a new output each second."""

    def act(self, observation):
        now = time.mktime(time.localtime())
        if now > self.last:
            self.last, self.output = now, [float(observation[0])]
        return self.output


def drawing(draw):
    """Return a class of controllers with these random numbers."""
    return type("Drawing", (Still,), {"draw": lambda self: draw()})


def fails():
    raise RuntimeError("no device")


GLOBAL = drawing(np.random.randn)


class Late(Still):
    def draw(self):
        return np.random.randn() if len(self.memory) == STEPS else 0.0


class AtReset(Still):
    def reset(self):
        self.memory = [np.random.randn()]


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


def findings(controller=None, env=Drift):
    """Return the sentences of the trial of an env of two rows, or of a controller in it."""
    trial = Trial(GymnasiumEnv(env, 2, first_seed=0))
    if controller is None:
        trial.ask_env()
    else:
        trial.ask_controller(ControllerGuide(controller))
    return [(kind, text) for kind, text in trial.findings if kind != "bounds"]


UNSEEDED = "Unseeded gives other actions for the same .*reads the clock"
INSIDE = "Inside gives other actions for the same .*reads the clock"


@pytest.mark.parametrize(
    ("controller", "env", "kind", "message"),
    [
        (None, SharesDefault, "rows", "all rows share a default of SharesDefault.__init__; mak"),
        (None, SharesAttribute, "rows", "all rows share SharesAttribute.shared; make it in __i"),
        (None, Slow, "clock", "observation of the env differs when time passes between two"),
        (OfClass, Drift, "rows", "all rows share OfClass.memory; make it in __init__"),
        (OfClassCleared, Drift, "rows", "all rows share OfClass.memory; make it in __init__"),
        (OfModule, Drift, "rows", r"all rows share .*test_trial\.MEMORY; make it in"),
        (OfClock, Drift, "clock", "when time passes between two steps: it reads the clock"),
        (OfDate, Drift, "clock", "the controller OfDate gives other actions when time"),
        (Unseeded, Drift, "draws", UNSEEDED),
        (Inside(), Drift, "draws", INSIDE),
        pytest.param(Unseeded(), Drift, "draws", UNSEEDED, marks=pytest.mark.slow),
        pytest.param(Inside, Drift, "draws", INSIDE, marks=pytest.mark.slow),
    ],
)
def test_trial_names_what_no_run_repeats(controller, env, kind, message):
    ((found, text),) = findings(controller, env)
    assert found == kind
    assert re.search(message, text)


def test_trial_finds_what_rows_share_also_after_they_were_in_processes():
    env = GymnasiumEnv(SharesAttribute, 2, first_seed=0, workers=2)
    env.rollout(3)
    trial = Trial(env)
    trial.ask_env()
    assert [each.kind for each in trial.findings] == ["rows"]


@pytest.mark.fast(8)
@pytest.mark.parametrize(
    "controller",
    [
        *(None, Still, Still(), Seeded, Seeded(3), Inside(3), Unused()),
        *(GLOBAL, GLOBAL(), Late, AtReset, drawing(random.random), drawing(fails)),
        drawing(lambda: torch.randn(()).item()),
    ],
)
def test_trial_blames_nothing_that_a_run_repeats(controller):
    assert findings(controller) == []


def test_function_is_not_asked():
    calls = []
    assert findings(calls.append) == []
    assert not calls


def test_global_random_numbers_go_on_as_without_the_trial():
    def drawn():
        return random.random(), np.random.rand(), torch.rand(()).item()

    def seed():
        random.seed(5), np.random.seed(6), torch.manual_seed(7)

    seed()
    expected = drawn()
    seed()
    assert not findings(GLOBAL)
    assert drawn() == expected


def test_controller_is_asked_in_few_steps():
    calls = []
    findings(drawing(lambda: calls.append(1) or 0.0))
    assert 0 < len(calls) <= 9 * (STEPS + 1)


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

    findings(Shares)
    assert shared.bit_generator.state == before
