"""Policies as files of ONNX and torch.export, and such files as controllers and guides."""

from coil_rl.export.guide import ExportedGuide as ExportedGuide
from coil_rl.export.policy import ExportedPolicy as ExportedPolicy
from coil_rl.export.write import export_policy as export_policy
