"""Formulas: only drifts are read as ones, and what is found is what was there."""

import json
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpo.distill
from lpo import cli, commands
from lpo.certificate import certify
from lpo.distill import _shortest, distill, sample_updates
from lpo.drifts import ClipDrift, ClosedFormDrift, DPODrift, LearnedDrift
from lpo.drifts.formula import parse
from lpo.drifts.sums import as_sum, as_text
from lpo.formula_search import DistillConfig, front_of
from lpo.objectives import Objective, load_objective, save_objective
from scb.agents.ppo import PPO, PPOHyperparameters
from scb.environments.registry import make
from scb.errors import UserError

GRID = {"num_ratios": 61, "num_advantages": 11}
# Small enough for a second or two.
QUICK = DistillConfig(
    samples=300, population_size=100, generations=4, candidates=4, grown=1, numbers=5
)


def charged(drift, log_ratio, advantage, progress=0.5) -> np.ndarray:
    x, a = (jnp.asarray(v, jnp.float32) for v in (log_ratio, advantage))
    parameters = drift.init(jax.random.key(0))
    return np.asarray(drift(parameters, x, a, jnp.full_like(x, progress)))


# -- reading ------------------------------------------------------------------------------------


def test_a_formula_charges_what_it_says():
    # r = 2, A = 3: d = 1, log r = 0.6931; 0.5 (3) 1 - tanh(2 (0.6931)) = 1.5 - 0.8824 = 0.6176.
    drift = ClosedFormDrift("0.5*A*d - tanh(2*log_r)")
    assert charged(drift, [np.log(2.0)], [3.0])[0] == pytest.approx(0.6176, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        # At r = 2, A = -3 and half of training: d = 1.
        ("d", 1.0),
        ("2 - 1 + d*0*A + d - 1", None),
        ("2*d*d", 2.0),
        ("d - -d", 2.0),
        ("-A*d", 3.0),
        ("d*(1 + 2*3)", 7.0),
        ("d - 2*d + 4*d", 3.0),
        ("relu(A)*d + d", 1.0),
        ("abs(A)*d", 3.0),
        ("relu(A*d) + abs(A*d) + progress*d", 3.5),
        (" 1e-1*d+.5 *d\t+ 1.*d ", 1.6),
    ],
)
def test_operators_bind_as_in_arithmetic(text, value):
    if value is None:  # zero at ratio 1 by luck of its numbers, which may change
        with pytest.raises(UserError, match="does not vanish at ratio 1"):
            parse(text)
    else:
        found = charged(ClosedFormDrift(text), [np.log(2.0)], [-3.0])
        assert found[0] == pytest.approx(value, rel=1e-5)


def test_a_base_is_added_and_the_dead_zone_taken_off():
    # PPO's clip at r = 2, A = 1: 2 - 1.2 = 0.8; with d / 2 = 0.5 and xi = 0.25: 1.05.
    drift = ClosedFormDrift("0.5*d", base="ppo", xi=0.25)
    assert charged(drift, [np.log(2.0)], [1.0])[0] == pytest.approx(1.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "",
            "the expression '' has no formula at character 1: it takes numbers up to 1e+30, d, log_r,",
        ),
        ("d +", "has no formula at character"),
        ("d d", "the expression 'd d' has no formula at character"),
        ("2x*d", "has no formula at character"),
        ("(d", "has no formula at character 1"),
        ("d)", "has no formula at character 2"),
        ("tanh d", "has no formula at character"),
        ("d / 2", "has '/' at character 3"),
        ("d ** 2", "has 'd ** 2' at character 1"),
        ("+d", "has '+d' at character 1"),
        ("d*(1 if d else 2)", "has '1 if d else 2' at character 4"),
        ("d*True", "has 'True' at character 3"),
        ("exp(d)", "has 'exp(d)' at character 1"),
        ("d + tanh(d)(d)", "has 'tanh(d)(d)' at character 5"),
        ("__import__('os').system('true')", 'has "\'" at character 12'),
        ("d.real", "has 'd.real' at character 1"),
        ("1e99*d", "has '1e99' at character 1: it takes numbers up to 1e+30"),
        ("d\n+ 1 \x00", "has '\\x00' at character 7"),
        ("d # + d", "has '#' at character 3"),
        ("tanh(" * 160 + "d" + ")" * 160, "is nested more than 150 deep"),
        ("-" * 3900 + "d", "is nested more than 150 deep"),
        ("+".join(["d"] * 3000), "the expression has 5999 characters: at most 4000 are read"),
        ("A", "the expression 'A' does not vanish at ratio 1 whatever its numbers are"),
        ("d + 0.001", "does not vanish at ratio 1"),
        ("tanh(progress) * A", "does not vanish at ratio 1"),
        ("d*d*d*d", "grows beyond 32-bit numbers"),
        ("tanh(A*d*d*d*d)", "grows beyond 32-bit numbers"),
    ],
)
def test_what_is_no_drift_is_refused_in_one_sentence(text, message, one_sentence):
    with pytest.raises(UserError) as error:
        parse(text)
    assert message in one_sentence(str(error.value))


def test_a_long_formula_is_no_deep_one():
    assert charged(ClosedFormDrift(" + ".join(["d"] * 900)), [np.log(2.0)], [1.0])[
        0
    ] == pytest.approx(900.0, rel=1e-5)


@pytest.mark.parametrize(
    "text",
    ["d", "-3*A*d", "tanh(50*A*log_r)*A", "progress*relu(A - 2)*abs(log_r) - d*d*A", "abs(d)"],
)
@pytest.mark.parametrize("base", ["none", "ppo"])
def test_whatever_is_read_is_a_drift(text, base):
    drift = ClosedFormDrift(text, base=base)
    for scale in (1.0, -100.0):
        parameters = jax.tree.map(lambda x: scale * x, drift.init(jax.random.key(0)))  # noqa: B023
        assert certify(drift, parameters, **GRID).holds


def test_gradients_are_finite_wherever_training_goes():
    drift = ClosedFormDrift("A*d*d*d - tanh(A*A*d*d) + abs(log_r)*d")
    parameters = drift.init(jax.random.key(0))
    x = jnp.linspace(-20.0, 20.0, 101)
    slope = jax.grad(lambda x: drift(parameters, x, jnp.full_like(x, 100.0), 0.0 * x).sum())(x)
    assert np.isfinite(np.asarray(slope)).all()


def test_a_formula_is_temporal_where_it_names_the_progress():
    assert ClosedFormDrift("progress*d").temporal
    assert not ClosedFormDrift("A*d").temporal


# -- files --------------------------------------------------------------------------------------


def test_a_saved_formula_charges_the_same_bit_for_bit(tmp_path):
    drift = ClosedFormDrift("0.3*A*d - 1.25e-3*tanh(2*log_r)", base="ppo", clip=0.1, xi=1e-4)
    path, certificate = save_objective(tmp_path / "mine.npz", drift, drift.init(jax.random.key(0)))
    loaded = load_objective(path)
    assert (loaded.name, loaded.drift) == ("mine", drift)
    assert certificate.holds
    x = jnp.linspace(-2.0, 2.0, 101)
    arguments = (x, jnp.cos(7.0 * x), jnp.zeros(101))
    np.testing.assert_array_equal(
        loaded.drift(loaded.parameters, *arguments),
        drift(drift.init(jax.random.key(1)), *arguments),
    )


def test_a_formula_without_numbers_is_kept(tmp_path):
    drift = ClosedFormDrift("A*d - log_r*A")
    path, _ = save_objective(tmp_path / "mine", drift, drift.init(jax.random.key(0)))
    assert load_objective(path).drift == drift


def test_numbers_that_were_trained_on_come_back_in_the_text(tmp_path):
    drift = ClosedFormDrift("0.5*A*d - 2 * tanh(3e-1*log_r)")
    trained = {"constants": jnp.float32([0.1, -7.25, 1e-9])}
    path, _ = save_objective(tmp_path / "mine.npz", drift, trained)
    loaded = load_objective(path)
    assert loaded.drift.expression == "0.1*A*d - -7.25 * tanh(1e-09*log_r)"
    x = jnp.linspace(-2.0, 2.0, 101)
    arguments = (x, jnp.cos(7.0 * x), jnp.zeros(101))
    np.testing.assert_array_equal(
        loaded.drift(loaded.parameters, *arguments), drift(trained, *arguments)
    )


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"expression": "0.5*A*d + 1"}, "does not vanish at ratio 1"),
        ({"expression": "0.5*A*exp(d)"}, "has 'exp(d)' at character 7"),
        ({"expression": "0.6*A*d"}, "holds other numbers than the expression in its .json"),
        ({"expression": "A*d"}, "array 'constants' of drift 'mine' has shape (1,) where (0,)"),
        ({"base": "ppo3"}, "unknown drift base 'ppo3'"),
        ({"clip": "wide"}, "garbles config entry 'drift'"),
        ({"xi": 0}, "xi is 0: it must be positive."),
    ],
)
def test_a_tampered_formula_is_refused(tmp_path, entries, message, one_sentence):
    drift = ClosedFormDrift("0.5*A*d")
    path, _ = save_objective(tmp_path / "mine.npz", drift, drift.init(jax.random.key(0)))
    metadata = json.loads(path.with_suffix(".json").read_text())
    metadata["config"]["drift"].update(entries)
    path.with_suffix(".json").write_text(json.dumps(metadata))
    with pytest.raises(UserError) as error:
        load_objective(path)
    assert message in one_sentence(str(error.value))


def test_ppo_trains_with_a_formula(tiny_agent):
    # A base to which nothing is added is PPO's clip: the agents end the same, rounding apart.
    env, params = make("Synthetic-CartPole-v1")
    ends = []
    for drift in (ClosedFormDrift("0*d", base="ppo", xi=1e-30), ClipDrift()):
        agent = PPO(env, tiny_agent, drift)
        hyperparameters = PPOHyperparameters(drift=drift.init(jax.random.key(0)))
        state = agent.init(jax.random.key(0), hyperparameters, params)
        ends.append(jax.jit(agent.iterate)(state, hyperparameters, params).params)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), *ends)


# -- the search ---------------------------------------------------------------------------------


def test_programs_are_multiplied_out():
    # mul(add(d, A d), sub(d, d)) = 0, and mul(add(d, A d), half(log_r)) = 0.5 d log r + 0.5 A d log r.
    add, sub, mul, half = ("add", 2), ("sub", 2), ("mul", 2), ("half", 1)
    d, log_r, scaled = ("d",), ("log_r",), ("A", "d")
    assert as_sum([mul, add, d, scaled, sub, d, d]) == ()
    found = as_text(as_sum([mul, add, d, scaled, half, log_r]))
    assert found == "0.5*A*d*log_r + 0.5*d*log_r"


def test_text_of_a_program_is_read_as_the_program():
    # sub(tanh(double(d)), relu(half(A d))): tanh(2 d) - 0.5 relu(A d).
    program = [("sub", 2), ("tanh", 1), ("double", 1), ("d",), ("relu", 1), ("half", 1), ("A", "d")]
    text = as_text(as_sum(program))
    assert text == "-0.5*relu(A*d) + tanh(2*d)"
    # At r = 1.5, A = 1: tanh(1) - 0.25 = 0.7616 - 0.25.
    value = charged(ClosedFormDrift(text), [np.log(1.5)], [1.0])
    assert value[0] == pytest.approx(0.5116, abs=1e-3)


def test_a_known_formula_is_found_again_and_judged_where_it_was_not_fitted(monkeypatch):
    pytest.importorskip("gplearn")
    seen = []

    def drawn(*arguments):
        seen.append(sample_updates(*arguments))
        return seen[-1]

    monkeypatch.setattr(lpo.distill, "sample_updates", drawn)
    # 0.7 |A| d², which is "abs(A)*d" times "d".
    known = ClosedFormDrift("0.7*abs(A)*d*d")
    found = distill(Objective("known", known, known.init(jax.random.key(0))), QUICK)
    fitted, judged = (x["log_ratio"] for x in seen)
    assert (fitted != judged).mean() > 0.9
    assert found.r2["drift"] > 0.999 and found.r2["slope"] > 0.999
    assert certify(found.drift, found.parameters, **GRID).holds
    assert [point["size"] for point in found.front] == sorted(p["size"] for p in found.front)
    # It says the same at a point of its own: 0.7 (2) 0.5² = 0.35.
    assert charged(found.drift, [np.log(1.5)], [2.0])[0] == pytest.approx(0.35, abs=0.01)
    again = distill(Objective("known", known, known.init(jax.random.key(0))), QUICK)
    assert again.drift == found.drift


def test_a_known_formula_is_found_again_behind_its_gate():
    pytest.importorskip("gplearn")
    known = ClosedFormDrift("0.7*abs(A)*d*d", gate=0.2)
    # At r = e^0.2 the gate lets 1 - 1/e through: 0.7 (0.2214)² 0.6321.
    assert charged(known, [0.2], [1.0])[0] == pytest.approx(0.02169, rel=1e-3)
    found = distill(Objective("known", known, known.init(jax.random.key(0))), QUICK)
    assert found.drift.gate == 0.2
    assert found.r2["drift"] > 0.999 and found.r2["slope"] > 0.999


def test_a_temporal_drift_is_distilled_with_its_progress():
    drift = ClosedFormDrift("1.5*progress*abs(A)*d*d")
    known = Objective("known", drift, drift.init(jax.random.key(0)))
    found = distill(known, replace(QUICK, numbers=3))
    assert found.drift.temporal
    # What is nothing explains none of it.
    assert found.base_r2["drift"] <= 0 < 0.8 < found.r2["drift"]


def test_points_are_mostly_near_the_start_of_an_update():
    # Nine of ten have a deviation of 0.3, the others of 0.6: the root of 0.117, a little cut off.
    drawn = sample_updates(np.random.default_rng(0), 20_000)["log_ratio"]
    assert drawn.std() == pytest.approx(0.34, rel=0.03) and np.abs(drawn).max() == 1.2


@pytest.mark.parametrize("numbers", [1, 2])
def test_formulas_have_no_more_numbers_than_they_may(numbers):
    found = distill(load_objective("dpo"), replace(QUICK, numbers=numbers))
    for entry in found.front:
        parameters = ClosedFormDrift(entry["expression"]).init(jax.random.key(0))
        assert len(parameters["constants"]) <= numbers


def test_no_formula_is_kept_that_a_shorter_one_equals():
    def of(*factors):
        return ((factors, 0.5),)

    front = front_of([(of("A", "d", "d"), 0.9), (of("A", "d"), 0.5), (of("d"), 0.7)])
    assert [score for _, score, _ in front] == [0.7, 0.9]


def test_a_learned_drift_keeps_its_base():
    pytest.importorskip("gplearn")
    drift = LearnedDrift(hidden_size=2, clip=0.3, xi=1e-5, gate=0.05)
    parameters = jax.tree.map(lambda x: 0.1 * x, drift.init(jax.random.key(0)))
    found = distill(Objective("mine", drift, parameters), QUICK)
    assert (found.drift.base, found.drift.clip, found.drift.xi) == ("ppo", 0.3, 1e-5)
    assert found.drift.gate == 0.05
    assert found.r2["drift"] >= found.base_r2["drift"] - 0.05
    assert certify(found.drift, found.parameters, **GRID).holds


def test_a_formula_that_holds_policies_still_is_taken_only_where_no_other_fits():
    barrier, smooth = "0.2*abs(log_r)", "0.7*abs(A)*d*d"
    front = [(barrier, 0.91, 3), (smooth, 0.9, 5)]
    for tolerance, chosen in ((0.05, smooth), (0.001, barrier)):
        closed, parameters = _shortest(ClosedFormDrift("0*d"), front, tolerance)
        assert closed.expression == chosen
        assert certify(closed, parameters).stalls == (chosen == barrier)


def test_a_drift_that_charges_nothing_is_refused(one_sentence):
    with pytest.raises(UserError) as error:
        distill(load_objective("none"), QUICK)
    assert "none charges nothing where updates go" in one_sentence(str(error.value))


def test_without_gplearn_the_extra_is_named(monkeypatch, one_sentence):
    for module in [m for m in sys.modules if m.startswith("gplearn")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "gplearn", None)
    dpo = DPODrift()
    with pytest.raises(UserError) as error:
        distill(Objective("dpo", dpo, dpo.init(jax.random.key(0))), QUICK)
    message = one_sentence(str(error.value))
    assert message == "distilling needs the package gplearn: install the extra `distill`."


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": 10}, "samples is 10: it must be at least 100."),
        ({"generations": 0}, "generations is 0: it must be at least 1."),
        ({"parsimony": -1.0}, "parsimony is -1.0: it must be 0 or larger"),
        ({"seed": -1}, "seed is -1: it must be 0 or larger"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, message, one_sentence):
    with pytest.raises(UserError) as error:
        DistillConfig(**settings)
    assert message in one_sentence(str(error.value))


def test_the_command_writes_an_objective(tmp_path, monkeypatch, capsys):
    pytest.importorskip("gplearn")
    monkeypatch.chdir(tmp_path)

    def quick(objective: Objective, config: DistillConfig):
        return distill(objective, replace(config, candidates=3, grown=1, numbers=3))

    monkeypatch.setattr(commands, "distill", quick)
    flags = "--samples 200 --population-size 50 --generations 2 --out runs/mine"
    assert cli.main(["distill", "dpo", *flags.split()]) == 0
    output = capsys.readouterr().out
    loaded = load_objective(tmp_path / "runs" / "mine" / "closed_form.npz")
    assert f"expression: {loaded.drift.expression}\n" in output
    assert "R² on unseen points: drift 0." in output
    assert "it is a drift whatever its weights" in output
    assert loaded.metadata["command"].startswith("lpo distill dpo --samples=200")
    assert loaded.metadata["config"]["distill"]["population_size"] == 50
    assert loaded.metadata["results"]["r2"].keys() == {"drift", "slope"}
    # A second run must not write over the first.
    assert cli.main(["distill", "dpo", *flags.split()]) == 2
    assert "already exists and is not empty" in capsys.readouterr().err
