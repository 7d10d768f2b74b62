import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.environments.brax import BraxEnvironment
from scb.environments.brax_physics import (
    CHUNK,
    _batches_last,
    _in_chunks,
    improved_inverse,
    nonnegative_forces,
)


def matrices(condition: float, number: int, size: int = 6) -> np.ndarray:
    """[number, size, size] symmetric and positive definite."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(number, size, size)))[0]
    values = np.geomspace(1, condition, size)
    return np.asarray(axes * values @ np.swapaxes(axes, 1, 2), np.float32)


def inverted(matrix: jax.Array, guess: jax.Array, iterations: int) -> jax.Array:
    return _batches_last(partial(improved_inverse, iterations=iterations))(matrix, guess)


# The second as humanoids' are, by products.
@pytest.mark.parametrize(("inverse", "largest"), [(inverted, 6), (improved_inverse, 5)])
# Near: a guess from which it converges. Far: one that is given up, which converges or, as for walker2d, doesn't.
@pytest.mark.parametrize(
    ("condition", "near", "iterations"),
    [(50, True, 10), (5, False, 20), (1000, False, 20), (1000, True, 1)],
)
def test_an_inverse_is_braxs_converged_or_not(
    inverse, largest, condition, near, iterations, monkeypatch
):
    from brax.math import inv_approximate

    monkeypatch.setattr("scb.environments.brax_physics.LARGEST", largest)
    matrix = matrices(condition, 6)
    guess = np.linalg.inv(matrix * 1.05) if near else matrix
    expected = jax.vmap(partial(inv_approximate, num_iter=iterations))(matrix, guess)
    found = jax.jit(jax.vmap(partial(inverse, iterations=iterations)))(matrix, guess)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    exact = np.abs(expected - np.linalg.inv(matrix)).max() < 1e-3
    assert exact == (condition < 1000)


def test_an_inverse_is_the_same_in_batches_of_batches_and_alone():
    matrix = jnp.asarray(matrices(50, 6))
    guess = jnp.linalg.inv(matrix[0] * 1.05)
    invert = partial(inverted, iterations=10)
    alone = jnp.stack([invert(one, guess) for one in matrix])
    batch = jax.vmap(invert, (0, None))(matrix, guess)
    batches = jax.vmap(jax.vmap(invert, (0, None)), (1, None))(matrix.reshape(2, 3, 6, 6), guess)
    np.testing.assert_allclose(batch, alone, rtol=1e-5)
    np.testing.assert_allclose(
        batches, alone.reshape(2, 3, 6, 6).swapaxes(0, 1), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize(("iterations", "halvings"), [(4, 15), (4, 1), (100, 5)])
def test_forces_are_jaxopts(iterations, halvings):
    import jaxopt

    product = matrices(300, 8, 7)
    offset = np.random.default_rng(1).normal(size=(8, 7)).astype(np.float32)
    product[0], offset[0] = np.eye(7), 1  # no force is needed: it has converged at once

    def of_jaxopt(a: jax.Array, b: jax.Array) -> jax.Array:
        return jaxopt.ProjectedGradient(
            lambda x: jnp.sum((a @ x + b) ** 2) / 2,
            jaxopt.projection.projection_non_negative,
            maxiter=iterations,
            implicit_diff=False,
            maxls=halvings,
        ).run(jnp.zeros_like(b))[0]

    def ours(a: jax.Array, b: jax.Array) -> jax.Array:
        return nonnegative_forces(lambda x: a @ x, b, iterations, halvings)

    expected = jax.jit(jax.vmap(of_jaxopt))(product, offset)
    found = jax.jit(jax.vmap(ours))(product, offset)
    assert not expected[0].any() and expected[1:].any()
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_chunks_are_the_same_as_a_whole_batch_and_wait_for_their_own_slowest_alone():
    waits = []

    def doublings(start: jax.Array, factors: jax.Array) -> jax.Array:
        """Doubles until 100, as a loop that under vmap waits for the slowest of its batch."""

        def double(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            jax.debug.callback(lambda _: waits.append(1), carry[1])  # once for each of a batch
            return carry[0] * 2, carry[1] + 1

        _, number = jax.lax.while_loop(lambda x: x[0] < 100, double, (start, 0))
        return number * jnp.sum(factors)

    # One of all is slow: alone in the last chunk, which is not a full one.
    start = jnp.full((5, CHUNK), 60.0).reshape(-1)[: 4 * CHUNK + 3].at[-1].set(1e-3)
    factors = jnp.arange(3.0)
    expected = jax.jit(jax.vmap(doublings, (0, None)))(start, factors)
    jax.effects_barrier()
    together = len(waits)
    waits.clear()
    found = jax.jit(jax.vmap(_in_chunks(doublings), (0, None)))(start, factors)
    jax.effects_barrier()
    np.testing.assert_array_equal(found, expected)
    assert len(waits) == 4 * CHUNK + 3 * 17 < together == 17 * len(start)

    pairs = jnp.stack([start, start[::-1]])
    nested = jax.vmap(jax.vmap(_in_chunks(doublings), (0, None)), (1, None))(pairs, factors)
    np.testing.assert_array_equal(nested, jnp.stack([expected, expected[::-1]], axis=1))
    np.testing.assert_array_equal(_in_chunks(doublings)(start[0], factors), expected[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["hopper", "walker2d", "halfcheetah", "humanoidstandup", "inverted_pendulum"]
)
def test_a_step_is_braxs(name):
    import brax.envs

    env = BraxEnvironment(name)
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        original = brax.envs.get_environment(name, backend="generalized")
    states = jax.jit(jax.vmap(original.reset))(jax.random.split(jax.random.key(0), 16))
    step, ours = (jax.jit(jax.vmap(made.step)) for made in (original, env.brax_env))
    different = []
    for key in jax.random.split(jax.random.key(1), 20):
        actions = jax.random.uniform(key, (16, env.num_actions), minval=-1.0)
        expected, found = step(states, actions), ours(states, actions)
        different.append(np.abs(found.obs - expected.obs) / (1 + np.abs(expected.obs)))
        np.testing.assert_array_equal(found.done, expected.done)
        states = expected
    # Contacts amplify rounding, now and then by a lot.
    assert np.quantile(different, 0.99) < 1e-3 and np.median(different) < 1e-6
