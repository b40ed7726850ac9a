from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import pytest

from coil_rl.envs import Track
from coil_rl.errors import UserError
from coil_rl.signature import check_call, describe, fits


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (float, [1, 1.5, -2], ["1", None, True, float("nan"), float("inf"), 10**400, [1.0]]),
        (int, [1, -1, 2**63 - 1], [1.0, True, None, 2**63, "1"]),
        (bool, [True], [1, 0, "true", None]),
        (str, ["", "a"], [1, None, ["a"]]),
        (float | None, [None, 1], ["a"]),
        (Literal["a", 1], ["a", 1], ["b", True, None]),
        (Sequence[int], [[], [1, 2]], ["12", 1, [1, "a"], None]),
        (tuple[int, str], [[1, "a"]], ["a"]),
        (dict[str, float], [{}, {"a": 1}], [{"a": "b"}, [1], 1]),
        (Mapping, [{"a": "b"}], [1]),
        (float | Callable[[float], float], [1, {"_target_": "math.sqrt"}], ["sqrt"]),
        (Sequence[Track], [{"_target_": "coil_rl.envs.shipped_tracks"}], [5, [1, 2], "abc"]),
        (Any, [1, None, "a", []], []),
    ],
)
def test_value_fits_what_its_parameter_is_annotated_with(hint, good, bad):
    assert all(fits(value, hint) for value in good)
    assert not any(fits(value, hint) for value in bad)
    assert describe(hint)


def part(needed: int, scale: float = 1.0, *, table: dict[str, float] | None = None, loose=None):
    return needed, scale, table, loose


@pytest.mark.parametrize(
    ("node", "given", "words"),
    [
        ({}, (), "part: part needs needed; give part.needed=VALUE"),
        ({"needed": 1, "scal": 1}, (), "part takes no scal; it takes needed, scale, table, loose; did you mean scale?"),
        ({"needed": 1}, ("needed",), "needed of part is set by the program; leave it out"),
        ({"table": {"a": 1, "b": "x"}}, ("needed",), r"table\.b='x' must be a finite number"),
        ({"needed": 1, "_args_": [1]}, (), "part takes no _args_"),
    ],
)
def test_call_that_cannot_be_made_is_refused(node, given, words):
    with pytest.raises(UserError, match=words):
        check_call(part, node, "part", given)


def test_what_has_no_annotations_is_not_checked():
    check_call(part, {"needed": 1, "loose": object()}, "part")
    check_call(dict, {"anything": 1}, "part")
