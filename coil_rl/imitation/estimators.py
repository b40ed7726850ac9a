"""What of other libraries may be in a folder that somebody else made, from `conf/trusted.yaml`."""

from importlib import resources
from typing import Any

import yaml

TRUSTED: dict[str, Any] = yaml.safe_load(
    (resources.files("coil_rl.conf") / "trusted.yaml").read_text("utf-8")
)


def _full_names(modules: dict[str, list[str]]) -> frozenset[str]:
    return frozenset(
        f"sklearn.{module}.{name}" for module, names in modules.items() for name in names
    )


ESTIMATORS = _full_names(TRUSTED["estimators"])  # regressors of scikit-learn and their parts
PARTS = _full_names(TRUSTED["parts"])  # types inside fitted estimators
