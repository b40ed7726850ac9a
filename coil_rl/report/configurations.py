"""Configurations of runs: which share their test, which are one method, and what differs.

Cases belong to the env in which they are, so that only runs with one test are compared. Runs of one
label whose configurations differ get names with numbers, and what differs is said in a table.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Collection, Mapping, Sequence
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
    "env.render",
    "evaluation.env.render",
)
# Keys, or parents of keys, of the test that a run ends with: others make other cases.
TEST = (
    "env",
    "track",
    "disturb",
    "evaluation.cases",
    "evaluation.env",
    "evaluation.disturb",
    "evaluation.first_seed",
)
# Those that runs have to share to be compared: episodes of a case, what is observed, and frames.
CONDITIONS = ("evaluation.repeats", "observes", "budget.frames")
# Last parts of keys of an env that change no case.
BATCH = ("num_envs", "workers", "device", "render", "info")
# Keys, or parents of keys, whose random numbers the drives of a guide depend on.
ADVICE = ("guide", "degrade")
OF_GUIDES = ("guide", "degrade", "disturb", "env", "evaluation")
CASE_SEEDS = ("evaluation.env.first_seed", "evaluation.env.seed")  # instead of that of the env
LEARNED_GUIDES = "guides"  # in method.learner, of a method whose guides learn
LONGEST_NAME = 30  # characters
LONGEST_VALUE = 40  # characters
MOST_KEYS = 3  # that nobody typed


Differing = list[dict[str, str]]  # rows of a table: the new name, and what differs


def distinguish(runs: Sequence[Run]) -> tuple[list[Run], Differing]:
    """Give runs short labels, with numbers where those of one label have different configurations.

    Returns:
        The runs in their order, and a row for each label that is new.
    """
    named, rows = _named(runs, lambda run: run.label, lambda _: True)
    labels = {run: label for label, of_label in named.items() for run in of_label}
    return [_relabelled(run, labels[run]) for run in runs], rows


def by_test(runs: Sequence[Run]) -> tuple[dict[str, list[Run]], Differing]:
    """Return the runs that share an env and the cases of its test, by the name of the env.

    Returns:
        The runs by a name, with a number where one env has several tests, and a row for each of
        these names.
    """
    return _named(runs, env_name, _is_of_test)


def env_name(run: Run) -> str:
    """Return the name of the env of a run; empty for one that was made from parts."""
    node = run.settings.get("env") or {}
    if node.get("id"):
        return str(node["id"]).rpartition(":")[2]
    return str(node.get("_target_", "")).rpartition(".")[2]


def _is_of_test(key: str) -> bool:
    """Return whether the cases of a test depend on a key."""
    return is_part(key, TEST) and key.rpartition(".")[2] not in BATCH


def _named(
    runs: Sequence[Run], name_of: Callable[[Run], str], divides: Callable[[str], bool]
) -> tuple[dict[str, list[Run]], Differing]:
    """Return runs by short names, and a row for each name that is new.

    Args:
        name_of: gives a run the name that it has at first.
        divides: whether runs of one name get different ones where a key of theirs differs.
    """
    of_names: dict[str, list[Run]] = {}
    for run in runs:
        of_names.setdefault(name_of(run), []).append(run)
    found: dict[str, tuple[list[list[Run]], list[str]]] = {}
    for name, of_name in of_names.items():
        keys = list(filter(divides, differing(of_name)))
        alike: dict[str, list[Run]] = {}
        for run in of_name:
            values = relevant(run)
            alike.setdefault(repr([values.get(key) for key in keys]), []).append(run)
        groups = list(alike.values())
        found[name] = groups, _what_differs(groups, keys, divides)
    unchanged = {
        name for name, (of, _) in found.items() if len(of) == 1 and len(name) <= LONGEST_NAME
    }
    named: dict[str, list[Run]] = {}
    rows: Differing = []
    for name, (groups, told) in found.items():
        for group, differs in zip(groups, told, strict=True):
            new = name
            if name not in unchanged:
                new = _free_name(name, {*unchanged, *named}, len(groups))
            named[new] = group
            if new != name:
                cut = "" if len(name) <= LONGEST_NAME else f"of {name}"
                rows.append({"name": new, "differs": ", ".join(filter(None, (cut, differs)))})
    return named, rows


def _free_name(name: str, taken: Collection[str], several: int) -> str:
    """Return a short name that is not taken, with a number if there are several of it."""
    short = name if len(name) <= LONGEST_NAME - 4 else f"{name[: LONGEST_NAME - 5]}…"
    alone = [each for each in (name, short) if several == 1 and len(each) <= LONGEST_NAME]
    numbered = (f"{short} {number}" for number in itertools.count(1))
    return next(each for each in itertools.chain(alone, numbered) if each not in taken)


def _what_differs(
    groups: Sequence[Sequence[Run]], keys: Sequence[str], divides: Callable[[str], bool]
) -> list[str]:
    """Return what was typed for all runs of each of some groups, and not for all groups, as a text.

    Where that does not tell them apart, it is values of their configurations.

    Args:
        keys: that tell the groups apart.
        divides: see `_named`; words of other keys are left out.
    """
    if len(groups) == 1:
        return [""]
    common = [_common([_typed(run) for run in runs]) for runs in groups]
    values = [_common([relevant(run) for run in runs]) for runs in groups]
    typed = list(filter(divides, dict.fromkeys(itertools.chain.from_iterable(common))))
    typed = [key for key in typed if len({words.get(key) for words in common}) > 1]
    # Two words may write one value.
    typed = [key for key in typed if key in keys or not any(key in of for of in values)]
    telling = _telling_first(keys, values)
    texts = [
        [words.get(key) or f"{key}={_text(of[key])}" for key in typed if key in words or key in of]
        for words, of in zip(common, values, strict=True)
    ]
    if len(set(map(repr, texts))) < len(texts):
        more = ["..."] if len(telling) > MOST_KEYS else []
        texts = [
            [*(f"{key}={_text(of.get(key))}" for key in telling[:MOST_KEYS]), *more]
            for of in values
        ]
    return [", ".join(each) for each in texts]


def _common(nodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the values that several mappings have in common."""
    first, *others = nodes
    return {
        key: value
        for key, value in first.items()
        if all(key in other and other[key] == value for other in others)
    }


def _typed(run: Run) -> dict[str, str]:
    """Return the words of the command of a run on which its numbers depend, by their key."""
    words = {word.partition("=")[0].lstrip("+~"): word for word in run.command[1:]}
    return {key: word for key, word in words.items() if not is_part(key, (*IRRELEVANT, "hydra"))}


def of_several_conditions(runs: Sequence[Run]) -> list[str]:
    """Return a warning if runs with one test observe something else, or have other frames.

    What experiments compare, such as the method or the guide, is no such condition.

    Args:
        runs: of one group of `by_test`.
    """
    differ = [key for key in differing(runs) if is_part(key, CONDITIONS)]
    # An empty group beside its keys says nothing.
    keys = [key for key in differ if not any(each.startswith(f"{key}.") for each in differ)]
    return REPORT.said("conditions", keys=keys)


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
    values = relevant(run)
    return {key: values[key] for key in values if is_part(key, ADVICE) or _is_of_test(key)}


def relevant(run: Run) -> dict[str, Any]:
    """Return the values on which the numbers of a run depend, by their full keys.

    The seed in the path of another run, as in `seed3`, is left out.
    """
    values = {
        name: value for name, value in leaves(run.settings).items() if not is_part(name, IRRELEVANT)
    }
    for name, value in values.items():
        if isinstance(value, str):
            values[name] = re.sub(rf"seed{run.seed}(?!\d)", "seed", value)
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
