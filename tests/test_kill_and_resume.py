import kill_and_resume
import pytest


@pytest.mark.slow
def test_killed_runs_end_as_if_they_had_never_been_stopped(tmp_path):
    assert kill_and_resume.main(["--kills", "3", "--folder", str(tmp_path)]) == 0
