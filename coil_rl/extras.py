"""Packages that only some parts need: an extra of coil-rl installs them."""

from importlib.util import find_spec

from coil_rl.errors import UserError


def require(what: str, extra: str, *modules: str) -> None:
    """Raise a `UserError` that says what to install, if a module is missing."""
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise UserError(
            f"{what} needs {', '.join(missing)}: python -m pip install 'coil-rl[{extra}]'"
        )
