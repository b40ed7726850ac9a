"""A package that coil-rl does not know goes through all commands.

It has its own envs, controllers and YAML files.
"""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from outside_package.install import PROXY, SOURCE, TINY, install
from programs import ROOT, called

CONF = ["--config-dir", str(SOURCE / "thermostat" / "conf")]
FILES = ["metrics.csv", "evaluation.csv", "episodes.csv", "guide_return.json"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return the folder in which the package is installed."""
    return install(tmp_path_factory.mktemp("outside"))


@pytest.fixture
def installed(site, monkeypatch):
    """Install the package for this process."""
    monkeypatch.syspath_prepend(site)


@pytest.fixture(scope="module")
def runs(site, tmp_path_factory):
    """Return the folder of two finished runs.

    `room` has the PI controller of the package, and `rooms` its batched one.
    """
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        for env in ("room", "rooms"):
            called(
                "train",
                *CONF,
                f"env={env}",
                "method=coil",
                *TINY,
                f"hydra.run.dir={env}",
                cwd=folder,
            )
    return folder


def table(file, **where):
    """Return the rows of a table, with numbers where they can be."""

    def number(text):
        try:
            return float(text)
        except ValueError:
            return text

    with Path(file).open(newline="") as lines:
        rows = [{key: number(value) for key, value in row.items()} for row in csv.DictReader(lines)]
    return [row for row in rows if all(row[key] == value for key, value in where.items())]


def test_files_of_an_env_and_of_a_guide_are_short():
    files = list((SOURCE / "thermostat" / "conf").rglob("*.yaml"))
    assert len(files) == 4
    assert all(len(file.read_text().splitlines()) <= 15 for file in files)


@pytest.mark.slow
def test_batched_env_is_the_same_room(installed):
    from thermostat.room import Room
    from thermostat.rooms import Rooms

    rooms, room = Rooms(3, first_seed=0, cases=3), Room()
    state = rooms.reset()
    room.reset()
    room.mean = float(rooms.rooms[1, 2])
    for power in np.random.default_rng(0).uniform(0, 1, (50, 1)):
        observation, reward, *_, info = room.step(power)
        state = rooms.step(state.set("action", torch.full((3, 1), float(power[0]))))["next"]
        assert state["observation"][1].numpy() == pytest.approx(observation, abs=1e-3)
        assert state["reward"][1].item() == pytest.approx(reward, abs=1e-3)
        assert state["info", "in_band"][1].item() == info["in_band"]


@pytest.mark.slow
@pytest.mark.parametrize("env", ["room", "rooms"])
def test_run_has_cases_measures_and_a_line_of_the_guide(env, runs):
    file = runs / env / "evaluation.csv"
    assert [row["case"] for row in table(file, driver="coil", actions="deterministic")] == [
        0,
        1,
        "mean",
    ]
    [guide] = table(file, driver="guide", case="mean")
    [agent] = table(file, driver="coil", case="mean", actions="deterministic")
    assert guide["reward"] > 75 > 60 > agent["reward"]
    assert guide["in_band"] > 0.7 > agent["in_band"]
    assert guide["completed"] == 1
    assert 20 < guide["energy"] < 96
    assert table(runs / env / "metrics.csv")[-1]["frames"] == 192


@pytest.mark.slow
@pytest.mark.parametrize("env", ["room", "rooms"])
def test_finished_run_is_evaluated_and_listened_to_without_its_yaml_files(
    env, runs, installed, tmp_path
):
    called(
        "evaluate", f"run={runs / env}", "evaluation.repeats=1", "hydra.run.dir=again", cwd=tmp_path
    )
    assert (tmp_path / "again" / "evaluation.csv").read_bytes() == (
        runs / env / "evaluation.csv"
    ).read_bytes()
    listen = ["evaluation.repeats=1", "donors=2", "hydra.run.dir=listening"]
    called("listen", f"run={runs / env}", *listen, cwd=tmp_path)
    [row] = table(tmp_path / "listening" / "listening_sections.csv")
    assert row["section"] == "everywhere"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("guide", "at_least"),
    [("PI", 80), ("BatchedPI", 80), ("Feedforward", 80), ("proportional", 30), ("KnowsTheDay", 80)],
)
def test_each_kind_of_controller_is_a_guide(guide, at_least, installed, tmp_path):
    name = f"thermostat.control:{guide}"
    chosen = ["guide=controller", f"guide.controller.of={name}"]
    if guide == "KnowsTheDay":
        beside = "thermostat.control:KnowsTheDay"
        chosen = [f"+env.controllers.day={beside}", "guide=entry"]
        chosen += ["guide.entry.key=[controller,day]"]
    called(
        "evaluate",
        *CONF,
        "env=room",
        *chosen,
        "evaluation.cases=5",
        "hydra.run.dir=alone",
        cwd=tmp_path,
    )
    [mean] = table(tmp_path / "alone" / "evaluation.csv", driver="guide", case="mean")
    assert at_least < mean["reward"] < 90


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [["evaluate", "run=run"], ["listen", "run=run"], ["train", "resume=run"]]
)
def test_package_that_is_not_declared_is_refused_by_name(command, runs, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(SOURCE)  # not installed
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_bytes((runs / "room" / "config.yaml").read_bytes())
    stderr = called(*command, cwd=tmp_path, code=2).stderr
    assert "env.id names 'thermostat.Room-v0', which could run code" in stderr
    assert "allow it with trust=[thermostat] on the command line" in stderr


@pytest.mark.slow
def test_package_that_is_not_declared_can_be_trusted(runs, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(SOURCE)
    trusted = ["trust=[thermostat]", "evaluation.repeats=1", "hydra.run.dir=again"]
    called("evaluate", f"run={runs / 'room'}", *trusted, cwd=tmp_path)
    assert (tmp_path / "again" / "evaluation.csv").read_bytes() == (
        runs / "room" / "evaluation.csv"
    ).read_bytes()


@pytest.fixture
def script(site, tmp_path):
    """Return what starts a console script in a process of its own.

    This checkout and the package are installed there.
    """

    def start(name, *arguments):
        path = os.pathsep.join([str(ROOT), str(site)])
        return subprocess.Popen(
            [Path(sys.executable).with_name(name), *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    return start


def finished(process, code=0):
    """Return what a process has written, after its end."""
    output = process.communicate(timeout=300)[0]
    assert process.returncode == code, output
    return output


@pytest.mark.slow
def test_sweep_report_distillation_and_learned_guide(script, tmp_path):
    package = "hydra.searchpath=[pkg://thermostat.conf]"  # instead of --config-dir
    sweep = [
        "-m",
        package,
        "env=room",
        "method=coil,ppo",
        "seed=0,1",
        *TINY,
        "hydra.sweep.dir=sweep",
    ]
    assert "not available" not in finished(script("coil-train", *sweep))
    assert "All 4 runs that were started are finished." in finished(
        script("coil-report", "folder=sweep")
    )
    means = table(tmp_path / "sweep" / "report.csv")
    assert {row["driver"] for row in means} == {"guide", "coil", "ppo"}
    finished(script("coil-distill", *CONF, "env=room", *PROXY, "proxy.folder=proxies"))
    assert len(list((tmp_path / "proxies").glob("pi_*/policy_last.pt"))) == 1
    learned = ["guide=learned", "guide.learned.run=sweep/2_Room-v0_ppo_seed0", "method=coil", *TINY]
    finished(script("coil-train", *CONF, "env=room", *learned, "hydra.run.dir=second"))
    [first] = table(
        tmp_path / "sweep" / "2_Room-v0_ppo_seed0" / "evaluation.csv",
        driver="ppo",
        actions="deterministic",
        case="mean",
    )
    [guide] = table(tmp_path / "second" / "evaluation.csv", driver="guide", case="mean")
    assert guide["reward"] == pytest.approx(first["reward"])
