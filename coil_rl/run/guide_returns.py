"""The mean return of each guide in the cases of the evaluation curve."""

from collections.abc import Mapping, Sequence

import torch
from tensordict.nn import TensorDictModuleBase

from coil_rl.report.runs import EVALUATION
from coil_rl.run.curve import measures
from coil_rl.run.judge import guide_titles
from coil_rl.run.parts import EnvMaker


class GuideReturns:
    """Mean return of each guide of a learner that trains its guides, with its present parameters.

    A `Callback`. It measures nothing without a curve.

    Args:
        make_env: makes the env.
        guides: of the learner, by name.
        each_phase: whether to measure after each phase that changed a guide, not only before and
            after the training.
    """

    def __init__(
        self,
        make_env: EnvMaker,
        guides: Mapping[str, TensorDictModuleBase],
        *,
        each_phase: bool = True,
    ) -> None:
        self.make_env, self.guides, self.each_phase = make_env, guides, each_phase
        measured = guides if EVALUATION in make_env.sizes else ()
        self.names: Sequence[str] = [f"guide/{name}" for name in measured]

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the guides have changed, or the training begins or ends."""
        if update in (0, updates):
            return True
        return self.each_phase and bool(row["learner/guides_changed"])

    def after_update(self, update: int) -> dict[str, float]:
        """Return the means by their names in the log."""
        returns = guide_returns(self.make_env, self.guides)
        return dict(zip(self.names, returns.values(), strict=True))


def guide_returns(
    make_env: EnvMaker, guides: Mapping[str, TensorDictModuleBase]
) -> dict[str, float]:
    """Return the mean return of each guide in the cases of the curve.

    It is empty without cases or guides.
    """
    if EVALUATION not in make_env.sizes or not guides:
        return {}
    cases = make_env.sizes[EVALUATION]
    env, policy = make_env.guided(cases, EVALUATION, guides)
    with torch.random.fork_rng():
        returns = measures(env, policy, cases=cases)["return"].view(len(guides), -1).mean(1)
    return dict(zip(guide_titles(guides), returns.tolist(), strict=True))
