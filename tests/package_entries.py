"""The entry points of this checkout, whether or not this version of it is installed."""

import atexit
import os
import shutil
import sys
import tempfile
import tomllib
from importlib import metadata
from pathlib import Path

GROUP = "coil_rl.conf"


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
    folder = Path(place, f"coil_rl-{project['version']}.dist-info")
    folder.mkdir()
    head = f"Metadata-Version: 2.1\nName: coil-rl\nVersion: {project['version']}\n"
    (folder / "METADATA").write_text(head)
    lines = [f"{name} = {value}" for name, value in wanted.items()]
    (folder / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, ""]))
    sys.path.insert(0, place)
    paths = [place, *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
