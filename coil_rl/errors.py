"""Mistakes of the user, and damaged files of a run, as errors of one sentence."""

import difflib
import errno
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

NO_SPACE = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
# Another kind of file than expected, one that may not be used, or a name that no file can have.
IN_THE_WAY = (
    errno.EISDIR,
    errno.ENOTDIR,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ELOOP,
    errno.ENAMETOOLONG,
)


# What libraries say where there is no memory for tensors, threads or a library.
NO_MEMORY = ("allocate memory", "bad_alloc", "failed to map segment", "start new thread")


class UserError(Exception):
    """A mistake in the input of the user.

    The message states what is wrong, what is expected and what to do.
    """


class RunningError(UserError):
    """Another process is working on the same run."""


def is_outside(error: BaseException) -> bool:
    """Return whether an error has its cause in the user's input, or in code of other people."""
    return isinstance(error, UserError) or bool(getattr(error, "outside", False))


def lacks_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that it comes from, is about a lack of memory."""
    while error is not None:
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return True
        if any(text in str(error) for text in NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def file_of_a_run(path: Path, remedy: str) -> Iterator[None]:
    """Turn the errors of a damaged file into a `UserError`.

    Args:
        path: of the file that is read in the block.
        remedy: what to do, the end of the message.
    """
    try:
        yield
    except (AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError) as error:
        if is_outside(error) or getattr(error, "errno", None) in NO_SPACE:
            raise
        missing = f"it lacks {error.args[0]}" if isinstance(error, KeyError) else str(error)
        problem = textwrap.shorten(missing, 200, placeholder=" ...")
        raise UserError(f"{path} is damaged ({problem}); {remedy}") from error


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Return `; did you mean X?` with the most similar known name, or an empty string.

    Of several similar ones it is one that begins with the given name.

    Args:
        given: the unknown name.
        known: the names that exist.
    """
    similar = difflib.get_close_matches(given, list(known))  # the most similar first
    best = max(similar, key=lambda name: name.startswith(given), default="")
    return f"; did you mean {best}?" if best else ""
