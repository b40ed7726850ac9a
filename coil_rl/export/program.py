"""`coil-export`: write the policy of a run as ONNX and torch.export, with its contract."""

from __future__ import annotations

import shlex
from functools import partial
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.programs import app


def export(config: DictConfig) -> None:
    """Export the policy of a run, and print what to type next."""
    from coil_rl.config.python import open_run
    from coil_rl.export import export_policy

    meanings: Any = OmegaConf.to_container(config.meanings, resolve=True)
    exported = export_policy(
        open_run(config.run, device=config.device),
        config.run_dir,
        which=config.policy,
        observations=config.observations,
        seed=config.seed,
        meanings=meanings,
    )
    guide = exported.contract["guide"]["place"]
    size = exported.contract["files"][exported.file.name]["bytes"] / 1000
    print(f"export: {exported.file} has {size:.0f} kB; guide {guide}; see {config.run_dir}")
    drive = f"on the machine: {config.run_dir}/drive.py, with numpy and onnxruntime alone"
    print(f"Next: {next_step(config, guide)} | {drive}")


def next_step(config: DictConfig, guide: str) -> str:
    """Return the command that evaluates an export; for a guide outside, a Python expression.

    Args:
        config: of the program.
        guide: its place, "inside", "outside" or "absent".
    """
    from coil_rl.run.stopping import command_of

    folder = str(config.run_dir)
    if guide == "outside":
        return f"coil_rl.ExportedPolicy({folder!r}).act(observation, guide_action) in Python"
    command = command_of("coil-evaluate", "run", config.run, config.trust)
    return f"{command} {shlex.quote(f'exported={folder}')}"


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl.envs.meanings import meaning
    from coil_rl.errors import UserError

    values: Any = OmegaConf.to_container(config.meanings, resolve=True)
    try:
        for name, value in values.items():
            meaning(str(name), value)
    except ValueError as error:
        raise UserError(str(error)) from error


main = partial(app.run_program, export, "export", check)

if __name__ == "__main__":
    main()
