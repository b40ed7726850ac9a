import itertools

import pytest
from programs import read_csv
from reproduced_runs import make_runs, row

from coil_paper.reproduce.training import Figure22, Table4
from coil_rl.errors import UserError


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The table, its page and folder, for small runs in two worlds."""
    folder = tmp_path_factory.mktemp("table_4")
    runs = {
        "main": make_runs(folder / "main", {"coil": 90.0, "ppo": 20.0}),
        "other": make_runs(folder / "other", {"coil": -10.0, "ppo": 20.0}),
        "single": make_runs(folder / "single", {"alone": 0.0}, seeds=1),
    }
    table = Table4(["main", "single"], {"another world": ["other"]})
    return table, table.make(folder / "t", runs), folder, runs


def test_the_csv_has_the_best_and_the_final_return_of_each_run(made):
    numbers = read_csv(made[2] / "t.csv")
    assert (made[2] / "t.png").exists()
    which = ("coil", "2", "")
    (coil,) = (run for run in numbers if (run["label"], run["seed"], run["world"]) == which)
    columns = ("best", "best_at", "final", "frames", "guide")
    assert [float(coil[key]) for key in columns] == [432, 3000, 412, 4000, 300]
    assert len(numbers) == 6 + 1 + 6


def test_coil_and_ppo_are_next_to_the_paper(made):
    _, page, _, _ = made
    assert row(page, "paper, best") == ["paper, best", "477.6", "414.2", "+15.3%"]
    assert row(page, "ours, best") == ["ours, best", "431.0", "361.0", "+19.4%"]
    assert row(page, "ours, final") == ["ours, final", "411.0", "341.0", "+20.5%"]


def test_methods_are_compared_seed_by_seed(made):
    _, page, _, _ = made
    assert row(page, "coil ")[:2] == ["coil", "3"]
    assert row(page, "coil ")[2] == "431.0 (428.5 to 433.5)"
    assert row(page, "coil ")[-2:] == ["+70.0 (+70.0 to +70.0)", "100%"]
    assert row(page, "ppo ")[-2:] == ["-", "-"]
    assert row(page, "alone ")[2] == "340.0", "one seed has no interval"


def test_the_claim_has_a_verdict_in_each_world(made):
    _, page, _, _ = made
    claim = "COIL's best return is above PPO's"
    paper, ours = row(page, f"{claim} ")[1:]
    assert (paper, ours[:19]) == ("+63.4", "**held up**: +70.0 ")
    assert row(page, f"{claim}, another world")[2].startswith("**did not hold up**: -30.0 (")


def test_runs_without_evaluations_have_no_numbers(tmp_path):
    runs = make_runs(tmp_path / "runs", {"coil": 0.0, "ppo": 0.0}, seeds=2)
    for run in runs:
        for point in run.curve:
            point["evaluation/return"] = float("nan")
    page = Table4(["main"]).make(tmp_path / "t", {"main": runs})
    assert row(page, "coil ")[2:4] == ["-", "-"]
    assert row(page, "COIL's best")[2] == "-"


def test_curves_are_means_of_runs_with_the_guides_return(tmp_path):
    runs = {"main": make_runs(tmp_path / "main", {"coil": 0.0, "ppo": -10.0, "other": 0.0})}
    page = Figure22(["main"]).make(tmp_path / "f", runs)
    points = read_csv(tmp_path / "f.csv")
    rows = {(point["label"], float(point["frames"])): point for point in points}
    assert set(rows) == set(itertools.product(("coil", "ppo"), (2000, 3000, 4000)))
    assert float(rows["coil", 3000]["mean"]) == 341
    assert float(rows["coil", 3000]["low"]) <= 341 <= float(rows["coil", 3000]["high"])
    coil, ppo = row(page, "coil"), row(page, "ppo")
    assert [line[5].split(" (")[0] for line in (coil, ppo)] == ["321.0", "311.0"]
    assert [line[-1].split(" (")[0] for line in (coil, ppo)] == ["2,000", "2,225"]
    assert "The guide alone earns 300.0 in these cases." in page
    assert row(page, "The curve of coil is above")[1] == "**held up**: at 3 of 3 points"
    assert row(page, "coil reaches the level")[1].startswith("**held up**: -225 (")
    assert (tmp_path / "f.png").exists()


def test_mistakes_are_rejected(made):
    with pytest.raises(UserError, match="no run of single has the label ppo; available: alone"):
        Figure22(["single"], ["ppo"]).make(made[2] / "f", made[3])
    with pytest.raises(ValueError, match=r"labels=\[\] must be at least 1 long"):
        Figure22(["main"], labels=[])
