"""Actions from a file, and from an entry of the env."""

import pytest
import torch
from hosted_guides import cones, driven, steps_of_episode
from tensordict import TensorDict

from coil_rl.guides import EntryGuide, RecordedGuide


def test_entry_of_the_env_is_advice():
    guide = EntryGuide(["controller", "theirs"])
    data = TensorDict({"controller": {"theirs": torch.rand(3, 2)}}, [3])
    assert torch.equal(guide(data)["action"], data["controller", "theirs"])
    assert guide.sees == "env"
    rollout, advice = driven(cones(EntryGuide("steering")))
    assert torch.equal(advice, rollout["steering"])


@pytest.mark.parametrize("header", ["", "steering\n"])
def test_recording_begins_with_each_episode_and_holds_its_last_action(header, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_text(header + "".join(f"{step / 100:e}\n" for step in range(10)))
    rollout, advice = driven(cones(RecordedGuide(file)))
    expected = (steps_of_episode(rollout) - 1).clamp(max=9) / 100
    torch.testing.assert_close(advice.squeeze(-1), expected)


@pytest.mark.parametrize(
    ("text", "actions"),
    [
        ("\ufeff0.1\n0.2\n", [[0.1], [0.2]]),
        ("\ufeffpower\n0.1\n", [[0.1]]),
        ("left (V),right (V)\r\n1e-1 , 0.2\r\n\n", [[0.1, 0.2]]),
    ],
)
def test_actions_of_a_plain_file(text, actions, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_bytes(text.encode())
    torch.testing.assert_close(RecordedGuide(file).actions, torch.tensor(actions))


NO_NUMBERS = "cannot be read as numbers with commas"
NO_LINE = "must hold at least one line of finite numbers"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1\nleft\n", NO_NUMBERS + r".*\(could not convert string to float: 'left'"),
        ("\u22120.1\n0.2\n", NO_NUMBERS),  # another minus sign in the first line
        ("# of Tuesday\n0.1\n", NO_NUMBERS),
        ("0.1;0.2\n", NO_NUMBERS),
        ("0,1;-0,2\n0,3;0,4\n", NO_NUMBERS),
        ("0.1 0.2\n", NO_NUMBERS),
        ("a,0.1\n0.1,0.2\n", NO_NUMBERS),
        ("0.1,,0.2\n", NO_NUMBERS),
        ("\x00", NO_NUMBERS),
        ("0.1\n0.1,0.2\n", "as many in each line"),
        ("", NO_LINE),
        ("a,b\n", NO_LINE),
        ("nan\n0.1\n", NO_LINE),
    ],
)
@pytest.mark.filterwarnings("error")
def test_file_without_actions_is_refused(text, message, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"actions.csv.* {message}"):
        RecordedGuide(file)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"actions.csv cannot be read as numbers"):
        RecordedGuide(tmp_path / "actions.csv")
