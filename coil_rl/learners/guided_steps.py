"""Learning where a guide acts in some of the steps: the policy learns from its own steps only."""

from torchrl.envs import EnvBase

from coil_rl.learners.policy import Entries

AGENT_ACTS = "agent_acts"  # entry [*batch, 1]: whether the agent acted in a step


def guide_may_act(env: EnvBase) -> bool:
    """Return whether a guide acts in some steps of an env, which then writes `agent_acts`."""
    return AGENT_ACTS in env.observation_spec


def of_agent(steps: Entries) -> Entries:
    """Return the steps of [N] in which the agent acted; all without the entry `agent_acts`."""
    if AGENT_ACTS not in steps:
        return steps
    acted = steps[AGENT_ACTS].squeeze(-1)
    return Entries({key: steps[key][acted] for key in steps})
