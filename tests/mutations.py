"""Random changes of configurations, of files of runs, and of other inputs, for the fuzz test."""

import contextlib
import copy
import csv
import hashlib
import json
import math
import random
import shutil
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from coil_rl.envs.recordings.mcap_files import Channel, RawMessage, RecordingWriter, read_messages
from coil_rl.envs.recordings.messages import SCAN, decode, definition, encode
from coil_rl.run import checkpoint

LARGE = [1000, 2**31, 2**63 - 1, 2**63, 10**30, 1e23, 1e300]
NUMBERS = [-1, 0, 1, 2, 5, 1.5, -0.5, math.nan, math.inf, -math.inf, 1e-300, True]
TEXTS = [
    "",
    "abc",
    "1e400",
    "null",
    "???",
    "${seed}",
    "${nope}",
    "${env}",
    "${oc.env:HOME}",
    "${",
    "日本 é",
    "\u202e\u0300",
    "a\nb",
    "a/b",
    "x" * 300,
    "../outside/file",
    "/dev/null/x",
    "~nobody_x",
    ".",
    "runs/ppo",
    "last",
]
TREES: list[Any] = [
    None,
    [],
    [[]],
    [1, "a"],
    {},
    {"a": 1},
    {"_target_": "coil_rl.guides.ZeroGuide"},
]
MARK = "touch ../outside/marker"
BOMB = b"cos\nsystem\n(S'" + MARK.encode() + b"'\ntR."  # a pickle that runs a command
# What a configuration from a stranger must not call: it writes outside of the run, or runs the
# pickle.
CALLS: list[dict[str, Any]] = [
    {"_target_": "sympy.sympify", "a": f"__import__('os').system({MARK!r})"},
    {"_target_": "os.system", "command": MARK},
    {"_target_": "subprocess.Popen", "args": MARK.split()},
    {"_target_": "distutils.spawn.spawn", "cmd": MARK.split()},
    {"_target_": "torch.utils.collect_env.run", "command": MARK},
    {"_target_": "coil_rl.run.folder._output", "command": MARK.split()},
    {"_target_": "joblib.load", "filename": "bomb.pkl"},
    {"_target_": "torch.load", "f": "bomb.pkl", "weights_only": False},
    {"_target_": "numpy.load", "file": "bomb.pkl", "allow_pickle": True},
    {"_target_": "torch.hub.load", "repo_or_dir": ".", "model": "x", "source": "local"},
    {"_target_": "builtins.open", "file": "../outside/marker", "mode": "w"},
    {"_target_": "shutil.copyfile", "src": "bomb.pkl", "dst": "../outside/marker"},
    {"_target_": "coil_rl.files.write_text", "path": "../outside/marker", "text": "x"},
]
BILLION = "\n".join(
    f"{b}: &{b} [{', '.join(9 * [f'*{a}'])}]" for a, b in zip("abcdefg", "bcdefgh", strict=True)
)
YAML_LINES = [
    "a: &a [*a]",
    "seed: 1\nseed: 2",
    f"x: !!python/object/apply:os.system [{MARK!r}]",
    "\tx: 1",
    "%YAML 9.9",
    "method: null",
    "\0",
    "? [a, b]\n: 1",
    "1: 2",
    "x: 2020-01-01",
    "x: !!binary aGk=",
    "x: !!set {a}",
    "- 1",
    f"a: &a [x, x]\n{BILLION}",
]


def junk(draw: random.Random) -> Any:
    """Return a value that is wrong in most places."""
    kinds: list[list[Any]] = [NUMBERS, TEXTS, TREES, LARGE]
    return copy.deepcopy(draw.choice(draw.choices(kinds, [8, 8, 4, 1])[0]))


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every container and key of a tree."""
    keys: Iterable[Any] = ()
    if isinstance(tree, dict):
        keys = tree
    elif isinstance(tree, list):
        keys = range(len(tree))
    for key in keys:
        yield tree, key
        yield from places(tree[key])


def mutate(tree: Any, draw: random.Random, kinds: str = "") -> tuple[Any, str]:
    """Return a tree with one change at a random place, and what was changed.

    `kinds` are further kinds of change.
    """
    tree = copy.deepcopy(tree)
    known = list(places(tree))
    if not known:
        return junk(draw), "replaced"
    (node, key), (other, other_key) = draw.choice(known), draw.choice(known)
    kind, value, new = (
        draw.choice(f"junk junk delete swap near extra wrap {kinds}".split()),
        node[key],
        junk(draw),
    )
    if isinstance(value, torch.Tensor):
        new = _tensor(value, draw)
    elif kind == "swap":
        new, other[other_key] = copy.deepcopy(other[other_key]), copy.deepcopy(value)
    elif kind == "near" and isinstance(value, (int, float)):
        new = draw.choice([-value, value + 1, value / 2, str(value), float(value)])
    elif kind == "wrap":
        new = draw.choice([[value], {"a": value}, str(value)])
    elif kind == "call":
        new = copy.deepcopy(draw.choice(CALLS))
    if kind == "delete":
        del node[key]
    elif isinstance(value, dict) and kind in ("extra", "call"):
        value["extra"] = new
    else:
        node[key] = new
    return tree, f"{kind} {key}" + ("" if kind == "delete" else f"={str(new)[:150]!r}")


def _tensor(value: torch.Tensor, draw: random.Random) -> Any:
    value = value.detach().clone()
    if value.numel() and draw.random() < 0.6:
        numbers: list[Any] = (
            [math.nan, math.inf, 1e30, -1.0] if value.is_floating_point() else [0, 1, 255]
        )
        value.view(-1)[draw.randrange(value.numel())] = draw.choice(numbers)
        return value
    return draw.choice(
        [
            value[..., :1],
            value.double(),
            value.long(),
            value.flatten(),
            value.unsqueeze(0),
            None,
            "x",
        ]
    )


def damage(path: Path, draw: random.Random) -> str:
    """Change a file, or replace it by something else, and return what was done."""
    special = {
        ".yaml": _yaml,
        ".json": _json,
        ".csv": _csv,
        ".pt": _state,
        ".mcap": _recording,
    }.get(path.suffix)
    if special and path.is_file() and draw.random() < 0.7:
        with contextlib.suppress(
            Exception
        ):  # a change may be impossible to write, or the file already damaged
            return f"{path.name}: {special(path, draw)}"
    return f"{path.name}: {_any_file(path, draw)}"


def _any_file(path: Path, draw: random.Random) -> str:
    content = bytearray(path.read_bytes()) if path.is_file() else bytearray()
    others = sorted(file for file in path.parent.rglob("*") if file.is_file() and file != path)
    flipped = content.copy()
    for _ in range(draw.choice([1, 3, 50]) if content else 0):
        flipped[draw.randrange(len(content))] = draw.randrange(256)
    cut = content[: draw.randrange(len(content) + 1)]
    new = {
        "flip": flipped,
        "cut": cut,
        "empty": b"",
        "append": content + draw.randbytes(8),
        "bomb": BOMB,
    }
    kind = draw.choice([*new, "flip", "delete", "folder", "loop", "other"])
    other = draw.choice(others).read_bytes() if others else b""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind != "delete":
        path.write_bytes(bytes(new.get(kind, other)))
    return kind


def _yaml(path: Path, draw: random.Random) -> str:
    if draw.random() < 0.15:
        line = draw.choice(YAML_LINES)
        path.write_text(f"{path.read_text()}{line}\n")
        return f"append {line[:60]!r}"
    tree = yaml.safe_load(path.read_text())
    if draw.random() < 0.1:  # where every program builds it
        tree["method"]["transforms"]["extra"] = draw.choice(CALLS)
        done = f"call {tree['method']['transforms']['extra']}"
    else:
        tree, done = mutate(tree, draw, "call call")
    path.write_text(yaml.safe_dump(tree))
    return done


def _json(path: Path, draw: random.Random) -> str:
    tree, done = mutate(json.loads(path.read_text()), draw)
    path.write_text(json.dumps(tree))
    return done


def _csv(path: Path, draw: random.Random) -> str:
    rows = list(csv.reader(path.read_text().splitlines()))
    row, factor = draw.randrange(len(rows)), draw.choice([0, 1e-6, 1e6, 1e300, -1])
    column = draw.randrange(len(rows[row]))
    kind = draw.choice(
        ["cell"] * 6 + ["row", "row", "column", "header", "double", "shuffle", "scale", "scale"]
    )
    if kind == "shuffle":
        draw.shuffle(rows)
    elif kind == "scale":
        for cells in rows:
            with contextlib.suppress(ValueError):
                cells[column] = repr(float(cells[column]) * factor)
    elif kind == "column":
        rows = [cells[:column] + cells[column + 1 :] for cells in rows]
    elif kind == "row":
        del rows[row]
    elif kind == "double":
        rows.insert(row, rows[row])
    else:
        rows[0 if kind == "header" else row][column] = str(junk(draw))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return f"{kind} {row} {column}"


def _state(path: Path, draw: random.Random) -> str:
    if draw.random() < 0.3:  # wrong content with its right checksum
        content = bytearray(path.read_bytes()[: -checkpoint.DIGITS])
        content[draw.randrange(len(content))] ^= 1 + draw.randrange(255)
        content = draw.choice([content, bytearray(BOMB)])
        path.write_bytes(content + hashlib.sha256(content).hexdigest().encode())
        return "flip, with its checksum"
    state = checkpoint.load(path)
    forest = next((key for key in state if key.endswith("_extra_state")), None)
    if forest and draw.random() < 0.7:
        done = _forest(state[forest], draw)
    else:
        state, done = mutate(dict(state), draw)
    checkpoint.save(state, path)
    return done


def _forest(arrays: dict[str, torch.Tensor], draw: random.Random) -> str:
    """Change a number in the trees of a forest."""
    name, value = (
        draw.choice(["children", "features", "roots"]),
        draw.choice([0, -1, 10**6, 2**62, -(10**6)]),
    )
    flat = arrays[name].view(-1)
    flat[draw.choice([0, draw.randrange(len(flat))])] = value
    return f"forest {name}={value}"


def _recording(path: Path, draw: random.Random) -> str:
    """Change some messages or notes of a recording."""
    contents = read_messages(path)
    messages = list(chain.from_iterable(contents.messages.values()))
    notes: Any = contents.notes
    of_one_topic = draw.choice([topic for topic in contents.messages.values() if topic])
    chosen = set(
        draw.choice([range(len(of_one_topic)), [0], draw.sample(range(len(of_one_topic)), 2)])
    )
    first = of_one_topic[0]
    name = draw.choice(
        [SCAN, "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry", "std_msgs/msg/Float64"]
    )
    channels: dict[str, dict[str, Any]] = {
        "topic": {"topic": draw.choice(["", "/scan", "/odom", "/cmd_vel", "日"])},
        "type": {"message_type": draw.choice([name, "a/b", ""]), "definition": definition(name)},
        "encoding": {"encoding": draw.choice(["", "json"])},
        "definition": {"definition": draw.choice([b"", b"float64 x\n", b"\xff"])},
    }
    kind = draw.choice(
        [*channels, "field", "field", "field", "field", "bytes", "time", "drop", "notes", "extra"]
    )
    change: dict[str, Any] = {}
    if kind in channels:
        change = {"channel": first.channel._replace(**channels[kind])}
    elif kind == "extra":
        messages += [RawMessage(Channel("/extra", name), first.log_time, 0, draw.randbytes(20))]
    elif kind == "notes":
        record = draw.choice(sorted(notes))
        key = draw.choice(sorted(notes[record]))
        text = str(junk(draw))
        other = json.dumps(mutate(json.loads(notes[record][key]), draw)[0])
        notes[record][key] = draw.choice([text, other])
    else:
        change = _changed_fields(first, kind, draw)
    replaced = {id(of_one_topic[index]) for index in chosen}
    with RecordingWriter(path) as writer:
        for record, entries in notes.items():
            writer.describe(record, entries)
        for message in messages:
            if id(message) not in replaced:
                writer.copy(message)
            elif kind != "drop":
                writer.copy(message._replace(**change))
    return f"{kind} of {len(chosen)} messages of {first.channel.topic}"


def _changed_fields(message: RawMessage, kind: str, draw: random.Random) -> dict[str, Any]:
    """Return the changed fields of a message; none for other kinds of change."""
    if kind == "time":
        return {"log_time": draw.choice([0, 1, 2**63 - 1, 10**18])}
    if kind == "bytes":
        data = message.data
        return {"data": draw.choice([b"", data[:40], data + b"\0\0", draw.randbytes(40)])}
    if kind == "field":
        return {"data": _message(message, draw)}
    return {}


def _message(message: RawMessage, draw: random.Random) -> bytes:
    """Return a message with another number or text, or with other ranges."""

    def fields(node: Any) -> Any:
        names = [
            name for name in getattr(node, "__dataclass_fields__", ()) if not name.startswith("__")
        ]
        return {name: fields(getattr(node, name)) for name in names} if names else node

    tree = fields(decode(message.data, message.channel.message_type))
    node, key = draw.choice(
        [(node, key) for node, key in places(tree) if not isinstance(node[key], dict)]
    )
    old, number = node[key], draw.choice([*NUMBERS, *LARGE])
    if isinstance(old, np.ndarray):
        node[key] = draw.choice(
            [old[:0], old[:1], old[:-1], np.full_like(old, number), np.tile(old, 3)]
        )
    else:
        node[key] = draw.choice(TEXTS) if isinstance(old, str) else type(old)(number)
    return encode(message.channel.message_type, tree)
