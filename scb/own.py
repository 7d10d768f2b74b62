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
from pathlib import Path
from types import FunctionType
from typing import Any

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
            found[name] = _digest(inspect.getsource(_module(name.partition(":")[0])))
    return found


def code_of(thing: Any) -> dict[str, str]:
    """{name: SHA-256} of what is somebody's own: a function, or an object's class and the functions among its fields.

    Of what their module says, as `module_code`; of the script that runs, or a notebook, what they say themselves.
    """
    parts: list[Any] = [thing]
    if not isinstance(thing, FunctionType):
        values = [getattr(thing, f.name) for f in fields(thing)] if is_dataclass(thing) else []
        parts = [type(thing), *(x for x in values if isinstance(x, FunctionType))]
    found = {}
    for part in parts:
        if part.__module__.partition(".")[0] in (*_OURS, "builtins"):
            continue
        name = f"{part.__module__}:{part.__qualname__}"
        module = None if part.__module__ == "__main__" else sys.modules.get(part.__module__)
        try:
            found[name] = _digest(inspect.getsource(part if module is None else module))
        except (OSError, TypeError):  # no source is kept of what is typed at a prompt
            code = getattr(part, "__code__", None)
            said = repr((code.co_code, code.co_consts)) if code else name
            found[name] = hashlib.sha256(said.encode()).hexdigest()
    return found


def _digest(source: str) -> str:
    with contextlib.suppress(SyntaxError):  # of a lambda, which is the line that it stands in
        source = ast.unparse(ast.parse(textwrap.dedent(source)))
    return hashlib.sha256(source.encode()).hexdigest()
