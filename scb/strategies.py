"""Evolution strategies: any of evosax's by name, behind one interface that maximises."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optax

from scb.errors import UserError
from scb.keys import root_key, split_key
from scb.start import unstarted

with unstarted():
    import evosax.algorithms

if TYPE_CHECKING:
    from scb.evolution import EvolutionConfig

# These take constructor arguments of their own that no common configuration can supply; gradientless
# descent draws within radii of its own, whatever sigma is.
_UNSUPPORTED = {"RandomSearch", "SV_CMA_ES", "SV_Open_ES", "GradientlessDescent"}
# These estimate a gradient and hand it to an optimiser; the others' update rules set their own
# step.
GRADIENT_ESTIMATING = {
    "ARS",
    "ASEBO",
    "ESMC",
    "GuidedES",
    "NoiseReuseES",
    "Open_ES",
    "PersistentES",
    "PGPE",
}
STRATEGIES: dict[str, Any] = {
    name: algorithm
    for name, algorithm in evosax.algorithms.algorithms.items()
    if name not in _UNSUPPORTED
}
# These have a search distribution with a mean; the others keep a population.
DISTRIBUTIONS = set(evosax.algorithms.distribution_based_algorithms)
# Of these the deviation follows a schedule; the others adapt it, or have none.
SCHEDULED = {
    name
    for name, algorithm in STRATEGIES.items()
    if "std_schedule" in algorithm.__init__.__annotations__
}
# These compare a fitness with those of earlier generations, or return the best that ever was, so that fitness has to
# mean the same in all.
REMEMBERING = {
    "CMAAnchoredLES",
    "EvoTF_ES",
    "HillClimbing",
    "LES",
    "SimulatedAnnealing",
    "iAMaLGaM_Full",
    "iAMaLGaM_Univariate",
    *(STRATEGIES.keys() - DISTRIBUTIONS),
}


def check_memory(strategy: str, because: str, instead: str) -> None:
    """Raises a UserError where fitness does not mean the same in all generations, and a strategy remembers it.

    Args:
      because: why it does not, as a relative clause.
      instead: what else to choose than another strategy.
    """
    if strategy in REMEMBERING:
        raise UserError(
            f"{strategy} compares fitness with that of earlier generations, {because}: {instead}, or choose another "
            "strategy, such as SNES."
        )


class Strategy:
    """An evosax strategy behind one interface. Runs on one device; fitness comes and goes through the host."""

    def __init__(self, config: "EvolutionConfig", solution: Any) -> None:
        algorithm = STRATEGIES[config.strategy]
        self._sigma, self._name = config.sigma, config.strategy
        self._size = config.population_size
        # The others have no mean to judge before the first tell.
        self.has_mean = config.strategy in DISTRIBUTIONS
        arguments: dict[str, Any] = {}
        if config.strategy in SCHEDULED:
            arguments["std_schedule"] = lambda generation: jnp.maximum(
                config.sigma * config.sigma_decay**generation, config.sigma_limit
            )
        if config.strategy in GRADIENT_ESTIMATING:
            arguments["optimizer"] = optax.adam(
                lambda count: jnp.maximum(
                    config.learning_rate * config.learning_rate_decay**count,
                    config.learning_rate_limit,
                )
            )
        try:
            self._algorithm = algorithm(config.population_size, solution, **arguments)
        except AssertionError as error:
            # Antithetic pairs, groups, subspaces: what each strategy asserts about sizes.
            weights = sum(np.size(leaf) for leaf in jax.tree.leaves(solution))
            raise UserError(
                f"{config.strategy} does not take a population_size of {config.population_size} for {weights} weights "
                f"({error}): choose another size or strategy."
            ) from error
        self._params = self._algorithm.default_params
        if self.has_mean:
            self._check_size(solution)
        if hasattr(self._params, "std_init"):
            # evosax starts SNES at a standard deviation of 1; the paper's is 0.05.
            self._params = self._params.replace(std_init=config.sigma)

    def _check_size(self, solution: Any) -> None:
        """ESMC asks for fewer where their number is odd, which its own assertion does not say."""

        def ask(key: jax.Array) -> Any:
            state = self._algorithm.init(key, solution, self._params)
            return self._algorithm.ask(key, state, self._params)[0]

        asked = len(jax.tree.leaves(jax.eval_shape(ask, root_key(0)))[0])
        if asked != self._size:
            raise UserError(
                f"{self._name} does not take a population_size of {self._size}, of which it would ask for {asked}: "
                "choose an even size or another strategy."
            )

    def start(self, key: jax.Array, solution: Any, units: Any = None) -> Any:
        """The state before the first ask; `units`, a tree like the solution, are factors on its initial deviations."""
        if units is not None:
            self.check_units(solution)
            state = self._algorithm.init(key, solution, self._params)
            return state.replace(std=state.std * jax.flatten_util.ravel_pytree(units)[0])
        if self.has_mean:
            return self._algorithm.init(key, solution, self._params)
        key_population, key_init = split_key(key)
        flat, unravel = jax.flatten_util.ravel_pytree(solution)
        noise = jax.random.normal(key_population, (self._size, flat.size))
        population = jax.vmap(unravel)(flat + self._sigma * noise.at[0].set(0.0))
        # Worse than anything evaluated, but finite: strategies that standardise would make NaN of
        # infinity.
        unknown = jnp.full(self._size, 1e9)
        return self._algorithm.init(key_init, population, unknown, self._params)

    def check_units(self, solution: Any) -> None:
        """Raises a UserError where the strategy has no deviation for each weight, which units ask for."""
        weights = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(solution))
        state = None
        if self.has_mean:
            state = jax.eval_shape(
                lambda: self._algorithm.init(root_key(0), solution, self._params)
            )
        if np.shape(getattr(state, "std", 0.0)) != (weights,):
            raise UserError(
                f"{self._name} has one deviation for all weights, and those of this bandit have different sizes: "
                "choose SNES, or the form networks."
            )

    def ask(self, key: jax.Array, state: Any) -> tuple[Any, Any]:
        return self._algorithm.ask(key, state, self._params)

    def tell(self, key: jax.Array, population: Any, fitness: np.ndarray, state: Any) -> Any:
        # The negation of a population's fitness: fitness is maximised everywhere, evosax minimises.
        state, _ = self._algorithm.tell(key, population, -jnp.asarray(fitness), state, self._params)
        return state

    def mean(self, state: Any) -> Any:
        """The search distribution's mean; for strategies that keep a population, the best solution told so far."""
        if self.has_mean:
            return self._algorithm.get_mean(state)
        return self._algorithm._unravel_solution(state.best_solution)


def strategy_for(config: "EvolutionConfig", solution: Any) -> Strategy:
    """One for all searches that differ in nothing it sees: evosax compiles anew for every algorithm made."""
    leaves, structure = jax.tree.flatten(solution)
    shapes = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    config = replace(
        config,
        num_generations=1,
        combine="mean",
        averaging=1,
        mean_evaluations=1,
        evaluate_mean_every=1,
        checkpoint_every=1,
        seed=0,
    )
    return _shared_strategy(config, structure, shapes)


@lru_cache(maxsize=8)
def _shared_strategy(config: "EvolutionConfig", structure: Any, shapes: Any) -> Strategy:
    return Strategy(config, jax.tree.unflatten(structure, [jnp.zeros(*x) for x in shapes]))
