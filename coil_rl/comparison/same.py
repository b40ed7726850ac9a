"""The plan in the folder of a comparison, and whether a repeated command is about the same one."""

import copy
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from coil_rl.comparison.timing import Plan
from coil_rl.config import source
from coil_rl.config.folder import identity
from coil_rl.config.given import kept
from coil_rl.config.python import Named
from coil_rl.errors import file_of_a_run
from coil_rl.files import LARGEST_NUMBERS, read_file, write_text
from coil_rl.run.folder import check_same

Identity = Mapping[str, Mapping[str, Any]]


def identity_of(given: Named, config: DictConfig, minutes: float, seed: int) -> Identity:
    """Return everything on which the numbers of a comparison depend.

    These are the arguments, and the values that they are composed to: files of the user may change
    between two commands. An object has no value, but is told apart by its class and its state, and
    what a name of the user's stands for by its code.

    Args:
        given: env, guide and everything else that was given.
        config: of plain PPO with its whole budget, composed of them.
        minutes: that it may take.
        seed: of the first trainings.
    """
    code = source.code_of_user(config, ("env", "guide"))
    arguments = {
        "words": list(given.words),
        "objects": sorted(given.nodes),
        "tune": given.nodes.get("tune"),
        "minutes": minutes,
        "seed": seed,
        "code of env and guide": hashlib.sha256(" ".join(code).encode()).hexdigest()[:10],
    }
    described = copy.deepcopy(config)
    with open_dict(described):
        for key, node in given.nodes.items():
            # The node of an object contains the folder, which may be moved.
            if key != "tune":
                OmegaConf.update(
                    described, key, source.identity_of(kept(node["name"])), merge=False
                )
    return {"identity": arguments, "configuration": identity(described)}


def keep_plan(file: Path, identity: Identity, plan: Plan) -> None:
    """Write the plan of a comparison."""
    write_text(file, json.dumps({**identity, "plan": plan.to_dict()}, indent=2, default=str))


def known_plan(file: Path, identity: Identity) -> Plan:
    """Return the plan in a file, which must be that of the same comparison.

    Raises:
        UserError: for another comparison, with what differs first, and for a damaged file.
    """
    with file_of_a_run(file, "choose another folder"):
        saved = json.loads(read_file(file, LARGEST_NUMBERS))
        for part, values in json.loads(json.dumps(identity, default=str)).items():
            check_same(
                saved[part],
                values,
                f"{file.parent} holds a comparison",
                "give the same arguments to go on, or choose another folder",
            )
        return Plan(**saved["plan"])
