"""A configuration as a run's folder stores it, and how the one that is asked for now may differ from it."""

from collections.abc import Collection
from dataclasses import MISSING, asdict, fields, is_dataclass
from functools import reduce
from pathlib import Path
from typing import Any, get_type_hints

from scb.errors import UserError
from scb.files import as_json


def config_dict(config: Any) -> dict[str, Any]:
    """A configuration's dataclass as plain JSON types."""
    return dict(as_json(asdict(config)))


def with_defaults(stored: Any, config: Any) -> Any:
    """A configuration as it was stored, and the defaults of the settings that this version has and it lacks.

    Of a dataclass inside of another one they are its own; where it may be one of several, nothing is added, as what is
    lacking may be another one's.

    Args:
      stored: JSON.
      config: a dataclass, as it is asked for now.
    """
    if not isinstance(stored, dict):
        return stored
    found, kinds = dict(stored), get_type_hints(type(config))
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            if type(value) is kinds[entry.name]:
                found[entry.name] = with_defaults(stored.get(entry.name, {}), value)
        elif entry.name not in stored:
            default = entry.default
            if entry.default_factory is not MISSING:
                default = entry.default_factory()
            if default is not MISSING:
                found[entry.name] = as_json(default)
    return found


def first_difference(stored: Any, given: Any, growing: Collection[str] = (), path: str = "") -> str:
    """Where two trees of JSON differ first, such as "a.b (1 there, 2 now)"; empty where they don't.

    Entries of `growing`, by such a path, may be more than they were (`grown`). What one of them lacks is as good as
    empty.
    """
    if isinstance(stored, dict) and isinstance(given, dict):
        for key in sorted(stored.keys() | given.keys()):
            inner = f"{path}.{key}".lstrip(".")
            difference = first_difference(stored.get(key), given.get(key), growing, inner)
            if difference:
                return difference
        return ""
    empty: tuple[Any, ...] = (None, {}, [])
    if stored == given or (stored in empty and given in empty):
        return ""
    if path in growing and grown(stored, given):
        return ""
    return f"{path} ({stored!r} there, {given!r} now)"


def as_if_shorter(
    folder: Path, stored: dict[str, Any], asked: dict[str, Any], growing: Collection[str]
) -> dict[str, Any]:
    """A stored config as if so few generations had been asked for at first as now are; itself, where these are more.

    Raises:
      UserError: the search has done more, or as many: the last one is judged as it is done.
    """
    stored = as_json(stored)
    for path in growing:
        *parents, name = path.split(".")
        there, given = (reduce(_entry, parents, config) for config in (stored, asked))
        before, now = _entry(there, name), _entry(given, name)
        if name != "num_generations" or not (type(before) is type(now) is int and now < before):
            continue
        done = _generations_done(folder)
        if now <= done:
            raise UserError(
                f"cannot end {folder} after {now} generations: of {before} it has done {done}"
                + (f"; take at least {done + 1}." if done < before else ", and has ended.")
            )
        there[name] = now
    return stored


def _entry(of: Any, name: str) -> Any:
    return of.get(name) if isinstance(of, dict) else None


def _generations_done(folder: Path) -> int:
    """How many are in a run's newest checkpoint."""
    saved = (folder / "checkpoints").glob("*/*")  # what is in one, so that an empty folder is none
    return max((int(x.parent.name) for x in saved if x.parent.name.isdecimal()), default=0)


def grown(before: Any, now: Any) -> bool:
    """Whether a setting is as it was, or more: a larger number, a list or a table that holds what it held."""
    if isinstance(before, dict) and isinstance(now, dict):
        return all(name in now and now[name] == value for name, value in before.items())
    if isinstance(before, list) and isinstance(now, list):
        return all(x in now for x in before)
    return type(before) is type(now) is int and now >= before
