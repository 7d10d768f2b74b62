"""How fast Brax's generalized physics are here: this library's environments beside Brax's own, in one process.

    python -m experiments.brax_speed

Random actions in many environments; both are timed in turn, several times over. Compare the ratios: the seconds are
the machine's.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import brax.envs
import jax
import numpy as np

from experiments.harness import Experiment, Report, Save
from scb.environments.registry import environment_spec, families
from scb.errors import at_least

OWN, PEER = "scb", "brax"
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


def rollout(env: Any, options: Options) -> Callable[[], Any]:
    """A call that takes all steps from the same start states, and gives the [num_envs, O] last observations."""
    keys = jax.random.split(jax.random.key(SEED), options.num_envs)
    states = jax.jit(jax.vmap(env.reset))(keys)
    shape = (options.steps, options.num_envs, env.action_size)
    actions = jax.random.uniform(jax.random.key(SEED + 1), shape, minval=-1.0)

    @jax.jit
    def steps(states: Any, actions: jax.Array) -> jax.Array:
        def step(states: Any, actions: jax.Array) -> tuple[Any, None]:
            return jax.vmap(env.step)(states, actions), None

        last, _ = jax.lax.scan(step, states, actions)
        return last.obs

    return lambda: jax.block_until_ready(steps(states, actions))


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """In turn, so that what else the machine does meets both."""
    report |= {"num_envs": options.num_envs, "steps": options.steps, "repeats": options.repeats}
    found = report.setdefault("environments", {})
    for name in options.environments:
        original = brax.envs.get_environment(name, backend=BACKEND)
        own: Any = environment_spec(name).make(BACKEND)[0]
        calls = {
            OWN: rollout(own.brax_env, options),
            PEER: rollout(original, options),
        }
        compilation = {}
        for who, call in calls.items():
            start = time.perf_counter()
            call()
            compilation[who] = round(time.perf_counter() - start, 1)
        rates: dict[str, list[float]] = {who: [] for who in calls}
        for _ in range(options.repeats):
            for who, call in calls.items():
                start = time.perf_counter()
                call()
                seconds = time.perf_counter() - start
                rates[who].append(options.num_envs * options.steps / seconds)
        found[name] = {
            **{who: round(float(np.median(x))) for who, x in rates.items()},
            "ratios": [round(a / b, 2) for a, b in zip(rates[OWN], rates[PEER], strict=True)],
            "compilation": compilation,
        }
        print(name, found[name], flush=True)
        save()


def facts(report: Report) -> dict[str, Any]:
    """The median of each ratio, and what they are between."""
    ratios = {
        name: float(np.median(cell["ratios"])) for name, cell in report["environments"].items()
    }
    return {"own": OWN, "peer": PEER, "ratios": ratios}


EXPERIMENT = Experiment(
    "brax_speed",
    "How fast are Brax's generalized physics?",
    measure,
    facts=facts,
    options=Options,
    keys=("environments",),
    out=Path("docs/data/brax_speed.json"),
)


if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.main())
