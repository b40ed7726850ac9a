import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from coil_rl.report.table import markdown_table, write_csv

Row = dict[str, object]

ROWS: list[Row] = [
    {"driver": "guide", "lap": 31.256, "crashes": 0.0, "done": True, "laps": 2},
    {"driver": "agent (COIL)", "lap": math.nan, "crashes": 0.125, "done": False, "laps": None},
]
COLUMNS = {
    "driver": ("driver", ""),
    "lap": ("lap (s)", ".2f"),
    "crashes": ("crashed", ".1%"),
    "done": ("done", ""),
    "laps": ("laps", "d"),
}


def test_a_table_lines_up_with_numbers_to_the_right() -> None:
    assert markdown_table(ROWS, COLUMNS).splitlines() == [
        "| driver       | lap (s) | crashed | done | laps |",
        "| :----------- | ------: | ------: | :--- | ---: |",
        "| guide        |   31.26 |    0.0% | yes  |    2 |",
        "| agent (COIL) |       - |   12.5% | no   |    - |",
    ]


def test_the_columns_choose_and_order_what_is_shown() -> None:
    table = markdown_table(ROWS, {"laps": ("laps", "d"), "driver": ("driver", "")})
    assert table.splitlines()[2] == "|    2 | guide        |"


def test_a_key_that_only_some_rows_have_is_a_gap_in_the_others() -> None:
    rows: list[Row] = [{"driver": "guide"}, {"driver": "agent", "lap": 3}]
    assert markdown_table(rows, {"lap": ("lap", ".1f")}).splitlines()[2:] == ["|   - |", "| 3.0 |"]


def test_text_is_taken_as_it_is_but_cannot_break_the_table() -> None:
    rows = [{"lap": "31.2 ± 0.4"}, {"lap": "a|b\nc"}]
    assert markdown_table(rows, {"lap": ("lap", ".1f")}).splitlines()[2:] == ["| 31.2 ± 0.4 |", "| a\\|b c     |"]


@pytest.mark.parametrize("number", [np.float32(1.5), np.float64(1.5), np.array(1.5), torch.tensor(1.5)])
def test_numbers_of_numpy_and_torch_are_numbers(number: object) -> None:
    assert markdown_table([{"x": number}], {"x": ("x", ".2f")}).splitlines()[1:] == ["| ---: |", "| 1.50 |"]


def test_truth_values_and_nan_of_numpy_and_torch_read_the_same() -> None:
    rows: list[Row] = [{"a": np.True_, "b": np.float32("nan")}, {"a": torch.tensor(False), "b": torch.tensor(math.nan)}]
    lines = markdown_table(rows, {"a": ("a", ""), "b": ("b", ".1f")}).splitlines()
    assert lines[2:] == ["| yes |   - |", "| no  |   - |"]


def test_a_table_without_rows_is_its_head() -> None:
    assert markdown_table([], {"lap": ("lap (s)", ".2f")}) == "| lap (s) |\n| :------ |"


def test_a_misspelt_column_names_what_there_is() -> None:
    with pytest.raises(ValueError, match=r"No row has 'lap_tme' .* driver, lap, crashes, done, laps"):
        markdown_table(ROWS, {"lap_tme": ("lap (s)", ".2f")})


def test_a_format_that_does_not_fit_names_column_and_value() -> None:
    with pytest.raises(ValueError, match=r"column 'lap' holds 31\.256, which does not take the format 'd'"):
        markdown_table(ROWS, {"lap": ("lap (s)", "d")})


def test_csv_reads_back_in_full_precision(tmp_path: Path) -> None:
    rows: list[Row] = [{"a": 1 / 3, "b": None}, {"a": torch.tensor(2.0), "c": "x,y"}, {"a": math.nan, "b": True}]
    write_csv(rows, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ["a", "b", "c"]
    assert float(read[0]["a"]) == 1 / 3
    assert [row["b"] for row in read] == ["", "", "True"]
    assert read[1] == {"a": "2.0", "b": "", "c": "x,y"}
    assert math.isnan(float(read[2]["a"]))


def test_csv_of_no_rows_is_an_empty_file(tmp_path: Path) -> None:
    write_csv([], tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == ""


def test_csv_that_cannot_be_written_leaves_no_file(tmp_path: Path) -> None:
    class Unprintable:
        def __str__(self) -> str:
            raise RuntimeError("no text")

    with pytest.raises(RuntimeError, match="no text"):
        write_csv([{"a": 1}, {"a": Unprintable()}], tmp_path / "table.csv")
    assert list(tmp_path.iterdir()) == []
