"""The policy of a finished run as a guide."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import ExplorationType, TensorDictPrimer, set_exploration_type

from coil_rl.config.assemble import assemble
from coil_rl.config.folder import read_config, run_folder
from coil_rl.errors import UserError
from coil_rl.run.parts import TRAIN
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace, OwnChoices, space_of
from coil_rl.transforms.chain import Chain, links_of
from coil_rl.transforms.guide_memory import primer_of
from coil_rl.transforms.hosted import HostedGuide

LONGEST_CHAIN = 4  # learned guides of learned guides
# Number of runs that are being loaded, each of which is a guide of the one before.
_DEPTH: ContextVar[int] = ContextVar("depth", default=0)


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
            opened = assemble(config, self.folder)
            # The transforms need the specs of an env; some need at least two rows.
            env = opened.make_env.around(opened.make_env.bare(2, TRAIN, None)).eval()
            policy = opened.load_policy(env, which)
        self.chain = Chain(env, policy, links_of(env.transform, tensors=True))
        self.space = space_of(env.base_env, env.base_env.action_key)
        guides = [each for each in self.chain.links if isinstance(each, GuideActions)]
        inner = [guide for each in guides for guide in each.guides.guides.values()]
        self.by_row = any(isinstance(guide, HostedGuide) and guide.by_row for guide in inner)
        first = self.chain.first(TensorDict({}, [1], device=env.device))
        self.memory = {f"learned_{n}": at for n, at in enumerate(self.chain.remembered(first))}
        self.start = {name: first[n][key][0] for name, (n, key) in self.memory.items()}
        supplied = {key for each in guides for key in each.supplied}
        self.in_keys = [*self.chain.reads, *supplied.intersection(["row"]), *self.memory]
        self.out_keys: list[NestedKey] = ["action", *(("next", name) for name in self.memory)]
        self.requires_grad_(False)
        self.eval()

    def meet(self, space: ActionSpace, choices: OwnChoices) -> None:
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
