"""Drifts in NumPy and PyTorch are those of the contract, and the example trains with them."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpo.drifts import ClosedFormDrift, LearnedDrift, MirrorDrift
from lpo.drifts.contract import BASES
from lpo.objectives import KNOWN, Objective, load_objective, zoo_names
from lpo.portable import (
    _policy_loss,
    drift_function,
    loss_function,
    numpy_drift,
    torch_drift,
    torch_loss,
)
from scb.agents.drift import MAX_LOG_RATIO
from scb.errors import UserError

ROOT = Path(__file__).parents[2]


def random_objective(base: str, temporal: bool) -> Objective:
    """A learned drift of random weights, three times the usual size so that it charges on many points."""
    # One of the two families with a gate, and one without.
    drift = LearnedDrift(base=base, hidden_size=8, temporal=temporal, gate=0.2 * temporal)
    parameters = jax.tree.map(lambda w: 3 * w, drift.init(jax.random.key(5)))
    return Objective(f"learned-{base}{'-temporal' if temporal else ''}", drift, parameters)


def mirror() -> Objective:
    drift = MirrorDrift(hidden_size=8)
    return Objective("mirror", drift, drift.init(jax.random.key(5)))


def formula(base: str, expression: str) -> Objective:
    drift = ClosedFormDrift(expression, base=base, gate=0.3 if base == "ppo" else 0.0)
    return Objective(f"formula-{base}", drift, drift.init(jax.random.key(0)))


OBJECTIVES = [load_objective(name) for name in [*KNOWN, *zoo_names(), "ppo-0.3"]] + [
    random_objective(base, temporal) for base in BASES for temporal in (False, True)
]
OBJECTIVES += [
    mirror(),
    formula("ppo", "0.3*A*tanh(d) - 0.2*relu(1.5*A*log_r)"),
    formula("none", "abs(d)*(0.7 - progress) + A*log_r*tanh(-2*A*d)"),
]
every_objective = pytest.mark.parametrize("objective", OBJECTIVES, ids=lambda o: o.name)


def points(largest_log_ratio: float, size: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[size] log-ratios, advantages and fractions of training; drawn, so on no kink."""
    rng = np.random.default_rng(2)
    log_ratio = rng.uniform(-largest_log_ratio, largest_log_ratio, size)
    return log_ratio, rng.normal(scale=2.0, size=size), rng.uniform(size=size)


def contract(objective: Objective, log_ratio, advantage, progress) -> jax.Array:
    """The drift itself on log-ratios clipped as in training."""
    clipped = jnp.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO)
    return objective.drift(objective.parameters, clipped, advantage, progress)


def contract_slope(objective: Objective, log_ratio, advantage, progress) -> jax.Array:
    """[B] derivative of the penalty with respect to the log-ratio."""
    return jax.grad(lambda x: contract(objective, x, advantage, progress).sum())(log_ratio)


def minimised(objective: Objective, log_ratio, advantage, progress) -> tuple[jax.Array, jax.Array]:
    """The policy loss of training, with log-ratios clipped as there, and its slope."""

    def loss(log_ratio):
        penalty = contract(objective, log_ratio, advantage, progress)
        ratio = jnp.exp(jnp.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO))
        return -jnp.mean(ratio * advantage - penalty)

    return jax.value_and_grad(loss)(log_ratio)


# -- NumPy and JAX ------------------------------------------------------------------------------


def test_only_a_temporal_drift_asks_for_progress():
    change, advantage = np.linspace(-1.0, 1.0, 5), np.ones(5)
    for name in ("ppo", "lpo-pendulum"):
        drift = numpy_drift(name)
        np.testing.assert_array_equal(drift(change, advantage), drift(change, advantage, 0.3))
    with pytest.raises(UserError, match=r"this drift depends on the fraction .* give progress"):
        numpy_drift("ta-lpo")(change, advantage)


@every_objective
@pytest.mark.parametrize("largest_log_ratio", [0.5, 3.0, 30.0])
def test_numpy_and_jax_give_the_contracts_penalty(objective, largest_log_ratio):
    batch = [x.astype(np.float32) for x in points(largest_log_ratio)]
    expected = contract(objective, *map(jnp.asarray, batch))
    for drift in (numpy_drift(objective), drift_function(objective)):
        penalty = drift(*batch)
        assert penalty.dtype == np.float32
        np.testing.assert_allclose(penalty, expected, rtol=1e-5, atol=1e-5)


@every_objective
def test_a_single_ratio_has_a_penalty_and_a_slope(objective):
    change, advantage, progress = (jnp.float32(x[0]) for x in points(0.5, size=1))
    drift = drift_function(objective)
    assert numpy_drift(objective)(change, advantage, progress).shape == ()
    assert drift(change, advantage, progress).shape == ()
    slope = jax.grad(drift)(change, advantage, progress)
    each = jax.vmap(jax.grad(drift))(change[None], advantage[None], progress[None])
    np.testing.assert_allclose(each, slope[None], rtol=1e-5)


@every_objective
def test_a_batch_may_lie_on_several_devices(objective):
    batch = [x.astype(np.float32) for x in points(0.5, size=8 * jax.device_count())]
    mesh = jax.make_mesh((jax.device_count(),), ("batch",))
    spread = jax.device_put(batch, jax.NamedSharding(mesh, jax.P("batch")))
    drift = drift_function(objective)
    np.testing.assert_allclose(drift(*spread), drift(*batch), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        drift(*spread[:2], 0.5), drift(*batch[:2], 0.5), rtol=1e-5, atol=1e-6
    )


@every_objective
def test_a_far_ratio_costs_what_the_farthest_that_training_meets_costs(objective):
    drift = numpy_drift(objective)
    far, bound = np.float32([100.0, -100.0]), np.float32([MAX_LOG_RATIO, -MAX_LOG_RATIO])
    advantage = np.float32([1.5, -1.5])
    assert np.isfinite(drift(far, advantage, 0.5)).all()
    np.testing.assert_array_equal(drift(far, advantage, 0.5), drift(bound, advantage, 0.5))


def test_a_progress_in_per_cent_is_told():
    with pytest.raises(UserError, match=r"progress is 50: it is the fraction of training done"):
        numpy_drift("ta-lpo")([0.1], [1.0], 50)


@pytest.mark.parametrize(
    "progress",
    [50.0, np.float32(50), np.array(-0.1), [0.5, 0.5, np.nan], "0.5", ["0.5"] * 3, 0.5j],
)
@pytest.mark.parametrize("make", [numpy_drift, drift_function, loss_function])
def test_no_progress_outside_of_0_and_1_is_taken(make, progress, one_sentence):
    with pytest.raises(UserError, match=r"the fraction of training done, in \[0, 1\]") as error:
        make("ta-lpo")(np.zeros(3), np.ones(3), progress)
    one_sentence(str(error.value))


@pytest.mark.parametrize("make", [numpy_drift, drift_function])
def test_a_progress_is_one_or_one_for_each(make, one_sentence):
    each = make("ta-lpo")(np.full(3, 0.3), np.ones(3), np.array([0.0, 0.5, 1.0]))
    ones = [make("ta-lpo")(np.full(1, 0.3), np.ones(1), p)[0] for p in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(each, ones, rtol=1e-5)
    with pytest.raises(UserError, match=r"progress has shape \(4,\) and log_ratio \(3,\)") as error:
        make("ta-lpo")(np.zeros(3), np.ones(3), np.zeros(4))
    one_sentence(str(error.value))


def test_numpy_computes_in_the_precision_that_it_is_given():
    drift, x = numpy_drift("lpo-pendulum"), np.linspace(-1.0, 1.0, 5)
    assert drift(x, np.ones(5)).dtype == drift([0.1], [1]).dtype == np.float64
    assert drift(x.astype(np.float32), np.ones(5, np.float32)).dtype == np.float32


def test_the_policy_loss_is_what_a_drift_takes_from_the_surrogate():
    # Ratios 2 and exp(20), which is as far as training goes: (0.5 - 2 x 3 + 0.25 + exp(20)) / 2.
    log_ratio, advantage = np.array([np.log(2.0), 30.0]), np.array([3.0, -1.0])
    loss = _policy_loss(np, np.array([0.5, 0.25]), log_ratio, advantage)
    assert loss == pytest.approx((0.5 - 6.0 + 0.25 + np.exp(20.0)) / 2)


@every_objective
def test_one_progress_holds_for_the_whole_batch(objective):
    log_ratio, advantage, _ = points(1.0)
    for drift in (numpy_drift(objective), drift_function(objective)):
        whole = drift(log_ratio, advantage, np.full_like(log_ratio, 0.25))
        np.testing.assert_array_equal(drift(log_ratio, advantage, 0.25), whole)


def test_only_a_temporal_drift_changes_with_progress():
    log_ratio, advantage, _ = points(1.0)
    changes = {}
    for objective in OBJECTIVES:
        drift = numpy_drift(objective)
        early, late = drift(log_ratio, advantage, 0.0), drift(log_ratio, advantage, 1.0)
        changes[objective.name] = bool(np.any(early != late))
    assert {name for name, changed in changes.items() if changed} == {
        *(f"learned-{base}-temporal" for base in BASES),
        "formula-none",
        "ta-lpo",
    }


def test_lists_numbers_and_any_shape_will_do():
    # PPO's clip 0.2, r = e^0.5 = 1.648721, A = 2: (1.648721 - 1.2) * 2 = 0.897443.
    for make in (numpy_drift, drift_function):
        drift = make("ppo")
        assert float(drift(0.5, 2, 0)) == pytest.approx(0.897443, abs=1e-6)
        np.testing.assert_allclose(drift([[0.5], [0.5]], [[2], [0]], 0), [[0.897443], [0]], 1e-6)
        learned = make("lpo-pendulum")
        flat = learned(np.linspace(-1, 1, 6), np.ones(6), 0.5)
        square = learned(np.linspace(-1, 1, 6).reshape(2, 3), np.ones((2, 3)), 0.5)
        np.testing.assert_allclose(square.ravel(), flat, rtol=1e-5)


def test_a_function_for_jax_is_differentiated_and_compiled():
    drift = drift_function("lpo-pendulum")
    slope = jax.jit(jax.grad(lambda log_ratio: drift(log_ratio, 2.0, 0.0)))
    assert float(slope(0.0)) == 0.0
    assert float(slope(0.5)) > 0.0
    assert float(slope(25.0)) == 0.0  # beyond the clip


@pytest.mark.parametrize("make", [numpy_drift, drift_function, loss_function])
def test_shapes_that_would_broadcast_are_refused(make, one_sentence):
    with pytest.raises(UserError) as error:
        make("ppo")(np.zeros((5, 1)), np.zeros(5), 0.0)
    message = one_sentence(str(error.value))
    assert "(5, 1)" in message and "(5,)" in message


def test_what_is_no_number_is_refused(one_sentence):
    for function in (numpy_drift, drift_function):
        with pytest.raises(UserError) as caught:
            function("dpo")(0.0, "b")
        assert "advantage is 'b', which is no array of numbers" in one_sentence(str(caught.value))
    with pytest.raises(UserError, match="log_ratio is array"):
        numpy_drift("dpo")(np.array(["a"]), np.zeros(1))


@pytest.mark.parametrize("make", [numpy_drift, drift_function, loss_function])
def test_an_unknown_name_is_refused_as_everywhere(make):
    with pytest.raises(UserError, match="unknown objective 'dppo'"):
        make("dppo")


@every_objective
@pytest.mark.parametrize("largest_log_ratio", [2.0, 30.0])
def test_the_loss_for_jax_is_what_training_minimises(objective, largest_log_ratio):
    batch = [jnp.float32(x) for x in points(largest_log_ratio)]
    expected, expected_slope = minimised(objective, *batch)
    loss, slope = jax.jit(jax.value_and_grad(loss_function(objective)))(*batch)
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    scale = float(jnp.abs(expected_slope).max())
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-4, atol=1e-6 * max(scale, 1.0))


@pytest.mark.parametrize("objective", ["ppo", "dpo", "lpo-pendulum"])
def test_in_a_loss_for_jax_a_far_ratio_pulls_at_nothing(objective):
    far = jnp.float32([25.0, jnp.inf, -jnp.inf, 0.1])
    loss, slope = jax.value_and_grad(loss_function(objective))(far, jnp.ones(4))
    assert np.isfinite(loss) and np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[:3], 0.0)
    assert slope[3] < 0.0


def test_a_loss_takes_a_minibatch_of_one_or_more(one_sentence):
    with pytest.raises(UserError, match=r"shape \(0,\), which is of no actions") as error:
        loss_function("ppo")(jnp.zeros(0), jnp.zeros(0))
    one_sentence(str(error.value))
    assert drift_function("ppo")(jnp.zeros(0), jnp.zeros(0)).shape == (0,)


@pytest.mark.parametrize("made", [drift_function, loss_function, numpy_drift])
def test_what_a_user_holds_can_be_pickled(made):
    function = made("lpo-pendulum")
    again = pickle.loads(pickle.dumps(function))
    arguments = np.float32([0.1, -0.2]), np.float32([1.0, -1.0])
    np.testing.assert_array_equal(function(*arguments), again(*arguments))


def test_without_torch_one_sentence_says_what_to_install(monkeypatch, one_sentence):
    monkeypatch.setitem(sys.modules, "torch", None)
    for make in (torch_drift, torch_loss):
        with pytest.raises(UserError) as error:
            make("ppo")
        assert "extra `torch`" in one_sentence(str(error.value))


# -- PyTorch ------------------------------------------------------------------------------------


def in_torch(function, log_ratio, advantage, progress) -> tuple[np.ndarray, np.ndarray]:
    """Value and the derivative of its sum with respect to the log-ratio."""
    import torch

    leaf = torch.tensor(log_ratio, requires_grad=True)
    value = function(leaf, torch.tensor(advantage), progress)
    (slope,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach().numpy(), slope.numpy()


class TestTorch:
    @pytest.fixture(autouse=True)
    def torch(self):
        torch = pytest.importorskip("torch")
        torch.set_num_threads(1)
        return torch

    @every_objective
    @pytest.mark.parametrize("largest_log_ratio", [0.5, 3.0, 30.0])
    def test_penalty_is_the_contracts(self, objective, largest_log_ratio, torch):
        batch = [x.astype(np.float32) for x in points(largest_log_ratio)]
        expected = contract(objective, *map(jnp.asarray, batch))
        penalty = torch_drift(objective)(*map(torch.tensor, batch))
        assert penalty.dtype == torch.float32
        np.testing.assert_allclose(penalty, expected, rtol=1e-5, atol=1e-5)

    @every_objective
    def test_gradient_is_the_contracts(self, objective, torch):
        batch = [x.astype(np.float32) for x in points(1.0)]
        expected = contract_slope(objective, *map(jnp.asarray, batch))
        _, slope = in_torch(torch_drift(objective), *batch[:2], torch.tensor(batch[2]))
        # Slopes of up to 9 are sums over hidden units, which PyTorch adds in another order.
        np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-4)

    @every_objective
    def test_gradient_of_far_ratios_is_the_contracts_in_double_precision(self, objective, torch):
        # In single precision 1 - tanh^2 of a saturated unit is rounding error, times a feature of
        # up to e^40: neither library knows that slope.
        batch = points(30.0)
        with jax.enable_x64(True):
            expected = np.asarray(contract_slope(objective, *map(jnp.asarray, batch)))
        _, slope = in_torch(torch_drift(objective), *batch[:2], torch.tensor(batch[2]))
        # Slopes of up to 9 are sums over hidden units, which PyTorch adds in another order.
        np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-4)

    @every_objective
    def test_where_an_update_starts_nothing_is_charged(self, objective):
        # The first minibatch has ratio 1 everywhere, to the last bit.
        advantage = points(1.0)[1].astype(np.float32)
        value, slope = in_torch(torch_drift(objective), np.zeros_like(advantage), advantage, 0.5)
        np.testing.assert_array_equal(value, 0.0)
        np.testing.assert_array_equal(slope, 0.0)

    @every_objective
    def test_one_progress_holds_for_the_whole_batch(self, objective, torch):
        log_ratio, advantage, _ = points(1.0)
        drift = torch_drift(objective)
        whole, _ = in_torch(drift, log_ratio, advantage, torch.full((len(log_ratio),), 0.25))
        for progress in (0.25, np.float64(0.25), torch.tensor(0.25)):
            value, _ = in_torch(drift, log_ratio, advantage, progress)
            np.testing.assert_array_equal(value, whole)

    def test_loss_of_ppo_is_the_clipped_loss_that_it_replaces(self, torch):
        def clipped_loss(log_ratio, advantage, progress):
            ratio = log_ratio.exp()
            return torch.max(-advantage * ratio, -advantage * ratio.clamp(0.8, 1.2)).mean()

        log_ratio, advantage, _ = points(1.0)
        function = pickle.loads(pickle.dumps(torch_loss("ppo")))
        loss, slope = in_torch(function, log_ratio, advantage, 0.0)
        expected_loss, expected_slope = in_torch(clipped_loss, log_ratio, advantage, 0.0)
        np.testing.assert_allclose(loss, expected_loss, rtol=1e-6)
        np.testing.assert_allclose(slope, expected_slope, rtol=1e-6, atol=1e-9)

    @every_objective
    def test_loss_is_what_training_minimises(self, objective, torch):
        batch = [x.astype(np.float32) for x in points(2.0)]
        expected, expected_slope = minimised(objective, *map(jnp.asarray, batch))
        loss, slope = in_torch(torch_loss(objective), *batch[:2], torch.tensor(batch[2]))
        assert float(loss) == pytest.approx(float(expected), rel=1e-5)
        np.testing.assert_allclose(slope, expected_slope, rtol=1e-4, atol=1e-6)

    def test_a_log_ratio_beyond_the_bound_is_not_pulled(self):
        beyond = np.float32([30.0, -30.0])
        loss, slope = in_torch(torch_loss("none"), beyond, np.float32([1.0, 1.0]), 0.0)
        # -(e^20 + e^-20) / 2 = -242582597.7
        assert float(loss) == pytest.approx(-242582597.7, rel=1e-6)
        np.testing.assert_array_equal(slope, 0.0)

    def test_a_minibatch_is_of_one_or_more(self, torch, one_sentence):
        with pytest.raises(UserError, match=r"shape \(0,\), which is of no actions") as error:
            torch_loss("ppo")(torch.zeros(0), torch.zeros(0))
        one_sentence(str(error.value))

    def test_shapes_that_would_broadcast_are_refused(self, torch):
        with pytest.raises(UserError, match="same shape"):
            torch_loss("ppo")(torch.zeros(5), torch.zeros(5, 1), 0.0)

    @pytest.mark.parametrize("objective", ["dpo", "lpo-pendulum"])
    def test_half_precision_and_autocast_are_computed_in_float32(self, objective, torch):
        far = np.float32([6.0, -12.0, 0.1]), np.ones(3, np.float32)
        loss = torch_loss(objective)
        expected, expected_slope = in_torch(loss, *far, 0.0)
        leaf = torch.tensor(far[0], requires_grad=True)
        with torch.autocast("cpu", torch.float16):
            value = loss(leaf, torch.tensor(far[1]), 0.0)
        value.backward()
        assert value.item() == expected
        np.testing.assert_array_equal(leaf.grad, expected_slope)
        half = torch.tensor(far[0], dtype=torch.float16, requires_grad=True)
        value = loss(half, torch.ones(3, dtype=torch.float16), 0.0)
        value.backward()
        assert value.dtype == torch.float32 and torch.isfinite(half.grad).all()
        assert value.item() == pytest.approx(float(expected), rel=1e-2)
        # One that knows no autocast.
        nowhere = torch.zeros(3, device="meta")
        assert torch_drift(objective)(nowhere, nowhere, 0.0).shape == (3,)

    @pytest.mark.parametrize("objective", ["ppo", "ta-lpo"])
    def test_a_loss_is_one_graph_of_torch_compile(self, torch, objective):
        loss = torch_loss(objective)
        compiled = torch.compile(loss, backend="eager", fullgraph=True)
        given = torch.linspace(-1, 1, 5), torch.linspace(1, -2, 5), torch.tensor(0.3)
        assert torch.allclose(compiled(*given), loss(*given))

    @pytest.mark.parametrize("wrong", ["log_ratio", "advantage"])
    def test_an_array_of_numpys_is_no_tensor(self, torch, wrong, one_sentence):
        given = {"log_ratio": torch.zeros(5), "advantage": torch.zeros(5), wrong: np.zeros(5)}
        with pytest.raises(UserError) as error:
            torch_loss("ppo")(**given, progress=0.0)
        message = one_sentence(str(error.value))
        assert f"{wrong} is no tensor of PyTorch but" in message and "loss_function" in message

    def test_progress_may_be_jaxs(self, torch):
        drift, x = torch_drift("ta-lpo"), torch.tensor([0.3, -0.2])
        assert torch.equal(drift(x, x, jnp.float32(0.5)), drift(x, x, 0.5))
        with pytest.raises(UserError, match=r"progress is 2\.0: it is the fraction"):
            drift(x, x, jnp.float32(2.0))

    @pytest.mark.slow
    @pytest.mark.parametrize("objective", ["ppo", "dpo", "lpo-pendulum"])
    def test_the_example_trains(self, objective):
        pytest.importorskip("gymnasium")
        answer = subprocess.run(
            [
                sys.executable,
                "examples/cleanrl_ppo_pendulum.py",
                f"--objective={objective}",
                # Two batches, and episodes of 200 steps that end inside them.
                *("--total-steps=1000", "--num-envs=4", "--num-steps=125"),
                *("--num-epochs=2", "--num-minibatches=2", "--evaluation-episodes=2"),
            ],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert answer.returncode == 0, answer.stderr
        lines = answer.stdout.splitlines()
        assert lines[1].startswith("steps 1000 ")
        found = re.fullmatch(
            rf"{objective}, seed 1: return (-\d+\.\d) \(2 episodes, .*\)", lines[-1]
        )
        # A step of Pendulum costs at most pi^2 + 0.1 * 8^2 + 0.001 * 2^2 = 16.27, an episode 3255.
        assert found and -3255 < float(found.group(1)) < 0


# -- the page -----------------------------------------------------------------------------------

PAGE = ROOT / "docs" / "elsewhere.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.splitlines()[0])
def test_the_pages_examples_run(block, monkeypatch):
    if "import torch" in block:
        pytest.importorskip("torch")
    monkeypatch.chdir(ROOT)
    exec(compile(block, str(PAGE), "exec"), {})


def test_the_page_writes_the_drift_out_correctly(monkeypatch):
    (block,) = [block for block in BLOCKS if "def drift" in block]
    assert "lpo." not in block and "jax" not in block
    monkeypatch.chdir(ROOT)
    namespace: dict = {}
    exec(compile(block, str(PAGE), "exec"), namespace)
    log_ratio, advantage, _ = points(30.0)
    np.testing.assert_allclose(
        namespace["drift"](log_ratio, advantage),
        numpy_drift("lpo-pendulum")(log_ratio, advantage, 0.0),
        rtol=1e-5,
        atol=1e-5,
    )
