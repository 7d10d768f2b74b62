"""Does an objective carry over to many environments? Normalised scores over a suite, with intervals.

Agarwal et al. (2021): scores are normalised per environment, 0 a uniformly random policy and 1 a
reference, and aggregated by the interquartile mean over all runs of all environments, with intervals
from a bootstrap that resamples seeds within every environment.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from lpo.comparison import Comparison, compare, ppo_spec
from lpo.objectives import Objective, check_names
from scb.agents.spec import AgentSpec
from scb.environments.registry import environment_spec, families
from scb.errors import UserError, one_of
from scb.rows import Rows
from scb.statistics import Estimate, iqm, normalized_score

# Resampling is over seeds within environments, on [objectives, environments, seeds].
RESAMPLES = 2000
TOGETHER = 100  # resamples at a time, which bounds memory
# About so many evaluations along a training, of which only the last is scored: with episodes of a thousand steps
# fifteen take longer than the training itself.
POINTS = 5
BEST_HERE = "the best objective here"


def suites() -> dict[str, tuple[str, ...]]:
    """{name: environments}: every family's own suite, and all of them together."""
    found = {name: family.suite for name, family in families().items() if family.suite}
    return found | {"all": tuple(name for names in found.values() for name in names)}


def suite(name: str) -> tuple[str, ...]:
    """The environments of a suite: classic, minatar, brax or all."""
    one_of("suite", name, suites())
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

    def without(self, *environments: str) -> "SuiteScores | None":
        """The scores of the others, such as those on which no objective was learned; None where none is left."""
        kept = [i for i, name in enumerate(self.environments) if name not in environments]
        if not kept:
            return None
        of_each = ("environments", "random", "reference", "sources")
        chosen = {name: [getattr(self, name)[i] for i in kept] for name in of_each}
        return replace(self, scores=self.scores[:, kept], **chosen)

    def _estimates(self, times_reference: float) -> list[Estimate]:
        def aggregate(runs: np.ndarray) -> np.ndarray:
            return iqm(self._scaled(runs).reshape(*runs.shape[:2], -1), axis=-1)

        found = _with_resamples(self.scores, aggregate, RESAMPLES)
        return _intervals(found - times_reference * found[:, :1], self.scores[0])

    def _scaled(self, runs: np.ndarray) -> np.ndarray:
        """Runs, where the best objective's are 1 by the best of these: which one that is is drawn with the seeds."""
        own = np.array([source == BEST_HERE for source in self.sources])
        best = iqm(runs, axis=-1).max(axis=1)
        # Where none of a resample beats random actions, the scale of all runs stays.
        return runs / np.where(own & (best > 0), best, 1.0)[:, None, :, None]

    def profile(self, thresholds: np.ndarray) -> list[list[Estimate]]:
        """Performance profiles: the share of runs above each threshold, environments weighted alike.

        Args:
          thresholds: [T] normalised scores.

        Returns:
          For every objective the shares with their 95 % intervals.
        """

        def share(runs: np.ndarray) -> np.ndarray:
            return np.mean(self._scaled(runs)[..., None] > thresholds, axis=(2, 3))

        found = _with_resamples(self.scores, share, RESAMPLES // 4)
        return [_intervals(found[:, i], self.scores[0]) for i in range(len(self.objectives))]

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


def _with_resamples(
    scores: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], number: int
) -> np.ndarray:
    """[1 + number, ...] a statistic of the scores, and of as many with seeds drawn anew within every environment.

    They are drawn alike for all objectives. The statistic takes [N, objectives, environments, seeds], several
    at once.
    """
    _, environments, seeds = scores.shape
    generator, every = np.random.default_rng(0), np.arange(environments)[:, None]
    found = [statistic(scores[None])]
    for start in range(0, number, TOGETHER):
        shape = (min(TOGETHER, number - start), environments, seeds)
        picked = generator.integers(0, seeds, shape)
        found.append(statistic(np.swapaxes(scores[:, every, picked], 0, 1)))
    return np.concatenate(found)


def _intervals(found: np.ndarray, runs: np.ndarray) -> list[Estimate]:
    """[1 + resamples, N] -> N estimates of [environments, seeds] runs, without an interval where there is one seed."""
    ends = np.percentile(found[1:], [2.5, 97.5], axis=0)
    known = runs.shape[1] > 1
    return [
        Estimate(float(v), float(low) if known else None, float(high) if known else None, runs.size)
        for v, low, high in zip(found[0], *ends, strict=True)
    ]


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
    return best, BEST_HERE


def suite_specs(
    name: str, steps: int | None, hyperparameters: Mapping[str, Any]
) -> dict[str, AgentSpec]:
    """{environment: PPO's specification there} of a suite.

    Raises:
      UserError: as `ppo_spec`, with the environment's name: what fits one's batches need not fit another's.
    """
    specs = {}
    for environment in suite(name):
        try:
            specs[environment] = ppo_spec(environment, steps, hyperparameters)
        except UserError as error:
            raise UserError(f"{environment}: {error}") from error
    return specs


def run_suite(
    name: str,
    objectives: Sequence[Objective],
    seeds: Sequence[int],
    backend: str | None = None,
    tell: Callable[[str], None] = print,
    rows: Rows | None = None,
    steps: int | None = None,
    hyperparameters: Mapping[str, Any] = MappingProxyType({}),
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
      steps, hyperparameters: of every training (`ppo_spec`); each environment's own setting where left out.
      arguments: further ones of `compare`.
    """
    specs = suite_specs(name, steps, hyperparameters)
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
            spec=specs[environment_name],
            backend=physics,
            points=POINTS,
            rows=rows,
            **arguments,
        )
        comparisons[environment_name] = comparison
        finals = ", ".join(f"{c.objective} {float(iqm(c.final)):.1f}" for c in comparison.curves)
        tell(f"{environment_name} (random {random[environment_name]:.1f}): {finals}")
        if comparison.caution:
            tell(f"{environment_name}: {comparison.caution}")
    return suite_scores(comparisons, random), comparisons
