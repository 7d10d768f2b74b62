"""Environments that are in no registry: `package.module:factory`, imported when one is made."""

import importlib
import inspect
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gymnax.environments import environment

from scb.environments.spec import Family, Made
from scb.errors import UserError

_NAME = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")


class CustomFamily(Family):
    """A function or class of somebody's, which returns a gymnax 1.x environment, or one with its parameters.

    Modules are looked for where Python does, and in the working directory.
    """

    name = "custom"

    def names(self) -> Sequence[str]:
        return ()

    def owns(self, name: str) -> bool:
        return _NAME.fullmatch(name) is not None

    def make(self, name: str, **arguments: Any) -> Made:
        module, _, factory = name.partition(":")
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.append(here)
        try:
            function = getattr(importlib.import_module(module), factory)
        # Whatever a module does that is not ours.
        except Exception as error:
            raise UserError(
                f"environment {name!r} cannot be imported ({error}): give package.module:factory, of a module that "
                "Python finds from here."
            ) from error
        try:
            # Before the call, inside of which a TypeError is a mistake of another kind.
            inspect.signature(function).bind(**arguments)
        except TypeError as error:
            raise UserError(f"environment {name!r} does not take {arguments}: {error}.") from error
        made = function(**arguments)
        env, params = made if isinstance(made, tuple) and len(made) == 2 else (made, None)
        if not isinstance(env, environment.Environment):
            raise UserError(
                f"{name!r} returned a {type(env).__name__}: it must return a gymnax 1.x environment, or one and its "
                "parameters."
            )
        return env, env.default_params if params is None else params
