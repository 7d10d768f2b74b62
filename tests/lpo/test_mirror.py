"""The mirror drift is the Bregman divergence of its potential, and KL where its search starts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpo.certificate import certify
from lpo.drifts import learned_drift
from lpo.drifts.mirror import MirrorDrift
from lpo.objectives import load_objective, save_objective
from scb.errors import UserError

DRIFT = MirrorDrift(hidden_size=4, strength=3.0)


def charged(parameters, ratio) -> np.ndarray:
    x = jnp.log(jnp.asarray(ratio, jnp.float32))
    return np.asarray(DRIFT(parameters, x, jnp.ones_like(x), jnp.zeros_like(x)))


def test_a_search_starts_near_kl():
    # 3 (r log r - r + 1) at r = 2: 3 (2 (0.693147) - 1) = 1.158883; at r = 1/2: 3 (0.5 - 0.346574) = 0.460279.
    start = DRIFT.init(jax.random.key(0), 0.0)
    np.testing.assert_allclose(charged(start, [2.0, 0.5]), [1.158883, 0.460279], atol=1e-5)


def test_it_is_the_bregman_divergence_of_its_potential():
    # Written out in 64 bits from the definition, with other weights than a search starts from.
    weights = jax.tree.map(lambda x: x + 0.5, DRIFT.init(jax.random.key(1)))
    square, entropy, slope, offset, weight = (
        np.asarray(weights[k], float) for k in ("square", "entropy", "slope", "offset", "weight")
    )

    def potential(r):
        unit = np.logaddexp(0.0, 5.0 * (offset + slope * (r[:, None] - 1.0)))
        known = square**2 / 2 * (r - 1.0) ** 2 + entropy**2 * r * np.log(r)
        return known + unit @ weight**2

    ratio, one, h = np.array([0.05, 0.4, 0.9, 1.2, 3.0]), np.ones(1), 1e-5
    at_one = (potential(one + h) - potential(one - h)) / (2 * h)
    divergence = potential(ratio) - potential(one) - at_one * (ratio - 1.0)
    np.testing.assert_allclose(charged(weights, ratio), divergence, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_it_is_a_drift_whatever_its_weights(scale):
    weights = jax.tree.map(lambda x: scale * x, DRIFT.init(jax.random.key(2)))
    found = certify(DRIFT, weights, num_ratios=61, num_advantages=5)
    assert found.holds
    # Convex, with no kink at 1: a tenth of the way out, at most about a tenth of the slope.
    assert found.slope_at_0_001 <= 0.15 * found.slope_at_0_01


def test_a_saved_one_charges_the_same(tmp_path):
    weights = DRIFT.init(jax.random.key(3))
    path, _ = save_objective(tmp_path / "mine.npz", DRIFT, weights)
    loaded = load_objective(path)
    assert loaded.drift == DRIFT
    jax.tree.map(np.testing.assert_array_equal, loaded.parameters, weights)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MirrorDrift(hidden_size=0), "hidden_size is 0: it must be at least 1."),
        (lambda: MirrorDrift(strength=0.0), "strength is 0.0: it must be positive"),
        (
            lambda: learned_drift("mirror", gate=0.1),
            "mirror has no gate, which is a setting of net",
        ),
    ],
)
def test_settings_that_make_none_are_refused(make, message, one_sentence):
    with pytest.raises(UserError) as error:
        make()
    assert message in one_sentence(str(error.value))
