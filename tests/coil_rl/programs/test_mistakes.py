"""Whatever is wrong with what a program is given: one sentence, exit code 2, no traceback, nothing left behind."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from programs import called

from coil_rl.errors import UserError
from coil_rl.programs import evaluate, train
from coil_rl.sentence import sentence
from coil_rl.train import checkpoint
from coil_rl.train.build import build, build_env
from coil_rl.train.check import check

TINY = ["budget.cars=8", "budget.steps=32", "track=generated", "track.train.count=1", "track.test.count=1"]
# All examples of a test share its folder; each looks at what it adds.
SHARED = [HealthCheck.function_scoped_fixture]


@pytest.fixture
def started(monkeypatch, tmp_path):
    """The programs up to where their work starts, in a folder of their own: which of them started."""
    monkeypatch.chdir(tmp_path)
    names = []
    monkeypatch.setattr(train, "train", lambda config: names.append("train"))
    monkeypatch.setattr(evaluate, "judge", lambda *_: None)
    monkeypatch.setattr(evaluate, "outcome", lambda folder: 0.0)
    return names


def outcome(name, *arguments):
    """Exit code and what stands on standard error."""
    done = called(name, *arguments, code=None)
    return done.returncode, done.stderr


def everything():
    return {str(path) for path in Path().rglob("*")}


def refusal(name, *arguments):
    before = everything()
    code, said = outcome(name, *arguments)
    assert code == 2, said
    assert said.startswith(f"{name}: ")
    (line,) = said.splitlines()
    assert everything() == before
    return line.removeprefix(f"{name}: ")


# The sentence alone, which takes a third of the time: as a program starts, Hydra composes twice.
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        # keys
        ("sed=1", "no key sed; the configuration has preset, track, env, guide, degrade, method"),
        ("sed=1", "resume; did you mean seed?"),
        ("budget.car=1", "no key budget.car; budget has frames, cars, steps; did you mean cars?"),
        ("learner.learning_rat=1", "+learner.learning_rat=VALUE adds it; did you mean learning_rate?"),
        ("env.speed=3", "+env.speed=VALUE adds it"),
        ("+env.sped=3", "env: ConeTrackEnv takes no sped; it takes tracks, num_cars"),
        ("+evaluation.env.lap=3", "env: ConeTrackEnv takes no lap"),
        ("+evaluation.env.lap=3", "dtype; did you mean laps?"),
        ("+foo=1", "there is no key foo; the configuration has preset"),
        ("+watch.epsode.a=[reward]", "no key watch.epsode; watch has episode, step; did you mean episode?"),
        ("+learner.env=1", "learner: env of PPO is set by the program; leave it out"),
        ("~learner", "learner must be given: write learner=VALUE"),
        ("~nope", "no key nope to remove"),
        # types
        ("seed=abc", "seed='abc' must be a whole number"),
        ("budget.cars=2.5", "budget.cars=2.5 must be a whole number"),
        ("watch=null", "watch=null must be a table"),
        ("evaluation.gif=maybe", "evaluation.gif='maybe' must be true or false"),
        ("budget=5", "budget=5 must be a table with frames, cars, steps"),
        ("learner.gamma=abc", "learner: gamma='abc' must be a finite number"),
        ("learner.gamma=nan", "learner: gamma=nan must be a finite number"),
        ("learner.hidden=[64,a]", "learner: hidden=[64, 'a'] must be a list, each entry a whole number"),
        ("learner.epochs=1.5", "learner: epochs=1.5 must be a whole number"),
        ("env.reward.finish=abc", "env: reward.finish='abc' must be a finite number"),
        ("env.tracks=5", "env: tracks=5 must be a list, each entry a Track"),
        ("track.train=5", "track.train=5 names nothing to build; give it a _target_"),
        ("method.observes=5", "method.observes=5 must be a list, each entry text or null"),
        # values
        ("seed=-1", "seed=-1 must be at least 0"),
        ("seed=99999999999999999999", "seed=99999999999999999999 must be at most"),
        ("threads=0", "threads=0 must be at least 1"),
        ("budget.cars=0", "budget.cars=0 must be at least 1"),
        ("device=tpu", "device=tpu must be cpu, cuda, or one GPU such as cuda:0"),
        ("evaluation.policy=worst", "evaluation.policy=worst must be one of last, best"),
        ("learner.minibatches=129", "learner.minibatches=129 leaves less than 2 frames of a batch to each"),
        ("env.cone_bonus=all", "env: cone_bonus='all' must be one of first_sighting, every_sighting"),
        ("track.train.count=0", "track.train: count=0 of random_tracks must be from 1 to 10000"),
        ("method.observes=[lidar]", "the env has no entry lidar to observe; it has observation"),
        ("watch.step.smoothness=[info,smoothnes]", "is no entry of the env; it has cone_count"),
        ("guide=constant guide.constant.value=[1,2]", "guide.constant: its action has the shape [1, 2], but the env"),
        # targets
        ("guide.spline._target_=coil_rl.guides.Nope", "guide.spline: there is no 'coil_rl.guides.Nope'; is it"),
        ("guide.spline._target_=coil_rl.guides.spline.FAR", "is 1000.0, which cannot be called"),
        ("guide=zero guide.zero._target_=builtins.dict", "makes dict, but TensorDictModuleBase is wanted"),
        ("guide=zero guide.zero._target_=subprocess.run", "guide.zero: Target 'subprocess.run' is blocklisted"),
        ("~guide.spline._target_", "names nothing to build; give it a _target_"),
        # groups
        ("guide=splin", "no guide=splin; guide can be centre_fast, constant, learned, random, spline, undertuned"),
        ("guide=null", "a group takes the name of one of its files, as in guide=spline"),
        ("+guide=random", "guide is chosen already; write guide=random without the +"),
        ("+experiment=nope", "no experiment=nope; experiment can be coil_vs_ppo"),
        ("experiment=coil_vs_ppo", "nothing is chosen for experiment yet, so that it cannot be replaced; write +exp"),
        # parts
        ("degrade=[noisy,loud]", "no degrade=loud"),
        ("degrade=[noisy] degrade.noisy.sigma=-1", "degrade.noisy: sigma=-1 must be a finite number of at least 0"),
        (
            "method=coil degrade=[shuffled] track.train.count=2",
            "track.test gives 1 to drive on, one car each: degrade: ShuffledAdvice gives a row the advice of another",
        ),
        (
            "method=coil +degrade@evaluation.advice.other=shuffled",
            "track.test gives 1 to drive on, one car each: method.transforms: ShuffledAdvice gives a row the advice of",
        ),
        ("method=coil degrade=[shuffled] budget.cars=1", "the batch is one row; use more"),
        ("method=oil", "track.train gives one track, which cannot be left out to validate; set learner.group_key=null"),
        ("guide=learned", "guide.learned.run must be given"),
        ("guide=learned guide.learned.run=nowhere", "guide.learned: run=nowhere is not the folder of a run"),
        (
            "method=rfc method.transforms.coupling.norm=l3",
            "method.transforms.coupling: norm='l3' must be one of l1, l2",
        ),
        (
            "method=rfc +method.transforms.coupling.guide=1",
            "method.transforms: RewardCoupling reads row 1 of",
        ),
        (
            "method=rfc ~method.transforms.advice",
            "but there is no advice; put GuideActions with",
        ),
        ("method=kickstart learner=linear", "learner=ppo, but Imitation is one that imitates a guide"),
        (
            "method=oil learner=dqn",
            "method=oil needs a learner that imitates a guide, such as learner=forest, but",
        ),
        ("label=guide", "label=guide cannot name an agent"),
        ("existing=maybe", "existing=maybe must be one of refuse, resume"),
        ("+evaluation.advice.odd=3", "evaluation.advice.odd=3 names nothing to build"),
    ],
)  # fmt: skip
def test_mistake_is_refused_in_one_sentence(monkeypatch, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    errors = (UserError, OmegaConfBaseException, HydraException, ValueError)
    with initialize_config_module("coil_rl.conf", version_base="1.3"), pytest.raises(errors) as caught:
        check(compose("train", [*TINY, "run_dir=run", *arguments.split()]))
    said = sentence(caught.value)
    assert words in said
    assert len(said.splitlines()) == 1
    assert not everything()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        # one of each kind above
        ("sed=1", "no key sed; the configuration has preset, track, env, guide, degrade, method"),
        ("learner.gamma=abc", "learner: gamma='abc' must be a finite number"),
        ("seed=-1", "seed=-1 must be at least 0"),
        ("guide=zero guide.zero._target_=subprocess.run", "guide.zero: Target 'subprocess.run' is blocklisted"),
        ("guide=splin", "no guide=splin; guide can be centre_fast, constant, learned, random, spline, undertuned"),
        # how it is written
        ("learner.gamma", "'learner.gamma' cannot be read; write KEY=VALUE"),
        ("[", "'[' cannot be read; write KEY=VALUE"),
        ("=3", "'=3' has no key, write KEY=VALUE"),
        ("seed=1,2", "seed=1,2 gives several values; add -m to run one after the other"),
        ("env.rate=${nope}", "env.rate refers to a key that does not exist"),
        ("--nope", "unrecognized arguments: --nope"),
        ("--config-dir=nope", "nope' not found"),
        ("--config-name=trian", "no configuration 'trian'; leave out --config-name"),
        # folders
        ("hydra.run.dir=/dev/null", "/dev/null cannot be used (File exists); choose another folder"),
        ("hydra.run.dir=/dev/null/run", "/dev/null/run cannot be used (Not a directory)"),
        ("run_dir=/dev/null", "the run's folder /dev/null cannot be used (File exists)"),
        # tracks and sweeps
        ("track=folder", "track.dir must be given: write track.dir=VALUE"),
        ("track=folder track.dir=/nowhere", "/nowhere cannot be read (No such file or directory)"),
        ("track=folder track.dir=5", "path=5 must be text or a path"),
        ("-m seed=-1,0", "seed=-1 must be at least 0"),
        ("-m guide=zero,zeroo", "no guide=zeroo"),
    ],
)  # fmt: skip
def test_mistake_of_training_is_one_sentence_and_exit_code_2(started, arguments, words):
    given = [*TINY[: 2 if "track=" in arguments else None], *arguments.split()]
    assert words in refusal("train", *sorted(given, key=lambda word: not word.startswith("-")))
    assert not started


def test_folders_that_were_there_before_stay(started, tmp_path):
    (tmp_path / "mine" / "empty").mkdir(parents=True)
    refusal("train", *TINY, "seed=-1", "hydra.run.dir=mine/empty")
    refusal("train", *TINY, "seed=-1", "hydra.run.dir=mine/empty/new/er")
    assert (tmp_path / "mine" / "empty").is_dir()


def test_bug_shows_its_traceback(started, monkeypatch):
    def broken(config):
        raise ValueError("a bug")

    monkeypatch.setattr(train, "train", broken)
    with pytest.raises(ValueError, match="a bug"):
        outcome("train", *TINY)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run, as far as coil-evaluate reads it."""
    folder = tmp_path_factory.mktemp("run")
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("train", [*TINY, f"run_dir={folder}"])
    agent = build(config.learner, "learner", env=build_env(config), in_keys=list(config.method.observes))
    checkpoint.save(agent.policy.state_dict(), folder / "policy_last.pt")
    OmegaConf.save(OmegaConf.create(OmegaConf.to_container(config, resolve=True)), folder / "config.yaml")
    return folder


def test_run_can_be_evaluated(started, run):
    assert outcome("evaluate", *TINY[2:], f"run={run}") == (0, "")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (b"a: [1,\n  b: }", "config.yaml is not the configuration of a run (while parsing"),
        (b"\xff\xfe\x00\x81", "config.yaml is not the configuration of a run ("),
        (b"- 1\n", "config.yaml is not the configuration of a run, but a list"),
        (b"", "is not the configuration of a run ("),
        ({"lerner": 1}, "there is no key lerner; the configuration has"),
        ({"seed": "abc"}, "seed='abc' must be a whole number"),
        ({"guide": "???"}, "guide must be given"),
        ({"learner.gama": 1}, "learner: PPO takes no gama"),
        ({"learner.hidden": [8]}, "policy_last.pt does not fit the networks that"),
        ({"evaluation.policy": "best"}, None),  # what is asked for counts, not what the run had
    ],
)
def test_folder_of_a_run_that_is_not_as_it_was_is_refused(started, run, tmp_path, change, words):
    (tmp_path / "policy_last.pt").write_bytes((run / "policy_last.pt").read_bytes())
    config = OmegaConf.load(run / "config.yaml")
    for key, value in change.items() if isinstance(change, dict) else ():
        OmegaConf.update(config, key, value)
    OmegaConf.save(config, tmp_path / "config.yaml")
    if isinstance(change, bytes):
        (tmp_path / "config.yaml").write_bytes(change)
    if words is None:
        assert outcome("evaluate", *TINY[2:], "run=.") == (0, "")
    else:
        assert words in refusal("evaluate", *TINY[2:], "run=.")


def leaves(node, path=""):
    """Dotted names of the values of a configuration."""
    for key in node:
        name = f"{path}.{key}".lstrip(".")
        value = node._get_node(key)
        yield from leaves(value, name) if isinstance(value, DictConfig) and not value._is_interpolation() else [name]


with initialize_config_module("coil_rl.conf", version_base="1.3"):
    LEAVES = sorted(leaves(compose("train", TINY)))

JUNK = [
    "abc", "''", "null", "true", "-1", "0", "1.5", "nan", "inf", "-inf", "1e400", "1e-300", "123456789012345678901234",
    "[]", "[1,a]", "{}", "{a:1}", "???", "${seed}", "${nope}", "${env}", "{_target_:subprocess.run}", "../..",
]  # fmt: skip
VALUES = st.sampled_from(JUNK) | st.text(max_size=8).filter(lambda text: "\0" not in text)


def check_mutation(path, value):
    before = everything()
    code, said = outcome("train", *TINY, f"{path}={value}")
    if code == 0:
        return
    assert code == 2
    assert len(said.splitlines()) == 1, said
    assert "Traceback" not in said
    assert everything() == before


@settings(max_examples=10, phases=[Phase.explicit, Phase.generate], suppress_health_check=SHARED)
@given(path=st.sampled_from(LEAVES) | st.sampled_from(LEAVES).map(lambda path: path + "x"), value=VALUES)
def test_any_change_of_one_value_is_accepted_or_refused_in_one_sentence(started, path, value):
    check_mutation(path, value)


@pytest.mark.slow
@settings(max_examples=150, phases=[Phase.explicit, Phase.generate], suppress_health_check=SHARED)
@given(path=st.sampled_from(LEAVES), value=VALUES)
def test_very_many_changes_of_one_value_are_accepted_or_refused_in_one_sentence(started, path, value):
    check_mutation(path, value)
