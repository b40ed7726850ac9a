"""YAML files of plain values, such as the configuration in the folder of a run.

A file may come from anybody: it is read without running code, and stays as small in memory as on
the disk. Numbers are read and written as OmegaConf does, to which 1e-3 is a number.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import yaml

from coil_rl.errors import IN_THE_WAY, UserError
from coil_rl.files import read_text

LARGEST_FILE = 200_000  # bytes; the configuration of a run has about 5,000
DEEPEST = 32  # levels
FLOAT = re.compile(r"([-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF))$")


class _Loader(yaml.SafeLoader):
    """Reads 1e-3 as a number, a date as a text, and refuses a key that is given twice."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        first: [pair for pair in pairs if pair[0] != "tag:yaml.org,2002:timestamp"]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; raise a `ConstructorError` for a key that occurs twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"found duplicate key {key.value}", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Writes texts that could be read as numbers, such as 1e3, in quotes."""


for each in (_Loader, _Dumper):
    each.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("-+0123456789."))


def read_yaml(path: Path, largest: int = LARGEST_FILE) -> Any:
    """Return the values of a file.

    Args:
        largest: allowed size, in bytes.

    Raises:
        UserError: for a file that cannot be read, is larger or deeper than any configuration of a
            run, or refers to parts of itself.
        yaml.YAMLError: for a file that is no YAML.
        OSError: for a folder, or without the right to read.
    """
    try:
        text, depth = read_text(path, largest), 0
    except OSError as error:
        if error.errno in IN_THE_WAY:
            raise
        raise UserError(
            f"{path} is not the configuration of a run ({error.strerror}); put the file back that "
            "coil-train wrote"
        ) from error
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.AliasEvent):
            raise UserError(
                f"{path} repeats a part of itself by *{event.anchor:.40}; write the part out"
            )
        if depth > DEEPEST:
            raise UserError(f"{path} has more than {DEEPEST} levels; no configuration of a run has")
    return yaml.load(text, Loader=_Loader)


def entries(node: Any, name: str = "", *, lists: bool = False) -> Iterator[tuple[str, Any, Any]]:
    """Yield full key, key and value of each entry of nested mappings, a node before its entries.

    Args:
        name: full key of the node; empty for the whole.
        lists: whether lists are nodes too; the full keys in them have indices, as in `key[0]`.
    """
    if isinstance(node, Mapping):
        inner = [(f"{name}.{key}" if name else str(key), key, node[key]) for key in node]
    elif lists and isinstance(node, list):
        inner = [(f"{name}[{index}]", index, value) for index, value in enumerate(node)]
    else:
        return
    for full, key, value in inner:
        yield full, key, value
        yield from entries(value, full, lists=lists)


def leaves(node: Any) -> dict[str, Any]:
    """Return what is no mapping, or an empty one, in nested mappings, by its full key."""
    found = ((key, value) for key, _, value in entries(node))
    return {key: value for key, value in found if not (isinstance(value, Mapping) and value)}


def is_part(key: str, of: Iterable[str]) -> bool:
    """Return whether a key, or a parent of it, is one of some keys.

    Args:
        of: full keys of values or groups.
    """
    return any(f"{key}.".startswith(f"{each}.") for each in of)


def yaml_of(values: Mapping[str, Any]) -> str:
    """Return plain values as YAML, which `read_yaml` and OmegaConf read as the same values."""
    return yaml.dump(dict(values), Dumper=_Dumper, sort_keys=False, allow_unicode=True)
