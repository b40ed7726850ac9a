"""Evaluation of a run: its agent and its guides in all cases, as tables and figures."""

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_object
from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import write_text
from coil_rl.guides.simple import FollowAdvice
from coil_rl.report import Returns, markdown_table, write_csv
from coil_rl.report.pictures import Picture
from coil_rl.report.statistics import mean_interval
from coil_rl.train.build import (
    build,
    build_env,
    build_guided_env,
    build_guides,
    compile_steps,
    env_node,
    what_guides_see,
)
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy
from coil_rl.train.fallback import Fallback
from coil_rl.train.measures import Measure, measures_of, summarise
from coil_rl.train.policy_batch import RecordedPolicy, is_tensors
from coil_rl.transforms import GuideActions

COLUMNS = {
    "driver": ("driver", ""),
    "advice": ("advice", ""),
    "actions": ("actions", ""),
    "case": ("case", ""),
}
COLUMNS |= {"reward": ("reward", ".1f")}
MAX_CASES = 8  # in the table for people


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation consists of: the names of its cases, its measures, and the entries that pictures need."""

    cases: Sequence[str]
    measures: Mapping[str, Measure]
    record: Mapping[str, NestedKey]

    def __hash__(self) -> int:
        return hash(repr(self))

    def drive(self, env: EnvBase, policy: TensorDictModuleBase, **options: Any) -> EvaluationResult:
        """Evaluate a policy on an env whose rows are the cases, perhaps several times; see `evaluate_policy`."""
        return evaluate_policy(
            env, policy, cases=self.cases, measures=self.measures, record=self.record, **options
        )


def build_evaluation(
    config: DictConfig, record: Mapping[str, NestedKey] | None = None
) -> Evaluation:
    """Return the evaluation of a configuration, with entries to record by name; no cases are a `UserError`."""
    cases = config.evaluation.cases
    names = build(cases, "evaluation.cases") if isinstance(cases, DictConfig) else cases
    names = list(map(str, range(names))) if isinstance(names, int) else names
    if not isinstance(names, (list, tuple, ListConfig)) or not names:
        raise UserError(f"evaluation.cases={cases} must be at least 1, or the names of the cases")
    return Evaluation(list(map(str, names)), measures_of(config.evaluation.measures), record or {})


def build_pictures(config: DictConfig) -> list[Picture]:
    """Return the pictures of a configuration; without any, the returns."""
    nodes = config.evaluation.pictures.items()
    return [build(node, f"evaluation.pictures.{name}") for name, node in nodes if node] or [
        Returns()
    ]


def recorded(pictures: Iterable[Picture]) -> dict[str, NestedKey]:
    """Return the entries that pictures need, by name."""
    return {name: key for picture in pictures for name, key in picture.record.items()}


def evaluate_run(
    config: DictConfig,
    agent: TensorDictModuleBase | None,
    folder: Path,
    seed: int,
    fallback: Fallback | None = None,
) -> None:
    """Evaluate and write `episodes.csv`, pictures, `evaluation.md` (means) and, last, `evaluation.csv`.

    Each guide drives each case once, beside the agent where both have the same env. An agent drives
    it once with deterministic actions, `evaluation.repeats` times with sampled ones if it samples,
    once with each advice of `evaluation.advice` instead of its own, and once with a `fallback`.

    The agent is the policy of the run, or None for the guides alone; `seed` is that of the sampled
    actions.
    """
    pictures = build_pictures(config)
    evaluation = build_evaluation(config, recorded(pictures))
    count = len(evaluation.cases)
    table: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    drives: dict[str, EvaluationResult] = {}

    def add(
        result: EvaluationResult, driver: str, advice: str = "", actions: str = "deterministic"
    ) -> None:
        label = {"driver": driver, "advice": advice, "actions": actions}
        table.extend(label | row for row in summarise(result.episodes, evaluation.measures))
        episodes.extend(label | row for row in result.episodes)
        if actions == "deterministic":
            drives[f"{driver}, {advice}" if advice else driver] = result

    together = agent is not None and _advises_only(config)
    if not together:
        for driver, result in drive_guides(config, config.evaluation.env, evaluation).items():
            add(result, driver)
    # The kinds of advice, each with the number of sampled episodes a case.
    plan = (
        [("", config.evaluation.repeats if hasattr(agent, "get_dist") else 0)]
        if agent is not None
        else []
    )
    plan += [
        (advice, 0) for advice in config.evaluation.advice if plan and config.method.transforms
    ]
    acting = RecordedPolicy(agent) if agent is not None and is_tensors(agent) else agent
    torch.manual_seed(seed)
    with tqdm(unit="step", desc="evaluate", leave=False, mininterval=0.5) as bar:
        for advice, repeats in plan:
            bar.set_postfix_str(", ".join(filter(None, (config.label, advice))))
            names = driver_names(config.guide) if together and not advice else []
            # All drives in one batch: the time of a step hardly depends on its size.
            own = (1 + repeats) * count
            rows = torch.arange(own + len(names) * count, device=config.device)
            env = build_env(config, {**config.evaluation.env, "num_envs": len(rows)}, advice=advice)
            compile_steps(config, env)
            watching = pictures if not advice else []
            tick = partial(_tick, env, watching, bar.update)
            policy = AgentAndGuides(env, acting, own, len(names)) if names else acting
            sampled = repeats > 0 and (rows >= count) & (rows < own)
            result = evaluation.drive(env, policy, sampled=sampled, tick=tick)
            for name, of_guide in zip(
                names, result[own:].split(len(names)) if names else [], strict=True
            ):
                add(of_guide, name)
            add(result[:count], config.label, advice)
            if repeats:
                add(result[count:own], config.label, advice, "sampled")
        if fallback is not None:
            result = evaluation.drive(
                build_env(config, {**config.evaluation.env, "num_envs": count}), fallback
            )
            add(result, f"{config.label} or guide")
    write_csv(episodes, folder / "episodes.csv")
    for picture in pictures:
        picture.draw(drives, folder)
    columns = {
        key: value for key, value in COLUMNS.items() if key != "advice" or config.evaluation.advice
    }
    columns |= {
        name: (measure.title, measure.format)
        for name, measure in evaluation.measures.items()
        if measure.title
    }
    few = count <= MAX_CASES
    page = [
        markdown_table(table if few else [row for row in table if row["case"] == "mean"], columns)
    ]
    page += [] if few else [f"Means of {count} cases; all are in evaluation.csv."]
    sees = what_guides_see(config).items()
    guides = driver_names(config.guide) if agent is not None and count > 1 else []
    page += [not_worse(drives[config.label], drives[guide], guide) for guide in guides]
    page += (
        [f"With fallback the guide acted in {fallback.share(result):.1%} of the steps."]
        if fallback
        else []
    )
    page += [f"guide.{name} sees: {what}; it may know more than the agent." for name, what in sees]
    write_text(folder / "evaluation.md", "\n\n".join(page))
    write_csv(table, folder / "evaluation.csv")


def _advises_only(config: DictConfig) -> bool:
    """Return whether the env of the agent is that of its guides: all that a method adds is their advice."""
    added = {get_object(node["_target_"]) for node in config.method.transforms.values()}
    return added == {GuideActions} and not config.degrade and not config.action


class AgentAndGuides(TensorDictModuleBase):
    """An agent on the first rows of an env with advice, and its guides on the others, each on as many.

    Args:
        env: the env.
        agent: writes the action.
        count: number of rows of the agent.
        guides: number of guides.
    """

    def __init__(self, env: EnvBase, agent: TensorDictModuleBase, count: int, guides: int) -> None:
        self.in_keys, self.out_keys = list(agent.in_keys), ["action"]
        super().__init__()
        cases = (env.batch_size[0] - count) // guides
        # Of the guides' action on the rows of the agent nothing is used.
        self.guides = FollowAdvice(
            env, [0] * count + [guide for guide in range(guides) for _ in range(cases)]
        )
        self.agent, self.count = agent, count

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        advised = self.guides(tensordict.copy())["action"]
        tensordict = self.agent(tensordict)
        return tensordict.set(
            "action", torch.cat([tensordict["action"][: self.count], advised[self.count :]])
        )


def not_worse(agent: EvaluationResult, guide: EvaluationResult, name: str) -> str:
    """Return the sentence whether an agent is not worse than a guide in the same cases, by the t interval of the loss.

    The answer is yes if the whole interval is above minus 1 % of the guide's mean reward, no if it
    is below.
    """
    pairs = zip(agent.episodes, guide.episodes, strict=True)
    _, low, high = mean_interval([mine["reward"] - other["reward"] for mine, other in pairs])
    margin = -0.01 * abs(guide.mean_reward)
    answer = "yes" if low >= margin else "no" if high < margin else "undecided"
    return (
        f"Not worse than {name} on these {len(agent.episodes)} cases: {answer} "
        f"(difference of the rewards {low:+.1f} to {high:+.1f}, 95 % interval; 1 % is allowed)."
    )


def _tick(env: EnvBase, pictures: Iterable[Picture], update: Callable[[], Any]) -> None:
    update()
    for picture in pictures:
        picture.watch(env)


def report_outcome(folder: Path) -> float:
    """Print the evaluation of a run, and return the mean reward of its deterministic agent, or else of its guide."""
    with file_of_a_run(path := folder / "evaluation.csv", "remove the file, and evaluate again"):
        with path.open(newline="") as file:
            rows = [
                row
                for row in csv.DictReader(file)
                if (row["case"], row["actions"]) == ("mean", "deterministic")
            ]
        last = [row for row in rows if not row["advice"]][-1]
        reward, completed = float(last["reward"]), float(last.get("completed", "nan"))
        page = (folder / "evaluation.md").read_text().rstrip()
    print(page)
    share = "" if math.isnan(completed) else f", {completed:.0%} completed"
    print(f"{last['driver']}: mean test reward {reward:.1f}{share}; see {folder}")
    return reward


def drive_guides(
    config: DictConfig,
    overrides: Mapping[str, Any],
    evaluation: Evaluation,
    guides: Mapping[str, TensorDictModuleBase] | None = None,
) -> dict[str, EvaluationResult]:
    """Evaluate each guide of a run alone, once in each case; return the results by `driver_names`.

    `overrides` are of `env`. `guides` replace those of the configuration, whose results are cached.
    """
    if not guides:
        nodes = {
            key: OmegaConf.to_container(config[key], resolve=True) for key in ("guide", "degrade")
        }
        if not nodes["guide"]:
            return {}
        return dict(
            _drive_configured(
                OmegaConf.to_yaml({"env": env_node(config, overrides), **nodes}), evaluation
            )
        )
    env, policy = build_guided_env(config, {**overrides, "num_envs": len(evaluation.cases)}, guides)
    with tqdm(unit="step", desc="guides", leave=False, mininterval=0.5) as bar:
        result = evaluation.drive(env, policy, tick=bar.update)
    return dict(zip(driver_names(guides), result.split(len(guides)), strict=True))


# The runs of a sweep share their guides.
@lru_cache(maxsize=64)
def _drive_configured(nodes: str, evaluation: Evaluation) -> dict[str, EvaluationResult]:
    config: Any = OmegaConf.create(nodes)
    return drive_guides(config, {}, evaluation, build_guides(config))


def driver_names(guides: Iterable[str]) -> list[str]:
    """Return the display names of guides: `guide` for a single one, otherwise `guide NAME`."""
    names = list(guides)
    return ["guide"] if len(names) == 1 else [f"guide {name}" for name in names]
