"""Parts that moved: today's full name by the name that older run folders have for it."""

OLD_NAMES = {
    "coil_rl.envs.EnvBatch": "coil_rl.foreign.torchrl_env.EnvBatch",
    "coil_rl.envs.gymnasium_env.GymnasiumEnv": "coil_rl.foreign.gymnasium_env.GymnasiumEnv",
    "coil_rl.guides.learned.LearnedGuide": "coil_rl.LearnedGuide",
}
