"""`coil-evaluate`: evaluate the policy of a run beside its guides, or guides alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from coil_rl.errors import UserError
from coil_rl.programs import app

# Keys that have an effect on the evaluation of a run, and on that of guides alone.
OF_BOTH = ("run", "exported", "track", "disturb", "degrade", "evaluation")
OF_NO_TRAINING = ("env.info", "env.workers")  # no number of a training depends on them
OF_A_RUN = (*OF_BOTH, "beside", *OF_NO_TRAINING)
OF_GUIDES = ("preset", "env", "guide", *OF_BOTH)
# Keys of `evaluation` of the command, not of the run.
OWN = ("repeats", "policy", "advice", "beside")
OF_A_TRACK = ("cases", "env", "pictures", "sections")  # those that depend on `track`
# Keys of `evaluation` that only a training reads, and those that only a policy with actions to
# sample or advice to listen to has.
OF_TRAINING = ("evaluation.curve", "evaluation.guides")
OF_AN_AGENT = tuple(f"evaluation.{key}" for key in OWN)


def evaluate(config: DictConfig) -> float:
    """Evaluate a run or guides; return the mean reward of the deterministic policy."""
    from coil_rl.config.assemble import assemble, trial
    from coil_rl.config.folder import run_folder
    from coil_rl.config.parts import env_maker
    from coil_rl.run.judge import judge, report_outcome

    results = Path(config.run_dir)
    alone = config
    if config.run is not None:
        alone = configured(run_folder(config.run), config)
    if config.exported is not None:
        alone = with_exported(alone, config.exported)
    if config.run is None or config.exported is not None:
        judge(trial(alone, env_maker(alone)), None, results, config.seed)
    else:
        run = assemble(alone)
        run.judge(run.trial, results, config.seed)
    return report_outcome(results)


def with_exported(config: DictConfig, file: str) -> DictConfig:
    """Return the configuration of a run in which an exported policy is a guide that acts alone.

    Args:
        file: of the exported policy, or its folder.

    Raises:
        UserError: for a file that cannot be used, or a policy whose guide is outside.
    """
    from coil_rl.config.check import check_guide_in_env
    from coil_rl.config.nodes import build
    from coil_rl.config.parts import env_maker
    from coil_rl.run.parts import SOME_ROWS, TEST

    target = {"_target_": "coil_rl.export.ExportedGuide", "file": str(file)}
    guide = build(target, "exported")
    alone = config.copy()
    with open_dict(alone):
        alone.guide["exported"] = target
        # Degraded advice is not a part of a policy that acts.
        alone.degrade, alone.action = {}, {}
        alone.method.name, alone.method.observes, alone.method.transforms = "guide", None, {}
    check_guide_in_env(guide, env_maker(alone).bare(SOME_ROWS, TEST, None), "exported")
    return alone


def configured(folder: Path, requested: DictConfig) -> DictConfig:
    """Return the configuration of a run with the requested evaluation.

    Everything is as in the run but for what the command line gives.

    Raises:
        UserError: for a folder without a run, one without tracks although tracks are given, or an
            env that does not write what is measured.
    """
    from coil_rl.config.check import check_measures
    from coil_rl.config.compose import check_values
    from coil_rl.config.folder import read_config
    from coil_rl.config.parts import env_maker
    from coil_rl.run.parts import SOME_ROWS, TEST

    config = read_config(folder, "run", {"device": requested.device})
    resolved: Any = OmegaConf.to_container(requested, resolve=True)
    _check_advice(config, resolved, folder)
    own: Any = OmegaConf.to_container(config.evaluation.advice, resolve=True)
    # The advice of the training is evaluated too.
    resolved["evaluation"]["advice"] = own | resolved["evaluation"]["advice"] | resolved["degrade"]
    values = OmegaConf.create(resolved["evaluation"])
    changed = _changed(config, resolved, folder)
    for key in changed:
        value = OmegaConf.select(values, key)
        OmegaConf.update(config.evaluation, key, value, merge=False, force_add=True)
    if "gif" in changed:  # what refers to it in the files has its value in a folder
        for node in filter(None, (config.evaluation.env, *config.evaluation.pictures.values())):
            node.update({name: values.gif for name in node.keys() & {"render", "active", "gif"}})
    if "cases" in config.evaluation.env:  # an env whose cases are numbered seeds
        config.evaluation.env["cases"] = config.evaluation.cases
    check_values(config)
    if config.method.observes is not None:
        check_measures(config.evaluation.measures, env_maker(config)(SOME_ROWS, TEST))
    return config


def _check_advice(config: DictConfig, resolved: Mapping[str, Any], folder: Path) -> None:
    """Raise a `UserError` if degraded advice is asked for, but the policy has no advice."""
    from coil_rl.config.parts import advises

    if advises(config):
        return
    asked = {"degrade": resolved["degrade"], "evaluation.advice": resolved["evaluation"]["advice"]}
    for key, nodes in asked.items():
        if nodes:
            names = ",".join(map(str, nodes))
            raise UserError(
                f"{key}=[{names}] has no effect: the policy of run={folder} has no advice; leave "
                "it out"
            )


def _changed(config: DictConfig, resolved: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the keys of `evaluation` that the command line changes.

    The tracks and the disturbances that it gives are set.
    """
    changed = list(OWN)
    overrides = app.overrides() if HydraConfig.initialized() else []
    chooses_tracks = any(key == "track" for key, _ in overrides)
    for key, text in overrides:
        if key.partition(".")[0] == "track":
            if not config.track:
                raise UserError(f"{text} has no effect: run={folder} has no tracks; leave it out")
            if not chooses_tracks:
                raise UserError(
                    f"{text} has no effect alone: run={folder} has its own tracks; choose others "
                    "by track=NAME, or leave it out"
                )
            config.track = resolved["track"]
            changed += OF_A_TRACK
        elif key.partition(".")[0] == "disturb":
            config.disturb = resolved["disturb"]
            changed.append("disturb")
        elif key in OF_NO_TRAINING:
            name = key.removeprefix("env.")
            if name not in config.env:
                target = config.env["_target_"].rpartition(".")[2]
                raise UserError(f"{text} has no effect on {target}, the env of run={folder}")
            value = resolved["env"][name]
            if isinstance(value, list):  # beside the entries that the policy may observe
                value = [*dict.fromkeys([*config.env[name], *value])]
            config.env[name] = value
        elif key.startswith("evaluation."):
            changed.append(key.removeprefix("evaluation."))
    return changed


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    given = config.run is not None
    if config.exported is not None and not given:
        raise UserError(
            f"exported={config.exported} needs the run whose env it is evaluated in: run=RUN; or "
            f"name an env and guide=exported guide.exported.file={config.exported}"
        )
    reason = (
        f"run={config.run} has its own configuration (for another env +evaluation.env.KEY=VALUE)"
        if given
        else "a guide is evaluated without an agent"
    )
    app.check_used(OF_A_RUN if given else OF_GUIDES, reason)
    app.check_unused(OF_TRAINING, "only a training reads it")
    app.check_unused(("evaluation.sections",), "only coil-listen reads it")
    if config.exported is not None:
        alone = "the exported policy acts alone, as it is in its file"
        app.check_unused((*OF_AN_AGENT, "degrade"), alone)
    elif not given:
        app.check_unused(OF_AN_AGENT, reason)
    from coil_rl.config import check as checks  # torch, which a wrong word does not wait for

    checks.check(config)


main = partial(app.run_program, evaluate, "evaluate", check)

if __name__ == "__main__":
    main()
