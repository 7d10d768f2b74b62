"""Objectives of one's own: functions of ratio and advantage, and families of drifts, by object and by name."""

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpo
from lpo import cli
from lpo.drifts import learned_drift
from lpo.drifts.surrogate import SurrogateDrift
from lpo.meta_training import MetaTraining
from lpo.objectives import load_apart, load_objective, save_objective
from scb.errors import UserError
from scb.own import code_of

MODULE = '''
from dataclasses import dataclass
from typing import Any
import jax
import jax.numpy as jnp
import lpo

def clipped(ratio, advantage, xp):
    return xp.minimum(ratio * advantage, xp.clip(ratio, 0.8, 1.2) * advantage)

def squared(ratio, advantage):
    return ratio * advantage - 0.5 * (ratio - 1) ** 2

@dataclass(frozen=True)
class Power(lpo.Drift):
    """A power of the log-ratio.

    Attributes:
      power: which.
    """

    learned = True
    power: int = 2

    def init(self, key, scale=1.0):
        return {"w": 1.0 + scale * jax.random.normal(key, (1,))}

    def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
        return xp.abs(parameters["w"][0]) * log_ratio**self.power

mine = lpo.Objective("another name", Power(4), {"w": jnp.ones(1)})
number = 3
text = "ppo"
'''
LOG_RATIO = np.array([-0.5, 0.0, 0.1, 0.6])
ADVANTAGE = np.array([-1.0, -2.0, 3.0, 0.5])


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module that Python finds in the working directory, and what writes another into its place."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    sys.modules.pop("own_module", None)
    (tmp_path / "own_module.py").write_text(MODULE)

    def changed(old: str, new: str) -> None:
        assert old in MODULE
        (tmp_path / "own_module.py").write_text(MODULE.replace(old, new) + "# longer\n")
        importlib.invalidate_caches()
        sys.modules.pop("own_module", None)

    yield changed
    sys.modules.pop("own_module", None)


def test_a_function_of_ratio_and_advantage_is_an_objective(module):
    ours, ppo = load_objective("own_module:clipped"), load_objective("ppo")
    assert ours.name == "own_module:clipped"
    theirs = lpo.numpy_drift(ppo)(LOG_RATIO, ADVANTAGE)
    assert (theirs[[0, 3]] > 0.1).all()
    in_jax = np.asarray(lpo.drift_function(ours)(LOG_RATIO, ADVANTAGE))
    assert in_jax == pytest.approx(theirs, abs=1e-6)
    assert lpo.numpy_drift(ours)(LOG_RATIO, ADVANTAGE) == pytest.approx(theirs, abs=1e-6)
    assert lpo.certify(ours).holds


def test_the_same_in_pytorch(module):
    torch = pytest.importorskip("torch")
    given = torch.as_tensor(LOG_RATIO), torch.as_tensor(ADVANTAGE)
    ours = lpo.torch_loss("own_module:clipped")(*given)
    assert ours.item() == pytest.approx(lpo.torch_loss("ppo")(*given).item())
    # One that says nothing of its arrays' library needs none.
    assert torch.isfinite(lpo.torch_loss("own_module:squared")(*given))
    whole = torch.tensor([1, 2]), torch.ones(2)
    assert lpo.torch_loss("ppo")(*whole).item() == pytest.approx(-1.2)
    of_jax = load_objective(lambda ratio, advantage: jnp.minimum(ratio, 1.0) * advantage)
    with pytest.raises(UserError, match=r"does not compute with PyTorch .*: let it take xp"):
        lpo.torch_drift(of_jax)(*given)


@pytest.mark.slow
def test_agents_train_with_it_as_with_the_same_of_ours(module, tiny_spec):
    comparison = lpo.compare(
        "Synthetic-Pendulum-v1",
        ["ppo", "own_module:clipped", SurrogateDrift(lambda ratio, advantage: ratio * advantage)],
        [0, 1],
        spec=tiny_spec,
        points=1,
        episodes=2,
    )
    ppo, ours, free = comparison.curves
    assert [ours.objective, free.objective] == ["own_module:clipped", "surrogate"]
    assert ours.final == pytest.approx(ppo.final, abs=1e-4)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda r, a: r, "takes r, a: let it take advantage"),
        (lambda ratio: ratio, "takes ratio: let it take advantage"),
        (lambda ratio, advantage: (ratio * advantage).mean(), r"returns the shape \(\)"),
        (lambda ratio, advantage: 1.0, "returns the shape 1.0"),
    ],
)
def test_functions_that_are_none(function, message):
    with pytest.raises(UserError, match=message):
        lpo.drift_function(function)(LOG_RATIO, ADVANTAGE)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda ratio, advantage: -ratio * advantage,
            "falls with the ratio where .*, as a loss do",
        ),
        (lambda ratio, advantage, xp: xp.maximum(-ratio * advantage, -advantage), "as a loss does"),
        (lambda ratio, advantage: -ratio * jnp.maximum(advantage, 0), "as a loss does"),
        (SurrogateDrift(lambda ratio, advantage: -ratio * advantage), "as a loss does"),
        (lambda advantage: advantage, "does not change with the ratio where that is 1"),
        (
            lambda ratio, advantage: ratio * advantage + jnp.sqrt((ratio - 1) ** 2),
            "slope in the ratio that is no number",
        ),
    ],
)
def test_what_would_teach_nothing_or_the_opposite_is_refused(function, message):
    with pytest.raises(UserError, match=message):
        load_objective(function)


@pytest.mark.parametrize(
    "function",
    [
        lambda ratio, advantage, progress: progress * ratio * advantage,
        lambda ratio, advantage: ratio * (advantage - advantage.mean()),
        lambda ratio, advantage: jnp.where(jnp.abs(advantage) > 1, ratio * advantage, 0),
        lambda log_ratio, advantage: log_ratio * advantage,
    ],
)
def test_what_is_unusual_and_teaches_is_taken(function):
    load_objective(function)


def branching(ratio, advantage, progress, xp):
    return ratio * advantage if progress > 0.5 else 0.5 * ratio * advantage


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            branching,
            r"surrogate branching does not compute in JAX \(.*\): use xp.where in place of",
        ),
        (
            lambda ratio, advantage: np.minimum(ratio, 1.2) * advantage,
            r"does not compute in JAX \(.*[^.]\): use xp.where in place of if, and xp in place of",
        ),
        (
            lambda ratio, advantage: ratio.clamp(0.8, 1.2) * advantage,
            r"does not compute in JAX \(.* clamp\): let it take xp, and call xp.clip and the like",
        ),
        (lambda ratio, advantage: ratio * advantage / (1 // 0), r"in JAX \(.*division.*\)\."),
        (lambda ratio, advantage: ratio * advantage * 1j, "returns complex numbers: return their"),
    ],
)
def test_what_jax_cannot_trace_is_told_of_the_function(function, message):
    with pytest.raises(UserError, match=message):
        load_objective(function)


def test_what_one_library_cannot_compute_is_told_of_the_function():
    drift = SurrogateDrift(branching)
    with pytest.raises(
        UserError, match=r"compute with NumPy \(The truth value .*\): use xp.where in place"
    ):
        drift(None, LOG_RATIO, ADVANTAGE, np.zeros(len(LOG_RATIO)), np)
    torch = pytest.importorskip("torch")
    tight = load_objective(lambda ratio, advantage, xp: advantage * xp.minimum(ratio, 1.2))
    with pytest.raises(UserError, match=r"with PyTorch .*; its minimum and maximum take tensors a"):
        lpo.torch_drift(tight)(torch.as_tensor(LOG_RATIO), torch.as_tensor(ADVANTAGE))


def test_it_may_depend_on_the_fraction_of_training_done():
    def fading(ratio, advantage, progress):
        return ratio * advantage - progress * (ratio - 1) ** 2

    drift = lpo.drift_function(fading)
    assert (drift(LOG_RATIO, ADVANTAGE, 0.0) == 0).all()
    assert drift(LOG_RATIO, ADVANTAGE, 1.0)[0] > 0
    with pytest.raises(UserError, match="depends on the fraction of training done"):
        drift(LOG_RATIO, ADVANTAGE)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_module:nothing", "cannot be imported"),
        ("no_such_module:thing", "cannot be imported"),
        ("own_module:number", "of the class int is no objective"),
        ("own_module:text", "is a str"),
    ],
)
def test_names_that_stand_for_none(module, name, message):
    with pytest.raises(UserError, match=message):
        load_objective(name)


def test_an_objective_a_drift_or_its_class_is_found_by_name(module):
    found = load_apart(["own_module:mine", "own_module:Power"])
    assert [o.name for o in found] == ["own_module:mine", "own_module:Power"]
    assert [o.drift.power for o in found] == [4, 2]
    with pytest.raises(UserError, match="is of the class function"):
        lpo.Objective("f", lambda *_: 0.0, ())


def test_rows_of_what_a_module_said_before_are_refused(module, tiny_spec, tmp_path):
    def measured():
        arguments = {"spec": tiny_spec, "points": 1, "episodes": 2}
        rows = tmp_path / "rows.jsonl"
        name = "own_module:squared"
        return lpo.compare("Synthetic-Pendulum-v1", [name], [0], rows=rows, **arguments).curves[0]

    before = measured()
    module("import lpo\n", "import lpo  # a comment\n\n\n")
    assert (measured().returns == before.returns).all()
    module("0.5 * (ratio", "50 * (ratio")
    with pytest.raises(UserError, match="hold another objective with the name own_module:squared"):
        measured()


def test_a_family_inside_of_another_has_a_name_of_its_own():
    @dataclass(frozen=True)
    class Base(lpo.NoDrift):
        pass

    @dataclass(frozen=True)
    class Sub(Base):
        function: Callable = abs

    assert [o.name for o in load_apart([Base, Sub])] == ["Base", "Sub"]
    with pytest.raises(UserError, match="setting function of the drift Sub is a function"):
        Sub().to_config()

    class Thawed(lpo.Drift):
        init = __call__ = lambda self, *_: jnp.zeros(())

    with pytest.raises(UserError, match="Thawed is no frozen dataclass"):
        load_objective(Thawed)


def test_a_subclass_of_the_clip_keeps_settings_that_its_parameters_do_not_say():
    @dataclass(frozen=True)
    class Asymmetric(lpo.ClipDrift):
        lower: float = 0.1

        def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
            ratio = xp.exp(log_ratio)
            inside = xp.clip(ratio, 1 - self.lower, 1 + parameters)
            return xp.maximum((ratio - inside) * advantage, xp.zeros_like(ratio))

    objective = load_objective(Asymmetric(0.2, lower=0.5))
    assert objective.drift.lower == 0.5
    below = np.log(0.7), -1.0
    assert lpo.numpy_drift(objective)(*below) == pytest.approx(0.0)
    assert lpo.numpy_drift(Asymmetric(0.2))(*below) == pytest.approx(0.2)
    # Of the clip itself one program trains all.
    assert load_objective("ppo-0.3").drift == load_objective("ppo").drift


def test_what_cannot_be_told_apart_is_told():
    @dataclass
    class Strength:
        strength: float = 0.5

        def __call__(self, ratio, advantage):
            return ratio * advantage - self.strength * (ratio - 1) ** 2

    @dataclass(frozen=True)
    class Table(lpo.NoDrift):
        weights: Any = field(default_factory=lambda: [1.0])

    for unhashable in (Strength(), Table(), Table(np.ones(2))):
        with pytest.raises(UserError, match=r"cannot be told from others \(unhashable type"):
            load_objective(unhashable)
    assert load_objective(Table((1.0,))).drift.weights == (1.0,)


def test_parameters_may_be_of_any_tree():
    class Parts(NamedTuple):
        width: Any
        rest: Any

    @dataclass(frozen=True)
    class OfTree(lpo.NoDrift):
        def init(self, key, scale=1.0):
            return Parts(jnp.full(1, 2.0), [jnp.full(2, 3.0)])

        def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
            return parameters.width[0] * parameters.rest[0][1] * log_ratio**2

    drift = OfTree()
    assert lpo.numpy_drift(drift)(LOG_RATIO, ADVANTAGE) == pytest.approx(6 * LOG_RATIO**2)
    in_jax = lpo.drift_function(drift)(LOG_RATIO, ADVANTAGE)
    assert np.asarray(in_jax) == pytest.approx(6 * LOG_RATIO**2, rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("frozen=True)\nclass Power", "frozen=False)\nclass Power", "is no frozen dataclass"),
        ("power: int = 2", "power: int", "own_module:Power cannot be made as it is"),
        ("power", "sigma", "has a field sigma, and --sigma is something else here"),
        ("power: int = 2", "power: Any = (jnp.ones(2),)", "cannot be told from others"),
    ],
)
def test_a_family_that_cannot_be_learned_is_told_before(module, old, new, told, capsys):
    module(old, new)
    assert cli.main(["meta-train", "--drift", "own_module:Power", "--out", "run"]) == 2
    assert told in capsys.readouterr().err and not Path("run").exists()


def test_a_family_that_is_not_frozen_is_not_learned():
    @dataclass
    class Thawed(lpo.Drift):
        def init(self, key, scale=1.0):
            return {"w": jnp.ones(1)}

        def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
            return parameters["w"][0] * log_ratio**2

    with pytest.raises(UserError, match="Thawed is no frozen dataclass"):
        MetaTraining(lpo.MetaTrainingConfig(drift=Thawed()))


def test_certificates_are_of_drifts_and_objectives():
    ppo = load_objective("ppo")
    assert lpo.certify(ppo) == lpo.certify(ppo.drift) == lpo.certify(ppo.drift, ppo.parameters)
    with pytest.raises(UserError, match="of the class str is no drift: give one"):
        lpo.certify("ppo")


def test_a_family_counts_with_what_it_inherits_from(module, tmp_path):
    heir = "from own_module import Power\n\nclass Heir(Power):\n    pass\n"
    (tmp_path / "heirs.py").write_text(heir)
    try:
        before = code_of(load_objective("heirs:Heir").drift)
        assert list(before) == ["heirs:Heir"]
        sys.modules.pop("heirs")
        module("log_ratio**self.power", "log_ratio**2")
        assert code_of(load_objective("heirs:Heir").drift) != before
    finally:
        sys.modules.pop("heirs", None)


def test_a_file_names_the_family(module):
    power = learned_drift("own_module:Power", power=4)
    save_objective("p.npz", power, power.init(jax.random.key(0)))
    assert load_objective("p.npz").drift == power
    module("class Power(", "class Other(")
    with pytest.raises(UserError, match=r"drift 'own_module:Power' cannot be imported"):
        load_objective("p.npz")


def test_what_no_import_finds_is_not_saved(module, tmp_path):
    @dataclass(frozen=True)
    class Hidden(lpo.NoDrift):
        def init(self, key, scale=1.0):
            return {"w": jnp.ones(1)}

    with pytest.raises(UserError, match="is defined where no import finds it"):
        save_objective(tmp_path / "x.npz", Hidden(), {"w": jnp.ones(1)})
    function = load_objective("own_module:squared")
    with pytest.raises(UserError, match="surrogate is its settings"):
        save_objective(tmp_path / "x.npz", function.drift, function.parameters)
    assert not list(tmp_path.glob("x*"))


@pytest.mark.slow
def test_a_family_of_ones_own_is_learned_and_its_run_continued(module, capsys):
    words = "meta-train --drift own_module:Power --power 4 --generations 1 --population-size 2"
    rest = " --agents-per-candidate 1 --mean-evaluations 2 --contexts 20 --out run"
    assert cli.main((words + rest).split()) == 0
    assert load_objective("run/objective.npz").drift.power == 4
    resumed = ["meta-train", "--resume", "run", "--generations", "2"]
    module("xp.abs(parameters", "2 * xp.abs(parameters")
    assert cli.main(resumed) != 0
    assert "own_module:Power is not what it was" in capsys.readouterr().err
    module("import lpo\n", "import lpo\n\n")
    assert cli.main(resumed) == 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_module:squared", "is a function: it must be a subclass of lpo.Drift"),
        ("lpo.drifts:NoDrift", "does not learn"),
        ("nothing", "unknown learned drift"),
    ],
)
def test_families_that_do_not_learn(module, name, message):
    with pytest.raises(UserError, match=message):
        learned_drift(name)
