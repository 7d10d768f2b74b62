"""A replay buffer that vmaps: a ring of transitions as a pytree of arrays."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class ReplayBuffer:
    """The newest `capacity` transitions.

    `written` counts what was ever added. It depends on nothing that is vmapped, so under `vmap` all
    rings are written at one place.
    """

    transitions: Any  # pytree of [capacity, ...]
    written: jax.Array  # []

    @property
    def capacity(self) -> int:
        return int(jax.tree.leaves(self.transitions)[0].shape[0])


def empty_buffer(example: Any, capacity: int) -> ReplayBuffer:
    """A buffer for transitions like `example` (one transition, or its shapes and dtypes)."""
    transitions = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
    return ReplayBuffer(transitions, jnp.int32(0))


def add(buffer: ReplayBuffer, batch: Any) -> ReplayBuffer:
    """Adds [N, ...] transitions, N at most the capacity; the oldest make room.

    N must divide what was written so far, as a step of the agents' environments divides the prefill
    and every step before: where it divides the capacity too, the batch never wraps around the ring's
    end, and a slice is written instead of a scatter.
    """
    number = jax.tree.leaves(batch)[0].shape[0]
    capacity = buffer.capacity
    start = buffer.written % capacity
    if capacity % number == 0:

        def write(ring: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(ring, new, start, 0)
    else:
        index = (start + jnp.arange(number)) % capacity

        def write(ring: jax.Array, new: jax.Array) -> jax.Array:
            return ring.at[index].set(new)

    # With jax_enable_x64 what is added can be of twice the size.
    batch = jax.tree.map(lambda ring, new: jnp.asarray(new, ring.dtype), buffer.transitions, batch)
    transitions = jax.tree.map(write, buffer.transitions, batch)
    return ReplayBuffer(transitions, buffer.written + number)


def sample(buffer: ReplayBuffer, key: jax.Array, number: int) -> Any:
    """[number, ...] transitions, uniformly with replacement; the buffer must not be empty."""
    stored = jnp.minimum(buffer.written, buffer.capacity)
    index = jax.random.randint(key, (number,), 0, stored)
    return jax.tree.map(lambda x: x[index], buffer.transitions)
