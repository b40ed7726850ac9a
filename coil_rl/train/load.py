"""Policies and guides of finished runs."""

from pathlib import Path

from omegaconf import DictConfig
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.errors import UserError
from coil_rl.train import checkpoint
from coil_rl.train.build import (
    add_transforms,
    build_env,
    build_guides,
    build_learner,
    trains_guides,
)
from coil_rl.train.run_folder import read_config

PROXIES = "proxies"  # subfolder with the networks that replace guides without parameters


def load_policy(
    folder: Path, config: DictConfig, env: EnvBase, which: str = "last"
) -> TensorDictModuleBase:
    """Return the policy of a run, `last` or `best` (of the kept ones, in the cases of selection).

    The env has the transforms of the run. A policy that is missing or does not fit the
    configuration is a `UserError`.
    """
    learner = build_learner(
        config, env, load_guides(folder, config) if trains_guides(config) else None
    )
    path = weights_file(folder, which)
    state = checkpoint.load(path, config.device)
    try:
        learner.policy.load_state_dict(state)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, AttributeError) as error:
        networks = f"the networks in {folder / 'config.yaml'}"
        raise UserError(
            f"{path} does not fit {networks}; one of them was changed after the run"
        ) from error
    policy: TensorDictModuleBase = learner.policy
    if not all(parameter.isfinite().all() for parameter in policy.parameters()):
        raise UserError(
            f"{path} holds weights that are NaN or infinite; train again or use another"
        )
    return policy


def memory_keys(policy: TensorDictModuleBase) -> list[NestedKey]:
    """Return the entries that a policy writes for its next step, `("next", ...)`; none without a memory."""
    return [key for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]


def weights_file(folder: Path, which: str = "last") -> Path:
    """Return the file with the weights of the `last` or `best` policy of a run."""
    return folder / f"policy_{which}.pt"


def load_policy_in_env(
    folder: Path, config: DictConfig, env: EnvBase, which: str = "last"
) -> tuple[EnvBase, TensorDictModuleBase]:
    """Return any env with the guides and transforms of a run, and the policy of the run.

    The own env and tracks of the run are not built. Arguments and errors are those of
    `load_policy`; a run without an agent, or with one that cannot act in this env, is a `UserError`
    too.
    """
    if config.method.observes is None:
        raise UserError(f"{folder} has no agent: its guide drives alone; give that guide instead")
    try:
        transformed = add_transforms(config, env)
        return transformed, load_policy(folder, config, transformed, which)
    except UserError as error:
        raise UserError(f"run {folder}: {error}") from error


def load_guides(folder: Path, config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """Return the initial guides of a run that trains its guides: the proxy of a guide if there is one."""
    guides = build_guides(config)
    for name in guides:
        proxy = folder / PROXIES / name
        if proxy.exists():
            proxy_config = read_config(
                proxy, f"the proxy of guide.{name}", {"device": config.device}
            )
            if trains_guides(proxy_config):
                raise UserError(
                    f"{proxy} trains guides itself, but a proxy imitates one; train the run again"
                )
            guides[name] = load_policy(proxy, proxy_config, build_env(proxy_config))
    return guides
