"""Proxies: networks that imitate guides without parameters, for methods that train their guides.

A proxy is the policy of an imitation run. The configuration of that run follows from the guide, the
env and the key `proxy`; its hash is part of the folder name, so that a proxy is trained once. For
objects and code of a user, which the configuration only names, there is a second hash. A run copies
its proxies into its own folder.
"""

import hashlib
import math
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import nn

from coil_rl.config.given import kept_objects
from coil_rl.config.nodes import find_target
from coil_rl.config.parts import build_guides, build_learner, env_maker
from coil_rl.config.schema import TrainConfig, fingerprint
from coil_rl.config.source import code_of_user, identity_of
from coil_rl.errors import UserError
from coil_rl.files import temporary, whole_file
from coil_rl.guides import ControllerGuide
from coil_rl.transforms.normalised_action import in_unit_of

PROXIES = "proxies"  # subfolder of a run with the networks that replace guides without parameters
FILES = ("config.yaml", "policy_last.pt")  # files of a run that are needed to load its policy


def guides_without_parameters(guides: Mapping[str, nn.Module]) -> list[str]:
    """Return the names of the guides without parameters."""
    return [name for name, guide in guides.items() if not any(True for _ in guide.parameters())]


def proxy_config(config: DictConfig, name: str) -> DictConfig:
    """Return the configuration of the run that trains the proxy of one guide of a training run.

    The env is that of the training run, with its delays and noise. The key `proxy` must describe a
    network.
    """
    if config.proxy is None or config.proxy.method.observes is None:
        raise UserError("proxy.method.observes: a proxy needs observations; give proxy=network")
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    guide, proxy = {name: resolved["guide"][name]}, resolved["proxy"]
    values = {
        **{key: resolved[key] for key in ("preset", "track", "observes", "device", "threads")},
        **{key: proxy[key] for key in ("method", "learner", "budget", "seed")},
        "env": resolved["env"] | resolved["training"]["imitation_env"] | proxy["env"],
        "disturb": _drawn_anew(resolved["disturb"], proxy["seed"]),
        "training": {"disturb": _drawn_anew(resolved["training"]["disturb"], proxy["seed"])},
        "guide": guide,
        "label": f"proxy of {name}",
        "evaluation": {key: resolved["evaluation"][key] for key in ("cases", "measures", "env")}
        | {"disturb": _drawn_anew(resolved["evaluation"]["disturb"], proxy["seed"]), "gif": False},
        "existing": "resume",
    }
    merged: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), values)
    OmegaConf.update(merged, "method.transforms.advice.guides", guide, merge=False, force_add=True)
    parts = [name, fingerprint(merged), *_hash_of_user(merged, name)]
    merged.run_dir = f"{proxy['folder']}/{'_'.join(parts)}"
    return merged


def _drawn_anew(nodes: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return the nodes of disturbances with another seed, so that runs share their proxies."""
    has_seed = [
        name for name, node in nodes.items() if isinstance(node, Mapping) and "seed" in node
    ]
    return {**nodes, **{name: {**nodes[name], "seed": seed} for name in has_seed}}


def _hash_of_user(config: DictConfig, name: str) -> list[str]:
    """Return a hash of what is a user's in a guide and an env; none if there is nothing."""
    guide = config.guide[name]
    things = kept_objects(config, "env")
    if find_target(guide.get("_target_"), f"guide.{name}") is ControllerGuide:
        things += kept_objects(config, "guide")
    found = [*map(identity_of, things), *code_of_user(config, ("guide", "env"))]
    if not found:
        return []
    return [hashlib.sha256(" ".join(found).encode()).hexdigest()[:10]]


def distil(config: DictConfig, folder: Path, run: Callable[[DictConfig], float]) -> int:
    """Put a proxy of each guide without parameters into the folder of a run, unless it is there.

    Args:
        run: does the run of a proxy, or finishes it.

    Returns:
        The frames that the proxies took, now or earlier. Their last batch is a whole one.
    """
    names = guides_without_parameters(build_guides(config))
    proxies = {name: proxy_config(config, name) for name in names}
    if not (folder / PROXIES).is_dir():
        for proxy in proxies.values():
            run(proxy)
        copy_proxies({name: Path(proxy.run_dir) for name, proxy in proxies.items()}, folder)
    return frames_of_proxies(config, names)


def frames_of_proxies(config: DictConfig, guides: Iterable[str]) -> int:
    """Return the frames that the proxies of the guides of a run take.

    Args:
        guides: names of the guides that get a proxy.
    """
    return sum(frames_of(config.proxy.budget) for _ in guides)


def frames_of(budget: DictConfig) -> int:
    """Return the frames that a training without tests takes: whole batches.

    Args:
        budget: of the training, with `frames`, `num_envs` and `steps`.
    """
    batch = int(budget.num_envs) * int(budget.steps)
    return math.ceil(budget.frames / batch) * batch


def copy_proxies(runs: Mapping[str, Path], folder: Path) -> None:
    """Copy proxies into the folder of the run that uses them, all at once.

    `runs` are their run folders by the name of the guide. A file in their place is a `UserError`.
    """
    proxies = folder / PROXIES
    if proxies.is_file():
        raise UserError(f"{proxies} is a file, but a folder is to be made there; remove it")
    unfinished = temporary(proxies)
    try:
        unfinished.mkdir(parents=True, exist_ok=True)  # guides with parameters need no proxy
        for name, run in runs.items():
            for file in FILES:
                with whole_file(unfinished / name / file) as copy:
                    shutil.copyfile(run / file, copy)
        unfinished.rename(proxies)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def guides_with_untrained_proxies(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """Return the guides of a configuration.

    A guide without parameters is replaced by an untrained proxy.
    """
    guides = build_guides(config)
    for name in guides_without_parameters(guides):
        proxy = proxy_config(config, name)
        env = env_maker(proxy)()
        guides[name] = in_unit_of(env, build_learner(proxy, env).policy)
    return guides
