# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From an FMU to a verdict in ten minutes
#
# A motor of uncertain inertia is an FMU, its controller a PI. We tune it and let a policy learn on
# top. Trainings are short here; longer ones, and the command line: [the page](../fmu.md).

# %%
import runpy
import tempfile
from pathlib import Path

import fmpy
import matplotlib
import numpy as np
import pandas as pd
from IPython.display import Image
from pythonfmu.builder import FmuBuilder

import coil_rl

matplotlib.use("Agg")  # whatever MPLBACKEND names
folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The plant

# %%
MOTOR = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class motor(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.voltage, self.inertia, self.speed, self.current = 0.0, 0.01, 0.0, 0.0
        self.register_variable(Real("voltage", causality=Fmi2Causality.input))
        fixed = Fmi2Variability.fixed
        self.register_variable(
            Real("inertia", causality=Fmi2Causality.parameter, variability=fixed)
        )
        self.register_variable(Real("speed", causality=Fmi2Causality.output))
        self.register_variable(Real("current", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        for _ in range(10):
            dt = step / 10
            self.current += dt * (self.voltage - 0.05 * self.speed - self.current) / 0.02
            self.speed += dt * (0.05 * self.current - 0.001 * self.speed) / self.inertia
        return True
"""
source = folder / "motor.py"
source.write_text(MOTOR)
file = folder / FmuBuilder.build_FMU(str(source), dest=str(folder))

# %% [markdown]
# ## The task
#
# The speed follows a setpoint that jumps each half second. Each episode draws an inertia. The
# reward is minus the error.

# %%
PLANT = [
    f"env.file={file}",
    "env.step=0.05",
    "env.seconds=2",
    "env.bounds={voltage: [-24, 24]}",
    "env.setpoints={speed: {low: 50, high: 150, every: 0.5}}",
    "env.parameters={inertia: {low: 0.005, high: 0.02}}",
    "evaluation.cases=100",
]
PI = ["guide.pid.measured=speed", "guide.pid.setpoint=speed_setpoint"]

# %% [markdown]
# ## The PI with better numbers

# %%
tuned = coil_rl.train(
    "fmu",
    guide="pid",
    method="tune",
    tune="auto",
    frames=4_000,
    folder=folder / "tuned",
    overrides=[*PLANT, *PI, "guide.pid.kp=0.2", "guide.pid.ki=0.1"],
)

# %% [markdown]
# ## A policy on top
#
# It begins as the tuned PI, which is handed over if nothing better was found.

# %%
policy = coil_rl.train(
    "fmu",
    guide="learned",
    frames=2_000,
    folder=folder / "policy",
    overrides=[*PLANT, f"guide.learned.run={folder / 'tuned'}", "trust=[coil_fmu]"],
)

# %% [markdown]
# ## The verdict
#
# All drive the same 100 drawn plants, which were in no training.

# %%
first, second = (pd.read_csv(run.folder / "evaluation.csv") for run in (tuned, policy))
returns = {
    "the PI": first[first.driver == "guide"],
    "tuned": first[first.driver == "tune"],
    "policy on top": second[(second.driver != "guide") & (second.actions == "deterministic")],
}
for name, rows in returns.items():
    cases = rows[rows.case != "mean"]
    values = cases.reward.astype(float)
    worst = cases.loc[values.idxmin()]
    print(f"{name}: mean {values.mean():.0f}; worst {values.min():.0f}, case {worst.case}")

# %%
Image(folder / "policy" / "returns.png", width=500)

# %% [markdown]
# ## The file for the machine
#
# The PI is inside. `drive.py` beside it needs NumPy and onnxruntime, and nothing of this package.

# %%
exported = coil_rl.export_policy(policy, folder / "exported")
driver = runpy.run_path(str(exported.file.parent / "drive.py"))["Policy"]()
description = fmpy.read_model_description(file)
number = {each.name: each.valueReference for each in description.modelVariables}
motor = fmpy.instantiate_fmu(fmpy.extract(file), description, "CoSimulation")
motor.setupExperiment(startTime=0.0)
motor.setReal([number["inertia"]], [0.015])
motor.enterInitializationMode()
motor.exitInitializationMode()
total = 0.0
for step in range(40):
    speed, current = motor.getReal([number["speed"], number["current"]])
    seen = {"speed": [speed], "current": [current], "speed_setpoint": [100.0]}
    voltage = driver.act({name: np.float32(value) for name, value in seen.items()})
    motor.setReal([number["voltage"]], [float(voltage[0])])
    motor.doStep(0.05 * step, 0.05)
    total -= abs(motor.getReal([number["speed"]])[0] - 100.0)
motor.freeInstance()
print(f"onnxruntime alone, inertia 0.015, setpoint 100: return {total:.1f}")
