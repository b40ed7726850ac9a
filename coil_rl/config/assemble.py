"""From a configuration to a run, new or begun before."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, TensorDictPrimer, set_exploration_type

from coil_rl.config.folder import holds, identity, read_config, run_folder, settings
from coil_rl.config.nodes import build, code_of_run
from coil_rl.config.parts import (
    PROXIES,
    advises,
    advises_only,
    build_beside,
    build_evaluation,
    build_guides,
    build_learner,
    build_pictures,
    distil,
    driving_guides,
    env_maker,
    of_guides,
    own_run,
    recorded,
    trains_guides,
)
from coil_rl.config.trust import to_trust
from coil_rl.errors import UserError
from coil_rl.learners.learner import Learner
from coil_rl.run.curve import GuideReturns
from coil_rl.run.folder import locked
from coil_rl.run.judge import Trial, guide_titles
from coil_rl.run.parts import TRAIN, EnvMaker
from coil_rl.run.reasons import about_returns
from coil_rl.run.run import Budget, Run
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace, OwnForms, space_of
from coil_rl.transforms.chain import Chain, links_of
from coil_rl.transforms.guide_memory import primer_of
from coil_rl.transforms.hosted import HostedGuide
from coil_rl.transforms.normalised_action import in_unit_of

LONGEST_CHAIN = 4  # learned guides of learned guides
# Number of runs that are being loaded, each of which is a guide of the one before.
_DEPTH: ContextVar[int] = ContextVar("depth", default=0)


def assemble(config: DictConfig) -> Run:
    """Return the run that a configuration describes; its envs and learner are built when used.

    Args:
        config: of `coil-train`, composed or read from a folder.
    """
    folder = Path(config.run_dir)
    make_env = env_maker(config)
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
        run = assemble(proxy_config)
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


class LearnedGuide(HostedGuide):
    """Deterministic action of a trained policy, with the guides and action transforms of its run.

    All rows act at once. What the policy, its guides and its transforms remember is the memory of
    the guide, as entries of the data.

    Args:
        run: folder of a run of `coil-train`, or `pretrained:NAME`.
        which: the policy that the run hands over, or the last one.
        device: of the networks.

    Raises:
        UserError: if the folder holds no finished run, or one that is its own guide.
        ValueError: if the run has no policy (method=guide).
    """

    def __init__(
        self,
        run: str,
        which: Literal["handed_over", "last"] = "handed_over",
        device: str = "cpu",
    ) -> None:
        super().__init__()
        self.folder = run_folder(run)
        config = read_config(self.folder, "run", {"device": device})
        if config.method.observes is None:
            raise ValueError(
                f"{self.folder} trained no agent: its method is {config.method.name}; name its "
                "guide instead"
            )
        with _guarded(self.folder):
            opened = assemble(config)
            # The transforms need the specs of an env; some need at least two rows.
            env = opened.make_env.around(opened.make_env.bare(2, TRAIN, None)).eval()
            policy = opened.policy(env, which)
        self.chain = Chain(env, policy, links_of(env.transform, tensors=True))
        self.space = space_of(env.base_env, env.base_env.action_key)
        guides = [each for each in self.chain.links if isinstance(each, GuideActions)]
        inner = [guide for each in guides for guide in each.guides.guides.values()]
        self.by_row = any(isinstance(guide, HostedGuide) and guide.by_row for guide in inner)
        first = self.chain.first(TensorDict({}, [1], device=env.device))
        self.memory = {f"learned_{n}": at for n, at in enumerate(self.chain.remembered(first))}
        self.start = {name: first[link][key][0] for name, (link, key) in self.memory.items()}
        supplied = {key for each in guides for key in each.supplied}
        self.in_keys = [*self.chain.reads, *supplied.intersection(["row"]), *self.memory]
        self.out_keys: list[NestedKey] = ["action", *(("next", name) for name in self.memory)]
        self.requires_grad_(False)
        self.eval()

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Check the action of an env.

        Raises:
            UserError: if the policy has another number of choices or other bounds, which may be in
                another unit.
        """
        if not self.space.range.same_as(space.range):
            raise UserError(
                f"run={self.folder} acts {self.space.range}, but the action of this env goes "
                f"{space.range}: give a run in an env with the same action, or convert it by a "
                "wrapper"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` as the env takes it, and what is remembered for the next step."""
        data = tensordict.select(*self.in_keys)
        past = self.chain.first(data)
        for name, (number, key) in self.memory.items():
            past[number][key] = data.pop(name)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data, past = self.chain(data, past)
        for name, (number, key) in self.memory.items():
            tensordict.set(("next", name), past[number][key])
        return tensordict.set("action", self.space.executed(data[self.chain.action_key]))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare what is remembered."""
        return primer_of(self.start)


@contextmanager
def _guarded(folder: Path) -> Iterator[None]:
    """Refuse a run that is its own guide, or too long a chain of learned guides."""
    depth = _DEPTH.get()
    if depth == LONGEST_CHAIN:
        raise UserError(
            f"run={folder} ends a chain of more than {LONGEST_CHAIN} learned guides, or is its own "
            "guide; give a run with a shorter chain"
        )
    token = _DEPTH.set(depth + 1)
    try:
        yield
    finally:
        _DEPTH.reset(token)


def make_logger(node: Any) -> Any:
    """Return the logger of a run.

    Raises:
        UserError: for whatever the logger raises, such as without a log-in or a server.
    """
    try:
        return build(node, "logger")
    except UserError:
        raise
    except Exception as error:
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise UserError(
            f"logger: {node['_target_']} could not be started ({reason}); correct the cause, or "
            "take logger=none"
        ) from error
