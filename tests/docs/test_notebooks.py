"""The notebooks of the docs run from top to bottom, as in Jupyter."""

from itertools import product

import jupytext
import pytest
from nbclient import NotebookClient
from programs import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
# A part of what a cell of each must show.
SHOWN = {
    "your_env_and_controller": ("coil_anchored", "l/s"),
    "is_my_guide_worth_it": ("coil_anchored", "coil_rl.train(env"),
    "from_an_fmu_to_a_verdict": ("policy on top: mean", "onnxruntime alone"),
    "from_a_recording": ("scans with a command", "network  reward"),
}

# What costs time in the cells, and what a test puts in its place.
TOY = {
    "frames=20_000": "frames=2048",
    '"evaluation.gif=false"': '"evaluation.gif=false", "evaluation.cases=2"',
    "cases=20": "cases=2",
    "cases=100": "cases=4",
}


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[notebook.stem for notebook in NOTEBOOKS])
def test_it_runs_with_the_backend_that_a_notebook_sets(notebook, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    cells = jupytext.read(notebook, fmt="py:percent")
    for cell, given in product(cells.cells, TOY):
        cell.source = cell.source.replace(given, TOY[given])
    NotebookClient(cells, timeout=1200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in cells.cells for output in cell.get("outputs", ())]
    texts = [output.get("text", "") for output in outputs]
    data = [output.get("data", {}) for output in outputs]
    everything = "".join([*texts, *(each.get("text/html", "") for each in data)])
    for part in SHOWN[notebook.stem]:
        assert part in everything
    assert any("image/png" in each for each in data)
