"""How fast Brax's generalized physics are here: this library's environments beside Brax's own, in one process.

    python -m experiments brax_speed

Random actions in many environments; both are timed in turn, several times over. Compare the ratios: the seconds are
the machine's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from experiments.harness import Experiment, Save
from experiments.reports import Report, settled
from experiments.timing import OWN, in_turn, without_compilation_cache
from scb.environments.brax_physics import CHUNK
from scb.environments.registry import environment_spec, families
from scb.errors import at_least
from scb.keys import named_key, root_key, split_key
from scb.stopwatch import Stopwatch

PEER = "brax"
BACKEND = "generalized"
SEED = 1


@dataclass(frozen=True)
class Options:
    """What is timed."""

    environments: tuple[str, ...] = tuple(families()["brax"].names())
    """of Brax"""
    num_envs: int = 64
    """side by side"""
    steps: int = 20
    """of each environment in a repeat"""
    repeats: int = 5
    """of each; the median counts"""

    def __post_init__(self) -> None:
        at_least(1, self, "num_envs", "steps", "repeats")


def rollout(env: Any, options: Options) -> Callable[[], jax.Array]:
    """A call that takes all steps from the same start states, and gives the [num_envs, O] last observations."""
    key = root_key(SEED)
    states = jax.jit(jax.vmap(env.reset))(split_key(key, options.num_envs))
    shape = (options.steps, options.num_envs, env.action_size)
    actions = jax.random.uniform(named_key(key, "actions"), shape, minval=-1.0)

    @jax.jit
    def steps(states: Any, actions: jax.Array) -> jax.Array:
        def step(states: Any, actions: jax.Array) -> tuple[Any, None]:
            return jax.vmap(env.step)(states, actions), None

        last, _ = jax.lax.scan(step, states, actions)
        return last.obs

    return lambda: jax.block_until_ready(steps(states, actions))


def seconds(call: Callable[[], Any]) -> float:
    """That a call takes."""
    watch = Stopwatch()
    call()
    return watch.lap()


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """An environment at a time."""
    import brax.envs  # it prints what it misses

    settled(report, num_envs=options.num_envs, steps=options.steps, repeats=options.repeats)
    found = report.setdefault("environments", {})
    steps = options.num_envs * options.steps
    for name in options.environments:
        own: Any = environment_spec(name).make(BACKEND)[0]
        peer = brax.envs.get_environment(name, backend=BACKEND)
        calls = {OWN: rollout(own.brax_env, options), PEER: rollout(peer, options)}
        with without_compilation_cache():
            compilation = {who: round(seconds(call), 1) for who, call in calls.items()}
        rates = {who: lambda call=call: steps / seconds(call) for who, call in calls.items()}
        found[name] = {**in_turn(rates, options.repeats), "compilation": compilation}
        print(name, found[name], flush=True)
        save()


def facts(report: Report) -> dict[str, Any]:
    """The median of each environment's ratios."""
    ratios = {
        name: float(np.median(cell["ratios"])) for name, cell in report["environments"].items()
    }
    return {"own": OWN, "peer": PEER, "ratios": ratios, "chunk": CHUNK}


EXPERIMENT = Experiment(
    "brax_speed",
    "How fast are Brax's generalized physics?",
    measure,
    facts=facts,
    options=Options,
    keys=("environments",),
)
