import copy
import io
import os
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule

from coil_rl.errors import UserError
from coil_rl.files import remove_unfinished
from coil_rl.run import checkpoint


def test_failed_save_keeps_the_old_file(tmp_path):
    checkpoint.save(1, tmp_path / "state.pt")
    with pytest.raises(Exception, match=r"pickle|local object"):
        checkpoint.save(lambda: None, tmp_path / "state.pt")
    assert checkpoint.load(tmp_path / "state.pt") == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"there is no file .*state\.pt"):
        checkpoint.load(tmp_path / "state.pt")


def test_loading_runs_no_code(tmp_path):
    class Payload:
        def __reduce__(self):
            return (print, ("code ran",))

    torch.save(Payload(), tmp_path / "evil.pt")
    with pytest.raises(UserError, match="checksum is wrong"):
        checkpoint.load(tmp_path / "evil.pt")
    checkpoint.save(Payload(), tmp_path / "evil.pt")
    with pytest.raises(UserError, match="is damaged"):
        checkpoint.load(tmp_path / "evil.pt")


def signed(archive, path):
    """Write an archive of another program with the checksum of ours."""
    content = archive.getvalue()[:-2] + checkpoint.DIGITS.to_bytes(2, "little")
    path.write_bytes(content + checkpoint._checksum(content))


def repacked(state, **options):
    """The archive of a state, with other options of the entries."""
    saved, other = io.BytesIO(), io.BytesIO()
    torch.save(state, saved)
    with zipfile.ZipFile(saved) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name), **options)
    return other


def sharing(count):
    """An archive in which many names have the bytes of one entry."""
    archive = repacked({"a": torch.zeros(10**5)})
    with zipfile.ZipFile(archive, "a") as target:
        (first,) = [entry for entry in target.infolist() if entry.filename.endswith("data/0")]
        for number in range(1, count):
            entry = copy.copy(first)
            entry.filename = first.filename[:-1] + str(number)
            target.filelist.append(entry)
            target.NameToInfo[entry.filename] = entry
        target._didModify = True
    return archive


@pytest.mark.parametrize(
    ("archive", "reason"),
    [
        (lambda: repacked({"a": torch.zeros(10**6)}, compress_type=8), "ValueError"),
        (lambda: repacked({"a": torch.zeros(10**6)}, compress_type=14), "ValueError"),
        (lambda: sharing(1000), "ValueError"),
        (lambda: io.BytesIO(pickle.dumps({"a": 1})), "BadZipFile"),
    ],
    ids=["deflated", "lzma", "sharing", "pickle"],
)
def test_small_file_does_not_load_as_a_large_state(tmp_path, archive, reason):
    signed(archive(), tmp_path / "policy_last.pt")
    with pytest.raises(UserError, match=rf"is damaged \({reason}\)"):
        checkpoint.load(tmp_path / "policy_last.pt")


def test_stored_archive_of_another_program_is_read(tmp_path):
    signed(repacked({"a": torch.arange(3)}), tmp_path / "a.pt")
    assert checkpoint.load(tmp_path / "a.pt")["a"].tolist() == [0, 1, 2]


def test_states_of_all_kinds_are_read(tmp_path):
    state = OrderedDict(
        a=torch.nn.Parameter(torch.ones(2)), b=torch.Size([1]), c=(1, {2.0}, b"x", 2j)
    )
    state |= {"d": torch.zeros(2, 3).T, "e": torch.ones(2, dtype=torch.bfloat16), "f": None}
    state |= {"updates": 7, "returns": [1.5, 2.5]}
    checkpoint.save(state, tmp_path / "a.pt")
    assert str(checkpoint.load(tmp_path / "a.pt")) == str(state)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A folder with checkpoint 2 and, as the previous one, checkpoint 1; and the bytes of 2."""
    folder = tmp_path_factory.mktemp("run")
    for number in (1, 2):
        checkpoint.save_newest({"updates": number, "weights": torch.zeros(50)}, folder)
    return folder, (folder / "checkpoint.pt").read_bytes()


@given(st.data())
def test_previous_checkpoint_replaces_an_altered_or_truncated_one(two, data):
    folder, whole = two
    at = data.draw(st.integers(0, len(whole) - 1))
    broken = whole[:at]
    if data.draw(st.booleans()):
        broken += bytes([whole[at] ^ data.draw(st.integers(1, 255))]) + whole[at + 1 :]
    (folder / "checkpoint.pt").write_bytes(broken)
    before = (folder / "checkpoint_previous.pt").read_bytes()
    assert checkpoint.load_newest(folder)["updates"] == 1
    assert (folder / "checkpoint.pt").read_bytes() == before
    (folder / "checkpoint_previous.pt").write_bytes(before)


def test_damaged_checkpoints_are_reported_or_refused(tmp_path, capsys):
    assert checkpoint.load_newest(tmp_path) is None
    for number in (1, 2):
        checkpoint.save_newest(number, tmp_path)
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    assert checkpoint.load_newest(tmp_path) == 1
    assert "checkpoint.pt is damaged: its checksum is wrong; using" in capsys.readouterr().err
    for name in ("checkpoint.pt", "checkpoint_previous.pt"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(UserError, match=r"both .*checkpoint\.pt and .*_previous\.pt are damaged"):
        checkpoint.load_newest(tmp_path)


def test_kill_at_any_step_of_a_save_leaves_a_checkpoint(tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    for step in range(8):
        folder = tmp_path / str(step)
        folder.mkdir()
        checkpoint.save_newest(1, folder)
        left = iter(range(step))

        def dying(function, left=left):
            def call(*arguments, **named):
                if next(left, None) is None:
                    raise Killed
                return function(*arguments, **named)

            return call

        with monkeypatch.context() as patch:
            # All writes to the disk; a killed process does not clean up either.
            patch.setattr(os, "fsync", dying(os.fsync))
            for name in ("write_bytes", "replace", "unlink"):
                patch.setattr(Path, name, dying(getattr(Path, name)))
            try:
                checkpoint.save_newest(2, folder)
                died = False
            except Killed:
                died = True
        assert checkpoint.load_newest(folder) in ((1, 2) if died else (2,))
        remove_unfinished(folder)
        checkpoint.save_newest(3, folder)
        assert checkpoint.load_newest(folder) == 3
        left_behind = {file.name for file in folder.iterdir()}
        assert left_behind <= {"checkpoint.pt", "checkpoint_previous.pt"}
    assert not died


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.float64])
def test_weights_of_another_type_are_refused(dtype, tmp_path):
    policy = TensorDictModule(torch.nn.Linear(2, 1), in_keys=["x"], out_keys=["y"])
    checkpoint.put_weights(policy, policy.state_dict(), tmp_path)
    state = {name: value.to(dtype) for name, value in policy.state_dict().items()}
    with pytest.raises(UserError, match=rf"weight as {dtype}, not torch.float32"):
        checkpoint.put_weights(policy, state, tmp_path)
