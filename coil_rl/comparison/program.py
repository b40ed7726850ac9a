"""coil-compare: is my guide worth it? Short trainings beside the guide, and what to use.

  coil-compare env=mountain_car                            with the guide of the env's file
  coil-compare env=gym env.id=Pendulum-v1 guide=controller guide.controller.of=my_package:PID
  coil-compare env=pendulum tune='{gain: [0.1, 10, log]}'  would tuning the rule do it?

minutes=2       that it may take, about; the forecast is printed first
folder=FOLDER   for everything that is written; the same command with it goes on after a stop
seed=0          of the first trainings; the others have the next one
tune='{...}'    bounds of numbers of the guide, as of method=tune

All other arguments are those of coil-train, but for what is compared: method and learner. See
docs/compare.md.
"""

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

import coil_rl.config.schema  # noqa: F401  the types that the configurations begin with
from coil_rl.config.compose import compose_train, quoted
from coil_rl.config.messages import sentence
from coil_rl.config.trust import trust_packages
from coil_rl.errors import UserError
from coil_rl.programs import app, folders

CONFIG_DIR = ("--config-dir", "-cd")  # of Hydra: a folder with YAML files of the user
NUMBERS: dict[str, type[float] | type[int]] = {"minutes": float, "seed": int}
OWN = (*NUMBERS, "folder", "tune")  # arguments that coil-train does not have


def compare(arguments: Sequence[str]) -> None:
    """Compare as the arguments of the program say.

    Args:
        arguments: of the command line.
    """
    own, words = _split(arguments)
    folder = folders.folder(own["folder"]) if "folder" in own else None
    numbers: dict[str, Any] = {key: _number(key, own[key]) for key in own.keys() & NUMBERS.keys()}
    # Mistakes, in a moment.
    composed = compose_train([*words, "method=coil_anchored", "run_dir=unused"])
    # They import PyTorch, which takes seconds.
    from coil_rl.comparison.compare import Comparison
    from coil_rl.config.python import Named, new_folder

    nodes: dict[str, Any] = {}
    if "tune" in own:
        nodes["tune"] = _value("tune", own["tune"])
    trust_packages(composed.trust)
    place = new_folder("compare") if folder is None else folder
    others = [argument for argument in arguments if not argument.startswith("folder=")]
    command = shlex.join(["coil-compare", *others, f"folder={place}"])
    comparison = Comparison(Named(words, nodes), place, command=command, **numbers)
    try:
        comparison.run()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"continue with: {command}") from None


def _split(arguments: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the arguments of this program by name, and the words of `coil-train`."""
    own: dict[str, str] = {}
    words = []
    rest = iter(arguments)
    for argument in rest:
        key, equals, value = argument.partition("=")
        if key in CONFIG_DIR:
            place = Path(value or next(rest, "")).expanduser().absolute()
            if not place.is_dir():
                raise UserError(f"{key}: {place} is no folder; give one with YAML files")
            words.append(f"hydra.searchpath=[{quoted(f'file://{place}')}]")
            continue
        if argument.startswith("-"):
            raise UserError(f"{argument} is no argument of coil-compare; give KEY=VALUE")
        if key in OWN:
            if not equals or not value:
                raise UserError(f"{argument}: give {key}=VALUE")
            own[key] = value
        else:
            words.append(folders.spelled(argument))
    return own, words


def _number(key: str, text: str) -> float:
    """Return a number of the command line."""
    try:
        return NUMBERS[key](text)
    except ValueError as error:
        kind = "a whole number" if NUMBERS[key] is int else "a number"
        raise UserError(f"{key}={text} must be {kind}") from error


def _value(key: str, text: str) -> Any:
    """Return the value of an argument, as Hydra reads it."""
    try:
        return OverridesParser.create().parse_override(f"{key}={text}").value()
    except HydraException as error:
        raise UserError(f"{key}={text}: {sentence(error)}") from error


main = partial(app.plain_program, "compare", __doc__.rstrip(), compare)

if __name__ == "__main__":
    main()
