"""Policies as files of ONNX and torch.export, and such files as controllers and guides."""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.export.guide import ExportedGuide as ExportedGuide
    from coil_rl.export.policy import ExportedPolicy as ExportedPolicy
    from coil_rl.export.write import export_policy as export_policy
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
