"""The files of a run as a typed record."""

import math

import pytest

from coil_rl import record
from coil_rl.errors import UserError

ROWS = [
    {"driver": "coil", "advice": "", "actions": "deterministic", "case": case, "reward": reward}
    for case, reward in (("a", 0.1 + 0.2), ("b", math.nan), ("mean", 1 / 3))
]
CONTENTS = [
    (record.EVALUATION, ROWS),
    (record.COMMAND, ["coil-train", "method=coil", "label=a b"]),
    (record.VERSIONS, {"python": "3.11"}),
    (record.GUIDE_RETURNS, {"guide": 0.1 + 0.2, "guide slow": math.nan}),
    (record.DELIVERY, record.Delivery(policy="last", cases=2, returns={"last": -1e-7})),
]


@pytest.mark.parametrize(("file", "content"), CONTENTS, ids=[file.name for file, _ in CONTENTS])
def test_what_is_written_is_read_with_every_digit(file, content, tmp_path):
    assert file.read(tmp_path) is None
    file.write(tmp_path, content)
    assert repr(file.read(tmp_path)) == repr(content)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (record.DELIVERY, "{", r"Invalid JSON.*; remove it, and the sentence is left out"),
        (record.DELIVERY, '{"policy": "last"}', r"\(cases: Field required\)"),
        (record.DELIVERY, "[" * 100_000, "Invalid JSON"),
        (record.GUIDE_RETURNS, '{"guide": "much"}', r"\(guide: Input should be a valid number"),
        (
            record.EVALUATION,
            "driver,reward\ncoil,1\n",
            r"it lacks advice.*again by coil-train",
        ),
        (
            record.EVALUATION,
            "driver,advice,actions,case,reward\ncoil,,sampled,0,-inf\n",
            "a return that is infinite",
        ),
    ],
)
def test_damaged_file_is_one_sentence_with_its_name_and_what_to_do(file, text, message, tmp_path):
    (tmp_path / file.name).write_text(text)
    with pytest.raises(UserError, match=message) as error:
        file.read(tmp_path)
    assert str(error.value).startswith(f"{tmp_path / file.name} is damaged (")
    assert "\n" not in str(error.value)


def test_file_that_is_needed_is_named_where_it_is_missing(tmp_path):
    with pytest.raises(UserError, match=r"there is no file .*evaluation\.csv; put back what"):
        record.EVALUATION.need(tmp_path)
