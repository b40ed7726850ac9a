"""The method and the logger of a run that names none."""

from importlib.util import find_spec
from typing import Any

from omegaconf import OmegaConf

# The paper's method is the default in the worlds of this project. Elsewhere nobody knows how good
# the guide is, and the default is the method that holds it.
OWN_WORLDS = ("cone_track", "driving_tasks", "simulated_robot", "mcap_replay")


def method_for(guide: Any) -> str:
    """Return the method for an env of somebody else.

    Args:
        guide: what was given as the guide; None, or the file "none", for no guide.
    """
    return "ppo" if guide is None or guide == "none" else "coil_anchored"


def default_method(env: str, guide: Any) -> str:
    """Return the method of a run whose command names none.

    Args:
        env: name of the file in conf/env.
        guide: name of the file in conf/guide, or several of them.
    """
    own = any(env == world or env.startswith(f"{world}_") for world in OWN_WORLDS)
    return "coil" if own else method_for(guide)


# In the defaults list of train.yaml: ${default_method:${env},${oc.select:guide,several}}
OmegaConf.register_new_resolver("default_method", default_method, replace=True)


def default_logger() -> str:
    """Return the logger of a run whose command names none: metrics.csv is always written."""
    return "none" if find_spec("tensorboard") is None else "tensorboard"


# In the defaults list of train.yaml: ${default_logger:}
OmegaConf.register_new_resolver("default_logger", default_logger, replace=True)
