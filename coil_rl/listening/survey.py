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

from coil_rl.listening.measures import ADVICE, InterceptedPolicy, agreement, gradient, intervention
from coil_rl.report.measures import summarise
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.judge import Evaluation
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace

if TYPE_CHECKING:
    from coil_rl.listening.sections import WholeEpisode

Array = NDArray[np.float64]

EVERYWHERE = "everywhere"


@dataclass(frozen=True)
class Survey:
    """Measures in the N states of all episodes."""

    guides: list[str]  # names, one per slot of the advice
    result: EvaluationResult
    step: NDArray[np.int64]  # [N], of the episode
    place: dict[str, NDArray[Any]]  # as `WholeEpisode.locate` returns it, [N, ...]
    section: NDArray[np.int64]  # [N], index of the section
    advice: Tensor  # [N, n_guides, A]
    measures: dict[str, Array]  # agreement, intervention and gradient, [N, n_guides] each

    def means(self, **groups: NDArray[np.int64]) -> list[dict[str, Any]]:
        """Return a row for each guide and group of states, given its numbers [N] by name.

        Rows have `guide`, the groups, the number of `states`, and the means of the measures.
        """
        rows = []
        for slot, guide in enumerate(self.guides):
            table = pd.DataFrame(
                {**groups, **{name: values[:, slot] for name, values in self.measures.items()}}
            )
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
    """Evaluate the deterministic agent for one episode per row of an env [B], and measure in every visited state.

    The agent reads `guide_action`. `donors` are as for `intervention`, the seed is theirs, and
    `tick` is called every step.
    """
    history: list[TensorDictBase] = []

    def record(state: TensorDictBase) -> TensorDictBase:
        recorded = state.select(*recorder.acting.in_keys)
        recorded["step"] = torch.full(state.batch_size, len(history), device=state.device)
        recorded["place"] = TensorDict(sections.locate(state), state.batch_size)
        history.append(recorded)
        return state

    recorder = InterceptedPolicy(policy, record)
    sources = [
        recorder.advising,
        *(module for module in env.modules() if isinstance(module, GuideActions)),
    ]
    guides = next((list(source.names) for source in sources if source is not None), None)
    if guides is None:
        raise ValueError("nothing writes guide_action: put GuideActions into the env")
    result = evaluation.run(env, recorder, tick=tick)
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


class Ablation(NamedTuple):
    """A guide, by its slot in the advice, that is removed in one section, by its index, or everywhere (None)."""

    guide: int
    section: int | None = None


def ablations(guides: int, sections: int) -> list[Ablation]:
    """Return the removal of each guide everywhere and in each section, given their numbers."""
    return [
        Ablation(guide, section) for guide in range(guides) for section in (None, *range(sections))
    ]


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

    Removed advice is replaced by a constant, such as its mean: it carries no information and is not
    misleading, as advice from other states would be.

    The arguments are those of `survey` and the `replacement` [n_guides, A]. Each ablation gets an
    equal share of the rows of the env, in order. The result is the episodes of each ablation, as in
    `EvaluationResult`.
    """
    rows = env.batch_size.numel()
    if not removed or rows % len(removed):
        raise ValueError(
            f"{rows} rows cannot be divided among {len(removed)} ablations; give a multiple"
        )
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

    episodes = evaluation.run(env, InterceptedPolicy(policy, remove), tick=tick).episodes
    return [episodes[start : start + share] for start in range(0, rows, share)]


def table_by_section(
    data: Survey,
    sections: WholeEpisode,
    evaluation: Evaluation,
    ablated: Mapping[Ablation, Sequence[Mapping[str, Any]]],
) -> list[dict[str, Any]]:
    """Return one row per guide everywhere and in each section: means over states, and the effect of its removal.

    Returns:
        Rows with `guide`, `section`, `share` of the states, `agreement`, `intervention`,
        `gradient`, and, with the guide removed there, `lost` (return) and `completed` (share), if
        it is measured. Sections without a state are left out.
    """
    intact = summarise(data.result.episodes, evaluation.measures)[-1]
    rows = []
    for (slot, section), episodes in ablated.items():
        states = (
            np.ones(len(data.section), dtype=bool) if section is None else data.section == section
        )
        if states.any():
            without = summarise(episodes, evaluation.measures)[-1]
            rows.append(
                {
                    "guide": data.guides[slot],
                    "section": EVERYWHERE if section is None else sections.names[section],
                }
                | {"share": float(states.mean())}
                | {
                    name: float(values[states, slot].mean())
                    for name, values in data.measures.items()
                }
                | {"lost": intact["reward"] - without["reward"]}
                | ({"completed": without["completed"]} if "completed" in without else {})
            )
    return rows
