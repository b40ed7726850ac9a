"""Methods and measures from outside the core, added as any other package adds its own."""

from coil_studies.advisor import Advisor as Advisor
from coil_studies.fallback import Fallback as Fallback
from coil_studies.ibrl import IBRL as IBRL
