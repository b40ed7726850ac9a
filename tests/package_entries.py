"""The entry points of this checkout, whether or not this version of it is installed."""

import atexit
import os
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

GROUP = "coil_rl.conf"


def declare(
    place: Path, package: str, version: str, group: str, entries: Mapping[str, str]
) -> None:
    """Write the entry points of a package as if it were installed in a folder."""
    folder = place / f"{package}-{version}.dist-info"
    folder.mkdir()
    head = f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n"
    (folder / "METADATA").write_text(head)
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (folder / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))


def find_entry_points() -> None:
    """Let this process, and those that it starts, find the entry points of pyproject.toml."""
    path = Path(__file__).parents[1] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    wanted = project["entry-points"][GROUP]
    known = {each.name: each.value for each in metadata.entry_points(group=GROUP)}
    if wanted.items() <= known.items():
        return
    place = tempfile.mkdtemp(prefix="coil_rl_entry_points_")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    declare(Path(place), "coil_rl", project["version"], GROUP, wanted)
    sys.path.insert(0, place)
    paths = [place, *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
