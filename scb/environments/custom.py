"""Environments that are in no registry: `package.module:factory`, imported when one is made."""

import importlib
import inspect
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from gymnax.environments import environment, spaces

from scb.environments.spec import Family, Made
from scb.errors import UserError
from scb.keys import root_key

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
        params = env.default_params if params is None else params
        _check(name, env, params)
        return env, params


def _check(name: str, env: environment.Environment[Any, Any], params: Any) -> None:
    """A UserError where it keeps another contract than gymnax 1.x's; what its own functions raise is theirs to say."""

    def wrong(what: str) -> UserError:
        return UserError(f"environment {name!r} {what}.")

    if not hasattr(params, "max_steps_in_episode"):
        raise wrong(
            "has parameters without max_steps_in_episode, after which an episode ends: give them that field"
        )
    if type(params) is environment.EnvParams and params == environment.EnvParams():
        raise wrong(
            "has gymnax's own parameters, whose episodes end after one step: give it default_params with its "
            "max_steps_in_episode"
        )
    observations, actions = env.observation_space(params), env.action_space(params)
    for kind, space in {"observations": observations, "actions": actions}.items():
        if not isinstance(space, spaces.Box | spaces.Discrete):
            raise wrong(
                f"has a {type(space).__name__} of {kind}: one Box or Discrete is understood: put all into one"
            )

    def check_values(of: str, found: Any, values: str) -> None:
        number = len(found) if isinstance(found, tuple) else 1
        if number != values.count(",") + 1:
            raise wrong(
                f"returns {number} of {of}, where gymnax 1.x returns {values}: return these"
            )

    def first_step(key: jax.Array) -> Any:
        found = env.reset(key, params)
        check_values("reset", found, "observation, state")
        observation, state = found
        action = actions.sample(key)
        inner = env.step_env(key, state, action, params)
        check_values("step_env", inner, "observation, state, reward, terminated, info")
        step = env.step(key, state, action, params)
        check_values("step", step, "observation, state, reward, terminated, truncated, info")
        return observation, step

    first, step = jax.eval_shape(first_step, root_key(0))
    for when, observation in {"reset": first, "step": step[0]}.items():
        shape = getattr(observation, "shape", type(observation).__name__)
        if shape != observations.shape:
            raise wrong(
                f"returns observations of shape {shape} from {when}, where its observation_space says "
                f"{observations.shape}: let them agree"
            )
    if step[2].shape != ():
        raise wrong(
            f"returns rewards of shape {step[2].shape}, where one number is expected: sum or average them"
        )
