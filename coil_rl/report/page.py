"""Page of `coil-report`: tables and sentences, which become Markdown and HTML.

It has tables of the policies, of the cases, of the parts of the reward and of the training, and
says how to read them.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from statistics import mean
from typing import Any

from coil_rl.record import UNTESTED
from coil_rl.report.comparison import Comparison, Group
from coil_rl.report.curves import learning, points
from coil_rl.report.runs import GUIDE, TERM, Run, begun_with, by_label
from coil_rl.report.sentences import REPORT
from coil_rl.report.statistics import SIGN_FLIP_SEEDS, Estimate
from coil_rl.report.table import AUTO_FORMAT, TABLES, Table, return_format

Block = Table | str  # a table or a paragraph

MAX_CASES = 8  # in a table
IN_CASE = "in "  # prefix of columns, since a case may have the name of another column
GUIDE_RETURN = "guide/"  # prefix of columns of metrics.csv
GUIDE_CALLS = "guide/calls"  # is no return


def section(comparison: Comparison, against: str | None) -> list[Block]:
    """Return the section for one kind of actions.

    Args:
        against: what the policies are compared with, see `Comparison.table`.
    """
    rows = comparison.table(against)
    columns = _columns(comparison, rows, against)
    shown = with_cells(rows, comparison.spec)
    counts = [group.counts() for group in comparison.groups]
    cases = cases_table(comparison.groups, "report_cases.csv")
    return [Table(shown, columns, counts), *_terms(comparison), cases]


def _columns(
    comparison: Comparison, rows: Sequence[Mapping[str, Any]], against: str | None
) -> dict[str, tuple[str, str]]:
    """Return heading and format of the columns of the table of policies, without empty ones."""
    hidden = set() if against else {"difference cell", "p", "better"}
    for key in ("advice", "completed", "crashes"):
        if all(row[key] in (None, "") for row in rows):
            hidden.add(key)
    columns: dict[str, tuple[str, str]] = {}
    for key, (text, spec) in TABLES["drivers"]["columns"].items():
        if key not in hidden:
            columns[key] = (text.format(other=_other(against)), spec)
    for name, measure in chain.from_iterable(each.measures.items() for each in comparison.groups):
        if measure.heading(name) and name not in ("completed", "crashed"):
            columns[name] = (measure.heading(name), measure.format)
    columns["needs_guide"] = ("guide at test time", "")
    return columns


def with_cells(rows: Sequence[Mapping[str, Any]], spec: str) -> list[dict[str, Any]]:
    """Return rows of `Comparison.table` with `reward cell`, `cases cell` and `difference cell`.

    These cells show the intervals too.
    """
    shown = []
    for row in rows:
        reward = Estimate(row["reward"], row["low"], row["high"])
        difference = Estimate(row["difference"], row["difference_low"], row["difference_high"])
        cells = {"reward cell": reward.cell(spec), "difference cell": difference.cell(f"+{spec}")}
        if cells["difference cell"]:
            cells["difference cell"] += some_of(row["difference_seeds"], row["seeds"])
        low, high = row["low_of_cases"], row["high_of_cases"]
        cells["cases cell"] = None if math.isnan(low) else f"{low:{spec}} to {high:{spec}}"
        shown.append({**row, **cells})
    return shown


def guide_training(runs: Sequence[Run]) -> list[Table]:
    """Return the table of guides' own returns before and after training.

    The list is empty if no guide was trained.
    """
    rows: list[dict[str, Any]] = []
    columns = {"label": ("guides' own return, before to after", ""), "seeds": ("seeds", "")}
    for label, of_label in by_label(run for run in runs if run.curve).items():
        row: dict[str, Any] = {"label": label, "seeds": len(of_label)}
        for key in dict.fromkeys(chain.from_iterable(run.curve[0] for run in of_label)):
            if key.startswith(GUIDE_RETURN) and key != GUIDE_CALLS:
                known = [points(run.curve, key)[:, 1] for run in of_label]
                before, after = ([each[end] for each in known if len(each)] for end in (0, -1))
                spec = return_format([mean(before), mean(after)]) if before else ""
                row[key] = _mean_of_some(before, len(of_label), spec, after)
                columns[key] = (key.removeprefix(GUIDE_RETURN), "")
        if len(row) > 2:
            rows.append(row)
    return [Table(rows, columns)] if rows else []


def training(runs: Sequence[Run]) -> list[Block]:
    """Return the table of evaluation curves, means over seeds, and why frames differ if they do.

    The list is empty if nothing was trained.
    """
    rows: list[dict[str, Any]] = []
    for label, of_label in by_label(run for run in runs if run.curve).items():
        numbers = [learning(run) for run in of_label]
        row: dict[str, Any] = {key: mean(seed[key] for seed in numbers) for key in numbers[0]}
        row["label"], row["seeds"] = label, len(of_label)
        seconds = [run.seconds for run in of_label if run.seconds is not None]
        row["seconds"] = _mean_of_some(seconds, len(of_label), ".0f")
        reached = [seed["until_guide"] for seed in numbers if not math.isnan(seed["until_guide"])]
        row["until_guide cell"] = _mean_of_some(reached, len(of_label), ",.0f")
        if not math.isnan(row["area"]):
            rows.append(row)
    rows.sort(key=lambda row: -float(row["area"]))
    spec = return_format(row[key] for row in rows for key in ("guide", "area"))
    columns = {
        key: (heading, spec if each == AUTO_FORMAT else each)
        for key, (heading, each) in TABLES["learning"]["columns"].items()
    }
    differ = len({row["frames"] for row in rows}) > 1
    return [Table(rows, columns), *REPORT.said("frames", differ=differ)] if rows else []


def _mean_of_some(
    known: Sequence[float], seeds: int, spec: str, after: Sequence[float] = ()
) -> str | None:
    """Return the mean over some seeds as a cell that says how many; None without a number.

    Args:
        known: numbers of the seeds that have one.
        after: a second number of each of these seeds.
    """
    if not known:
        return None
    means = " to ".join(f"{mean(numbers):{spec}}" for numbers in (known, after) if numbers)
    return f"{means}{some_of(len(known), seeds)}"


def some_of(reached: int, seeds: int) -> str:
    """Return ` (3 of 5 seeds)` for a mean of some seeds only; empty for a mean of all.

    Args:
        reached: number of seeds that the mean is of.
    """
    return f" ({reached} of {seeds} seeds)" if reached < seeds else ""


def notes(against: str | None, *, sampled: bool) -> list[str]:
    """Return an explanation of the tables.

    Args:
        against: what the policies are compared with, see `Comparison.table`.
        sampled: whether there are tables of sampled actions.
    """
    return REPORT.said("notes", other=_other(against), sampled=sampled, seeds=SIGN_FLIP_SEEDS)


def what_differs(rows: Sequence[Mapping[str, str]], heading: str) -> list[Table]:
    """Return the table of what differs between runs that got names with numbers.

    Args:
        rows: see `configurations.distinguish`.
        heading: of the column with the names.
    """
    return [Table(rows, {"name": (heading, ""), "differs": ("what differs", "")})] if rows else []


def summary(tables: Mapping[str, Sequence[Mapping[str, Any]]], against: str | None) -> list[Table]:
    """Return in how many envs each policy is better than another one; no table for a single env.

    Returns of two envs have no common unit, but signs have: those of the interval.

    Args:
        tables: `Comparison.table(against)`, by env.
        against: what the policies are compared with, see `Comparison.table`.
    """
    found: dict[str, Counter[str]] = {}
    for row in chain.from_iterable(tables.values()):
        if row["difference_seeds"] is not None and not row["advice"]:
            signs = {"better": row["difference_low"] > 0, "worse": row["difference_high"] < 0}
            sign = next((name for name, is_so in signs.items() if is_so), "even")
            found.setdefault(row["driver"], Counter()).update([sign])
    rows = [
        {"driver": driver, "better": 0, "even": 0, "worse": 0, **of} for driver, of in found.items()
    ]
    columns = {
        "driver": (f"in how many envs beside {_other(against)}", ""),
        "better": ("better", "d"),
        "even": ("undecided", "d"),
        "worse": ("worse", "d"),
    }
    return [Table(rows, columns)] if rows and len(tables) > 1 else []


def unpaired(against: str | None, compared: Mapping[str, Comparison]) -> list[str]:
    """Return a sentence on the policies that have no seed in common with the other one.

    Args:
        against: what the policies are compared with, see `Comparison.table`.
        compared: the policies, by kind of actions.
    """
    names = chain.from_iterable(each.unpaired(against) for each in compared.values())
    return REPORT.said("unpaired", names=list(dict.fromkeys(names)), other=_other(against))


def handed_over(runs: Sequence[Run]) -> list[str]:
    """Return sentences for each label whose runs test at their end what they hand over.

    Runs that had no frames left for a test are in a sentence of their own.
    """
    counts: dict[str, Counter[str]] = {}
    for run in runs:
        if run.handed_over:
            counts.setdefault(run.label, Counter())[run.handed_over] += 1
    labels = [(label, of.pop(UNTESTED, 0), of.most_common()) for label, of in counts.items()]
    return REPORT.said("handed_over", labels=labels)


def begun(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each label whose runs began with an earlier policy or data."""
    sources: dict[str, dict[str, None]] = {}
    for run in runs:
        if (source := begun_with(run.settings)) is not None:
            sources.setdefault(run.label, {})[source] = None
    return REPORT.said("begun", labels=sources)


def _other(against: str | None) -> str:
    return "its guide" if against == GUIDE else against or ""


def _terms(comparison: Comparison) -> list[Table]:
    """Return the table of the terms of the reward; no table without such measures."""
    rows: list[dict[str, Any]] = []
    columns = {"driver": ("term of the reward", "")}
    for group in comparison.groups:
        terms = group.terms()
        for name in terms:
            columns[name] = (name.removeprefix(TERM), AUTO_FORMAT)
        if terms:
            rows.append({"driver": group.title, **terms})
    return [Table(rows, columns)] if rows else []


def cases_table(groups: Sequence[Group], file: str) -> Block:
    """Return the table of the mean reward by policy and case, with the completed share below 1.

    Args:
        file: name of the file with these numbers, which is named instead if there are many cases.
    """
    names = dict.fromkeys(chain.from_iterable(group.cases for group in groups))
    if len(names) > MAX_CASES:
        return f"The rewards in each of the {len(names)} cases are in {file}."
    spec = return_format(group.reward.mean for group in groups)
    rows = []
    for group in groups:
        row: dict[str, Any] = {"driver": group.title}
        for case in group.cases:
            means = group.means(case)
            reward, completed = means["reward"], means.get("completed", 1.0)
            row[f"{IN_CASE}{case}"] = (
                f"{reward:{spec}} ({completed:.0%} completed)" if completed < 1 else reward
            )
        rows.append(row)
    return Table(
        rows, {"driver": ("mean reward", "")} | {f"{IN_CASE}{name}": (name, spec) for name in names}
    )
