"""A linear expert, by augmented random search (Mania et al., 2018, "V2-t").

A linear policy of normalised observations hops, and a bandit's small networks hold it better than the
networks of an agent that earns as much. What an environment pays for not falling is left out of the
search's fitness: else it finds to stand still. The same search finds the one action that is best held
throughout, which is all that humanoidstandup asks for.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from evosax.algorithms import ARS
from gymnax.environments import environment, spaces
from jax.tree_util import Partial
from jax.typing import ArrayLike
from rich.console import Console

from scb.agents.agent import AgentConfig
from scb.agents.networks import MLP
from scb.agents.normalization import RunningStatistics, merge_statistics, normalize
from scb.checkpoints import continued
from scb.console import Progress, progress_console
from scb.errors import UserError, at_least, fraction, positive
from scb.evaluation import Episodes, Policy, evaluate
from scb.experts import EPISODES, Expert, judged
from scb.keys import key_at, named_key, split_key
from scb.population import map_population
from scb.spaces import action_size, clip_to_space, flat_size, scale_to_space
from scb.stopwatch import Stopwatch

START_GENERATIONS = 20  # after which one of several searches goes on

# {"matrix": [O, A], "bias": [A]}; of a constant action the bias alone.
Linear = dict[str, jax.Array]
Worth = Callable[[Expert, jax.Array], tuple[float, int]]


@dataclass(frozen=True)
class LinearSearchConfig:
    """Augmented random search.

    Attributes:
      generations: steps of the search.
      starts: searches that are begun; the one whose policies earn most in their twentieth generation goes on. How
        fast a gait is found, and which, is luck.
      directions: perturbations of a generation, each tried both ways for one episode.
      best: of the directions, those that the step is made of.
      sigma: standard deviation of the perturbations.
      learning_rate: of the step.
      decay: factor on sigma and learning rate a generation.
      action_noise: standard deviation of Gaussian noise on the actions of all episodes but those of the
        expert's return, as a share of half their range. Under it a policy is found that bears errors,
        such as those of an agent that learned from it.
      action_errors: the scale of errors that are a function of the observation (`erring`), in the same
        episodes, each of which has a function of its own. An agent errs so: what it did not learn it
        gets wrong whenever it is there.
      error_warmup: generations over which the scale of these errors grows linearly to its end; 0 for all of it
        from the start, under which a gait is found late or never. Judgements are under all of it.
      episode_steps: at which the search's episodes are cut; the environment's own limit where None. Where
        nothing ends an episode early a gait shows in a fraction of it. Judgements are of whole episodes.
      judge_every: generations between judgements of the unperturbed policy, of 20 episodes each; the
        policy that was judged best is the expert.
      reach: how far a policy goes where it errs, in halves of the actions' range: reach * tanh(outputs), which is
        clipped after the errors. Above 1 they vanish far enough beyond an end, as those of an agent do
        whose mean action lies there, and what bears them switches between the ends. The expert is
        tanh(reach * outputs), which is as steep where it switches.
      normalization: the power of their deviations that observations are divided by. With 1 all entries weigh the
        same; with less, those that vary little weigh less, as they do for an agent that sees them as they are.
      constant: one action instead of a linear policy, each entry at an end of its range: what agents
        overshoot there they cannot get wrong.
    """

    generations: int = 200
    starts: int = 1
    directions: int = 32
    best: int = 8
    sigma: float = 0.03
    learning_rate: float = 0.02
    decay: float = 1.0
    action_noise: float = 0.0
    action_errors: float = 0.0
    error_warmup: int = 0
    episode_steps: int | None = None
    judge_every: int = 10
    reach: float = 1.0
    normalization: float = 1.0
    constant: bool = False

    def __post_init__(self) -> None:
        at_least(1, self, "generations", "starts", "directions", "best", "episode_steps")
        at_least(1, self, "judge_every", "reach")
        at_least(0, self, "action_noise", "action_errors", "error_warmup")
        fraction(self, "normalization")
        positive(self, "sigma", "learning_rate", "decay")
        if self.starts > 1 and self.generations < 2:
            raise UserError(
                f"there are {self.starts} starts, and {self.generations} generation to choose among them and go on: "
                "take at least 2, or one start."
            )
        if self.best > self.directions:
            raise UserError(f"best is {self.best} of {self.directions} directions: take no more.")


def search_linear_expert(
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    config: LinearSearchConfig | None = None,
    bonus: float = 0.0,
    quiet: bool = True,
    worth: Worth | None = None,
    folder: Path | None = None,
) -> Expert:
    """The best unperturbed policy of an augmented random search; its return is of episodes that chose nothing.

    Args:
      env, env_params: with continuous actions.
      key: decides everything.
      config: of the search.
      bonus: what every step pays without falling, which the fitness leaves out.
      quiet: no progress on the terminal.
      worth: (an expert that is not judged yet, a key) -> what it is judged by, and the environment steps
        that took; what it earns under the noise and errors of the search where None.
      folder: to keep the search in, after its starts and at every judgement, and to go on from; the same folder
        must not be given to another search. None keeps nothing.
    """
    config, console = config or LinearSearchConfig(), progress_console(quiet)
    search = _LinearSearch(env, env_params, key, config, bonus, worth)
    checkpoints, first, kept = continued(folder, search.begin(), console)
    earlier_seconds = float(kept["seconds"])
    if not first and config.starts > 1:
        first = min(START_GENERATIONS, config.generations - 1)
        kept = _best_start(search, config.starts, first, console)
        if checkpoints and first:
            checkpoints.save(first, kept)
    with Progress(console, config.generations, first) as advance:
        for number in range(first + 1, config.generations + 1):
            judging = number % config.judge_every == 0 or number == config.generations
            metrics = search.generation(kept, number, judging)
            if checkpoints and judging:
                checkpoints.save(number, kept)
            advance(metrics, metrics["seconds"])
    if checkpoints:
        checkpoints.close()
    found = search.expert(*kept["expert"])
    key_return, steps = named_key(key, "return"), int(kept["steps"])
    judgement = judged(found.policy, env, env_params, key_return, steps)
    return judgement._replace(reaching=found.reaching, earlier_seconds=earlier_seconds)


def _best_start(
    search: "_LinearSearch", starts: int, generations: int, console: Console
) -> dict[str, Any]:
    """Of several searches the one whose policies earn most in its last generation, which pays for all."""
    begun, fitness = [search.begin(start) for start in range(starts)], []
    for kept in begun:
        earned = 0.0
        for number in range(1, generations + 1):
            earned = search.generation(kept, number, judging=False)["fitness/mean"]
        fitness.append(earned)
        console.print(f"start {len(fitness)}/{starts}: {earned:.4g}")
    costs = {name: sum(kept[name] for kept in begun) for name in ("steps", "seconds")}
    return begun[int(np.argmax(np.nan_to_num(fitness, nan=-np.inf)))] | costs


class _LinearSearch:
    """The programs of a search, and what of it is kept from one generation to the next."""

    def __init__(
        self,
        env: environment.Environment[Any, Any],
        env_params: Any,
        key: jax.Array,
        config: LinearSearchConfig,
        bonus: float,
        worth: Worth | None,
    ) -> None:
        self._env, self._params, self._key = env, env_params, key
        self._config, self._bonus, self._worth = config, bonus, worth
        self._space = env.action_space(env_params)
        self._size = flat_size(env.observation_space(env_params))
        actions = action_size(self._space)
        self._zero = {"bias": jnp.zeros(actions)}
        if not config.constant:
            self._zero["matrix"] = jnp.zeros((self._size, actions))
        self._ars = ARS(
            2 * config.directions,
            self._zero,
            optimizer=optax.sgd(optax.exponential_decay(config.learning_rate, 1, config.decay)),
            std_schedule=optax.exponential_decay(config.sigma, 1, config.decay),
        )
        # Half a direction more, as evosax rounds down.
        self._ars.elite_ratio = min(1.0, (config.best + 0.5) / config.directions)
        self._roll = map_population(self._episode, 2 * config.directions, (0, None, 0, None))
        self._ask, self._tell = jax.jit(self._asked), jax.jit(self._told)
        self._mean_return = jax.jit(self._judged)

    def begin(self, start: int = 0) -> dict[str, Any]:
        """What is kept of a search before its first generation; arrays all."""
        seen = RunningStatistics.start(self._size)
        return {
            "start": jnp.int32(start),
            "search": self._ars.init(
                named_key(self._key, "start"), self._zero, self._ars.default_params
            ),
            "seen": seen,
            "steps": jnp.int32(0),
            "seconds": jnp.float32(0.0),
            "expert": (self._zero, seen),
            "best": jnp.float32(-jnp.inf),
        }

    def generation(self, kept: dict[str, Any], number: int, judging: bool) -> dict[str, float]:
        """Moves what is kept by one generation; what was earned, without the bonus, and the seconds that it took."""
        watch, config, key = Stopwatch(), self._config, named_key(self._key, "generations")
        if start := int(kept["start"]):
            key = key_at(named_key(self._key, "other starts"), start)
        key_ask, key_tell = split_key(key_at(key, number))
        population, state, key_roll = self._ask(kept["search"], key_ask)
        grown = min(1.0, number / config.error_warmup) if config.error_warmup else 1.0
        errors = jnp.float32(grown * config.action_errors)
        episodes = self._roll(population, kept["seen"], key_roll, errors)
        state, fitness, failed, seen, steps = self._tell(
            state, population, episodes, kept["seen"], key_tell
        )
        kept |= {"search": state, "seen": seen}
        metrics = {"fitness/mean": float(fitness), "failed": int(failed)}
        if judging:
            mean = self._ars.get_mean(state)
            judge = self._worth or self._mean_return
            # The same start states for all, so that judgements are compared in pairs.
            earned, taken = judge(self.expert(mean, seen), named_key(self._key, "judgement"))
            steps += taken
            metrics["mean/fitness"] = float(earned)
            if earned > kept["best"]:
                kept |= {"expert": (mean, seen), "best": jnp.float32(earned)}
        metrics["seconds"] = watch.lap()
        kept |= {"steps": kept["steps"] + steps, "seconds": kept["seconds"] + metrics["seconds"]}
        return metrics

    def expert(self, policy: Linear, seen: RunningStatistics) -> Expert:
        """Not judged yet."""
        return Expert(
            Partial(self._act, policy, seen), 0.0, 0, Partial(self._reaching, policy, seen)
        )

    def _outputs(
        self, policy: Linear, seen: RunningStatistics, observation: jax.Array
    ) -> jax.Array:
        if self._config.constant:
            return jnp.where(policy["bias"] > 0, jnp.inf, -jnp.inf)
        inputs = normalize(seen, observation, self._config.normalization)
        return inputs @ policy["matrix"] + policy["bias"]

    def _reaching(
        self, policy: Linear, seen: RunningStatistics, observation: jax.Array
    ) -> jax.Array:
        """What errors are added to; beyond the ends of the range where reach is above 1."""
        squashed = self._config.reach * jnp.tanh(self._outputs(policy, seen, observation))
        return jnp.reshape(scale_to_space(squashed, self._space), self._space.shape)

    def _act(self, policy: Linear, seen: RunningStatistics, observation: jax.Array) -> jax.Array:
        # As steep where it switches, and a linear bandit's best action can be the same.
        squashed = jnp.tanh(self._config.reach * self._outputs(policy, seen, observation))
        return clip_to_space(scale_to_space(squashed, self._space), self._space)

    def _rolled(
        self,
        reaching: Callable[[jax.Array], jax.Array],
        key: jax.Array,
        errors: ArrayLike,
        number: int,
        **more: Any,
    ) -> Episodes:
        if self._config.action_errors:  # the scale itself is traced
            reaching = erring(reaching, self._size, self._space, errors, key)
        act = noisy(reaching, self._space, self._config.action_noise)
        return evaluate(self._env, self._params, act, key, number, **more)

    def _episode(
        self, policy: Linear, seen: RunningStatistics, key: jax.Array, errors: ArrayLike
    ) -> Episodes:
        reaching, horizon = Partial(self._reaching, policy, seen), self._config.episode_steps
        return self._rolled(reaching, key, errors, 1, horizon=horizon, moments=True)

    def _asked(self, state: Any, key: jax.Array) -> Any:
        key_ask, key_roll = split_key(key)
        population, state = self._ars.ask(key_ask, state, self._ars.default_params)
        # Both ways from the same start state, with the same noise.
        return population, state, jnp.tile(split_key(key_roll, self._config.directions), 2)

    def _told(
        self,
        state: Any,
        population: Any,
        episodes: Episodes,
        seen: RunningStatistics,
        key: jax.Array,
    ) -> Any:
        fitness = (episodes.returns - self._bonus * episodes.lengths)[:, 0]
        observed = episodes.observations
        assert observed is not None
        # Where the simulation broke down nothing is known, and what was seen there is not learned from.
        failed = ~(jnp.isfinite(fitness) & jnp.isfinite(observed.mean + observed.squares).all(-1))
        worst = jnp.min(jnp.where(failed, jnp.inf, fitness))
        fitness = jnp.where(failed, jnp.where(jnp.isfinite(worst), worst, 0.0), fitness)
        state, _ = self._ars.tell(key, population, -fitness, state, self._ars.default_params)
        seen = merge_statistics(seen, replace(observed, count=jnp.where(failed, 0, observed.count)))
        return state, fitness.mean(), failed.sum(), seen, episodes.lengths.sum()

    def _judged(self, expert: Expert, key: jax.Array) -> Any:
        """What it earns under the noise and all of the errors, and the environment steps that took."""
        assert expert.reaching is not None
        reaching, errors = expert.reaching, self._config.action_errors
        # Errors are an episode's own.
        keys = split_key(key, EPISODES) if errors else key[None]
        each = EPISODES // len(keys)
        episodes = jax.vmap(lambda key: self._rolled(reaching, key, errors, each))(keys)
        return episodes.returns.mean(), episodes.lengths.sum()


def noisy(policy: Callable[[jax.Array], jax.Array], space: spaces.Box, noise: float) -> Policy:
    """A policy of flattened observations, with Gaussian noise on its actions, as `evaluate` takes it.

    Args:
      policy: its actions may lie beyond their bounds, and are clipped to them with the noise.
      noise: standard deviation, as a share of half the actions' range.
    """
    half = noise * (space.high - space.low) / 2

    def act(observation: jax.Array, key: jax.Array) -> jax.Array:
        action = jnp.reshape(policy(jnp.ravel(observation)), space.shape)
        if noise:
            action += half * jax.random.normal(key, space.shape)
        return clip_to_space(action, space)

    return act


def erring(
    policy: Callable[[jax.Array], jax.Array],
    size: int,
    space: spaces.Box,
    scale: ArrayLike,
    key: jax.Array,
) -> Callable[[jax.Array], jax.Array]:
    """A policy of flattened observations whose errors are a function of the observation, like an agent's; not clipped.

    They are the outputs of an untrained network of an agent's size, times the scale: on Hopper's states half of that.

    Args:
      size: of the observations.
      scale: as a share of half the actions' range.
      key: decides the network.
    """
    if isinstance(scale, float | int) and scale == 0:
        return policy
    network = MLP(AgentConfig.hidden_sizes, action_size(space), AgentConfig.activation)
    variables = network.init(named_key(key, "errors"), jnp.zeros(size))
    half = scale * (space.high - space.low) / 2

    def act(observation: jax.Array) -> jax.Array:
        errors = jnp.reshape(jnp.asarray(network.apply(variables, observation)), space.shape)
        return jnp.reshape(policy(observation), space.shape) + half * errors

    return act
