import math

import numpy as np
import pytest
import torch
from programs import read_csv

from coil_rl.report.table import AUTO_FORMAT, markdown_table, write_csv

ROWS = [
    {"driver": "guide", "lap": 31.256, "crashes": 0.0, "done": True, "laps": 2},
    {"driver": "agent (COIL)", "lap": math.nan, "crashes": 0.125, "done": False},
]
COLUMNS = {
    "driver": ("driver", ""),
    "lap": ("lap (s)", ".2f"),
    "crashes": ("crashed", ".1%"),
    "done": ("done", ""),
    "laps": ("laps", "d"),
}


def test_columns_choose_order_and_align_the_cells():
    assert markdown_table(ROWS, COLUMNS).splitlines() == [
        "| driver       | lap (s) | crashed | done | laps |",
        "|:-------------|--------:|--------:|:-----|-----:|",
        "| guide        |   31.26 |    0.0% | yes  |    2 |",
        "| agent (COIL) |       - |   12.5% | no   |    - |",
    ]
    others = {"laps": ("laps", "d"), "done": ("", "")}
    assert markdown_table(ROWS, others).splitlines()[2] == "|    2 | yes |"
    assert "lap (s)" in markdown_table([], {"lap": ("lap (s)", ".2f")})


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([-81.73, 0.44], ["-81.7", "0.4"]),
        ([9.996, 9.957], ["10.0", "10.0"]),
        ([1.0, 0.9745], ["1.00", "0.97"]),
        ([0.0123, 0.0, math.nan], ["0.0123", "0.0000", "-"]),
        ([-8.173e-5, 2e-6], ["-8.17e-05", "2.00e-06"]),
        ([-3.25e8, 21.5], ["-325,000,000", "22"]),
        ([-99_999.5], ["-99999.5"]),
        ([0.0], ["0.0"]),
    ],
)
def test_returns_have_enough_digits_in_any_unit(returns, expected):
    rows = [{"return": each} for each in returns]
    lines = markdown_table(rows, {"return": ("return", AUTO_FORMAT)}).splitlines()[2:]
    assert [line.strip("| ") for line in lines] == expected


def test_mean_over_fewer_episodes_says_so():
    rows = [{"lap": lap, "speed": 2.0} for lap in (5.0, 7.25, math.nan, math.nan)]
    counts = [{"episodes": 4, "lap": known, "speed": 4} for known in (4, 3, 2, 0)]
    columns = {"lap": ("lap", AUTO_FORMAT), "speed": ("speed", ".1f"), "of": ("of", "")}
    lines = markdown_table([row | {"of": ""} for row in rows], columns, counts).splitlines()[2:]
    assert [[cell.strip() for cell in line.split("|")[1:3]] for line in lines] == [
        ["5.00", "2.0"],
        ["7.25 (3 of 4)", "2.0"],
        ["- (2 of 4)", "2.0"],
        ["-", "2.0"],
    ]


def test_text_cannot_break_the_table():
    rows = [{"lap": "31.2 ± 0.4"}, {"lap": "a|b\nc"}, {"lap": "1_000"}]
    heading, _, *lines = markdown_table(rows, {"lap": ("|a - g|", ".1f")}).splitlines()
    assert heading == "| \\|a - g\\|  |"
    assert lines == ["| 31.2 ± 0.4 |", "| a\\|b c     |", "| 1_000      |"]


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.array, torch.tensor])
def test_scalars_of_numpy_and_torch_are_numbers(kind):
    row = {"x": kind(1.5), "y": np.True_, "z": torch.tensor(math.nan)}
    table = markdown_table([row], {name: (name, "") for name in row})
    assert table.splitlines()[1:] == ["|----:|:----|--:|", "| 1.5 | yes | - |"]


def test_unknown_column_and_wrong_format_are_errors():
    with pytest.raises(ValueError, match=r"No row has 'lap_tme' .* driver, lap, crashes, done"):
        markdown_table(ROWS, {"lap_tme": ("lap (s)", ".2f")})
    with pytest.raises(ValueError, match="format code 'd'"):
        markdown_table(ROWS, {"lap": ("lap (s)", "d")})


def test_csv_has_full_precision(tmp_path):
    rows = [{"a": 1 / 3, "b": None}, {"a": torch.tensor(2.0), "c": "x,y"}]
    rows.append({"a": math.nan, "b": True})
    write_csv(rows, tmp_path / "table.csv")
    read = read_csv(tmp_path / "table.csv")
    assert list(read[0]) == ["a", "b", "c"]
    assert float(read[0]["a"]) == 1 / 3
    assert [row["b"] for row in read] == ["", "", "True"]
    assert read[1] == {"a": "2.0", "b": "", "c": "x,y"}
    assert read[2]["a"] == "nan"
    write_csv([], tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == ""
