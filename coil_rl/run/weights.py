"""Putting the weights of a file into a policy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.run import checkpoint


def load_weights(policy: TensorDictModuleBase, path: Path, device: str = "cpu") -> None:
    """Load the weights of a file into a policy.

    Raises:
        UserError: if the file is missing or damaged, does not fit the policy, or holds weights that
            are not finite.
    """
    put_weights(policy, checkpoint.load(path, device), path)


def put_weights(policy: TensorDictModuleBase, state: Any, path: Path) -> None:
    """Put the weights that were read from a file into a policy.

    Raises:
        UserError: if they do not fit the policy, or are not finite.
    """
    own = policy.state_dict()
    for name, value in state.items() if isinstance(state, Mapping) else ():
        known = own.get(name)
        both = isinstance(value, Tensor) and isinstance(known, Tensor)
        if both and value.dtype != known.dtype:  # torch would make another policy of them
            raise UserError(
                f"{path} holds {name} as {value.dtype}, not {known.dtype}, so that it is no policy "
                "of this run; train again or use another"
            )
    try:
        policy.load_state_dict(state)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} does not fit the networks in {path.parent / 'config.yaml'}; one of them was "
            "changed after the run"
        ) from error
    if not all(parameter.isfinite().all() for parameter in policy.parameters()):
        raise UserError(
            f"{path} holds weights that are NaN or infinite; train again or use another"
        )
