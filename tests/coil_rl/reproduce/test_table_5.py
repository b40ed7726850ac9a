import csv

import pandas as pd
import pytest
from PIL import Image
from reproduced_runs import make_runs

from coil_rl.reproduce import Table5


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, the numbers and the place of a small one."""
    folder = tmp_path_factory.mktemp("table_5")
    runs = {
        "main": make_runs(folder / "main", {"coil": 30.0, "ppo": 60.0, "coil_shuffled": 10.0}),
        "imitation": make_runs(folder / "imitation", {"oil": 5.0}, sampled=False, completed=0.5, crashed=0.5),
        "other": make_runs(folder / "other", {"coil": 80.0, "ppo": 60.0}),
    }
    page = Table5(["main", "imitation"], {"another world": "other"}, resamples=200).make(folder / "t", runs)
    with (folder / "t.csv").open(newline="") as file:
        return page, list(csv.DictReader(file)), folder


def rows(page, heading, world=0):
    """The cells of the table of drivers below a heading, by driver."""
    _, *after = page.split(f"**{heading}**")
    lines = after[world].strip().split("\n\n")[0].splitlines()
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    return {line[0]: dict(zip(table[0], line, strict=True)) for line in table[2:]}


def test_the_guide_comes_first_then_the_agents_by_their_reward_what_was_completed_before_all(made):
    page, _, _ = made
    deterministic = rows(page, "Deterministic actions")
    assert list(deterministic) == ["guide", "ppo", "coil", "coil_shuffled", "oil"]
    assert list(deterministic["coil"])[:4] == ["driver", "seeds", "completed", "crashed"]
    assert (deterministic["oil"]["completed"], deterministic["oil"]["crashed"]) == ("50%", "50%")
    assert deterministic["coil"]["reward: mean (95 %)"].startswith("581.0 (580.0 to 58")


def test_drivers_that_act_in_one_way_stand_in_both_tables(made):
    page, _, _ = made
    sampled = rows(page, "Sampled actions")
    assert list(sampled) == ["guide", "ppo", "oil", "coil", "coil_shuffled"]
    assert sampled["oil"]["reward: mean (95 %)"].startswith("556.0 (")
    assert sampled["coil"]["reward: mean (95 %)"].startswith("531.0 (")


def test_agents_are_compared_seed_by_seed_with_ppo_and_with_the_guide(made):
    page, _, _ = made
    coil = rows(page, "Deterministic actions")["coil"]
    assert coil["reward - ppo's (95 %)"] == "-30.0 (-30.0 to -30.0)"
    assert (coil["better than ppo"], coil["better than the guide"]) == ("0%", "100%")
    assert rows(page, "Deterministic actions", world=1)["coil"]["reward - ppo's (95 %)"] == "+20.0 (+20.0 to +20.0)"


def test_four_drivers_stand_beside_the_paper(made):
    page, _, _ = made
    lines = [line for line in page.splitlines() if "| 609.4 |" in line or "| 632.9 |" in line]
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [line[:2] for line in table] == [["guide", "the same"], ["coil", "sampled"], ["coil", "deterministic"]]
    assert table[2] == [
        "coil", "deterministic", "50.00", "48.48", "0.100", "0.606", "581.0", "632.9", "1.056", "1.039", "0%", "0%",
    ]  # fmt: skip


def test_tracks_have_rows_and_say_what_was_not_completed(made):
    page, _, _ = made
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()]
    assert ["coil", "531.0", "631.0"] in lines
    assert ["oil", "506.0 (50% completed)", "606.0 (50% completed)"] in lines


def test_what_the_paper_says_is_judged_for_both_ways_to_act_and_in_each_world(made):
    page, _, _ = made
    table = page.split("### What held up\n\n")[1].splitlines()[2:]
    found = {cells[0]: cells[1:] for cells in ([c.strip() for c in line.split("|")[1:-1]] for line in table)}
    paper, sampled, deterministic = found["COIL earns more than its guide"]
    assert paper == "+23.5"
    assert sampled.startswith("**did not hold up**: -19.0 (-20.0 to")
    assert deterministic.startswith("**held up**: +31.0 (+30.0 to")
    assert found["COIL earns more than PPO"][1] == "**did not hold up**: -30.0 (-30.0 to -30.0)"
    assert found["COIL earns more than PPO, another world"][1] == "**held up**: +20.0 (+20.0 to +20.0)"
    assert found["COIL's laps take less time than PPO's"][:2] == ["-0.10", "**undecided**: +0.00 (+0.00 to +0.00)"]
    assert found["COIL earns more with its guide's advice than with another car's"][0] == "-"
    crashes = "**did not hold up**: guide 0%, ppo 0%, oil 50%, coil 0%"
    assert found["Nobody crashes"][:2] == ["0%", crashes]
    assert len(found) == 7 + 3 + 1


def test_every_drive_is_kept_and_drawn(made):
    _, numbers, folder = made
    assert len(numbers) == 2 * (3 * 3 * 3 + 3 * 2 + 2 * 3 * 3)
    found = next(row for row in numbers if (row["label"], row["actions"], row["seed"]) == ("coil", "sampled", "2"))
    assert (found["track"], float(found["reward"]), float(found["lap_time"])) == ("a", 482, 50)
    with Image.open(folder / "t.png") as image:
        assert image.width == 1600


def test_many_tracks_are_left_to_the_file(tmp_path):
    runs = make_runs(tmp_path / "main", {"coil": 30.0, "ppo": 60.0}, seeds=2)
    for run in runs:
        first = run.evaluation[run.evaluation["track"] == "a"]
        object.__setattr__(run, "evaluation", pd.concat([first.assign(track=name) for name in "abcdefghi"]))
    page = Table5(["main"]).make(tmp_path / "t", {"main": runs})
    assert page.count("The numbers of each of the 9 tracks are in t.csv.") == 2


def test_no_resamples_are_refused():
    with pytest.raises(ValueError, match="resamples=0 must be at least 1"):
        Table5(["main"], resamples=0)
