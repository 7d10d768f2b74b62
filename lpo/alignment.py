"""Does a bandit rank objectives as an environment does? Measured before an evolution is spent on it.

An inner loop is useful for meta-training if what it calls fitness ranks objectives as the outcome on
the environment does. Objectives that are already known (PPO's clip, DPO, none, learned ones) tell:
each trains agents on the environment and in every regime of a bandit, and Spearman's correlation
between the two is the regime's alignment.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpo.comparison import compare, ppo_spec
from lpo.drifts import Drift
from lpo.fitness import FITNESSES, LABELS
from lpo.inner_loop import EPISODES_AT_HOME, MetaTrainingConfig, TaskTraining, task_agent
from lpo.objectives import Objective, check_names, load_objective
from scb.agents.ppo import PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError, at_least, unused
from scb.keys import root_key, split_key
from scb.machine import machine_description, package_versions
from scb.measurement import Judge, check_seeds, train_and_judge
from scb.objectives import families
from scb.population import map_population, rank_failed_last
from scb.rows import Rows
from scb.statistics import correlation_text, iqm, rank_correlations, spearman
from scb.stopwatch import Stopwatch

RESAMPLES = 1000


@dataclass(frozen=True)
class Regime:
    """An inner loop on a bandit.

    Attributes:
      bandit: a zoo name or file.
      reward_noise: in standard deviations of the bandit's reward.
      contexts: of a batch.
      iterations, epochs, minibatches, learning_rate, policy_output_scale: where None, those of the
        evaluation environment's own setting.
    """

    bandit: str = "Synthetic-Pendulum-v1"
    reward_noise: float = 5.0
    contexts: int = 200
    iterations: int | None = None
    epochs: int | None = None
    minibatches: int | None = None
    learning_rate: float | None = None
    policy_output_scale: float | None = None

    def __post_init__(self) -> None:
        if not environment_spec(self.bandit).synthetic:
            raise UserError(
                f"a regime asks for a bandit, and {self.bandit!r} is none: give a name such as "
                "Synthetic-Pendulum-v1, or a bandit's file."
            )
        at_least(1, self, "iterations", "epochs", "minibatches", "contexts")
        at_least(0, self, "reward_noise")
        if not environment_spec(self.bandit).is_bandit:
            if self.reward_noise:
                raise UserError(
                    f"reward_noise is {self.reward_noise:g}, and {self.bandit!r} is a synthetic MDP, whose reward has "
                    "none: take 0."
                )
            because = f"the batches of {self.bandit!r}, a synthetic MDP, are its environment's"
            unused(self, because, ("contexts",), "take a bandit")
        self.spec()  # which refuses what does not fit, before anything is trained

    def spec(self) -> AgentSpec:
        """Of its agents: the setting's own but for what is given here."""
        own = task_agent(self.bandit, self.contexts, self.minibatches)
        iterations = self.iterations
        return own.with_values(
            total_steps=None if iterations is None else own.config.steps_after(iterations),
            num_epochs=self.epochs,
            learning_rate=self.learning_rate,
            policy_output_scale=self.policy_output_scale,
        )

    def task(self, objective: Objective) -> TaskTraining:
        """The inner loop with this objective."""
        config = MetaTrainingConfig(
            tasks=(self.bandit,),
            agent=self.spec().config,
            reward_noise=self.reward_noise,
            fitness="area",
            drift=objective.drift,
        )
        return TaskTraining(config, self.bandit)

    def static(self) -> "Regime":
        """The regime without what is traced: those that are equal here share a program."""
        return replace(self, reward_noise=0.0, learning_rate=None, policy_output_scale=None)

    def __str__(self) -> str:
        """What differs from the default."""
        default = Regime()
        given = {k: v for k, v in asdict(self).items() if v != getattr(default, k)}
        return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in given.items()) or "default"


def known_drifts() -> list[Objective]:
    """Clips from 0.05 to 1, no drift, and DPO over alpha and beta: a family that spans the scale."""
    clips = ("ppo-0.05", "ppo-0.1", "ppo-0.2", "ppo-0.3", "ppo-0.5", "ppo-1")
    return [*map(load_objective, (*clips, "none", "dpo-1-0.3", "dpo-2-0.6", "dpo-4-1.2"))]


def other_drifts() -> list[Objective]:
    """Closed forms that are not among `known_drifts` and span the scale as well: to confirm what those chose."""
    clips = ("ppo-0.03", "ppo-0.07", "ppo-0.15", "ppo-0.25", "ppo-0.4", "ppo-0.7")
    between = ("dpo-0.5-0.15", "dpo-1-0.6", "dpo-2-0.3", "dpo-2-1.2", "dpo-4-0.6", "dpo-8-2.4")
    return [*map(load_objective, (*clips, *between))]


def regime_fitness(
    regime: Regime,
    objectives: Sequence[Objective],
    seeds: Sequence[int],
    backend: str | None = None,
) -> dict[str, dict[str, np.ndarray]]:
    """{objective: {fitness: [S]}} of agents trained in a regime with each, one a seed.

    Fitnesses go by their labels, in the order of `lpo.fitness.FITNESSES`; the backend is that of the environment
    which the bandit stands for, where some of them judge. What is no number, as of an agent that diverged, counts as
    less than all that is.

    Raises:
      UserError: every agent diverged.
    """
    check_names(objectives)
    seeds, found = check_seeds(seeds), {}
    for family in families(objectives):
        task = regime.task(family[0])
        size = len(family) * len(seeds)
        program = _program(regime.static(), family[0].drift, size, backend)
        # Every objective with every seed, all at once.
        parameters = jax.tree.map(
            lambda *leaves: jnp.repeat(jnp.stack(leaves), len(seeds), axis=0),
            *(objective.parameters for objective in family),
        )
        earned = program(
            parameters,
            np.tile(np.asarray(seeds, np.uint32), len(family)),
            regime.spec().hyperparameters,
            task.env_params,
            task.training_params,
        )
        of_family = np.asarray(earned, np.float64).reshape(len(family), len(seeds), -1)
        for objective, of_it in zip(family, of_family, strict=True):
            found[objective.name] = of_it
    values = np.stack(list(found.values()))
    if not np.isfinite(values).any(axis=(0, 1)).all():
        raise UserError(f"every agent diverged in {regime}: lower its learning rate.")
    flat = values.reshape(-1, len(LABELS))
    ranked = np.stack([rank_failed_last(x) for x in flat.T], axis=1).reshape(values.shape)
    return {
        name: dict(zip(LABELS, of_it.T, strict=True))
        for name, of_it in zip(found, ranked, strict=True)
    }


@lru_cache(maxsize=64)
def _program(regime: Regime, drift: Drift, size: int, backend: str | None) -> Callable[..., Any]:
    """([N] drift parameters, [N] seeds, hyperparameters, bandit's params, the same with noise) -> [N, F] fitnesses.

    Compiled once for all regimes that differ in traced numbers only: noise, learning rate, initialisation.
    """
    task = regime.task(Objective("any", drift, None))
    spec = environment_spec(task.home)
    home, home_params = spec.make(spec.physics(backend))
    along = dict.fromkeys(f.judge for f in FITNESSES.values() if f.along)
    at_end = dict.fromkeys(f.judge for f in FITNESSES.values() if f.judge not in along)

    def train(
        parameters: Any,
        seed: jax.Array,
        hyperparameters: PPOHyperparameters,
        env_params: Any,
        training_params: Any,
    ) -> jax.Array:
        def judge(kind: tuple[bool, bool]) -> Judge:
            at_home, mode = kind
            if at_home:
                return Judge(home, home_params, EPISODES_AT_HOME, mode)
            return Judge(task.env, env_params, task.evaluation_episodes, mode)

        key_train, key_end = split_key(root_key(seed))
        state, earned = train_and_judge(
            task.agent,
            replace(hyperparameters, drift=parameters),
            key_train,
            training_params,
            {kind: judge(kind) for kind in along},
            every=task.every,
        )
        for kind, key in zip(at_end, split_key(key_end, len(at_end)), strict=True):
            earned[kind] = judge(kind)(task.agent, state, key)
        measured = {kind: jnp.atleast_1d(x.returns.mean(-1)) for kind, x in earned.items()}
        return jnp.stack([f.of(measured[f.judge]) for f in FITNESSES.values()])

    return map_population(train, size, (0, 0, None, None, None))


def forget_programs() -> None:
    """Frees what was compiled: a process that keeps hundreds of programs runs out of memory maps."""
    _program.cache_clear()
    jax.clear_caches()


@dataclass(frozen=True)
class Alignment:
    """Spearman's correlation between a fitness and an outcome over a family of objectives.

    Attributes:
      spearman: None where the fitness tells no two objectives apart.
      low, high: 95 % of bootstrap resamples of each objective's agents; the family is not resampled. What agents
        scatter by counts twice in them, so that they lean downwards: a low end above 0 is evidence, and a high end
        is no bound. With objectives that differ by as much as their agents scatter, the correlation without any scatter
        was above the high end in a quarter of simulations. None where an objective has a single agent, of which
        nothing tells what another would earn.
    """

    spearman: float | None
    low: float | None
    high: float | None

    @property
    def shown(self) -> bool:
        """Whether the whole interval is above 0."""
        return self.low is not None and self.low > 0


def alignment(fitness: Mapping[str, np.ndarray], outcome: Mapping[str, np.ndarray]) -> Alignment:
    """How a fitness ranks objectives, against how their outcome does.

    Args:
      fitness: {objective: [S]}, of which the mean counts, as in meta-training.
      outcome: {objective: [S']} of the same objectives, of which the interquartile mean counts.

    Raises:
      UserError: other objectives in one than in the other, or fewer than three.
    """
    if set(fitness) != set(outcome):
        raise UserError("fitness and outcome are of different objectives: measure the same ones.")
    if len(outcome) < 3:
        raise UserError(
            f"there are {len(outcome)} objectives, which rank nothing: give at least 3."
        )
    names = list(outcome)
    generator = np.random.default_rng(0)

    def with_resamples(values: np.ndarray) -> np.ndarray:
        """[1 + RESAMPLES, S]: the measured numbers first, then draws from them."""
        drawn = generator.integers(0, len(values), (RESAMPLES, len(values)))
        return np.concatenate([values[None], values[drawn]])

    means = np.stack([np.mean(with_resamples(fitness[n]), axis=1) for n in names], axis=1)
    iqms = np.stack([iqm(with_resamples(outcome[n]), axis=1) for n in names], axis=1)
    correlation = spearman(means[0], iqms[0])
    if min(len(x) for of in (fitness, outcome) for x in of.values()) < 2:
        return Alignment(correlation, None, None)
    low, high = np.percentile(rank_correlations(means[1:], iqms[1:]), [2.5, 97.5])
    return Alignment(correlation, float(low), float(high))


def measure_alignment(
    regimes: Sequence[Regime],
    objectives: Sequence[Objective],
    environment: str,
    seeds: Sequence[int],
    steps: int | None = None,
    backend: str | None = None,
    policy_output_scale: float | None = None,
    tell: Callable[[str], None] = print,
    rows: Rows | None = None,
    done: Mapping[str, Any] | None = None,
    keep: Callable[[dict[str, Any]], None] = lambda report: None,
) -> dict[str, Any]:
    """The alignment of every regime's fitnesses with an environment's outcome, ready for JSON.

    Args:
      regimes: inner loops on bandits.
      objectives: the family that is ranked.
      environment, steps, backend, policy_output_scale: where and how the outcome is measured.
      seeds: of the agents in the environment and in the regimes.
      tell: takes a line when a regime has been measured.
      rows: where the environment's agents are kept, and found.
      done: what `keep` was given before, whose regimes are not measured again.
      keep: is given the report so far after every regime.

    Raises:
      UserError: `done` is of another measurement.
    """
    seeds = check_seeds(seeds)
    asked = {
        "environment": environment,
        "steps": steps,
        "backend": backend,
        "policy_output_scale": policy_output_scale,
        "agents": len(seeds),
        "first_seed": min(seeds),
        "seeds": seeds,
        # Of what files hold, for another may come to have its name.
        "checksums": {o.name: o.sha256 for o in objectives if o.sha256},
    }
    report: dict[str, Any] = dict(done or {})
    if not report:
        spec = ppo_spec(environment, steps).with_values(policy_output_scale=policy_output_scale)
        comparison = compare(environment, objectives, seeds, spec, backend, points=1, rows=rows)
        found, caution = comparison.curves, comparison.caution
        if caution:
            tell(caution)
        report = {
            **asked,
            "caution": caution,
            "outcome_iqm": {c.objective: float(iqm(c.final)) for c in found},
            # To as many digits as tell agents apart, of whatever size returns are.
            "outcome": {c.objective: [float(f"{x:.6g}") for x in c.final] for c in found},
            "regimes": [],
            "versions": package_versions(),
            "machine": machine_description(),
        }
        keep(report)
    stored = {name: report.get(name, asked[name]) for name in asked}
    names = {objective.name for objective in objectives}
    if stored != asked or set(report["outcome"]) != names:
        of = ", ".join(report["outcome"])
        told = ("environment", "steps", "backend", "policy_output_scale", "agents", "first_seed")
        said = ", ".join(f"{name} {stored[name]}" for name in told)
        raise UserError(
            f"{environment} was measured with other objectives, agents or steps ({of}; {said}): choose another --out."
        )
    outcome = {name: np.asarray(returns) for name, returns in report["outcome"].items()}
    tell(f"{environment}: " + ", ".join(f"{n} {x:.0f}" for n, x in report["outcome_iqm"].items()))
    checksums = {x: bandit_metadata(x)["sha256"] for x in {regime.bandit for regime in regimes}}

    def current(row: Mapping[str, Any]) -> bool:
        digest = checksums.get(row["bandit"])
        return digest is None or row.get("sha256", digest) == digest

    report["regimes"] = [row for row in report["regimes"] if current(row)]
    known = {Regime(**{name: row[name] for name in asdict(Regime())}) for row in report["regimes"]}
    for regime in regimes:
        if regime in known:
            continue
        watch = Stopwatch()
        fitness = regime_fitness(regime, objectives, seeds, backend)
        correlations = {
            name: asdict(alignment({o: x[name] for o, x in fitness.items()}, outcome))
            for name in LABELS
        }
        report["regimes"].append(
            {
                "name": str(regime),
                **asdict(regime),
                "sha256": checksums[regime.bandit],
                "alignment": correlations,
                "mean_fitness": {
                    o: {name: float(x[name].mean()) for name in LABELS} for o, x in fitness.items()
                },
                "seconds": round(watch.lap(), 1),
            }
        )
        keep(report)
        tell(
            f"{regime}: "
            + "; ".join(f"{name} {correlation_text(c)}" for name, c in correlations.items())
        )
    return report
