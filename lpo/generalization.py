"""Does an objective carry over? Train PPO with several objectives on the same seeds and compare.

Every objective meets the same seeds: the same initial networks, start states and evaluation
episodes, so that differences are paired. Final scores are interquartile means with bootstrap
intervals.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpo.objectives import Objective
from scb.agents.ppo import PPO, PPOConfig
from scb.agents.spec import AgentSpec, environment_agent
from scb.environments.registry import environment_spec, make
from scb.errors import UserError
from scb.evolution import map_population
from scb.keys import root_key
from scb.statistics import Estimate, estimate, paired_difference


@dataclass(frozen=True)
class LearningCurves:
    """Returns of agents over their training.

    Attributes:
      environment, backend: where; the backend is None outside Brax.
      objective: with which.
      steps: [P] environment steps at each evaluation, the first 0.
      returns: [S, P] mean return of `episodes` episodes, per seed.
      mode_actions: whether evaluation took the most likely actions or sampled ones.
      policy_output_scale: factor on the policy's last layer at initialisation.
    """

    environment: str
    backend: str | None
    objective: str
    steps: np.ndarray
    returns: np.ndarray
    seeds: list[int]
    episodes: int
    mode_actions: bool
    policy_output_scale: float = 1.0

    @property
    def final(self) -> np.ndarray:
        """[S] return at the end of training."""
        return self.returns[:, -1]

    @property
    def area(self) -> np.ndarray:
        """[S] mean return over the training, the untrained agent left out."""
        return self.returns[:, 1:].mean(axis=1)

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "LearningCurves":
        """What `as_dict` wrote."""
        names = ("environment", "backend", "objective", "seeds", "episodes", "mode_actions")
        return cls(
            steps=np.asarray(stored["steps"]),
            returns=np.asarray(stored["returns"]),
            **{name: stored[name] for name in names},
            policy_output_scale=stored.get("policy_output_scale", 1.0),
        )

    def as_dict(self) -> dict[str, Any]:
        return {
            "environment": self.environment,
            "backend": self.backend,
            "objective": self.objective,
            "steps": self.steps.tolist(),
            "returns": self.returns.tolist(),
            "seeds": self.seeds,
            "episodes": self.episodes,
            "mode_actions": self.mode_actions,
            "policy_output_scale": self.policy_output_scale,
            "final_iqm": estimate(self.final).as_dict(),
            "area_iqm": estimate(self.area).as_dict(),
        }


def evaluation_interval(num_iterations: int, points: int) -> int:
    """The number of iterations between evaluations that divides the training and gives about `points` of them."""
    divisors = [n for n in range(1, num_iterations + 1) if num_iterations % n == 0]
    return min(divisors, key=lambda n: abs(num_iterations / n - points))


def _rounded_to_points(config: PPOConfig, points: int) -> PPOConfig:
    evaluations = config.num_iterations / evaluation_interval(config.num_iterations, points)
    if points / 2 <= evaluations <= points * 2:
        return config
    # A prime number of iterations has no divisors to evaluate at: round up to a multiple of the
    # points.
    iterations = -(-config.num_iterations // points) * points
    return replace(config, total_steps=iterations * config.batch_size)


def check_seeds(seeds: Sequence[int]) -> None:
    """Raises a UserError where there are no seeds, or one is not a number of 32 bits."""
    if not seeds:
        raise UserError("no seeds: give at least one.")
    for seed in seeds:
        if not 0 <= seed < 2**32:
            raise UserError(f"a seed is {seed}: each must be 0 or larger, and below 2^32.")


def learning_curves(
    environment: str,
    objective: Objective,
    seeds: Sequence[int],
    spec: AgentSpec | None = None,
    backend: str | None = None,
    points: int = 15,
    episodes: int = 20,
    mode_actions: bool = True,
) -> LearningCurves:
    """Trains one PPO agent a seed with the objective, evaluating along the way.

    Args:
      environment: a name that `scb.make` takes.
      objective: what replaces PPO's surrogate.
      seeds: one agent each; the same seeds pair agents of different objectives.
      spec: PPO's; the environment's own where None. Where its number of batches has no divisor that
        gives about `points` evaluations, it is rounded up to a multiple of `points`.
      backend: Brax physics ("generalized", "positional", "spring"); only for Brax environments.
      points: about how many evaluations along the training, the untrained agent not counted.
      episodes: of each evaluation.
      mode_actions: evaluate the most likely actions rather than sampled ones.
    """
    return _family_curves(
        environment,
        [objective],
        seeds,
        spec,
        backend,
        points,
        episodes,
        mode_actions,
    )[0]


def families(objectives: Sequence[Objective]) -> list[list[Objective]]:
    """Objectives that differ in their drifts' parameters alone stand together: one program trains them all."""
    found: list[list[Objective]] = []
    for objective in objectives:
        family = next((f for f in found if f[0].drift == objective.drift), None)
        if family is None:
            found.append([objective])
        else:
            family.append(objective)
    return found


def over_objectives(
    mapped: Callable[[Any, np.ndarray], Any], objectives: Sequence[Objective], seeds: Sequence[int]
) -> Any:
    """Calls a function for every objective of a family with every seed, all at once.

    Args:
      mapped: ([N] drift parameters, [N] seeds) -> pytree of [N, ...], such as `map_population` makes.

    Returns:
      The pytree, every leaf [objectives, seeds, ...].
    """
    parameters = jax.tree.map(
        lambda *leaves: jnp.repeat(jnp.stack(leaves), len(seeds), axis=0),
        *(objective.parameters for objective in objectives),
    )
    results = mapped(parameters, np.tile(np.asarray(seeds, np.uint32), len(objectives)))
    shape = (len(objectives), len(seeds))
    return jax.tree.map(lambda x: np.reshape(x, (*shape, *x.shape[1:])), results)


def _family_curves(
    environment: str,
    objectives: Sequence[Objective],
    seeds: Sequence[int],
    spec: AgentSpec | None = None,
    backend: str | None = None,
    points: int = 15,
    episodes: int = 20,
    mode_actions: bool = True,
) -> list[LearningCurves]:
    """`learning_curves` of objectives that share a drift, on the same seeds."""
    check_seeds(seeds)
    for name, value in (("points", points), ("episodes", episodes)):
        if value < 1:
            raise UserError(f"{name} is {value}: it must be at least 1.")
    env, env_params = make(environment, backend)
    spec = spec or environment_agent("ppo", environment)
    config = _rounded_to_points(spec.config, min(points, spec.config.num_iterations))
    agent = PPO(env, config, objectives[0].drift)
    every = evaluation_interval(config.num_iterations, points)

    def train(parameters: Any, seed: jax.Array) -> jax.Array:
        def judge(state: Any, key: jax.Array) -> jax.Array:
            return agent.evaluate(
                state, key, episodes, env_params=env_params, mode=mode_actions
            ).returns.mean()

        hyperparameters = replace(spec.hyperparameters, drift=parameters)
        _, returns = agent.train_with_evaluations(
            root_key(seed), hyperparameters, env_params, judge, every
        )
        return returns

    # In double precision, so that curves read back from JSON give the same estimates.
    mapped = map_population(train, len(objectives) * len(seeds), (0, 0))
    returns = np.asarray(over_objectives(mapped, objectives, seeds), np.float64)
    steps = np.arange(returns.shape[2]) * every * config.batch_size
    return [
        LearningCurves(
            environment,
            environment_spec(environment).physics(backend),
            objective.name,
            steps,
            of_it,
            list(seeds),
            episodes,
            mode_actions,
            float(spec.hyperparameters.policy_output_scale),
        )
        for objective, of_it in zip(objectives, returns, strict=True)
    ]


@dataclass(frozen=True)
class Comparison:
    """Learning curves of several objectives on one environment, the first of them the reference."""

    curves: list[LearningCurves]

    def differences(self) -> dict[str, Estimate]:
        """{objective: paired difference of final IQM to the reference}, positive where it is better."""
        reference = self.curves[0]
        return {c.objective: paired_difference(c.final, reference.final) for c in self.curves[1:]}

    def table(self) -> list[dict[str, Any]]:
        """One row an objective: final and area IQM with intervals, difference to the reference."""
        differences = self.differences()
        return [
            {
                "objective": c.objective,
                "final": estimate(c.final),
                "area": estimate(c.area),
                "difference": differences.get(c.objective),
            }
            for c in self.curves
        ]

    def as_dict(self) -> dict[str, Any]:
        return {
            "curves": [c.as_dict() for c in self.curves],
            "reference": self.curves[0].objective,
            "paired_differences": {k: v.as_dict() for k, v in self.differences().items()},
        }


def check_names(objectives: Sequence[Objective]) -> None:
    """Raises a UserError where two objectives bear one name."""
    names = [objective.name for objective in objectives]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise UserError(
            f"objective {repeated[0]!r} is there twice: give each once, and each a name of its own."
        )


def compare(
    environment: str, objectives: Sequence[Objective], seeds: Sequence[int], **arguments: Any
) -> Comparison:
    """`learning_curves` of each objective on the same seeds.

    Raises:
      UserError: two objectives bear one name, by which their results would be told apart.
    """
    check_names(objectives)
    curves = [
        curve
        for family in families(objectives)
        for curve in _family_curves(environment, family, seeds, **arguments)
    ]
    names = [objective.name for objective in objectives]
    return Comparison(sorted(curves, key=lambda curve: names.index(curve.objective)))
