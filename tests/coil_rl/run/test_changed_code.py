"""A run folder knows the files of a user that its env and its guide are defined in."""

import importlib
import re
import sys

import pytest
from programs import called

import coil_rl
from coil_rl.record import GUIDE_RETURNS
from coil_rl.run.folder import CODE, CODE_BEFORE, code_of

PLANT = """
from odd_parts import Plain
from rewards_of_mine import cost

class Tank(Plain):
    def step(self, action):
        seen, _, *ends = super().step(action)
        return seen, -cost(seen[0]), *ends
"""
TINY = ["learner=ppo", "learner.minibatches=1", "budget.num_envs=2", "budget.steps=8"]
TINY += ["evaluation.cases=2", "evaluation.curve.points=1", "evaluation.curve.num_envs=2"]
TINY += ["evaluation.gif=false", "logger=none", "env.workers=0"]


@pytest.fixture
def place(tmp_path, monkeypatch):
    (tmp_path / "tank_of_mine.py").write_text(PLANT)
    (tmp_path / "rewards_of_mine.py").write_text("def cost(level):\n    return abs(level)\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield tmp_path
    for name in ("tank_of_mine", "rewards_of_mine"):
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_change_of_a_file_is_said_and_refused_where_the_run_would_go_on(place):
    folder = place / "run"
    run = coil_rl.train("tank_of_mine:Tank", frames=32, folder=folder, overrides=TINY)
    begun = code_of(folder)[CODE]
    assert set(begun) == {"tank_of_mine", "rewards_of_mine", "odd_parts"}
    assert coil_rl.open_run(folder, trust=["tank_of_mine"]).train(frames=48).budget.frames == 48
    run.evaluate(cases=1)
    (place / "rewards_of_mine.py").write_text("def cost(level):\n    return level**2\n")
    with pytest.warns(UserWarning, match="was trained with another file of rewards_of_mine: what"):
        run.evaluate(cases=1)
    GUIDE_RETURNS.write(folder, {"guide": -9.0})
    again = coil_rl.open_run(folder, trust=["tank_of_mine"])
    with pytest.warns(UserWarning, match="another file of rewards_of_mine"):
        again.controller()
    words = [f"resume={folder}", "trust=[tank_of_mine]", "budget.frames=64"]
    refused = called("train", *words, code=2).stderr
    assert re.search("another file of rewards_of_mine.* changed=accept", refused)
    assert code_of(folder)[CODE] == begun
    assert GUIDE_RETURNS.read(folder) == {"guide": -9.0}
    said = called("train", *words, "changed=accept").stderr
    assert "goes on with another file of rewards_of_mine" in said
    now = code_of(folder)
    assert now[CODE_BEFORE] == begun
    assert GUIDE_RETURNS.read(folder) == {}  # measured anew, without a guide
    assert now[CODE]["rewards_of_mine"] != begun["rewards_of_mine"]
