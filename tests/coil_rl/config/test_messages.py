"""What is typed wrong is answered in one sentence before a run begins, with what to write."""

import logging
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.check import check, check_read
from coil_rl.config.compose import compose_train
from coil_rl.config.messages import is_no_bug, sentence
from coil_rl.errors import UserError

CONES = ["budget.num_envs=8", "budget.steps=32", "track=generated"]
CONES += ["track.train.count=1", "track.test.count=1"]
PLAIN = ["env=gym", "env.id=odd_parts:Plain", "logger=none", "method=ppo"]
PLAIN += ["evaluation.cases=2", "evaluation.curve.num_envs=2"]
OF_HYDRA = (AssertionError, ValueError, OSError)  # as they come from it
IN_CONES = [
    # keys
    ("sed=1", "init; did you mean seed?"),
    ("budget.step=1", "budget has frames, num_envs, steps, minibatches, stages; did you mean"),
    ("+budget.frame=1", "there is no key frame; budget has frames, num_envs, steps"),
    ("training.env.laps=1", "training.env has none; +training"),
    ("+watch.epsode.a=[reward]", "watch has episode, step; did you mean episode?"),
    ("logger=null", "Config group override must be a string or a list. Got NoneType"),
    ("learner.lr=0.1", "did you mean learning_rate?\n"),  # a plus would not help
    ("+learner.lr=0.1", "did you mean learning_rate?"),
    ("lr=0.1", "did you mean training.learning_rate or learner.learning_rate?"),
    ("guide.gain=0.5", "did you mean guide.spline.gain?"),
    ("network.hidden=[32,32]", "did you mean learner.hidden?"),
    ("network=mlp network.hidden=[8]", "mean learner.hidden or learner.network.hidden?"),
    ("frames=1000", "did you mean budget.frames?"),
    ("total_timesteps=1000", "did you mean budget.frames?"),
    ("env=twotank:TwoTank-v0", "write env=gym env.id=twotank:TwoTank-v0"),
    ("env=CartPole-v1", "write env=gym env.id=CartPole-v1"),
    ("guide=tank.control:PI", "write guide=controller guide.controller.of=tank.control:PI"),
    ("guide.controller.of=a:PI", "write guide=controller guide.controller.of=VALUE"),
    ("degrade.noisy.sigma=0.1", "write degrade=[noisy] degrade.noisy.sigma=VALUE"),
    ("run=outputs/tank", "to go on with a run write resume=FOLDER"),
    # types and values
    ("budget=5", "budget=5: Invalid type assigned: int is not a subclass of BudgetConfig"),
    ("budget.frames=1e6", "must be a whole number; write budget.frames=1_000_000"),
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
    ("learner=dqn action.choices=1", "action: choices=1 must be at least 2"),
    # targets
    ("guide.spline._target_=coil_rl.guides.Nope", "there is no 'coil_rl.guides.Nope'; check"),
    ("guide.spline._target_=coil_rl.cones.spline.FAR", "is 1000.0, which cannot be called"),
    ("guide=zero guide.zero._target_=builtins.dict", "makes dict, not TensorDictModuleBase"),
    ("guide=zero guide.zero._target_=subprocess.run", "'subprocess.run' is blocklisted"),
    # groups
    ("guide=[spline,centre_fst]", "guide can be authors, "),
    ("degrade=[noise]", "; did you mean noisy?"),
    ("guide=centre", "; did you mean centre_fast?"),
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
    ("method=dynamic_coil_joint degrade=[noisy]", "no effect on guides that are trained"),
    ("observes=[] method=ppo", "observes=[]: the agent has no observations; give the entries"),
    ("guide=none", "there is none, but method=coil needs one; give guide=NAME, or method=ppo"),
    ("method=rfc +method.transforms.coupling.guide=1", "RewardCoupling reads row 1 of"),
    ("method=rfc ~method.transforms.advice", "but there is no advice; put GuideActions with"),
    ("method=ppo learner=dynamic_coil", "but DynamicCoil is one that improves its guides"),
    ("method=dynamic_coil_sequential action=choices", "Dynamic COIL needs continuous actions"),
    ("learner=dqn budget.frames=500", "ends before learning starts, after learner.starts=500"),
    ("method=rlpd learner=sac budget.frames=4_999", "=4999 ends before learning starts"),
    ("method=ppo network=gru learner.minibatches=9", "learner.minibatches=9 are more than the"),
]
IN_A_PLANT = [
    ("guide=controller guide.controller.of=odd_parts:firts", "did you mean first?"),
    ("guide=controller env.options={sutton:true}", "none; +env.options.sutton=VALUE adds it\n"),
    ("env.id=", "env.id is empty; write env.id=MODULE:NAME"),
    ("env.id=7", "env.id=7 must be a valid string or callable"),
    ("+env.options.speed=3", "it raised TypeError: Plain() takes no arguments"),
    ("env.max_steps=-5", "max_steps=-5 must be at least 1"),
    ("env.info=speed", "env.info='speed' must be a list"),
    ("observes=observation", "observes=observation must be a list; write observes=[observation]"),
    ("observes=[speed]", "the env has no entry speed to observe; it has observation"),
    ("budget.frames=1.5", "budget.frames=1.5 must be a whole number\n"),
    ("seed=1k", "seed=1k must be a whole number\n"),
    ("training.learning_rate=low", "training.learning_rate=low must be a number\n"),
    ("compile=maybe", "Value 'maybe' is not a valid bool"),
    ("label=a/b", "label=a/b cannot be used: it must not be empty"),
    ("method=[ppo,coil]", "several files of a group that takes one; for a run with each write -m"),
    ("degrade=[noisy]", "degrade=[noisy] has no effect, because there is no guide"),
    ("track=unseen", "Could not override 'track'. No match in the defaults list"),
    ("+track=unseen", "+track=unseen has no effect: nothing in this run reads track"),
    ("+evaluation.measures.speed.entry=speed", "measures.speed=speed is no entry of the env"),
    ("evaluation.measures.speed=speed", "write evaluation.measures.speed.entry=ENTRY"),
    ("evaluation.measures.speed.entrry=reward", "no key entrry; evaluation.measures.speed"),
    (
        "+evaluation.pictures.lines={_target_:coil_rl.report.DrivenLines,tracks:[]}",
        "evaluation.pictures=info.pose is no entry of the env",
    ),
]
OF_ENVS = [
    ("env.id=odd_parts:Plain", "it belongs to env=gym: write env=gym env.id=VALUE"),
    ("env=gym method=ppo", "env.id must be given: write env.id=VALUE"),
    ("env=torchrl env.of._target_=odd_parts.Plain", "of makes Plain, which is no env of TorchRL"),
    ("env=mcap_replay method=ppo", "give at least one MCAP file or rosbag2 folder: recording="),
    ("env=pendulum delivery=tested method=guide", "delivery=tested has no effect: method=guide"),
    ("env=pendulum delivery=tested evaluation.policy=last", "evaluates what it hands over"),
    ("env=pendulum delivery=best", "delivery='best' must be 'last' or 'tested'"),
]
ROWS = [
    (base, *row)
    for base, rows in ((CONES, IN_CONES), (PLAIN, IN_A_PLANT), ([], OF_ENVS))
    for row in rows
]


def answer(base, words):
    """Return the sentence that refuses the words of a command line, or an empty string."""
    own = words.split()
    try:
        config = compose_train([*base, "run_dir=run", *own])
    except (UserError, HydraException, OmegaConfBaseException, *OF_HYDRA) as error:
        return sentence(error)
    try:
        check(config)
        check_read(config, own)
    except Exception as error:
        if not isinstance(error, HydraException) and not is_no_bug(error):
            raise
        return sentence(error)
    return ""


@pytest.mark.fast(20)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("base", "words", "message"), ROWS, ids=[words[:60] for _, words, _ in ROWS]
)
def test_what_is_typed_wrong_is_answered_in_one_sentence(
    base, words, message, caplog, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.CRITICAL)
    said = answer(base, words)
    assert message in f"{said}\n"
    assert len(said.splitlines()) == 1
    assert not [*Path().rglob("*")]
