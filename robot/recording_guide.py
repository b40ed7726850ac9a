"""The recorded steering of a robot as a guide that demonstrates, for imitation."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

RECORDED = ("info", "recorded")


class RecordingGuide(TensorDictModuleBase):
    """The steering that was recorded at each scan of a replay (`coil_rl.envs.McapReplayEnv`).

    It demonstrates: its actions belong to the scans of the recording, whatever a policy does. In an
    env without recorded steering, where an imitation of it is tested, it drives straight, and it is
    not evaluated there itself.

    `RecordedGuide` is another one: it takes actions from a CSV file by the number of the step, in
    any env.
    """

    demonstrates = True
    remedy = "give env=mcap_replay recording=[FILE,...], see also guide=recorded"

    in_keys, out_keys = [RECORDED, "observation"], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`, [B, 1]: fraction of the maximal steering, 0 where none was recorded."""
        if RECORDED in tensordict.keys(True):
            return tensordict.set("action", tensordict[RECORDED])
        observation = tensordict["observation"]
        straight = torch.zeros((*tensordict.batch_size, 1), device=observation.device)
        return tensordict.set("action", straight)
