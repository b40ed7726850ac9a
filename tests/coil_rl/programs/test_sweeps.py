from pathlib import Path

import pytest
from hydra import initialize_config_module

from coil_rl.errors import UserError
from coil_rl.programs import sweeps


def plan(experiment, given=(), seeds=(0, 1)):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return sweeps.planned(experiment, given, seeds)


@pytest.fixture(scope="module")
def authors():
    return plan("paper_authors", ["budget.frames=64"])


@pytest.fixture
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def finish(folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "evaluation.csv").touch()


def test_every_run_has_a_folder_that_says_what_it_is(authors):
    assert list(authors.folders) == [("method=coil",), ("method=ppo",)]
    names = [folder.name for folder in authors.all_folders]
    assert [name.rpartition("_")[0] for name in names] == ["coil_seed0", "coil_seed1", "ppo_seed0", "ppo_seed1"]
    assert len(set(names)) == 4
    assert {folder.parent for folder in authors.all_folders} == {Path("outputs/reproduce/runs")}
    assert not set(names) & {folder.name for folder in plan("paper_authors", ["budget.frames=128"]).all_folders}


def test_what_is_missing_is_one_sweep_where_it_is_a_product_and_no_more_than_that(authors, here):
    begin = ["-m", "+experiment=paper_authors", "budget.frames=64"]
    assert authors.commands() == [[*begin, "method=coil,ppo", "seed=0,1"]]
    coil, ppo = ([*of_seed.values()] for of_seed in authors.folders.values())
    finish(coil[1])
    assert authors.commands() == [[*begin, "method=coil", "seed=0"], [*begin, "method=ppo", "seed=0,1"]]
    finish(ppo[1])
    assert authors.commands() == [[*begin, "method=coil,ppo", "seed=0"]]
    finish(coil[0])
    assert authors.missing == [ppo[0]]
    assert authors.commands() == [[*begin, "method=ppo", "seed=0"]]
    finish(ppo[0])
    assert authors.commands() == []


def test_what_only_a_choice_knows_is_refused_before_the_first_run():
    given = ["learner.validate=false"]
    assert len(plan("paper_imitation", given).all_folders) == 4
    with pytest.raises(UserError, match=r"there is no key learner\.validate"):
        plan("methods", given)


def test_choices_that_are_no_product_are_sweeps_of_their_own(here):
    folders = {(f"a={a}", f"b={b}"): {0: Path(f"{a}{b}")} for a in (1, 2) for b in (1, 2)}
    sweep = sweeps.Sweep("any", (), folders)
    assert sweep.commands() == [["-m", "+experiment=any", "a=1,2", "b=1,2", "seed=0"]]
    finish(Path("11"))
    swept = [command[2:4] for command in sweep.commands()]
    assert swept == [["a=1", "b=2"], ["a=2", "b=1"], ["a=2", "b=2"]]


def test_lists_are_values_of_a_sweep_too():
    placebo = plan("paper_placebo", seeds=[3])
    assert ("method=coil", "degrade=[shuffled]") in placebo.folders
    assert placebo.commands()[0][2:] == ["method=coil", "degrade=[shuffled],[random],[zeroed],[delayed]", "seed=3"]


def test_only_what_is_missing_is_started_and_all_of_it_must_come(authors, here, monkeypatch, capfd):
    started = []

    def start(words):
        started.append(words)
        return 0

    monkeypatch.setattr(sweeps, "start", start)
    finish(authors.all_folders[0])
    with pytest.raises(UserError, match=r"3 runs of paper_authors are still missing, the first of them .*coil_seed1"):
        sweeps.run(authors, ["hydra/launcher=joblib"])
    assert [command[-3:] for command in started] == [
        ["method=coil", "seed=1", "hydra/launcher=joblib"],
        ["method=ppo", "seed=0,1", "hydra/launcher=joblib"],
    ]
    assert "paper_authors: 3 of 4 runs are missing\ncoil-train -m +experiment=paper_authors" in capfd.readouterr().err
    for folder in authors.all_folders:
        finish(folder)
    started.clear()
    sweeps.run(authors)
    assert not started


def test_a_sweep_that_fails_is_said(authors, here, monkeypatch):
    monkeypatch.setattr(sweeps, "start", lambda words: 2)
    with pytest.raises(UserError, match="a sweep of paper_authors ended with code 2, and says above why"):
        sweeps.run(authors)


def test_what_does_not_fit_is_one_sentence():
    with pytest.raises(UserError, match=r"coil-train \+experiment=paper_dynamic learner.gama=1: there is no key"):
        plan("paper_dynamic", ["learner.gama=1"])
    with pytest.raises(UserError, match="there is no experiment=papr; experiment can be"):
        plan("papr")
