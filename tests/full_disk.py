"""Train on a disk that is full at random moments, resume, and compare with an uninterrupted run.

    python tests/full_disk.py --runs 10 [--seed 0] [--folder FOLDER] [--disk FOLDER] [OVERRIDES of
    coil-train ...]

A limit of the size of each file stands for the full disk. With `--disk`, the folder of a small file
system of its own (mount -t tmpfs -o size=16m tmpfs FOLDER), a file fills that disk up to a random
rest.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import sys
import tempfile
from pathlib import Path

from kill_and_resume import describe_state, differences, finish, start

# What a full disk makes of a logger, which is no result.
LEFT_OUT = r"the logger TensorboardLogger of .* is left out \(OSError: .*(No space|File too large)"


def interrupted_by_full_disk(
    folder: Path, overrides: list[str], room: int, disk: Path | None
) -> list[str]:
    """Start a run with so many bytes of room; return its standard error without the progress."""
    filler = folder.parent / "filler"
    if disk:
        with filler.open("wb") as file:
            file.write(bytes(max(0, shutil.disk_usage(disk).free - room)))
    errors, of_program = os.pipe()

    def prepare() -> None:
        os.dup2(of_program, 2)
        os.close(of_program)
        if not disk:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))

    process = start(folder, overrides, prepare)
    os.close(of_program)
    with open(errors) as file:
        lines = [
            line
            for line in file.read().splitlines()
            if line.strip() and not re.search(f"%|step/s|{LEFT_OUT}", line)
        ]
    process.join()
    filler.unlink(missing_ok=True)
    return lines if process.exitcode == 2 else [f"exit code {process.exitcode}", *lines]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=10, help="number of runs with a full disk")
    parser.add_argument("--seed", type=int, default=0, help="of the room")
    parser.add_argument("--folder", type=Path, help="of the runs; temporary by default")
    parser.add_argument("--disk", type=Path, help="file system to fill")
    arguments, overrides = parser.parse_known_args(argv)
    draw, wrong = random.Random(arguments.seed), 0
    with tempfile.TemporaryDirectory(dir=arguments.disk) as temporary:
        place = (
            Path(temporary) if arguments.disk else (arguments.folder or Path(temporary)).absolute()
        )
        finish(place / "whole", overrides)
        sizes = [file.stat().st_size for file in (place / "whole").rglob("*") if file.is_file()]
        for number in range(1, arguments.runs + 1):
            folder = place / f"full_{number}"
            room = round(
                draw.uniform(4096, sum(sizes)) if arguments.disk else 10 ** draw.uniform(3, 5.5)
            )
            lines = interrupted_by_full_disk(folder, overrides, room, arguments.disk)
            state = describe_state(folder) if folder.exists() else "before the run"
            finish(folder, overrides)
            found = differences(place / "whole", folder)
            is_one_sentence = len(lines) == 1 and "cannot be" in lines[0]
            # A limit may be larger than all files.
            if not found and (is_one_sentence or lines == ["exit code 0"]):
                verdict = "OK"
            else:
                verdict = f"WRONG: {found} {lines}"
                wrong += 1
            print(
                f"{number:3}  {room:8} bytes: {state:40} {(lines or [''])[-1]}  {verdict}",
                flush=True,
            )
            if arguments.disk:
                shutil.rmtree(folder)
    print(
        f"{arguments.runs - wrong} of {arguments.runs} runs with a full disk "
        "ended like the uninterrupted one"
    )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
