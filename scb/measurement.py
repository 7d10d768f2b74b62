"""One measurement: agents train somewhere, are judged somewhere, and what they earn are tidy rows.

`train_and_judge` is the traced core, of one agent: pure, so that searches call it inside their own
`vmap`. `measure` maps it over agents and devices and keeps a row for every agent and point of its
training, agent by agent (`scb.rows`), so that a measurement that was killed goes on where it stopped.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment
from jax.typing import ArrayLike

from scb.agents.agent import Agent, evaluated_after
from scb.agents.spec import AgentSpec
from scb.environments.alike import representative
from scb.environments.registry import environment_spec
from scb.errors import UserError, count_at_least, one_of
from scb.evaluation import Episodes
from scb.files import plain
from scb.keys import root_key, split_key
from scb.machine import arithmetic, package_versions
from scb.objectives import Objective, programs_for
from scb.own import code_of, code_of_names
from scb.population import map_population
from scb.rows import Row, Rows

MODE, SAMPLED = "mode", "sampled"
# What is measured of an agent's episodes, as columns of its rows.
EARNED = ("return", "length", "speed")
_DIAGNOSIS = "diagnosis"  # a judge's name, beside the kinds of actions
# Steps of a training from which a CPU trains only as many agents at a time as it has devices.
LONG = 250_000


# -- one agent ------------------------------------------------------------------------------------


class Judge(NamedTuple):
    """What a trained agent is judged by.

    Attributes:
      env, params: where.
      episodes: how many; static.
      mode: the most likely actions instead of sampled ones; static.
      limit: steps after which an episode is cut; traced. None: the environment's own.
    """

    env: environment.Environment[Any, Any]
    params: Any
    episodes: int
    mode: bool = False
    limit: ArrayLike | None = None

    def __call__(self, agent: Agent, state: Any, key: jax.Array) -> Episodes:
        """[E] episodes of an agent."""
        return agent.evaluate(
            state, key, self.episodes, self.env, self.params, self.mode, self.limit
        )


def train_and_judge(
    agent: Agent,
    hyperparameters: Any,
    key: jax.Array,
    params: Any,
    judges: Mapping[Any, Judge | Callable[..., Any]],
    every: int | None = None,
    iterations: jax.Array | None = None,
) -> tuple[Any, dict[Any, Any]]:
    """One agent's training, and what it earns. Traced: to be jitted and vmapped by the caller.

    Args:
      key: decides everything. All judges meet one key, so that they see the same start states.
      params: of the environment that the agent trains in.
      judges: by name, `Judge` or whatever else tells something of an agent.
      every: iterations between judgements along the training, the first of them before it and one at its
        end. None: judged at the end alone.
      iterations: a traced number of iterations instead of the configuration's; without `every`.

    Returns:
      The trained agent's state, and {judge: what it finds}: `Episodes` of shape [points, E] with `every`, else [E].
    """

    def judged(state: Any, key: jax.Array) -> dict[Any, Any]:
        return {name: judge(agent, state, key) for name, judge in judges.items()}

    if every is not None:
        return agent.train_with_evaluations(key, hyperparameters, params, judged, every)
    key_train, key_judge = split_key(key)
    if iterations is None:
        state = agent.train(key_train, hyperparameters, params)
    else:
        state = agent.init(key_train, hyperparameters, params)
        state = agent.train_iterations(state, hyperparameters, params, iterations)
    return state, judged(state, key_judge)


def spaced(iterations: int, points: int) -> int:
    """Iterations between about so many judgements of a training.

    They divide it evenly, but where no divisor gives between half and twice as many as asked (a prime number of
    iterations): there the last come sooner.
    """
    points = min(points, iterations)
    divisors = (n for n in range(1, iterations + 1) if iterations % n == 0)
    every = min(divisors, key=lambda n: abs(iterations / n - points))
    even = points / 2 <= iterations / every <= points * 2
    return every if even else round(iterations / points)


# -- many agents ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Place:
    """Where agents train or are judged: an environment under the name that rows give it."""

    name: str
    env: environment.Environment[Any, Any]
    params: Any
    backend: str | None = None

    @classmethod
    def named(cls, name: str, backend: str | None = None) -> "Place":
        """An environment or bandit of the registry, with this physics."""
        spec = environment_spec(name)
        return cls(spec.name, *spec.make(backend), spec.physics(backend))

    def __str__(self) -> str:
        return self.name if self.backend is None else f"{self.name} ({self.backend} physics)"


@dataclass(frozen=True, eq=False)
class Agents:
    """Who is trained.

    Attributes:
      names: (seed, number among the seed's agents) of each.
      keys: [N] of each.
      hyperparameters: of each, every leaf [N].
      drawn: the hyperparameters that differ among them, which become columns.
    """

    names: Sequence[tuple[int, int]]
    keys: jax.Array
    hyperparameters: Any
    drawn: tuple[str, ...] = ()

    @classmethod
    def seeded(cls, spec: AgentSpec, seeds: Sequence[int]) -> "Agents":
        """One agent a seed, with the specification's own hyperparameters."""
        seeds = check_seeds(seeds)
        keys = jax.vmap(root_key)(np.asarray(seeds, np.uint32))
        return cls([(seed, 0) for seed in seeds], keys, spec.repeated(len(seeds)))

    @classmethod
    def drawn_from(cls, spec: AgentSpec, seed: int, number: int) -> "Agents":
        """Several agents of one seed, which share the values of the specification's lists out."""
        check_seeds([seed])
        key_draw, key_agents = split_key(root_key(seed))
        return cls(
            [(seed, i) for i in range(number)],
            split_key(key_agents, number),
            spec.sample(key_draw, number),
            tuple(sorted(spec.lists)),
        )


def as_random(returns: np.ndarray, place: Place) -> tuple[np.ndarray, np.ndarray]:
    """(returns, which were no finite number): those of agents that diverged are those of random actions there.

    Raises:
      UserError: random actions earn no number either.
    """
    failed = ~np.isfinite(returns)
    if failed.any():
        random = environment_spec(place.name).random_return(place.backend)
        returns = np.where(failed, random, returns)
    return returns, failed


def check_seeds(seeds: Sequence[int]) -> list[int]:
    """The seeds, as Python's integers.

    Raises:
      UserError: there are none, one is no whole number of 32 bits, or is there twice.
    """
    given: Any = seeds
    if not isinstance(given, Sequence | np.ndarray | jax.Array) or isinstance(given, str):
        raise UserError(f"the seeds are {given!r}: give a list, such as [0, 1] or range(10).")
    if not isinstance(given, Sequence):
        given = np.asarray(given).tolist()
    if not len(given):
        raise UserError("no seeds: give at least one.")
    for seed in given:
        if not (
            isinstance(seed, int | float | np.number) and 0 <= seed < 2**32 and seed == int(seed)
        ):
            raise UserError(
                f"a seed is {seed}: each must be a whole number, 0 or larger, and below 2^32."
            )
    whole = [int(seed) for seed in given]
    if repeated := [seed for seed, number in Counter(whole).items() if number > 1]:
        raise UserError(f"seed {repeated[0]} is there twice: give each once.")
    return whole


def measure(
    spec: AgentSpec,
    train_in: Place,
    judge_in: Place | None = None,
    agents: Agents | Sequence[int] = (0,),
    *,
    objectives: Sequence[Objective] = (),
    points: int | None = None,
    episodes: int = 20,
    actions: Sequence[str] = (MODE,),
    diagnose: bool = False,
    rows: Rows | None = None,
    side_by_side: int | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Row]:
    """Trains agents and judges them; what the rows hold already is not measured again.

    Where some of those that train side by side lack, all of these are trained, and the others' rows stay.

    Args:
      spec: the agents' algorithm, configuration and hyperparameters.
      train_in, judge_in: where; judged where they train if left out.
      agents: or seeds, of one agent each.
      objectives: each trains all agents, on the same seeds; none for the algorithm's own.
      points: about how many judgements along the training (`spaced`), the untrained agent's not counted. None: at
        the end alone.
      episodes: of each judgement.
      actions: "mode", the most likely ones, or "sampled", or both of the same agents.
      diagnose: whether rows say also what an iteration does to the policy (`PPO.diagnose`); PPO only.
        Rows that are there without it stay so.
      rows: where results are kept and found; None for memory.
      side_by_side: agents that train at a time, and are kept together. All of them where left out; on a
        CPU, with physics or `LONG` trainings, as many as devices, so that they are kept as they come.
      tell: takes a line when some agents are done.

    Returns:
      A row for every objective, agent, point and kind of actions, in this order, with the columns
      environment, backend, trained_in, algorithm, objective, seed, agent, step, actions, return, length, speed
      (means of the episodes; the speed None where the environment has no `forward_velocity`), those of
      `agents.drawn`, and configuration.

    Raises:
      UserError: the rows hold such agents measured under another configuration.
    """
    given: object = spec
    if not isinstance(given, AgentSpec):
        raise UserError(
            f"the spec is of the class {type(given).__name__}: give what scb.environment_agent returns, with_values of "
            "yours."
        )
    count_at_least(1, points=points, episodes=episodes, side_by_side=side_by_side)
    actions = (actions,) if isinstance(actions, str) else actions
    for kind in actions:
        one_of("kind of actions", kind, (MODE, SAMPLED))
    if spec.algorithm != "ppo" and (objectives or diagnose):
        raise UserError(
            f"objectives and diagnoses are of PPO's updates, and the algorithm is {spec.algorithm}: leave them out."
        )
    judge_in, rows = judge_in or train_in, Rows() if rows is None else rows
    agents = agents if isinstance(agents, Agents) else Agents.seeded(spec, agents)
    iterations = spec.config.num_iterations
    every = None if points is None else spaced(iterations, points)
    judged_at = [iterations] if every is None else evaluated_after(iterations, every)
    steps = [spec.config.steps_after(n) for n in judged_at]
    params = (spec.training_params(train_in.params), judge_in.params)
    long = train_in.backend is not None or spec.steps >= LONG
    if side_by_side is None and long and jax.default_backend() == "cpu":
        side_by_side = jax.device_count()
    columns = {
        "environment": judge_in.name,
        "backend": judge_in.backend,
        "trained_in": train_in.name,
        "algorithm": spec.algorithm,
    }
    configuration = {
        "agent": {n: getattr(spec, n) for n in ("config", "hyperparameters", "lists")},
        "trained_in": params[0],
        "judged_in": params[1],
        "physics": train_in.backend,
        "code": code_of_names([train_in.name, judge_in.name]),
        # Drawn agents share the values of lists out: of another number each has others.
        "drawn": len(agents.names) if agents.drawn else None,
        "points": points,
        "episodes": episodes,
        "actions": list(actions),
        "versions": package_versions() | arithmetic(),
    }

    named: Mapping[str | None, Objective | None] = {o.name: o for o in objectives} or {None: None}
    cells = {
        name: rows.cell(
            columns | {"objective": name},
            configuration | _told(objective),
            len(steps) * len(actions),
        )
        for name, objective in named.items()
    }
    if any(set(agents.names) - cell.done.keys() for cell in cells.values()):
        rows.expect_writable()
    # Physics take a minute to compile, however short the training.
    for drift, parameters in programs_for(objectives, shared=train_in.backend is not None):
        agent = spec.agent(train_in.env, drift)
        names: list[str | None] = list(parameters) or [None]
        wanted = [(name, i) for name in names for i in range(len(agents.names))]
        size = min(side_by_side or len(wanted), len(wanted))
        for start in range(0, len(wanted), size):
            batch = wanted[start : start + size]
            lacking = [(name, i) for name, i in batch if agents.names[i] not in cells[name].done]
            if not lacking:
                continue
            # With the neighbours that it has in this measurement, for an agent's last digits depend on its place:
            # where it goes on after a kill, these are the same.
            padded = [batch[i % len(batch)] for i in range(size)]
            which = np.array([i for _, i in padded])
            hyperparameters = jax.tree.map(itemgetter(which), agents.hyperparameters)
            if parameters:
                drifts = [parameters[name] for name, _ in padded if name is not None]
                stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *drifts)
                hyperparameters = replace(hyperparameters, drift=stacked)
            program, arrays = _program_of(
                agent, params, judge_in.env, episodes, tuple(actions), diagnose, every, size
            )
            earned, diagnosis = program(hyperparameters, agents.keys[which], *arrays)
            found = {x: dict(zip(EARNED, earned[x], strict=True)) | diagnosis for x in actions}
            for name, i in lacking:
                position = batch.index((name, i))
                # An objective takes the place of a drawn clip.
                own = [n for n in agents.drawn if not (parameters and n == "drift")]
                drawn = {n: float(getattr(agents.hyperparameters, n)[i]) for n in own}
                cells[name].add(
                    agents.names[i],
                    [
                        {
                            "step": step,
                            "actions": kind,
                            **{
                                what: plain(np.ravel(values[position])[point])
                                for what, values in found[kind].items()
                            },
                            **drawn,
                        }
                        for point, step in enumerate(steps)
                        for kind in actions
                    ],
                )
            done = sum(agents.names[i] in cells[name].done for name, i in wanted)
            tell(f"{', '.join([judge_in.name, *parameters])}: {done} of {len(wanted)} agents")
    return [row for cell in cells.values() for one in agents.names for row in cell.done[one]]


def _told(objective: Objective | None) -> dict[str, Any]:
    """What tells an objective from others of its name."""
    if objective is None:
        return {"objective": None}
    code = code_of(objective.drift)
    told = {"objective": (objective.drift, objective.parameters)}
    return told | ({"objective_code": code} if code else {})


def _program_of(
    agent: Agent, params: Any, judge_env: Any, *static: Any
) -> tuple[Callable[..., Any], list[Any]]:
    """The program that trains and judges, and the arrays in the parameters, which it takes after the agents.

    Arrays (a bandit's weights) are arguments, so that parameters which differ in them share a program; and so do
    environments that are alike.
    """
    leaves, structure = jax.tree.flatten(params)
    arrays = [x if isinstance(x, jax.Array | np.ndarray) else None for x in leaves]
    numbers = tuple(x if a is None else None for x, a in zip(leaves, arrays, strict=True))
    made_of = (getattr(agent, field.name) for field in fields(agent))
    program = _program(
        type(agent),
        tuple(representative(x) if x is agent.env else x for x in made_of),
        structure,
        numbers,
        representative(judge_env),
        *static,
    )
    return program, [x for x in arrays if x is not None]


@lru_cache(maxsize=8)  # each holds memory maps, of which a process has some ten thousand
def _program(
    kind: type[Agent],
    made_of: tuple[Any, ...],
    structure: Any,
    numbers: tuple[Any, ...],
    judge_env: environment.Environment[Any, Any],
    episodes: int,
    actions: tuple[str, ...],
    diagnose: bool,
    every: int | None,
    size: int,
) -> Callable[..., Any]:
    agent: Any = kind(*made_of)

    def one(hyperparameters: Any, key: jax.Array, *arrays: Any) -> tuple[dict[str, Any], Any]:
        given = iter(arrays)
        leaves = [next(given) if x is None else x for x in numbers]
        training_params, judge_params = jax.tree.unflatten(structure, leaves)
        judges: dict[str, Any] = {
            name: Judge(judge_env, judge_params, episodes, name == MODE) for name in actions
        }
        if diagnose:
            judges[_DIAGNOSIS] = lambda agent, state, key: agent.diagnose(
                state, hyperparameters, training_params
            )
        _, found = train_and_judge(agent, hyperparameters, key, training_params, judges, every)
        diagnosis = found.pop(_DIAGNOSIS, {})
        return {
            k: (
                x.returns.mean(-1),
                x.lengths.mean(-1),
                jnp.full(x.returns.shape[:-1], jnp.nan) if x.speeds is None else x.speeds.mean(-1),
            )
            for k, x in found.items()
        }, diagnosis

    return map_population(one, size, (0, 0, *(None for x in numbers if x is None)))
