"""A run as a notebook shows it, and the table that it returns."""

import math
from types import SimpleNamespace

import pytest
from run_folders import driven, make_run

from coil_rl.measures import measures_of
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.judge import Evaluation, Judgement, Trial
from coil_rl.run.reasons import page_of
from coil_rl.run.run import Run

pytest.importorskip("pandas")


def test_notebook_shows_all_measures_with_a_heading_and_of_how_many_episodes(tmp_path):
    measures = {"energy": {"entry": "reward"}, "lap": {"entry": "reward", "title": "lap (s)"}}
    measures["hidden"] = {"entry": "reward", "title": ""}
    numbers = {"energy": 1.25, "lap": 2.5, "hidden": 3.75, "episodes": 9, "lap_episodes": 4}
    folder = make_run(tmp_path / "run", "coil", 0, driven("coil", {"a": 1.0}, **numbers))
    about = {"folder": folder, "settings": {"evaluation": {"measures": measures}}, "seed": 0}
    page = page_of(SimpleNamespace(**about, label="coil", has_agent=False))
    headings = [text.partition("</th>")[0] for text in page.split("<th>")[1:]]
    assert headings == [*("driver", "advice", "actions", "reward"), *HEADINGS]
    assert "1.25" in page
    assert "3.75" not in page


HEADINGS = ("energy", "lap (s)", "episodes", "lap_episodes")


def test_table_of_a_run_says_of_how_many_episodes_a_mean_is():
    judgement = Judgement(measures_of({"lap": {"entry": "reward"}}))
    laps = enumerate((50.0, math.nan))
    judgement.add(
        EvaluationResult([{"case": str(n), "reward": 1.0, "lap": lap} for n, lap in laps]), "coil"
    )
    trial = Trial("coil", Evaluation(["0", "1"], {}, {}), make_env=None)
    run = SimpleNamespace(trial=trial, seed=0, judge=lambda trial, folder, seed: judgement)
    mean = Run.evaluate(run).iloc[-1]
    assert (mean["lap"], mean["episodes"], mean["lap_episodes"]) == (50.0, 2, 1)
