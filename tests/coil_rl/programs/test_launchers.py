"""Sweeps in other processes, by Hydra's launchers: where they run changes nothing about them."""

import importlib.util

import pytest

from tests.programs import TINY, called, program

SWEEP = [*TINY, "method=coil,guide", "seed=0", "existing=resume", "evaluation.gif=false", "hydra.sweep.dir=sweep",
         "hydra.sweep.subdir=${label}_seed${seed}"]  # fmt: skip
LAUNCHERS = {  # with the extra that brings them, and what they are told
    "joblib": ("joblib", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": ("slurm", []),
    "ray": ("ray", ["+hydra.launcher.ray.init.num_cpus=2"]),
}

pytestmark = pytest.mark.slow


def tables(folder):
    return {path.parent.name: path.read_text() for path in folder.glob("sweep/*/evaluation.csv")}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    called("train", "-m", *SWEEP, cwd=folder)
    return tables(folder)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_sweep_in_other_processes_leaves_the_same_and_goes_on_with_what_is_missing(tmp_path, alone, launcher):
    extra, told = LAUNCHERS[launcher]
    if importlib.util.find_spec(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher") is None:
        pytest.skip(f"it is not installed: pip install 'coil-rl[{extra}]'")
    sweep = ["-m", f"hydra/launcher={launcher}", *told, *SWEEP]
    program("train", *sweep, cwd=tmp_path)
    assert tables(tmp_path) == alone
    kept, lost = (tmp_path / "sweep" / name / "evaluation.csv" for name in ("guide_seed0", "coil_seed0"))
    lost.unlink()
    before = kept.stat().st_mtime_ns
    program("train", *sweep, cwd=tmp_path)
    assert tables(tmp_path) == alone
    assert kept.stat().st_mtime_ns == before
