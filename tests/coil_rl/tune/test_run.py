"""Sentences of a run that tunes its guide."""

import json

import pytest
from hydra import compose, initialize_config_module

from coil_rl import UserError, extras
from coil_rl.record import DELIVERY
from coil_rl.tune import Tuning
from coil_rl.tune.run import beyond_budget


def test_search_beyond_its_budget_is_said_from_a_file_that_may_be_missing(tmp_path):
    assert beyond_budget(tmp_path, 300) == []
    report = {"policy": "own", "cases": 4, "returns": {}, "frames": None, "steps": 1800}
    (tmp_path / DELIVERY.name).write_text(json.dumps(report))
    assert "took 1,800 frames, more than budget.frames=300" in str(beyond_budget(tmp_path, 300))
    assert beyond_budget(tmp_path, 1800) == []


def test_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("train", ["method=tune", "env=pendulum", "run_dir=unused"])
    with pytest.raises(UserError, match=r"method=tune needs cmaes: .* 'coil-rl\[tune\]'"):
        Tuning().check(config)
