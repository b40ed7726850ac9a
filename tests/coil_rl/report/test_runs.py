import pytest
from run_folders import driven, make_run, make_sweep

from coil_rl.errors import UserError
from coil_rl.report.runs import read_runs


@pytest.fixture
def sweep(tmp_path):
    return make_sweep(tmp_path / "sweep")


def test_every_run_of_a_folder_is_read(sweep):
    runs = read_runs([sweep])
    names = [(run.folder.name, run.label, run.seed) for run in runs[:2]]
    assert names == [("0_coil", "coil", 0), ("1_coil", "coil", 1)]
    assert [run.finished for run in runs] == [True] * 6 + [False] * 2
    assert [run.needs_guide for run in runs[2:4]] == [True, False]
    drives = runs[1].evaluation.groupby(["driver", "advice", "actions"], sort=False)
    assert [name for name, _ in drives] == [
        ("guide", "", "deterministic"),
        ("coil", "", "deterministic"),
        ("coil", "", "sampled"),
        ("coil", "zeroed", "deterministic"),
    ]
    agent = drives.get_group(("coil", "", "deterministic"))
    columns = agent[["case", "reward", "smoothness"]]
    assert columns.to_numpy().tolist() == [["a", 521, 0.2], ["b", 621, 0.2]]
    assert runs[1].guide_returns == {"guide": 300}
    assert (runs[1].curve[0]["frames"], len(runs[1].curve)) == (1000, 20)


def test_numbers_keep_every_digit(tmp_path):
    make_run(tmp_path / "run", "coil", 0, driven("coil", {"a": 0.1 + 0.2, "b": 1 / 3}))
    (run,) = read_runs([tmp_path])
    assert run.evaluation["reward"].tolist() == [0.1 + 0.2, 1 / 3]


def test_runs_are_found_once_at_any_depth(sweep):
    (sweep / "0_coil" / ".hydra").mkdir()
    (sweep / "0_coil" / ".hydra" / "config.yaml").write_text("seed: 0")
    make_run(sweep / "0_coil" / "proxies" / "spline", "proxy", 0, None)
    assert len(read_runs([sweep.parent])) == 8
    assert len(read_runs([sweep, sweep / "0_coil", sweep.parent])) == 8
    assert [run.label for run in read_runs([sweep / "3_ppo", sweep / "0_coil"])] == ["ppo", "coil"]


def test_guide_without_agent_has_no_curve(tmp_path):
    run = make_run(tmp_path / "run", "guide", 0, driven("guide", {"a": 1.0}), needs_guide=None)
    (run / "metrics.csv").unlink()
    (run / "guide_return.json").unlink()
    (found,) = read_runs([tmp_path])
    assert (list(found.curve), found.guide_returns, found.needs_guide) == ([], {}, None)


HEAD = "driver,advice,actions,case,reward,lap_time,smoothness,completed,crashed,clearance\n"
ROW = "guide,,sampled,a,"
DRIVERS = "\n".join(f"guide {number},,deterministic,a,1,1,1,1,1,1" for number in range(201))


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("evaluation.csv", "", r"\(No columns.*\); remove the file and write it again"),
        ("evaluation.csv", HEAD, r"is damaged \(0 rows, not 1 to 50,000\)"),
        ("evaluation.csv", HEAD + DRIVERS, r"is damaged \(201 drivers, not 1 to 200\)"),
        ("evaluation.csv", "driver,actions\nguide,sampled\n", r"is damaged \(it lacks advice\)"),
        ("evaluation.csv", HEAD.replace("lap_", "") + ROW + "1,1,1,1,1,1", "no column lap_"),
        ("evaluation.csv", HEAD + ROW + "much,1,1,1,1,1\n", "could not convert .* 'much'"),
        ("evaluation.csv", HEAD + ROW + "1,1,1,1,1,1,1", "more values than columns"),
        ("evaluation.csv", b"\xff\xfe", "codec can't decode"),
        ("metrics.csv", "frames,evaluation/return\n1,2\n3,\n", "is damaged .*; put the file back"),
        ("metrics.csv", "1,2\n3,4\n", r"\(not every row has its number of frames\)"),
        ("guide_return.json", "[1", "guide_return.json is damaged"),
        ("config.yaml", "seed: 0\n", r"no valid label, seed and .* \(Missing key label\)"),
        ("config.yaml", "- 1\n", r"\(a list\); restore the file"),
        ("config.yaml", "seed: [\n", "remove the run from the folder"),
    ],
)
def test_error_names_the_damaged_file(sweep, file, text, message):
    (sweep / "1_coil" / file).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=message) as error:
        read_runs([sweep])
    assert str(error.value).startswith(str(sweep / "1_coil" / file))
    assert "\n" not in str(error.value)
