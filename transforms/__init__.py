"""TorchRL transforms that bring guides to any env."""

from coil_rl.transforms.guide_actions import GuideActions

__all__ = ["GuideActions"]
