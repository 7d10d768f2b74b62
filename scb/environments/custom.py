"""Environments that are in no registry: `package.module:factory`, imported when one is made."""

import inspect
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import environment

from scb import own
from scb.environments.spec import Family, Made
from scb.errors import UserError, first_line
from scb.keys import root_key
from scb.spaces import not_understood, understood


class CustomFamily(Family):
    """A function or class of somebody's, which returns a gymnax 1.x environment, or one with its parameters.

    Modules are looked for where Python does, and in the working directory.
    """

    name = "custom"

    def names(self) -> Sequence[str]:
        return ()

    def owns(self, name: str) -> bool:
        return own.is_own(name)

    def make(self, name: str, **arguments: Any) -> Made:
        function = own.imported(name, "environment", "factory")
        if isinstance(function, environment.Environment) and not arguments:
            made: Any = function
        elif not callable(function):
            raise UserError(
                f"environment {name!r} is a {type(function).__name__}, which cannot be called: give a class or a "
                "function that returns a gymnax 1.x environment."
            )
        else:
            try:
                # Before the call, inside of which a TypeError is a mistake of another kind.
                inspect.signature(function).bind(**arguments)
            except TypeError as error:
                given = (
                    f"the arguments {arguments}" if arguments else "to be called without arguments"
                )
                raise UserError(f"environment {name!r} does not take {given}: {error}.") from error
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


def _has_limit(params: type) -> bool:
    """Whether a class of parameters has a limit of its own, and not that of gymnax's base class."""
    own = [c for c in params.__mro__ if not issubclass(environment.EnvParams, c)]
    return any("max_steps_in_episode" in inspect.get_annotations(c) for c in own)


def _check(name: str, env: environment.Environment[Any, Any], params: Any) -> None:
    """A UserError where it keeps another contract than gymnax 1.x's; what its own functions raise is theirs to say."""

    def wrong(what: str) -> UserError:
        return UserError(f"environment {name!r} {what}.")

    if not hasattr(params, "max_steps_in_episode"):
        raise wrong(
            "has parameters without max_steps_in_episode, after which an episode ends: give them that field"
        )
    if params.max_steps_in_episode == 1 and not _has_limit(type(params)):
        raise wrong(
            "has parameters whose max_steps_in_episode is gymnax's own, so that its episodes end after one step: give "
            "them that field with its value, though it be 1"
        )
    if not 1 <= params.max_steps_in_episode < 2**31:
        raise wrong(
            f"has a max_steps_in_episode of {params.max_steps_in_episode}, after which an episode ends: it must be at "
            "least 1, and below 2^31"
        )
    observations, actions = env.observation_space(params), env.action_space(params)
    for kind, space in {"observations": observations, "actions": actions}.items():
        if not understood(space):
            raise wrong(not_understood(space, kind))

    def check_values(of: str, found: Any, values: str) -> None:
        number = len(found) if isinstance(found, tuple) else 1
        if number != values.count(",") + 1:
            raise wrong(
                f"returns {number} of {of}, where gymnax 1.x returns {values}: return these"
            )

    # gymnax's own step chooses between what is begun and what goes on, and asks is_truncated whether time is up.
    base, made = environment.Environment, type(env)
    selects = made.step is base.step
    asks_time = made.is_truncated is base.is_truncated
    timed = selects and asks_time

    def first_step(key: jax.Array) -> Any:
        found = env.reset(key, params)
        check_values("reset", found, "observation, state")
        observation, state = found
        action = actions.sample(key)
        inner = env.step_env(key, state, action, params)
        check_values("step_env", inner, "observation, state, reward, terminated, info")
        if not jnp.issubdtype(jnp.result_type(inner[3]), jnp.bool_):
            raise wrong(
                f"returns a terminated of the type {jnp.result_type(inner[3])} from step_env: return a bool"
            )
        if jnp.shape(inner[3]) != ():
            raise wrong(
                f"returns a terminated of shape {jnp.shape(inner[3])} from step_env: return one bool, of shape ()"
            )
        if selects:
            check_same("a state", state, inner[1])
            # Of arrays of other shapes its space says more.
            if len({getattr(x, "shape", None) for x in (observation, inner[0])} - {None}) < 2:
                check_same("an observation", observation, inner[0])
        if asks_time and not hasattr(state, "time"):  # an evaluation asks it too, whoever selects
            raise wrong(
                "has a state without time, the steps of its episode: give it that field, 0 after reset_env and one "
                "more after each step_env"
            )
        step = env.step(key, state, action, params)
        check_values("step", step, "observation, state, reward, terminated, truncated, info")
        if "final_observation" not in step[5]:
            raise wrong(
                "returns an info without final_observation from step: there give what was observed last, before any "
                "reset, as gymnax's own step does, or write step_env and leave step to it"
            )
        return observation, step, state

    def times(state: Any) -> Any:
        key = root_key(0)
        return state.time, env.step_env(key, state, actions.sample(key), params)[1].time

    def check_same(what: str, begun: Any, stepped: Any) -> None:
        one, other = (
            {
                jax.tree_util.keystr(path): f"{jnp.result_type(x)}{list(jnp.shape(x))}"
                for path, x in jax.tree.leaves_with_path(tree)
            }
            for tree in (begun, stepped)
        )
        for name in {**one, **other}:
            begins, goes_on = (of.get(name, "something else") for of in (one, other))
            if begins != goes_on:
                called = f"whose {name.lstrip('.')} is" if name else "that is"
                raise wrong(
                    f"returns {what} {called} {begins} from reset_env and {goes_on} from step_env: let them agree"
                )

    try:
        first, step, state = jax.eval_shape(first_step, root_key(0))
    except NotImplementedError as error:
        raise wrong(
            "lacks reset_env or step_env, which gymnax's own reset and step call: define these two"
        ) from error
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise wrong(
            f"asks for a value where JAX only has a shape ({first_line(error)}): write reset_env and step_env with "
            "jnp.where or jax.lax.cond in place of if, and with jnp in place of numpy"
        ) from error
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
    if timed:
        before, after = jax.make_jaxpr(times)(state).jaxpr.outvars  # traced, not run
        if after is before:
            raise wrong(
                "returns a state whose time is what it was, from step_env, and episodes end after max_steps_in_episode "
                "of it: count a step there, time=state.time + 1"
            )
