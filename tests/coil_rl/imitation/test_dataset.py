import pytest
import torch
from tensordict import NonTensorData, TensorDict

from coil_rl.errors import UserError
from coil_rl.imitation.dataset import load, save


def samples():
    return TensorDict(
        {"observation": torch.rand(30, 4), "action": torch.rand(30, 1), "info": {"track": torch.arange(30)}}, [30]
    )


@pytest.fixture
def saved(tmp_path):
    save(samples(), tmp_path / "data")
    return tmp_path / "data"


def test_a_data_set_comes_back_as_it_was(tmp_path):
    dataset = samples()
    save(dataset, tmp_path / "new" / "data")
    again = load(tmp_path / "new" / "data")
    assert again.shape == (30,)
    assert again["info", "track"].dtype == torch.int64
    assert set(again.keys(True, True)) == set(dataset.keys(True, True))
    assert (again == dataset).all()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["data"]


def test_what_is_read_may_be_changed_and_the_folder_stays_as_it_was(saved):
    before = load(saved)
    load(saved)["action"].zero_()
    assert (load(saved) == before).all()


def test_a_failed_save_leaves_nothing(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError("the disk is full")

    monkeypatch.setattr(TensorDict, "memmap", full)
    with pytest.raises(OSError, match="the disk is full"):
        save(samples(), tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_written_over(saved):
    with pytest.raises(UserError, match="data exists already"):
        save(samples(), saved)


@pytest.mark.parametrize("name", ["action.memmap", "meta.json", "info/track.memmap"])
@pytest.mark.parametrize("how", ["cut", "altered", "removed"])
def test_a_damaged_data_set_is_refused(saved, name, how):
    path = saved / name
    content = path.read_bytes()
    if how == "removed":
        path.unlink()
    else:
        path.write_bytes(content[:-1] if how == "cut" else content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(UserError, match="data is not a whole data set"):
        load(saved)


def test_folders_of_something_else_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"there is no folder .*data"):
        load(tmp_path / "data")
    with pytest.raises(UserError, match="is not a data set"):
        load(tmp_path)
    samples().memmap(tmp_path / "foreign")
    with pytest.raises(UserError, match="foreign is not a data set"):
        load(tmp_path / "foreign")


def test_a_data_set_runs_no_code(tmp_path):
    class Payload:
        def __reduce__(self):
            return (print, ("code ran",))

    save(samples().set("payload", NonTensorData(Payload(), [30])), tmp_path / "data")
    with pytest.raises(UserError, match="is not a data set"):
        load(tmp_path / "data")
