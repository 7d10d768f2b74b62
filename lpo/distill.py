"""Distillation: a learned drift read off and written down, by symbolic regression.

A network that was learned can be written as a formula, as its authors did when they found DPO (Lu et
al., 2022); here genetic programming does the reading (gplearn, the extra `distill`), least squares
sets the numbers, and what comes out is a `lpo.drifts.ClosedFormDrift`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lpo.certificate import certify
from lpo.drifts import ClosedFormDrift
from lpo.drifts.contract import CorrectedDrift
from lpo.formula_search import (
    TERMINALS,
    DistillConfig,
    Points,
    best_formulas,
    drop_terms,
    front_of,
    grow,
    programs_of,
    terms_to_grow_by,
    tune,
)
from scb.errors import UserError
from scb.keys import root_key
from scb.stopwatch import Stopwatch

if TYPE_CHECKING:
    from lpo.objectives import Objective


@dataclass(frozen=True)
class Distillation:
    """A closed form and how well it fits.

    Attributes:
      drift: the closed form.
      parameters: its numbers.
      r2: on points that the fit has not seen, of the "drift" and of its "slope" d f/d(log r), which
        is all that training notices.
      base_r2: the same of the base alone, with nothing added: what the formula must improve on.
      front: {"size", "r2" (on the fit's points, value and slope together), "expression"}, of the
        formulas that no shorter one equals; sizes count numbers, variables and functions.
      seconds: that it took.
    """

    drift: ClosedFormDrift
    parameters: dict[str, jax.Array]
    r2: dict[str, float]
    base_r2: dict[str, float]
    front: list[dict[str, Any]]
    seconds: float


def distill(objective: "Objective", config: DistillConfig | None = None) -> Distillation:
    """Fits a closed form to an objective's drift and to its slope.

    gplearn looks for the structure, by the mean of the two R² of what the whole drift, base and
    relu included, then is; least squares sets the numbers of the best formulas of each length; the
    best of them get further terms as long as those help, and lose terms that hardly matter. Of all
    these, the shortest within `tolerance` of the best is taken.

    Args:
      objective: a learned one as a rule, whose base is kept; any other is fitted without a base.
      config: how to look.

    Raises:
      UserError: gplearn is not installed, or the drift charges nothing anywhere.
    """
    watch = Stopwatch()
    config = config or DistillConfig()
    drift = objective.drift
    nothing = ClosedFormDrift("0*d")
    if isinstance(drift, CorrectedDrift):
        nothing = replace(nothing, base=drift.base, clip=drift.clip, xi=drift.xi, gate=drift.gate)
    rng = np.random.default_rng(config.seed)
    terminals = [*TERMINALS, *((*t, "progress") for t in TERMINALS if drift.temporal)]
    fit = Points(objective, sample_updates(rng, config.samples), nothing)
    if not fit.drift.max() > 0.0:
        raise UserError(
            f"{objective.name} charges nothing where updates go: there is no drift to write as a formula."
        )
    formulas = best_formulas(programs_of(fit, config, terminals), config)
    tuned = sorted((tune(formula, fit) for formula in formulas), key=lambda found: -found[1])
    library = terms_to_grow_by(rng, terminals)
    grown = [g for f in tuned[: config.grown] for g in grow(*f, fit, library, config)]
    # Dropping terms one by one takes long: only from the best.
    longest = sorted([*tuned, *grown], key=lambda found: -found[1])[: config.grown]
    shorter = [drop_terms(*found, fit, config.tolerance) for found in longest]
    front = front_of([*tuned, *grown, *shorter])
    held_out = sample_updates(rng, config.samples)
    closed, parameters = _shortest(nothing, front, config.tolerance)
    return Distillation(
        drift=closed,
        parameters=parameters,
        r2=fit_quality(objective, closed, parameters, held_out),
        base_r2=fit_quality(objective, nothing, nothing.init(root_key(0)), held_out),
        front=[{"size": size, "r2": score, "expression": text} for text, score, size in front],
        seconds=watch.lap(),
    )


def _shortest(
    around: ClosedFormDrift, front: Sequence[tuple[str, float, int]], tolerance: float
) -> tuple[ClosedFormDrift, dict[str, jax.Array]]:
    """The shortest formula that is good enough, of those that hold no policy still where there are any.

    All of them are drifts by construction.
    """
    best = max(score for _, score, _ in front)
    good = [
        replace(around, expression=text) for text, score, _ in front if score >= best - tolerance
    ]
    found = [(closed, closed.init(root_key(0))) for closed in good]
    return next((pair for pair in found if not certify(*pair).stalls), found[0])


def sample_updates(rng: np.random.Generator, samples: int) -> dict[str, NDArray[np.floating]]:
    """Where updates go: [samples] each of log_ratio, advantage and progress.

    Log-ratios are normal with a standard deviation of 0.3, a tenth of them with 0.6, cut off at
    ±1.2; advantages are standard normal; training fractions are uniform. Heavier tails would leave
    R² to a handful of points.
    """
    spread = np.where(rng.uniform(size=samples) < 0.1, 0.6, 0.3)
    return {
        "log_ratio": np.clip(rng.standard_normal(samples) * spread, -1.2, 1.2),
        "advantage": rng.standard_normal(samples),
        "progress": rng.uniform(size=samples),
    }


def fit_quality(
    objective: "Objective",
    drift: ClosedFormDrift,
    parameters: Any,
    points: Mapping[str, NDArray[np.floating]],
) -> dict[str, float]:
    """R² of a closed form: of the "drift", and of the "slope" d f/d(log r) by differentiation."""
    x, a, p = (jnp.asarray(points[k], jnp.float32) for k in ("log_ratio", "advantage", "progress"))

    def both(f: Any, parameters: Any) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        slope = jax.grad(lambda x: f(parameters, x, a, p).sum())(x)
        return np.asarray(f(parameters, x, a, p), float), np.asarray(slope, float)

    target, found = both(objective.drift, objective.parameters), both(drift, parameters)
    return {name: _r2(t, f) for name, t, f in zip(("drift", "slope"), target, found, strict=True)}


def _r2(target: NDArray[np.floating], found: NDArray[np.floating]) -> float:
    spread = ((target - target.mean()) ** 2).sum()
    return float(1.0 - ((target - found) ** 2).sum() / spread) if spread > 0 else 0.0
