"""Parts that moved, by the names that older run folders have for them."""

from collections.abc import Mapping
from typing import Any

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


def renamed(node: Any) -> Any:
    """Return nested values of a configuration with today's names of parts that moved."""
    if isinstance(node, Mapping):
        return {key: renamed(value) for key, value in node.items()}
    if isinstance(node, list):
        return [renamed(value) for value in node]
    return OLD_NAMES.get(node, node) if isinstance(node, str) else node
