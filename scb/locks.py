"""Locks on files and folders, which keep one command out of what another one writes.

The system lets go of a lock however its process ends.
"""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows has none, and there nobody is kept out
    fcntl = None  # type: ignore[assignment]

from scb import termination
from scb.errors import UserError
from scb.files import cannot_write, refusing

SUFFIX = ".lock"
_held: dict[Path, IO[str]] = {}  # open as long as the process holds them


def lock(path: Path, of: Path) -> bool:
    """Holds a lock for this process.

    Args:
      of: what it is of, for the message.

    Returns:
      Whether this took it: False where the process held it already, or where there are no locks.

    Raises:
      UserError: another process holds it, or nothing can be written there.
    """
    if fcntl is None or path.resolve() in _held:
        return False
    with refusing(path.parent):
        file = path.open("a+")
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Whoever held it may have removed it after it was opened here; then a third one makes another.
        if not (path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())):
            raise BlockingIOError
    except (BlockingIOError, PermissionError) as error:
        file.seek(0)
        holder = file.read().strip() or "which has just begun"
        file.close()
        raise UserError(
            f"{of} is in use by another command ({holder}): wait until that has ended, or name another folder or file."
        ) from error
    except OSError:
        pass  # a file system without locks
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
    except OSError as error:  # the disk is full
        raise cannot_write(path.parent, reason=error.strerror) from error
    _held[path.resolve()] = file
    return True


def release(path: Path) -> None:
    """Lets go of a lock, if this process holds it."""
    if file := _held.pop(path.resolve(), None):
        file.close()


@contextlib.contextmanager
def released() -> Iterator[None]:
    """Lets go afterwards of the run folders that were opened within it, and not closed."""
    before = {*_held}
    try:
        yield
    finally:
        for path in {*_held} - before:
            release(path)


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Within it a file is this process's; a UserError where it is another's. A lock stands beside it meanwhile."""
    beside = path.with_name(f".{path.name}{SUFFIX}")
    if not lock(beside, path):  # whoever called this holds it
        yield
        return

    def remove() -> str:
        beside.unlink(missing_ok=True)
        return ""

    try:
        with termination.saving(remove):
            yield
    finally:
        remove()
        release(beside)
