import pytest
import torch

from coil_rl import checkpoint
from coil_rl.errors import UserError


def test_state_comes_back_as_it_was(tmp_path):
    state = {"weights": torch.arange(3.0), "updates": 7, "returns": [1.5, 2.5], "none": None}
    checkpoint.save(state, tmp_path / "state.pt")
    again = checkpoint.load(tmp_path / "state.pt")
    assert torch.equal(again.pop("weights"), state.pop("weights"))
    assert again == state
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]


def test_failed_save_leaves_the_file_before_it(tmp_path):
    checkpoint.save(1, tmp_path / "state.pt")
    with pytest.raises(Exception, match="pickle"):
        checkpoint.save(lambda: None, tmp_path / "state.pt")
    assert checkpoint.load(tmp_path / "state.pt") == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_missing_and_broken_files_are_named(tmp_path):
    with pytest.raises(UserError, match=r"there is no file .*state\.pt"):
        checkpoint.load(tmp_path / "state.pt")
    checkpoint.save(torch.zeros(1000), tmp_path / "state.pt")
    whole = (tmp_path / "state.pt").read_bytes()
    (tmp_path / "state.pt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"state\.pt is not a whole checkpoint"):
        checkpoint.load(tmp_path / "state.pt")


def test_a_checkpoint_runs_no_code(tmp_path):
    class Payload:
        def __reduce__(self):
            return (print, ("code ran",))

    torch.save(Payload(), tmp_path / "evil.pt")
    with pytest.raises(UserError, match="not a whole checkpoint"):
        checkpoint.load(tmp_path / "evil.pt")
