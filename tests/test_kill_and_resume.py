import full_disk
import kill_and_resume
import pytest


@pytest.mark.slow
def test_killed_and_resumed_runs_end_like_an_uninterrupted_one(tmp_path):
    assert kill_and_resume.main(["--kills", "3", "--folder", str(tmp_path)]) == 0


@pytest.mark.slow
def test_runs_on_a_full_disk_end_like_an_uninterrupted_one(tmp_path):
    assert full_disk.main(["--runs", "3", "--folder", str(tmp_path)]) == 0
