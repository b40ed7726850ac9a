"""Words of the command line that nothing reads: they would have no effect, and are refused."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.compose import REFERENCE, Job, covers, key_of, leaves
from coil_rl.config.parts import advises, env_maker, learner_kind, trains_guides
from coil_rl.errors import UserError
from coil_rl.report.configurations import is_part

# Keys that other values refer to, and that nothing else reads.
REFERRED = (
    "preset",
    "track",
    "recording",
    "training.learning_rate",
    "training.imitation_env",
    "budget.minibatches",
)
# Keys that no run reads that tunes its guide.
OF_A_LEARNER = (
    "learner",
    "network",
    "training.learning_rate",
    "training.normalise",
    "training.scale_rewards",
    "training.noise_correlation",
    "budget.num_envs",
    "budget.steps",
    "budget.minibatches",
    "checkpoint_every",
    "evaluation.repeats",
)
# Keys that no run reads whose guide acts alone.
OF_A_TRAINING = (
    *("learner", "network", "training", "budget", "checkpoint_every", "logger", "watch"),
    *("observes", "action", "compile", "evaluation.curve", "evaluation.guides"),
    *("evaluation.repeats", "evaluation.policy"),
)


def check_read(config: DictConfig, task: Iterable[str]) -> None:
    """Refuse a word of the command line that a run does not read.

    Args:
        config: of the run, composed and checked.
        task: words for the program.

    Raises:
        UserError: for the first word without an effect.
    """
    for sentence in unread(config, task):
        raise UserError(sentence)


def unread(config: DictConfig, task: Iterable[str]) -> Iterator[str]:
    """Yield a sentence for each word of the command line that a run does not read.

    Args:
        config: of the run, composed and checked.
        task: words for the program.
    """
    reasons = Reasons(config)
    for text in task:
        if reason := reasons.of(key_of(text)):
            yield f"{text} has no effect: {reason}"


def check_sweep(task: Iterable[str], jobs: Sequence[Job]) -> list[str]:
    """Refuse a word that no run of a sweep reads.

    Args:
        task: words for the program, those of the sweep as they were given.
        jobs: all runs of the sweep.

    Returns:
        a sentence for each word that only some of the runs read.

    Raises:
        UserError: for the first word that none of them reads.
    """
    rules = [Reasons(job.config) for job in jobs]
    sentences = []
    for text in task:
        reasons = [rule.of_unchecked(key_of(text)) for rule in rules]
        unread = [job for job, reason in zip(jobs, reasons, strict=True) if reason]
        if unread and len(unread) == len(jobs):
            raise UserError(f"{text} has no effect in any run of this sweep: {reasons[0]}")
        if unread:
            read = [job for job, reason in zip(jobs, reasons, strict=True) if not reason]
            sentences.append(
                f"{text} has no effect in the runs with {_told_apart(unread, read)}; the others "
                "read it"
            )
    return sentences


def _told_apart(some: Sequence[Job], others: Sequence[Job]) -> str:
    """Return the words by which some runs of a sweep differ from the others, in short."""
    sets, other_sets = [
        [{key_of(word): word for word in job.words} for job in group] for group in (some, others)
    ]
    for key in sets[0]:
        words = list(dict.fromkeys(each[key] for each in sets))
        if not {*words} & {each[key] for each in other_sets}:
            values = [word.partition("=")[2] for word in words]
            return f"{words[0].partition('=')[0]}={','.join(values)}"
    common = {*some[0].words}.intersection(*(job.words for job in (*some, *others)))
    each = [" ".join(word for word in job.words if word not in common) for job in some]
    return "; ".join(each)


class Reasons:
    """Why a run does not read a key.

    Args:
        config: of the run, composed and checked.
    """

    def __init__(self, config: DictConfig) -> None:
        self.config, self.method = config, f"method={config.method.name}"
        self.rules = (
            self._of_proxies,
            self._of_tests,
            self._of_references,
            self._of_method,
            self._of_advice,
            self._of_noise,
        )

    def of(self, key: str) -> str:
        """Return why the run does not read a key, and what to do; empty if it may read it.

        Args:
            key: full key of a word.
        """
        return next(filter(None, (rule(key) for rule in self.rules)), "")

    def of_unchecked(self, key: str) -> str:
        """Return why nothing reads a key, as `of` does, for a configuration that was not checked.

        The result is empty if the configuration is wrong: the check of its run says so.

        Args:
            key: full key of a word.
        """
        try:
            return self.of(key)
        except (UserError, OmegaConfBaseException):
            return ""

    def _of_proxies(self, key: str) -> str:
        if not key.startswith("proxy.") or trains_guides(self.config):
            return ""
        return (
            f"{self.method} trains no guides, for which a proxy would stand; leave it out, or take "
            "method=dynamic_coil_sequential"
        )

    def _of_tests(self, key: str) -> str:
        anchored = OmegaConf.select(self.config, "learner.anchor") is not None
        tests = anchored or self.config.method.search or self.config.delivery == "tested"
        if tests or not is_part(key, ["training.tests"]):
            return ""
        return (
            "this run compares no policies while it trains; leave it out, or give delivery=tested"
        )

    def _of_references(self, key: str) -> str:
        if not is_part(key, REFERRED) or _touches(key, self.references):
            return ""
        return f"nothing in this run reads {key}; leave it out"

    def _of_method(self, key: str) -> str:
        has_agent = self.config.method.observes is not None
        if has_agent and not self.config.method.search:
            return ""
        unread = OF_A_LEARNER if has_agent else OF_A_TRAINING
        if not is_part(key, unread) or _touches(key, self._references_beside(unread)):
            return ""
        what = "tunes its guide and has no learner" if has_agent else "trains nothing"
        return f"{self.method} {what}; leave it out"

    def _of_advice(self, key: str) -> str:
        if not is_part(key, ["evaluation.advice"]) or advises(self.config):
            return ""
        return f"{self.method} gives the agent no advice that could be degraded; leave it out"

    def _of_noise(self, key: str) -> str:
        if key != "training.noise_correlation":
            return ""
        if learner_kind(self.config) == "imitation":
            return f"{self.method} imitates, and explores without noise; leave it out"
        env = env_maker(self.config)()
        if env.full_action_spec[env.action_key].dtype.is_floating_point:
            return ""
        return "the actions of this env are choices, to which no noise is added; leave it out"

    @cached_property
    def references(self) -> set[str]:
        """The keys that values of the configuration refer to."""
        return self._references_beside(())

    def _references_beside(self, unread: Collection[str]) -> set[str]:
        """Return the keys that values refer to, but those that are not read.

        Of an evaluation that is the number of rows, too: it has one for each case.
        """
        values: Any = OmegaConf.to_container(self.config, resolve=False)
        found: set[str] = set()
        for key, value in leaves(values, ""):
            if unread and (is_part(key, unread) or key == "env.num_envs"):
                continue
            if isinstance(value, (str, list)):
                found |= {name for name in REFERENCE.findall(str(value)) if name != key}
        return found


def _touches(key: str, others: Iterable[str]) -> bool:
    """Return whether a key is one of some others, inside one, or around one."""
    return any(covers(key, other) for other in others)
