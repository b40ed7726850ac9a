"""The plan in the folder of a comparison, and whether a repeated command is about the same one."""

import copy
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from coil_rl.comparison.timing import Plan
from coil_rl.config import nodes
from coil_rl.config.folder import identity
from coil_rl.config.nodes import kept
from coil_rl.config.python import Named
from coil_rl.record import json_file
from coil_rl.run.folder import check_same

Identity = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Kept:
    """What the folder of a comparison holds of it.

    Args:
        identity: the arguments.
        configuration: the values that they are composed to.
        plan: what is done.
    """

    identity: dict[str, Any]
    configuration: dict[str, Any]
    plan: Plan


PLAN = json_file("compare.json", Kept, "choose another folder")


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
    code = nodes.code_of_run(config).values()
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
                OmegaConf.update(described, key, nodes.identity_of(kept(node["name"])), merge=False)
    found = {"identity": arguments, "configuration": identity(described)}
    return dict(json.loads(json.dumps(found, default=str)))


def keep_plan(folder: Path, identity: Identity, plan: Plan) -> None:
    """Write the plan of a comparison."""
    PLAN.write(folder, Kept(**identity, plan=plan))


def known_plan(folder: Path, identity: Identity) -> Plan | None:
    """Return the plan in a folder, which must be that of the same comparison; None without one.

    Raises:
        UserError: for another comparison, with what differs first, and for a damaged file.
    """
    saved = PLAN.read(folder)
    if saved is None:
        return None
    for values, ours in (
        (saved.identity, identity["identity"]),
        (saved.configuration, identity["configuration"]),
    ):
        remedy = "give the same arguments to go on, or choose another folder"
        check_same(values, ours, f"{folder} holds a comparison", remedy)
    return saved.plan
