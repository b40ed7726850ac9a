"""Every mistake in the input of a program is answered by one sentence.

The exit code is 2, and there is no traceback and no new file.
"""

import signal
import subprocess
import warnings
from functools import partial
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from programs import called, command, environment
from run_folders import make_untrained_run

from coil_rl.programs import app, train

TRACK = ["track=generated", "track.train.count=1", "track.test.count=1"]
LONG = 300 * "x"


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Return the trainings that start to work: they do nothing, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    names = []
    monkeypatch.setattr(train, "train", lambda config: names.append("train"))
    return names


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run with an untrained policy."""
    short = ["env.time_limit=0.5", "evaluation.repeats=1", "evaluation.gif=false"]
    return make_untrained_run(tmp_path_factory.mktemp("runs") / "run", *TRACK, *short)


def files():
    paths = {str(path) for path in Path().rglob("*")}
    return {path for path in paths if not path.startswith((".hypothesis", ".git"))}


def refusal(name, *arguments):
    before = files()
    done = called(name, *arguments, code=None)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert files() == before
    assert line.startswith(f"{name}: ")
    return line.removeprefix(f"{name}: ")


NO_EFFECT = "has no effect: a guide is evaluated without an agent"
OWN = "has no effect: RUN has its own configuration"
OF_TRAINING = "has no effect: only a training reads it"


@pytest.mark.fast(16)
@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("train", "sed=1", "no key sed; the configuration has preset, track, env, guide"),
        ("train", "learner.gamma=abc", "learner.gamma='abc' must be a valid number"),
        ("train", "guide=splin", "no guide=splin; guide can be authors, bot, centre_fast"),
        # command line
        ("train", "learner.gamma", "'learner.gamma' cannot be parsed; write KEY=VALUE"),
        ("train", "=3", "'=3' has no key, write KEY=VALUE"),
        ("train", "seed=1,2", "Ambiguous value for argument 'seed=1,2'"),
        ("train", "env.rate=${nope}", "env.rate: Interpolation key 'nope' not found"),
        ("train", "--nope", "unrecognized arguments: --nope"),
        ("train", "--config-dir=nope", "nope' not found"),
        ("train", "-m resume=run,other", "resume=run,other takes no argument but trust="),
        # folders
        ("train", "hydra.run.dir=/dev/null/run", "/dev/null/run cannot be used (Not a directory)"),
        ("train", f"label={LONG}", "cannot be used (File name too long); choose a shorter name"),
        ("train", "run_dir=/dev/null", "(File exists); choose another folder"),
        ("train", "track=folder track.dir=/nowhere", "cannot be read (No such file or directory)"),
        ("train", f"init={LONG}", LONG[:60]),
        ("train", f"resume={LONG}", LONG[:60]),
        ("report", f"folder={LONG}", LONG[:60]),
        ("compare", f"env=pendulum folder={LONG}", LONG[:60]),
        ("compare", f"env=pendulum guide={LONG}", LONG[:60]),
        *((name, f"run={LONG}", LONG[:60]) for name in ("listen", "drive", "export", "info")),
        ("evaluate", "run=/nowhere", "run=/nowhere is not the folder of a run"),
        ("replay", "recording=drive.mcap run_dir=new/er", "drive.mcap"),
        (
            "evaluate",
            "guide=controller guide.controller.of=math:sin guide.controller.in_keys=[x]",
            "guide.controller: it reads x, but the env has only observation, cones, ",
        ),
        (
            "evaluate",
            "guide=controller guide.controller.of=math:sin guide.controller.in_keys=[x]",
            "; name those that it reads by in_keys=[ENTRY,...]",
        ),
        # what an evaluation does not read
        (
            "evaluate",
            "run=RUN env.laps=2",
            f"env.laps=2 {OWN} (for another env +evaluation.env.KEY=VALUE); what can be changed is "
            "run, ",
        ),
        ("evaluate", "run=RUN +action.x=1", f"+action.x=1 {OWN}"),
        ("listen", "run=RUN guide=random", f"guide=random {OWN}"),
        ("evaluate", "run=RUN evaluation.curve.num_envs=3", f"num_envs=3 {OF_TRAINING}"),
        ("listen", "run=RUN evaluation.curve.num_envs=3", f"num_envs=3 {OF_TRAINING}"),
        ("evaluate", "run=RUN evaluation.guides=ends", f"guides=ends {OF_TRAINING}"),
        ("evaluate", "run=RUN evaluation.sections=null", "no effect: only coil-listen reads it"),
        ("evaluate", "method=ppo", f"method=ppo {NO_EFFECT}"),
        ("evaluate", "evaluation.policy=last", f"evaluation.policy=last {NO_EFFECT}"),
        ("evaluate", "beside=fallback", f"beside=fallback {NO_EFFECT}"),
        ("evaluate", "evaluation.repeats=9", f"evaluation.repeats=9 {NO_EFFECT}"),
        ("evaluate", "+evaluation.advice.x=1", f"+evaluation.advice.x=1 {NO_EFFECT}"),
        # what other programs do not
        ("distill", "degrade=[noisy]", "degrade=[noisy] has no effect: a proxy is trained as the"),
        ("distill", "hydra.run.dir=mine", "the files are written to proxy.folder=FOLDER"),
        ("report", "folder=. hydra.run.dir=mine", "the files are written to folder=FOLDER"),
        ("distill", "proxy.budget.frames=-5", "proxy.budget.frames=-5 must be at least 1"),
        ("distill", "proxy.learner._target_=coil_rl.learners.PPO", "method=proxy needs a learn"),
        ("train", "beside=fallback method=ppo", "its agent has no guide in its env; train it"),
        ("train", "beside=fallback method=guide", "no effect: method=guide trains no policy"),
        ("train", "beside=fallback method=residual", "env adds the actions of agent and guide"),
        ("train", "beside=fallback method=oil", "its learner has no value function; train it"),
    ],
    ids=lambda text: text[:50],
)
def test_mistake_is_one_line_with_exit_code_2_and_leaves_nothing(
    started, run, name, words, message
):
    if name == "replay":
        Path("drive.mcap").touch()  # it is opened after the check
    on_tracks = name in ("train", "evaluate", "listen", "distill")
    tracks = TRACK if on_tracks and "track=" not in words and "resume=" not in words else []
    said = refusal(name, *words.replace("RUN", str(run)).split(), *tracks)  # options come first
    assert message.replace("RUN", f"run={run}") in said
    assert not started


def test_existing_folders_are_kept(started, tmp_path):
    (tmp_path / "mine" / "empty").mkdir(parents=True)
    for folder in ("mine/empty", "mine/empty/new/er"):
        refusal("train", *TRACK, "seed=-1", f"hydra.run.dir={folder}")
    assert (tmp_path / "mine" / "empty").is_dir()


def test_tracks_are_not_changed_where_none_are_chosen(started, run):
    said = refusal("evaluate", f"run={run}", "track.test.split=train")
    assert said.startswith(f"track.test.split=train has no effect alone: run={run} has its own")


def test_error_of_the_program_itself_shows_its_traceback(started, monkeypatch):
    def broken(config):
        raise ValueError("a bug")

    monkeypatch.setattr(train, "train", broken)
    with pytest.raises(ValueError, match="a bug"):
        called("train", *TRACK, code=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"evaluation.policy": "best"}, None),  # replaced by the requested evaluation
        (
            b"a: [1,\n  b: }",
            "config.yaml is not the configuration of a run (line 2: it is no YAML: ",
        ),
        (b"- 1\n", "config.yaml is not the configuration of a run (it holds no keys)"),
        (b"", "is not the configuration of a run ("),
        ({"seed": "abc"}, "Value 'abc' of type 'str' could not be converted to Integer"),
        ({"learner.gama": 1}, "learner: PPO takes no gama"),
        ({"learner.hidden": [8]}, "policy_last.pt does not fit the networks in"),
        ({"budget.num_envs": -5}, "budget.num_envs=-5 must be at least 1"),
    ],
)
def test_changed_run_folder_is_refused(started, run, tmp_path, change, message):
    (tmp_path / "policy_last.pt").write_bytes((run / "policy_last.pt").read_bytes())
    config = OmegaConf.load(run / "config.yaml")
    for key, value in change.items() if isinstance(change, dict) else ():
        OmegaConf.update(config, key, value, merge=False)
    OmegaConf.save(config, tmp_path / "config.yaml")
    if isinstance(change, bytes):
        (tmp_path / "config.yaml").write_bytes(change)
    if message is None:
        assert called("evaluate", *TRACK, "run=.").stderr == ""
    else:
        assert message in refusal("evaluate", *TRACK, "run=.")


def test_resume_checks_the_configuration_before_it_trains(started, run, tmp_path):
    config = OmegaConf.load(run / "config.yaml")
    del config.guide.spline["_target_"]
    OmegaConf.save(config, tmp_path / "config.yaml")
    (tmp_path / ".lock").touch()
    assert "config.yaml: guide.spline={'spline': 'cubic', " in refusal("train", "resume=.")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["degrade=[zeroed]"], ["+degrade@evaluation.advice.zeroed=zeroed"]]
)
@pytest.mark.parametrize("method", ["ppo", "guide"])
def test_other_advice_is_refused_for_a_policy_without_any(method, words, tmp_path):
    folder = make_untrained_run(tmp_path / "run", f"method={method}", *TRACK)
    for exported, reason in (
        ([], f"the policy of run={folder} has no advice"),
        (["exported=policy.onnx"], "the exported policy acts alone, as it is in its file"),
    ):
        given = [f"run={folder}", *words, *exported]
        refused = called("evaluate", *given, cwd=tmp_path, code=2).stderr
        assert "has no effect: " in refused
        assert reason in refused


# The first is imported before the program begins, the second by its check of the configuration.
@pytest.mark.fast(1)
@pytest.mark.parametrize("module", [b"omegaconf.errors", b"torch.nn.functional"])
def test_interrupt_while_importing_is_one_line(tmp_path, module):
    python, *arguments = command("train", *TRACK)
    verbose = [python, "-X", "importtime", *arguments]  # a line on standard error for each module
    # A shell ignores the signal in what it starts in the background, as perhaps these tests.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    started = subprocess.Popen(
        verbose, cwd=tmp_path, env=environment(tmp_path), stderr=subprocess.PIPE, preexec_fn=heed
    )
    next(line for line in started.stderr if module in line)
    started.send_signal(signal.SIGINT)
    _, error = started.communicate(timeout=60)
    assert started.returncode == 130, error
    assert error.splitlines()[-1] == b"train: interrupted"
    assert b"Traceback" not in error


def test_folder_in_place_of_the_lock_is_named(tmp_path):
    lock = tmp_path / "run" / ".lock"
    lock.mkdir(parents=True)
    words = ["method=guide", f"hydra.run.dir={tmp_path}/run", *TRACK]
    said = called("train", *words, cwd=tmp_path, code=2).stderr
    assert f"{lock} is a folder, but must be a file that locks the run; remove it" in said


def test_folder_in_place_of_a_file_is_named(tmp_path):
    (tmp_path / "runs" / "one" / "config.yaml").mkdir(parents=True)
    said = called("report", "folder=runs", cwd=tmp_path, code=2).stderr
    assert said.startswith("report: runs/one/config.yaml cannot be used (Is a directory); ")


def test_warning_is_one_line_of_the_program_however_often_it_is_given(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    with app.program("replay"):
        said = [
            warnings.formatwarning(f"topic {topic} is ignored", UserWarning, "reading.py", 189)
            for topic in ("a", "a", "b", "a")
        ]
    assert said == ["replay: topic a is ignored\n", "", "replay: topic b is ignored\n", ""]
