"""`coil-distill`: train a network that imitates each guide, and print how well it does."""

from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.programs import app


def distill(config: DictConfig) -> float:
    """Train the missing proxies of all guides, and return the lowest mean test reward of a proxy."""
    from coil_rl.report.table import TABLES, markdown_table
    from coil_rl.train import distillation
    from coil_rl.train.build import build_guides
    from coil_rl.train.run import run

    table = []
    for name in build_guides(config):
        proxy_config = distillation.proxy_config(config, name)
        reward = run(proxy_config, wait=True)
        table.append({"guide": name, "reward": reward, **_measures(Path(proxy_config.run_dir))})
    print(markdown_table(table, TABLES["proxies"]["columns"]))
    worst = min(table, key=lambda row: float(row["reward"]))
    print(
        f"distill: made {len(table)}; the lowest mean reward is {worst['reward']:.1f}, "
        f"that of its guide {worst['guide_reward']:.1f}"
    )
    return float(worst["reward"])


def _measures(folder: Path) -> dict[str, Any]:
    from coil_rl.report.runs import read_runs

    (run,) = read_runs([folder])
    learned = {name.removeprefix("learner/"): value for name, value in run.curve[-1].items()}
    means = run.evaluation.groupby("driver", sort=False)[["reward", "completed"]].mean()
    rewards = {"guide_reward": float(means["reward"].iloc[0]), "completed": float(means["completed"].iloc[-1])}
    return learned | rewards | {"folder": str(folder)}


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration of the proxies, and make their folder."""
    from coil_rl.train.check import check_proxies, check_values, make_folder

    used = ("preset", "track", "env", "guide", "evaluation", "proxy")
    app.check_used(used, "a proxy is trained as the key proxy says")
    check_values(config)
    check_proxies(config, config.guide)
    make_folder(Path(config.proxy.folder))


main = partial(app.run, distill, "distill", check)

if __name__ == "__main__":
    main()
