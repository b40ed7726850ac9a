"""How often a test at the end of a training hands over a policy that is worse than its guide.

    python -m benchmarks.hand_over outputs/experiments/guide_benchmark

Each folder in it has the runs of one task. The scale of a task is the distance from its lowest to
its highest mean return. The returns of a policy minus those of its guide in the same cases are
shifted: their mean becomes a known share of the scale, by which the policy is better or worse. A
test draws some of these differences at random, with replacement, and decides by a rule.

The table has a row for each rule and number of cases: the share of tests that hand over the policy
at each shift, and the regret. That is the loss against always handing over the better of the two,
averaged over the shifts, as a share of the scale.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from coil_rl.errors import UserError
from coil_rl.report import markdown_table
from coil_rl.report.runs import GUIDE, Run, read_runs

Differences = NDArray[np.float64]  # [tests, cases]
SHIFTS = (0.1, 0.03, 0.01, 0.0, -0.01, -0.03, -0.1)  # of the scale
CASES = (2, 4, 8, 16, 32)
TESTS = 1_000  # for each policy, shift and number of cases
EVIDENCE = 20  # of the sequential test: it decides wrongly in at most 1 of 20 tests


def t_values(found: Differences) -> NDArray[np.float64]:
    """Return the mean of each test in standard errors."""
    error = found.std(1, ddof=1) / np.sqrt(found.shape[1])
    return found.mean(1) / np.maximum(error, 1e-12)


def by_mean(found: Differences) -> NDArray[np.bool_]:
    """Hand over what has the higher mean, as `delivery=tested` does."""
    return found.mean(1) > 0


def by_error(found: Differences) -> NDArray[np.bool_]:
    """Hand over a policy that is better by a standard error."""
    return t_values(found) > 1


def by_t_test(found: Differences) -> NDArray[np.bool_]:
    """Hand over a policy that is better at the 5 % level."""
    return t_values(found) > stats.t.ppf(0.95, found.shape[1] - 1)


def in_sequence(found: Differences) -> NDArray[np.bool_]:
    """Hand over a policy that is better in a test that may stop after any case.

    It is the sequential t test with a mixture over effects (Wang and Ramdas 2023, section 4.2).
    """
    n = np.arange(1, found.shape[1] + 1)
    squares, sums = (found**2).cumsum(1), found.cumsum(1)
    ratio = (n + 1) * squares / np.maximum((n + 1) * squares - sums**2, 1e-300)
    evidence = ratio ** (n / 2) / np.sqrt(n + 1)
    decided = evidence[:, 1:] >= EVIDENCE
    first = decided.argmax(1) + 1
    better = sums[np.arange(len(sums)), first] > 0
    return decided.any(1) & better


RULES: dict[str, Callable[[Differences], NDArray[np.bool_]]] = {
    "higher mean": by_mean,
    "better by a standard error": by_error,
    "better at 5 %": by_t_test,
    "sequential, 5 %": in_sequence,
}


def differences_of(runs: Sequence[Run]) -> list[NDArray[np.float64]]:
    """Return the differences of policy and guide of the runs of a task, in parts of its scale.

    Runs without a guide, and those whose policy is the guide, are left out.
    """
    pairs, means = [], []
    for run in runs:
        if not run.finished:
            continue
        own, guide = (
            run.episodes_of(name).sort_values("case")["reward"].to_numpy()
            for name in (run.label, GUIDE)
        )
        if len(own) == len(guide) and not np.allclose(own, guide):
            pairs.append(own - guide)
        means += [values.mean() for values in (own, guide) if len(values)]
    return [pair / (max(means) - min(means)) for pair in pairs]


def rows_of(pairs: Sequence[NDArray[np.float64]], seed: int = 0) -> list[dict[str, Any]]:
    """Return a row for each rule and number of cases."""
    random, rows, shifts = np.random.default_rng(seed), [], np.array(SHIFTS)
    for cases in CASES:
        handed = {name: np.zeros(len(SHIFTS)) for name in RULES}
        for place, shift in enumerate(SHIFTS):
            for pair in pairs:
                drawn = random.choice(pair - pair.mean(), (TESTS, cases)) + shift
                for name, rule in RULES.items():
                    handed[name][place] += rule(drawn).mean() / len(pairs)
        for name, shares in handed.items():
            lost = np.abs(shifts) * np.where(shifts > 0, 1 - shares, shares)
            row: dict[str, Any] = {"cases": cases, "rule": name}
            row |= {f"{shift:+.0%}": share for shift, share in zip(SHIFTS, shares, strict=True)}
            rows.append(row | {"regret": float(lost.mean())})
    return rows


def main() -> None:
    """Print the table of the runs in a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the experiments, with a folder for each task")
    folder = parser.parse_args().folder
    try:
        tasks = [each for each in sorted(folder.iterdir()) if any(each.glob("*/config.yaml"))]
        pairs = [pair for task in tasks for pair in differences_of(read_runs([task]))]
    except (OSError, UserError) as error:
        parser.error(str(error))
    if not pairs:
        parser.error(f"{folder} has no finished runs with a guide")
    columns = {"cases": ("cases", "d"), "rule": ("rule", "")}
    columns |= {f"{shift:+.0%}": (f"{shift:+.0%}", ".0%") for shift in SHIFTS}
    print(f"{len(pairs)} policies of {len(tasks)} tasks, {TESTS} tests of each and shift\n")
    print(markdown_table(rows_of(pairs), columns | {"regret": ("regret", ".2%")}))


if __name__ == "__main__":
    main()
