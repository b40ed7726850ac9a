"""Analysis of how much a trained agent uses the advice of each guide, and where."""

from coil_rl.listening.sections import TrackSections as TrackSections
from coil_rl.listening.sections import WholeEpisode as WholeEpisode
