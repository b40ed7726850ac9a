import pytest
from run_folders import driven, make_run, make_sweep

from coil_rl.errors import UserError
from coil_rl.report.runs import MEASURES, read_runs


@pytest.fixture
def sweep(tmp_path):
    return make_sweep(tmp_path / "sweep")


def test_every_run_of_a_folder_is_read(sweep):
    runs = read_runs([sweep])
    assert [(run.folder.name, run.label, run.seed) for run in runs[:2]] == [
        ("0_coil", "coil", 0),
        ("1_coil", "coil", 1),
    ]
    assert [run.finished for run in runs] == [True] * 6 + [False] * 2
    assert [run.needs_guide for run in runs[2:4]] == [True, False]
    guide, agent, sampled, zeroed = runs[1].drives
    assert (guide.driver, guide.advice, guide.actions, guide.tracks) == ("guide", "", "deterministic", ("a", "b"))
    assert (agent.driver, sampled.actions, zeroed.advice) == ("coil", "sampled", "zeroed")
    assert agent.values[:, MEASURES.index("reward")].tolist() == [521, 621], "without the row of the mean"
    assert agent.values[:, MEASURES.index("smoothness")].tolist() == [0.2, 0.2]
    assert (runs[1].guide_returns, runs[1].curve[0]["frames"], len(runs[1].curve)) == ({"guide": 300}, 1000, 20)


def test_runs_are_found_at_any_depth_and_once(sweep):
    (sweep / "0_coil" / ".hydra").mkdir()
    (sweep / "0_coil" / ".hydra" / "config.yaml").write_text("seed: 0")
    assert len(read_runs([sweep.parent])) == len(read_runs([sweep, sweep / "0_coil", sweep.parent])) == 8
    assert [run.label for run in read_runs([sweep / "3_ppo", sweep / "0_coil"])] == ["ppo", "coil"]


def test_a_guide_alone_learns_nothing(tmp_path):
    run = make_run(tmp_path / "run", "guide", 0, driven("guide", {"a": 1.0}), needs_guide=None)
    (run / "metrics.csv").unlink()
    (run / "guide_return.json").unlink()
    (found,) = read_runs([tmp_path])
    assert found.finished
    assert (list(found.curve), found.guide_returns, found.needs_guide) == ([], {}, None)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("evaluation.csv", "", r"is damaged \(no rows\); remove the file and write it again by coil-train resume="),
        ("evaluation.csv", "driver,actions\nguide,sampled\n", r"no column 'advice'"),
        (
            "evaluation.csv",
            "driver,advice,actions,track,reward\nguide,,sampled,a,much\n",
            "could not convert .* 'much'",
        ),
        ("evaluation.csv", "driver,advice,actions,track,reward\nguide,,sampled,a,1.0\n", "no column 'lap_time'"),
        ("evaluation.csv", 'driver,advice\n"guide', "unexpected end of data"),
        ("evaluation.csv", b"\xff\xfe", "codec can't decode"),
        ("metrics.csv", "frames,train/return\n1,2\n3,\n", r"metrics.csv is damaged .*; put the whole file back"),
        ("metrics.csv", "frames,train/return\n1,2\n3\n", "metrics.csv is damaged"),
        ("guide_return.json", "[1", "guide_return.json is damaged"),
        ("config.yaml", "seed: 0\n", r"no label, seed and method.needs_guide to read \(Missing key label\)"),
        ("config.yaml", "- 1\n", r"to read \(a list\); put back the file"),
        ("config.yaml", "seed: [\n", "take the run out of the folder"),
        ("config.yaml", "seed: x\nlabel: a\nmethod: {needs_guide: true}\n", "invalid literal for int"),
    ],
)
def test_a_damaged_file_is_named(sweep, file, text, words):
    (sweep / "1_coil" / file).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=words) as found:
        read_runs([sweep])
    assert str(found.value).startswith(str(sweep / "1_coil" / file))
    assert "\n" not in str(found.value)


def test_folders_without_runs_are_refused(tmp_path):
    with pytest.raises(UserError, match="holds no run of coil-train"):
        read_runs([tmp_path])
    with pytest.raises(UserError, match="is not there; give a folder in which coil-train"):
        read_runs([tmp_path / "nowhere"])


def test_what_a_run_keeps_for_itself_is_no_run(tmp_path):
    run = make_run(tmp_path / "run", "coil", 0, driven("guide", {"a": 1.0}))
    make_run(run / "proxies" / "spline", "proxy", 0, None)
    assert [found.folder for found in read_runs([tmp_path])] == [run]
