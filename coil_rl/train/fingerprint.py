"""What a run is, in ten letters: a run that was made once is found again by them."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from omegaconf import DictConfig, OmegaConf

# What two runs of one configuration may differ in; a configuration that was read holds the defaults of its type.
IGNORED_KEYS = ("run_dir", "logger", "existing", "defaults")


def fingerprint(config: DictConfig) -> str:
    """Ten hexadecimal digits that are the same for configurations of the same numbers, and for no others.

    Args:
        config: of a training run, also as Hydra composes it, with its own part; references may be in it.
    """
    wanted: dict[str, Any] = {
        str(key): OmegaConf.to_container(config[key], resolve=True) if OmegaConf.is_config(config[key]) else config[key]
        for key in sorted(map(str, config))
        if key not in (*IGNORED_KEYS, "hydra")
    }
    return hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()[:10]
