"""What random and zero actions earn, measured once and kept in returns.json.

    python -c 'from scb.environments import returns; returns.main(["CartPole-v1", "hopper:spring"])'

measures anew and writes the table beside this file: uniformly random actions everywhere, zero actions where
there is physics to choose. What is in it stays as it was first measured, so that scores of all reports have
one scale. An environment without an entry is measured when random actions are asked for.
"""

import json
from collections.abc import Mapping, Sequence
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
_TABLE = Path(__file__).with_name("returns.json")


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
    for place, value in json.loads(_TABLE.read_text())[kind].items():
        name, _, backend = place.partition(":")
        found.setdefault(name, {})[backend or None] = value
    return dict(found)


def main(places: Sequence[str]) -> None:
    """Measures at each NAME or NAME:BACKEND and writes the table."""
    from scb.environments.registry import environment_spec  # which needs the table

    for place in places:
        name, _, backend = place.partition(":")
        spec = environment_spec(name)
        made = spec.make(backend or None)
        measured = {RANDOM: random_return(*made)}
        if spec.backends:
            measured[IDLE] = idle_return(*made)
        print(f"{place}: {measured}")
        kept = json.loads(_TABLE.read_text())
        for kind, value in measured.items():
            kept[kind] = dict(sorted({**kept[kind], place: value}.items()))
        _TABLE.write_text(json.dumps(kept, indent=2) + "\n")
