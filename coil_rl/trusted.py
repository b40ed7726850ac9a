"""What of other libraries may be in a folder that somebody else made, from `conf/trusted.yaml`."""

from importlib import resources
from typing import Any

import yaml

TRUSTED: dict[str, Any] = yaml.safe_load(
    (resources.files("coil_rl.conf") / "trusted.yaml").read_text("utf-8")
)


def _full_names(modules: dict[str, list[str]]) -> frozenset[str]:
    found: set[str] = set()
    for module, names in modules.items():
        found |= {f"sklearn.{module}.{name}" for name in names}
    return frozenset(found)


ESTIMATORS = _full_names(TRUSTED["estimators"])  # regressors of scikit-learn and their parts
PARTS = _full_names(TRUSTED["parts"])  # types inside fitted estimators
