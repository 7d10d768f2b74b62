"""Environments that are made twice are two objects; programs compiled for one serve the other."""

from collections.abc import Hashable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from gymnax.environments import environment, spaces


@dataclass(frozen=True)
class _Kind:
    key: Hashable
    env: Any = field(compare=False)


def representative(env: Any) -> Any:
    """The first environment seen of this type with the same attributes, so that both are one key of a cache.

    An environment with attributes of which equality cannot be told is its own.
    """
    try:
        return _first(_Kind(_key(env), env))
    except TypeError:  # not hashable
        return env


@lru_cache(maxsize=64)
def _first(kind: _Kind) -> Any:
    return kind.env


def _key(value: Any) -> Hashable:
    """What is equal for equal contents, types included; another object's is its own equality, by default its identity.

    Raises:
      TypeError: it is not hashable.
    """
    kind: Any = type(value)
    made = isinstance(value, environment.Environment | spaces.Space)
    if made and kind.__eq__ is object.__eq__:
        return kind, tuple((name, _key(x)) for name, x in sorted(vars(value).items()))
    if isinstance(value, jax.Array | np.ndarray):
        array = np.asarray(value)
        return kind, array.shape, array.dtype.str, array.tobytes()
    leaves, structure = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        hash(value)
        return kind, value
    return kind, structure, tuple(map(_key, leaves))
