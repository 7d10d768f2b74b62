"""Does an objective carry over to many environments? Normalised scores over a suite, with intervals.

Agarwal et al. (2021): scores are normalised per environment, 0 a uniformly random policy and 1 a
reference, and aggregated by the interquartile mean over all runs of all environments, with intervals
from a bootstrap that resamples seeds within every environment.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lpo.comparison import Comparison, check_names, compare, ppo_spec
from lpo.objectives import Objective
from scb.environments.registry import environment_spec, families
from scb.errors import UserError, unknown_name
from scb.rows import Rows
from scb.statistics import Estimate, iqm, normalized_score

# Resampling is over seeds within environments, on [objectives, environments, seeds].
RESAMPLES = 2000


def suites() -> dict[str, tuple[str, ...]]:
    """{name: environments}: every family's own suite, and all of them together."""
    found = {name: family.suite for name, family in families().items() if family.suite}
    return found | {"all": tuple(name for names in found.values() for name in names)}


def suite(name: str) -> tuple[str, ...]:
    """The environments of a suite: classic, minatar, brax or all."""
    if name not in suites():
        raise unknown_name("suite", name, suites())
    return suites()[name]


@dataclass(frozen=True)
class SuiteScores:
    """Normalised scores of several objectives over several environments.

    Attributes:
      environments: names, in order.
      objectives: names, in order; the first is what the others are compared with.
      scores: [objectives, environments, seeds] of final returns.
      random, reference: [environments] returns that are 0 and 1.
      sources: [environments] where the reference is from.
      left_out: environments where no objective beat random actions, so that nothing normalises.
    """

    environments: list[str]
    objectives: list[str]
    scores: np.ndarray
    random: list[float]
    reference: list[float]
    sources: list[str]
    left_out: list[str]

    def aggregate(self) -> list[Estimate]:
        """Interquartile mean over environments and seeds, per objective."""
        return self._estimates(0.0)

    def differences(self) -> list[Estimate]:
        """Each aggregate minus the first objective's, paired by seed."""
        return self._estimates(1.0)

    def _estimates(self, times_reference: float) -> list[Estimate]:
        generator = np.random.default_rng(0)
        drawn = [_aggregate(_draw(self.scores, generator)) for _ in range(RESAMPLES)]
        # Resampled or not, alike.
        found = np.stack([_aggregate(self.scores), *drawn])
        found = found - times_reference * found[:, :1]
        size, ends = int(self.scores[0].size), np.percentile(found[1:], [2.5, 97.5], axis=0)
        if self.scores.shape[2] == 1:  # one seed says nothing of its spread
            return [Estimate(float(v), None, None, size) for v in found[0]]
        return [
            Estimate(float(v), float(low), float(high), size)
            for v, low, high in zip(found[0], *ends, strict=True)
        ]

    def profile(self, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Performance profiles: the share of runs above each threshold, environments weighted alike.

        Args:
          thresholds: [T] normalised scores.

        Returns:
          ([objectives, T] shares, and the low and high ends of their 95 % intervals).
        """
        above = (self.scores[..., None] > thresholds).astype(np.float64)
        share = above.mean(axis=(1, 2))
        generator = np.random.default_rng(0)
        drawn = np.stack([_draw(above, generator).mean(axis=(1, 2)) for _ in range(RESAMPLES // 4)])
        low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
        return share, low, high

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "environments": [
                {"name": name, "random": r, "reference": e, "source": s}
                for name, r, e, s in zip(
                    self.environments, self.random, self.reference, self.sources, strict=True
                )
            ],
            "left_out": self.left_out,
            "objectives": self.objectives,
            "scores": self.scores.tolist(),
            "aggregate": [x.as_dict() for x in self.aggregate()],
            "differences": [x.as_dict() for x in self.differences()],
        }


def _draw(scores: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """The same shape, seeds drawn anew within every environment, alike for all objectives."""
    _, environments, seeds = scores.shape[:3]
    picked = generator.integers(0, seeds, (environments, seeds))
    return scores[:, np.arange(environments)[:, None], picked]


def _aggregate(scores: np.ndarray) -> np.ndarray:
    """[objectives] interquartile means over all runs."""
    return np.asarray(iqm(scores.reshape(scores.shape[0], -1), axis=1))


def suite_scores(comparisons: Mapping[str, Comparison], random: Mapping[str, float]) -> SuiteScores:
    """Normalises the final returns of comparisons that share objectives and numbers of seeds.

    Args:
      comparisons: {environment: Comparison}.
      random: {environment: return of random actions}.

    Raises:
      UserError: other objectives or numbers of seeds in one than in another; no environment left.
    """
    normalisation, scores = [], []
    objectives = [c.objective for c in next(iter(comparisons.values())).curves]
    for name, comparison in comparisons.items():
        if [c.objective for c in comparison.curves] != objectives:
            raise UserError(f"{name} was run with other objectives than the rest: run all alike.")
        finals = np.stack([c.final for c in comparison.curves])
        reference, source = reference_of(name, comparison)
        if reference > random[name]:
            normalisation.append((name, random[name], reference, source))
            scores.append(normalized_score(finals, random[name], reference))
    if not scores:
        raise UserError("no objective is better than random actions anywhere: train longer.")
    if len({s.shape for s in scores}) > 1:
        raise UserError("environments were run with different numbers of seeds: run all alike.")
    kept, floors, ceilings, sources = map(list, zip(*normalisation, strict=True))
    left_out = [name for name in comparisons if name not in kept]
    stacked = np.stack(scores, axis=1)
    return SuiteScores(kept, objectives, stacked, floors, ceilings, sources, left_out)


def reference_of(name: str, comparison: Comparison) -> tuple[float, str]:
    """The return that counts as 1, and where it is from: a published one, else the best of the comparison."""
    reference = environment_spec(name).reference(comparison.curves[0].backend)
    if reference is not None:
        return reference.value, reference.source
    best = max(float(iqm(curve.final)) for curve in comparison.curves)
    return best, "the best objective here"


def run_suite(
    name: str,
    objectives: Sequence[Objective],
    seeds: Sequence[int],
    backend: str | None = None,
    tell: Callable[[str], None] = print,
    rows: Rows | None = None,
    steps: int | None = None,
    policy_output_scale: float | None = None,
    points: int = 5,
    **arguments: Any,
) -> tuple[SuiteScores, dict[str, Comparison]]:
    """Trains PPO with every objective in every environment of a suite.

    Args:
      name: of the suite.
      objectives: the first is what the others are compared with.
      seeds: of the agents, the same everywhere.
      backend: Brax physics, for the suite's Brax environments.
      tell: takes a line when an environment is done.
      rows: where results are kept, and found; what is there is not measured again.
      steps, policy_output_scale: of every training; each environment's own setting where None.
      points: about how many evaluations along a training. Only the last one is scored, and with
        episodes of a thousand steps fifteen take longer than the training itself.
      arguments: further ones of `compare`.
    """
    check_names(objectives)
    comparisons: dict[str, Comparison] = {}
    random: dict[str, float] = {}
    for environment_name in suite(name):
        spec = environment_spec(environment_name)
        physics = spec.physics(backend)
        random[environment_name] = spec.random_return(physics)
        comparison = compare(
            environment_name,
            objectives,
            seeds,
            spec=ppo_spec(environment_name, steps, policy_output_scale),
            backend=physics,
            points=points,
            rows=rows,
            **arguments,
        )
        comparisons[environment_name] = comparison
        finals = ", ".join(f"{c.objective} {float(iqm(c.final)):.1f}" for c in comparison.curves)
        tell(f"{environment_name} (random {random[environment_name]:.1f}): {finals}")
    return suite_scores(comparisons, random), comparisons
