"""The YAML files of guests: packages beside coil-rl that bring envs, guides, experiments, programs.

A guest names the package of its files by an entry point, and Hydra then finds them like those of
coil-rl, by the names of their folders:

    [project.entry-points."coil_rl.conf"]
    my_package = "my_package.conf"
"""

from functools import cache
from importlib import metadata

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

CORE = "coil_rl.conf"  # the package of our own files, and the group of the entry points


@cache
def packages() -> tuple[str, ...]:
    """Return the packages with YAML files, coil-rl's own first."""
    return (CORE, *sorted(entry.value for entry in metadata.entry_points(group=CORE)))


@cache
def shipped_places() -> tuple[str, ...]:
    """Return where Hydra finds its own files, and those that are installed with coil-rl."""
    entries = metadata.entry_points(group=CORE)
    ours = sorted(each.value for each in entries if each.dist and each.dist.name == "coil-rl")
    return ("pkg://hydra", "structured://", *(f"pkg://{package}" for package in (CORE, *ours)))


class GuestFiles(SearchPathPlugin):
    """Lets Hydra find the files of all of them in a program whose own file is in one of them."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append what is not there.

        Args:
            search_path: of the program.
        """
        places = [f"pkg://{package}" for package in packages()]
        known = {element.path for element in search_path.get_path()}
        if not known.isdisjoint(places):
            for place in places:
                if place not in known:
                    search_path.append(CORE, place)


Plugins.instance().register(GuestFiles)
