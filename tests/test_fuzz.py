import subprocess
import sys

import pytest
from programs import ROOT


# In a process of its own, as it is forked for every case.
@pytest.mark.slow
def test_no_input_makes_a_traceback_or_hangs_or_writes_outside(tmp_path):
    command = [
        sys.executable,
        str(ROOT / "tests" / "fuzz.py"),
        "--cases",
        "100",
        "--folder",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
