"""Sentences on a run: what an anchored policy holds, what is handed over, what to type next."""

import json
import math
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from coil_rl.config.trust import to_trust, trust_packages
from coil_rl.learners.anchor import StartTest
from coil_rl.record import DELIVERY
from coil_rl.run.reasons import handed_over, next_step, start_test, still_rising


def row(*numbers):
    return dict(zip(StartTest.names, numbers, strict=True))


@pytest.mark.parametrize(
    ("numbers", "parts"),
    [
        ((-20, math.nan, -90, 4, 1), ["guide -20.0, the new policy -90.0", "The guide is held,"]),
        ((-90, -20, -80, 2, -1), ["opposite -20.0", "The opposite of the guide is held,"]),
        ((-20, math.nan, -90, 4, 0.5), ["held at 0.5 of its distance from the middle"]),
        ((-50, -95, -90, 4, 0), ["None is held", "with more frames the test has more cases"]),
        ((-95, -96, -90, 4, 0), ["None is better than the new policy"]),
    ],
)
def test_start_test_says_what_is_held_and_why(numbers, parts):
    (sentence,) = start_test(row(*numbers))
    assert sentence.startswith(f"Start test, mean returns in {numbers[3]} new cases: ")
    assert "nan" not in sentence
    for part in parts:
        assert part in sentence


def test_run_without_tests_has_no_sentences(tmp_path):
    assert start_test({"frames": 0.0}) == []
    assert start_test(row(*[math.nan] * 5)) == []
    assert handed_over(tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({}, "Handed over is the last policy: mean returns in 6 new cases"),
        ({"policy": "earlier", "frames": 4096}, "Handed over is the policy after 4,096 frames"),
        ({"policy": "spline"}, "Handed over is the spline itself, and nothing that was learned"),
        ({"policy": "spline", "ahead": [4.0, -1.0, 9.0]}, "it is +4.00 ahead of the last policy"),
        ({"policy": "spline"}, "With policy=last the last policy is evaluated."),
    ],
)
def test_handing_over_is_said_with_its_reason(changes, part, tmp_path):
    returns = {"last": 1.0, "spline": 5.0}
    report = {"policy": "last", "cases": 6, "returns": returns, "frames": None} | changes
    (tmp_path / DELIVERY.name).write_text(json.dumps(report))
    (sentence,) = handed_over(tmp_path)
    assert part in sentence


def curve_of(*returns):
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
    assert still_rising(curve_of(*returns)) is rising


def test_next_command_is_quoted_and_doubles_the_frames():
    line = next_step(Path("my runs/one"), 1000, curve_of(0, 1, 2, 3))
    assert line == "Still rising at the end: coil-train 'resume=my runs/one' budget.frames=2000"
    line = next_step(Path("runs/one"), 1000)
    assert "coil-evaluate run=runs/one | coil-report folder=runs/one |" in line


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
        trust_packages(["other"])
        line = next_step(Path("runs/one"), 1000, trust=to_trust(command))
    finally:
        trust_packages([])
    words = shlex.split(line.split(" | ")[0].removeprefix("Next: "))
    assert words == ["coil-evaluate", "run=runs/one", "trust=[my_plant,one,other]"]
