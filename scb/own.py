"""Somebody's own code by name, `package.module:attribute`, of a module that Python finds from the working directory."""

import ast
import contextlib
import hashlib
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

from scb.errors import UserError

_NAME = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")
_OURS = ("scb", "lpo")


def is_own(name: str) -> bool:
    """Whether a text is such a name."""
    return _NAME.fullmatch(name) is not None


def imported(name: str, kind: str, attribute: str) -> Any:
    """What a name stands for.

    Args:
      kind: of thing, and what to call its attribute, in messages: environment, factory.

    Raises:
      UserError: it cannot be imported.
    """
    module, _, entry = name.partition(":")
    try:
        return getattr(_module(module), entry)
    # Whatever a module does that is not ours.
    except Exception as error:
        raise UserError(
            f"{kind} {name!r} cannot be imported ({error}): give package.module:{attribute}, of a module that "
            "Python finds from here."
        ) from error


def _module(name: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    return importlib.import_module(name)


def reference(thing: Any, kind: str) -> str:
    """The name of a class or function.

    Raises:
      UserError: no import finds it: it is defined inside of a function, in a notebook or in the script that runs.
    """
    name = f"{thing.__module__}:{thing.__qualname__}"
    there = getattr(sys.modules.get(thing.__module__), thing.__qualname__, None)
    if is_own(name) and thing.__module__ != "__main__" and there is thing:
        return name
    raise UserError(
        f"the {kind} {thing.__qualname__} is defined where no import finds it: a file names package.module:"
        f"{thing.__name__.strip('<>')}, so move it to the top of a module, and import it from there."
    )


def module_code(names: Iterable[str]) -> dict[str, str]:
    """{name: SHA-256} of those of the names that are somebody's own: of what the module says, but comments and layout.

    What that module imports does not count, nor one without source.
    """
    found = {}
    for name in filter(is_own, names):
        # A module that cannot be imported is told of where the thing is made.
        with contextlib.suppress(Exception):
            said = _layout_free(inspect.getsource(_module(name.partition(":")[0])))
            found[name] = hashlib.sha256(said.encode()).hexdigest()
    return found


def plain_function(function: Any) -> FunctionType | None:
    """What a `functools.partial` or a decorator such as `jax.jit` was made of; None where that is no function."""
    while isinstance(function, partial) or hasattr(function, "__wrapped__"):
        function = function.func if isinstance(function, partial) else function.__wrapped__
    return function if isinstance(function, FunctionType) else None


def code_of(thing: Any) -> dict[str, str]:
    """{name: SHA-256} of what is somebody's own: a function, or an object's classes and the functions among its fields.

    Of what their module says, as `module_code`; of the script that runs, or a notebook, what they say themselves. With
    a function the values count that it was made with: arguments of a partial, and variables of the function around it.
    """
    if plain_function(thing) is not None:
        return _code_of_function(thing)
    found: dict[str, str] = {}
    for part in type(thing).__mro__:
        found |= _code(part)
    for field in fields(thing) if is_dataclass(thing) else ():
        if plain_function(value := getattr(thing, field.name)) is not None:
            found |= _code_of_function(value)
    return found


def _code_of_function(function: Any) -> dict[str, str]:
    plain = plain_function(function)
    values: list[Any] = [cell.cell_contents for cell in plain.__closure__ or ()] if plain else []
    if isinstance(function, partial):
        values += [*function.args, *sorted(function.keywords.items())]
    return _code(plain, "".join(map(_value, values)))


def _code(part: Any, values: str = "") -> dict[str, str]:
    """{name: SHA-256} of a class or function and values, where it is no part of Python or this library."""
    home = part.__module__
    if home.partition(".")[0] in (*_OURS, *sys.stdlib_module_names) and home != "__main__":
        return {}
    module = None if home == "__main__" else sys.modules.get(home)
    try:
        said = _layout_free(inspect.getsource(part if module is None else module))
    except (OSError, TypeError):  # no source is kept of what is typed at a prompt
        code = getattr(part, "__code__", None)
        said = repr((code.co_code, code.co_consts)) if code else ""
    return {f"{home}:{part.__qualname__}": hashlib.sha256((said + values).encode()).hexdigest()}


def _value(value: Any) -> str:
    """What tells a value from others in every process: itself, or of what holds code its name."""
    if isinstance(value, tuple | list):
        return "".join(map(_value, value))
    array = np.asarray(value)
    if array.dtype != object:
        return f"{array.dtype}{array.shape}{array.tobytes().hex()}"
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def _layout_free(source: str) -> str:
    with contextlib.suppress(SyntaxError):  # of a lambda, which is the line that it stands in
        return ast.unparse(ast.parse(textwrap.dedent(source)))
    return source
