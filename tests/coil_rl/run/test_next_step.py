import math
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from coil_rl.config.trust import trust_packages
from coil_rl.run.next_step import next_step, still_rising


def rows(*returns):
    return [{"frames": 10 * n, "evaluation/return": value} for n, value in enumerate(returns)]


@pytest.mark.parametrize(
    ("returns", "rising"),
    [
        ((0, 1, 2, 3, 4, 5, 6, 7), True),
        ((0, 5, 7, 8, 8, 8, 8, 8.1), False),
        ((0, 8, 3, 8, 2, 8, 1, 8), False),
        ((0, math.nan, 1, 2, 3, 4, 5, math.nan), True),
        ((1, 2, 3), False),
        ((), False),
    ],
)
def test_curve_is_rising_if_its_last_quarter_is_above_the_rest(returns, rising):
    assert still_rising(rows(*returns)) is rising


def test_next_command_is_quoted_and_doubles_the_frames():
    line = next_step(Path("my runs/one"), 1000, rows(0, 1, 2, 3))
    assert line == "Still rising at the end: coil-train 'resume=my runs/one' budget.frames=2000"
    line = next_step(Path("runs/one"), 1000)
    assert "coil-evaluate run=runs/one | coil-report folder=runs |" in line


def test_next_command_trusts_what_the_command_of_the_run_named():
    command = OmegaConf.create(
        {
            "guide": {"of": "my_plant:PI"},
            "env": {"_target_": "one.Env"},
            "learner": {"_target_": "coil_rl.learners.PPO"},
            "logger": {"_target_": "torchrl.record.loggers.csv.CSVLogger"},  # taken by its name
        }
    )
    try:
        trust_packages(["other"], command)
        line = next_step(Path("runs/one"), 1000)
    finally:
        trust_packages([])
    words = shlex.split(line.split(" | ")[0].removeprefix("Next: "))
    assert words == ["coil-evaluate", "run=runs/one", "trust=[my_plant,one,other]"]
