from pathlib import Path

import pytest
from hydra.utils import get_object

from coil_rl.config.old_names import GONE, OLD_NAMES, renamed, with_todays_keys
from coil_rl.errors import UserError

PATH = Path("config.yaml")


def test_parts_that_moved_are_found_at_any_depth():
    assert all(map(get_object, OLD_NAMES.values()))
    for old, new in OLD_NAMES.items():
        node = {"guide": {"one": {"_target_": old}}, "list": [{"_target_": old, "of": 3}]}
        found = {"guide": {"one": {"_target_": new}}, "list": [{"_target_": new, "of": 3}]}
        assert renamed(node, PATH) == found


@pytest.mark.parametrize("old", GONE)
def test_part_that_went_is_refused(old):
    with pytest.raises(UserError, match=r"config.yaml is of an earlier version: .*; train again"):
        renamed({"learner": {"regressor": {"_target_": old}}}, PATH)


def test_keys_that_were_renamed_are_found_in_their_place_only():
    search = {"search": {"cases": 4}}
    found = with_todays_keys({"label": "tune", "method": {"name": "tune", **search}, "env": search})
    assert found == {
        "label": "tune",
        "method": {"name": "tune", "run": {"cases": 4}},
        "env": search,
    }


@pytest.mark.parametrize(
    ("fallback", "beside"),
    [(False, {}), (True, {"fallback": {"_target_": "coil_studies.Fallback"}})],
)
def test_fallback_of_an_older_run_is_a_driver_beside(fallback, beside):
    found = with_todays_keys({"evaluation": {"cases": 3, "fallback": fallback}})
    assert found == {"evaluation": {"cases": 3, "beside": beside}}
