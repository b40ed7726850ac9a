"""Values in YAML files equal the defaults of the constructors, except for deliberate variations."""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra.utils
import pytest
from omegaconf import OmegaConf
from programs import CONF

import coil_fmu.conf
import coil_paper.conf
import coil_robot.conf
import coil_studies.conf

PROJECT = ("coil_rl.", "coil_fmu.", "coil_paper.", "coil_robot.", "coil_studies.")
# Folders in which a file changes the defaults of a class for a method or an experiment.
VARIATION_FOLDERS = ("experiment", "method", "preset", "paper/experiment", "studies/method")
# Other deliberate variations, by file. A key stands for all keys that begin with it.
VARIATIONS = {
    "env/cone_track.yaml": ["env.reward"],  # None in the constructor: the rewards of the paper
    "env/driving_tasks.yaml": ["env.reward"],
    "robot/env/simulated_robot.yaml": ["env.reward", "env.lidar", "env.car_length"],  # rounded
    # None in the constructor: no options, no controllers; from Python processes are asked for.
    "env/gym.yaml": ["env.options", "env.controllers", "env.workers"],
    # None in the constructor: nothing, and a reward for setpoints that a command line may change.
    "fmu/env/fmu.yaml": [
        *(f"env.{name}" for name in ("setpoints", "parameters", "start", "bounds", "controllers")),
        *("env.reward", "env.workers"),
    ],
    "env/torchrl.yaml": ["env.max_steps"],
    "robot/env/mcap_replay.yaml": ["evaluation.env."],  # two laps of robots that start alike
    "task/cones_noisy_view.yaml": ["method.transforms.view.sigma"],
    "robot/robot/replayed.yaml": ["car_length"],
    "disturb/late.yaml": ["min_lag", "max_lag", "in_keys", "memory_key"],
    "guide/authors.yaml": ["oddities"],
    "guide/undertuned.yaml": ["gain"],
    "learner/ppo_sb3.yaml": ["learner."],
    "proxy/network.yaml": ["method.transforms"],
    "paper/reproduce/figure_22.yaml": ["labels", "worlds"],
    "paper/reproduce/table_4.yaml": ["worlds"],
    "paper/reproduce/table_5.yaml": ["worlds"],
    "paper/reproduce/table_6.yaml": ["experiments", "worlds", "car_length"],
}
FOLDERS = {
    "": CONF,
    "fmu/": Path(coil_fmu.conf.__path__[0]),
    "paper/": Path(coil_paper.conf.__path__[0]),
    "robot/": Path(coil_robot.conf.__path__[0]),
    "studies/": Path(coil_studies.conf.__path__[0]),
}
FILES = {
    f"{prefix}{path.relative_to(conf).as_posix()}": path
    for prefix, conf in FOLDERS.items()
    for path in sorted(conf.rglob("*.yaml"))
}


def nodes(value: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield all nodes with a `_target_` of this project, with their keys.

    Schedules are values and not nodes.
    """
    if isinstance(value, dict):
        target = str(value.get("_target_", ""))
        if target.startswith(PROJECT) and not target.startswith("coil_rl.schedules."):
            yield path, value
        for key, entry in value.items():
            yield from nodes(entry, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            yield from nodes(entry, f"{path}[{index}]")


def defaults(target: Any) -> dict[str, Any]:
    """Return defaults by parameter.

    Those of the base class are included if the constructor passes arguments on to it.
    """
    function = target.__init__ if inspect.isclass(target) else target
    parameters = inspect.signature(function).parameters.values()
    passes_on = inspect.isclass(target) and any(p.kind is p.VAR_KEYWORD for p in parameters)
    inherited = {}
    if passes_on and target.__module__.startswith(PROJECT):
        inherited = defaults(target.__bases__[0])
    return inherited | {p.name: p.default for p in parameters if p.default is not p.empty}


def plain(value: Any) -> Any:
    """Return a value with lists in place of tuples."""
    return [plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def differences(file: str) -> dict[str, tuple[Any, Any]]:
    """Return stated value and default of each key in which a file differs from the constructors."""
    different = {}
    for path, node in nodes(OmegaConf.to_container(OmegaConf.load(FILES[file]))):
        default = defaults(hydra.utils.get_object(node["_target_"]))
        for key in node.keys() & default.keys():
            value = node[key]
            if "${" in str(value) or (isinstance(value, dict) and value.get("_partial_")):
                continue
            if isinstance(value, dict) and "_target_" in value:
                value = hydra.utils.instantiate(value)
            if plain(value) != plain(default[key]):
                different[f"{path}.{key}".lstrip(".")] = (value, default[key])
    return different


@pytest.mark.parametrize("file", [file for file in FILES if not file.startswith(VARIATION_FOLDERS)])
def test_yaml_states_the_defaults_of_the_constructors(file: str) -> None:
    allowed = tuple(VARIATIONS.get(file, ["no key"]))
    assert not {key: pair for key, pair in differences(file).items() if not key.startswith(allowed)}
