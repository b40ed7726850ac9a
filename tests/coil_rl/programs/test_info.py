"""`coil-info`: versions, and the command that made a run."""

import pytest

from coil_rl.errors import UserError
from coil_rl.programs.info import describe


def test_damaged_command_is_named(tmp_path):
    (tmp_path / "config.yaml").touch()
    (tmp_path / "command.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match=r"command.txt is damaged .*; remove it"):
        describe(tmp_path)
