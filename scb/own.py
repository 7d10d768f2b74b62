"""Somebody's own code by name, `package.module:attribute`, of a module that Python finds from the working directory."""

import contextlib
import copyreg
import dis
import hashlib
import importlib
import json
import logging
import re
import sys
import sysconfig
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scb.errors import UserError

_NAME = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")
_OURS = ("scb", "lpo")
_LIBRARIES = {Path(path) for name, path in sysconfig.get_paths().items() if name.endswith("lib")}


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
    name = _called(thing)
    there = getattr(sys.modules.get(thing.__module__), thing.__qualname__, None)
    if is_own(name) and thing.__module__ != "__main__" and there is thing:
        return name
    raise UserError(
        f"the {kind} {thing.__qualname__} is defined where no import finds it: a file names package.module:"
        f"{thing.__name__.strip('<>')}, so move it to the top of a module, and import it from there."
    )


def code_of(thing: Any) -> dict[str, str]:
    """{name: SHA-256} of what somebody's own functions and classes compute, of which an object is made; empty for none.

    By their compiled code, in which comments and layout are not. With it count defaults, what partials, decorators and
    functions around them hold, base classes, and the functions, classes and values of their modules that they name;
    of libraries and of this one nothing does, but what an object of theirs holds.
    """
    reading = _Reading()
    said = json.dumps(reading.of(thing))
    return {reading.own[0]: hashlib.sha256(said.encode()).hexdigest()} if reading.own else {}


def code_of_names(names: Iterable[str]) -> dict[str, str]:
    """{name: SHA-256} of those of the names that stand for somebody's own code."""
    found = {}
    for name in filter(is_own, names):
        # One that cannot be imported is told of where the thing is made.
        with contextlib.suppress(UserError):
            if code := code_of(imported(name, "code", "name")):
                (found[name],) = code.values()
    return found


class _Reading:
    """What things say, as nested lists of texts that are the same in every process.

    Attributes:
      own: names of somebody's own functions and classes that were met.
    """

    def __init__(self, around: Iterable[int] = ()) -> None:
        self.own: list[str] = []
        self._met: dict[int, Any] = {}  # held, so that nothing else comes to be where one was
        self._around = set(around)  # what is being read: containers, and objects

    def of(self, value: Any) -> Any:
        match value:
            case None | bool() | int() | float() | complex() | str() | bytes():
                return repr(value)
            case CodeType():
                return self._code(value)
            case ModuleType():
                return value.__name__
        if id(value) in self._met:
            return "as before"
        if id(value) in self._around:
            return "around"
        self._around.add(id(value))
        match value:
            case tuple() | list() | set() | frozenset() | Mapping():
                said = self._container(value)
            case _:
                self._met[id(value)] = value
                said = self._object(value)
        self._around.discard(id(value))
        return said

    def _object(self, value: Any) -> Any:
        match value:
            case FunctionType():
                return self._function(value)
            case type():
                return self._class(value)
            case MethodType() | staticmethod() | classmethod():
                return [
                    "method",
                    self.of(value.__func__),
                    self.of(getattr(value, "__self__", None)),
                ]
            case property():
                return ["property", *map(self.of, (value.fget, value.fset))]
            case cached_property():
                return ["property", self.of(value.func)]
            case partial():
                return ["partial", *map(self.of, (value.func, value.args, value.keywords))]
            case np.ndarray() | np.generic() | jax.Array():
                array = np.asarray(_plain(value))
                return [
                    str(array.dtype),
                    str(array.shape),
                    hashlib.sha256(array.tobytes()).hexdigest(),
                ]
            case logging.Logger():  # computes nothing, and holds what the process has opened
                return _called(type(value))
            case jax.custom_vjp() | jax.custom_jvp() if _is_somebodys(value):
                return ["derivative", self.of(_without_names(vars(value)))]
        if hasattr(value, "__wrapped__"):  # by a decorator such as jax.jit
            return ["wrapped", self.of(value.__wrapped__)]
        return [self.of(type(value)), self.of(_held(value))]

    def _container(self, value: Any) -> Any:
        match value:
            case Mapping():
                pairs = sorted(((self._apart(k), k) for k in value), key=itemgetter(0))
                return ["mapping", *([name, self.of(value[k])] for name, k in pairs)]
            case set() | frozenset():
                return ["set", *sorted(map(self._apart, value))]
            case _:
                return [type(value).__name__, *map(self.of, value)]

    def _apart(self, value: Any) -> str:
        """What a value says by itself, whatever was met before it: the order of sets is another in every process."""
        reading = _Reading(self._around)
        said = json.dumps(reading.of(value))
        self.own += reading.own
        return said

    def _named(self, value: Any, names: set[str]) -> Any:
        """A global; of somebody's own module what code names of it."""
        if not isinstance(value, ModuleType) or not _is_of_somebody(value.__name__):
            return self.of(value)
        held = vars(value)
        return [[n, self._named(held[n], names - {n})] for n in sorted(names & held.keys())]

    def _function(self, function: FunctionType) -> Any:
        if not _is_somebodys(function):
            return _called(function)
        self.own.append(_called(function))
        cells = []
        for cell in function.__closure__ or ():
            with contextlib.suppress(ValueError):  # of what is assigned later
                cells.append(self.of(cell.cell_contents))
        names, known = _names(function.__code__), function.__globals__
        named = [[n, self._named(known[n], names - {n})] for n in sorted(names & known.keys())]
        code = self._code(function.__code__)
        held = [self.of((function.__defaults__, function.__kwdefaults__)), named]
        return ["function", code, held, cells]

    def _code(self, code: CodeType) -> Any:
        # Not its bytes, which a docstring that comes or goes would move.
        return [[x.opname, self.of(x.argval)] for x in dis.get_instructions(code)]

    def _class(self, made: type) -> Any:
        if not _is_somebodys(made):
            return _called(made)
        self.own.append(_called(made))
        said = {k: x for k, x in vars(made).items() if k not in _ABOUT_CLASSES}
        return ["class", self.of(said), *map(self.of, made.__bases__)]


_ABOUT_CLASSES = (
    "__doc__",
    "__module__",
    "__qualname__",
    "__firstlineno__",
    "__static_attributes__",
    "__slotnames__",  # noted when the first object is copied
)


def _without_names(held: Mapping[str, Any]) -> dict[str, Any]:
    """What a function holds but for what is said about it, such as its name."""
    return {name: x for name, x in held.items() if not name.startswith("__")}


def _held(value: Any) -> Any:
    """What an object holds: its attributes; of one without any what it would be copied from, or its name."""
    if is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in fields(value)}
    if hasattr(value, "__dict__"):
        return vars(value)
    try:
        known = copyreg.dispatch_table.get(type(value))
        made = known(value) if known else value.__reduce_ex__(2)
    # Whatever cannot be copied says so as it likes: a lock, a generator.
    except Exception:
        return getattr(value, "__name__", {})
    if isinstance(made, str):
        return made
    items = (list(x) for x in made[3:5] if x is not None)  # such as a deque's
    return [*made[1:3], *items]


def _names(code: CodeType) -> set[str]:
    """The globals and attributes that code names, that inside of it too."""
    inner = (_names(x) for x in code.co_consts if isinstance(x, CodeType))
    return set(code.co_names).union(*inner)


def _plain(array: Any) -> Any:
    """An array of numbers, which those of a random key are in another form."""
    if isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(array)
    return array


def _called(thing: Any) -> str:
    return f"{thing.__module__}:{thing.__qualname__}"


def _is_somebodys(thing: Any) -> bool:
    """Whether a function or class is neither Python's, nor this library's, nor that of a package that is installed."""
    return _is_of_somebody(thing.__module__ or "")


def _is_of_somebody(home: str) -> bool:
    """The same of a module's name."""
    if home.partition(".")[0] in (*_OURS, "builtins"):
        return False
    file = getattr(sys.modules.get(home), "__file__", None)
    if home == "__main__" or file is None:  # typed, or Python's and without a file
        return home not in sys.builtin_module_names
    return not any(Path(file).is_relative_to(library) for library in _LIBRARIES)
