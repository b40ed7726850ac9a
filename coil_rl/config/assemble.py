"""From a configuration to a run, new or begun before."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.config.folder import holds, identity, read_config, run_folder, settings
from coil_rl.config.own_run import own_run
from coil_rl.config.parts import (
    advises,
    advises_only,
    build_beside,
    build_evaluation,
    build_guides,
    build_learner,
    build_pictures,
    driving_guides,
    env_maker,
    of_guides,
    recorded,
    trains_guides,
)
from coil_rl.config.proxies import PROXIES, distil
from coil_rl.config.source import code_of_run
from coil_rl.config.trust import make_logger, to_trust
from coil_rl.errors import UserError
from coil_rl.learners.learner import Learner
from coil_rl.measures import measures_of
from coil_rl.run.curve import GuideReturns
from coil_rl.run.folder import locked
from coil_rl.run.judge import Trial, guide_titles
from coil_rl.run.parts import EnvMaker
from coil_rl.run.reasons import about_returns
from coil_rl.run.run import Budget, Run
from coil_rl.transforms.normalised_action import in_unit_of


def assemble(config: DictConfig, folder: Path | None = None) -> Run:
    """Return the run that a configuration describes; nothing is built or written yet.

    Args:
        config: of `coil-train`, composed or read from a folder.
        folder: of the run, instead of `run_dir`.
    """
    folder = Path(config.run_dir) if folder is None else folder
    make_env = env_maker(config, folder)
    trains = trains_guides(config)

    def make_learner(env: EnvBase) -> Learner:
        return build_learner(config, env, load_guides(folder, config) if trains else None)

    def guide_returns(learner: Learner) -> list[GuideReturns]:
        each_phase = config.evaluation.guides == "phases"
        return [GuideReturns(make_env, learner.guides, each_phase=each_phase)] if trains else []

    run_of_proxy = partial(run_configured, wait=True)
    has_learner = config.method.observes is not None and config.method.learner != "none"
    own = own_run(config)
    make_run: Callable[..., Run] = Run if own is None else own.maker(config)
    return make_run(
        folder,
        make_env,
        make_learner if has_learner else None,
        partial(trial, config, make_env),
        budget(config),
        label=config.label,
        seed=config.seed,
        watch=OmegaConf.to_container(config.watch),
        failure=measures_of(config.evaluation.measures).get("crashed"),
        noise_correlation=config.training.noise_correlation,
        logger=partial(make_logger, config.logger) if config.logger else None,
        callbacks=guide_returns,
        prepare=partial(distil, config, folder, run_of_proxy) if trains else lambda: 0,
        init=run_folder(config.init) if config.init else None,
        delivery=config.delivery,
        which=config.evaluation.policy,
        beside=build_beside(config),
        compiled=config.compile,
        device=config.device,
        threads=config.threads,
        settings=settings(config),
        identity=identity(config),
        trust=to_trust(config),
        code=partial(code_of_run, config),
    )


def budget(config: DictConfig) -> Budget:
    """Return how much a run learns, and how often it looks at itself."""
    curve = config.evaluation.curve
    return Budget(
        frames=config.budget.frames,
        steps=config.budget.steps,
        stages=list(config.budget.stages),
        points=curve.points,
        batches=curve.batches,
        checkpoint_every=config.checkpoint_every,
    )


def trial(config: DictConfig, make_env: EnvMaker) -> Trial:
    """Return how the policy of a run is evaluated.

    Raises:
        UserError: if the configuration names no cases.
    """
    pictures = build_pictures(config)
    has_agent = config.method.observes is not None
    notes = [
        f"guide.{name} sees: {what}; it may know more than the agent."
        for name, what in of_guides(config, "sees").items()
    ]
    if has_agent:
        tested = OmegaConf.select(config, "delivery") == "tested"
        notes += about_returns(make_env.sizes, tested=tested)
    return Trial(
        OmegaConf.select(config, "label") or "",  # the programs without an agent have none
        build_evaluation(config, recorded(pictures)),
        make_env,
        pictures=pictures,
        guides=guide_titles(driving_guides(config)),
        together=has_agent
        and not config.method.run
        and advises_only(config)
        and not of_guides(config, "demonstrates"),
        advice=list(config.evaluation.advice) if advises(config) else [],
        repeats=config.evaluation.repeats,
        compiled=config.compile,
        notes=notes,
    )


def load_guides(folder: Path, config: DictConfig) -> Mapping[str, TensorDictModuleBase]:
    """Return the first guides of a run that trains its guides.

    The proxy of a guide takes its place, if there is one.
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


def run_configured(
    config: DictConfig,
    *,
    wait: bool = False,
    command: Sequence[str] = (),
) -> float:
    """Do a run, or finish it if `existing=resume`; return the mean test reward of its policy.

    Args:
        config: of `coil-train`, composed.
        wait: whether to wait for another process that uses the folder.
        command: what was typed, for the folder of the run.

    Raises:
        UserError: for a folder that holds another run, or that another process uses.
    """
    run = assemble(config)
    run.command = command
    folder = Path(config.run_dir)
    with locked(folder, wait=wait):
        if config.existing == "resume" and holds(folder, config):
            return run.finish_begun()
        run.begin()
        return run.finish()
