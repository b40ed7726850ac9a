"""Every mistake in the input of a program is answered by one sentence.

The exit code is 2, and there is no traceback and no new file.
"""

import signal
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from programs import called, command, environment
from run_folders import make_untrained_run

import coil_rl
import coil_rl.run.run  # noqa: F401  before `started` replaces functions that it imports
from coil_rl.config.check import check
from coil_rl.config.messages import sentence
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.errors import UserError
from coil_rl.programs import app, train
from coil_rl.run import checkpoint, judge

TINY = [
    "budget.num_envs=8",
    "budget.steps=32",
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
]


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
        ("sed=1", "no key sed; the configuration has preset, track, env, guide, disturb, degrade"),
        ("sed=1", "init; did you mean seed?"),
        (
            "budget.step=1",
            "no key budget.step; budget has frames, num_envs, steps, minibatches, stages; "
            "did you mean steps?",
        ),
        ("+env.sped=3", "env: ConeTrackEnv takes no sped; it takes tracks, num_envs"),
        (
            "+budget.frame=1",
            "there is no key frame; budget has frames, num_envs, steps, minibatches",
        ),
        (
            "training.env.laps=1",
            "there is no key training.env.laps; training.env has none; +training",
        ),
        (
            "+watch.epsode.a=[reward]",
            "no key watch.epsode; watch has episode, step; did you mean episode?",
        ),
        ("logger=null", "takes the name of a file, not null or a number; write GROUP=NAME"),
        ("~learner", "learner must be given: write learner=VALUE"),
        # types
        ("seed=abc", "'abc' of type 'str' could not be converted to Integer"),
        ("budget=5", "budget=5: Invalid type assigned: int is not a subclass of BudgetConfig"),
        (
            "method.observes=5",
            "method.observes=5 must be a list; write method.observes=[5]",
        ),
        ("learner.gamma=abc", "learner.gamma='abc' must be a valid number"),
        ("learner.hidden=[64,a]", "learner.hidden[1]='a' must be a valid integer"),
        # values
        ("seed=-1", "seed=-1 must be at least 0"),
        (
            "budget.num_envs=100000 budget.steps=10000",
            "budget.num_envs x budget.steps=1000000000 must be at most",
        ),
        ("device=tpu", "device=tpu must be cpu, cuda, or one GPU such as cuda:0"),
        (
            "device=cuda compile=true",
            "compile=true is for the CPU only, not for device=cuda; take compile=false",
        ),
        ("preset.rate=1e23", "env.rate=1e+23 must be at most 1000"),
        (
            "learner.hidden=[99999999]",
            "learner: hidden[0]=99999999 must be at most 4096",
        ),
        ("track.train.count=0", "count=0 of random_tracks must be from 1 to 10000"),
        ("method.observes=[lidar]", "the env has no entry lidar to observe; it has observation"),
        (
            "evaluation.measures.clearance.format=nan",
            "format=nan must be a format of numbers, such as .1f",
        ),
        (
            "watch.step.smoothness=null",
            "watch.step.smoothness=None must be a list, such as [info, lap]",
        ),
        ("watch.step.smoothness=[info,smoothnes]", "is no entry of the env; it has cone_count"),
        ("watch.episode.laps=[info,pose]", "watch.episode.laps=info.pose has 3 numbers a row"),
        (
            "evaluation.measures.laps.entry=[info,pose]",
            "evaluation.measures.laps=info.pose has 3 numbers a row, and one is needed",
        ),
        (
            "evaluation.measures.laps.where=[info,lap]",
            "evaluation.measures.laps.where=info.lap must be a flag",
        ),
        ("method=guide init=none", "init=none has no effect: method=guide trains no policy"),
        (
            "evaluation.measures.crashed.entry=[info,crash]",
            "evaluation.measures.crashed=info.crash is no entry of the",
        ),
        (
            "evaluation.measures.laps.reduction=median",
            "evaluation.measures.laps: reduction=median must be one of mean",
        ),
        (
            "evaluation.measures.laps.at_least=1 evaluation.measures.laps.at_most=2",
            "at_least and at_most cannot both",
        ),
        (
            "~evaluation.curve.cases.selection",
            "evaluation.curve.cases has evaluation; give evaluation and selection",
        ),
        ("label=guide", "label=guide cannot be used"),
        ("guide=constant guide.constant.value=[1,2]", "has the shape [2, 2], but must have [2, 1]"),
        # targets
        (
            "guide.spline._target_=coil_rl.guides.Nope",
            "guide.spline: there is no 'coil_rl.guides.Nope'; check",
        ),
        ("guide.spline._target_=coil_rl.cones.spline.FAR", "is 1000.0, which cannot be called"),
        ("guide=zero guide.zero._target_=builtins.dict", "makes dict, not TensorDictModuleBase"),
        (
            "guide=zero guide.zero._target_=subprocess.run",
            "guide.zero: Target 'subprocess.run' is blocklisted",
        ),
        # groups
        (
            "guide=splin",
            "no guide=splin; guide can be authors, bot, centre_fast, cone_planner, constant",
        ),
        (
            "+guide=random",
            "Multiple values for guide. To override a value use 'override guide: random'",
        ),
        ("+experiment=nope", "no experiment=nope; experiment can be advice, advice_better_guide"),
        (
            "hydra/launcher=submitit_slurm",
            "is not installed: python -m pip install 'coil-rl[slurm]'",
        ),
        (
            "+degrade=${pid:}",
            "the command line cannot be composed; give each group a name, GROUP=CHOICE",
        ),
        (f"method={'x' * 300}", "... cannot be used (File name too long); choose a shorter name"),
        ("experiment=coil_vs_ppo", "To append to your default list use +experiment=coil_vs_ppo"),
        # combinations
        (
            "guide=linear_feedback",
            "guide.linear_feedback: it cannot act on the observations of this env (The size of",
        ),
        (
            "method=coil degrade=[shuffled] track.train.count=2",
            "each case of the evaluation has one row, 1 in all: ",
        ),
        (
            "method=oil",
            "track.train gives one track, which cannot be left out to validate; "
            "set learner.group_key=null",
        ),
        (
            "method=dynamic_coil_joint proxy.method.observes=null",
            "proxy.method.observes: a proxy needs observations",
        ),
        (
            "observes=[] method=ppo",
            "observes=[]: the agent has no observations; give the entries of the env",
        ),
        (
            "guide=none",
            "guide: there is none, but method=coil needs one; give guide=NAME, or method=ppo",
        ),
        (
            "method=dynamic_coil_joint ~proxy.method.transforms.advice",
            "guide.spline: method.transforms.advice=",
        ),
        (
            "guide=learned guide.learned.run=nowhere",
            "nowhere is not the folder of a run",
        ),
        (
            "method=rfc +method.transforms.coupling.guide=1",
            "method.transforms: RewardCoupling reads row 1 of",
        ),
        ("method=rfc ~method.transforms.advice", "but there is no advice; put GuideActions with"),
    ],
)
def test_mistake_is_refused_in_one_sentence(monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    errors = (
        UserError,
        OmegaConfBaseException,
        HydraException,
        ValueError,
        OSError,
        AssertionError,
    )
    with (
        initialize_config_module("coil_rl.conf", version_base="1.3"),
        pytest.raises(errors) as caught,
    ):
        check(compose("train", [*TINY, "run_dir=run", *arguments.split()]))
    text = sentence(caught.value)
    assert message in text
    assert len(text.splitlines()) == 1
    assert not files()


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # one of each kind above
        ("sed=1", "no key sed; the configuration has preset, track, env, guide, disturb, degrade"),
        ("learner.gamma=abc", "learner.gamma='abc' must be a valid number"),
        ("seed=-1", "seed=-1 must be at least 0"),
        (
            "guide=splin",
            "no guide=splin; guide can be authors, bot, centre_fast, cone_planner, constant",
        ),
        # command line
        ("learner.gamma", "'learner.gamma' cannot be parsed; write KEY=VALUE"),
        ("=3", "'=3' has no key, write KEY=VALUE"),
        ("seed=1,2", "Ambiguous value for argument 'seed=1,2'"),
        (
            "env.rate=${nope}",
            "env.rate refers to nope, which does not exist; choose another env, or give env.rate=",
        ),
        ("--nope", "unrecognized arguments: --nope"),
        ("--config-dir=nope", "nope' not found"),
        # folders
        ("hydra.run.dir=/dev/null/run", "/dev/null/run cannot be used (Not a directory)"),
        (f"label={'x' * 300}", "cannot be used (File name too long); choose a shorter name"),
        ("run_dir=/dev/null", "/dev/null cannot be used (File exists); choose another folder"),
        # tracks and sweeps
        ("track=folder", "track.dir must be given: write track.dir=VALUE"),
        ("track=folder track.dir=/nowhere", "/nowhere cannot be read (No such file or directory)"),
    ],
)
def test_mistake_ends_the_program_with_exit_code_2_and_leaves_no_folder(
    started, arguments, message
):
    overrides = [*TINY[: 2 if "track=" in arguments else None], *arguments.split()]
    assert message in refusal(
        "train", *sorted(overrides, key=lambda override: not override.startswith("-"))
    )
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
    folder = tmp_path_factory.mktemp("run")
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("train", [*TINY, "logger=none", f"run_dir={folder}"])
    policy = build_learner(config, env_maker(config)()).policy
    checkpoint.save(policy.state_dict(), folder / "policy_last.pt")
    OmegaConf.save(
        OmegaConf.create(OmegaConf.to_container(config, resolve=True)), folder / "config.yaml"
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"evaluation.policy": "best"}, None),  # replaced by the requested evaluation
        (b"a: [1,\n  b: }", "line 2: it is no YAML: "),
        (b"- 1\n", "config.yaml is not the configuration of a run, but a list"),
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


# Both programs ask the same function.
@pytest.mark.fast(3)
@pytest.mark.parametrize("name", ["evaluate", "listen"])
@pytest.mark.parametrize(
    "change", ["env.laps=2", "preset=authors", "guide=random", "method=ppo", "+action.x=1"]
)
def test_override_of_what_a_run_provides_is_refused(started, run, name, change):
    sentence = refusal(name, *TINY[2:], f"run={run}", change)
    assert (
        f"{change} has no effect: run={run} has its own configuration; "
        "what can be changed is run, " in sentence
    )


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("evaluate", "evaluation.curve.num_envs=3", "only a training reads it"),
        ("evaluate", "evaluation.guides=ends", "only a training reads it"),
        ("evaluate", "evaluation.sections=null", "only coil-listen reads it"),
        ("listen", "evaluation.curve.num_envs=3", "only a training reads it"),
    ],
)
def test_evaluation_of_a_run_refuses_what_it_does_not_read(started, run, name, change, reason):
    sentence = refusal(name, *TINY[2:], f"run={run}", change)
    assert sentence == f"{change} has no effect: {reason}; leave it out"


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
    sentence = refusal("evaluate", f"run={run}", "track.test.split=train")
    assert sentence.startswith(f"track.test.split=train has no effect alone: run={run} has its own")


@pytest.mark.parametrize(
    "change",
    [
        "evaluation.policy=last",
        "beside=fallback",
        "evaluation.repeats=9",
        "+evaluation.advice.x=1",
        "evaluation.curve.points=2",
    ],
)
def test_evaluation_of_guides_alone_refuses_what_an_agent_needs(started, change):
    assert f"{change} has no effect: " in refusal("evaluate", *TINY[2:], change)


def test_refused_program_leaves_no_folder_of_its_own_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.mcap").touch()
    words = ["recording=drive.mcap", "run_dir=new/er"]  # it is opened after the check
    assert "drive.mcap" in refusal("replay", *words)


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("method=ppo", "its agent has no guide in its env"),
        ("method=guide", "method=guide trains no policy"),
        ("method=residual", "its env adds the actions of agent and guide"),
        ("method=oil", "its learner has no value function"),
    ],
)
def test_fallback_that_cannot_be_is_refused_before_the_training(started, change, reason):
    sentence = refusal("train", *TINY, "beside=fallback", change)
    assert sentence.startswith("beside=fallback has no effect")
    assert reason in sentence
    assert started == []


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


def test_run_with_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(UserError, match="is not the folder of a run"):
        coil_rl.open_run(300 * "x")


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (
            "evaluate",
            "method=ppo",
            "method=ppo has no effect: a guide is evaluated without an agent",
        ),
        (
            "distill",
            "degrade=[noisy]",
            "degrade=[noisy] has no effect: a proxy is trained as the key proxy says",
        ),
        (
            "distill",
            "proxy.budget.frames=-5",
            "proxy.budget.frames=-5 must be at least 1",
        ),
        (
            "distill",
            "proxy.learner._target_=coil_rl.learners.PPO",
            "proxy of guide.spline: method=proxy needs a learner",
        ),
    ],
)
def test_override_without_effect_or_out_of_range_is_refused(started, name, arguments, message):
    assert message in refusal(name, arguments)


def test_missing_extra_is_named(monkeypatch):
    pytest.importorskip("Box2D")
    monkeypatch.setitem(sys.modules, "Box2D", None)
    # What an earlier test has imported needs Box2D no more.
    for module in [module for module in sys.modules if module.startswith("gymnasium.envs.box2d")]:
        monkeypatch.delitem(sys.modules, module)
    assert refusal("train", "env=lunar_lander").endswith(
        "is not installed: python -m pip install 'coil-rl[gym]'"
    )


def test_env_with_the_guide_of_another_one_is_refused():
    message = (
        "guide.spline.spline refers to preset.spline, which does not exist; "
        "choose another guide, or give"
    )
    assert message in refusal("train", "env=mountain_car", "guide=spline")


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
    ended = called(
        "train", "method=guide", f"hydra.run.dir={tmp_path}/run", *TINY[2:], cwd=tmp_path, code=2
    )
    assert (
        ended.stderr
        == f"train: {lock} is a folder, but must be a file that locks the run; remove it\n"
    )


def test_folder_in_place_of_a_file_is_named(tmp_path):
    (tmp_path / "runs" / "one" / "config.yaml").mkdir(parents=True)
    ended = called("report", "folder=runs", cwd=tmp_path, code=2)
    (sentence,) = ended.stderr.splitlines()
    assert sentence == (
        "report: runs/one/config.yaml cannot be used (Is a directory); "
        "put the right file or folder there, with the right to use it"
    )


def test_warning_is_one_line_of_the_program(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    with app.program("replay"):
        assert (
            warnings.formatwarning("a topic is ignored", UserWarning, "reading.py", 189)
            == "replay: a topic is ignored\n"
        )
