import csv

import pytest
from PIL import Image

from coil_rl.reproduce import Figure6


def test_figure_6_has_both_values_after_each_iteration(tmp_path):
    page = Figure6(iterations=100).make(tmp_path / "f")
    with (tmp_path / "f.csv").open(newline="") as file:
        rows = [[float(value) for value in row.values()] for row in csv.DictReader(file)]
    assert [row[0] for row in rows] == list(range(101))
    assert rows[0][1:3] == [0, 0]
    assert rows[1][1:3] == pytest.approx([6, -3])  # the best immediate reward
    assert rows[100][1:3] == pytest.approx([7640 / 181, 5840 / 181], rel=0.01)
    assert "After 80 iterations V is 41.58 of 42.21, 31.64 of 32.27." in page
    assert "|                  2.0% |         80 | about 80 |" in page
    with Image.open(tmp_path / "f.png") as image:
        assert image.size == (1600, 840)


def test_no_iterations_are_refused():
    with pytest.raises(ValueError, match="iterations=0 must be at least 1"):
        Figure6(0)
