from pathlib import Path

import pytest
from hydra import compose, initialize_config_module

import coil_paper.schema  # noqa: F401  registers the configuration of coil-reproduce
from coil_paper import sweeps
from coil_rl.errors import UserError


def planned(experiment, overrides=(), seeds=(0, 1)):
    return sweeps.planned(experiment, overrides, seeds)


@pytest.fixture(scope="module")
def authors():
    return planned("paper_authors", ["budget.frames=64"])


@pytest.fixture
def started(monkeypatch, tmp_path):
    """The arguments of the sweeps that were started, in an empty folder; all of them succeed."""
    monkeypatch.chdir(tmp_path)
    commands = []
    monkeypatch.setattr(sweeps, "start", lambda arguments: commands.append(arguments) or 0)
    return commands


def finish(folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "evaluation.csv").touch()


@pytest.mark.slow
def test_every_run_has_a_folder_with_its_fingerprint(authors):
    names = [folder.name.rpartition("_")[0] for folder in authors.all_folders]
    assert names == ["coil_seed0", "coil_seed1", "ppo_seed0", "ppo_seed1"]
    assert {folder.parent for folder in authors.all_folders} == {Path("outputs/reproduce/runs")}
    longer = planned("paper_authors", ["budget.frames=128"])
    assert not {*authors.all_folders} & {*longer.all_folders}


def test_sweep_is_composed_beside_the_files_of_the_running_program(authors):
    with initialize_config_module("coil_paper.conf", version_base="1.3"):
        before = compose("reproduce")
        assert planned("paper_authors", ["budget.frames=64"]) == authors
        assert compose("reproduce") == before


def test_word_of_the_command_takes_the_place_of_a_parameter_of_the_file():
    folders = planned("paper_authors", ["method=ppo", "budget.frames=64"], seeds=[0]).all_folders
    assert [folder.name.rpartition("_")[0] for folder in folders] == ["ppo_seed0"]


@pytest.mark.slow
def test_lists_are_values_of_a_sweep():
    folders = planned("paper_placebo", seeds=[3]).all_folders
    labels = [folder.name.rpartition("_seed3")[0] for folder in folders]
    assert labels == ["coil_random", "coil_zeroed", "coil_delayed"]


def test_sweep_is_started_until_all_its_runs_are_finished(authors, started, monkeypatch, capfd):
    finish(authors.all_folders[0])
    with pytest.raises(
        UserError, match=r"3 runs of .* are still missing, the first is .*coil_seed1"
    ):
        sweeps.run(authors, ["hydra/launcher=joblib"])
    words = ["+experiment=paper_authors", "budget.frames=64", "seed=0,1"]
    command = ["-m", *words, "hydra/launcher=joblib"]
    assert started == [command]
    assert "paper_authors: 3 of 4 runs are missing\ncoil-train -m" in capfd.readouterr().err
    for folder in authors.all_folders:
        finish(folder)
    sweeps.run(authors)
    assert started == [command]
    authors.all_folders[0].joinpath("evaluation.csv").unlink()
    monkeypatch.setattr(sweeps, "start", lambda arguments: 2)
    with pytest.raises(UserError, match="the sweep of paper_authors ended with exit code 2"):
        sweeps.run(authors)


@pytest.mark.parametrize(
    ("experiment", "override", "message"),
    [
        ("paper_dynamic", "learner.gama=1", r"coil-train .*paper_dynamic learner.gama=1: there is"),
        ("methods", "learner.validate=false", r"there is no key learner\.validate"),
        ("papr", "budget.frames=64", "there is no experiment=papr; experiment can be"),
    ],
    ids=["key", "key of some runs only", "experiment"],
)
def test_mistake_is_refused_before_the_first_run(experiment, override, message):
    with pytest.raises(UserError, match=message):
        planned(experiment, [override])
