"""What the contract of an exported policy says."""

from types import SimpleNamespace

import pytest
from run_folders import driven, make_run

from coil_rl import record
from coil_rl.export.describe import results_of


@pytest.mark.parametrize(
    ("which", "chosen", "drivers"),
    [
        ("handed_over", "earlier", ["guide", "coil"]),
        ("last", "last", ["guide", "coil"]),
        ("last", "tuned", ["guide", "coil"]),  # of a search, which has one policy
        ("last", "earlier", ["guide"]),
        ("last", "guide", ["guide"]),
    ],
)
def test_results_are_those_of_the_exported_policy(which, chosen, drivers, tmp_path):
    rows = [row for name in ("guide", "coil") for row in driven(name, {"a": 1.0, "b": 2.0})]
    folder = make_run(tmp_path / "run", "coil", 0, rows)
    returns = {chosen: 2.0} if chosen == "tuned" else {"last": 1.0, chosen: 2.0}
    record.DELIVERY.write(folder, record.Delivery(policy=chosen, cases=2, returns=returns))
    found = results_of(SimpleNamespace(folder=folder), which)
    assert [(row["driver"], row["reward"]) for row in found] == [(name, 1.5) for name in drivers]
