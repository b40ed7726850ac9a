"""Runs from Python: the words of the command line as arguments.

Where a name is not enough, an object may be given.
"""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import gymnasium
from omegaconf import DictConfig, OmegaConf, open_dict
from torchrl.envs import EnvBase

from coil_rl.config.assemble import assemble
from coil_rl.config.check import check, check_read
from coil_rl.config.compose import Composed, compose_with_files, default_learner, quoted
from coil_rl.config.folder import PREFIX, make_folder, read_config, run_folder
from coil_rl.config.messages import naming_files
from coil_rl.config.nodes import give, import_path, keep
from coil_rl.config.schema import method_for, shipped
from coil_rl.config.trust import trust_own, trust_packages
from coil_rl.errors import UserError
from coil_rl.foreign.faults import foreign
from coil_rl.run.controller import Controller
from coil_rl.run.run import Run, as_before

Words = tuple[list[str], dict[str, Any]]  # of the command line, and nodes for objects by their key


@as_before()
def train(
    env: Any,
    *,
    guide: Any = None,
    method: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    tune: Mapping[str, Any] | str | None = None,
    overrides: Sequence[str] = (),
) -> Run:
    """Train a policy, evaluate it beside its guide, and return the run.

    Args:
        env: the id of a Gymnasium env, such as "CartPole-v1" or "PACKAGE:ID"; the name of a file in
            conf/env, such as "cone_track"; or a class or function that makes a Gymnasium env, or a
            TorchRL env without batch.
        guide: a class or a `functools.partial` of one, an object with `act(observation)`, a
            function, a network; the import path "PACKAGE.MODULE:NAME" of one; the name of a file in
            conf/guide, such as "spline"; a `Controller` of another run; or None.
        method: name of a file in conf/method; by default "coil_anchored" with a guide, "ppo"
            without one. In both cases SAC is the learner where actions are numbers, unless
            `overrides` names one, such as "learner=ppo".
        frames: length of the run; by default 100,000 of SAC, else those of the env's file.
        seed: of everything.
        folder: for everything that the run writes; by default a new one in outputs/train.
        tune: of method="tune": bounds of numbers of the guide by name, [low, high] or [low, high,
            "log"]; "auto" for those that the guide knows.
        overrides: further words of the command line, such as "learner.gamma=0.98".

    Raises:
        UserError: for a mistake in an argument, with one sentence that says what to do.
        ValueError: for what the env or the guide raises, or returns that does not fit.

    Example:
        >>> import coil_rl
        >>> run = coil_rl.train("CartPole-v1", frames=50_000)  # doctest: +SKIP
        >>> table = run.evaluate(cases=50)  # doctest: +SKIP
    """
    folder = Path(folder).expanduser() if folder is not None else new_folder("train")
    run = prepare(
        env,
        guide=guide,
        method=method,
        frames=frames,
        seed=seed,
        folder=folder,
        tune=tune,
        overrides=overrides,
    )
    return run.train()


def prepare(
    env: Any,
    *,
    guide: Any = None,
    method: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    folder: str | Path,
    tune: Mapping[str, Any] | str | None = None,
    overrides: Sequence[str] = (),
) -> Run:
    """Return a run that is checked and ready to train.

    Args:
        env: as for `train`.
        guide: as for `train`.
        method: as for `train`.
        frames: as for `train`.
        seed: as for `train`.
        folder: as for `train`.
        tune: as for `train`.
        overrides: as for `train`.

    Raises:
        UserError: for a mistake in an argument.
    """
    folder = Path(folder).absolute()
    given = named(env, guide, str(folder))
    words = [*given.words, *([] if method is None else [f"method={method}"])]
    words += [] if frames is None else [f"budget.frames={frames}"]
    words += default_learner(
        [*words, *overrides], lambda of_env: composed(Named(of_env, given.nodes), folder).config
    )
    if method is None:
        words.append(f"method={method_for(guide)}")
    if tune is not None:
        given.nodes["tune"] = tune if isinstance(tune, str) else dict(tune)
    words += [f"seed={seed}", *overrides]
    run = prepared(Named(words, given.nodes), folder)
    run.in_python = True
    return run


@dataclass(frozen=True)
class Named:
    """What chooses an env and a guide, and everything else.

    Args:
        words: of the command line.
        nodes: for objects that have no name, by their key.
        shared: whether other runs have the same words, so that this one need not read all of them.
    """

    words: list[str]
    nodes: dict[str, Any]
    shared: bool = False


def named(env: Any, guide: Any, place: str) -> Named:
    """Return what chooses an env and a guide.

    Args:
        env: as for `train`.
        guide: as for `train`.
        place: under which objects without a name are kept.

    Raises:
        UserError: for something that is no env or guide.
    """
    env_words, env_nodes = _env(env, f"{place}#env")
    guide_words, guide_nodes = _guide(guide, f"{place}#guide")
    return Named([*env_words, *guide_words], env_nodes | guide_nodes)


def prepared(given: Named, folder: str | Path) -> Run:
    """Return a run that is checked and ready to train.

    Raises:
        UserError: for a mistake.
    """
    made = composed(given, folder)
    trust_own(made.config)
    config = checked(made)
    if not given.shared:
        check_read(config, given.words)
    make_folder(Path(config.run_dir))
    run = assemble(config)
    run.command = ["coil-train", *given.words]
    return run


def composed(given: Named, folder: str | Path) -> Composed:
    """Return the configuration of a run.

    Raises:
        UserError: for words that do not fit.
    """
    made = compose_with_files([*given.words, f"run_dir={quoted(str(folder))}"])
    with open_dict(made.config):
        for place, node in given.nodes.items():
            OmegaConf.update(made.config, place, node, merge=False, force_add=True)
    return made


def checked(made: Composed) -> DictConfig:
    """Check a configuration, and return it.

    Raises:
        UserError: for a mistake; the sentence on an unknown argument names the file that gives it.
    """
    with naming_files(made.files):
        check(made.config)
    return made.config


def new_folder(program: str) -> Path:
    """Return a new folder in the outputs of a program."""
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")
    return Path("outputs", program, f"{now}_{os.getpid()}")


def _env(env: Any, name: str) -> Words:
    """Return what chooses an env; an object is kept under a name."""
    if isinstance(env, str):
        return ([f"env={env}"] if env in shipped("env") else _gym_words(env)), {}
    if not callable(env):
        raise UserError(
            f"env is {type(env).__name__}; give the id of a Gymnasium env, the name of a file in "
            "conf/env, or a class or function that makes an env; a Run is trained by its train()"
        )
    path = import_path(env)
    with foreign(f"the env {path or getattr(env, '__name__', 'of the maker')}", "its maker"):
        made = env()
    with suppress(Exception):  # nothing depends on it
        made.close()
    if isinstance(made, gymnasium.Env):
        if path is not None:
            return _gym_words(path), {}
        return _gym_words("given"), {"env.id": keep(name, env)}
    if isinstance(made, EnvBase) and not made.batch_size:
        words = ["env=torchrl", f"env.of._target_={(path or 'given').replace(':', '.')}"]
        return words, {} if path is not None else {"env.of": keep(name, env)}
    raise UserError(
        f"env makes {type(made).__name__}; give a maker of a Gymnasium env, or of a TorchRL env "
        "without batch (a batched one of your own needs a file, see docs/your_env_reference.md)"
    )


def _gym_words(env: str) -> list[str]:
    return ["env=gym", f"env.id={quoted(env)}"]


def _guide(guide: Any, name: str) -> Words:
    """Return what chooses a guide; an object is kept under a name."""
    if guide is None:
        return [], {}
    if isinstance(guide, str) and ":" not in guide:
        return [f"guide={guide}"], {}
    if isinstance(guide, Controller):
        if guide.folder is None:
            raise UserError("guide: this controller has no run; give one of coil_rl.open_run")
        words = [f"run={quoted(str(guide.folder))}", f"which={guide.which}"]
        return ["guide=learned", *(f"guide.learned.{word}" for word in words)], {}
    path = guide if isinstance(guide, str) else import_path(guide)
    words = ["guide=controller", f"guide.controller.of={quoted(path or 'given')}"]
    return words, {} if path is not None else {"guide.controller.of": keep(name, guide)}


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
    run = assemble(config)
    run.in_python = True
    return run


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
