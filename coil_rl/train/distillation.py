"""Networks in place of guides without parameters, where a method trains its guides.

A proxy is the policy of a training run of its own, which imitates the guide. What that run is follows from the guide,
the env and `proxy` of the configuration, and so does the name of its folder: what was made once is found again. A run
that uses proxies keeps copies of them in its own folder.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import nn

from coil_rl.files import whole_folder
from coil_rl.train import load
from coil_rl.train.build import build_env, build_guides, build_learner
from coil_rl.train.config import TrainConfig, fingerprint

FILES = ("config.yaml", "policy_last.pt")  # what of a run its policy is made from


def lacking(guides: Mapping[str, nn.Module]) -> list[str]:
    """The names of those guides that have no parameters."""
    return [name for name, guide in guides.items() if not any(True for _ in guide.parameters())]


def configuration(config: DictConfig, name: str) -> DictConfig:
    """The configuration of the run that makes the proxy of a guide.

    Args:
        config: of a training run.
        name: of one of its guides.
    """
    whole: Any = OmegaConf.to_container(config, resolve=True)
    node, proxy = whole["guide"][name], whole["proxy"]
    # The guide alone, whatever others the configuration has and whatever they are for.
    proxy["method"]["transforms"]["advice"]["guides"] = {name: node}
    wanted = {
        **{key: whole[key] for key in ("preset", "track", "device", "threads")},
        **{key: proxy[key] for key in ("method", "learner", "budget", "seed")},
        "proxy": {},
        "env": whole["env"] | proxy["env"],
        "guide": {name: node},
        "label": f"proxy of {name}",
        "evaluation": {"env": whole["evaluation"]["env"], "gif": False},
        "existing": "resume",
    }
    made: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), wanted)
    made.run_dir = f"{proxy['folder']}/{name}_{fingerprint(made)}"
    return made


def keep(made: Mapping[str, Path], folder: Path) -> None:
    """Copy the proxies of guides, by name, into the folder of the run that uses them."""
    with whole_folder(folder / load.PROXIES) as unfinished:
        for name, run in made.items():
            (unfinished / name).mkdir()
            for file in FILES:
                shutil.copyfile(run / file, unfinished / name / file)


def untrained(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The guides of a configuration, with proxies that have not learned yet in place of those without parameters."""
    guides = build_guides(config)
    for name in lacking(guides):
        wanted = configuration(config, name)
        guides[name] = build_learner(wanted, build_env(wanted)).policy
    return guides
