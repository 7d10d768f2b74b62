"""Fit a bandit to an expert before evolving it.

The paper's lemma: a bandit whose reward is the expert's Q-function, on contexts that cover the
expert's states, has the expert's policy as its optimum. Regression finds such a bandit in a minute;
what it cannot know is which of them *trains* well, and that is what evolution is for.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from gymnax.environments import spaces

from scb.agents.spec import (
    ALGORITHMS,
    AgentSpec,
    check_algorithms,
    environment_agent,
    has_values_for,
)
from scb.agents.tables import WARM_START
from scb.aggregation import Learned, Learners, best_round
from scb.console import progress_console
from scb.curriculum import paper_curriculum
from scb.environments.registry import environment_spec
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.errors import UserError, agents_at_least, at_least, fraction, one_of, positive, unused
from scb.expert_data import DatasetConfig, expert_dataset, labelled
from scb.experts import Expert, PolicySearchConfig, evolve_expert, train_expert
from scb.fitting import fit_bandit
from scb.keys import named_key, split_key
from scb.linear_expert import LinearSearchConfig, Worth, search_linear_expert
from scb.measurement import Place
from scb.spaces import kind_of_actions
from scb.stopwatch import Stopwatch

PUPILS_EPISODES = 3  # by which each of an expert's pupils is judged


def _evolved(
    place: Place,
    key: jax.Array,
    config: "WarmStartConfig",
    quiet: bool,
    **_: Any,
) -> Expert:
    search, generations = PolicySearchConfig(), config.expert_generations
    search = replace(
        search,
        curriculum=paper_curriculum(place.name, generations),
        evolution=replace(search.evolution, num_generations=generations),
    )
    return evolve_expert(place.env, place.params, search, key, quiet)


def _linear(
    place: Place,
    key: jax.Array,
    config: "WarmStartConfig",
    quiet: bool,
    *,
    worth: Worth | None,
    folder: Path | None,
    constant: bool = False,
) -> Expert:
    standing = environment_spec(place.name).standing_still(place.backend) or 0.0
    bonus = standing / place.params.max_steps_in_episode
    # Where actions err anyway a larger step is no more noise, and finds gains that bear errors.
    sigma, learning_rate = (0.15, 0.09) if config.erring else (0.03, 0.02)
    search = LinearSearchConfig(
        config.expert_generations,
        config.expert_starts,
        sigma=config.expert_sigma or sigma,
        learning_rate=config.expert_learning_rate or learning_rate,
        decay=config.expert_decay,
        episode_steps=config.expert_episode_steps,
        action_noise=config.expert_noise,
        action_errors=config.expert_errors,
        error_warmup=config.expert_error_warmup,
        reach=config.expert_reach,
        normalization=config.expert_normalization,
        constant=constant,
    )
    return search_linear_expert(place.env, place.params, key, search, bonus, quiet, worth, folder)


class _Search(NamedTuple):
    """What finds experts that are no agents: in words, how, and what it needs and knows."""

    what: str
    find: Callable[..., Expert]  # (place, key, config, quiet; worth, folder)
    linear: bool = False  # for continuous actions; cuts episodes and asks pupils where told to


_OF_LINEAR_SEARCHES = (
    "expert_episode_steps",
    "expert_pupils",
    "expert_starts",
    "expert_sigma",
    "expert_learning_rate",
    "expert_decay",
    "expert_error_warmup",
    "expert_reach",
    "expert_normalization",
)

SEARCHES = {
    "evolution": _Search("evolution", _evolved),
    "linear": _Search("a linear search", _linear, linear=True),
    "constant": _Search("a search for one action", partial(_linear, constant=True), linear=True),
}


@dataclass(frozen=True)
class WarmStartConfig(DatasetConfig):
    """How the expert is trained and the bandit is fitted.

    Attributes:
      expert: the algorithm that finds it: one of the agents' ("ppo", "sac", ...), "evolution" of a
        small policy network, "linear", augmented random search for a linear policy, which a bandit
        holds better than a network, or "constant", the same for one action, each entry at an end of its
        range. "auto" takes PPO where the environment has a setting of its own for it, and evolution
        elsewhere.
      num_experts: agents trained on the environment; the best of them is the expert.
      expert_steps: environment steps of each; the environment's own setting where None.
      expert_generations: of the evolution or the linear search, where that finds the expert.
      expert_starts: linear searches that are begun; the one whose policies earn most after twenty generations goes on.
      expert_sigma: standard deviation of a linear search's perturbations; 0.03 where None, and 0.15 under noise or
        errors.
      expert_learning_rate: of a linear search; 0.02 where None, and 0.09 under noise or errors.
      expert_decay: factor on both a generation.
      expert_error_warmup: generations of a linear search over which the scale of its errors grows linearly to its end.
      expert_reach: how far the policy of a linear search goes where it errs, in halves of the actions' range, before
        it is clipped to that. Above 1 a policy that bears errors comes to switch between the ends, beyond
        which they vanish.
      expert_normalization: the power of their deviations that a linear search divides observations by, from 1,
        standardised, to 0, centred only. With less than 1 its policy asks less of entries that vary little.
      expert_pupils: agents of each algorithm of the inner loop that train in a bandit fitted to each policy
        which the linear search judges: the expert is then the one whose agents earn most on average. With 0
        it is the one that earns most itself, under its noise and errors.
      expert_episode_steps: at which a linear search cuts its episodes; the environment's own limit where None.
      fit_steps: Adam steps of each regression.
      aggregation_rounds: of dataset aggregation (Ross et al., 2011): agents train in the fit, states that
        they visit join the dataset with what the expert does there, and all is fitted again. The fit
        whose agents earn most is kept: rounds scatter.
      aggregation_agents: of each algorithm of the inner loop, in every round and after the last.
    """

    expert: str = "auto"
    num_experts: int = 8
    expert_steps: int | None = None
    expert_generations: int = 80
    expert_starts: int = 1
    expert_sigma: float | None = None
    expert_learning_rate: float | None = None
    expert_decay: float = 1.0
    expert_error_warmup: int = 0
    expert_reach: float = 1.0
    expert_normalization: float = 1.0
    expert_pupils: int = 0
    expert_episode_steps: int | None = None
    fit_steps: int = 4000
    aggregation_rounds: int = 0
    aggregation_agents: int = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("expert", self.expert, ("auto", *SEARCHES, *ALGORITHMS))
        agents_at_least(0, self, "expert_pupils")
        agents_at_least(1, self, "num_experts", "aggregation_agents")
        at_least(0, self, "expert_error_warmup", "aggregation_rounds")
        at_least(1, self, "expert_generations", "expert_starts")
        at_least(1, self, "expert_episode_steps", "expert_reach", "fit_steps")
        positive(self, "expert_sigma", "expert_learning_rate", "expert_decay")
        fraction(self, "expert_normalization")
        if not self.aggregation_rounds:
            unused(
                self, "there are no aggregation rounds", ("aggregation_agents",), "take at least 1"
            )
        if self.expert_error_warmup > self.expert_generations:
            raise UserError(
                f"expert_error_warmup is {self.expert_error_warmup} of {self.expert_generations} generations: the "
                "errors would not grow to their scale; take no more."
            )
        if self.expert_error_warmup and not self.expert_errors:
            raise UserError(
                f"expert_error_warmup is {self.expert_error_warmup}, and there are no errors that could grow: give "
                "expert_errors, or leave it out."
            )


def expert_agent(
    name: str, space: spaces.Box | spaces.Discrete, config: WarmStartConfig
) -> AgentSpec | None:
    """How the expert of an environment is trained; None where a search finds it.

    Raises:
      UserError: an expert that doesn't fit the action space, or steps that it can't be trained for.
    """
    if isinstance(space, spaces.Discrete) and config.erring:
        raise UserError(
            f"expert_noise and expert_errors are of continuous actions, and {name} has discrete ones: leave them out."
        )
    algorithm = _chosen(name, config)
    linear = algorithm in SEARCHES and SEARCHES[algorithm].linear
    found = f"the expert of {name} is found by {algorithm}"
    if not linear:
        unused(config, f"{found}, which has no such setting", _OF_LINEAR_SEARCHES, "choose linear")
    if algorithm == "constant":
        sees_nothing = f"{found}, which observes nothing"
        unused(config, sees_nothing, ("expert_normalization",), "choose linear")
    if algorithm in SEARCHES:
        search = SEARCHES[algorithm]
        if search.linear and isinstance(space, spaces.Discrete):
            raise UserError(
                f"the expert of {search.what} has continuous actions and {name} discrete ones: choose evolution, or "
                "an algorithm."
            )
        trained = ("expert_steps", "num_experts")
        unused(config, f"{found}, which trains no agent", trained, "choose an algorithm for it")
        return None
    unused(
        config, f"{found}, which is trained", ("expert_generations",), "choose evolution or linear"
    )
    check_algorithms([algorithm], kind_of_actions(space))
    spec = environment_agent(algorithm, name).with_values(**WARM_START.get((algorithm, name), {}))
    return spec.with_values(total_steps=config.expert_steps)


def _chosen(name: str, config: WarmStartConfig) -> str:
    if config.expert != "auto":
        return config.expert
    return "ppo" if has_values_for("ppo", name) else "evolution"


def warm_start(
    bandit: SyntheticBandit,
    specs: Mapping[str, AgentSpec],
    place: Place,
    key: jax.Array,
    config: WarmStartConfig,
    quiet: bool = True,
    folder: Path | None = None,
) -> tuple[Weights, dict[str, float]]:
    """A bandit's weights fitted to an expert of an environment, and how the fit came about.

    Args:
      bandit: whose weights.
      specs: of the agents that train in the bandit, for rounds of aggregation.
      place: the environment.
      key: decides everything.
      config: how.
      quiet: no progress on the terminal.
      folder: where a linear search is kept while it goes on, and resumed; None keeps nothing.

    Raises:
      UserError: the expert earns less than random actions.
    """
    watch = Stopwatch()
    key_expert, key_data, key_fit = split_key(key, 3)
    fit = partial(fit_bandit, bandit, construction=config.construction, steps=config.fit_steps)
    worth = None
    if config.expert_pupils:
        pupils = Learners(bandit, specs, place, config.expert_pupils, PUPILS_EPISODES)

        def worth(expert: Expert, key: jax.Array) -> tuple[float, int]:
            key_data, key_fit, key_agents = split_key(key, 3)
            dataset, steps = expert_dataset(expert, place, key_data, config)
            earned, _ = pupils(fit(dataset, key_fit)[0], key_agents)
            return earned, steps + pupils.steps

    expert = find_expert(place, key_expert, config, quiet, worth, folder)
    random = environment_spec(place.name).random_return(place.backend)
    if not expert.mean_return >= random:  # of a simulation that breaks down it is no number
        raise UserError(
            f"the expert of {place.name} earns {expert.mean_return:.4g} and random actions {random:.4g}: give it more "
            "steps or generations, or choose another expert."
        )
    progress_console(quiet).print(f"fitting a bandit to an expert of {expert.mean_return:.4g}")
    dataset, steps = expert_dataset(expert, place, key_data, config)
    found = fit(dataset, key_fit)
    if config.aggregation_rounds:
        learners = Learners(bandit, specs, place, config.aggregation_agents)

        def improve(latest: Weights, learned: dict[str, Learned], key: jax.Array) -> Any:
            nonlocal dataset
            key_pick, key_label, key_fit = split_key(key, 3)
            visited = learners.visits(latest, learned)
            more, taken = labelled(expert, place, visited, key_pick, key_label, config)
            dataset = jax.tree.map(lambda *x: jnp.concatenate(x), dataset, more)
            return fit(dataset, key_fit), taken

        rounds = config.aggregation_rounds
        key_rounds = named_key(key, "rounds")
        progress_console(quiet).print("aggregating a dataset, what agents of each fit earn:")
        found, taken = best_round(found, learners, rounds, key_rounds, improve, quiet)
        steps += taken
    weights, report = found
    return weights, {
        "expert_return": expert.mean_return,
        "environment_steps": expert.environment_steps + steps,
        "seconds": round(expert.earlier_seconds + watch.lap(), 1),
        **report,
    }


def find_expert(
    place: Place,
    key: jax.Array,
    config: WarmStartConfig,
    quiet: bool = True,
    worth: Worth | None = None,
    folder: Path | None = None,
) -> Expert:
    """An expert for an environment of the registry.

    Args:
      place: the environment.
      key: decides everything.
      config: how.
      quiet: no progress on the terminal.
      worth: what a linear search judges its policies by.
      folder: where a linear search is kept while it goes on, and resumed; None keeps nothing.
    """
    spec = expert_agent(place.name, place.env.action_space(place.params), config)
    if spec is None:
        search = SEARCHES[_chosen(place.name, config)]
        progress_console(quiet).print(f"looking for an expert of {place.name} by {search.what}")
        return search.find(place, key, config, quiet, worth=worth, folder=folder)
    progress_console(quiet).print(f"training {config.num_experts} experts of {place.name}")
    return train_expert(place.env, place.params, spec, key, config.num_experts)
