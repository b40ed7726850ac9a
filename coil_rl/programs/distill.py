"""`coil-distill`: train a network that imitates each guide, and print how well it does."""

from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from coil_rl.programs import app


def distill(config: DictConfig) -> float:
    """Train the missing proxies of all guides; return the lowest mean test reward of a proxy."""
    from coil_rl.config import parts
    from coil_rl.config.assemble import run_configured
    from coil_rl.config.parts import build_guides
    from coil_rl.report.runs import read_runs
    from coil_rl.report.table import TABLES, markdown_table, return_format
    from coil_rl.run.folder import is_evaluated

    table, found = [], 0
    for name in build_guides(config):
        proxy_config = parts.proxy_config(config, name)
        found += is_evaluated(Path(proxy_config.run_dir))
        reward = run_configured(proxy_config, wait=True)
        (finished,) = read_runs([Path(proxy_config.run_dir)])
        row: dict[str, Any] = {}
        for key, value in finished.curve[-1].items():
            row[key.removeprefix("learner/")] = value
        results = finished.evaluation.groupby("driver", sort=False)
        row |= {
            "guide": name,
            "reward": reward,
            "guide_reward": results["reward"].mean().iloc[0],
            "folder": str(finished.folder),
        }
        if "completed" in finished.evaluation:
            row["completed"] = results["completed"].mean().iloc[-1]
        table.append(row)
    columns = TABLES["proxies"]["columns"]
    print(markdown_table(table, {key: columns[key] for key in columns if key in table[0]}))
    worst = min(table, key=lambda row: row["reward"])
    spec = return_format([worst["reward"], worst["guide_reward"]])
    print(
        f"distill: made {len(table) - found}, found {found}; the lowest mean reward is "
        f"{worst['reward']:{spec}}, that of its guide {worst['guide_reward']:{spec}}"
    )
    return float(worst["reward"])


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration of the proxies."""
    from coil_rl.config.check import check_proxies

    used = ("preset", "track", "env", "disturb", "guide", "evaluation", "proxy")
    app.check_used(used, "a proxy is trained as the key proxy says")
    app.check_folder("proxy.folder")
    check_proxies(config, config.guide)


main = partial(app.run_program, distill, "distill", check)

if __name__ == "__main__":
    main()
