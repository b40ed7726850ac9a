"""Methods and measures from outside the core, added as any other package adds its own."""

from typing import TYPE_CHECKING

from coil_rl.for_guests import lazy_names

if TYPE_CHECKING:
    from coil_studies.advisor import Advisor as Advisor
    from coil_studies.fallback import Fallback as Fallback
    from coil_studies.ibrl import IBRL as IBRL
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
