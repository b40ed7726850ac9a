import csv

import numpy as np
import pytest
from PIL import Image
from programs import LAP
from run_folders import make_untrained_run

from coil_rl.envs import shipped_tracks
from coil_rl.errors import UserError
from coil_rl.report.runs import Run
from coil_rl.report.straightened import Straightened
from coil_rl.reproduce import FigureLines
from coil_rl.reproduce.figure_lines_picture import last_lap
from coil_rl.train import load
from coil_rl.train.build import build_env
from coil_rl.train.evaluation import evaluate_policy


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Agents that have learned nothing, and so leave the ring soon; the guide drives a lap."""
    folder = tmp_path_factory.mktemp("runs")
    made = {label: make_untrained_run(folder / label, f"method={label}", "seed=3", *LAP) for label in ("ppo", "coil")}
    return {"mine": [Run(path, label, 3, None) for label, path in made.items()]}


@pytest.fixture(scope="module")
def made(runs, tmp_path_factory):
    stem = tmp_path_factory.mktemp("made") / "figure_lines"
    page = FigureLines(["mine"], labels=["ppo", "coil"], seed=3).make(stem, runs)
    with stem.with_suffix(".csv").open(newline="") as file:
        return page, list(csv.DictReader(file)), stem


def test_each_driver_drives_as_its_own_run_does(made, runs):
    _, rows, _ = made
    assert [(row["driver"], row["crashed"]) for row in rows] == [("guide", "False"), ("ppo", "True"), ("coil", "True")]
    run = runs["mine"][1].folder
    config = load.read_config(run, "run")
    env = build_env(config, {**config.evaluation.env, "num_cars": 1})
    (alone,) = evaluate_policy(env, load.load_policy(run, config, env)).episodes
    assert {key: float(rows[2][key]) for key in ("reward", "smoothness")} == pytest.approx(
        {key: alone[key] for key in ("reward", "smoothness")}
    )


def test_the_way_is_that_of_the_lap_time(made):
    _, rows, _ = made
    # At 2 m/s; the ring is 31 m long, and at 6 steps a second a lap is known to a third of a metre.
    assert float(rows[0]["way"]) == pytest.approx(float(rows[0]["lap_time"]) * 2 / (2 * np.pi * 5), abs=0.02)
    assert 0 < float(rows[0]["off_centre"]) < 0.3


def test_the_page_has_all_numbers_and_a_picture(made):
    page, rows, stem = made
    assert page.startswith("## Driven lines on unseen tracks\n")
    assert page.count("| ring ") == len(rows) == 3
    assert Image.open(stem.with_suffix(".png")).width == 1600


def test_the_last_lap_is_cut_where_it_leaves_the_picture():
    straight = Straightened(shipped_tracks("test")[0])
    twice = np.vstack([straight.line[-40:], straight.line, straight.line[:200]])
    along, aside, _ = last_lap(straight, twice, np.zeros(len(twice)))
    assert np.isnan(along).sum() == 1
    assert np.nanmax(along) - np.nanmin(along) > straight.length - 0.1
    assert len(along) == pytest.approx(len(straight.line) + 1, abs=1)
    assert (np.diff(along[: np.flatnonzero(np.isnan(along))[0]]) > 0).all()
    assert np.nanmax(np.abs(aside)) < 1e-9


def test_a_seed_that_is_not_there_is_refused(runs, tmp_path):
    with pytest.raises(UserError, match="coil has no run with seed=0; it has 3"):
        FigureLines(["mine"], labels=["coil"]).make(tmp_path / "figure_lines", runs)


@pytest.mark.parametrize("wrong", [{"labels": []}, {"tracks": 0}, {"policy": "first"}])
def test_choices_that_draw_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FigureLines(["mine"], **wrong)
