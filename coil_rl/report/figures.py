"""The figures of `coil-report` for one env: as PNG files, and for its HTML page."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path

from coil_rl.errors import file_of_a_run
from coil_rl.files import read_file
from coil_rl.report import style
from coil_rl.report.beside import BESIDE, beside_guides, draw_beside_guides
from coil_rl.report.comparison import Comparison
from coil_rl.report.curves import draw_curve_grid, draw_learning_curves, guide_return
from coil_rl.report.guide_use import draw_guide_use, guide_use
from coil_rl.report.html import Figure, embedded, svg
from coil_rl.report.intervals import draw_intervals, driver_intervals
from coil_rl.report.runs import RESTORE, Run

SAME_LINE = 1e-6  # relative difference of the returns of one guide; the rest is rounding
MAX_CURVES = 8  # in one plot
# Pictures of runs: title and caption by file.
FILMS = {
    "in_time.png": ("First case in time", "Observation, advice and executed action"),
    "episode.webp": ("Film", "The first case of the evaluation"),
    "lines.gif": ("Film", "The cases of the evaluation"),
}
LARGEST_FILM = 2_000_000  # bytes
MAX_FILMS = 12  # of an env

Draw = Callable[[style.Target], None]


def draw_report(
    runs: Sequence[Run],
    compared: Mapping[str, Comparison],
    folder: Path,
    strokes: Mapping[str, style.Stroke],
    suffix: str = ".png",
) -> list[Figure]:
    """Draw all figures of the runs in one env into a folder, and return them for the HTML page.

    Args:
        compared: the policies, by kind of actions.
        folder: where the files are written.
        strokes: by label.
        suffix: of the names of the files, with their format.
    """
    panels = {}
    for kind, comparison in compared.items():
        groups = comparison.agents or comparison.guides
        panels[f"{kind} actions"] = driver_intervals(groups, strokes)
    beside = beside_guides(next(iter(compared.values())).agents)
    curves = [run for run in runs if run.curve and run.label in strokes]
    use = guide_use(curves)
    drawings: dict[str, tuple[str, str, Draw | None]] = {  # by the name of the file
        "report": (
            "Evaluation",
            "Mean return in the cases of the evaluation.",
            partial(draw_intervals, panels, measure="return"),
        ),
        "report_cases": (
            "Case by case",
            BESIDE,
            partial(draw_beside_guides, beside, strokes=strokes) if beside else None,
        ),
        "report_curves": (
            "Training",
            "Deterministic policies kept on the way.",
            _learning_curves(curves, strokes) if curves else None,
        ),
        "report_guides": (
            "Use of the guide",
            "A line for each run.",
            partial(draw_guide_use, use, strokes=strokes) if use else None,
        ),
    }
    figures = []
    for name, (title, caption, drawn) in drawings.items():
        if drawn is not None:
            drawn(folder / f"{name}{suffix}")
            figures.append(Figure(title, svg(drawn), caption))
    return [*figures, *films(runs)]


def _learning_curves(runs: Sequence[Run], strokes: Mapping[str, style.Stroke]) -> Draw:
    """Return the function that draws the learning curves in the order of the table."""
    labels = {label: [run for run in runs if run.label == label] for label in strokes}
    curves = {label: [run.curve for run in own] for label, own in labels.items() if own}
    guides = {label: guide_return(labels[label]) for label in curves}
    guides = {label: line for label, line in guides.items() if not math.isnan(line)}
    lines = list(guides.values())
    several_guides = not all(math.isclose(line, lines[0], rel_tol=SAME_LINE) for line in lines)
    if several_guides or len(curves) > MAX_CURVES:
        return partial(draw_curve_grid, curves, strokes=strokes, guides=guides)
    guide = {"guide": next(iter(guides.values()))} if guides else {}
    sizes = {_cases_of_curve(run) for run in runs}
    cases = sizes.pop() if len(sizes) == 1 else None
    return partial(draw_learning_curves, curves, strokes=strokes, guides=guide, cases=cases)


def _cases_of_curve(run: Run) -> int | None:
    """Return the number of cases of the curve of a run; None if its configuration has none."""
    curve = (run.settings.get("evaluation") or {}).get("curve") or {}
    count = curve.get("num_envs")
    return count if isinstance(count, int) else None


def films(runs: Sequence[Run]) -> list[Figure]:
    """Return the first case of the first run of each label, of the first `MAX_FILMS` labels.

    It is shown in time and as a film, if the run has drawn them.

    Raises:
        UserError: for a file that is no picture, or too large.
    """
    found: dict[tuple[str, str], Figure] = {}
    for run, (name, (title, caption)) in product(runs, FILMS.items()):
        path = run.folder / name
        if (run.label, title) in found or len(found) == MAX_FILMS or not path.exists():
            continue
        with file_of_a_run(path, RESTORE):
            image = embedded(read_file(path, LARGEST_FILM))
        figure = Figure(f"{title} of {run.label}", image, f"{caption}, seed {run.seed}.")
        found[run.label, title] = figure
    return list(found.values())
