"""A package that coil-rl does not know goes through all commands.

It has its own envs, controllers and YAML files.
"""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from outside_package.install import PROXY, SOURCE, TINY, install
from programs import ROOT, called

CONF = ["--config-dir", str(SOURCE / "thermostat" / "conf")]


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
            words = [f"env={env}", "method=coil", *TINY, f"hydra.run.dir={env}"]
            called("train", *CONF, *words, cwd=folder)
    return folder


def table(file, **where):
    """Return the rows of a table in which some columns have some values."""
    rows = pd.read_csv(file)
    for column, value in where.items():
        rows = rows[rows[column] == value]
    return rows.to_dict("records")


@pytest.mark.slow
@pytest.mark.parametrize("env", ["room", "rooms"])
def test_run_has_cases_measures_and_a_line_of_the_guide(env, runs):
    file = runs / env / "evaluation.csv"
    agent = table(file, driver="coil", actions="deterministic")
    assert [row["case"] for row in agent] == ["0", "1", "mean"]
    [guide] = table(file, driver="guide", case="mean")
    agent = agent[-1]
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
    again = ["evaluation.repeats=1", "hydra.run.dir=again"]
    called("evaluate", f"run={runs / env}", *again, cwd=tmp_path)
    tables = (folder / "evaluation.csv" for folder in (runs / env, tmp_path / "again"))
    assert len({file.read_bytes() for file in tables}) == 1
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
    words = [*CONF, "env=room", *chosen, "evaluation.cases=5", "hydra.run.dir=alone"]
    called("evaluate", *words, cwd=tmp_path)
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


@pytest.fixture
def script(site, tmp_path):
    """Return what runs a console script with this checkout and the package installed."""
    places = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(site)])}
    env = os.environ | places | {"OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}

    def run(name, *arguments):
        command = [Path(sys.executable).with_name(name), *arguments]
        pipes = {"stderr": subprocess.STDOUT, "text": True}
        return subprocess.check_output(command, cwd=tmp_path, env=env, timeout=300, **pipes)

    return run


@pytest.mark.slow
def test_sweep_report_distillation_and_learned_guide(script, tmp_path):
    package = "hydra.searchpath=[pkg://thermostat.conf]"  # instead of --config-dir
    sweep = ["-m", package, "env=room", "method=coil,ppo", "seed=0,1", *TINY]
    assert "not available" not in script("coil-train", *sweep, "hydra.sweep.dir=sweep")
    said = script("coil-report", "folder=sweep")
    assert "All 4 runs that were started are finished." in said
    means = table(tmp_path / "sweep" / "report.csv")
    assert {row["driver"] for row in means} == {"guide", "coil", "ppo"}
    script("coil-distill", *CONF, "env=room", *PROXY, "proxy.folder=proxies")
    assert len(list((tmp_path / "proxies").glob("pi_*/policy_last.pt"))) == 1
    run = Path("sweep") / "2_Room-v0_ppo_seed0"
    learned = ["guide=learned", f"guide.learned.run={run}", "method=coil", *TINY]
    script("coil-train", *CONF, "env=room", *learned, "hydra.run.dir=second")
    mean = {"actions": "deterministic", "case": "mean"}
    [first] = table(tmp_path / run / "evaluation.csv", driver="ppo", **mean)
    [guide] = table(tmp_path / "second" / "evaluation.csv", driver="guide", case="mean")
    assert guide["reward"] == pytest.approx(first["reward"])
