"""The motor and the reward of docs/fmu.md are what the page says."""

import re

import fmus
import torch
from programs import ROOT

from coil_fmu import fmu_env

PAGE = (ROOT / "docs" / "fmu.md").read_text(encoding="utf-8")
MOTOR, REWARD = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)


def test_motor_and_reward_of_the_page_are_an_env():
    scope = {}
    exec(REWARD, scope)
    env = fmu_env(
        fmus.built(MOTOR, "page"),
        step=0.05,
        seconds=2.0,
        bounds={"voltage": [-24, 24]},
        setpoints={"speed": {"low": 50, "high": 150, "every": 0.5}},
        parameters={"inertia": {"low": 0.005, "high": 0.02}},
        reward=scope["cheap"],
    )
    present = env.reset().set("action", torch.full((1, 1), 10.0))
    after = env.step(present)["next"]
    error = abs(present["speed_setpoint"] - after["speed"]).item()
    assert after["reward"].item() == torch.tensor(-error - 1.0).item()
    assert not after["terminated"].item()
