"""Every mistake in the input of a program is answered by one sentence.

The exit code is 2, and there is no traceback and no new file.
"""

import signal
import subprocess
import warnings
from functools import partial
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from programs import called, command, composed, environment
from run_folders import make_untrained_run

import coil_rl.run.run  # noqa: F401  before `started` replaces functions that it imports
from coil_rl.config.check import check
from coil_rl.config.messages import sentence
from coil_rl.errors import UserError
from coil_rl.programs import app, train
from coil_rl.run import judge

TINY = [
    "budget.num_envs=8",
    "budget.steps=32",
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
]
ERRORS = (UserError, OmegaConfBaseException, HydraException, ValueError, OSError, AssertionError)


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Return the names of the programs that start to work: they do nothing, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    names = []
    monkeypatch.setattr(train, "train", lambda config: names.append("train"))
    monkeypatch.setattr(judge, "judge", lambda *_: None)
    monkeypatch.setattr(judge, "report_outcome", lambda folder: 0.0)
    return names


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


# Without the program, which composes the configuration twice.
@pytest.mark.fast(10)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # keys
        ("sed=1", "init; did you mean seed?"),
        ("budget.step=1", "budget has frames, num_envs, steps, minibatches, stages; did you mean"),
        ("+budget.frame=1", "there is no key frame; budget has frames, num_envs, steps"),
        ("training.env.laps=1", "training.env has none; +training"),
        ("+watch.epsode.a=[reward]", "watch has episode, step; did you mean episode?"),
        ("logger=null", "Config group override must be a string or a list. Got NoneType"),
        # types and values
        ("budget=5", "budget=5: Invalid type assigned: int is not a subclass of BudgetConfig"),
        ("budget.num_envs=100000 budget.steps=10000", "num_envs x budget.steps=1000000000 must be"),
        ("device=tpu", "device=tpu must be cpu, cuda, or one GPU such as cuda:0"),
        ("device=cuda compile=true", "compile=true is for the CPU only, not for device=cuda"),
        ("evaluation.measures.clearance.format=nan", "format=nan must be a format of numbers"),
        ("watch.step.smoothness=null", "=None must be a list, such as [info, lap]"),
        ("watch.episode.laps=[info,pose]", "watch.episode.laps=info.pose has 3 numbers a row"),
        ("evaluation.measures.laps.where=[info,lap]", "where=info.lap must be a flag"),
        ("evaluation.measures.laps.reduction=median", "measures.laps: reduction=median must be"),
        ("~evaluation.curve.cases.selection", "give evaluation and selection"),
        ("label=guide", "label=guide cannot be used"),
        ("guide=constant guide.constant.value=[1,2]", "shape [2, 2], but must have [2, 1]"),
        ("method=guide init=none", "init=none has no effect: method=guide trains no policy"),
        # targets
        ("guide.spline._target_=coil_rl.guides.Nope", "there is no 'coil_rl.guides.Nope'; check"),
        ("guide.spline._target_=coil_rl.cones.spline.FAR", "is 1000.0, which cannot be called"),
        ("guide=zero guide.zero._target_=builtins.dict", "makes dict, not TensorDictModuleBase"),
        ("guide=zero guide.zero._target_=subprocess.run", "'subprocess.run' is blocklisted"),
        # groups
        ("+guide=random", "To override a value use 'override guide: random'"),
        ("hydra/launcher=submitit_slurm", "not installed: python -m pip install 'coil-rl[slurm]'"),
        ("+degrade=${pid:}", "cannot be composed; give each group a name, GROUP=CHOICE"),
        (f"method={'x' * 300}", "... cannot be used (File name too long); choose a shorter name"),
        # combinations
        ("guide=linear_feedback", "it cannot act on the observations of this env (The size of"),
        ("degrade=[shuffled] track.train.count=2", "each case of the evaluation has one row, 1 in"),
        ("method=oil", "there is one track or episode, which cannot be left out to validate; "),
        ("method=dynamic_coil_joint proxy.method.observes=null", "a proxy needs observations"),
        ("method=dynamic_coil_joint ~proxy.method.transforms.advice", "guide.spline: method."),
        ("observes=[] method=ppo", "observes=[]: the agent has no observations; give the entries"),
        ("guide=none", "there is none, but method=coil needs one; give guide=NAME, or method=ppo"),
        ("method=rfc +method.transforms.coupling.guide=1", "RewardCoupling reads row 1 of"),
        ("method=rfc ~method.transforms.advice", "but there is no advice; put GuideActions with"),
    ],
)
def test_mistake_is_refused_in_one_sentence(monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ERRORS) as caught:
        check(composed(*TINY, "run_dir=run", *arguments.split()))
    text = sentence(caught.value)
    assert message in text
    assert len(text.splitlines()) == 1
    assert not files()


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("sed=1", "no key sed; the configuration has preset, track, env, guide"),
        ("learner.gamma=abc", "learner.gamma='abc' must be a valid number"),
        ("guide=splin", "no guide=splin; guide can be authors, bot, centre_fast"),
        # command line
        ("learner.gamma", "'learner.gamma' cannot be parsed; write KEY=VALUE"),
        ("=3", "'=3' has no key, write KEY=VALUE"),
        ("seed=1,2", "Ambiguous value for argument 'seed=1,2'"),
        ("env.rate=${nope}", "env.rate: Interpolation key 'nope' not found"),
        ("--nope", "unrecognized arguments: --nope"),
        ("--config-dir=nope", "nope' not found"),
        # folders
        ("hydra.run.dir=/dev/null/run", "/dev/null/run cannot be used (Not a directory)"),
        (f"label={'x' * 300}", "cannot be used (File name too long); choose a shorter name"),
        ("run_dir=/dev/null", "/dev/null cannot be used (File exists); choose another folder"),
        ("track=folder track.dir=/nowhere", "/nowhere cannot be read (No such file or directory)"),
    ],
)
def test_mistake_ends_the_program_with_exit_code_2_and_leaves_no_folder(
    started, arguments, message
):
    words = [*arguments.split(), *TINY[: 2 if "track=" in arguments else None]]  # options first
    assert message in refusal("train", *words)
    assert not started


def test_existing_folders_are_kept(started, tmp_path):
    (tmp_path / "mine" / "empty").mkdir(parents=True)
    refusal("train", *TINY, "seed=-1", "hydra.run.dir=mine/empty")
    refusal("train", *TINY, "seed=-1", "hydra.run.dir=mine/empty/new/er")
    assert (tmp_path / "mine" / "empty").is_dir()


def test_error_of_the_program_itself_shows_its_traceback(started, monkeypatch):
    def broken(config):
        raise ValueError("a bug")

    monkeypatch.setattr(train, "train", broken)
    with pytest.raises(ValueError, match="a bug"):
        called("train", *TINY, code=None)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run with an untrained policy."""
    return make_untrained_run(tmp_path_factory.mktemp("runs") / "run", *TINY)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"evaluation.policy": "best"}, None),  # replaced by the requested evaluation
        (b"a: [1,\n  b: }", "line 2: it is no YAML: "),
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
        assert called("evaluate", *TINY[2:], "run=.").stderr == ""
    else:
        assert message in refusal("evaluate", *TINY[2:], "run=.")


def test_resume_checks_the_configuration_before_it_trains(started, run, tmp_path):
    config = OmegaConf.load(run / "config.yaml")
    del config.guide.spline["_target_"]
    OmegaConf.save(config, tmp_path / "config.yaml")
    (tmp_path / ".lock").touch()
    assert "config.yaml: guide.spline={'spline': 'cubic', " in refusal("train", "resume=.")


@pytest.mark.fast(6)
@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("evaluate", "env.laps=2", "has its own configuration; what can be changed is run, "),
        ("evaluate", "+action.x=1", "has its own configuration"),
        ("listen", "guide=random", "has its own configuration"),
        ("evaluate", "evaluation.curve.num_envs=3", "only a training reads it"),
        ("listen", "evaluation.curve.num_envs=3", "only a training reads it"),
        ("evaluate", "evaluation.guides=ends", "only a training reads it"),
        ("evaluate", "evaluation.sections=null", "only coil-listen reads it"),
    ],
)
def test_override_that_the_evaluation_of_a_run_does_not_read_is_refused(
    started, run, name, change, reason
):
    said = refusal(name, *TINY[2:], f"run={run}", change)
    assert said.startswith(f"{change} has no effect: ")
    assert reason in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["degrade=[zeroed]"], ["+degrade@evaluation.advice.zeroed=zeroed"]]
)
@pytest.mark.parametrize("method", ["ppo", "guide"])
def test_other_advice_is_refused_for_a_policy_without_any(method, words, tmp_path):
    folder = make_untrained_run(tmp_path / "run", f"method={method}", *TINY)
    for exported, reason in (
        ([], f"the policy of run={folder} has no advice"),
        (["exported=policy.onnx"], "the exported policy acts alone, as it is in its file"),
    ):
        given = [f"run={folder}", *words, *exported]
        refused = called("evaluate", *given, cwd=tmp_path, code=2).stderr
        assert "has no effect: " in refused
        assert reason in refused


def test_tracks_are_not_changed_where_none_are_chosen(started, run):
    said = refusal("evaluate", f"run={run}", "track.test.split=train")
    assert said.startswith(f"track.test.split=train has no effect alone: run={run} has its own")


@pytest.mark.fast(2)
@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("evaluate", "method=ppo", "a guide is evaluated without an agent"),
        ("evaluate", "evaluation.policy=last", "a guide is evaluated without an agent"),
        ("evaluate", "beside=fallback", "a guide is evaluated without an agent"),
        ("evaluate", "evaluation.repeats=9", "a guide is evaluated without an agent"),
        ("evaluate", "+evaluation.advice.x=1", "a guide is evaluated without an agent"),
        ("distill", "degrade=[noisy]", "a proxy is trained as the key proxy says"),
        ("train", "beside=fallback method=ppo", "its agent has no guide in its env"),
        ("train", "beside=fallback method=guide", "method=guide trains no policy"),
        ("train", "beside=fallback method=residual", "its env adds the actions of agent and guide"),
        ("train", "beside=fallback method=oil", "its learner has no value function"),
    ],
)
def test_override_without_effect_is_refused_with_the_reason(started, name, change, reason):
    said = refusal(name, *TINY[2:], *change.split())
    assert said.startswith(f"{change.split()[0]} has no effect")
    assert reason in said
    assert started == []


def test_refused_program_leaves_no_folder_of_its_own_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.mcap").touch()
    words = ["recording=drive.mcap", "run_dir=new/er"]  # it is opened after the check
    assert "drive.mcap" in refusal("replay", *words)


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    "words",
    [
        ["compare", "env=pendulum", "folder=LONG"],
        ["compare", "env=pendulum", "guide=LONG"],
        ["report", "folder=LONG"],
        ["train", "resume=LONG"],
        ["train", *TINY, "init=LONG"],
        *([name, "run=LONG"] for name in ("evaluate", "listen", "drive", "export", "info")),
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_name_that_no_file_can_have_is_refused(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, *arguments = (word.replace("LONG", 300 * "x") for word in words)
    assert 60 * "x" in refusal(name, *arguments)


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("proxy.budget.frames=-5", "proxy.budget.frames=-5 must be at least 1"),
        ("proxy.learner._target_=coil_rl.learners.PPO", "guide.spline: method=proxy needs a learn"),
    ],
)
def test_proxy_that_cannot_be_is_refused(started, argument, message):
    assert message in refusal("distill", argument)


# The first is imported before the program begins, the second by its check of the configuration.
@pytest.mark.fast(1)
@pytest.mark.parametrize("module", [b"omegaconf.errors", b"torch.nn.functional"])
def test_interrupt_while_importing_is_one_line(tmp_path, module):
    python, *arguments = command("train", *TINY)
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
    words = ["method=guide", f"hydra.run.dir={tmp_path}/run", *TINY[2:]]
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
