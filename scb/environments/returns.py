"""What random and zero actions earn, measured once and kept in returns.json.

Uniformly random actions everywhere, zero actions where there is physics to choose. What is in the table beside
this file stays as it was first measured, so that scores of all reports have one scale; `python -m experiments
returns` writes it. An environment without an entry is measured when random actions are asked for.
"""

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment

from scb.evaluation import Policy, evaluate
from scb.keys import root_key
from scb.spaces import check_bounded

# By backend; None where there is no choice of physics.
Returns: TypeAlias = Mapping[str | None, float]
EPISODES, IDLE_EPISODES = 256, 64
RANDOM, IDLE = "random", "idle"
TABLE = Path(__file__).with_name("returns.json")


def random_return(
    env: environment.Environment[Any, Any], env_params: Any, episodes: int = EPISODES
) -> float:
    """Mean return of uniformly random actions; a UserError where these have no bounds."""
    space = env.action_space(env_params)
    check_bounded(space)
    return _mean_return(env, env_params, lambda _, key: space.sample(key), episodes)


def idle_return(
    env: environment.Environment[Any, Any], env_params: Any, episodes: int = IDLE_EPISODES
) -> float:
    """Mean return of actions that are all zero."""
    zero = jnp.zeros(env.action_space(env_params).shape)
    return _mean_return(env, env_params, lambda observation, key: zero, episodes)


def _mean_return(env: Any, env_params: Any, policy: Policy, episodes: int) -> float:
    found = jax.jit(lambda key: evaluate(env, env_params, policy, key, episodes))(root_key(0))
    return float(np.mean(found.returns))


@cache
def table(kind: str) -> dict[str, Returns]:
    """{environment: {backend: mean return}} of random or of zero actions."""
    found: dict[str, dict[str | None, float]] = {}
    for place, value in json.loads(TABLE.read_text())[kind].items():
        name, _, backend = place.partition(":")
        found.setdefault(name, {})[backend or None] = value
    return dict(found)
