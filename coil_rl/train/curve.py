"""The evaluation curve of a run: the returns of policies that were kept during the training.

The return in training says little about a policy: its actions are sampled, and it is the mean of
the episodes that happen to end. The kept policies act deterministically, all of them in one batch,
each from the same starts (cases).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.train import checkpoint
from coil_rl.train.evaluation import Totals, episodes
from coil_rl.train.measures import Measure
from coil_rl.train.policy_batch import policy_batch

POLICIES = "policies"  # subfolder with the kept policies
Watch = Mapping[str, Mapping[str, Sequence[str]]]  # name to key, of "episode" and of "step"


@dataclass(eq=False)
class EvaluationCurve:
    """Evaluation of the kept policies of a run in sets of cases; `names` are those of the measures in the log."""

    folder: Path  # of the run; `keep` writes `policies/FRAMES.pt`
    policy: TensorDictModuleBase  # of the learner; a copy of it drives
    envs: Mapping[
        str, Callable[[int], EnvBase]
    ]  # makes an env with all cases of a set for a number of drivers
    _: KW_ONLY
    # Further measures, "episode" at the end of an episode, "step" as the mean over its steps.
    watch: Watch = field(default_factory=dict)
    points: int = 16  # number of policies that are kept, besides the first one
    # number of times that the policies kept since are driven; each takes as long as one drive
    batches: int = 1

    def __post_init__(self) -> None:
        measured = ["return", *(name for group in self.watch.values() for name in group)]
        self.names = [f"{cases}/{name}" for cases in self.envs for name in measured]

    def kept(self, updates: int) -> list[int]:
        """Return the updates of a run after which the policy is kept."""
        return sorted({round(updates * point / self.points) for point in range(self.points + 1)})

    def batch(self, update: int, updates: int) -> list[int]:
        """Return the updates whose policies are driven after an update, if any."""
        ends = sorted({round(updates * batch / self.batches) for batch in range(self.batches + 1)})
        if update not in ends[1:]:
            return []
        begin = ends[ends.index(update) - 1]
        return [each for each in self.kept(updates) if begin < each <= update or begin == each == 0]

    def keep(self, frames: int) -> None:
        """Write the policy as it is."""
        checkpoint.save(self.policy.state_dict(), self.file(frames))

    def file(self, frames: int) -> Path:
        """Return the file of the policy after some frames."""
        return self.folder / POLICIES / f"{frames:012d}.pt"

    def drive(self, frames: Sequence[int]) -> list[dict[str, float]]:
        """Return the mean measures of the policies after some frames, by name; a damaged file is a `UserError`."""
        policies = policy_batch(self.policy, [checkpoint.load(self.file(each)) for each in frames])
        rows: list[dict[str, float]] = [{} for _ in frames]
        # The training's random numbers are left alone.
        with (
            torch.random.fork_rng(),
            tqdm(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar,
        ):
            for cases, build in self.envs.items():
                for name, values in measures(
                    build(len(frames)), policies, self.watch, bar.update
                ).items():
                    for row, value in zip(
                        rows, values.view(len(frames), -1).double().mean(1).tolist(), strict=True
                    ):
                        row[f"{cases}/{name}"] = value
        return rows


@torch.no_grad()
def measures(
    env: EnvBase,
    policy: TensorDictModuleBase,
    watch: Watch | None = None,
    tick: Callable[[], Any] | None = None,
) -> dict[str, Tensor]:
    """Run one episode on every row of an env [B] with deterministic actions, and return its measures, [B] each.

    These are the `return`, the sum of the rewards of the task, and those of `watch`; `tick` is
    called after every step.
    """
    measured = {"return": Measure("episode_reward", "last")}
    for group, reduction in (("episode", "last"), ("step", "mean")):
        keys = (watch or {}).get(group, {})
        measured |= {name: Measure.of(key, reduction=reduction) for name, key in keys.items()}
    totals = Totals(measured)
    for after, running in episodes(env, policy, tick=tick):
        totals.add(after, running)
    return totals.results()
