"""`coil-reproduce`: tables, figures and claims of the paper made again, the paper's value beside ours."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from coil_rl.build import build
from coil_rl.config import Reproduce
from coil_rl.errors import UserError
from coil_rl.files import whole_file
from coil_rl.programs import app
from coil_rl.reproduce import Result
from coil_rl.signature import near

KINDS = ("table", "figure", "claim")


def reproduce(config: DictConfig) -> None:
    """Make what was asked for; print each page and leave it in the folder with its numbers and its picture."""
    folder = Path(config.run_dir)
    names = chosen(config)
    # All are built before the first is made: a mistake shall cost seconds.
    results = {name: build(config.results[name], f"results.{name}", Result) for name in names}
    for name in names:
        if (folder / f"{name}.md").exists():
            raise UserError(f"{folder} already holds {name}; choose another folder with hydra.run.dir=FOLDER")
    for name, result in results.items():
        text = result.make(folder / name)
        with whole_file(folder / f"{name}.md") as unfinished:
            unfinished.write_text(text + "\n", encoding="utf-8")
        print(f"{text}\n")
    print(f"reproduce: {', '.join(names)} made; see {folder}")


def chosen(config: DictConfig) -> list[str]:
    """The names in `results` of what was asked for: table=1 is table_1, and a claim has its own name.

    Raises:
        UserError: for one that does not exist, and if nothing was asked for.
    """
    wanted: dict[str, str] = {}
    for kind in KINDS:
        if config[kind] is not None:
            wanted[f"{kind}={config[kind]}"] = config[kind] if kind == "claim" else f"{kind}_{config[kind]}"
    known = {_asked(name): name for name in config.results}
    for asked, name in wanted.items():
        if known.get(asked) != name:
            raise UserError(f"{asked} cannot be made; there are {', '.join(known)}{near(asked, known)}")
    if not wanted:
        raise UserError(f"nothing is asked for; give one of {', '.join(known)}, or several")
    return list(wanted.values())


def _asked(name: str) -> str:
    """How a person asks for a result."""
    kind, _, number = str(name).partition("_")
    return f"{kind}={number}" if kind in KINDS and number.isdecimal() else f"claim={name}"


def check(config: DictConfig) -> None:
    """Refuse a configuration of which nothing can be made.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    app.check_keys(config, Reproduce)
    chosen(config)


def main() -> None:
    """Entry point."""
    app.run(reproduce, "reproduce", check)


if __name__ == "__main__":
    main()
