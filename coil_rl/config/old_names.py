"""Parts that moved: today's full name by the name that older run folders have for it."""

OLD_NAMES = {
    "coil_rl.envs.EnvBatch": "coil_rl.foreign.torchrl_env.EnvBatch",
    "coil_rl.envs.gymnasium_env.GymnasiumEnv": "coil_rl.foreign.gymnasium_env.GymnasiumEnv",
    "coil_rl.guides.learned.LearnedGuide": "coil_rl.LearnedGuide",
    "coil_rl.learners.Advisor": "coil_studies.Advisor",
    "coil_rl.learners.IBRL": "coil_studies.IBRL",
    "coil_rl.listening.TrackSections": "coil_studies.listening.TrackSections",
    "coil_rl.listening.WholeEpisode": "coil_studies.listening.WholeEpisode",
    "coil_rl.run.tuning.Search": "coil_rl.tune.search.Search",
}
