"""Sweeps in other processes with Hydra's launchers give the same results."""

import importlib.util

import pytest

from tests.programs import TINY, called, program

SWEEP = [
    *TINY,
    "method=coil,guide",
    "seed=0",
    "existing=resume",
    "evaluation.gif=false",
    "hydra.sweep.dir=sweep",
    "hydra.sweep.subdir=${label}_seed${seed}",
]
LAUNCHERS = {  # extra and overrides of each
    "joblib": ("joblib", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": ("slurm", []),
    "ray": ("ray", ["+hydra.launcher.ray.init.num_cpus=2"]),
}

pytestmark = pytest.mark.slow


def tables(folder):
    return {path.parent.name: path.read_text() for path in folder.glob("sweep/*/evaluation.csv")}


@pytest.fixture(scope="module")
def in_this_process(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    called("train", "-m", *SWEEP, cwd=folder)
    return tables(folder)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_sweep_gives_the_same_results_and_repeats_only_missing_runs(
    tmp_path, in_this_process, launcher
):
    extra, overrides = LAUNCHERS[launcher]
    if (
        importlib.util.find_spec(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
        is None
    ):
        pytest.skip(f"it is not installed: pip install 'coil-rl[{extra}]'")
    sweep = ["-m", f"hydra/launcher={launcher}", *overrides, *SWEEP]
    program("train", *sweep, cwd=tmp_path)
    assert tables(tmp_path) == in_this_process
    kept, lost = (
        tmp_path / "sweep" / name / "evaluation.csv" for name in ("guide_seed0", "coil_seed0")
    )
    lost.unlink()
    before = kept.stat().st_mtime_ns
    program("train", *sweep, cwd=tmp_path)
    assert tables(tmp_path) == in_this_process
    assert kept.stat().st_mtime_ns == before
