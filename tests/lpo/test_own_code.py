"""What is told of the code of an objective of one's own, so that rows of another are not taken for its own."""

import json
import logging
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, partial, wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpo
from lpo.drifts.surrogate import SurrogateDrift
from lpo.objectives import load_apart, load_objective
from scb.errors import UserError
from scb.own import code_of


def code(thing):
    """What is told of an objective's code."""
    return code_of(load_objective(thing).drift)


def typed(text, name="f", **given):
    """A function or class of code that is in no file."""
    space = {"__name__": "__main__", "lpo": lpo, "dataclass": dataclass, "jnp": jnp}
    space |= {"cached_property": cached_property, **given}
    exec(text, space)
    return space[name]


FUNCTION = """def f(ratio, advantage, xp):
    return xp.minimum(ratio * advantage, sum((lambda z: z)(x) for x in [1.0]))
"""
FAMILY = """@dataclass(frozen=True)
class F(lpo.NoDrift):
    TABLE = {"weights": jnp.ones(3)}

    @cached_property
    def strength(self):
        return 5.0

    def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
        return 1.0 * log_ratio**2
"""


@pytest.mark.parametrize(
    ("text", "name", "old", "new", "layout"),
    [
        (FUNCTION, "f", "minimum", "maximum", "    return"),
        (FUNCTION, "f", "[1.0]", "[2.0]", "    return"),
        (FAMILY, "F", "1.0 *", "2.0 *", "        return"),
        (FAMILY, "F", "jnp.ones", "jnp.zeros", "        return"),
        (FAMILY, "F", "5.0", "6.0", "        return"),
    ],
)
def test_code_that_is_in_no_file_is_told_apart(text, name, old, new, layout):
    same = text.replace(layout, f'{layout.replace("return", "")}"""Says."""\n\n{layout}')
    assert code(typed(text, name)) == code(typed(same, name)) != {}
    assert code(typed(text, name)) != code(typed(text.replace(old, new), name))


def scaled(factor):
    def decorated(function):
        @wraps(function)
        def inner(*given, **named):
            return factor * function(*given, **named)

        return inner

    return decorated


def with_default(strength):
    def surrogate(ratio, advantage, strength=strength):
        return strength * ratio * advantage

    return surrogate


class Called:
    def __init__(self, strength):
        self.strength = strength

    def __call__(self, ratio, advantage):
        return self.strength * ratio * advantage


def of_a_global(strength):
    return typed("def f(ratio, advantage): return float(LIMIT) * ratio * advantage", LIMIT=strength)


def of_a_table(strength):
    table = {"strength": np.array([strength])}
    return lambda ratio, advantage: table["strength"] * ratio * advantage


def of_a_helper(strength):
    helper = typed(f"def f(x): return {strength} * x")
    return typed("def f(ratio, advantage): return helper(ratio) * advantage", helper=helper)


def of_a_fraction(strength):
    return of_a_global(Fraction(strength))


class Slotted:
    __slots__ = ("strength",)

    def __init__(self, strength):
        self.strength = strength

    def __call__(self, ratio, advantage):
        return self.strength * ratio * advantage


def of_a_slope(strength):
    @jax.custom_vjp
    def through(x):
        return x

    through.defvjp(lambda x: (x, None), lambda _, slope: (strength * slope,))
    return lambda ratio, advantage: through(ratio) * advantage


def of_a_knot(strength):
    """A mapping whose key leads back to it, as the parts of a logger do."""
    knot = Called(strength)
    knot.table = {knot: 1.0}
    return lambda ratio, advantage: knot(ratio, advantage)


def of_a_logger(strength):
    log = logging.getLogger(__name__)

    def told(ratio, advantage):
        log.debug("traced")
        return strength * ratio * advantage

    return told


def squared(strength):
    def surrogate(ratio, advantage):
        return ratio * advantage - strength * (ratio - 1) ** 2

    return surrogate


def power(ratio, advantage, strength=1.0):
    return squared(strength)(ratio, advantage)


@pytest.mark.parametrize(
    "made",
    [
        squared,
        with_default,
        Called,
        of_a_global,
        of_a_table,
        of_a_helper,
        of_a_fraction,
        Slotted,
        of_a_slope,
        of_a_knot,
        of_a_logger,
        lambda x: partial(power, strength=x),
        lambda x: jax.jit(partial(power, strength=x)),
        lambda x: scaled(x)(power),
        lambda x: Called(x).__call__,
    ],
)
def test_what_a_function_was_made_with_counts(made):
    assert code(made(0.5)) == code(made(0.5)) != {}
    assert code(made(0.5)) != code(made(0.7))


def test_of_ours_and_libraries_nothing_counts():
    assert code("lpo-pendulum") == code("dpo") == {}
    (only,) = code(lambda ratio, advantage: jnp.tanh(ratio) * advantage)
    assert only == f"{__name__}:test_of_ours_and_libraries_nothing_counts.<locals>.<lambda>"


@pytest.mark.parametrize("made", [squared, Called, lambda x: partial(power, strength=x)])
def test_values_that_a_function_was_made_with_count(made, tiny_spec, tmp_path):
    def measured(objective):
        arguments = {"spec": tiny_spec, "points": 1, "episodes": 2, "rows": tmp_path / "r.jsonl"}
        return lpo.compare("Synthetic-Pendulum-v1", [objective], [0], **arguments)

    measured(made(0.5))
    measured(made(0.5))
    with pytest.raises(UserError, match="hold another objective with the name"):
        measured(made(0.7))


def test_functions_in_wrappers_are_themselves():
    for wrapped in (partial(power, strength=1.0), jax.jit(power)):
        assert load_objective(wrapped).name == "power"
        assert next(iter(code(wrapped))) == f"{__name__}:power"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (max, "max does not say what it takes"),
        (int, "of the class type is no objective"),
        (lpo.Drift, "Drift cannot be made as it is"),
        (SurrogateDrift, "SurrogateDrift cannot be made as it is"),
    ],
)
def test_callables_that_are_none(wrong, message):
    with pytest.raises(UserError, match=message):
        load_objective(wrong)


def test_several_of_one_function_have_names_by_a_dict():
    strengths = {f"square {x}": partial(power, strength=x) for x in (0.5, 1.0)}
    assert [o.name for o in load_apart(strengths)] == ["square 0.5", "square 1.0"]
    with pytest.raises(UserError, match=r"is there twice: .* by a dict {name: objective}"):
        load_apart(strengths.values())
    with pytest.raises(UserError, match=r"named 0.5, which is no text: .* such as {'0.5': ...}"):
        load_apart({x: partial(power, strength=x) for x in (0.5, 1.0)})


def test_rows_of_before_code_was_told_go_on(tiny_spec, tmp_path):
    def measured():
        arguments = {"spec": tiny_spec, "points": 1, "episodes": 2, "rows": tmp_path / "r.jsonl"}
        (curve,) = lpo.compare("Synthetic-Pendulum-v1", [power], [0], **arguments).curves
        return curve.returns.tolist()

    before, described = measured(), tmp_path / "r.json"
    told = json.loads(described.read_text())
    (configuration,) = told.values()
    assert configuration.pop("objective_code")
    described.write_text(json.dumps(told))
    assert measured() == before
