import pandas as pd
import pytest
from programs import read_csv
from reproduced_runs import cells, make_runs

from coil_paper.reproduce.unseen import Table5


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page and the rows of the CSV, for small runs in two worlds."""
    folder = tmp_path_factory.mktemp("table_5")
    poor = {"sampled": False, "completed": 0.5, "crashed": 0.5}
    runs = {
        "main": make_runs(folder / "main", {"coil": 30.0, "ppo": 60.0, "coil_shuffled": 10.0}),
        "imitation": make_runs(folder / "imitation", {"oil": 5.0}, **poor),
        "other": make_runs(folder / "other", {"coil": 80.0, "ppo": 60.0}),
    }
    page = Table5(["main", "imitation"], {"another world": ["other"]}).make(folder / "t", runs)
    assert (folder / "t.png").exists()
    return page, read_csv(folder / "t.csv")


def drivers(page, heading, world=0):
    """Return the rows of the table of drivers below a heading, by driver."""
    table = page.split(f"**{heading}**")[1 + world].strip().split("\n\n")[0].splitlines()
    columns, _, *rows = map(cells, table)
    return {row[0]: dict(zip(columns, row, strict=True)) for row in rows}


@pytest.mark.slow
def test_drivers_are_the_guide_and_then_the_agents_by_reward(made):
    deterministic = drivers(made[0], "Deterministic actions")
    assert list(deterministic) == ["guide", "ppo", "coil", "coil_shuffled", "oil"]
    crashes = deterministic["oil"]["seeds with a crash (95 %)"]
    assert (deterministic["oil"]["completed"], crashes) == ("50%", "3 of 3 (29% to 100%)")
    # 530, 531 and 532 of 500, and 630, 631 and 632 of 600.
    assert deterministic["coil"]["reward / guide's (95 %)"] == "1.057 (1.052 to 1.061)"
    # Where oil has no sampled actions, it is listed too.
    assert list(drivers(made[0], "Sampled actions")) == list(deterministic)


@pytest.mark.slow
def test_agents_are_compared_seed_by_seed_with_ppo_and_with_the_guide(made):
    coil = drivers(made[0], "Deterministic actions")["coil"]
    assert coil["difference to ppo (95 %)"] == "-0.055 (-0.055 to -0.055)"
    assert (coil["better than ppo"], coil["better than the guide"]) == ("0%", "100%")
    other = drivers(made[0], "Deterministic actions", world=1)["coil"]
    assert other["difference to ppo (95 %)"] == "+0.037 (+0.037 to +0.037)"


def test_the_papers_drivers_are_next_to_the_paper(made):
    table = [
        cells(line) for line in made[0].splitlines() if "| 609.4 |" in line or "| 632.9 |" in line
    ]
    assert [line[:2] for line in table] == [
        ["guide", "the same"],
        ["coil", "sampled"],
        ["coil", "deterministic"],
    ]
    numbers = "50.00 48.48 0.100 0.606 581.0 632.9 1.056 1.039 0% 0%"
    assert table[2] == ["coil", "deterministic", *numbers.split()]
    table = [cells(line) for line in made[0].splitlines()]
    assert ["oil", "506.0 (50% completed)", "606.0 (50% completed)"] in table


def test_claims_have_a_verdict_for_both_kinds_of_actions_and_in_each_world(made):
    table = made[0].split("### What held up\n\n")[1].splitlines()[2:]
    claims = {row[0]: row[1:] for row in map(cells, table)}
    paper, sampled, deterministic = claims["COIL earns more than its guide"]
    assert paper == "+0.039"
    assert sampled.startswith("**did not hold up**: -0.035 (-0.039 to -0.030), 3 seeds, p 0.0")
    assert deterministic.startswith("**held up**: +0.057 (+0.052 to +0.061), 3 seeds, p 0.0")
    expected = "**held up**: +0.037 (+0.037 to +0.037), 3 seeds, p < 0.001"
    assert claims["COIL earns more than PPO, another world"][1] == expected
    expected = "**undecided**: +0.00 (+0.00 to +0.00), 3 seeds, p 1.000"
    assert claims["COIL's laps take less time than PPO's"][:2] == ["-0.10", expected]
    assert claims["COIL earns more with its guide's advice than with another car's"][0] == "-"
    none = "0 of 3 (0% to 71%)"
    crashes = (
        f"**did not hold up**: guide 0 of 2 cases (0% to 84%), ppo {none}, coil {none}, "
        "oil 3 of 3 (29% to 100%)"
    )
    assert claims["Nobody crashes"][:2] == ["0%", crashes]
    assert len(claims) == 7 + 3 + 1


def test_the_csv_has_every_drive(made):
    _, numbers = made
    assert len(numbers) == 2 * (3 * 3 * 3 + 3 * 2 + 2 * 3 * 3)
    of_coil = [row for row in numbers if (row["label"], row["actions"]) == ("coil", "sampled")]
    drive = next(row for row in of_coil if row["seed"] == "2")
    assert (drive["case"], float(drive["reward"]), float(drive["lap_time"])) == ("a", 482, 50)


def test_many_tracks_are_in_the_csv_only(tmp_path):
    runs = make_runs(tmp_path / "main", {"coil": 30.0, "ppo": 60.0}, seeds=2)
    for run in runs:
        first = run.evaluation[run.evaluation["case"] == "a"]
        object.__setattr__(
            run, "evaluation", pd.concat([first.assign(case=name) for name in "abcdefghi"])
        )
    page = Table5(["main"]).make(tmp_path / "t", {"main": runs})
    assert page.count("The rewards in each of the 9 cases are in t.csv.") == 2
