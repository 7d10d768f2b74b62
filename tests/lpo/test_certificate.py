"""A certificate must tell a drift from what only looks like one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import lpo
import scb
from lpo.certificate import Certificate, certify
from lpo.drifts import ClipDrift, DPODrift, Drift, LearnedDrift, NoDrift
from lpo.objectives import load_objective

GRID = {"num_ratios": 61, "num_advantages": 11}


@dataclass(frozen=True)
class Formula(Drift):
    """A drift by formula: (log ratio, advantage, progress) -> penalty."""

    temporal = True

    formula: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]

    def init(self, key: jax.Array, scale: float = 1.0) -> Any:
        return ()

    def __call__(self, parameters, log_ratio, advantage, progress):
        return self.formula(log_ratio, advantage, progress)


def certificate(formula: Callable[..., jax.Array]) -> Certificate:
    return certify(Formula(formula), (), **GRID)


def quadratic(x, a, p):
    """(r - 1)^2."""
    return jnp.expm1(x) ** 2


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("base", ["ppo", "none"])
@pytest.mark.parametrize("gate", [0.0, 0.1])
def test_a_learned_drift_is_a_drift_whatever_its_weights(base, scale, gate):
    drift = LearnedDrift(base=base, hidden_size=4, gate=gate)
    parameters = jax.tree.map(lambda x: scale * x, drift.init(jax.random.key(1)))
    found = certify(drift, parameters, **GRID)
    assert found.holds
    assert found.slope_at_0_01 > 0.0  # these weights charge something


@pytest.mark.parametrize("drift", [ClipDrift(), DPODrift(), NoDrift()])
def test_closed_forms_are_drifts(drift: Drift):
    found = certify(drift, drift.init(jax.random.key(0)), **GRID)
    assert found.holds
    assert str(found).startswith("is a drift: min f 0, at ratio 1 |f| 0 and |df/dr| 0")


def surrogate_of_kl(ratio, log_ratio, advantage):
    return ratio * advantage - 0.5 * (ratio * log_ratio - (ratio - 1))


def surrogate_of_reverse_kl(ratio, log_ratio, advantage):
    return ratio * advantage - 2.0 * (ratio - 1 - log_ratio)


@pytest.mark.parametrize(
    "surrogate",
    [surrogate_of_kl, surrogate_of_reverse_kl],
    ids=lambda f: f.__name__,
)
def test_what_32_bits_leave_of_a_surrogates_difference_is_no_gradient(surrogate):
    found = certify(load_objective(surrogate), num_ratios=101)
    assert found.holds and not found.stalls
    assert 0 < found.gradient_at_one < 1e-5 or found.minimum < 0  # which exact zeros would refuse


@pytest.mark.parametrize("paid", [1e-4, 0.01])
def test_a_surrogate_that_pays_or_slopes_by_more_than_that_is_no_drift(paid):
    def pays(ratio, advantage):
        return ratio * advantage - 0.5 * (ratio - 1) ** 2 + paid

    def slopes(ratio, advantage):
        return ratio * advantage - 0.5 * (ratio - 1) ** 2 - paid * (ratio - 1)

    assert not certify(load_objective(pays), **GRID).holds
    assert not certify(load_objective(slopes), **GRID).holds


def test_a_bias_is_no_drift():
    found = certificate(lambda x, a, p: quadratic(x, a, p) + 0.25)
    assert not found.holds
    assert found.value_at_one == 0.25
    assert found.minimum == 0.25  # reached at r = 1, which is on the grid
    assert found.gradient_at_one == 0.0
    assert str(found).startswith("is NOT a drift: min f 0.25")


def test_a_linear_term_is_no_drift():
    # f = r - 1 for r >= 1, else 0: non-negative and zero at 1, but it leaves 1 with slope 1.
    found = certificate(lambda x, a, p: jnp.where(x >= 0, jnp.expm1(x), 0.0))
    assert not found.holds
    assert (found.minimum, found.value_at_one) == (0.0, 0.0)
    assert found.gradient_at_one == 1.0


def test_a_drift_that_pays_somewhere_is_none():
    # (r - 1)^2 (1 - (r - 1) / 10) is negative beyond r = 11, at log r = 2.4 of a grid to 3.
    found = certificate(lambda x, a, p: quadratic(x, a, p) * (1.0 - 0.1 * jnp.expm1(x)))
    assert not found.holds
    assert found.minimum < 0.0
    assert (found.value_at_one, found.gradient_at_one, found.finite) == (0.0, 0.0, True)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
def test_a_drift_that_is_not_finite_far_out_is_none(bad):
    # Far out is log r in (15, 20], where a policy can get that moved far in one batch.
    found = certificate(lambda x, a, p: jnp.where(x > 15.0, bad, quadratic(x, a, p)))
    assert not found.holds
    assert not found.finite
    assert (found.minimum, found.value_at_one, found.gradient_at_one) == (0.0, 0.0, 0.0)
    assert str(found).startswith("is NOT a drift, and no number on a part of the grid")


def test_a_bias_of_one_advantage_only_is_found():
    found = certificate(lambda x, a, p: jnp.where(a >= 10.0, 0.5, 0.0) * jnp.ones_like(x))
    assert not found.holds
    assert found.value_at_one == 0.5


@pytest.mark.parametrize(("begin", "end"), [(0.2, 0.3), (0.999, 1.0)])
def test_a_bias_of_a_part_of_the_training_is_found(begin, end):
    found = certificate(
        lambda x, a, p: jnp.where((begin <= p) & (p <= end), 0.5, 0.0) * jnp.ones_like(x)
    )
    assert not found.holds
    assert found.value_at_one == 0.5


def test_a_gradient_that_is_not_a_number_late_in_training_is_found():
    # sqrt(x^2) has no derivative at 0: autodiff multiplies infinity by zero.
    def formula(x, a, p):
        return jax.lax.cond(p[0] > 0.0, lambda x: jnp.sqrt(x**2), jnp.zeros_like, x)

    found = certificate(formula)
    assert not found.holds
    assert found.gradient_at_one != found.gradient_at_one


@pytest.mark.parametrize(
    ("formula", "near", "further"),
    [
        # (r - 1)^2 has slope 2 |r - 1|.
        (quadratic, 0.002, 0.02),
        # relu(|log r| - 0.005): flat at 0.001; slope 1 / r outside, at most 1 / 0.99 = 1.0101.
        (lambda x, a, p: jax.nn.relu(jnp.abs(x) - 0.005), 0.0, 1.0101),
        # |A| (r - 1)^2 with advantages up to 10 is ten times the first.
        (lambda x, a, p: jnp.abs(a) * quadratic(x, a, p), 0.02, 0.2),
        # |r - 1| has a kink at 1 where autodiff says 0: its slope beside 1 tells.
        (lambda x, a, p: jnp.abs(jnp.expm1(x)), 1.0, 1.0),
    ],
)
def test_slopes_beside_ratio_one_are_those_of_the_formula(formula, near, further):
    found = certificate(formula)
    assert found.slope_at_0_001 == pytest.approx(near, rel=1e-3)
    assert found.slope_at_0_01 == pytest.approx(further, rel=1e-3)


def test_slope_of_a_clip_between_the_two_points():
    # Clip 0.005 charges from |r - 1| = 0.005 on, with slope |A|, which is at most 10.
    found = certify(ClipDrift(), jnp.float32(0.005), **GRID)
    assert (found.slope_at_0_001, found.slope_at_0_01) == (0.0, 10.0)


def test_parameters_of_another_drift_are_told():
    assert lpo.UserError is scb.UserError
    clip, dpo = load_objective("ppo"), load_objective("dpo")
    for drift, parameters in ((dpo.drift, clip.parameters), (clip.drift, dpo.parameters)):
        with pytest.raises(
            lpo.UserError, match="the drift cannot take these parameters: it takes those of its own"
        ):
            certify(drift, parameters, **GRID)


@pytest.mark.parametrize("points", ["num_ratios", "num_advantages"])
@pytest.mark.parametrize("number", [1, 0, -3, 2.5])
def test_a_grid_has_at_least_three_points(points, number, one_sentence):
    with pytest.raises(lpo.UserError, match=f"{points} is {number}: it must be") as error:
        certify(load_objective("ppo"), **{points: number})
    one_sentence(str(error.value))


def test_a_certificate_says_on_which_grid():
    # 61 log-ratios in [-3, 3] and 61 // 4 = 15 in [-20, 20], which share 0: 75.
    found = certificate(quadratic)
    expected = "75 log-ratios in [-20, 20] x 11 advantages in [-10, 10] x 21 training fractions"
    assert found.grid == expected
    assert found.as_dict()["grid"] == expected
    assert Certificate(**found.as_dict()) == found


def test_the_kink_is_the_rise_of_the_penalty_around_ratio_one():
    class Absolute(Drift):
        """Half of |log r|, for every advantage."""

        def init(self, key, scale=1.0):
            return jnp.zeros(())

        def __call__(self, parameters, log_ratio, advantage, progress):
            return 0.5 * jnp.abs(log_ratio)

    # d/dr of 0.5 |log r| is 0.5 / r: 0.495 to the right of 1, -0.505 to the left, half of 1.00 in the mean.
    assert certify(Absolute(), jnp.zeros(()), **GRID).kink == pytest.approx(0.5, rel=1e-3)
    for name in ("ppo", "dpo", "none"):
        objective = load_objective(name)
        found = certify(objective.drift, objective.parameters, **GRID)
        assert found.kink == pytest.approx(0.0, abs=1e-3)


def test_the_kink_is_over_normal_advantages_and_the_largest_of_the_training():
    # The mean of |A| is sqrt(2 / pi) = 0.798; the grid has eleven advantages.
    found = certify(Formula(lambda x, a, p: 0.1 * jnp.abs(a * x)), (), num_advantages=401)
    assert found.kink == pytest.approx(0.0798, rel=1e-2)
    early = certificate(lambda x, a, p: jnp.where(p < 0.1, 0.5 * jnp.abs(x), 0.0))
    assert early.kink == pytest.approx(0.5, rel=1e-2)
    assert early.slope_at_0_01 == pytest.approx(0.5 / 0.99, rel=1e-3)


@pytest.mark.parametrize(
    ("formula", "stalls"),
    [
        (lambda x, a, p: 0.1 * jnp.abs(x), True),
        # Whatever rises smoothly beside it, and where advantages are large more than it.
        (lambda x, a, p: 0.1 * jnp.abs(x) + 5 * a * a * jnp.expm1(x) ** 2, True),
        (lambda x, a, p: 0.02 * jnp.abs(x), False),
        (lambda x, a, p: 30 * jnp.expm1(x) ** 2, False),  # steep, and smooth
        # At the end alone, and smooth before.
        (lambda x, a, p: jnp.where(p > 0.9, 0.1 * jnp.abs(x), 60 * jnp.expm1(x) ** 2), True),
        (lambda x, a, p: jax.nn.relu(jnp.abs(x) - 0.005), False),
    ],
)
def test_what_rises_right_at_ratio_one_may_hold_a_policy_still(formula, stalls):
    found = certificate(formula)
    assert found.stalls == stalls
    # As stored before that was measured, it is judged by what is further out, which cannot tell.
    assert replace(found, kink_at_one=None).stalls == (found.kink > 0.03)


def test_a_gate_takes_the_kink_from_any_weights():
    drift = LearnedDrift(hidden_size=16, gate=0.0)
    weights = jax.tree.map(lambda w: 3.0 * w, drift.init(jax.random.key(1)))
    plain, gated = (certify(replace(drift, gate=g), weights, **GRID) for g in (0.0, 0.1))
    assert plain.kink > 0.1
    assert gated.kink < 0.03 * plain.kink + 1e-3
    # Both are drifts, as any weights are: what tells them apart is what is judged.
    assert plain.holds and plain.by_construction and gated.holds and gated.by_construction
    assert plain.stalls and not gated.stalls
    assert str(plain).startswith(
        "is a drift whatever its weights, but one that MAY HOLD A POLICY STILL, with a kink above 0.03"
    )
    assert str(gated).startswith("is a drift whatever its weights: min f 0")
    assert f"and {plain.kink_at_one:.3g} carried on to ratio 1" in str(plain)


@pytest.mark.parametrize(
    ("formula", "stalls"),
    [
        # KL, ten times: as steep at 0.01 as |log r| / 10, but not at 0.001.
        (lambda x, a, p: 10.0 * (jnp.exp(x) * x - jnp.expm1(x)), False),
        (lambda x, a, p: 0.1 * jnp.abs(x), True),
        # Less than what a thousand advantages correlate with anything by chance, 1 / sqrt(1000) = 0.03.
        (lambda x, a, p: 0.02 * jnp.abs(x), False),
        # A narrow clip begins beyond 0.001.
        (lambda x, a, p: jax.nn.relu(jnp.abs(x) - 0.005), False),
    ],
)
def test_a_drift_stalls_where_its_penalty_rises_right_at_ratio_one(formula, stalls):
    found = certificate(formula)
    assert found.stalls == stalls
    assert not found.by_construction
