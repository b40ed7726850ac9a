import csv

import pytest
from PIL import Image
from reproduced_runs import make_runs

from coil_rl.reproduce import Table4


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, the numbers and the place of a small one."""
    folder = tmp_path_factory.mktemp("table_4")
    runs = {
        "main": make_runs(folder / "main", {"coil": 90.0, "ppo": 20.0}),
        "other": make_runs(folder / "other", {"coil": -10.0, "ppo": 20.0}),
        "lost": make_runs(folder / "lost", {"alone": 0.0}, seeds=1),
    }
    table = Table4(["main", "lost"], {"another world": "other"}, resamples=200)
    page = table.make(folder / "t", runs)
    with (folder / "t.csv").open(newline="") as file:
        return table, page, list(csv.DictReader(file)), folder


def cells(page, begins):
    line = next(line for line in page.splitlines() if line.startswith(f"| {begins}"))
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_the_best_and_the_final_return_of_each_run_are_told_apart(made):
    _, _, numbers, _ = made
    row = next(row for row in numbers if (row["label"], row["seed"], row["world"]) == ("coil", "2", ""))
    assert [float(row[key]) for key in ("best", "best_at", "final", "frames", "guide")] == [432, 3000, 412, 4000, 300]
    assert len(numbers) == 6 + 1 + 6


def test_coil_and_ppo_stand_beside_the_paper(made):
    _, page, _, _ = made
    assert cells(page, "paper, best") == ["paper, best", "477.6", "414.2", "+15.3%"]
    assert cells(page, "ours, best") == ["ours, best", "431.0", "361.0", "+19.4%"]
    assert cells(page, "ours, final") == ["ours, final", "411.0", "341.0", "+20.5%"]


def test_methods_are_compared_seed_by_seed(made):
    _, page, _, _ = made
    assert cells(page, "coil ")[:2] == ["coil", "3"]
    assert cells(page, "coil ")[2].startswith("431.0 (430.0 to 43")
    assert cells(page, "coil ")[-2:] == ["+70.0 (+70.0 to +70.0)", "100%"]
    assert cells(page, "ppo ")[-2:] == ["-", "-"]
    assert cells(page, "alone ")[2] == "340.0", "one seed has no interval"


def test_what_the_paper_says_is_judged_in_each_world(made):
    _, page, _, _ = made
    claim = "COIL's best return in training is above PPO's"
    assert cells(page, f"{claim} ")[1:] == ["+63.4", "**held up**: +70.0 (+70.0 to +70.0)"]
    assert cells(page, f"{claim}, another world")[2] == "**did not hold up**: -30.0 (-30.0 to -30.0)"


def test_it_is_the_same_each_time_and_has_a_picture(made, tmp_path):
    table, page, _, folder = made
    runs = {"main": make_runs(tmp_path / "main", {"coil": 90.0, "ppo": 20.0})}
    runs |= {"other": make_runs(tmp_path / "other", {"coil": -10.0, "ppo": 20.0})}
    runs |= {"lost": make_runs(tmp_path / "lost", {"alone": 0.0}, seeds=1)}
    assert table.make(tmp_path / "t", runs) == page
    assert (tmp_path / "t.csv").read_text() == (folder / "t.csv").read_text()
    with Image.open(folder / "t.png") as image:
        assert image.width == 1600


def test_runs_in_which_no_episode_ended_have_no_numbers(tmp_path):
    runs = make_runs(tmp_path / "runs", {"coil": 0.0, "ppo": 0.0}, seeds=2)
    for run in runs:
        for row in run.curve:
            row["train/return"] = float("nan")
    page = Table4(["main"]).make(tmp_path / "t", {"main": runs})
    assert cells(page, "coil ")[2:5] == ["-", "-", "-"]
    assert cells(page, "COIL's best")[2] == "-"


def test_no_resamples_are_refused():
    with pytest.raises(ValueError, match="resamples=0 must be at least 1"):
        Table4(["main"], resamples=0)
