from hydra.utils import get_object

from coil_rl.config.old_names import OLD_NAMES, renamed


def test_parts_that_moved_are_found_at_any_depth():
    assert all(map(get_object, OLD_NAMES.values()))
    for old, new in OLD_NAMES.items():
        node = {"guide": {"one": {"_target_": old}}, "list": [{"_target_": old, "of": 3}]}
        found = {"guide": {"one": {"_target_": new}}, "list": [{"_target_": new, "of": 3}]}
        assert renamed(node) == found
