"""Survey of an agent: measures in every visited state, ablations of guides, and their tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.measures import summarise
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.judge import Evaluation
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace
from coil_studies.listening.measures import (
    ADVICE,
    InterceptedPolicy,
    agreement,
    gradient,
    intervention,
)

if TYPE_CHECKING:
    from coil_studies.listening.sections import WholeEpisode

Array = NDArray[np.float64]

EVERYWHERE = "everywhere"


@dataclass(frozen=True)
class Survey:
    """Measures in the N states of all episodes.

    Attributes:
        guides: names of the guides, one per slot of the advice.
        result: the evaluated episodes.
        step: [N], number of the step in its episode.
        place: where the states are, as `WholeEpisode.locate` returns it, [N, ...].
        section: [N], index of the section.
        advice: [N, n_guides, A].
        measures: agreement, intervention and gradient, [N, n_guides] each.
    """

    guides: list[str]
    result: EvaluationResult
    step: NDArray[np.int64]
    place: dict[str, NDArray[Any]]
    section: NDArray[np.int64]
    advice: Tensor
    measures: dict[str, Array]

    def means(self, **groups: NDArray[np.int64]) -> list[dict[str, Any]]:
        """Return the means of the measures for each guide in each group of states.

        Args:
            groups: what the states are grouped by: the number of the group of each state, [N].

        Returns:
            Rows with `guide`, the groups, the number of `states`, and the means of the measures.
        """
        rows = []
        for slot, guide in enumerate(self.guides):
            columns: dict[str, NDArray[Any]] = dict(groups)
            for name, values in self.measures.items():
                columns[name] = values[:, slot]
            table = pd.DataFrame(columns)
            grouped = table.groupby(list(groups))
            means = grouped.size().rename("states").to_frame().join(grouped.mean()).reset_index()
            rows += [{"guide": guide} | row for row in means.to_dict("records")]
        return rows


def survey(
    env: EnvBase,
    policy: TensorDictModuleBase,
    sections: WholeEpisode,
    evaluation: Evaluation,
    *,
    donors: int = 16,
    seed: int = 0,
    tick: Callable[[], Any] | None = None,
) -> Survey:
    """Evaluate the deterministic agent, and measure in every visited state.

    Args:
        env: [B], one episode per row.
        policy: the agent, which reads `guide_action`.
        evaluation: the cases and the measures of the episodes.
        donors: number of replacements of the advice per state and guide, as for `intervention`.
        tick: called at every step.
    """
    history: list[TensorDictBase] = []

    def record(state: TensorDictBase) -> TensorDictBase:
        recorded = state.select(*recorder.acting.in_keys)
        recorded["step"] = torch.full(state.batch_size, len(history), device=state.device)
        recorded["place"] = TensorDict(sections.locate(state), state.batch_size)
        history.append(recorded)
        return state

    recorder = InterceptedPolicy(policy, record)
    guides = _guide_names(env, recorder)
    result = evaluation.run(env, recorder, different=env.batch_size.numel(), tick=tick)
    steps = torch.tensor([episode["steps"] for episode in result.episodes], device=env.device)
    running = torch.arange(len(history), device=env.device).unsqueeze(-1) < steps
    states: TensorDictBase = torch.stack(history)[running]
    space = ActionSpace(env.full_action_spec["action"], env.batch_dims)

    def act(state: TensorDictBase) -> Tensor:
        return space.vectors(recorder.acting(state)["action"])

    generator = torch.Generator().manual_seed(seed)
    measures = {
        "agreement": agreement(act, states),
        "intervention": intervention(act, states, donors, generator),
        "gradient": gradient(act, states),
    }
    return Survey(
        guides,
        result,
        states["step"].cpu().numpy(),
        {key: value.cpu().numpy() for key, value in states["place"].items()},
        sections.section(states["place"]).cpu().numpy(),
        states[ADVICE],
        {name: values.cpu().double().numpy() for name, values in measures.items()},
    )


def _guide_names(env: EnvBase, policy: InterceptedPolicy) -> list[str]:
    """Return the names of the guides whose advice the policy reads, one per slot of the advice."""
    if policy.advising is not None:
        return list(policy.advising.names)
    writes = (module for module in env.modules() if isinstance(module, GuideActions))
    return list(next(writes).names)


class Ablation(NamedTuple):
    """The removal of a guide's advice.

    Attributes:
        guide: the slot of the guide in the advice.
        section: index of the section where the advice is removed; None for everywhere.
    """

    guide: int
    section: int | None = None


def ablations(guides: int, sections: int) -> list[Ablation]:
    """Return the removal of each guide everywhere and in each section."""
    places = (None, *range(sections))
    return [Ablation(guide, section) for guide in range(guides) for section in places]


def drive_ablated(
    env: EnvBase,
    policy: TensorDictModuleBase,
    sections: WholeEpisode,
    evaluation: Evaluation,
    removed: Sequence[Ablation],
    replacement: Tensor,
    *,
    tick: Callable[[], Any] | None = None,
) -> list[list[dict[str, Any]]]:
    """Evaluate the deterministic agent with each ablation, all at the same time.

    The noise of env and guides is the same for each of them, and that of an env with its rows.

    Removed advice is replaced by a constant, such as its mean: it carries no information and is not
    misleading, as advice from other states would be.

    Args:
        env: [B]; each ablation gets an equal share of the rows, in order.
        policy: the agent, which reads `guide_action`.
        evaluation: the cases and the measures of the episodes.
        replacement: what replaces the removed advice, [n_guides, A].
        tick: called at every step.

    Returns:
        The episodes of each ablation, as in `EvaluationResult`.
    """
    rows = env.batch_size.numel()
    share = rows // len(removed)
    shape = len(removed), max(1, len(sections.names)), len(replacement)
    replaced = torch.zeros(shape, dtype=torch.bool, device=env.device)
    for index, (guide, where) in enumerate(removed):
        replaced[index, slice(None) if where is None else where, guide] = True
    replaced = replaced.repeat_interleave(share, 0)

    def remove(state: TensorDictBase) -> TensorDictBase:
        section = sections.section(TensorDict(sections.locate(state), state.batch_size))
        mask = replaced[torch.arange(rows, device=env.device), section].unsqueeze(-1)
        return state.set(ADVICE, torch.where(mask, replacement, state[ADVICE]))

    acting = InterceptedPolicy(policy, remove)
    episodes = evaluation.run(env, acting, different=share, tick=tick).episodes
    return [episodes[start : start + share] for start in range(0, rows, share)]


def table_by_section(
    data: Survey,
    sections: WholeEpisode,
    evaluation: Evaluation,
    ablated: Mapping[Ablation, Sequence[Mapping[str, Any]]],
) -> list[dict[str, Any]]:
    """Return how much the agent uses each guide everywhere and in each section.

    Returns:
        Rows with `guide`, `section`, `share` of the states, `agreement`, `intervention`,
        `gradient`, and, with the guide removed there, `lost` (return) and `completed` (share), if
        it is measured. Sections without a state are left out.
    """
    intact = summarise(data.result.episodes, evaluation.measures)[-1]
    rows = []
    for (slot, section), episodes in ablated.items():
        if section is None:
            name, states = EVERYWHERE, np.ones(len(data.section), dtype=bool)
        else:
            name, states = sections.names[section], data.section == section
        if not states.any():
            continue
        row = {"guide": data.guides[slot], "section": name, "share": float(states.mean())}
        for measure, values in data.measures.items():
            row[measure] = float(values[states, slot].mean())
        without = summarise(episodes, evaluation.measures)[-1]
        row["lost"] = intact["reward"] - without["reward"]
        if "completed" in without:
            row["completed"] = without["completed"]
        rows.append(row)
    return rows
