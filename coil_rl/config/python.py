"""Runs from Python: the words of the command line as arguments.

Where a name is not enough, an object may be given.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from torchrl.envs import EnvBase

from coil_rl.config.build import assemble
from coil_rl.config.check import check_parts, make_folder
from coil_rl.config.default_method import method_for
from coil_rl.config.given import import_path, keep
from coil_rl.config.guest_files import packages
from coil_rl.config.sentences import sentence
from coil_rl.config.trust import trust_own
from coil_rl.config.unread import check_read
from coil_rl.config.written import keep_written, quoted
from coil_rl.errors import UserError
from coil_rl.foreign.faults import foreign
from coil_rl.run.controller import Controller
from coil_rl.run.run import Run


def train(
    env: Any,
    *,
    guide: Any = None,
    method: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    tune: Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
) -> Run:
    """Train a policy, evaluate it beside its guide, and return the run.

    Args:
        env: the id of a Gymnasium env, such as "CartPole-v1" or "PACKAGE:ID"; the name of a file in
            conf/env, such as "cone_track"; a class or function that makes a Gymnasium env, or a
            TorchRL env without batch; or a `Run`, which is trained as it is: of the other arguments
            it takes `frames` alone.
        guide: a class or a `functools.partial` of one, an object with `act(observation)`, a
            function, a network; the import path "PACKAGE.MODULE:NAME" of one; the name of a file in
            conf/guide, such as "spline"; a `Controller` of another run; or None.
        method: name of a file in conf/method; by default "coil_anchored" with a guide, "ppo"
            without one.
        frames: length of the run; by default that of the env's file.
        seed: of everything.
        folder: for everything that the run writes; by default a new one in outputs/train.
        tune: of method="tune": bounds of numbers of the guide by name, [low, high] or [low, high,
            "log"].
        overrides: further words of the command line, such as "learner.gamma=0.98".

    Raises:
        UserError: for a mistake in an argument, with one sentence that says what to do.
        ValueError: for what the env or the guide raises, or returns that does not fit.

    Example:
        >>> import coil_rl
        >>> run = coil_rl.train("CartPole-v1", frames=50_000)  # doctest: +SKIP
        >>> table = run.evaluate(cases=50)  # doctest: +SKIP
    """
    if isinstance(env, Run):
        _refuse_others(guide, method, seed, folder, tune, overrides)
        return env.train(frames)
    folder = Path(folder).expanduser() if folder is not None else _new_folder()
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


def _refuse_others(
    guide: Any, method: Any, seed: int, folder: Any, tune: Any, overrides: Sequence[str]
) -> None:
    """Refuse arguments of `train` that say what a `Run` consists of, which it knows itself."""
    objects = {"guide": guide, "method": method, "folder": folder, "tune": tune}
    names = [name for name, value in objects.items() if value is not None]
    names += ["seed"] if seed != 0 else []
    names += ["overrides"] if overrides else []
    if names:
        raise UserError(
            f"{', '.join(names)}: a Run is trained as it is, with other frames at most; leave out "
            "what it has already, or give the env instead of the run"
        )


def prepare(
    env: Any,
    *,
    guide: Any = None,
    method: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    folder: str | Path,
    tune: Mapping[str, Any] | None = None,
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
    given = named(env, guide, str(folder))
    words = list(given.words)
    words.append(f"method={method or method_for(guide)}")
    if frames is not None:
        words.append(f"budget.frames={frames}")
    if tune is not None:
        given.nodes["tune"] = dict(tune)
    words += [f"seed={seed}", *overrides]
    return prepared(Named(words, given.nodes), folder)


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

    Args:
        given: everything that it consists of.
        folder: of the run.

    Raises:
        UserError: for a mistake.
    """
    config = composed(given, folder)
    trust_own(config)
    check_parts(config)
    if not given.shared:
        check_read(config, given.words)
    make_folder(Path(config.run_dir))
    run = assemble(config)
    run.command = ["coil-train", *given.words]
    return run


def composed(given: Named, folder: str | Path) -> DictConfig:
    """Return the configuration of a run.

    Args:
        given: everything that it consists of.
        folder: of the run.

    Raises:
        UserError: for words that do not fit.
    """
    config = compose_train([*given.words, f"run_dir={quoted(str(folder))}"])
    with open_dict(config):
        for place, node in given.nodes.items():
            OmegaConf.update(config, place, node, merge=False, force_add=True)
    return config


def _new_folder() -> Path:
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")
    return Path("outputs", "train", f"{now}_{os.getpid()}")


def compose_train(words: Sequence[str], *, with_hydra: bool = False) -> DictConfig:
    """Return the configuration that `coil-train` composes from the words of its command line.

    Args:
        words: such as "method=coil" and "+experiment=placebo". YAML files of another package are
            found with "hydra.searchpath=[pkg://PACKAGE.conf]".
        with_hydra: whether the configuration has Hydra's own part, such as the folders of a sweep.

    Raises:
        UserError: for words that do not fit the configuration, with one sentence.
    """
    try:
        with _own_hydra():
            config = compose("train", list(words), return_hydra_config=with_hydra)
            task = [word for word in words if not word.startswith("hydra.")]
            keep_written(config, "train", task, [w for w in words if w not in task])
            return config
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(sentence(error)) from error


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Compose files of this package in the block.

    This works inside a program of Hydra with its own files, too.
    """
    program = GlobalHydra.instance()
    outer = program.hydra
    program.clear()
    try:
        with initialize_config_module("coil_rl.conf", version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = outer


def _shipped(group: str) -> set[str]:
    """Return the names of the files of coil-rl and of its guests in a group."""
    folders = [resources.files(package) / group for package in packages()]
    files = [file for folder in folders if folder.is_dir() for file in folder.iterdir()]
    return {file.name.removesuffix(".yaml") for file in files}


Words = tuple[list[str], dict[str, Any]]  # of the command line, and nodes for objects by their key


def _env(env: Any, name: str) -> Words:
    """Return what chooses an env; an object is kept under a name."""
    if isinstance(env, str):
        return ([f"env={env}"] if env in _shipped("env") else _gym_words(env)), {}
    if not callable(env):
        raise UserError(
            f"env is {type(env).__name__}; give the id of a Gymnasium env, the name of a file in "
            "conf/env, or a class or function that makes an env"
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
        "without batch (a batched one of your own needs a file, see docs/your_env.md)"
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
