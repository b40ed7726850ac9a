"""Robot recordings: reading, writing and replaying MCAP files and rosbag2 folders."""

from typing import TYPE_CHECKING

from coil_rl.extras import require
from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.envs.recordings import bearings as bearings
    from coil_rl.envs.recordings import mcap_files as mcap_files
    from coil_rl.envs.recordings import messages as messages
    from coil_rl.envs.recordings.cautions import in_order as in_order
    from coil_rl.envs.recordings.recording import SIMULATED as SIMULATED
else:
    require("a recording", "robot", "lz4", "mcap", "rosbags", "zstandard")
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
