"""What a guest needs for programs of its own, besides the other public names.

A guest is a package beside coil-rl. See `coil_rl.config.schema` for its YAML files.
"""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names as lazy_names

if TYPE_CHECKING:
    from coil_rl.config.check import check_guide_in_env as check_guide_in_env
    from coil_rl.config.nodes import check_arguments as check_arguments
    from coil_rl.config.parts import build_guides as build_guides
    from coil_rl.config.schema import PolicyConfig as PolicyConfig
    from coil_rl.config.schema import WhichPolicy as WhichPolicy
    from coil_rl.config.schema import one_of as one_of
    from coil_rl.config.schema import typed_as as typed_as
    from coil_rl.extras import require as require
    from coil_rl.files import LARGEST_NUMBERS as LARGEST_NUMBERS
    from coil_rl.files import read_text as read_text
    from coil_rl.foreign.controllers import load as load
    from coil_rl.output import progress as progress
    from coil_rl.output import say as say
    from coil_rl.programs.app import check_unused as check_unused
    from coil_rl.programs.app import check_used as check_used
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
