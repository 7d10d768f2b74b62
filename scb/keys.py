"""Random keys: the one place that makes them, so that no two draws of a run use the same one.

In JAX `split(key, n)[i]` is `fold_in(key, i)`. A key is therefore either split or indexed by
position, never both, and is split at one place only; whatever else hangs on it goes by name.
"""

import hashlib

import jax
import numpy as np
from jax.typing import ArrayLike

from scb.errors import UserError

# Positions are smaller.
FIRST_NAME = 2**31


def root_key(seed: ArrayLike) -> jax.Array:
    """The key that everything decided by a seed comes from; the seed may be traced."""
    return jax.random.key(seed)


def split_key(key: jax.Array, number: int = 2) -> jax.Array:
    """[number] keys of their own; a longer split begins with the keys of a shorter one.

    Raises:
      UserError: it is no key, but a seed for instance.
    """
    if not isinstance(key, jax.Array | np.ndarray):
        raise UserError(f"the key is {key!r}: give one of JAX's, such as jax.random.key(0).")
    return jax.random.split(key, number)


def key_at(key: jax.Array, position: ArrayLike) -> jax.Array:
    """The key of a position (below 2^31, may be traced), of a key that is not split as well."""
    return jax.random.fold_in(key, position)


def named_key(key: jax.Array, role: str) -> jax.Array:
    """The key of a role, which is no position's: this key may be split or indexed as well."""
    digest = int.from_bytes(hashlib.sha256(role.encode()).digest()[:4], "big")
    return jax.random.fold_in(key, FIRST_NAME | digest)
