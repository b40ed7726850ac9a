"""All that is registered with Hydra: typed root configurations, resolvers and files of guests.

The types of the fields are checked by OmegaConf, their ranges by pydantic
(`coil_rl.config.compose.check_values`).
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from typing import Annotated, Any

import hydra.utils
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf
from pydantic import ConfigDict, Field, GetPydanticSchema
from pydantic_core import core_schema

CORE = "coil_rl.conf"  # the package of our own files, and the group of the entry points
LARGEST = 2**63 - 1
GRU = "coil_rl.learners.Gru"
# Keys in which two runs with the same numbers may differ.
IGNORED_KEYS = (
    "run_dir",
    "logger",
    "existing",
    "defaults",
    "trust",
    "proxy.folder",
    "env.workers",
    "env.render",
    "evaluation.env.render",
    "evaluation.gif",
    "evaluation.pictures",
)


@cache
def packages() -> tuple[str, ...]:
    """Return the packages with YAML files, coil-rl's own first."""
    return (CORE, *sorted(entry.value for entry in metadata.entry_points(group=CORE)))


@cache
def shipped(group: str) -> Mapping[str, Traversable]:
    """Return the YAML files of coil-rl and of its guests in a group, by the name of a choice."""
    folders = [resources.files(package) / group for package in reversed(packages())]
    files = [file for folder in folders if folder.is_dir() for file in folder.iterdir()]
    return {file.name.removesuffix(".yaml"): file for file in files if file.name.endswith(".yaml")}


@cache
def shipped_places() -> tuple[str, ...]:
    """Return where Hydra finds its own files, and those that are installed with coil-rl."""
    entries = metadata.entry_points(group=CORE)
    ours = sorted(each.value for each in entries if each.dist and each.dist.name == "coil-rl")
    return ("pkg://hydra", "structured://", *(f"pkg://{package}" for package in (CORE, *ours)))


class GuestFiles(SearchPathPlugin):
    """Lets Hydra find the files of all of them in a program whose own file is in one of them.

    Guests, packages beside coil-rl, bring YAML files of envs, guides, experiments and programs. A
    guest names the package of its files by an entry point, and Hydra then finds them like those of
    coil-rl, by the names of their folders:

        [project.entry-points."coil_rl.conf"]
        my_package = "my_package.conf"
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append what is not there."""
        places = [f"pkg://{package}" for package in packages()]
        known = {element.path for element in search_path.get_path()}
        if not known.isdisjoint(places):
            for place in places:
                if place not in known:
                    search_path.append(CORE, place)


Plugins.instance().register(GuestFiles)


def one_of(*choices: str) -> GetPydanticSchema:
    """Return the schema of a string with a few possible values; OmegaConf supports no `Literal`."""
    return GetPydanticSchema(lambda *_: core_schema.literal_schema(list(choices)))


def typed_as(kind: Any) -> GetPydanticSchema:
    """Return the schema of another type than the one that OmegaConf is told."""
    return GetPydanticSchema(lambda _, handler: handler(kind))


# Most upper limits only prevent that a typing error fills the memory.
Seed = Annotated[int, Field(ge=0, le=LARGEST)]
Positive = Annotated[int, Field(ge=1, le=LARGEST)]
Threads = Annotated[int, Field(ge=1, le=1024)]
Envs = Annotated[int, Field(ge=1, le=2**20)]
Steps = Annotated[int, Field(ge=1, le=2**16)]
Repeats = Annotated[int, Field(ge=1, le=10_000)]
WhichPolicy = Annotated[str, one_of("handed_over", "last")]


class NodeConfig:
    """Base of all typed nodes."""

    __pydantic_config__ = ConfigDict(extra="forbid")


@dataclass
class BudgetConfig(NodeConfig):
    """Amount of experience.

    It is frames in total, envs in parallel, steps of each per batch, and minibatches per pass.

    `stages` are earlier lengths, in frames, of a run that was made longer.
    """

    frames: Positive = 1
    num_envs: Envs = MISSING
    steps: Steps = 1
    minibatches: Positive = 16
    stages: list[int] = field(default_factory=list)


@dataclass
class CurveConfig(NodeConfig):
    """Evaluation of the policies that a run keeps, see `coil_rl.run.curve`.

    `env` and `cases` are overrides.
    """

    points: Annotated[int, Field(ge=1, le=1000)] = 16
    batches: Annotated[int, Field(ge=1, le=1000)] = 1
    num_envs: Envs = 1  # number of cases in a set
    count_key: str = "num_envs"  # argument of the env that takes this number, if it is another one
    env: dict[str, Any] = field(default_factory=dict)
    cases: dict[str, dict[str, Any]] = field(default_factory=dict)  # by the name of a set


@dataclass
class TrainingConfig(NodeConfig):
    """Training values for an env, and overrides of `env` in training.

    `imitation_env` is for methods that imitate, `tests` for the cases in which a training compares
    policies. `disturb` has overrides of `disturb` in both.
    """

    learning_rate: float = 1e-3  # of PPO, at the start of a run
    normalise: Any = "auto"  # of the learner: auto | true | false
    scale_rewards: bool = True  # of the learner, see `RewardScale`
    noise_correlation: Annotated[float, Field(ge=0, le=1)] = (
        0.0  # of the noise of continuous actions, see `Rollout`
    )
    env: dict[str, Any] = field(default_factory=dict)
    imitation_env: dict[str, Any] = field(default_factory=dict)
    tests: dict[str, Any] = field(default_factory=dict)
    disturb: dict[str, Any] = field(default_factory=dict)


@dataclass
class EvaluationConfig(NodeConfig):
    """Evaluation of a policy; `cases` is their number, or a node that gives their names.

    `disturb` has overrides of `disturb` in the evaluation and in its curve.
    """

    cases: Any = 1
    measures: dict[str, Any] = field(default_factory=dict)  # see `coil_rl.Measure`
    pictures: dict[str, Any] = field(default_factory=dict)
    sections: dict[str, Any] | None = None  # of coil-listen
    env: dict[str, Any] = field(default_factory=dict)
    disturb: dict[str, Any] = field(default_factory=dict)
    curve: CurveConfig = field(default_factory=CurveConfig)
    advice: dict[str, Any] = field(default_factory=dict)
    repeats: Repeats = 5
    policy: WhichPolicy = "handed_over"
    guides: Annotated[str, one_of("phases", "ends")] = "phases"
    gif: bool = True
    beside: dict[str, Any] = field(default_factory=dict)  # further drivers of the table


@dataclass
class MethodConfig(NodeConfig):
    """A method: transforms of the agent, the kind of its learner, and what it observes.

    `observes` are entries besides those of the env. `run` makes the run of a method that
    trains no policy, see `coil_rl.config.parts`; its learner is "none".
    """

    name: str = MISSING
    observes: list[Any] | None = MISSING  # None: no agent
    transforms: dict[str, Any] = field(default_factory=dict)
    needs_guide: bool = MISSING
    learner: Annotated[str, one_of("agent", "imitation", "guides", "none")] = "agent"
    run: dict[str, Any] = field(default_factory=dict)  # instead of a training


@dataclass
class ProxyConfig(NodeConfig):
    """Training of the networks that imitate guides without parameters."""

    folder: str = MISSING
    seed: Seed = 0
    method: MethodConfig = field(default_factory=MethodConfig)
    env: dict[str, Any] = field(default_factory=dict)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    learner: dict[str, Any] = MISSING


@dataclass
class ProgramConfig(NodeConfig):
    """Base of the root configurations: Hydra's help text and callback of this project.

    Args:
        defaults: Hydra's list of files.
    """

    defaults: list[Any] = field(
        default_factory=lambda: [
            {"override /hydra/help": "program"},
            {"override /hydra/callbacks": "program"},
            "_self_",
        ]
    )


@dataclass
class DrivingConfig(ProgramConfig):
    """Configuration that all programs share that drive."""

    preset: dict[str, Any] = field(default_factory=dict)
    track: dict[str, Any] = field(default_factory=dict)
    env: dict[str, Any] = MISSING
    guide: dict[str, Any] = MISSING
    disturb: dict[str, Any] = field(default_factory=dict)
    degrade: dict[str, Any] = field(default_factory=dict)
    method: MethodConfig = field(default_factory=MethodConfig)
    # None: all that the env writes
    observes: list[Any] | None = field(default_factory=lambda: ["observation"])
    action: dict[str, Any] = field(default_factory=dict)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    watch: dict[str, dict[str, Any]] = field(default_factory=dict)
    seed: Seed = 0
    device: str = "cpu"
    threads: Threads = 2
    compile: bool = False
    trust: list[str] = field(default_factory=list)
    run_dir: str = MISSING
    recording: Any = None


@dataclass
class TrainConfig(DrivingConfig):
    """Configuration of `coil-train`."""

    label: str = MISSING
    learner: dict[str, Any] = MISSING
    logger: dict[str, Any] | None = None
    proxy: ProxyConfig | None = None
    checkpoint_every: Positive = 10
    delivery: Annotated[str, one_of("last", "tested")] = "last"
    tune: Any = None  # bounds of numbers of the guide, by name
    existing: Annotated[str, one_of("refuse", "resume")] = "refuse"
    resume: str | None = None
    init: str | None = None


@dataclass
class EvaluateConfig(DrivingConfig):
    """Configuration of `coil-evaluate`."""

    run: str | None = None
    exported: str | None = None
    env: dict[str, Any] = field(default_factory=dict)


@dataclass
class PolicyConfig(ProgramConfig):
    """Configuration that programs share which use policies outside of their envs."""

    seed: Seed = 0
    device: str = "cpu"
    threads: Threads = 1
    trust: list[str] = field(default_factory=list)
    run_dir: str = MISSING


@dataclass
class ExportConfig(PolicyConfig):
    """Configuration of `coil-export`."""

    run: str = MISSING
    policy: WhichPolicy = "handed_over"
    observations: Annotated[int, Field(ge=1, le=1_000_000)] = 1_000
    meanings: dict[str, Any] = field(default_factory=dict)


@dataclass
class ReportConfig(ProgramConfig):
    """Configuration of `coil-report`."""

    folder: Any = MISSING
    actions: Annotated[str, one_of("deterministic", "sampled", "both")] = "deterministic"
    against: str | None = None
    figures: Annotated[str, one_of("png", "pdf", "svg")] = "png"


def passive(config: DictConfig) -> Any:
    """Return the class of an env that does not react to actions; None for any other env.

    Nothing can be learned by trial in such an env, a recording for example. What somebody else did
    there can be imitated, and the imitation is tested in another env. The class says so by
    `reacts = False`, and has

    - `whole_pass(arguments)`, a static method: how many episodes there are, and the steps of the
      longest, by the arguments of the constructor;
    - `length`, [B], the steps of the episode of each row;
    - `demonstrations()`: lines on what there is to learn; a `ValueError` if there is nothing.
    """
    try:
        kind = hydra.utils.get_object(str(config.env.get("_target_", "")))
    except Exception:  # who builds it says what is wrong
        return None
    return None if getattr(kind, "reacts", True) else kind


def whole_pass(what: str, otherwise: int, *, _root_: DictConfig) -> int:
    """Return what a training takes that sees all of an env that does not react.

    Args:
        what: "num_envs", one for each episode; "steps", those of the longest; or "frames".
        otherwise: the value in other envs.
    """
    kind = passive(_root_)
    if kind is None:
        return otherwise
    rows, steps = kind.whole_pass(_root_.env)
    return {"num_envs": rows, "steps": steps, "frames": rows * steps}[what]


def fingerprint(config: DictConfig) -> str:
    """Return ten hexadecimal digits that identify the numbers of a run.

    They are known while Hydra composes its configuration, too.
    """
    identity: dict[str, Any] = {}
    for key in sorted(map(str, config)):
        if key in (*IGNORED_KEYS, "hydra"):
            continue
        value = config[key]
        if key == "recording" and value is None:  # of all envs but one
            continue
        if OmegaConf.is_config(value):
            value = OmegaConf.to_container(value, resolve=True)
        if key == "env" and isinstance(value, dict):
            value.pop("workers", None)  # the numbers are the same with any number of processes
        identity[key] = value
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:10]


def agent_label(config: DictConfig) -> str:
    """Return the default label of a run: the method, and the learner.

    PPO, and the learner of the method itself, are left out.
    """
    name = str(config.method.name)
    if OmegaConf.is_missing(config, "learner") or config.method.learner != "agent":
        return name
    learner = str(config.learner.get("_target_", "")).rpartition(".")[2].lower()
    if learner in ("", "ppo", name):  # the method's own may have its name
        return name
    return learner if name == "ppo" else f"{name}_{learner}"


def minibatches(count: int, *, _root_: DictConfig) -> int:
    """Return how many minibatches a pass over a batch has by default.

    With a memory each has all steps of some rows of the env, so there are at most as many as rows.

    Args:
        count: of a policy without a memory.
    """
    network = OmegaConf.select(_root_, "learner.network._target_")
    return min(count, _root_.budget.num_envs) if network == GRU else count


# Process id in run folders: two runs may start within a microsecond.
OmegaConf.register_new_resolver("pid", os.getpid, replace=True)
# ${minibatches:${budget.minibatches}}
OmegaConf.register_new_resolver("minibatches", minibatches, replace=True)
# Keys of a table in a label: ${names:${degrade},intact}
OmegaConf.register_new_resolver(
    "names", lambda table, none: "_".join(map(str, table)) or none, replace=True
)
# ${file_name:${env.id}}, without the module of MODULE:NAME
OmegaConf.register_new_resolver(
    "file_name", lambda text: re.sub(r"[^\w.-]+", "_", str(text).rpartition(":")[2]), replace=True
)
# ${label}_seed${seed}_${fingerprint:}
OmegaConf.register_new_resolver("fingerprint", lambda *, _root_: fingerprint(_root_), replace=True)
OmegaConf.register_new_resolver("agent_label", lambda *, _root_: agent_label(_root_), replace=True)
# ${whole_pass:steps,2700}
OmegaConf.register_new_resolver("whole_pass", whole_pass, replace=True)

_store = ConfigStore.instance().store


def open_to_measures(schema: type[DrivingConfig]) -> DictConfig:
    """Return a schema to which the command line may add measures without a plus sign."""
    config = OmegaConf.structured(schema)
    OmegaConf.set_struct(config.evaluation.measures, False)
    if "env" in config:  # a run has its own, whose keys this configuration may not have
        OmegaConf.set_struct(config.env, False)
    return config


_store(name="schema", node=open_to_measures(TrainConfig))
_store(name="evaluate_schema", node=open_to_measures(EvaluateConfig))
_store(name="report_schema", node=ReportConfig)
_store(name="export_schema", node=ExportConfig)


# The paper's method is the default in the worlds of this project. Elsewhere nobody knows how good
# the guide is, and the default is the method that holds it.
OWN_WORLDS = ("cone_track", "driving_tasks", "simulated_robot", "mcap_replay")


def method_for(guide: Any) -> str:
    """Return the method for an env of somebody else.

    Args:
        guide: what was given as the guide; None, or the file "none", for no guide.
    """
    return "ppo" if guide is None or guide == "none" else "coil_anchored"


def default_method(env: str, guide: Any) -> str:
    """Return the method of a run whose command names none.

    Args:
        guide: name of the file in conf/guide, or several of them.
    """
    own = any(env == world or env.startswith(f"{world}_") for world in OWN_WORLDS)
    return "coil" if own else method_for(guide)


# In the defaults list of train.yaml: ${default_method:${env},${oc.select:guide,several}}
OmegaConf.register_new_resolver("default_method", default_method, replace=True)


def default_logger() -> str:
    """Return the logger of a run whose command names none: metrics.csv is always written."""
    return "none" if find_spec("tensorboard") is None else "tensorboard"


# In the defaults list of train.yaml: ${default_logger:}
OmegaConf.register_new_resolver("default_logger", default_logger, replace=True)
