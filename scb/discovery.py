"""Discover a synthetic contextual bandit: evolve one so that agents trained in it do well in a real environment.

Liesen et al. (2024). The inner loop trains agents of several algorithms in the candidate, with
hyperparameters drawn from the paper's lists so that the bandit suits any of them; the fitness is
their return in the evaluation environment. The same search finds the paper's fully synthetic MDPs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces
from jax.typing import ArrayLike

from scb import processes
from scb.agents.spec import (
    ALGORITHMS,
    AgentSpec,
    algorithms_for,
    bandit_agent,
    check_algorithms,
    configured,
)
from scb.analysis.optimal_actions import optimal_actions, optimal_policy
from scb.configurations import config_dict
from scb.curriculum import EpisodeLengths, check_curriculum, paper_curriculum
from scb.discovery_config import DiscoveryConfig as DiscoveryConfig
from scb.environments.linear import widened
from scb.environments.registry import environment_spec
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.environments.synthetic_mdp import synthetic_for
from scb.environments.zoo import bandit_metadata, load_bandit, save_bandit
from scb.errors import UserError, of_class, one_of
from scb.evaluation import evaluate
from scb.evolution import EnvironmentSteps, Outcome, evolve
from scb.fitting import standardize_reward
from scb.judgement import check_fits
from scb.keys import named_key, root_key, split_key
from scb.linear_expert import erring, noisy
from scb.listing import found
from scb.measurement import Judge, Place, train_and_judge
from scb.refinement import refined
from scb.runs import Run, run_of
from scb.seeds import VALIDATING
from scb.spaces import check_bounded, kind_of_actions
from scb.strategies import check_memory, strategy_for
from scb.warm_start import expert_agent, warm_start

OPTIMAL_POLICY = "optimal policy"  # in logs, beside the algorithms


class BanditDiscovery:
    """The evolution problem: a candidate is a synthetic environment's weights."""

    def __init__(self, config: DiscoveryConfig) -> None:
        self.place = Place.named(config.environment, config.backend)
        space = self.place.env.action_space(self.place.params)
        if not config.algorithms:
            config = replace(config, algorithms=algorithms_for(space))
        if isinstance(config.curriculum, str):
            # Of none there is no curriculum to follow, but the environment must have one.
            generations = max(1, config.evolution.num_generations)
            config = replace(config, curriculum=paper_curriculum(config.environment, generations))
        check_algorithms(config.algorithms, kind_of_actions(space))
        check_bounded(space)
        if config.optimal_policy_errors and kind_of_actions(space) == "discrete":
            raise UserError(
                f"optimal_policy_errors are added to continuous actions, and those of {config.environment} are "
                "discrete: leave them out."
            )
        if config.mode == "all" and len(set(config.algorithms)) < len(config.algorithms):
            raise UserError(
                f"an algorithm stands twice in {', '.join(config.algorithms)}: name each once, or use the mode "
                "sequential, where it then has two turns."
            )
        for what, given in {
            "hyperparameter lists": config.lists,
            "configurations": config.configs,
        }.items():
            for name in given:
                one_of("algorithm", name, ALGORITHMS)
            if given and not set(given) & set(config.algorithms):
                raise UserError(
                    f"there are {what} for {', '.join(given)}, but the inner loop trains "
                    f"{', '.join(config.algorithms)}: give them for that."
                )
        if config.fitted:
            expert_agent(config.environment, space, config.warm_start)
        self.config = config
        self.bandit = synthetic_for(
            self.place.env,
            self.place.params,
            config.parameterization,
            config.bandit,
            environment_spec(config.environment).bandit,
            config.max_steps,
        )
        self.specs = {name: self._spec(name) for name in dict.fromkeys(config.algorithms)}
        if config.evolution.num_generations:
            self._check_strategy()
        assert not isinstance(config.curriculum, str)  # the paper's is read by now
        if config.curriculum is not None:
            limit = int(self.place.params.max_steps_in_episode)
            check_curriculum(config.curriculum, limit, config.environment)
            if config.curriculum.initial != config.curriculum.final:
                because = "which is of episodes of other lengths where there is a curriculum"
                check_memory(config.evolution.strategy, because, "leave it out")
        self._lengths = EpisodeLengths(config.curriculum, self.place.params)
        self._starts: dict[str, Weights] = {}
        self.start_reports: dict[str, dict[str, float]] = {}
        self._folder: Path | None = None
        self._quiet = True
        # Read now, so that a wrong name is told before anything is computed or written.
        self._start: Weights | None = None
        self._origin: dict[str, Any] | None = None
        if config.start is not None:
            self._start = self._weights_of(config.start)
            self._origin = _as_origin(bandit_metadata(config.start))

    def search(self, run: Run | None = None, quiet: bool = False) -> Outcome:
        """Evolves; in a run's folder the fit is kept, so that a resumed one need not look for an expert again."""
        self._folder, self._quiet = None if run is None else run.folder, quiet
        # First: where it is no number, neither is what an expert or most agents earn.
        environment_spec(self.config.environment).random_return(self.config.backend)
        return evolve(self, self.config.evolution, run, quiet)

    def _check_strategy(self) -> None:
        """A UserError, before anything is computed, where the strategy does not fit the weights."""
        shapes = jax.eval_shape(self.bandit.init_weights, root_key(0))
        weights = jax.tree.map(jnp.zeros_like, shapes)
        strategy = strategy_for(self.config.evolution, weights)
        if self.units(weights) is not None:
            strategy.check_units(weights)

    def _spec(self, name: str) -> AgentSpec:
        config = self.config
        spec = bandit_agent(name, config.environment, not config.fixed_hyperparameters)
        return replace(
            spec,
            lists=config.lists.get(name, spec.lists),
            config=configured(spec.config, config.configs.get(name, {})),
        )

    def _weights_of(self, name: str) -> Weights:
        start = load_bandit(name)
        check_fits(start, self.place)
        networks = () if start.linear else ("hidden_size", "activation", "latent_size")
        for what in ("form", "latent", *networks):
            has, wanted = (
                getattr(x if what == "latent_size" else x.config, what)
                for x in (start, self.bandit)
            )
            if has != wanted:
                raise UserError(
                    f"{name} has the {what} {has}, and the bandit to discover {wanted}: ask for {has}, or start from "
                    "another."
                )
        weights, contexts = start.default_params.weights, self.config.warm_start
        if not self.config.widened:
            return weights
        return widened(weights, contexts.stretch, contexts.jitter)

    def initial_solution(self, key: jax.Array) -> Weights:
        config, seed = self.config, root_key(self.config.evolution.seed)
        if self._start is not None:
            weights = self._start
        elif config.init == "random":
            weights = self.bandit.init_weights(key)
        else:
            weights = self._kept("warm_start", partial(self._fit, named_key(seed, "expert")))
        if config.refinement.rounds:
            refine = partial(self._refine, weights, named_key(seed, "refinement"))
            weights = self._kept("refinement", refine)
        if config.reward_std is None:
            return weights
        assert isinstance(self.bandit, SyntheticBandit)
        return standardize_reward(self.bandit, weights, config.reward_std)

    def units(self, solution: Weights) -> Weights | None:
        """What a change of 1 is for each weight."""
        return self.bandit.units(solution) if isinstance(self.bandit, SyntheticBandit) else None

    def _fit(self, key: jax.Array) -> tuple[Weights, dict[str, float]]:
        assert isinstance(self.bandit, SyntheticBandit)
        config = self.config.warm_start
        folder = None if self._folder is None else self._folder / "expert"
        return warm_start(self.bandit, self.specs, self.place, key, config, self._quiet, folder)

    def _refine(self, weights: Weights, key: jax.Array) -> tuple[Weights, dict[str, float]]:
        assert isinstance(self.bandit, SyntheticBandit)
        config = self.config.refinement
        return refined(self.bandit, weights, self.specs, self.place, key, config, self._quiet)

    def _kept(self, name: str, made: Callable[[], tuple[Weights, dict[str, float]]]) -> Weights:
        """What the search starts from: made once, and kept in the run's folder; what it cost is in `start_reports`."""
        if name in self._starts:
            return self._starts[name]
        path = None if self._folder is None else self._folder / f"{name}.npz"
        report: Any = None
        shapes = jax.eval_shape(self.bandit.init_weights, root_key(0))
        # What a process holds that is told of weights, until it is.
        weights: Weights = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
        if processes.first() and path is not None and path.with_suffix(".json").exists():
            report = dict(bandit_metadata(str(path))["cost"])  # it is written last
            weights = load_bandit(path).default_params.weights
        if (report := processes.told(report)) is not None:
            weights = cast(Weights, processes.agreed(weights))
        else:
            weights, report = made()
            if path is not None and processes.first():
                metadata = self._metadata(report, "scb discover (what its search starts from)")
                save_bandit(path, self.bandit, weights, metadata)
        self._starts[name], self.start_reports[name] = weights, report
        return weights

    def selected(self, outcome: Outcome) -> Weights:
        """The weights that the configuration selects: of the last mean, or of the best judged one.

        Raises:
          UserError: they are no numbers, or no mean was judged a number.
        """
        best = self.config.select == "best"
        outcome.check(best)
        return cast(Weights, outcome.best_mean if best else outcome.mean)

    def described(self, outcome: Outcome, command: str) -> dict[str, Any]:
        """What is saved with what a search found, which no agents have judged yet.

        Args:
          command: that makes it again, or "python".
        """
        found = outcome.cost(self, self.config.evolution, self.config.select == "best")
        return self._metadata({**found, **self.start_reports}, command)

    def _metadata(self, cost: Mapping[str, Any], command: str) -> dict[str, Any]:
        config = self.config
        return {
            "config": {
                "evaluation_environment": config.environment,
                "backend": environment_spec(config.environment).physics(config.backend),
                "discovery": config_dict(config),
                "started_from": self._origin,
            },
            "seeds": {"discovery": config.evolution.seed, "validation": VALIDATING.start},
            "results": {},
            "cost": cost,
            "command": command,
        }

    def save(self, path: str | Path, outcome: Outcome) -> Path:
        """Writes what a search found as `scb discover` does: NAME.npz, and NAME.json, which says how it was found.

        Of several processes one is to call it.

        Raises:
          UserError: as `selected` does, or the file cannot be written.
        """
        metadata = self.described(outcome, "python")
        return save_bandit(path, self.bandit, self.selected(outcome), metadata)

    def evaluate(
        self, candidate: Weights, key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        config = self.config
        limit, env_params = self._lengths.limit(generation), self._lengths.params

        def returns_of(name: str, key: jax.Array) -> jax.Array:
            key_draw, key_agents = split_key(key)
            number = config.agents_per_candidate
            return jax.vmap(lambda h, k: self._earned(name, candidate, h, k, env_params, limit))(
                self.specs[name].sample(key_draw, number), split_key(key_agents, number)
            )

        names = list(self.specs)
        optimal: dict[str, jax.Array] = {}
        if config.optimal_policy_episodes:
            optimal = {
                OPTIMAL_POLICY: self._optimal_return(candidate, key, env_params, limit)[None]
            }
        if config.mode == "all":
            returns = {
                # The first has the generation's own key, as where it is alone.
                name: returns_of(name, named_key(key, name) if i else key)
                for i, name in enumerate(names)
            } | optimal
            means = {f"fitness/{name}": r.mean() for name, r in returns.items()}
            return {"fitness": jnp.concatenate(list(returns.values())), **means}
        # The generation is no member of the population, so this stays a branch and trains one
        # algorithm only.
        turns = jnp.asarray([names.index(name) for name in config.algorithms])
        turn = turns[generation % len(config.algorithms)]
        branches = [lambda key, name=name: returns_of(name, key) for name in names]
        returns = jax.lax.switch(turn, branches, key)
        logged = {
            f"fitness/{name}": jnp.where(turn == i, returns.mean(), jnp.nan)
            for i, name in enumerate(names)
        } | {f"fitness/{name}": r.mean() for name, r in optimal.items()}
        return {"fitness": jnp.concatenate([returns, *optimal.values()]), **logged}

    def _earned(
        self,
        algorithm: str,
        weights: Weights,
        hyperparameters: Any,
        key: jax.Array,
        env_params: Any,
        limit: ArrayLike | None = None,
    ) -> jax.Array:
        """[] mean return in the evaluation environment of an agent trained in a candidate."""
        episodes, mode = self.config.evaluation_episodes, self.config.mode_actions
        _, earned = train_and_judge(
            self.specs[algorithm].agent(self.bandit),
            hyperparameters,
            key,
            self.bandit.params(weights),
            {"return": Judge(self.place.env, env_params, episodes, mode, limit)},
        )
        return earned["return"].returns.mean()

    def _optimal_return(
        self, weights: Weights, key: jax.Array, env_params: Any, limit: ArrayLike | None = None
    ) -> jax.Array:
        """[] mean return in the evaluation environment of a candidate's own optimal policy."""
        assert isinstance(self.bandit, SyntheticBandit)
        config, params = self.config, self.bandit.params(weights)
        number, scale = config.optimal_policy_episodes, config.optimal_policy_errors
        key, judge = named_key(key, OPTIMAL_POLICY), partial(evaluate, self.place.env, env_params)
        if not scale:
            return judge(optimal_policy(self.bandit, params), key, number, limit).returns.mean()
        best, size = optimal_actions(self.bandit, params), self.bandit.observation_size
        space = cast(spaces.Box, self.bandit.action_space())

        def erred(key: jax.Array) -> jax.Array:
            act = noisy(erring(best, size, space, scale, key), space, 0.0)
            return judge(act, key, 1, limit).returns

        # Errors are an episode's own.
        return jax.vmap(erred)(split_key(key, number)).mean()

    def evaluate_mean(self, candidate: Weights, key: jax.Array) -> dict[str, jax.Array]:
        results = {}
        for i, (name, spec) in enumerate(self.specs.items()):
            key_draw, key_agent = split_key(named_key(key, name) if i else key)
            drawn = jax.tree.map(lambda x: x[0], spec.sample(key_draw, 1))
            results[f"fitness/{name}"] = self._earned(
                name, candidate, drawn, key_agent, self.place.params
            )
        if self.config.optimal_policy_episodes:
            results[f"fitness/{OPTIMAL_POLICY}"] = self._optimal_return(
                candidate, key, self.place.params
            )
        # As in the search, where an optimal policy counts as one of the agents that a generation trains: in the mode
        # sequential these are of one algorithm.
        number, sequential = self.config.agents_per_candidate, self.config.mode == "sequential"
        each = number / len(self.specs) if sequential else number
        weights = [each] * len(self.specs) + [1]
        worth = jnp.average(
            jnp.stack(list(results.values())), weights=jnp.array(weights[: len(results)])
        )
        return {"fitness": worth, **results}

    def steps(self, generation: int = 0) -> EnvironmentSteps:
        """Of one candidate; in the mode "sequential" of the algorithm whose turn it is."""
        config = self.config
        names: Sequence[str] = list(self.specs)
        if config.mode == "sequential":
            names = [config.algorithms[generation % len(config.algorithms)]]
        agents, length = config.agents_per_candidate, self._lengths.steps(generation)
        episodes = agents * len(names) * config.evaluation_episodes
        return EnvironmentSteps(
            training=agents * sum(self.specs[name].steps for name in names),
            evaluation=(episodes + config.optimal_policy_episodes) * length,
        )

    def judgement_steps(self) -> EnvironmentSteps:
        """Of one agent of each algorithm, and the optimal policy, in episodes of the environment's own length."""
        episodes = len(self.specs) * self.config.evaluation_episodes
        episodes += self.config.optimal_policy_episodes
        return EnvironmentSteps(
            training=sum(spec.steps for spec in self.specs.values()),
            evaluation=episodes * int(self.place.params.max_steps_in_episode),
        )


def _as_origin(metadata: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **{name: metadata[name] for name in ("command", "sha256", "cost")},
        "found": found(metadata),
        "started_from": metadata["config"].get("started_from"),
    }


def discover(
    config: DiscoveryConfig, run: Run | str | Path | None = None, quiet: bool = False
) -> tuple[BanditDiscovery, Outcome]:
    """Evolves a bandit.

    Args:
      config: for which environment, and how. What is a list or a table on the command line is a tuple or a dict here;
        `dataclasses.replace(DiscoveryConfig().evolution, num_generations=10)` keeps the rest of its default, which an
        EvolutionConfig made anew does not.
      run: a folder for logs and checkpoints. Killed, the same call goes on from the last checkpoint, also with more
        generations, or with fewer, but for the paper's curriculum; once it has ended, it returns the outcome. None:
        nothing is kept.
      quiet: no line a generation.

    Returns:
      (the problem, whose `bandit` has the shapes; the outcome, whose `mean` and `best_mean` are weights).
      `problem.save("mine.npz", outcome)` writes them.

    Raises:
      UserError: the folder holds something else, or a run of another configuration.
    """
    of_class(DiscoveryConfig, config=config)
    problem = BanditDiscovery(config)  # a mistake must not leave a folder behind
    with run_of(run, config, config.checksums(), config.growing) as opened:
        return problem, problem.search(opened, quiet)
