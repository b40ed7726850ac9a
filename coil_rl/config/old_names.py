"""Parts that moved or went, by the names that older run folders have for them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coil_rl.errors import UserError

OLD_NAMES = {
    "coil_rl.envs.EnvBatch": "coil_rl.foreign.torchrl_env.EnvBatch",
    "coil_rl.envs.gymnasium_env.GymnasiumEnv": "coil_rl.foreign.gymnasium_env.GymnasiumEnv",
    "coil_rl.guides.RecordingGuide": "coil_robot.RecordingGuide",
    "coil_rl.guides.cone_planner.ConePlannerGuide": "coil_rl.cones.ConePlannerGuide",
    "coil_rl.guides.learned.LearnedGuide": "coil_rl.LearnedGuide",
    "coil_rl.learners.Advisor": "coil_studies.Advisor",
    "coil_rl.learners.IBRL": "coil_studies.IBRL",
    "coil_rl.listening.TrackSections": "coil_studies.listening.TrackSections",
    "coil_rl.listening.WholeEpisode": "coil_studies.listening.WholeEpisode",
    "coil_rl.robot.classifier.load_classifier": "coil_robot.load_classifier",
    "coil_rl.run.tuning.Search": "coil_rl.tune.Tuning",
}
GONE = {
    "coil_rl.imitation.SklearnRegressor": "regressors of scikit-learn are saved in another way",
}


def renamed(node: Any, path: Path) -> Any:
    """Return nested values of a configuration with today's names of parts that moved.

    Raises:
        UserError: for a part that no longer exists.
    """
    if isinstance(node, Mapping):
        return {key: renamed(value, path) for key, value in node.items()}
    if isinstance(node, list):
        return [renamed(value, path) for value in node]
    if isinstance(node, str) and node in GONE:
        raise UserError(f"{path} is of an earlier version: {GONE[node]} today; train again")
    return OLD_NAMES.get(node, node) if isinstance(node, str) else node


def with_todays_keys(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration with today's keys.

    `method.run` was called `method.search`, and `evaluation.fallback` was a driver beside.
    """
    found = dict(values)
    if isinstance(method := found.get("method"), Mapping) and "search" in method:
        others = {key: value for key, value in method.items() if key != "search"}
        found["method"] = others | {"run": method["search"]}
    if isinstance(evaluation := found.get("evaluation"), Mapping) and "fallback" in evaluation:
        others = {key: value for key, value in evaluation.items() if key != "fallback"}
        driver = {"fallback": {"_target_": "coil_studies.Fallback"}}
        found["evaluation"] = others | {"beside": driver if evaluation["fallback"] else {}}
    return found
