"""Make a shipped policy of a finished run: `python -m benchmarks.ship RUN NAME`.

For maintainers. It copies what opening the run needs into `coil_rl/policies/NAME`, without paths of
this machine, writes the card, and adds the checksums. `python -m benchmarks.ship RUN NAME` replaces
an older policy of that name.
"""

import hashlib
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coil_rl.config.folder import CARD, CHECKSUMS, LARGEST
from coil_rl.files import write_text
from coil_rl.measures import MEAN_CASE
from coil_rl.plain_yaml import leaves, read_yaml, yaml_of
from coil_rl.record import COMMAND, DELIVERY, EVALUATION, SECONDS, VERSIONS
from coil_rl.report.table import markdown_table
from coil_rl.run.folder import CONFIG, HANDED_OVER, weights_file
from coil_rl.run.reasons import handed_over

PLACE = Path(__file__).parents[1] / "coil_rl" / "policies"
COLUMNS = {
    "driver": ("driver", ""),
    "actions": ("actions", ""),
    "reward": ("reward", ".1f"),
    "completed": ("completed", ".0%"),
    "lap_time": ("lap time (s)", ".1f"),
    "smoothness": ("smoothness", ".3f"),
}


def ship(run: Path, name: str) -> Path:
    """Make a shipped policy, and return its folder.

    Args:
        name: of the policy, such as "cone_track/coil".

    Raises:
        SystemExit: for a file that is too large, and for a path in the configuration.
    """
    settings = read_yaml(run / CONFIG)
    settings["run_dir"], settings["logger"] = "pretrained", None
    for key, value in leaves(settings).items():
        if isinstance(value, str) and value.startswith(("/", "~")):
            raise SystemExit(f"{CONFIG}.{key}={value} is a place on this machine")
    tested = settings["delivery"] == "tested"
    folder = PLACE / name
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / CONFIG, yaml_of(settings))
    files = [weights_file(run, HANDED_OVER if tested else "last").name, EVALUATION.name]
    files += [DELIVERY.name] if tested else []
    for file in files:
        (folder / file).write_bytes((run / file).read_bytes())
    write_text(folder / CARD, card(run, name, settings))
    for path in folder.iterdir():
        if path.stat().st_size > LARGEST:
            raise SystemExit(f"{path} has more than {LARGEST} bytes")
    _add_checksums(name, folder)
    return folder


def _add_checksums(name: str, folder: Path) -> None:
    path = PLACE / CHECKSUMS
    known = json.loads(path.read_text()) if path.exists() else {}
    known[name] = {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.iterdir())
        if file.is_file()
    }
    write_text(path, json.dumps(dict(sorted(known.items())), indent=2))


def card(run: Path, name: str, settings: Mapping[str, Any]) -> str:
    """Return the card of a policy."""
    rows = EVALUATION.need(run)
    means = [row for row in rows if row["case"] == MEAN_CASE]
    cases = len({row["case"] for row in rows}) - 1
    columns = {key: column for key, column in COLUMNS.items() if key in means[0]}
    guides = ", ".join(settings["guide"]) or "none"
    env = settings["env"]
    title = env.get("id") or env["_target_"].rpartition(".")[2]
    versions = VERSIONS.need(run)
    names = ("python", "torch", "torchrl", "tensordict", "gymnasium")
    made = ", ".join(f"{each} {versions[each]}" for each in names)
    seconds = SECONDS.need(run)["seconds"]
    parts = [
        f"# {name}",
        f"The policy of one training of `{settings['method']['name']}` in {title}. "
        f"Guide: {guides}. Its seed is {settings['seed']}, which was chosen before the training: "
        "it is not the best of several.",
        f"- {settings['budget']['frames']:,} frames, {seconds:.0f} s on a CPU that others used too",
        f"- made by `{_command(run)}`",
        f"- {made}",
        f"Means of {cases} cases that the training never saw; one episode a case with "
        f"deterministic actions, sampled ones {settings['evaluation']['repeats']} a case:",
        markdown_table(means, columns),
    ]
    parts += handed_over(run)
    parts.append(
        f"`coil-evaluate run=pretrained:{name}` repeats the evaluation; in Python "
        f'`coil_rl.pretrained("{name}").controller()` is the policy with all that belongs to it.'
    )
    return "\n\n".join(parts).replace("\n\n- ", "\n- ").replace("several.\n- ", "several.\n\n- ")


def _command(run: Path) -> str:
    """Return the command that made a run, without what says where it was written."""
    words = COMMAND.need(run)
    kept = [word for word in words if not word.startswith(("hydra.run.dir=", "logger="))]
    return shlex.join(kept)


def main(arguments: Sequence[str]) -> None:
    """Entry point."""
    if len(arguments) != 2:
        raise SystemExit("give the folder of a run and a name: python -m benchmarks.ship RUN NAME")
    print(ship(Path(arguments[0]), arguments[1]))


if __name__ == "__main__":
    main(sys.argv[1:])
