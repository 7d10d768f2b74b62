"""What PPO's clip, DPO and any learned network charge, and what a drift must never charge."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lpo.certificate import certify
from lpo.drifts import DRIFTS, ClipDrift, DPODrift, Drift, LearnedDrift, drift_from_config
from lpo.drifts.contract import BASES
from lpo.drifts.network import FEATURES, drift_features
from scb.agents.drift import MAX_LOG_RATIO
from scb.errors import UserError

EXPRESSION = "0.5*A*d - tanh(2*log_r)"
MEMBERS = {
    name: drift(EXPRESSION) if name == "formula" else drift() for name, drift in DRIFTS.items()
}
HIDDEN = 4
LEARNED = {base: LearnedDrift(base=base, hidden_size=HIDDEN) for base in BASES}
KEY = jax.random.key(0)

# -3 to 3 nats are ratios of 0.05 to 20; a normalised advantage seldom leaves [-10, 10].
log_ratios = st.floats(-3.0, 3.0, width=32)
advantages = st.floats(-10.0, 10.0, width=32)


def batch(*numbers: float) -> jax.Array:
    return jnp.asarray(numbers, jnp.float32)


def penalty(drift: Drift, log_ratio: float, advantage: float) -> float:
    parameters = drift.init(KEY)
    return float(drift(parameters, batch(log_ratio), batch(advantage), batch(0.5))[0])


@jax.jit
def clip_penalty(clip: jax.Array, log_ratio: jax.Array, advantage: jax.Array) -> jax.Array:
    return ClipDrift()(clip, log_ratio, advantage, jnp.zeros_like(log_ratio))


# -- PPO's clip ---------------------------------------------------------------------------------


@settings(deadline=None)
@given(log_ratio=log_ratios, advantage=advantages, clip=st.floats(0.01, 0.9))
@example(log_ratio=0.0, advantage=1.0, clip=0.2)
def test_ratio_times_advantage_minus_clip_drift_is_ppos_minimum(log_ratio, advantage, clip):
    drift = float(clip_penalty(batch(clip)[0], batch(log_ratio), batch(advantage))[0])
    ratio = np.exp(log_ratio)
    minimum = min(ratio * advantage, np.clip(ratio, 1 - clip, 1 + clip) * advantage)
    assert drift >= 0.0
    # |r A| is at most 20 * 10 = 200, which float32 knows to 200 * 2^-24 = 1e-5; a few such errors
    # add up.
    assert ratio * advantage - drift == pytest.approx(minimum, abs=1e-4)


def test_clip_drift_charges_what_lies_outside_the_interval():
    # r = e^0.5 = 1.648721, A = 2: (1.648721 - 1.2) * 2 = 0.897443; A = -2 makes it negative, so 0.
    # r = e^-0.5 = 0.606531, A = -2: (0.606531 - 0.8) * -2 = 0.386939.
    assert penalty(ClipDrift(0.2), 0.5, 2.0) == pytest.approx(0.897443, abs=1e-5)
    assert penalty(ClipDrift(0.2), 0.5, -2.0) == 0.0
    assert penalty(ClipDrift(0.2), -0.5, -2.0) == pytest.approx(0.386939, abs=1e-5)


# -- DPO ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("log_ratio", "advantage", "expected"),
    [
        # A >= 0 takes x = (r - 1) A and relu(x - 2 tanh(x / 2)).
        # r = e, A = 1: x = 1.718282, tanh(0.859141) = 0.695815; 1.718282 - 1.391630 = 0.326652.
        (1.0, 1.0, 0.326652),
        # r = 3, A = 2: x = 4, tanh(2) = 0.964028; 4 - 1.928055 = 2.071945.
        (np.log(3.0), 2.0, 2.071945),
        # r = 1/e, A = 2: x = -1.264241, where x - 2 tanh(x / 2) is negative, so 0.
        (-1.0, 2.0, 0.0),
        # A < 0 takes x = A log r and relu(x - 0.6 tanh(x / 0.6)).
        # r = 1/e, A = -1: x = 1, tanh(1.666667) = 0.931110; 1 - 0.558666 = 0.441334.
        (-1.0, -1.0, 0.441334),
        # r = e, A = -1: x = -1, where x - 0.6 tanh(x / 0.6) is negative, so 0.
        (1.0, -1.0, 0.0),
        # Ratio 1 is free on either side.
        (0.0, 5.0, 0.0),
        (0.0, -5.0, 0.0),
    ],
)
def test_dpo_is_its_closed_form(log_ratio, advantage, expected):
    assert penalty(DPODrift(), log_ratio, advantage) == pytest.approx(expected, abs=2e-6)


@jax.jit
def dpo_penalty(log_ratio: jax.Array, advantage: jax.Array) -> jax.Array:
    drift = DPODrift()
    return drift(drift.init(KEY), log_ratio, advantage, jnp.zeros_like(log_ratio))


@settings(deadline=None)
@given(log_ratio=st.floats(-MAX_LOG_RATIO, MAX_LOG_RATIO, width=32), advantage=advantages)
def test_dpo_never_pays(log_ratio, advantage):
    value = float(dpo_penalty(batch(log_ratio), batch(advantage))[0])
    assert 0.0 <= value < np.inf


# -- the learned drift --------------------------------------------------------------------------


def test_features_are_those_of_the_list_in_its_order():
    # r = 2, A = 3: 1 - r = -1 and log r = 0.693147, whose square is 0.480453; times 3: 2.079442
    # and 1.441359.
    expected = {
        "1-r": -1.0,
        "(1-r)^2": 1.0,
        "log r": 0.693147,
        "(log r)^2": 0.480453,
        "A(1-r)": -3.0,
        "A(1-r)^2": 3.0,
        "A log r": 2.079442,
        "A(log r)^2": 1.441359,
    }
    computed = drift_features(batch(np.log(2.0)), batch(3.0))
    assert computed.shape == (1, len(FEATURES))
    named = dict(zip(FEATURES, np.asarray(computed[0]).tolist(), strict=True))
    assert named == pytest.approx(expected, abs=1e-5)


def test_a_network_by_hand_charges_beyond_xi_and_nothing_within():
    # One unit that sees log r alone: f = relu(tanh(log r) - xi), xi = 0.01.
    drift = LearnedDrift(base="none", hidden_size=1, xi=0.01, gate=0.0)
    seen = jnp.zeros((len(FEATURES), 1)).at[FEATURES.index("log r"), 0].set(1.0)
    parameters = {"hidden": seen, "output": jnp.ones((1, 1))}
    charged = drift(parameters, batch(0.1, 0.005, -0.1), batch(1, 1, 1), batch(0, 0, 0))
    # tanh(0.1) = 0.099668; tanh(0.005) < 0.01; tanh(-0.1) < 0.
    np.testing.assert_allclose(charged, [0.089668, 0.0, 0.0], atol=1e-6)


def random_weights(seed: int, scale: float) -> dict[str, jax.Array]:
    rng = np.random.default_rng(seed)
    shapes = LearnedDrift(hidden_size=HIDDEN).shapes()
    return {
        name: jnp.asarray(scale * rng.normal(size=shape), jnp.float32)
        for name, shape in shapes.items()
    }


@jax.jit
def learned(parameters, log_ratio, advantage):
    """Penalty and its derivative with respect to log r, of either base, at one point."""

    def at(drift, log_ratio):
        return drift(parameters, log_ratio[None], advantage[None], jnp.zeros(1))[0]

    return {
        base: jax.value_and_grad(lambda x, drift=drift: at(drift, x))(log_ratio)
        for base, drift in LEARNED.items()
    }


weights = st.builds(
    random_weights, st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.1, 1.0, 100.0])
)


@settings(deadline=None)
@given(
    parameters=weights,
    log_ratio=st.floats(-MAX_LOG_RATIO, MAX_LOG_RATIO, width=32),
    advantage=advantages,
)
@example(parameters=random_weights(0, 100.0), log_ratio=MAX_LOG_RATIO, advantage=10.0)
@example(parameters=random_weights(0, 100.0), log_ratio=-MAX_LOG_RATIO, advantage=-10.0)
def test_any_weights_give_a_finite_penalty_that_is_never_negative(parameters, log_ratio, advantage):
    for value, slope in learned(parameters, np.float32(log_ratio), np.float32(advantage)).values():
        assert 0.0 <= float(value) < np.inf
        assert np.isfinite(float(slope))


@settings(deadline=None)
@given(parameters=weights, advantage=advantages)
def test_any_weights_give_value_and_slope_zero_at_ratio_one(parameters, advantage):
    for value, slope in learned(parameters, np.float32(0.0), np.float32(advantage)).values():
        assert float(value) == 0.0
        assert float(slope) == 0.0


def test_some_weights_charge_for_moving_away():
    # Or else the properties above would hold of a drift that is always zero.
    point = (np.float32(0.5), np.float32(1.0))
    charges = [learned(random_weights(seed, 1.0), *point)["none"][0] for seed in range(10)]
    assert 0 < np.count_nonzero(charges) < 10


@settings(deadline=None)
@given(log_ratio=log_ratios, advantage=advantages, seed=st.integers(0, 2**32 - 1))
def test_zero_output_weights_are_the_base_within_xi(log_ratio, advantage, seed):
    parameters = random_weights(seed, 1.0)
    parameters["output"] = jnp.zeros_like(parameters["output"])
    outcome = learned(parameters, np.float32(log_ratio), np.float32(advantage))
    clip = float(clip_penalty(batch(0.2)[0], batch(log_ratio), batch(advantage))[0])
    # xi is 1e-6; at 200 float32 is 2e-5 coarse.
    assert float(outcome["ppo"][0]) == pytest.approx(clip, rel=1e-6, abs=2e-6)
    dpo = float(DPODrift()(DPODrift().init(KEY), batch(log_ratio), batch(advantage), batch(0.0))[0])
    assert float(outcome["dpo"][0]) == pytest.approx(dpo, rel=1e-6, abs=2e-6)
    assert float(outcome["none"][0]) == 0.0


def test_negated_weights_are_the_same_drift():
    # tanh(-x) * -w = tanh(x) * w.
    parameters = random_weights(1, 1.0)
    negated = jax.tree.map(lambda x: -x, parameters)
    points = drift_grid()
    for drift in LEARNED.values():
        np.testing.assert_array_equal(drift(parameters, *points), drift(negated, *points))


def test_antithetic_candidates_tie_around_zero_weights_but_not_around_init():
    # An evolution strategy that samples mean + e and mean - e would learn nothing from a tie.
    drift = LEARNED["ppo"]
    start = drift.init(KEY)
    noise = random_weights(2, 0.5)
    points = drift_grid()

    def pair(mean):
        return [
            np.asarray(drift(jax.tree.map(lambda m, e, s=s: m + s * e, mean, noise), *points))
            for s in (1.0, -1.0)
        ]

    np.testing.assert_array_equal(*pair(jax.tree.map(jnp.zeros_like, start)))
    plus, minus = pair(start)
    assert np.abs(plus - minus).max() > 0.01


@pytest.mark.parametrize("base", BASES)
def test_init_is_random_and_nowhere_zero(base):
    drift = LEARNED[base]
    first, second = drift.init(jax.random.key(0)), drift.init(jax.random.key(1))
    assert {name: w.shape for name, w in first.items()} == drift.shapes()
    for name in first:
        assert np.all(np.asarray(first[name]) != 0.0)
        assert np.any(np.asarray(first[name]) != np.asarray(second[name]))


def drift_grid() -> tuple[jax.Array, jax.Array, jax.Array]:
    log_ratio, advantage = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-3, 3, 7))
    flat = jnp.asarray(log_ratio.ravel(), jnp.float32), jnp.asarray(advantage.ravel(), jnp.float32)
    return (*flat, jnp.zeros(flat[0].size))


# -- one contract -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MEMBERS)
def test_every_registered_drift_keeps_the_contract(name):
    drift = MEMBERS[name]
    assert drift.name == name
    assert hash(drift) == hash(type(drift)(**vars(drift)))  # static: equal drifts share a program
    values = drift(drift.init(KEY), *drift_grid())
    assert values.shape == (63,)
    assert values.dtype == jnp.float32


@pytest.mark.parametrize("name", MEMBERS)
def test_every_registered_drift_comes_back_from_its_description(name):
    described = json.loads(json.dumps(MEMBERS[name].to_config()))
    assert drift_from_config(described) == MEMBERS[name]
    with pytest.raises(UserError, match=f"unknown drift '{name}s': did you mean {name}"):
        drift_from_config({**described, "family": f"{name}s"})


@pytest.mark.parametrize("name", [name for name, drift in MEMBERS.items() if drift.learned])
def test_the_scale_of_a_learned_drifts_start_brings_it_towards_what_it_starts_from(name):
    drift = MEMBERS[name]
    points = drift_grid()
    known = drift(drift.init(KEY, 0.0), *points)
    away = [float(jnp.abs(drift(drift.init(KEY, s), *points) - known).max()) for s in (0.1, 1.0)]
    assert 0.0 < away[0] < away[1]


@pytest.mark.parametrize("name", MEMBERS)
def test_every_registered_drift_is_one_formula_in_numpy_and_pytorch_too(name):
    torch = pytest.importorskip("torch")
    drift = MEMBERS[name]
    parameters, points = drift.init(KEY), [np.asarray(x) for x in drift_grid()]
    expected = drift(parameters, *drift_grid())
    parameters = jax.tree.map(np.array, parameters)
    in_numpy = drift(parameters, *points, np)
    in_torch = drift(
        jax.tree.map(torch.asarray, parameters), *(torch.tensor(x) for x in points), torch
    )
    for found in (in_numpy, in_torch.numpy()):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MEMBERS)
@pytest.mark.parametrize("position", [0, 1, 2])
def test_a_column_beside_rows_is_an_error(name, position):
    # [B, 1] and [B] would broadcast to [B, B], and the mean over that trains something else.
    arguments = [batch(0.1, 0.2, 0.3)] * 3
    arguments[position] = arguments[position][:, None]
    drift = MEMBERS[name]
    with pytest.raises(AssertionError, match="shape"):
        drift(drift.init(KEY), *arguments)


# -- bad input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make_drift", "message"),
    [
        (lambda: ClipDrift(0.0), "clip is 0.0: it must be positive, and finite."),
        (lambda: ClipDrift(float("nan")), "clip is nan"),
        (lambda: DPODrift(alpha=-1.0), "alpha is -1.0: it must be positive"),
        (lambda: LearnedDrift(base="ppo2"), "unknown drift base 'ppo2': did you mean ppo"),
        (lambda: LearnedDrift(hidden_size=0), "hidden_size is 0: it must be at least 1."),
        (lambda: LearnedDrift(xi=0.0), "xi is 0.0: it must be positive, and finite."),
        (lambda: LearnedDrift(xi=float("inf")), "xi is inf: it must be positive, and finite."),
        (lambda: LearnedDrift(gate=-0.1), "gate is -0.1: it must be 0 or larger, and finite."),
    ],
)
def test_a_drift_refuses_numbers_that_make_none(make_drift, message):
    with pytest.raises(UserError) as error:
        make_drift()
    assert message in str(error.value)


# -- temporal awareness ---------------------------------------------------------------------------


def test_a_temporal_drift_is_another_one_at_another_fraction_of_training(batch_of_ratios):
    log_ratio, advantage = batch_of_ratios
    drift = LearnedDrift(base="none", hidden_size=HIDDEN, temporal=True)
    assert len(drift.features) == 16
    weights = drift.init(jax.random.key(0))
    assert weights["hidden"].shape == (16, HIDDEN)
    plain = LearnedDrift(base="none", hidden_size=HIDDEN)
    first, second = weights["hidden"][:8], weights["hidden"][8:]
    for fraction in (0.0, 0.25, 1.0):
        # (x, f x) [W1; W2] = x (W1 + f W2): a plain drift whose weights move with training.
        moved = {"hidden": first + fraction * second, "output": weights["output"]}
        progress = jnp.full_like(log_ratio, fraction)
        np.testing.assert_allclose(
            drift(weights, log_ratio, advantage, progress),
            plain(moved, log_ratio, advantage, progress),
            rtol=1e-4,
            atol=1e-5,
        )
    early, late = (
        drift(weights, log_ratio, advantage, jnp.full_like(log_ratio, f)) for f in (0.0, 1.0)
    )
    assert float(jnp.abs(early - late).max()) > 0.01


def test_a_temporal_drift_is_certified():
    drift = LearnedDrift(hidden_size=HIDDEN, temporal=True)
    assert certify(drift, drift.init(jax.random.key(0)), 51, 11).holds


@pytest.fixture
def batch_of_ratios():
    key_ratio, key_advantage = jax.random.split(jax.random.key(5))
    return jax.random.normal(key_ratio, (64,)), 2.0 * jax.random.normal(key_advantage, (64,))


def test_a_gate_fades_the_network_out_around_ratio_one_and_leaves_it_elsewhere():
    gated = LearnedDrift(base="none", hidden_size=HIDDEN, gate=0.1)
    open_ = replace(gated, gate=0.0)
    weights = jax.tree.map(lambda w: 3.0 * w, gated.init(jax.random.key(2)))
    advantage, progress = jnp.full(5, -1.5), jnp.zeros(5)
    x = jnp.asarray([-0.5, -0.1, 0.0, 0.1, 0.5])
    with_gate, without = (d(weights, x, advantage, progress) for d in (gated, open_))
    # 1 - e^-1 at one width, 1 - e^-25 at five; xi = 1e-6 is subtracted after it.
    factor = jnp.asarray([1.0, 0.6321206, 0.0, 0.6321206, 1.0])
    assert float(without.max()) > 0.01
    np.testing.assert_allclose(with_gate, factor * without, atol=2e-6)
