"""The controllers beside a foreign env that something reads.

Such a controller acts in every step of every row, whoever acts. In an env where nothing reads what
it would do it is not even made: PPO asks none, and a method with a guide asks its guide only.
"""

import re
from collections.abc import Iterable, Iterator
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torchrl.envs import Transform

# Parts of a configuration that name entries of the env of a method; its guides are parts of
# `method.transforms`.
READERS = ("observes", "method", "watch", "learner", "degrade", "action", "evaluation")


def unread_controllers(config: DictConfig, transforms: Iterable[Transform]) -> set[str]:
    """Return the names of the controllers beside an env that its agent does without.

    They are those that neither a transform reads nor any part of the configuration names: the
    observation, the method, what is logged, measures and pictures.

    Args:
        config: of a run.
        transforms: of the env.
    """
    names = set(OmegaConf.select(config, "env.controllers") or ())
    keys = [key for part in transforms for key in (part.in_keys or ())]
    named = set(_texts(keys))
    for reader in READERS:
        node = OmegaConf.select(config, reader)
        named |= set(_texts(OmegaConf.to_container(node) if OmegaConf.is_config(node) else node))
    return {name for name in names if not any(_mentions(text, name) for text in named)}


def _mentions(text: str, name: str) -> bool:
    """Return whether a text has a name as a whole word."""
    return re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) is not None


def _texts(node: Any) -> Iterator[str]:
    """Yield the texts in nested lists and mappings, but not the keys of mappings."""
    if isinstance(node, str):
        yield node
    elif isinstance(node, dict):
        for value in node.values():
            yield from _texts(value)
    elif isinstance(node, (list, tuple)):
        for value in node:
            yield from _texts(value)
