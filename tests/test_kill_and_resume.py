import full_disk
import kill_and_resume
import pytest
import torch

FMU = ["env=fmu", "env.step=0.01", "env.seconds=0.5", "env.workers=0", "trust=[coil_fmu]"]
FMU += ["env.setpoints={speed: {low: 50, high: 150, every: 0.1}}"]
FMU += ["env.parameters={inertia: {low: 0.008, high: 0.012}}"]
FMU += ["method=ppo", "budget.num_envs=4", "budget.frames=3200"]
FMU += ["evaluation.cases=4", "evaluation.curve.num_envs=2"]


def test_states_are_compared_entry_by_entry_also_in_lists():
    one, same, other = ({"buffers": [{"steps": torch.arange(n)}]} for n in (3, 3, 4))
    assert kill_and_resume.same(one, same)
    assert not kill_and_resume.same(one, other)
    assert not kill_and_resume.same(one, {"buffers": []})


@pytest.mark.slow
def test_killed_and_resumed_runs_end_like_an_uninterrupted_one(tmp_path):
    assert kill_and_resume.main(["--kills", "3", "--folder", str(tmp_path)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("state", [False, True], ids=["no FMU state", "FMU state"])
def test_killed_and_resumed_runs_of_an_fmu_end_like_an_uninterrupted_one(state, tmp_path):
    import fmus  # skips this test only, where FMPy is missing

    # Both repeat their episodes; one of them could also save its state.
    words = [*FMU, f"env.file={fmus.motor(state=state)}"]
    assert kill_and_resume.main(["--kills", "2", "--folder", str(tmp_path), *words]) == 0


@pytest.mark.slow
def test_runs_on_a_full_disk_end_like_an_uninterrupted_one(tmp_path):
    assert full_disk.main(["--runs", "3", "--folder", str(tmp_path)]) == 0
