import csv

import pytest
from PIL import Image
from reproduced_runs import make_runs

from coil_rl.errors import UserError
from coil_rl.reproduce import Figure22


def test_curves_are_means_of_the_runs_beside_the_guides_own_return(tmp_path):
    runs = {"main": make_runs(tmp_path / "main", {"coil": 0.0, "ppo": -10.0, "other": 0.0})}
    page = Figure22(["main"]).make(tmp_path / "f", runs)
    with (tmp_path / "f.csv").open(newline="") as file:
        rows = {(row["label"], float(row["frames"])): row for row in csv.DictReader(file)}
    assert set(rows) == {(label, frames) for label in ("coil", "ppo") for frames in (2000, 3000, 4000)}
    assert float(rows["coil", 3000]["mean"]) == 341
    assert float(rows["coil", 3000]["low"]) <= 341 <= float(rows["coil", 3000]["high"])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if "|" in line]
    assert [line[0] for line in lines[2:]] == ["coil", "ppo"]
    assert [line[4].split(" (")[0] for line in lines[2:]] == ["321.0", "311.0"]
    assert [line[-1] for line in lines[2:]] == ["2,000", "3,000"], "291 is below the guide, 331 is not"
    assert "The guide alone earns 300.0 there." in page
    with Image.open(tmp_path / "f.png") as image:
        assert image.size == (1600, 840)


def test_a_label_without_runs_is_named_with_those_that_have_some(tmp_path):
    runs = {"main": make_runs(tmp_path / "main", {"coil": 0.0}, seeds=1)}
    with pytest.raises(UserError, match="no run of main is called ppo; there are coil"):
        Figure22(["main"]).make(tmp_path / "f", runs)


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="labels=\\[\\] draws nothing"):
        Figure22(["main"], labels=[])
