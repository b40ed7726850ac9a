"""Real FMUs, built by pythonfmu while the tests run: a tank, a motor, and odd ones of a motor.

pythonfmu writes neither units nor bounds, so that they are written into the description here.
"""

import re
import textwrap
import zipfile
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest

for name in ("fmpy", "pythonfmu"):
    pytest.importorskip(name)

HEAD = """
from pythonfmu import *
from pythonfmu.enums import Fmi2Status
I, O, P = Fmi2Causality.input, Fmi2Causality.output, Fmi2Causality.parameter
FIXED = Fmi2Variability.fixed
"""
MOTOR = """
class Motor(Fmi2Slave):
    default_experiment = DefaultExperiment(start_time=0.0, stop_time=2.0, step_size=0.01)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.voltage, self.inertia, self.friction = 0.0, 0.01, 0.001
        self.speed = self.current = 0.0
        self.register_variable(Real("voltage", causality=I, description="of the armature"))
        self.register_variable(Real("inertia", causality=P, variability=FIXED))
        self.register_variable(Real("speed", causality=O))
        self.register_variable(Real("current", causality=O))

    def do_step(self, time, step):
        for _ in range(4):
            dt = step / 4
            drop = self.voltage - 0.05 * self.speed - self.current
            self.current += dt * drop / 0.02
            self.speed += dt * (0.05 * self.current - self.friction * self.speed) / self.inertia
        return True
"""
TANK = """
class Tank(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.inflow, self.level = 0.0, 0.5
        self.register_variable(Real("inflow", causality=I))
        self.register_variable(Real("level", causality=O))

    def do_step(self, time, step):
        self.level += step * (self.inflow - 0.1 * max(self.level, 0.0) ** 0.5)
        if self.level > 1.0:
            self.log("the tank overflows", Fmi2Status.error)
        return self.level <= 1.0
"""
UNITS = {
    "voltage": 'unit="V" min="-24" max="24"',
    "speed": 'unit="rad/s" nominal="100"',
    "current": 'unit="A"',
    "inflow": 'unit="m3/s" min="0" max="0.5"',
    "level": 'unit="m" min="0" max="2"',
}


@cache
def folder() -> Path:
    """Return a folder for all FMUs of this process."""
    return Path(mkdtemp(prefix="fmus_"))


@cache
def built(code: str, name: str, options: tuple[tuple[str, bool], ...] = ()) -> Path:
    """Return an FMU with the only class of some code, and units where `UNITS` has them."""
    from pythonfmu.builder import FmuBuilder

    path = packed(FmuBuilder, HEAD + textwrap.dedent(code), name, **dict(options))
    units = {rf'(name="{each}"[^>]*>\s*<Real)': rf"\g<1> {text}" for each, text in UNITS.items()}
    return edited(path, path, units)


def packed(builder, code: str, name: str, **options: bool) -> Path:
    """Return an FMU that a builder makes of some code."""
    place = folder() / name
    place.mkdir()
    source = place / f"{name}_plant.py"
    source.write_text(code)
    made = place / builder.build_FMU(str(source), dest=str(place), **options)
    return made.rename(place / f"{name}.fmu")


def edited(
    fmu: Path, out: Path, changes: dict[str, str], files: dict[str, str] | None = None
) -> Path:
    """Write an FMU with another description: regular expressions and what replaces them.

    Args:
        files: new names of files in it.
    """
    with zipfile.ZipFile(fmu) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    text = content["modelDescription.xml"].decode()
    for old, new in changes.items():
        text = re.sub(old, new, text)
    content["modelDescription.xml"] = text.encode()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in content.items():
            for old, new in (files or {}).items():
                name = name.replace(old, new)
            archive.writestr(name, data)
    return out


def motor(*, state: bool = False) -> Path:
    """Return a motor: voltage in, speed and current out, an inertia; with FMU state or without."""
    if state:
        return built(MOTOR, "motor_state", (("canGetAndSetFMUstate", True),))
    return built(MOTOR, "motor")


def tank() -> Path:
    """Return a tank that fails at a level of 1 m, and names no times."""
    return built(TANK, "tank")


HEATERS = """
import numpy as np
from pythonfmu3 import *
from pythonfmu3.variables import Dimension
I, O = Fmi3Causality.input, Fmi3Causality.output

class Heaters(Fmi3Slave, CoSimulation):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.left, self.right, self.temperature, self.warm = 0.0, 0.0, np.full(2, 20.0), False
        two = [Dimension(start="2")]
        self.register_variable(Float64("left", causality=I))
        self.register_variable(Float64("right", causality=I))
        self.register_variable(Float64("temperature", causality=O, dimensions=two))
        self.register_variable(Boolean("warm", causality=O))

    def do_step(self, time, step):
        flow = np.array([self.left, self.right]) - 0.1 * (self.temperature - 20.0)
        self.temperature = self.temperature + step * flow
        self.warm = bool(self.temperature.min() > 21)
        return True
"""


@cache
def heaters() -> Path:
    """Return an FMU of FMI 3 whose first output is an array, and the other a Boolean."""
    pytest.importorskip("pythonfmu3")
    from pythonfmu3.builder import FmuBuilder

    path = packed(FmuBuilder, HEATERS, "heaters")
    bounds = {r'name="(left|right)"': r'name="\1" unit="kW" min="0" max="5"'}
    return edited(path, path, bounds)
