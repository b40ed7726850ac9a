"""Names of policies and recordings: plain enough for a topic, and no two alike."""

from __future__ import annotations

import re
from collections.abc import Sequence


def plain(name: str) -> str:
    """A name with nothing but letters, digits and single underscores, which begins with a letter, as topics demand.

    Example:
        >>> plain("coil, lr=0.1"), plain("2nd try")
        ('coil_lr_0_1', 'policy_2nd_try')
    """
    kept = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return kept if kept[:1].isalpha() else f"policy_{kept}".rstrip("_")


def of_runs(labels: Sequence[str], seeds: Sequence[int]) -> list[str]:
    """What runs are called: by their labels, with the seeds where labels are shared, and numbered where those are too.

    Example:
        >>> of_runs(["ppo", "coil", "coil", "coil"], [0, 0, 1, 1])
        ['ppo', 'coil_seed0', 'coil_seed1_1', 'coil_seed1_2']
    """
    names = [plain(label) for label in labels]
    seeded = zip(names, seeds, strict=True)
    return numbered([f"{name}_seed{seed}" if names.count(name) > 1 else name for name, seed in seeded])


def numbered(names: Sequence[str]) -> list[str]:
    """The same names, those that come several times numbered in their order."""
    return [f"{name}_{names[: n + 1].count(name)}" if names.count(name) > 1 else name for n, name in enumerate(names)]


def repeated(names: Sequence[str]) -> str | None:
    """The first name that comes a second time, if one does."""
    return next((name for n, name in enumerate(names) if name in names[:n]), None)
