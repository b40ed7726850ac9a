"""The console programs.

Modules here import torch, and all that depends on it, only inside their functions.
"""

import gc
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import NoReturn


def interrupted(signum: int, frame: FrameType | None) -> NoReturn:
    """End a program at Ctrl-C during its imports, when no exception can be caught yet."""
    os.write(2, f"{Path(sys.argv[0]).stem.removeprefix('coil-')}: interrupted\n".encode())
    os._exit(130)


# Only in a process of a program: coil-NAME, or python -m, which has set no name yet.
_name = Path(sys.argv[0]).name if sys.argv else ""
if _name == "-m" or _name.startswith("coil-"):
    gc.set_threshold(10_000)  # Python's own costs a quarter of the time of the imports
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupted)  # `app.program` ends it
