"""Analysis of how much a trained agent uses the advice of each guide, and where."""

from typing import TYPE_CHECKING

from coil_rl.for_guests import lazy_names

if TYPE_CHECKING:
    from coil_studies.listening.sections import TrackSections as TrackSections
    from coil_studies.listening.sections import WholeEpisode as WholeEpisode
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
