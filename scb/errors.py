"""The one exception that means "the input was wrong", so that a command line can tell it from a bug."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any, get_args

import numpy as np

MOST_AGENTS = 100_000  # more would not fit into memory before the first is trained


class UserError(Exception):
    """Bad input, told in one sentence: what it was, what is allowed, what to do.

    Not a ValueError: tyro takes those for its own.
    """


def at_least(minimum: int, of: object = None, *names: str, **values: float | None) -> None:
    """Raises a UserError where a value, or an attribute `of` something by these names, is smaller or not finite.

    So does a whole number that JAX does not count to, of 2^31 or more; a seed, which may be larger, is checked where
    it is used. None is nothing of this.
    """
    allowed = f"at least {minimum}" if minimum else "0 or larger"
    _check(lambda value: minimum <= value < math.inf, allowed, of, names, values)


def counted(name: str, value: Any) -> int:
    """The whole number that a value is, Python's for NumPy's; a UserError where it is none."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise UserError(f"{name} is {value!r}: it must be a whole number.")
    return int(value)


def count_at_least(minimum: int, **values: int | None) -> None:
    """As `at_least`, and a UserError for what is no whole number; None is nothing of this."""
    for name, value in values.items():
        if value is not None:
            at_least(minimum, **{name: counted(name, value)})


def agents_at_least(minimum: int, of: object, *names: str) -> None:
    """As `at_least` of numbers of agents; a UserError also where they are more than are made at once."""
    at_least(minimum, of, *names)
    for name in names:
        if (getattr(of, name) or 0) > MOST_AGENTS:
            raise UserError(
                f"{called(of, name)} is {getattr(of, name)}: each is an agent to train, and at most {MOST_AGENTS} are "
                "taken."
            )


def positive(of: object = None, *names: str, **values: float | None) -> None:
    """As `at_least`, where a value is not larger than 0, or not finite."""
    _check(lambda value: 0 < value < math.inf, "positive", of, names, values)


def fraction(of: object, *names: str) -> None:
    """As `at_least`, where a value is not between 0 and 1."""
    _check(lambda value: 0 <= value <= 1, "between 0 and 1", of, names, {}, bounded=True)


def _check(
    holds: Callable[[float], bool],
    allowed: str,
    of: object,
    names: Iterable[str],
    values: Mapping[str, float | None],
    bounded: bool = False,
) -> None:
    for name, value in numbers(of, *names, **values).items():
        if value is not None and not holds(value):
            finite = ", and finite" if isinstance(value, float) and not bounded else ""
            raise UserError(f"{called(of, name)} is {value}: it must be {allowed}{finite}.")
        if isinstance(value, int) and value >= 2**31 and name != "seed":
            raise UserError(f"{called(of, name)} is {value}: it must be {allowed}, and below 2^31.")


def numbers(of: object = None, *names: str, **values: Any) -> dict[str, Any]:
    """{name: value} as `at_least` takes them; a UserError for a text, or a fraction where a field is a whole number."""
    whole = _counted(of) if is_dataclass(of) else ()
    found = {**{name: getattr(of, name) for name in names}, **values}
    for name, value in found.items():
        if isinstance(value, str) or (name in whole and isinstance(value, float)):
            kind = "whole number" if name in whole else "number"
            raise UserError(f"{called(of, name)} is {value!r}: it must be a {kind}.")
    return found


def called(of: Any, name: str) -> str:
    """A field's name, and the flag that sets it where that is called something else."""
    types = {f.name: f.type for f in fields(of)} if is_dataclass(of) else {}
    flag = flag_name(types.get(name), name)
    return name if flag == name else f"{name} (--{flag})"


def flag_name(annotated: Any, name: str) -> str:
    """What the command line calls a field, without dashes before it: its name, unless its type's annotations say."""
    named = (getattr(x, "name", None) for x in getattr(annotated, "__metadata__", ()))
    return next(filter(None, named), name)


def _counted(of: Any) -> set[str]:
    """The fields of a dataclass that are whole numbers, also where a flag's name is annotated."""
    types = {f.name: getattr(f.type, "__origin__", f.type) for f in fields(of)}
    return {name for name, of_it in types.items() if of_it in (int, int | None)}


def of_classes(of: Any, **wanted: Any) -> None:
    """Raises a UserError where an attribute is not of its class, or union of classes, as None is where that has it."""
    for name, classes in wanted.items():
        of_class(classes, **{name: getattr(of, name)})


def of_class(classes: Any, **values: Any) -> None:
    """As `of_classes`, of values."""
    for name, given in values.items():
        if isinstance(given, classes):
            continue
        if isinstance(given, type):
            raise UserError(
                f"{name} is the class {given.__name__} itself: make one, {given.__name__}(...)."
            )
        kinds = [x.__name__.replace("NoneType", "None") for x in get_args(classes) or [classes]]
        raise UserError(
            f"{name} is of the class {type(given).__name__}: it must be of {' or '.join(kinds)}."
        )


def first_line(error: Exception) -> str:
    """What an error says in its first line, without the full stop; its type's name where it says nothing."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__).rstrip(".")


@contextmanager
def needed_for(what: str, package: str, extra: str | None = None) -> Iterator[None]:
    """A UserError of an ImportError in it: a package is not installed that something needs.

    Args:
      what: needs it, with its verb.
      extra: of this project that installs it.
    """
    try:
        yield
    except ImportError as error:
        how = f"the extra `{extra}`" if extra else "it"
        raise UserError(f"{what} the package {package}: install {how}.") from error


def unused(config: Any, because: str, names: Iterable[str], otherwise: str) -> None:
    """Raises a UserError where a dataclass' field by one of these names is not at its default, and nothing uses it.

    Args:
      because: why nothing does, after "and".
      otherwise: what else to do than to leave it out, after "or".
    """
    defaults = {field.name: field.default for field in fields(config)}
    for name in names:
        if (value := getattr(config, name)) != defaults[name]:
            raise UserError(
                f"{called(config, name)} is {value}, and {because}: leave it out, or {otherwise}."
            )


def one_of(kind: str, name: str, known: Iterable[str]) -> None:
    """Raises `unknown_name` where a name is none of those."""
    if not isinstance(name, str) or name not in known:
        raise unknown_name(kind, name, known)


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that nobody registered; near matches first, else all known names."""
    names = sorted(known)
    lowered = {candidate.lower(): candidate for candidate in names}
    given = str(name).lower()  # a file may hold anything in the place of a name
    near = [lowered[match] for match in get_close_matches(given, lowered, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(names)}."
    return UserError(f"unknown {kind} {name!r}: {hint}")
