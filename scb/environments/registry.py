"""Environments by name: synthetic ones, gymnax's and Brax's, all behind gymnax 1.x's interface."""

from typing import Any

import gymnax
from gymnax.environments import environment

from scb.environments.brax import BRAX_NAMES, BraxEnvironment
from scb.environments.zoo import load
from scb.errors import UserError, unknown_name


def environment_names() -> list[str]:
    """Every name that `make` takes."""
    return [*gymnax.registered_envs, *BRAX_NAMES]


def make(
    name: str, backend: str | None = None, **arguments: Any
) -> tuple[environment.Environment[Any, Any], Any]:
    """An environment and its default parameters.

    Args:
      name: "Synthetic-Pendulum-v1", "CartPole-v1", "hopper", ..., or the file.npz of a bandit or of a
        synthetic MDP.
      backend: "generalized", "positional" or "spring" for Brax environments; None for their own, and
        for every other environment.
      arguments: for the environment's constructor.

    Raises:
      UserError: unknown name (with near matches), or arguments that the environment doesn't take.
    """
    if backend is not None:
        arguments["backend"] = backend
    if name.endswith(".npz"):
        synthetic = load(name)
        return synthetic, synthetic.default_params
    try:
        if name in BRAX_NAMES:
            env = BraxEnvironment(name, **arguments)
            return env, env.default_params
        if name in gymnax.registered_envs:
            return gymnax.make(name, **arguments)
    except TypeError as error:
        raise UserError(f"environment {name!r} does not take {arguments}: {error}.") from error
    raise unknown_name("environment", name, environment_names())
