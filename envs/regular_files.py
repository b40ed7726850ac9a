"""Files that may come from anybody: read only if they are files of a plausible size.

A pipe never ends without a writer, a device such as /dev/zero never ends at all, and a file may be
larger than the memory. All of them can be in a folder that was received.
"""

import errno
import os
import stat
from typing import BinaryIO

BLOCK = 65_536  # bytes
_OPTIONS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file to read its bytes.

    Args:
        path: of the file; a link to a file is one.

    Raises:
        OSError: if there is none, or it is a folder, a pipe, a socket or a device; `strerror` says
            which.
    """
    # A pipe without a writer would wait here, were it not for O_NONBLOCK.
    descriptor = os.open(path, _OPTIONS)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", os.fspath(path))
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: str | os.PathLike[str], largest: int) -> bytes:
    """Return the bytes of a file, as `open_regular`.

    Args:
        largest: allowed size, in bytes.

    Raises:
        OSError: as `open_regular`, and for a larger file.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        blocks: list[bytes] = []
        read = 0
        # Some files of the system have no size before they are read.
        while size <= largest and read <= largest and (block := file.read(max(size, BLOCK))):
            blocks.append(block)
            read += len(block)
    if max(size, read) > largest:
        raise OSError(errno.EINVAL, f"it has more than {largest:,} bytes", os.fspath(path))
    return b"".join(blocks)
