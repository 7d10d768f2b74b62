"""What a drift does to an update, in numbers: where it lets the policy move, stops it or turns it round.

PPO maximises `mean(r A - f(r, A))`. Of a drift f only the gradient reaches the policy, so a drift is
read here as what it leaves of the plain surrogate's gradient, the *relative gradient*

    h(r, A) = d(r A - f)/d(log r) / (r A) = 1 - (df/dr) / A,

which is 1 where nothing is charged, 0 where the update stops and negative where it turns round.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scb.agents.drift import USUAL_CLIP
from scb.errors import UserError

if TYPE_CHECKING:
    from lpo.objectives import Objective

# A twentieth of the surrogate's gradient counts as none; as much more or less as no change.
TOLERANCE = 0.05
RATIOS = (0.5, 2.0)
ADVANTAGES = (-3.0, 3.0)

# In the order in which tables and figures show them.
REGIONS = {
    "rolls back": "the ratio has moved in the advantage's direction and the gradient moves it back: h < -0.05",
    "flat": "it has moved in the advantage's direction and the gradient is gone: -0.05 <= h <= 0.05",
    "cautious": "it has moved so inside PPO's clip, and the gradient is damped: 0.05 < h < 0.95",
    "free": "the surrogate's own gradient, 0.95 <= h <= 1.05, inside PPO's clip or on the way back to 1",
    "optimistic": "it has moved so beyond PPO's clip, where PPO stops, and still goes on: h > 0.05",
    "amplified": "more than the surrogate's gradient, inside PPO's clip or on the way back to 1: h > 1.05",
    "hindered": "it has moved against the advantage, and its way back to 1 is damped or barred: h < 0.95",
}


@dataclass(frozen=True)
class Analysis:
    """A drift on a grid, at one fraction of training done.

    Attributes:
      objective: its name.
      progress: the fraction.
      log_ratios, advantages: [R] in nats, and [A] in standard deviations of a minibatch; neither
        holds a 0, where there is no direction to judge.
      drift: [A, R] f.
      gradient: [A, R] d(r A - f)/d(log r), of the whole objective.
      relative: [A, R] h, the share of the surrogate's gradient that is left.
      regions: [A, R] index into the names of `REGIONS`.
      fractions: of the grid, by region, summing to 1: uniform in log r, and advantages weighted by
        the standard normal density.
      beyond: the same of only that part where PPO's clip stops an update, beyond the clip in the
        advantage's direction: {"positive" or "negative" advantages: {region: share}}, each summing
        to 1.
      stops: {advantage: the first ratio, going from 1 in its direction, at which h <= 0.05; None
        where there is none up to the ends of `RATIOS`}, for advantages of +1 and -1.
    """

    objective: str
    progress: float
    log_ratios: NDArray[np.floating]
    advantages: NDArray[np.floating]
    drift: NDArray[np.floating]
    gradient: NDArray[np.floating]
    relative: NDArray[np.floating]
    regions: NDArray[np.integer]
    fractions: dict[str, float]
    beyond: dict[str, dict[str, float]]
    stops: dict[float, float | None]

    def as_dict(self) -> dict[str, Any]:
        """What a table needs; the grids' values stay out."""
        return {
            "objective": self.objective,
            "progress": self.progress,
            "fractions": self.fractions,
            "beyond": self.beyond,
            "stops": {f"{advantage:+g}": ratio for advantage, ratio in self.stops.items()},
        }


def analyze(
    objective: "Objective",
    progress: float = 0.5,
    log_ratios: NDArray[np.floating] | None = None,
    advantages: NDArray[np.floating] | None = None,
) -> Analysis:
    """Where an objective rolls back, stops, holds back and lets go.

    Args:
      objective: any that `load_objective` gives.
      progress: fraction of training done, for drifts that depend on it.
      log_ratios: [R] evenly spaced; 400 midpoints between the logarithms of `RATIOS` if left out.
      advantages: [A] evenly spaced; 240 midpoints between `ADVANTAGES` if left out.

    Raises:
      UserError: a grid holds a zero, the fraction is outside [0, 1], or the objective has no gradient somewhere.
    """
    if not 0.0 <= progress <= 1.0:
        raise UserError(f"progress is {progress}: it is a fraction of training, from 0 to 1.")
    low, high = np.log(RATIOS)
    x = midpoints(low, high, 400) if log_ratios is None else np.asarray(log_ratios, float)
    a = midpoints(*ADVANTAGES, 240) if advantages is None else np.asarray(advantages, float)
    for name, values in (("log-ratios", x), ("advantages", a)):
        if not values.all():
            raise UserError(f"the {name} hold a 0, where no direction can be judged: leave it out.")
    drift, gradient = surface(objective, x, a, progress)
    relative = gradient / (np.exp(x) * a[:, None])
    without = ~np.isfinite(relative) | ~np.isfinite(drift)
    if without.any():
        row, column = np.argwhere(without)[0]
        raise UserError(
            f"{objective.name} is no number on {without.mean():.0%} of the grid, such as at a ratio of "
            f"{np.exp(x[column]):.3g} with an advantage of {a[row]:.3g}: there is nothing to show there, nor to "
            "train with."
        )
    regions = classify(relative, x, a)
    weights = np.broadcast_to(np.exp(-0.5 * a**2)[:, None], regions.shape)
    past = (x * a[:, None] > 0.0) & (np.abs(np.expm1(x)) > USUAL_CLIP)
    signs = {"positive": a > 0.0, "negative": a < 0.0}
    return Analysis(
        objective=objective.name,
        progress=progress,
        log_ratios=x,
        advantages=a,
        drift=drift,
        gradient=gradient,
        relative=relative,
        regions=regions,
        fractions=_shares(regions, weights),
        beyond={name: _shares(regions, weights * (past & s[:, None])) for name, s in signs.items()},
        stops={sign: _stop(objective, sign, progress) for sign in (1.0, -1.0)},
    )


def classify(
    relative: NDArray[np.floating],
    log_ratios: NDArray[np.floating],
    advantages: NDArray[np.floating],
) -> NDArray[np.integer]:
    """[A, R] relative gradients, [R], [A] -> [A, R] indices into `REGIONS`, whose texts define them."""
    names = list(REGIONS)
    forward = log_ratios * advantages[:, None] > 0.0
    inside = np.broadcast_to(np.abs(np.expm1(log_ratios)) <= USUAL_CLIP, relative.shape)
    conditions = {
        "rolls back": forward & (relative < -TOLERANCE),
        "flat": forward & (np.abs(relative) <= TOLERANCE),
        "optimistic": forward & ~inside,
        "cautious": forward & (relative < 1.0 - TOLERANCE),
        "hindered": ~forward & (relative < 1.0 - TOLERANCE),
        "amplified": relative > 1.0 + TOLERANCE,
    }
    # The first condition that is met counts, so the later ones need not repeat the earlier.
    return np.select(
        list(conditions.values()), [names.index(name) for name in conditions], names.index("free")
    )


def surface(
    objective: "Objective",
    log_ratios: NDArray[np.floating],
    advantages: NDArray[np.floating],
    progress: float,
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """[A, R] drift f, and [A, R] gradient d(r A - f)/d(log r), on a grid of [R] log-ratios and [A] advantages."""
    x, a = (jnp.asarray(v, jnp.float32) for v in np.meshgrid(log_ratios, advantages))
    shape = x.shape

    def charge(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        f = objective.drift(objective.parameters, x, a.ravel(), jnp.full_like(x, progress))
        return f.sum(), f  # elementwise: the gradient of the sum is that of each

    slope, drift = jax.jit(jax.grad(charge, has_aux=True))(x.ravel())
    surrogate = np.exp(log_ratios) * advantages[:, None]
    return (
        np.asarray(drift, float).reshape(shape),
        surrogate - np.asarray(slope, float).reshape(shape),
    )


def midpoints(low: float, high: float, count: int) -> NDArray[np.floating]:
    """[count] middles of equal cells between two bounds: an even number of them misses the centre."""
    return low + (np.arange(count) + 0.5) * (high - low) / count


def _shares(regions: NDArray[np.integer], weights: NDArray[np.floating]) -> dict[str, float]:
    # A grid may hold nothing of a part; then its shares are all zero.
    total = max(float(weights.sum()), 1e-12)
    return {name: float(weights[regions == i].sum() / total) for i, name in enumerate(REGIONS)}


def _stop(objective: "Objective", advantage: float, progress: float) -> float | None:
    end = np.log(RATIOS[1] if advantage > 0 else RATIOS[0])
    away = np.linspace(0.0, end, 2001)[1:]
    _, gradient = surface(objective, away, np.array([advantage]), progress)
    stopped = gradient[0] / (np.exp(away) * advantage) <= TOLERANCE
    return float(np.exp(away[stopped.argmax()])) if stopped.any() else None
