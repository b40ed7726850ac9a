"""`coil-listen`: how much a trained agent uses the advice of each guide, and where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

import coil_studies.schema  # noqa: F401  registers the root configuration with Hydra
from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.programs.evaluate import OF_TRAINING, configured

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

    from coil_rl.run.judge import Evaluation
    from coil_rl.run.run import Run
    from coil_studies.listening import WholeEpisode
    from coil_studies.listening.survey import Ablation, Survey


def listen(config: DictConfig) -> None:
    """Evaluate the agent of a run, measure, and write tables and maps.

    `listening.csv` is the last file.
    """
    import torch

    from coil_rl.config.assemble import assemble
    from coil_rl.config.folder import run_folder
    from coil_rl.config.nodes import build
    from coil_rl.config.parts import build_evaluation
    from coil_rl.files import write_text
    from coil_rl.report import write_csv
    from coil_studies.listening import WholeEpisode
    from coil_studies.listening.survey import table_by_section

    folder = Path(config.run_dir)
    source = run_folder(config.run)
    of_run = configured(source, config)
    run = assemble(of_run)
    agent = _agent(run)
    node = of_run.evaluation.sections
    sections: WholeEpisode = build(node, "evaluation.sections") if node else WholeEpisode()
    evaluation = build_evaluation(of_run, sections.record)
    torch.manual_seed(config.seed)  # for guides with random actions
    data, ablated = _measure(config, run, agent, sections, evaluation)
    table = table_by_section(data, sections, evaluation, ablated)
    page = _page(agent, data, table)
    write_text(folder / "listening.md", page)
    write_csv(table, folder / "listening_sections.csv")
    sections.draw(data, folder)
    print(f"{page}\n\n{_summary(run.label, table)}; see {folder}")


def _agent(run: Run) -> TensorDictModuleBase:
    """Return the agent of a run, which must use advice."""
    from coil_rl.run.delivery import GuideActs
    from coil_studies.listening.measures import split_policy

    agent: TensorDictModuleBase | None = run.policy()
    if agent is None:
        raise UserError(
            f"run={run.folder} has no agent, only a guide; "
            "give a run of an agent that observes advice"
        )
    if isinstance(agent, GuideActs):
        raise UserError(
            f"run={run.folder} handed over its guide, which uses no advice; "
            "write evaluation.policy=last for the last policy that learned"
        )
    try:
        split_policy(agent)
    except ValueError as error:
        raise UserError(f"the agent of run={run.folder} does not use advice: {error}") from error
    return agent


def _measure(
    config: DictConfig,
    run: Run,
    agent: TensorDictModuleBase,
    sections: WholeEpisode,
    evaluation: Evaluation,
) -> tuple[Survey, Mapping[Ablation, Sequence[Mapping[str, Any]]]]:
    """Return the measures with all guides, and the episodes without the advice of one guide."""
    from coil_rl.output import progress
    from coil_rl.run.parts import TEST
    from coil_studies.listening import survey as surveys

    rows = len(evaluation.cases) * run.trial.repeats
    with progress(unit="step", desc="listen", leave=False, mininterval=0.5) as bar:
        bar.set_postfix_str("all guides")
        env = run.make_env(rows, TEST)
        data = surveys.survey(
            env,
            agent,
            sections,
            evaluation,
            donors=config.donors,
            seed=config.seed,
            tick=bar.update,
        )
        removed = surveys.ablations(len(data.guides), len(sections.names))
        bar.set_postfix_str("one guide removed")
        env = run.make_env(rows * len(removed), TEST)
        mean_advice = data.advice.mean(0)
        episodes = surveys.drive_ablated(
            env, agent, sections, evaluation, removed, mean_advice, tick=bar.update
        )
    return data, dict(zip(removed, episodes, strict=True))


def _page(agent: TensorDictModuleBase, data: Survey, table: Sequence[Mapping[str, Any]]) -> str:
    """Return the table with its notes as Markdown."""
    import numpy as np

    from coil_rl.learners.anchor import hold_of
    from coil_rl.report import markdown_table
    from coil_rl.report.table import TABLES

    texts = TABLES["listening"]
    columns = {key: column for key, column in texts["columns"].items() if key in table[0]}
    kind = "continuous"
    if np.isnan(data.measures["gradient"]).all():
        del columns["gradient"]
        kind = "discrete"
    notes = f"{texts['notes']} {texts[kind]}"
    hold = hold_of(agent)
    if hold is not None:
        weights = zip(data.guides, hold.weight.tolist(), strict=True)
        listed = ", ".join(f"{guide} {weight:.2f}" for guide, weight in weights)
        notes += f"\nWeight with which the policy holds each guide: {listed}."
    return f"{markdown_table(table, columns)}\n\n{notes}"


def _summary(label: str, table: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the guide with the largest effect."""
    means = {row["guide"]: row["intervention"] for row in table if row["section"] == "everywhere"}
    best = max(means, key=lambda guide: means[guide])
    rows = [row for row in table if row["guide"] == best and row["section"] != "everywhere"]
    there = ""
    if rows:
        most = max(rows, key=lambda row: row["intervention"])
        there = f", and by {most['intervention']:.4f} in the section {most['section']}"
    others = "".join(
        f"; {guide} changes it by {change:.4f}" for guide, change in means.items() if guide != best
    )
    return (
        f"{label} depends most on {best}: "
        f"other advice of it changes the action by {means[best]:.4f}{there}{others}"
    )


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration.

    Otherwise make the folder of the results.
    """
    app.check_used(
        ("run", "track", "evaluation", "donors"), f"run={config.run} has its own configuration"
    )
    app.check_unused(OF_TRAINING, "only a training reads it")
    from coil_rl.config import check as checks  # torch, which a wrong word does not wait for

    checks.check(config)


main = partial(app.run_program, listen, "listen", check, "pkg://coil_studies.conf")

if __name__ == "__main__":
    main()
