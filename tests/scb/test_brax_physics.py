import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.environments.brax import BraxEnvironment
from scb.environments.brax_physics import _batches_last, improved_inverse, nonnegative_forces


def matrices(condition: float, number: int, size: int = 6) -> np.ndarray:
    """[number, size, size] symmetric and positive definite."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(number, size, size)))[0]
    values = np.geomspace(1, condition, size)
    return np.asarray(axes * values @ np.swapaxes(axes, 1, 2), np.float32)


def inverted(matrix: jax.Array, guess: jax.Array, iterations: int) -> jax.Array:
    return _batches_last(partial(improved_inverse, iterations=iterations))(matrix, guess)


# Near: a guess from which it converges. Far: one that is given up, which converges or, as for walker2d, doesn't.
@pytest.mark.parametrize(
    ("condition", "near", "iterations"),
    [(50, True, 10), (5, False, 20), (1000, False, 20), (1000, True, 1)],
)
def test_an_inverse_is_braxs_converged_or_not(condition, near, iterations):
    from brax.math import inv_approximate

    matrix = matrices(condition, 6)
    guess = np.linalg.inv(matrix * 1.05) if near else matrix
    expected = jax.vmap(partial(inv_approximate, num_iter=iterations))(matrix, guess)
    found = jax.jit(jax.vmap(partial(inverted, iterations=iterations)))(matrix, guess)
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper", "walker2d", "halfcheetah", "inverted_pendulum"])
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
