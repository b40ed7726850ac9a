from coil_rl.benchmark.picture import draw_driving
from coil_rl.benchmark.summary import goals, not_measured, summarise

DRIVING = {"cars": 64, "steps_per_s": 2e4, "steps_per_s_with_guide": 1e4, "steps_per_s_guide_drives": 1.1e4,
           "ms_per_batched_step": 3.2, "ms_per_batched_step_with_guide": 6.4, "resets_per_1000_steps": 2.0,
           "rounds": {}}  # fmt: skip


def test_goals_say_what_was_met():
    results = {
        "training": [{"cars": 8, "steps": 4, "ppo_over_plain": 0.95, "coil_over_plain": 0.5}],
        "oracle": {"cars": 64, "ratio": 600.0},
        "sb3": {"cars": 8, "steps": 4, "stable_baselines3": [{"envs": 1, "ratio": 9.9}]},
        "memory": {"state_bytes_per_car": 400.0},
        "robot": [{"what": "reading MCAP", "scans_per_s": 1.0}, {"what": "perception, one", "scans_per_s": 2000.0}],
    }
    assert [row["met"] for row in goals(results)] == [True, False, True, False, True, True]
    assert goals({}) == []


def test_page_has_what_was_measured_and_says_what_was_not():
    results = {"env": [DRIVING], "sb3": {"not_measured": "it is not installed"}, "goals": []}
    text = summarise(results)
    assert "|   64 |  20,000 |                  10,000 |           11,000 |" in text
    assert "sb3: not measured: it is not installed" in text
    assert "Goals" not in text
    assert not_measured(results) == {"sb3": "it is not installed"}


def test_picture_is_drawn_also_for_one_size(tmp_path):
    draw_driving([DRIVING], tmp_path / "one.png", one_car=300.0)
    draw_driving([DRIVING, DRIVING | {"cars": 256}], tmp_path / "two.svg")
    assert (tmp_path / "one.png").stat().st_size > 1000
    assert "<svg" in (tmp_path / "two.svg").read_text()
