import json

from reproduced_runs import make_runs

from coil_rl.reproduce import pages
from coil_rl.reproduce.verdict import interval, verdict, verdicts


def test_a_page_says_what_to_know_shows_its_picture_and_where_it_comes_from():
    text = pages.page("## Table 9: something\n\ntext", "table_9", "A smoke test.", "Made by hand.")
    assert text == (
        "## Table 9: something\n\n> **A smoke test.**\n\n![Table 9: something](table_9.png)\n\ntext\n\n"
        "<sub>Made by hand.</sub>\n"
    )
    assert "> **" not in pages.page("## Table 9: something\n\ntext", "table_9", None, "")


def test_the_origin_has_command_commits_seeds_and_frames(tmp_path):
    runs = make_runs(tmp_path / "runs", {"coil": 0.0, "ppo": 0.0}, seeds=2)
    runs += make_runs(tmp_path / "other", {"guided": 0.0}, seeds=1, curve=False)
    for run, commit in zip(runs, ["abc", "abc", "abc-dirty", "abc"], strict=False):
        (run.folder / "versions.json").write_text(json.dumps({"commit": commit}))
    assert pages.origin("coil-reproduce table=4", "def-dirty", runs) == (
        "Made by `coil-reproduce table=4` at commit `def` with local changes. 5 runs with the seeds 0, 1, done at "
        "commit `abc`, `abc` with local changes, `unknown`. Frames of training: 4,000 (coil, ppo)."
    )
    assert pages.origin("coil-reproduce table=1", "def") == "Made by `coil-reproduce table=1` at commit `def`."


def test_all_results_are_in_one_file_what_held_up_first_and_what_is_missing_named():
    lines = [verdict("More", 1.0, 2.0, "+1.5"), verdict("Less", -2.0, -1.0, "-1.5")]
    made = pages.page("## Table 9: something\n\n" + "\n".join(lines), "table_9", "A note.", "Made.")
    text = pages.results(
        {"table_9": made, "figure_3": None}, {"table_9": "make table=9", "figure_3": "make figure=3"},
        "make all=true", "A note.", ["One\n  problem."], ["One limit."],
    )  # fmt: skip
    order = [
        "# Results", "> **A note.**", "`make all=true` writes this file", "## What held up", "**Table 9: something**",
        "- **held up**: More: +1.5", "- **did not hold up**: Less: -1.5", "## Table 9: something",
        "## Not made yet\n\n- `make figure=3`", "## What is known", "- One problem.", "## What cannot", "- One limit.",
    ]  # fmt: skip
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert text.count("A note.") == 1


def test_a_claim_is_undecided_where_its_interval_has_both_signs_or_is_not_known():
    words = [verdict("a", *ends, "b").split("**")[1] for ends in [(-1, 1), (0, 1), (float("nan"), float("nan"))]]
    assert words == ["undecided"] * 3
    page = "text\n- **held up**: a: b\n- **bold**: c\n- **undecided**: d: e"
    assert verdicts(page) == ["- **held up**: a: b", "- **undecided**: d: e"]


def test_intervals_in_words():
    assert interval(-1.0, 2.0, "+.1f") == "-1.0 to +2.0"
    assert interval(float("nan"), float("nan")) is None
