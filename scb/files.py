"""Files and folders that commands write."""

import contextlib
import errno
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from scb.errors import UserError

_REFUSED = (
    errno.ENOENT,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EEXIST,
    errno.EROFS,
)


def make_folder(folder: Path, flag: str = "--out") -> None:
    """Makes a folder for what a command will write, so that it fails before the work and not after it.

    Raises:
      UserError: nothing can be written there, or read; `flag` says where.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, flag, error.strerror) from error
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        raise cannot_write(folder, flag)


def cannot_write(folder: Path, flag: str = "--out", reason: str | None = None) -> UserError:
    """The error for a folder that refuses."""
    said = f" ({reason})" if reason else ""
    return UserError(
        f"cannot write to {folder}{said}: choose another {flag}, a folder that you may write to."
    )


@contextlib.contextmanager
def refusing(folder: Path) -> Iterator[None]:
    """Within it a folder that is not there, or may not be written to, is a UserError."""
    try:
        yield
    except OSError as error:
        if error.errno not in _REFUSED:
            raise
        raise cannot_write(folder, "place", error.strerror) from error


def strict_json(text: str | bytes) -> Any:
    """What JSON says; a ValueError also for NaN and infinities, which Python would read."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    return json.loads(text, parse_constant=refuse)


def read_object(path: Path, keys: Iterable[str] = ()) -> dict[str, Any]:
    """A file's JSON object with these keys at least; a ValueError, or an OSError, where it is none."""
    found: Any = json.loads(path.read_text())
    if not isinstance(found, dict):
        raise ValueError("it is no JSON object")
    if lacking := [key for key in keys if key not in found]:
        raise ValueError(f"it lacks {', '.join(lacking)}")
    return found


def as_json(content: Any) -> Any:
    """What comes back of it from a JSON file: lists for tuples."""
    return json.loads(json.dumps(content, default=_number))


def _number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def plain(number: Any) -> float | int | None:
    """A number as JSON takes it, which has no NaN and no infinity."""
    if not np.isfinite(number):
        return None
    return int(number) if isinstance(number, int | np.integer) else float(number)


def packed_row(row: Iterable[float]) -> str:
    """[M] numbers in one string, to four digits: one number a line would make a file of JSON unreadable."""
    return " ".join(f"{x:.4g}" for x in row)


def unpacked_row(line: str) -> NDArray[np.floating]:
    """What `packed_row` packed."""
    return np.array([float(x) for x in line.split()])


def packed(rows: Iterable[Iterable[float]]) -> list[str]:
    """[N, M] numbers, a string a row."""
    return [packed_row(row) for row in rows]


def unpacked(lines: Iterable[str]) -> NDArray[np.floating]:
    """What `packed` packed."""
    return np.array([unpacked_row(line) for line in lines])


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Writes files so that a kill leaves the old ones or the new ones, never half of one.

    Of several the last, which vouches for the others, is there last. It goes before the others are replaced, so that
    a kill leaves none that vouches for what it was not written with. Without room for all, nothing is replaced.
    """
    # In the same folder, since a rename is atomic within one file system only.
    fresh = {path: path.with_name(f".{path.name}.{os.getpid()}.tmp") for path in contents}
    *others, last = contents
    try:
        for path, content in contents.items():
            with refusing(path.parent), fresh[path].open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        if others:
            last.unlink(missing_ok=True)
        for path in contents:
            os.replace(fresh[path], path)
    finally:
        for temporary in fresh.values():
            temporary.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    """Writes text as `write_together` writes bytes."""
    write_together({path: content.encode()})


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes JSON as `write_together` writes bytes."""
    write_text(path, json.dumps(content, indent=2) + "\n")
