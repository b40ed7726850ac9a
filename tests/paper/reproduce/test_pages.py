import json
import math

import pytest
from reproduced_runs import make_runs, row

from coil_paper.reproduce import pages
from coil_paper.reproduce.pages import Claim, claims_section
from coil_rl.report.statistics import Estimate, estimate


def test_a_page_has_heading_warning_picture_text_and_origin():
    text = pages.page("## Table 9: something\n\ntext", "table_9", "A smoke test.", "Made by hand.")
    assert text == (
        "## Table 9: something\n\n> **A smoke test.**\n\n"
        "![Table 9: something](table_9.png)\n\ntext\n\n"
        "<sub>Made by hand.</sub>\n"
    )
    assert "> **" not in pages.page("## Table 9: something\n\ntext", "table_9", None, "")


def test_the_origin_has_command_commits_seeds_and_frames(tmp_path):
    runs = make_runs(tmp_path / "runs", {"coil": 0.0, "ppo": 0.0}, seeds=2)
    runs += make_runs(tmp_path / "other", {"guided": 0.0}, seeds=1, curve=False)
    for run, commit in zip(runs, ["abc", "abc", "abc-dirty", "abc"], strict=False):
        (run.folder / "versions.json").write_text(json.dumps({"commit": commit}))
    assert pages.origin("coil-reproduce table=4", "def-dirty", runs) == (
        "Made by `coil-reproduce table=4` at commit `def` with local changes. "
        "5 runs with the seeds 0, 1, made at "
        "commit `abc`, `abc` with local changes, `unknown`. Training frames: 4,000 (coil, ppo)."
    )
    assert pages.origin("make table=1", "def") == "Made by `make table=1` at commit `def`."


def test_results_md_has_the_claims_the_pages_and_the_missing_results():
    body = "## Table 9: something\n\ntable\n\n### What held up\n\n| more |"
    made = pages.page(body, "table_9", "A note.", "Made.")
    text = pages.all_results(
        {"table_9": made, "figure_3": None},
        {"table_9": "make table=9", "figure_3": "make figure=3"},
        "make all=true",
        "A note.",
        ["One\n  problem."],
        ["One limit."],
    )
    order = [
        "> **A note.**",
        "`make all=true` writes this file",
        "| more |",
        "![Table 9: something](table_9.png)",
        "- `make figure=3`",
        "- One problem.",
        "- One limit.",
    ]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert text.count("A note.") == text.count("| more |") == 1


BETTER, WORSE = (1.5, 1.0, 2.0, 3), (-1.5, -2.0, -1.0, 3)


@pytest.mark.parametrize(
    ("number", "sign", "p", "cell"),
    [
        (BETTER, 1, 0.049, "**held up**: +1.5 (+1.0 to +2.0), 3 seeds, p 0.049"),
        (WORSE, 1, 0.01, "**did not hold up**: -1.5 (-2.0 to -1.0), 3 seeds, p 0.010"),
        (WORSE, -1, 0.01, "**held up**: -1.5 (-2.0 to -1.0), 3 seeds, p 0.010"),
        (BETTER, 1, 0.06, "**undecided**: +1.5 (+1.0 to +2.0), 3 seeds, p 0.060"),
        (BETTER, 1, 0.0, "**held up**: +1.5 (+1.0 to +2.0), 3 seeds, p < 0.001"),
        ((2.0,), 1, math.nan, "**undecided**: +2.0, 1 seed"),
        ((math.nan,), 1, math.nan, None),
    ],
)
def test_a_verdict_needs_a_small_p(number, sign, p, cell):
    assert Claim(Estimate(*number), "+.1f", sign).verdict(p) == cell


def test_the_verdicts_of_a_world_are_one_family():
    alone = Claim(estimate([1.0, 1.1, 1.3]), ".1f")
    undecided = Claim(estimate([1.0, -1.0, 0.5]), ".1f")
    assert 0.005 < alone.estimate.p < 0.025
    first, other = {"claim": "first", "ours": alone}, {"claim": "other", "ours": undecided}
    for others, word in [(1, "held up"), (8, "undecided")]:
        page = claims_section([first, *[other] * others], {"ours": "ours"})
        assert row(page, "first")[1].startswith(f"**{word}**")
    elsewhere = [other | {"world": "rain"}] * 8
    page = claims_section([first | {"world": ""}, *elsewhere], {"ours": "ours"})
    assert row(page, "first")[1].startswith("**held up**")
    assert row(page, "other, rain")[1].startswith("**undecided**")
