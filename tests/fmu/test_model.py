"""FMUs and uses that are odd: each is one sentence, or does what is meant."""

import re
import warnings

import fmus
import pytest
import torch
from torchrl.data import Bounded

from coil_fmu import fmu_env

SETTINGS = {"step": 0.01, "seconds": 0.1, "setpoints": {"speed": 100.0}}
ODD = """
class Odd(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.push, self.open, self.gear = 0.0, False, 1
        self.speed, self.name, self.moving = 0.0, "odd", False
        self.register_variable(Real("push", causality=I))
        self.register_variable(Boolean("open", causality=I))
        self.register_variable(Integer("gear", causality=I))
        self.register_variable(Real("speed", causality=O))
        self.register_variable(String("name", causality=O))
        self.register_variable(Boolean("moving", causality=O))

    def do_step(self, time, step):
        self.speed = self.push * self.gear + self.open
        self.moving = self.speed != 0.0
        if self.push > 5.0:
            raise ValueError("broken")
        if self.push < -5.0:
            self.speed = float("nan")
        return True
"""


def odd(_=None):
    return fmus.built(ODD, "odd")


def changed(changes, files=None):
    return lambda folder: fmus.edited(fmus.motor(), folder / "changed.fmu", changes, files)


def text(folder):
    path = folder / "text.fmu"
    path.write_text("no archive")
    return path


def motor(_):
    return fmus.motor()


def tank(_):
    return fmus.tank()


CASES = {
    "missing": (lambda folder: folder / "none.fmu", {}, "does not exist"),
    "no archive": (text, {}, "text.fmu is no FMU: .*zip"),
    "FMI 1": (changed({'fmiVersion="2.0"': 'fmiVersion="1.0"'}), {}, "FMI 1.*export it again"),
    "model exchange": (
        changed({"<CoSimulation ": "<ModelExchange "}),
        {},
        "model exchange only.*co-simulation",
    ),
    "platform": (changed({}, {"linux64": "darwin64"}), {}, "binaries for darwin64, win64, but th"),
    "no input": (changed({'causality="input"': 'causality="local"'}), {}, "has no input"),
    "unknown input": (motor, {"actions": ["volt"]}, r"no input 'volt'.* did you mean voltage\?"),
    "unknown output": (motor, {"observations": ["sped"]}, "no output or local 'sped'; .* speed"),
    "unknown parameter": (
        motor,
        {"parameters": {"inertial": {"low": 1, "high": 2}}},
        "did you mean inertia",
    ),
    "text": (odd, {"observations": ["name"]}, "name of odd.fmu is a String"),
    "solver failure": (
        tank,
        {"step": 2.0, "seconds": 4.0, "setpoints": {"level": 0.5}},
        "tank.fmu failed after 0 s of an episode: the tank overflows .* counts as failed",
    ),
    "its own setpoint": (
        changed({'name="current"': 'name="speed_setpoint"'}),
        {},
        "changed.fmu has an output speed_setpoint itself; leave it out",
    ),
    "drawn whole number": (
        odd,
        {"actions": ["push"], "parameters": {"gear": {"low": 1, "high": 3}}},
        "gear of odd.fmu is a Integer, and only real numbers are drawn",
    ),
    "one bound": (motor, {"bounds": {"voltage": [24]}}, "at least 2 long"),
    "course with a unit": (
        motor,
        {"setpoints": {"speed": "100 rpm"}},
        "setpoints.speed: .*'100 rpm'; give a number, or",
    ),
    "course without a name": (
        motor,
        {"parameters": {"inertia": [0.8, 1.2]}},
        "parameters.inertia: .*give a number, or",
    ),
    "course the wrong way": (
        motor,
        {"setpoints": {"speed": {"low": 3, "high": 1}}},
        "low=3.* must be at most high=1",
    ),
    "both kinds": (odd, {}, "push of odd.fmu are real .* open, gear are choices"),
    "whole without bounds": (
        odd,
        {"actions": ["gear"]},
        r"gear of odd.fmu is a whole number without bounds; .*env.bounds.gear=\[LOW,HIGH\]",
    ),
    "min = max": (
        changed({'min="-24" max="24"': 'min="5" max="5"'}),
        {},
        "voltage of changed.fmu goes from 5 to 5, which leaves no choice",
    ),
    "no step": (motor, {"step": None}, "give env.step.*prefers 0.01"),
    "no seconds": (
        tank,
        {"seconds": None, "setpoints": {"level": 1.0}},
        "tank.fmu has no stopTime",
    ),
    "indivisible": (motor, {"step": 0.03}, "step=0.03 does not divide the 0.1 s .*0.06 or 0.09"),
    "fixed step": (
        changed({'canHandleVariableCommunicationStepSize="true"': ""}),
        {"step": 0.025},
        "takes steps of 0.01 s only",
    ),
    "nothing to follow": (motor, {"setpoints": {}}, "nothing to follow"),
    "setpoint of nothing": (motor, {"setpoints": {"voltage": 1.0}}, "voltage is not observed"),
    "no module": (motor, {"reward": "nowhere:none"}, "reward=nowhere:none: there is no"),
    "no unit": (
        changed({'unit="rad/s"': ""}),
        {},
        "'speed': {'unit': 'not said', 'meaning': 'nominal 100'}",
    ),
}


def said(file, settings):
    """Return why an FMU is no env, what is said of a step, or what its numbers mean."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            env = fmu_env(file, **(SETTINGS | settings))
        except ValueError as error:
            return str(error)
        env.step(env.reset().set("action", env.action_spec.space.high))
    return "\n".join(str(each.message) for each in warned) or str(env.meanings)


@pytest.mark.parametrize(("make", "settings", "sentence"), CASES.values(), ids=CASES)
def test_what_is_odd_is_one_sentence(make, settings, sentence, tmp_path):
    text = said(make(tmp_path), settings)
    assert re.search(sentence, text), text
    assert "\n" not in text
    assert "..." not in text  # what to do is at the end


def test_texts_are_left_out_and_flags_are_numbers():
    env = fmu_env(odd(), actions=["push"], **SETTINGS)
    data = env.step(env.reset().set("action", torch.ones(1, 1)))["next"]
    assert sorted(env.observation_spec.keys()) == ["info", "moving", "speed", "speed_setpoint"]
    assert (data["moving"].item(), data["speed"].item()) == (1.0, 1.0)


def test_flags_and_whole_numbers_are_choices():
    env = fmu_env(
        odd(), actions=["open", "gear"], bounds={"gear": [2, 4]}, start={"push": 1.0}, **SETTINGS
    )
    assert env.action_spec.nvec.tolist() == [[2, 3]]
    data = env.step(env.reset().set("action", torch.tensor([[1, 2]])))["next"]
    assert data["speed"].item() == 1.0 * 4 + 1


def test_an_input_without_bounds_has_none():
    assert not isinstance(fmu_env(odd(), actions=["push"], **SETTINGS).action_spec, Bounded)


@pytest.mark.parametrize(("push", "said"), [(6.0, "fatal|error"), (-6.0, "its output speed is")])
def test_an_exception_and_a_nan_are_failures(push, said):
    env = fmu_env(odd(), actions=["push"], **SETTINGS)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for _ in range(3):
            data = env.step(env.reset().set("action", torch.full((1, 1), push)))["next"]
            assert data["terminated"].item()
            assert data["info", "failed"].item() == 1.0
            assert data["speed"].item() == 0.0
    assert [re.search(said, str(each.message)) is None for each in warned] == [False]


def test_two_fmus_with_one_name_stay_apart(tmp_path):
    faster = fmus.MOTOR.replace("0.02", "0.01")
    other = fmus.built(faster, "motor2")
    same_name = tmp_path / "motor.fmu"
    other.rename(same_name)
    envs = [
        fmu_env(path, start={"inertia": 0.01}, **SETTINGS) for path in (fmus.motor(), same_name)
    ]
    speeds = []
    for env in envs:
        data = env.step(env.reset().set("action", torch.full((1, 1), 10.0)))["next"]
        speeds.append(data["speed"].item())
    assert speeds[0] != speeds[1]


def test_an_fmu_of_which_a_process_holds_one_has_copies():
    once = fmus.edited(
        fmus.motor(),
        fmus.folder() / "once.fmu",
        {'OnlyOncePerProcess="false"': 'OnlyOncePerProcess="true"'},
    )
    env = fmu_env(once, num_envs=2, **SETTINGS)
    env.rollout(3)
    folders = {plant.env.unwrapped.instance.folder for plant in env.held.plants}
    assert len(folders) == 2


def test_fmi_3_has_arrays_and_flags():
    env = fmu_env(
        fmus.heaters(),
        step=0.1,
        seconds=1.0,
        reward=lambda now, before: float(now.outputs["temperature"].min()),
        num_envs=2,
    )
    assert env.action_spec.space.high.tolist() == [[5.0, 5.0]] * 2
    data = env.reset()
    for _ in range(10):
        data = env.step_mdp(env.step(data.set("action", torch.tensor([[5.0, 4.0]] * 2))))
    assert data["temperature"].shape == (2, 2)
    assert data["temperature"][0].tolist() == pytest.approx([24.78, 23.83], abs=0.01)
    assert data["warm"].tolist() == [[1.0], [1.0]]
    assert env.meanings["action"]["unit"] == "kW, kW"
