"""Check numerically that a drift is one: the conditions of mirror learning on a dense grid.

Kuba et al. (2022) ask of a drift f that f >= 0 everywhere, and that its value and its gradient
vanish where the new policy equals the old. Those carry the guarantee of monotonic improvement; a
drift should not be used without them. Learned drifts and formulas meet them by construction, whatever
their weights are: of those the slope beside ratio 1 is what is judged.
"""

from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.contract import Drift
from scb.agents.drift import MAX_LOG_RATIO, check_drift
from scb.errors import UserError, count_at_least
from scb.keys import root_key
from scb.objectives import Objective

# As much as the advantages of a minibatch of 1000 correlate with any direction by chance, 1 / sqrt(1000).
LARGEST_KINK = 0.03
# What 32 bits leave of nothing where two numbers are taken from each other, as a share of these.
ROUNDING = 8 * float(np.finfo(np.float32).eps)
# Where a drift depends on the fraction of training that is done, it is looked at for this many.
FRACTIONS = 21


@dataclass(frozen=True)
class Certificate:
    """What was found on the grid.

    Attributes:
      holds: finite and non-negative everywhere, and value and gradient zero at ratio 1, as far as 32 bits tell a
        difference of a surrogate's terms from zero. The gradient is automatic differentiation's, whose relu has none
        at 0: a penalty that rises right at ratio 1 is told by `kink_at_one`, and where it does, by `stalls`.
      minimum: smallest penalty on the grid.
      value_at_one: largest |f| at ratio 1 over all advantages.
      gradient_at_one: largest |df/dr| there.
      slope_at_0_001: largest |df/dr| at |r - 1| = 0.001. Not a condition, but a drift whose slope jumps
        just outside its dead zone is one in name only.
      slope_at_0_01: the same at 0.01.
      kink: how much the penalty rises per unit of |log-ratio| around ratio 1 (at |r - 1| = 0.01), the
        mean over standard normal advantages. No condition either: but where the advantages of a
        minibatch correlate less than that with every direction that the policy could take, an update
        stays where it is.
      finite: no NaN or infinity, out to the largest ratio that training meets.
      grid: what the grid was.
      by_construction: whether every drift of its family holds, so that `holds` says no more than that
        the weights are finite.
      kink_at_one: where the line through the kinks at |r - 1| = 0.01 and 0.001 meets ratio 1; None in artefacts
        of before it was measured.
    """

    holds: bool
    minimum: float
    value_at_one: float
    gradient_at_one: float
    slope_at_0_001: float
    slope_at_0_01: float
    kink: float
    finite: bool
    grid: str
    by_construction: bool = False
    kink_at_one: float | None = None

    @property
    def stalls(self) -> bool:
        """Whether it may hold a policy still: the penalty rises right at ratio 1, and by more than `LARGEST_KINK`.

        Of a penalty that begins smoothly, as KL does, or further out, as a clip, nothing is left there.
        """
        return self.deciding_kink > LARGEST_KINK

    @property
    def deciding_kink(self) -> float:
        """`kink_at_one`, or `kink` where that was not measured."""
        return self.kink if self.kink_at_one is None else self.kink_at_one

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def __str__(self) -> str:
        verdict = "is a drift" if self.holds else "is NOT a drift"
        if self.holds and self.by_construction:
            verdict += " whatever its weights"
        if not self.finite:
            verdict += ", and no number on a part of the grid"
        if self.stalls:
            verdict += f", but one that MAY HOLD A POLICY STILL, with a kink above {LARGEST_KINK}"
        return (
            f"{verdict}: min f {self.minimum:.3g}, at ratio 1 |f| {self.value_at_one:.3g} and |df/dr| "
            f"{self.gradient_at_one:.3g}, |df/dr| {self.slope_at_0_001:.3g} at |r - 1| = 0.001 and "
            f"{self.slope_at_0_01:.3g} at 0.01, kink {self.kink:.3g} at 0.01 and {self.deciding_kink:.3g} "
            f"carried on to ratio 1 ({self.grid})"
        )


def certify(
    drift: Drift | Objective,
    parameters: Any = None,
    num_ratios: int = 2001,
    num_advantages: int = 401,
) -> Certificate:
    """Evaluates a drift on a grid of ratios and advantages, and its slope around ratio 1.

    Args:
      drift: any member of the contract, or an objective, which has its parameters.
      parameters: of a drift; what it starts with where they are left out.
      num_ratios: points of log-ratio, in [-3, 3] and, a quarter as many, out to the bound that
        training clips at; at least 3, and one more where they are even.
      num_advantages: points of advantage in [-10, 10], the tails of a normalised minibatch; so are they.

    Raises:
      UserError: it is no drift, or cannot take the parameters, or there are fewer points.
    """
    count_at_least(3, num_ratios=num_ratios, num_advantages=num_advantages)
    if not isinstance(drift, Drift):
        if not isinstance(getattr(drift, "drift", None), Drift):
            raise UserError(
                f"something of the class {type(drift).__name__} is no drift: give one with its parameters, or what "
                "lpo.load_objective returns."
            )
        if parameters is not None:
            raise UserError(
                "an objective comes with its own parameters: leave them out, or give its drift with others."
            )
        return certify(drift.drift, drift.parameters, num_ratios, num_advantages)
    parameters = drift.init(root_key(0)) if parameters is None else parameters
    advice = "it takes those of its own family, as objective.drift takes objective.parameters"
    check_drift(drift, parameters, advice=advice)
    inner = np.linspace(-3.0, 3.0, num_ratios | 1)
    outer = np.linspace(-MAX_LOG_RATIO, MAX_LOG_RATIO, (num_ratios // 4) | 1)
    log_ratios = jnp.asarray(np.union1d(inner, outer), jnp.float32)
    advantages = jnp.linspace(-10.0, 10.0, num_advantages | 1)
    by_construction = drift.always_holds
    # Most drifts are the same at every fraction of the training.
    progress_values = np.linspace(0, 1, FRACTIONS if drift.temporal else 1)
    # The whole grid, which takes long, tells of a drift by construction whether its weights are finite, and no more.
    on_whole_grid = progress_values[:: FRACTIONS // 2] if by_construction else progress_values

    def penalty(log_ratio: jax.Array, advantage: jax.Array, progress: float) -> jax.Array:
        return drift(
            parameters, log_ratio[None], advantage[None], jnp.full((1,), progress, jnp.float32)
        )[0]

    def on_grid(function: Any) -> Any:
        over_advantages = jax.vmap(function, in_axes=(None, 0, None))
        return jax.jit(jax.vmap(over_advantages, in_axes=(0, None, None)))

    def slope(log_ratio: jax.Array, advantage: jax.Array, progress: float) -> jax.Array:
        # d f / d r = (d f / d log r) / r
        return jax.grad(penalty)(log_ratio, advantage, progress) / jnp.exp(log_ratio)

    values, slopes = on_grid(penalty), on_grid(slope)

    def largest_slope(ratios: list[float]) -> float:
        points = jnp.log(jnp.asarray(ratios))
        # np.max and not max: the built-in passes over a NaN that is not the first.
        return float(
            np.max([jnp.abs(slopes(points, advantages, p)).max() for p in progress_values])
        )

    def kinks(distance: float) -> np.ndarray:
        """At every fraction of the training."""
        points = jnp.log(jnp.asarray([1.0 + distance, 1.0 - distance]))
        weights = jnp.exp(-(advantages**2) / 2)
        sides = [slopes(points, advantages, progress) for progress in progress_values]
        rises = [jnp.sum(weights * (right - left)) for right, left in sides]
        return np.asarray(rises) / (2 * float(jnp.sum(weights)))

    # What a surrogate is taken away from, ratio times advantage, or the ratios themselves.
    parts = np.maximum(np.exp(log_ratios), 1.0)[:, None] * np.maximum(np.abs(advantages), 1.0)
    grid = [np.asarray(values(log_ratios, advantages, progress)) for progress in on_whole_grid]
    at_one = [np.asarray(values(jnp.zeros(1), advantages, p)) for p in progress_values]
    finite = all(np.isfinite(x).all() for x in grid)
    minimum = float(np.nanmin(grid))
    nowhere_negative = float(np.nanmin(grid + ROUNDING * parts)) >= 0.0
    nothing = ROUNDING * float(np.abs(advantages).max())
    value_at_one = float(np.abs(at_one).max())
    gradient_at_one = largest_slope([1.0])
    near, further = kinks(0.001), kinks(0.01)
    return Certificate(
        holds=finite
        and nowhere_negative
        and value_at_one <= nothing
        and gradient_at_one <= nothing,
        minimum=minimum,
        value_at_one=value_at_one,
        gradient_at_one=gradient_at_one,
        slope_at_0_001=largest_slope([0.999, 1.001]),
        slope_at_0_01=largest_slope([0.99, 1.01]),
        kink=float(np.max(further)),
        kink_at_one=float(np.max(10 * near - further) / 9),
        finite=finite,
        grid=f"{len(log_ratios)} log-ratios in [-{MAX_LOG_RATIO:g}, {MAX_LOG_RATIO:g}] x "
        f"{len(advantages)} advantages in [-10, 10] x {len(on_whole_grid)} training fraction"
        + ("s" if len(on_whole_grid) > 1 else "")
        + (
            f", ratio 1 at {len(progress_values)}"
            if len(on_whole_grid) < len(progress_values)
            else ""
        ),
        by_construction=by_construction,
    )
