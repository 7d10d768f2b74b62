"""What uniformly random actions earn, measured once and kept in returns.json.

    python -c 'from scb.environments import returns; returns.main(["CartPole-v1", "hopper:spring"])'

measures anew and writes the table beside this file. What is in it stays as it was first measured, so that
scores of all reports have one scale. An environment without an entry is measured when it is asked for.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from gymnax.environments import environment

from scb.evaluation import evaluate
from scb.keys import root_key

# By backend; None where there is no choice of physics.
Returns: TypeAlias = Mapping[str | None, float]
EPISODES = 256
_TABLE = Path(__file__).with_name("returns.json")


def random_return(
    env: environment.Environment[Any, Any], env_params: Any, episodes: int = EPISODES
) -> float:
    """Mean return of uniformly random actions."""
    space = env.action_space(env_params)
    result = jax.jit(
        lambda key: evaluate(env, env_params, lambda _, k: space.sample(k), key, episodes)
    )(root_key(0))
    return float(np.mean(result.returns))


@cache
def table() -> dict[str, Returns]:
    """{environment: {backend: mean return of random actions}}."""
    found: dict[str, dict[str | None, float]] = {}
    for place, value in json.loads(_TABLE.read_text()).items():
        name, _, backend = place.partition(":")
        found.setdefault(name, {})[backend or None] = value
    return dict(found)


def main(places: Sequence[str]) -> None:
    """Measures at each NAME or NAME:BACKEND and writes the table."""
    from scb.environments.registry import environment_spec  # which needs the table

    kept = json.loads(_TABLE.read_text())
    for place in places:
        name, _, backend = place.partition(":")
        kept[place] = random_return(*environment_spec(name).make(backend or None))
        print(f"{place}: {kept[place]}")
        _TABLE.write_text(json.dumps(dict(sorted(kept.items())), indent=2) + "\n")
