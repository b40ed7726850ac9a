"""Sentences of a run that tunes its guide."""

import shlex
from types import SimpleNamespace

import pytest
from programs import composed

from coil_rl import UserError, extras
from coil_rl.tune import Tuning
from coil_rl.tune.run import SENTENCES, TunedRun


def test_numbers_of_the_guide_are_said_beside_its_own():
    values, own = {"kp": 2.51189, "ki": 0.0001}, {"kp": 1.0, "ki": 0.5}
    assert SENTENCES.said("numbers", values=values, own=own, file="tuned.json") == [
        "The guide's numbers: kp 2.512 (its own 1), ki 0.0001 (its own 0.5); all digits are in "
        "tuned.json."
    ]
    assert SENTENCES.said("numbers", values=None, own=own, file="tuned.json") == []


def test_search_beyond_its_budget_is_said():
    (said,) = SENTENCES.said("beyond_budget", steps=1800, frames=300)
    assert said == (
        "The search took 1,800 frames, more than budget.frames=300: that is too little for a "
        "generation and a test of its result."
    )
    assert SENTENCES.said("beyond_budget", steps=1800, frames=1800) == []


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
