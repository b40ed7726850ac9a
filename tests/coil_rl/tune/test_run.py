"""Sentences of a run that tunes its guide."""

import json
import shlex
from types import SimpleNamespace

import pytest
from programs import composed

from coil_rl import UserError, extras
from coil_rl.record import DELIVERY
from coil_rl.tune import Tuning
from coil_rl.tune.run import TunedRun, beyond_budget


def test_search_beyond_its_budget_is_said_from_a_file_that_may_be_missing(tmp_path):
    assert beyond_budget(tmp_path, 300) == []
    report = {"policy": "own", "cases": 4, "returns": {}, "frames": None, "steps": 1800}
    (tmp_path / DELIVERY.name).write_text(json.dumps(report))
    assert "took 1,800 frames, more than budget.frames=300" in str(beyond_budget(tmp_path, 300))
    assert beyond_budget(tmp_path, 1800) == []


def test_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    config = composed("method=tune", "env=pendulum", "run_dir=unused")
    with pytest.raises(UserError, match=r"method=tune needs cmaes: .* 'coil-rl\[tune\]'"):
        Tuning().check(config)


def tuned_run(folder, words):
    """Return a run whose guide gets its numbers by some words."""
    run = TunedRun.__new__(TunedRun)
    run.folder, run.in_python, run.numbers = folder, False, ()
    run.make_guide = SimpleNamespace(words=lambda values: words)
    return run


@pytest.mark.parametrize("mark", ["", "+", "++"])
def test_next_command_names_each_number_of_the_guide_once(mark, tmp_path, capsys):
    words = ["env=pendulum", f"{mark}guide.swing_up.gain=2", "++guide.swing_up.other=1", "seed=3"]
    run = tuned_run(tmp_path, ["guide.swing_up.gain=3.5", "+guide.swing_up.more=1"])
    run.command = ["coil-train", "method=tune", "tune={gain: [1, 4]}", *words]
    run._say_next()
    kept = ["env=pendulum", "++guide.swing_up.other=1", "seed=3"]
    tuned = [f"{mark}guide.swing_up.gain=3.5", "+guide.swing_up.more=1"]
    expected = ["Next:", "coil-train", *kept, *tuned, "method=coil_anchored"]
    assert shlex.split(capsys.readouterr().out) == expected


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("+guide.controller.options.gain=3.5", "guide=functools.partial(GUIDE, gain=3.5)"),
        ("guide.pid.kp=3.5", "guide=GUIDE, overrides=['guide.pid.kp=3.5']"),
    ],
)
def test_next_step_in_python_gives_numbers_to_the_guide(word, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("coil_rl.tune.run.read_tuned", lambda folder, numbers: {"gain": 3.5})
    run = tuned_run(tmp_path, [word])
    run.in_python = True
    run._say_next()
    assert capsys.readouterr().out == f"Next: coil_rl.train(ENV, {said})\n"
