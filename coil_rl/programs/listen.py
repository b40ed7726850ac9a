"""`coil-listen`: how much a trained agent uses the advice of each guide, and where."""

from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.errors import UserError
from coil_rl.programs import app


def listen(config: DictConfig) -> None:
    """Evaluate the agent of a run, measure, and write tables and maps; `listening.csv` is the last file."""
    import numpy as np
    import torch
    from tqdm import tqdm

    from coil_rl.config.build import assemble, build_evaluation
    from coil_rl.config.nodes import build
    from coil_rl.files import write_text
    from coil_rl.learners.anchor import AnchoredHead
    from coil_rl.listening import WholeEpisode
    from coil_rl.listening import survey as surveys
    from coil_rl.listening.measures import split_policy
    from coil_rl.programs.evaluate import configured
    from coil_rl.report import markdown_table, write_csv
    from coil_rl.report.table import TABLES
    from coil_rl.run.parts import TEST

    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    run = configured(Path(config.run), config)
    opened = assemble(run, Path(config.run))
    agent = opened.policy()
    if agent is None:
        raise UserError(
            f"run={config.run} has no agent, only a guide; give a run of an agent that observes advice"
        )
    try:
        split_policy(agent)
    except ValueError as error:
        raise UserError(f"the agent of run={config.run} does not use advice: {error}") from error
    node = run.evaluation.sections
    sections: WholeEpisode = build(node, "evaluation.sections") if node else WholeEpisode()
    evaluation = build_evaluation(run, sections.record)
    rows = len(evaluation.cases) * run.evaluation.repeats
    torch.manual_seed(config.seed)  # for guides with random actions
    with tqdm(unit="step", desc="listen", leave=False, mininterval=0.5) as bar:
        bar.set_postfix_str("all guides")
        env = opened.make_env(rows, TEST)
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
        env = opened.make_env(rows * len(removed), TEST)
        mean_advice = data.advice.mean(0)
        episodes = surveys.drive_ablated(
            env, agent, sections, evaluation, removed, mean_advice, tick=bar.update
        )
    table = surveys.table_by_section(
        data, sections, evaluation, dict(zip(removed, episodes, strict=True))
    )
    texts = TABLES["listening"]
    columns = {key: column for key, column in texts["columns"].items() if key in table[0]}
    kind = "continuous"
    if np.isnan(data.measures["gradient"]).all():
        del columns["gradient"]
        kind = "discrete"
    notes = f"{texts['notes']} {texts[kind]}"
    for head in (part for part in agent.modules() if isinstance(part, AnchoredHead)):
        weights = zip(data.guides, head.weight.tolist(), strict=True)
        notes += (
            "\nWeight of the anchor: "
            + ", ".join(f"{guide} {weight:.2f}" for guide, weight in weights)
            + "."
        )
    page = f"{markdown_table(table, columns)}\n\n{notes}"
    write_text(folder / "listening.md", page)
    write_csv(table, folder / "listening_sections.csv")
    sections.draw(data, folder)
    print(f"{page}\n\n{_summary(run.label, table)}; see {folder}")


def _summary(label: str, table: list[dict[str, Any]]) -> str:
    """Return a sentence on the guide with the largest effect."""
    means = {row["guide"]: row["intervention"] for row in table if row["section"] == "everywhere"}
    best = max(means, key=lambda guide: means[guide])
    rows = [row for row in table if row["guide"] == best and row["section"] != "everywhere"]
    where = max(rows, key=lambda row: row["intervention"], default=None)
    there = (
        f", and by {where['intervention']:.4f} in the section {where['section']}" if where else ""
    )
    others = "".join(
        f"; {guide} changes it by {change:.4f}" for guide, change in means.items() if guide != best
    )
    return f"{label} depends most on {best}: other advice of it changes the action by {means[best]:.4f}{there}{others}"


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration, and make the folder of the results."""
    app.check_used(
        ("run", "track", "evaluation", "donors"), f"run={config.run} has its own configuration"
    )
    app.check_run(config)


main = partial(app.run_program, listen, "listen", check)

if __name__ == "__main__":
    main()
