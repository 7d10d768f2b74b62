"""The search for a formula: gplearn for its structure, least squares for its numbers, terms added and dropped.

Formulas are `lpo.drifts.sums.Sum`s; what one is worth is `Points.score`, the mean R² of the drift and of its slope.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lpo.drifts import ClosedFormDrift
from lpo.drifts.formula import evaluate, parse
from lpo.drifts.sums import (
    Sum,
    as_sum,
    as_text,
    collect,
    function,
    node_of,
    numbers_of,
    one_fewer,
    product,
    scaled,
    size_of,
    structure_of,
    value_of,
    with_numbers,
)
from scb.errors import UserError, at_least, needed_for
from scb.seeds import searching

if TYPE_CHECKING:
    from lpo.objectives import Objective

# What gplearn combines: each is 0 at ratio 1 and so is whatever it makes of them.
TERMINALS: tuple[tuple[str, ...], ...] = (
    ("d",),
    ("log_r",),
    ("A", "d"),
    ("A", "log_r"),
    ("abs(A)", "d"),
    ("abs(A)", "log_r"),
)
_UNITS = 60
# In standard deviations of a term.
_FIRST_STEPS = (-1.0, -0.3, -0.1, 0.1, 0.3, 1.0)
_PROMISING = 4
# Central differences over 2 % of the ratio: at a kink, both slopes are those of the same secant.
_STEP = 0.01


@dataclass(frozen=True)
class DistillConfig:
    """How a closed form is looked for.

    Attributes:
      samples: points that the fit sees; as many again, which it doesn't, judge the result.
      population_size: of the genetic programming.
      generations: of the genetic programming.
      parsimony: fitness (R²) that a program pays for each of its nodes.
      candidates: formulas whose numbers are set by least squares, the best of each length.
      grown: the best of these, to which further terms are added one by one.
      numbers: that a formula may have.
      tolerance: R² that a shorter formula may lack to be taken instead of the best, and that a
        further term must add.
      seed: decides everything; 0 to 9999, which are for searches.
    """

    samples: int = 1000
    population_size: int = 1000
    generations: int = 20
    parsimony: float = 0.001
    candidates: int = 40
    grown: int = 4
    numbers: int = 18
    tolerance: float = 0.005
    seed: int = 0

    def __post_init__(self) -> None:
        at_least(100, self, "samples")
        at_least(20, self, "population_size")
        at_least(1, self, "generations", "candidates", "grown", "numbers")
        at_least(0, self, "parsimony", "tolerance")
        searching(self.seed)


class Points:
    """The points of the fit, thrice: at each log-ratio and a step to either side of it."""

    def __init__(
        self,
        objective: "Objective",
        points: Mapping[str, NDArray[np.floating]],
        around: ClosedFormDrift,
    ) -> None:
        x = points["log_ratio"]
        x = np.concatenate([x, x + _STEP, x - _STEP])
        a, p = np.tile(points["advantage"], 3), np.tile(points["progress"], 3)
        # As the closed form will compute it: its own base, and nothing of the network's.
        self.xi, self.gate = around.xi, np.ones_like(x)
        self.base = np.zeros_like(x) + around.base_penalty(x, a, p)
        if around.gate:
            self.gate = around.gate_factor(x)
        self.variables = {"d": np.expm1(x), "log_r": x, "A": a, "abs(A)": np.abs(a), "progress": p}
        f = objective.drift(objective.parameters, *(jnp.asarray(v, jnp.float32) for v in (x, a, p)))
        self.drift, self.slope = self._split(np.asarray(f, float))
        # Residuals in units of the standard deviation: 1 - R² is the mean of their squares.
        self._scales = [max(float(v.std()), 1e-12) for v in (self.drift, self.slope)]

    @staticmethod
    def _split(f: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        here, right, left = np.split(f, 3)
        return here, (right - left) / (2.0 * _STEP)

    def residuals(self, added: NDArray[np.floating]) -> NDArray[np.floating]:
        """[3 S] values of an expression -> [2 S] scaled errors of drift and slope."""
        drift, slope = self._split(np.maximum(self.base + self.gate * added - self.xi, 0.0))
        return np.concatenate(
            [(drift - self.drift) / self._scales[0], (slope - self.slope) / self._scales[1]]
        )

    def score(self, added: NDArray[np.floating]) -> float:
        """The mean of the two R²."""
        return float(1.0 - np.mean(self.residuals(added) ** 2))


def programs_of(
    data: Points, config: DistillConfig, terminals: Sequence[tuple[str, ...]]
) -> list[list[Any]]:
    """The programs of all of gplearn's generations, best first, as lists in prefix notation."""
    with needed_for("distilling needs", "gplearn", "distill"):
        from gplearn.fitness import make_fitness
        from gplearn.functions import make_function
        from gplearn.genetic import SymbolicRegressor
    inputs = np.stack(
        [np.prod([data.variables[name] for name in terminal], axis=0) for terminal in terminals],
        axis=-1,
    )

    def fitness(
        target: NDArray[np.floating], found: NDArray[np.floating], weight: NDArray[np.floating]
    ) -> float:
        # gplearn tries a new measure on two points of its own.
        if found.shape != data.base.shape:
            return 0.0
        # A hopeless program must not overflow on its way out.
        return max(data.score(np.clip(found, -1e6, 1e6)), -10.0)

    def unary(name: str, function: Callable[[Any], Any]) -> Any:
        return make_function(function=function, name=name, arity=1, wrap=False)

    search = SymbolicRegressor(
        population_size=config.population_size,
        generations=config.generations,
        tournament_size=max(2, config.population_size // 50),
        # A number of its own would not vanish at ratio 1: programs multiply by these instead, and
        # least squares finds the numbers afterwards.
        const_range=None,
        function_set=(
            "add",
            "sub",
            "mul",
            unary("tanh", lambda x: np.tanh(x)),
            unary("relu", lambda x: np.maximum(x, 0.0)),
            unary("half", lambda x: 0.5 * x),
            unary("double", lambda x: 2.0 * x),
        ),
        init_depth=(1, 4),
        metric=make_fitness(function=fitness, greater_is_better=True, wrap=False),
        parsimony_coefficient=config.parsimony,
        p_crossover=0.7,
        p_subtree_mutation=0.1,
        p_hoist_mutation=0.05,
        p_point_mutation=0.1,
        random_state=config.seed,
    )
    with np.errstate(all="ignore"):
        search.fit(inputs, np.zeros(len(inputs)))
    kept = [p for generation in search._programs for p in generation if p is not None]
    kept.sort(key=lambda program: -program.raw_fitness_)
    return [
        [terminals[x] if isinstance(x, int) else (x.name, x.arity) for x in program.program]
        for program in kept
    ]


def best_formulas(programs: Sequence[Sequence[Any]], config: DistillConfig) -> list[Sum]:
    """The best formulas, at most three of a size, each once; programs come best first."""
    found: dict[str, Sum] = {}
    sizes: dict[int, int] = {}
    for program in programs:
        formula = as_sum(program)
        if not formula or len(numbers_of(formula)) > config.numbers:
            continue
        structure, size = structure_of(formula), size_of(formula)
        if structure in found or sizes.get(size, 0) >= 3:
            continue
        found[structure] = formula
        sizes[size] = sizes.get(size, 0) + 1
        if len(found) == config.candidates:
            break
    return list(found.values())


def tune(terms: Sum, data: Points, evaluations: int = 20) -> tuple[Sum, float]:
    """A formula with the numbers that fit best, and its score."""
    from scipy.optimize import least_squares

    start: list[float] = []
    root = node_of(terms, start)

    def residuals(numbers: NDArray[np.floating]) -> NDArray[np.floating]:
        value = evaluate(root, numbers, data.variables, np)
        # The mean of squares must stay finite on the way.
        return np.clip(data.residuals(np.clip(value, -1e6, 1e6)), -1e6, 1e6)

    found = least_squares(residuals, start, max_nfev=evaluations).x
    # Four digits are what the text keeps, and so what is scored.
    rounded = with_numbers(terms, (float(f"{x:.4g}") for x in found))
    return rounded, data.score(value_of(rounded, data.variables))


def terms_to_grow_by(rng: np.random.Generator, terminals: Sequence[tuple[str, ...]]) -> list[Sum]:
    """Terms to grow by: products of at most two terminals, and tanh of random sums of three."""
    singles: list[Sum] = [((tuple(sorted(t)), 1.0),) for t in terminals]
    pairs = [product(x, y) for i, x in enumerate(singles) for y in singles[i:]]
    tanh = function("tanh")
    units = []
    for _ in range(_UNITS):
        chosen = rng.choice(len(singles), 3, replace=False)
        # Inputs are around 0.3: weights of 3 bring tanh to where it bends.
        units.append(
            tanh(collect([(singles[i][0][0], 3.0 * rng.standard_normal()) for i in chosen]))
        )
    return [*singles, *pairs, *units]


def grow(
    terms: Sum, score: float, data: Points, library: Sequence[Sum], config: DistillConfig
) -> list[tuple[Sum, float]]:
    """The formula with one more term, with two more, ..., as long as each adds the tolerance."""
    values = [value_of(term, data.variables) for term in library]
    steps = [
        (i, step / max(float(value.std()), 1e-12))
        for i, value in enumerate(values)
        for step in _FIRST_STEPS
    ]
    grown: list[tuple[Sum, float]] = []
    while True:
        here = value_of(terms, data.variables)
        # One step along every term shows which are worth a fit of all numbers.
        promising = sorted(steps, key=lambda tried: -data.score(here + tried[1] * values[tried[0]]))
        longer = [collect([*terms, *scaled(library[i], s)]) for i, s in promising[:_PROMISING]]
        fits = [tune(one, data) for one in longer if len(numbers_of(one)) <= config.numbers]
        best = max(fits, key=lambda found: found[1], default=None)
        if best is None or best[1] < score + config.tolerance:
            return grown
        terms, score = best
        grown.append(best)


def drop_terms(terms: Sum, score: float, data: Points, tolerance: float) -> tuple[Sum, float]:
    """Leaves out term after term while the score falls by less than a third of the tolerance in all."""
    floor = score - tolerance / 3.0
    while True:
        shorter = [tune(fewer, data, 10) for fewer in one_fewer(terms)]
        best = max(shorter, key=lambda found: found[1], default=None)
        if best is None or best[1] < floor:
            return terms, score
        terms, score = best


def front_of(found: Sequence[tuple[Sum, float]]) -> list[tuple[str, float, int]]:
    """(text, score, size) of the readable formulas that no shorter or equally long one matches, shortest first."""
    front: list[tuple[str, float, int]] = []
    for terms, score in sorted(found, key=lambda f: (size_of(f[0]), -f[1])):
        if not math.isfinite(score) or (front and score <= front[-1][1]):
            continue
        text = as_text(terms)
        try:
            parse(text)
        except UserError:  # it grows too fast, or became too long or deep
            continue
        front.append((text, score, size_of(terms)))
    if not front:
        raise UserError(
            "the search found no formula that stays finite: give it more generations or another seed."
        )
    return front
