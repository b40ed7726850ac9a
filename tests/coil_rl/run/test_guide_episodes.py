"""The guides in the table of a run drive once, whatever happens to the run."""

import json

import numpy as np
import pytest
from programs import TINY, called

from coil_rl.config import parts
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.guide_episodes import GUIDE_EPISODES, driven_once

SETTINGS = {"env": {"id": "Tank"}, "guide": {"pi": {"gain": 0.3}}, "budget": {"frames": 100}}
TABLES = ("evaluation.csv", "evaluation.md", "episodes.csv")


def episodes(reward=0.1):
    rows = [
        {"case": "a", "reward": reward, "steps": 2, "completed": True, "lap_time": float("nan")},
        {"case": "b", "reward": -1e-17, "steps": 1, "completed": False, "lap_time": 1 / 3},
    ]
    histories = {"pose": [np.array([[0.1, 2], [0.3, 4]]), np.array([[5.0, np.inf]])]}
    return {"guide": EvaluationResult(rows, histories, 12.0)}


class Driven:
    """Drives guides, and counts how often."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        return episodes()


def test_episodes_come_back_with_every_digit(tmp_path):
    drive = Driven()
    first, again = (driven_once(tmp_path, SETTINGS, "cases", drive)["guide"] for _ in range(2))
    assert drive.times == 1
    assert repr(again.episodes) == repr(first.episodes)
    assert again.rate == first.rate
    for found, expected in zip(again.histories["pose"], first.histories["pose"], strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("changed", "times"),
    [
        ({"guide": {"pi": {"gain": 0.4}}}, 2),
        ({"env": {"id": "Room"}}, 2),
        ({"budget": {"frames": 200}}, 1),
    ],
)
def test_guides_drive_again_after_a_change_of_guide_or_env(tmp_path, changed, times):
    drive = Driven()
    driven_once(tmp_path, SETTINGS, "cases", drive)
    driven_once(tmp_path, SETTINGS | changed, "cases", drive)
    assert drive.times == times
    driven_once(tmp_path, SETTINGS | changed, "other cases", drive)
    assert drive.times == times + 1


@pytest.mark.parametrize("text", ["", "{", "[]", '{"key": 3}', '{"guides": {}}', "[" * 100_000])
def test_damaged_file_is_written_anew(tmp_path, text):
    drive = Driven()
    driven_once(tmp_path, SETTINGS, "cases", drive)
    whole = (tmp_path / GUIDE_EPISODES.name).read_text()
    (tmp_path / GUIDE_EPISODES.name).write_text(text)
    assert driven_once(tmp_path, SETTINGS, "cases", drive)["guide"].rate == 12
    assert (tmp_path / GUIDE_EPISODES.name).read_text() == whole


@pytest.mark.parametrize("part", ["episodes", "histories", "rate"])
def test_file_without_a_part_is_written_anew(tmp_path, part):
    drive = Driven()
    driven_once(tmp_path, SETTINGS, "cases", drive)
    saved = json.loads((tmp_path / GUIDE_EPISODES.name).read_text())
    del saved["guides"]["guide"][part]
    (tmp_path / GUIDE_EPISODES.name).write_text(json.dumps(saved))
    driven_once(tmp_path, SETTINGS, "cases", drive)
    assert drive.times == 2


def test_run_that_writes_its_table_again_does_not_drive_its_guide(tmp_path, monkeypatch):
    run = tmp_path / "run"
    called("train", *TINY, "method=ppo", "evaluation.gif=false", f"hydra.run.dir={run}")
    written = {name: (run / name).read_bytes() for name in TABLES}
    for name in TABLES:
        (run / name).unlink()

    def driven_again(*_):
        raise AssertionError("the guide was driven again")

    monkeypatch.setattr(parts, "_guide_results", driven_again)
    called("train", f"resume={run}")
    assert {name: (run / name).read_bytes() for name in TABLES} == written
