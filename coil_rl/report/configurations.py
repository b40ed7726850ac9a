"""Configurations of runs with one label: what differs between them besides the seed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from coil_rl.measures import Measure
from coil_rl.plain_yaml import is_part, leaves
from coil_rl.report.runs import FALLBACK, Run
from coil_rl.report.sentences import REPORT

CALLED_SEED = ("seed", "random_state")  # ends of keys; the second is of scikit-learn
# Keys, or parents of keys, on which the numbers of a run do not depend, or only by rounding.
IRRELEVANT = (
    "seed",
    "label",
    "run_dir",
    "existing",
    "resume",
    "trust",
    "logger",
    "device",
    "threads",
    "compile",
    "checkpoint_every",
    "proxy.folder",
    "evaluation.gif",
    "evaluation.pictures",
)
# Keys, or parents of keys, of the test that a run ends with.
TEST = (
    "env",
    "track",
    "disturb",
    "evaluation.cases",
    "evaluation.env",
    "evaluation.disturb",
    "evaluation.first_seed",
)
# Those that runs have to share to be compared: task, test, what is observed, and frames.
CONDITIONS = (*TEST, "evaluation.repeats", "observes", "budget.frames")
BATCH = ("num_envs", "workers", "device")  # last parts of keys of an env that are no condition
# Keys, or parents of keys, whose random numbers the drives of a guide depend on.
OF_GUIDES = ("guide", "degrade", "disturb", "env", "evaluation")
CASE_SEEDS = ("evaluation.env.first_seed", "evaluation.env.seed")  # instead of that of the env
LEARNED_GUIDES = "guides"  # in method.learner, of a method whose guides learn
LONGEST_VALUE = 40  # characters of a value in a label
MOST_KEYS = 3  # in a label


def distinguish(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Give runs of one label different labels where their configurations differ.

    Returns:
        The runs in their order, and a sentence for each label that was divided.
    """
    distinguished, sentences = list(runs), []
    for label in dict.fromkeys(run.label for run in runs):
        of_label = [index for index, run in enumerate(runs) if run.label == label]
        keys = differing([runs[index] for index in of_label])
        if not keys:
            continue
        configurations = {index: relevant(runs[index]) for index in of_label}
        keys = _telling_first(keys, list(configurations.values()))
        sentences += REPORT.said("divided", label=label, keys=keys)
        values = [[configurations[index].get(key) for key in keys] for index in of_label]
        for index, shown in zip(of_label, _shown(keys, values), strict=True):
            distinguished[index] = _relabelled(runs[index], f"{label} ({shown})")
    return distinguished, sentences


def _shown(keys: Sequence[str], configurations: Sequence[list[Any]]) -> list[str]:
    """Return a text for each configuration; different ones have different texts.

    Args:
        configurations: the values of these keys for each run.
    """
    different: list[list[Any]] = []
    for values in configurations:
        if values not in different:
            different.append(values)
    texts = []
    for values in different:
        pairs = list(zip(keys, values, strict=True))[:MOST_KEYS]
        texts.append(", ".join(f"{key}={_text(value)}" for key, value in pairs))
    more = ", ..." if len(keys) > MOST_KEYS else ""
    if more or len(set(texts)) < len(different):  # the shown values may be alike
        texts = [f"{number}: {text}{more}" for number, text in enumerate(texts, start=1)]
    return [texts[different.index(values)] for values in configurations]


def of_several_envs(runs: Sequence[Run]) -> list[str]:
    """Return a warning if runs are in different envs, whose rewards cannot be compared."""
    nodes = [run.settings.get("env") or {} for run in runs]
    names = dict.fromkeys(str(node.get("id") or node.get("_target_")) for node in nodes)
    return REPORT.said("several_envs", names=list(map(_text, names)))


def of_several_conditions(runs: Sequence[Run]) -> list[str]:
    """Return a warning if runs in one env have another task, other cases or other frames.

    What experiments compare, such as the method or the guide, is no such condition.
    """
    if of_several_envs(runs):
        return []
    differ = [key for key in differing(runs) if _is_condition(key)]
    # An empty group beside its keys says nothing.
    keys = [key for key in differ if not any(each.startswith(f"{key}.") for each in differ)]
    return REPORT.said("conditions", keys=keys)


def _is_condition(key: str) -> bool:
    """Return whether runs are compared only if they have the same value of a key."""
    return is_part(key, CONDITIONS) and key.rpartition(".")[2] not in BATCH


def of_several_definitions(runs: Sequence[Run]) -> list[str]:
    """Return a warning for each measure that runs define in different ways."""
    labels: dict[str, dict[Measure, str]] = {}
    for run in runs:
        for name, measure in run.measures.items():
            # The heading and the format change no number.
            measured = replace(measure, title="", format="auto")
            labels.setdefault(name, {}).setdefault(measured, run.label)
    several = [(name, list(of.values())) for name, of in labels.items() if len(of) > 1]
    return REPORT.said("definitions", measures=several)


def _telling_first(keys: Sequence[str], configurations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return keys, first those whose values distinguish the most configurations.

    Args:
        configurations: values by key.
    """
    texts = {key: [repr(values.get(key)) for values in configurations] for key in keys}
    first: list[str] = []
    while len(first) < min(MOST_KEYS, len(keys)):
        groups = {
            key: len(set(zip(*(texts[each] for each in (*first, key)), strict=True)))
            for key in keys
            if key not in first
        }
        first.append(max(groups, key=lambda key: groups[key]))  # the first one of the best
    return [*first, *(key for key in keys if key not in first)]


def differing(runs: Sequence[Run]) -> list[str]:
    """Return the keys in which the configurations of runs differ, besides what follows the seed.

    Args:
        runs: of which none or all follow the seed in a key, such as those of one label.
    """
    configurations = [relevant(run) for run in runs]
    keys = dict.fromkeys(key for configuration in configurations for key in configuration)
    differ = []
    for key in keys:
        values = [configuration.get(key) for configuration in configurations]
        if not _follows_seed(key, values, runs) and any(value != values[0] for value in values):
            differ.append(key)
    return differ


def _follows_seed(key: str, values: Sequence[Any], runs: Sequence[Run]) -> bool:
    """Return whether a key is called a seed and has the value of the run's seed in each run.

    Other values may equal the seed by chance, as a flag and the seeds 0 and 1.
    """
    return key.endswith(CALLED_SEED) and all(
        value == run.seed and not isinstance(value, bool)
        for value, run in zip(values, runs, strict=True)
    )


def guide_follows_seed(runs: Sequence[Run]) -> bool:
    """Return whether the guides of runs are known to have other drives with each seed.

    So it is if they draw random numbers with the seed of the run, in an env that does so, if they
    come from a folder of that seed, or if they learn.

    Args:
        runs: that differ by their seed.
    """
    if any((run.settings.get("method") or {}).get("learner") == LEARNED_GUIDES for run in runs):
        return True
    if all(re.search(rf"seed{run.seed}(?!\d)", str(run.settings.get("guide"))) for run in runs):
        return True
    configurations = [relevant(run) for run in runs]
    keys = [key for key in configurations[0] if is_part(key, OF_GUIDES)]
    if any(configurations[0].get(key) is not None for key in CASE_SEEDS):
        keys = [key for key in keys if key != "env.seed"]
    return any(
        _follows_seed(key, [configuration.get(key) for configuration in configurations], runs)
        for key in keys
    )


def of_guide(run: Run) -> dict[str, Any]:
    """Return the values on which the returns of the guides of a run depend, by their full keys."""
    parts = ("guide", "degrade", *TEST)
    return {
        key: value
        for key, value in relevant(run).items()
        if is_part(key, parts) and key.rpartition(".")[2] not in BATCH
    }


def relevant(run: Run) -> dict[str, Any]:
    """Return the values on which the numbers of a run depend, by their full keys.

    The seed in the path of another run, as in `seed3`, is left out.
    """
    values: dict[str, Any] = {}
    for name, value in leaves(run.settings).items():
        if is_part(name, IRRELEVANT):
            continue
        is_text = isinstance(value, str)
        values[name] = re.sub(rf"seed{run.seed}(?!\d)", "seed", value) if is_text else value
    return values


def _text(value: Any) -> str:
    """Return a value as a short text."""
    text = "null" if value is None else str(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


def _relabelled(run: Run, label: str) -> Run:
    """Return a run with another label, also in its evaluation."""
    evaluation = run.evaluation.copy()
    renamed = {f"{run.label}{suffix}": f"{label}{suffix}" for suffix in ("", FALLBACK)}
    evaluation["driver"] = evaluation["driver"].replace(renamed)
    return replace(run, label=label, evaluation=evaluation)
