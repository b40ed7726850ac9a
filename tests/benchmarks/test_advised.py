"""How often coil-compare is right, by a table of whole trainings and what it said."""

import json

import pytest

from benchmarks.guide_benchmark import advised

NAMES = ("task", "method", "arm", "end", "guide", "random")
ROWS = [
    dict(zip(NAMES, map(str, row), strict=True))
    for row in [
        ("plant", "ppo", "alone", 60, "nan", 0),
        ("plant", "tune", "intact", 100, 50, 0),
        ("plant", "coil", "intact", 80, 50, 0),
        ("plant", "coil_anchored", "intact", 70, 50, 0),
        ("plant", "coil", "reversed", 40, -50, 0),
        ("plant", "coil_anchored", "reversed", 55, -50, 0),
        ("other", "ppo", "alone", 1, "nan", 0),
    ]
]


def comparison(folder, use, train="", **measured):
    folder.mkdir()
    (folder / "verdict.json").write_text(json.dumps({"use": use, "train": train}))
    rows = "".join(f"{name},{value}\n" for name, value in measured.items())
    (folder / "compare.csv").write_text(f"policy,return\n{rows}")
    return folder


def test_ends_are_those_of_a_guide_with_plain_learning_and_without_tuning():
    assert advised.ends(ROWS, "plant", "intact") == {
        "ppo": 60,
        "coil": 80,
        "coil_anchored": 70,
        "guide": 50,
    }


@pytest.mark.parametrize(
    ("arm", "use", "train", "value", "regret"),
    [
        ("intact", "coil_anchored", "coil_anchored", 70, 12.5),
        ("intact", "guide", "coil_anchored", 50, 37.5),
        ("intact", "residual", "residual", 30, 62.5),
        ("reversed", "ppo", "ppo", 60, 0),
        ("reversed", "opposite", "ppo", 49, 100 * 11 / 60),
        ("reversed", "nothing", "coil_anchored", 55, 100 * 5 / 60),
    ],
)
def test_regret_is_the_way_to_the_best_whole_training(arm, use, train, value, regret, tmp_path):
    folder = comparison(tmp_path / "it", use, train, residual=30, opposite=49, ppo=9)
    row = advised.judged(ROWS, "plant", arm, folder)
    assert row["value"] == value
    assert row["regret"] == pytest.approx(regret)


def test_opposite_that_is_better_than_all_methods_is_the_best(tmp_path):
    folder = comparison(tmp_path / "it", "opposite", opposite=75)
    row = advised.judged(ROWS, "plant", "reversed", folder)
    assert (row["best"], row["regret"]) == ("opposite", 0)
    assert row["regret_ppo"] == pytest.approx(20)


def test_page_has_the_share_of_right_recommendations(tmp_path):
    folders = [
        comparison(tmp_path / "one", "coil", "coil", coil=0),
        comparison(tmp_path / "other", "guide", "ppo", guide=0),
    ]
    found = [advised.judged(ROWS, "plant", "intact", folder) for folder in folders]
    text = advised.page(found)
    assert "**coil-compare**, of 2: mean regret 18.8 %, 50% within 1 %" in text
    assert "**always ppo**, of 2: mean regret 25.0 %" in text


def test_mean_regret_of_a_method_is_over_the_guides_it_has_rows_for(tmp_path):
    rows = [row for row in ROWS if (row["method"], row["arm"]) != ("coil_anchored", "reversed")]
    folder = comparison(tmp_path / "it", "ppo", "ppo", ppo=60)
    found = [advised.judged(rows, "plant", arm, folder) for arm in ("intact", "reversed")]
    text = advised.page(found)
    assert "**always coil_anchored**, of 1: mean regret 12.5 %" in text
    assert "nan" not in text.partition("|")[0]


def test_arguments_name_the_file_of_a_detuned_guide_and_the_folder_of_foreign_tasks(tmp_path):
    own = advised.words("cones_noisy_view", "detuned", tmp_path, 60_000)
    assert own[:2] == ["+task=cones_noisy_view", "+arm=detuned/cones"]
    foreign = advised.words("inventory", "random", tmp_path, 60_000)
    assert foreign[0].startswith("hydra.searchpath=")
    assert foreign[2:4] == ["+arm=random", "budget.frames=60000"]
