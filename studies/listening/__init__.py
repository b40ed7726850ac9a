"""Analysis of how much a trained agent uses the advice of each guide, and where."""

from typing import TYPE_CHECKING

from coil_rl.for_guests import lazy_names

if TYPE_CHECKING:
    from coil_studies.listening.sections import LEFT as LEFT
    from coil_studies.listening.sections import RIGHT as RIGHT
    from coil_studies.listening.sections import TrackSections as TrackSections
    from coil_studies.listening.sections import WholeEpisode as WholeEpisode
    from coil_studies.listening.sections import classify as classify
    from coil_studies.listening.sections import smooth_line as smooth_line
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
