"""Hints for what people type first: other names, keys in the wrong place, short forms."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl import conf
from coil_rl.errors import did_you_mean

OF_CONES = ("track", "preset")  # groups of the cone world
# Names of hyper-parameters elsewhere (Stable-Baselines3, CleanRL, rsl_rl), and ours.
OTHER_NAMES = {
    "lr": "learning_rate",
    "total_timesteps": "frames",
    "timesteps": "frames",
    "n_steps": "steps",
    "num_steps": "steps",
    "n_envs": "num_envs",
    "n_epochs": "epochs",
    "update_epochs": "epochs",
    "num_minibatches": "minibatches",
    "clip_range": "clip",
    "clip_coef": "clip",
    "ent_coef": "entropy",
    "entropy_coef": "entropy",
    "vf_coef": "critic",
    "discount": "gamma",
    "lam": "gae_lambda",
    "lmbda": "gae_lambda",
    "net_arch": "hidden",
    "hidden_sizes": "hidden",
    "buffer_size": "capacity",
    "learning_starts": "starts",
    "env_id": "id",
}
SEVERAL = ("guide", "disturb", "degrade")  # groups whose files are nodes by their names
OF_ENVS = {"env.id": "gym", "env.of": "torchrl", "env.options": "gym", "env.wrappers": "gym"}
MOST = 2  # places that a hint names


def similar(given: str, known: Iterable[str]) -> str:
    """Return `; did you mean X?` for a name among some known ones, or an empty string.

    Args:
        given: the unknown name.
        known: the names that exist.
    """
    if given == "run":
        return "; to go on with a run write resume=FOLDER"
    known = list(known)
    other = OTHER_NAMES.get(given)
    return f"; did you mean {other}?" if other in known else did_you_mean(given, known)


def where(key: str, root: Any) -> str:
    """Return `; did you mean KEY?` for a key that is in another place of the configuration.

    A key that exists is in its place already: only what it is to hold does not fit.

    Args:
        key: the full key that was typed.
        root: the whole configuration.
    """
    if not isinstance(root, DictConfig):
        return ""
    group, _, last = key.rpartition(".")
    wanted = {last, OTHER_NAMES.get(last, last)}
    found = [full for full in _keys(root) if full.rpartition(".")[2] in wanted]
    if key in found:
        return ""
    # A key of the group that was typed is more likely than one of another.
    first = group.partition(".")[0]
    found.sort(key=lambda full: (full.partition(".")[0] != first, full.count(".")))
    return f"; did you mean {' or '.join(found[:MOST])}?" if found else ""


def _keys(root: DictConfig) -> Iterator[str]:
    """Yield the full keys of a configuration, but those of Hydra and of proxies."""
    values: Any = OmegaConf.to_container(root, resolve=False)
    for key, value in values.items():
        if key not in ("hydra", "defaults", "proxy", "preset"):
            yield from _keys_of(str(key), value)


def _keys_of(name: str, node: Any) -> Iterator[str]:
    yield name
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from _keys_of(f"{name}.{key}", value)


def unchosen(key: str, typed: str) -> str:
    """Return `; ...` for the key of a file that exists and was not chosen, or an empty string.

    Args:
        key: that does not exist, such as "guide.controller".
        typed: the key that was typed, such as "guide.controller.of".
    """
    env = OF_ENVS.get(key)
    if env is not None:
        return f"; it belongs to env={env}: write env={env} {typed}=VALUE"
    group, _, name = key.partition(".")
    if not re.fullmatch(r"\w+\.\w+", key) or group not in SEVERAL:
        return ""
    if not Path(conf.__file__).with_name(group).joinpath(f"{name}.yaml").is_file():
        return ""
    chosen = name if group == "guide" else f"[{name}]"
    return f"; it belongs to {group}={name}: write {group}={chosen} {typed}=VALUE"


def choice(group: str, name: str, options: Iterable[str]) -> str:
    """Return `; ...` with what to write instead of a choice of a group that has no file.

    Args:
        group: such as "env".
        name: the choice.
        options: the names of its files.
    """
    if group == "env" and re.search(r":|-v\d+$", name):
        return f"; for an env of Gymnasium write env=gym env.id={name}"
    if group == "guide" and ":" in name:
        return f"; for a controller of your own write guide=controller guide.controller.of={name}"
    if group.startswith("guide") and (Path(group[6:], name) / "config.yaml").is_file():
        folder = Path(group[6:], name)
        return f"; for the policy of a run write guide=learned guide.learned.run={folder}"
    return similar(name, options)


def file_without_package(message: str) -> str:
    """Return the sentence for a YAML file that lacks its package line, or an empty string.

    Args:
        message: of Hydra, for a file whose keys do not fit.
    """
    found = re.search(r"In '([\w/]+)/([^'/]+)'.*Key '(\w+)' not in '(\w+)'", message, re.DOTALL)
    if found is None:
        return ""
    group, name, key, _ = found.groups()
    return (
        f"{group}/{name}.yaml: Hydra puts its keys under {group}, which has no key {key}; begin "
        "the file with the line # @package _global_"
    )
