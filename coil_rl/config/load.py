"""Finished runs, opened from their folders."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase

from coil_rl.config.build import assemble, build_guides, trains_guides
from coil_rl.config.given import give
from coil_rl.config.pretrained import PREFIX, run_folder
from coil_rl.config.saved import read_config
from coil_rl.config.trust import trust_packages
from coil_rl.errors import UserError
from coil_rl.run.run import Run
from coil_rl.transforms.normalised_action import in_unit_of

PROXIES = "proxies"  # subfolder with the networks that replace guides without parameters


def open_run(
    folder: str | Path,
    *,
    guide: Any = None,
    env: Any = None,
    trust: Sequence[str] = (),
    device: str = "cpu",
) -> Run:
    """Return the run in a folder, finished or not.

    Args:
        folder: that `coil-train` or `coil_rl.train` has written; it may come from anybody. Or
            "pretrained:NAME" for a shipped policy.
        guide: the object that was the guide, for a run that was made in Python with one that no
            import path names.
        env: the same for its env.
        trust: packages whose parts the folder may use, see docs/trust.md.
        device: of everything, "cpu" or "cuda".

    Raises:
        UserError: for a folder without a run, or one whose configuration cannot be read or could
            run code.

    Example:
        >>> import coil_rl
        >>> controller = coil_rl.open_run("outputs/tank").controller()  # doctest: +SKIP
    """
    folder = run_folder(folder)
    if trust:
        trust_packages(trust)
    config = read_config(folder, "folder", {"device": device}, goes_on=bool(trust))
    give(config, {"guide": guide, "env": env})
    return assemble(config, folder)


def pretrained(name: str, *, device: str = "cpu") -> Run:
    """Return a shipped policy as the finished run that it is.

    Args:
        name: such as "cone_track/coil"; `pretrained_names()` has all.
        device: of everything, "cpu" or "cuda".

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.

    Example:
        >>> import coil_rl
        >>> run = coil_rl.pretrained("cone_track/coil")
        >>> run.label, run.seed
        ('coil', 0)
    """
    return open_run(f"{PREFIX}{name}", device=device)


def load_guides(folder: Path, config: DictConfig) -> Mapping[str, TensorDictModuleBase]:
    """Return the first guides of a run that trains its guides.

    The proxy of a guide takes its place, if there is one.

    Args:
        folder: of the run.
        config: of the run.
    """
    guides = build_guides(config)
    for name in guides:
        proxy = folder / PROXIES / name
        if not proxy.exists():
            continue
        key = f"the proxy of guide.{name}"
        proxy_config = read_config(proxy, key, {"device": config.device})
        if trains_guides(proxy_config):
            raise UserError(
                f"{proxy} trains guides itself, but a proxy imitates one; train the run again"
            )
        run = assemble(proxy_config, proxy)
        env = run.make_env()
        guides[name] = in_unit_of(env, run.policy(env, which="last"))
    return guides
