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
    ("text", "message"),
    [
        (None, "actions.csv cannot be read as numbers"),
        (
            "0.1\nleft\n",
            r"actions.csv cannot be read as numbers with commas .*\(could not convert string to "
            "float: 'left'",
        ),
        ("", "must hold at least one line of finite numbers"),
        ("a,b\n", "must hold at least one line of finite numbers"),
        (
            "0.1\n0.1,0.2\n",
            "with commas between them, as many in each line",
        ),
        ("nan\n0.1\n", "must hold at least one line of finite numbers"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_file_without_actions_is_refused(text, message, tmp_path):
    file = tmp_path / "actions.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ValueError, match=message):
        RecordedGuide(file)


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


@pytest.mark.parametrize(
    "text",
    [
        "\u22120.1\n0.2\n",  # another minus sign in the first line
        "# of Tuesday\n0.1\n",
        "0.1;0.2\n",
        "0,1;-0,2\n0,3;0,4\n",
        "0.1 0.2\n",
        "a,0.1\n0.1,0.2\n",
        "0.1,,0.2\n",
        "\x00",
    ],
)
def test_file_in_another_format_is_refused(text, tmp_path):
    file = tmp_path / "actions.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"actions.csv cannot be read as numbers with commas"):
        RecordedGuide(file)
