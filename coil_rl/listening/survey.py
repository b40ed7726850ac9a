"""Survey of an agent on its tracks: measures in every visited state, ablations of guides, and their tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.listening.measures import ADVICE, InterceptedPolicy, agreement, gradient, intervention
from coil_rl.listening.sections import SECTIONS, TrackSections, curvature
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy, summarise
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace

Array = NDArray[np.float64]

EVERYWHERE = "everywhere"


@dataclass(frozen=True)
class Survey:
    """Measures in the N states of all episodes."""

    guides: list[str]  # names, one per slot of the advice
    result: EvaluationResult
    track: NDArray[np.int64]  # [N], index of the track
    point: NDArray[np.int64]  # [N], nearest point of its middle line
    section: NDArray[np.int64]  # [N], index in SECTIONS
    advice: Tensor  # [N, n_guides, A]
    measures: dict[str, Array]  # agreement, intervention and gradient, [N, n_guides] each


def survey(
    env: EnvBase,
    policy: TensorDictModuleBase,
    sections: TrackSections,
    *,
    donors: int = 16,
    seed: int = 0,
    tick: Callable[[], Any] | None = None,
) -> Survey:
    """Evaluate the deterministic agent for one episode per car, and measure in every visited state.

    The env has cars with `info`, [B], on the tracks of `sections`. The agent reads `guide_action`. `donors` are as for
    `intervention`, the seed is theirs, and `tick` is called every step.
    """
    history: list[TensorDictBase] = []

    def record(state: TensorDictBase) -> TensorDictBase:
        recorded = state.select(*recorder.acting.in_keys)
        recorded["track"] = state["info", "track"].squeeze(-1)
        recorded["point"] = sections.nearest(recorded["track"], state["info", "pose"][..., :2])
        history.append(recorded)
        return state

    recorder = InterceptedPolicy(policy, record)
    sources = [recorder.advising, *(module for module in env.modules() if isinstance(module, GuideActions))]
    guides = next((list(source.names) for source in sources if source is not None), None)
    if guides is None:
        raise ValueError("nothing writes guide_action: put GuideActions into the env")
    result = evaluate_policy(env, recorder, names=[track.name for track in sections.tracks], tick=tick)
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
        states["track"].cpu().numpy(),
        states["point"].cpu().numpy(),
        sections.section_at(states["track"], states["point"]).cpu().numpy(),
        states[ADVICE],
        {name: values.cpu().double().numpy() for name, values in measures.items()},
    )


class Ablation(NamedTuple):
    """A guide, by its slot in the advice, that is removed in one section, by its index, or everywhere (None)."""

    guide: int
    section: int | None = None


def ablations(guides: int) -> list[Ablation]:
    """Return the removal of each guide everywhere and in each section."""
    return [Ablation(guide, section) for guide in range(guides) for section in (None, *range(len(SECTIONS)))]


def drive_ablated(
    env: EnvBase,
    policy: TensorDictModuleBase,
    sections: TrackSections,
    removed: Sequence[Ablation],
    replacement: Tensor,
    *,
    tick: Callable[[], Any] | None = None,
) -> list[list[dict[str, Any]]]:
    """Evaluate the deterministic agent with each ablation, all at the same time.

    Removed advice is replaced by a constant, such as its mean: it carries no information and is not misleading, as
    advice from other states would be.

    The arguments are those of `survey` and the `replacement` [n_guides, A]. Each ablation gets an equal share of the
    cars of the env, in order. The result is the episodes of each ablation, as in `EvaluationResult`.
    """
    cars = env.batch_size.numel()
    if not removed or cars % len(removed):
        raise ValueError(f"{cars} cars cannot be divided among {len(removed)} ablations; give a multiple")
    share = cars // len(removed)
    replaced = torch.zeros(len(removed), len(SECTIONS), len(replacement), dtype=torch.bool, device=env.device)
    for index, (guide, where) in enumerate(removed):
        replaced[index, slice(None) if where is None else where, guide] = True
    replaced = replaced.repeat_interleave(share, 0)

    def remove(state: TensorDictBase) -> TensorDictBase:
        section = sections.section(state["info", "track"].squeeze(-1), state["info", "pose"][..., :2])
        mask = replaced[torch.arange(cars, device=env.device), section].unsqueeze(-1)
        return state.set(ADVICE, torch.where(mask, replacement, state[ADVICE]))

    names = [track.name for track in sections.tracks]
    episodes = evaluate_policy(env, InterceptedPolicy(policy, remove), names=names, tick=tick).episodes
    return [episodes[start : start + share] for start in range(0, cars, share)]


def table_by_section(data: Survey, ablated: Mapping[Ablation, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return one row per guide everywhere and in each section: means over states, and the effect of its removal.

    Returns:
        Rows with `guide`, `section`, `share` of the states, `agreement`, `intervention`, `gradient`, and, with the
        guide removed there, `lost` (return) and `completed` (share). Sections without a state are left out.
    """
    intact = _means(data.result.episodes)
    rows = []
    for (slot, section), episodes in ablated.items():
        states = np.ones(len(data.section), dtype=bool) if section is None else data.section == section
        if states.any():
            without = _means(episodes)
            rows.append(
                {"guide": data.guides[slot], "section": EVERYWHERE if section is None else SECTIONS[section]}
                | {"share": float(states.mean())}
                | {name: float(values[states, slot].mean()) for name, values in data.measures.items()}
                | {"lost": intact["reward"] - without["reward"], "completed": without["completed"]}
            )
    return rows


def table_along_track(data: Survey, sections: TrackSections, bin_length: float = 1.0) -> list[dict[str, Any]]:
    """Return one row per guide and bin of each track with a visited state.

    Bins are `bin_length` m of the middle line, rounded to a whole number of bins.

    Returns:
        Rows with `track`, `guide`, `bin`, `from` (m along the middle line), `x`, `y` (m), `curvature` (1/m) and
        `section` of the bin's middle, number of `states`, and means of `agreement`, `intervention` and `gradient`.
    """
    rows = []
    for index, track in enumerate(sections.tracks):
        line, on_track = sections.lines[index], data.track == index
        bins = _bins(line, bin_length)
        _, first, lengths = np.unique(bins, return_index=True, return_counts=True)
        middle = first + lengths // 2
        step, bend = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1), curvature(line)
        bin_of_state = bins[data.point[on_track]]
        states = np.bincount(bin_of_state, minlength=len(first))
        for slot, guide in enumerate(data.guides):
            sums = {name: np.bincount(bin_of_state, values[on_track, slot]) for name, values in data.measures.items()}
            for k in np.flatnonzero(states).tolist():
                x, y = line[middle[k]].tolist()
                rows.append({
                    "track": track.name, "guide": guide, "bin": k, "from": float(step[: first[k]].sum()),
                    "x": x, "y": y, "curvature": float(bend[middle[k]]),
                    "section": SECTIONS[sections.sections[index][middle[k]]], "states": int(states[k]),
                    **{name: float(of_bins[k] / states[k]) for name, of_bins in sums.items()},
                })  # fmt: skip
    return rows


def measure_on_lines(
    data: Survey, sections: TrackSections, measure: str, bin_length: float = 1.0
) -> tuple[list[Array], dict[str, list[Array]]]:
    """Return the line [T, 2] m of the last car of each track, and by guide the measure [T] at its points, by bins."""
    table = table_along_track(data, sections, bin_length)
    means = {(row["track"], row["guide"], row["bin"]): row[measure] for row in table}
    lines: list[Array] = []
    values: dict[str, list[Array]] = {guide: [] for guide in data.guides}
    for middle_line, track in zip(sections.lines, sections.tracks, strict=True):
        cars = [car for car, episode in enumerate(data.result.episodes) if episode["track"] == track.name]
        line = data.result.lines[cars[-1]]
        line = line[: max(1, len(line) - 1)]  # the last point is the position after the last measured state
        nearest = ((line[:, None] - middle_line) ** 2).sum(-1).argmin(1)
        bins = _bins(middle_line, bin_length)[nearest].tolist()
        lines.append(line)
        for guide in data.guides:
            values[guide].append(np.array([means.get((track.name, guide, k), np.nan) for k in bins]))
    return lines, values


def _means(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return summarise([dict(episode) for episode in episodes])[-1]


def _bins(line: Array, length: float) -> NDArray[np.int64]:
    """Return the bin of each point of a closed line [P]: numbers from 0, bins of about equal length."""
    total = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).sum()
    count = min(len(line), max(1, round(total / length)))
    return np.arange(len(line)) * count // len(line)
