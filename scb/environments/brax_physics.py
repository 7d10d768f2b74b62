"""Brax's generalized physics, the same numbers up to rounding in a fraction of the time.

Two steps of the simulation take most of its time, and both are batches of small matrices, for which XLA's loops
and products cost far more than their arithmetic:

- The inverse of the mass matrix, which Brax improves from the last step's by Newton-Schulz iterations
  (`improved_inverse`).
- The forces of contacts and joint limits: accelerated projected gradient descent (Beck & Teboulle, 2009) with a line
  search, which is jaxopt's there (`nonnegative_forces`).

Brax's loops always run to their ends, here they stop when all have converged. For the inverse of all but humanoids'
matrices, the axis that vmap adds is the last one here, so that each product of small matrices is arithmetic on whole
batches. For the forces, a large batch is taken in chunks on a CPU: each waits for its own slowest environment alone.

Loops that stop have no reverse mode: whoever differentiates through the physics takes Brax's own environment.
"""

import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

TOLERANCE = 1e-3  # jaxopt's, of the iterates' change over the size of the step
SMALLEST = 1e-6  # step, below which jaxopt starts from 1 again
CHUNK = 16  # environments
LARGEST = 16  # matrix whose products are arithmetic on whole batches; a humanoid's is of 23
Carry = tuple[Any, ...]


def accelerate(env: Any) -> None:
    """Has a Brax environment on the generalized backend simulate by this module; others stay as they are."""
    pipeline = env.unwrapped._pipeline

    def step(*arguments: Any) -> Any:
        with _in_place():
            return pipeline.step(*arguments)

    env.unwrapped._pipeline = types.SimpleNamespace(init=pipeline.init, step=step)


@contextmanager
def _in_place() -> Iterator[None]:
    """While Brax's step is traced, it finds the two functions of this module in the place of its own."""
    from brax.generalized import constraint, mass

    own = constraint.force, mass.matrix_inv
    constraint.force, mass.matrix_inv = constraint_force, matrix_inv
    try:
        yield
    finally:
        constraint.force, mass.matrix_inv = own


def matrix_inv(sys: Any, state: Any, iterations: int) -> Any:
    """`brax.generalized.mass.matrix_inv`: the state with its mass matrix and the inverse of it."""
    from brax.generalized import mass

    matrix = mass.matrix(sys, state)
    inverse: Callable[..., jax.Array] = partial(improved_inverse, iterations=iterations)
    if len(matrix) <= LARGEST:
        inverse = _batches_last(inverse)
    return state.replace(mass_mx=matrix, mass_mx_inv=inverse(matrix, state.mass_mx_inv))


def constraint_force(sys: Any, state: Any) -> jax.Array:
    """`brax.generalized.constraint.force`: [N] what contacts and joint limits do to each degree of freedom."""
    if not len(state.con_jac):
        return jnp.zeros(sys.qd_size())

    def force(
        inverse: jax.Array,
        jacobian: jax.Array,
        own: jax.Array,
        smooth: jax.Array,
        wanted: jax.Array,
    ) -> jax.Array:
        moved = inverse @ jacobian.T  # [N, C]

        def response(forces: jax.Array) -> jax.Array:
            """[C] forces -> [C] accelerations along the constraints."""
            return _combined(moved, _combined(jacobian, forces)) + own * forces

        offset = _combined(moved, smooth) - wanted
        forces = nonnegative_forces(response, offset, sys.solver_iterations, sys.solver_maxls)
        return _combined(jacobian, forces)

    return _in_chunks(force)(
        state.mass_mx_inv, state.con_jac, state.con_diag, state.qf_smooth, state.con_aref
    )


def improved_inverse(matrix: jax.Array, guess: jax.Array, iterations: int) -> jax.Array:
    """`brax.math.inv_approximate`, ended where it has converged: [N, N, ...] and a guess at its inverse -> [N, N, ...].

    The guess is given up for a small multiple of the matrix where it is far off. As in Brax, the first iteration
    then still has the residual of the guess; on walker2d and humanoidstandup, that and a mass matrix of a condition
    of about 1000 keep the result from being an inverse, and it is part of what these environments are.
    """
    eye = jnp.eye(len(matrix), dtype=matrix.dtype).reshape(
        len(matrix), len(matrix), *([1] * (matrix.ndim - 2))
    )

    def norm(x: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.sum(x**2, axis=(0, 1)))

    def improve(carry: Carry) -> Carry:
        number, found, residual, error, _ = carry
        better = _product(found, eye + residual)
        residual = eye - _product(matrix, better)
        next_error = norm(residual)
        found = jnp.where(next_error < error, better, found)
        return number + 1, found, residual, next_error, error

    residual = eye - _product(matrix, guess)
    small = jnp.swapaxes(matrix, 0, 1) / (2 * jnp.sum(matrix**2, axis=(0, 1)))
    found = jnp.where(norm(residual) > 1, small, guess)
    errors = jnp.ones(matrix.shape[2:], matrix.dtype)

    def goes_on(carry: Carry) -> jax.Array:
        # Each error is the one before squared: after 1e-3 comes what rounding leaves.
        return (carry[0] < iterations) & (carry[-1] > 1e-3)

    def improve_some(carry: Carry) -> Carry:
        """What vmap would do: a matrix that has converged keeps its inverse while others go on."""
        going = goes_on(carry)
        return tuple(jnp.where(going, *x) for x in zip(improve(carry), carry, strict=True))

    start = (jnp.zeros_like(errors), found, residual, errors, errors)
    return jax.lax.while_loop(lambda carry: jnp.any(goes_on(carry)), improve_some, start)[1]


def nonnegative_forces(
    response: Callable[[jax.Array], jax.Array], offset: jax.Array, iterations: int, halvings: int
) -> jax.Array:
    """Minimizes |response(x) + offset|^2 / 2 over x >= 0, as `jaxopt.ProjectedGradient` does from x = 0.

    Args:
      response: linear and symmetric, [C] -> [C].
      offset: [C].
      iterations: the most that are made.
      halvings: of the step in one line search, the most that are made.

    Returns:
      [C] x.
    """
    rounding = jnp.finfo(offset.dtype).eps

    def iterate(carry: Carry) -> Carry:
        number, x, point, momentum, size, _ = carry
        residual = response(point) + offset
        gradient = response(residual)
        value = jnp.sum(residual**2) / 2

        def tried(size: jax.Array) -> Carry:
            """Where a step of this size leads, and whether the step was too large."""
            there = jnp.maximum(point - size * gradient, 0)
            change = there - point
            gain = jnp.sum((response(there) + offset) ** 2) / 2 - value
            bound = size * jnp.sum(gradient * change) + jnp.sum(change**2) / 2
            return there, size * gain > bound + rounding

        def halved(carry: Carry) -> Carry:
            count, size, _, _ = carry
            return count + 1, size / 2, *tried(size / 2)

        _, size, there, _ = jax.lax.while_loop(
            lambda carry: carry[-1] & (carry[0] < halvings),
            halved,
            (0, size, *tried(size)),
        )
        size = jnp.where(size <= SMALLEST, 1.0, size * 2)
        next_momentum = (1 + jnp.sqrt(1 + 4 * momentum**2)) / 2
        change = there - x
        point = there + (momentum - 1) / next_momentum * change
        error = jnp.sqrt(jnp.sum(change**2)) / size
        return number + 1, there, point, next_momentum, size, error

    zero, one = jnp.zeros_like(offset), jnp.ones((), offset.dtype)
    return jax.lax.while_loop(
        lambda carry: (carry[0] < iterations) & (carry[-1] > TOLERANCE),
        iterate,
        (0, zero, zero, one, one, one * jnp.inf),
    )[1]


def _product(left: jax.Array, right: jax.Array) -> jax.Array:
    """[N, M, ...], [M, K, ...] -> [N, K, ...]."""
    if left.ndim == 2 and len(left) > LARGEST:
        return left @ right
    return reduce(add, (left[:, k, None] * right[k] for k in range(len(right))))


def _combined(rows: jax.Array, weights: jax.Array) -> jax.Array:
    """[R, C] rows, [R] weights -> [C] their sum."""
    return reduce(add, (row * weight for row, weight in zip(rows, weights, strict=True)))


def _batches_last(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function of [N, N, ...] arrays that gives one, with the batch axes that vmap adds as its "..."."""

    @custom_vmap
    def batched(*arrays: jax.Array) -> jax.Array:
        return function(*arrays)

    @batched.def_vmap
    def rule(size: int, is_batched: list[bool], *arrays: jax.Array) -> tuple[jax.Array, bool]:
        last = (jnp.moveaxis(x, 0, 2) for x in _all_batched(size, is_batched, arrays))
        return jnp.moveaxis(batched(*last), 2, 0), True

    return batched


def _in_chunks(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function of arrays that gives one; on a CPU, where it is faster, what vmap adds is taken `CHUNK` at a time."""
    if jax.default_backend() != "cpu":
        return function

    @custom_vmap
    def chunked(*arrays: jax.Array) -> jax.Array:
        """[B, ...] -> [B, ...]."""
        return jax.lax.map(lambda each: function(*each), arrays, batch_size=CHUNK)

    @chunked.def_vmap
    def rule(size: int, is_batched: list[bool], *arrays: jax.Array) -> tuple[jax.Array, bool]:
        found = chunked(
            *(x.reshape(-1, *x.shape[2:]) for x in _all_batched(size, is_batched, arrays))
        )
        return found.reshape(size, -1, *found.shape[1:]), True

    return lambda *arrays: chunked(*(array[None] for array in arrays))[0]


def _all_batched(
    size: int, is_batched: Sequence[bool], arrays: Sequence[jax.Array]
) -> list[jax.Array]:
    """What a rule of vmap is given, all of it with the new axis, which is the first."""
    return [
        array if there else jnp.repeat(array[None], size, axis=0)
        for array, there in zip(arrays, is_batched, strict=True)
    ]
