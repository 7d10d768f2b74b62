"""How fast bandits step for Gymnasium: this library's own environments beside gymnax's wrappers of the same bandits.

    python -m experiments gymnasium_speed

One environment alone, an episode (a reset and a step) at a time, and many together. Both ways are timed in turn
in one process, several times over; compare the ratios, for the seconds are the machine's.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import gymnax
import numpy as np
from gymnax.wrappers.gym import GymnaxToGymWrapper, GymnaxToVectorGymWrapper

from experiments.harness import Experiment, Save
from experiments.reports import Report, settled
from experiments.timing import OWN, in_turn
from scb.errors import UserError, at_least, positive
from scb.gymnasium import NAMESPACE

PEER = "gymnax's wrapper"


@dataclass(frozen=True)
class Options:
    """What is timed."""

    bandits: tuple[str, ...] = (
        "Synthetic-Pendulum-v1",
        "Synthetic-CartPole-v1",
        "Synthetic-hopper",
    )
    """of the zoo"""
    num_envs: int = 1024
    """of the many"""
    repeats: int = 5
    """of each; the median counts"""
    seconds: float = 1.0
    """that a repeat takes, about"""

    def __post_init__(self) -> None:
        at_least(1, self, "num_envs", "repeats")
        positive(self, "seconds")
        if not self.bandits:
            raise UserError("no bandits: name one at least.")


def steps_a_second(step: Callable[[], Any], steps: int, seconds: float) -> float:
    """Environment steps a second of a call that takes so many."""
    step()  # compiles, where there is something to compile
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        calls += 1
    return calls * steps / (time.perf_counter() - start)


def stepping(name: str, num_envs: int | None) -> dict[str, Callable[[], Any]]:
    """{who: an episode in one environment, or in all of many}."""
    env, params = gymnax.make(name)
    calls: dict[str, Callable[[], Any]] = {}
    made: Any
    for who in (OWN, PEER):
        if num_envs is None:
            made = (
                gymnasium.make(f"{NAMESPACE}/{name}")
                if who == OWN
                else GymnaxToGymWrapper(env, params)
            )
        elif who == OWN:
            made = gymnasium.make_vec(f"{NAMESPACE}/{name}", num_envs=num_envs)
        else:
            made = GymnaxToVectorGymWrapper(env, num_envs, params)
        made.reset(seed=0)
        calls[who] = _episode(made, made.action_space.sample(), alone=num_envs is None)
    return calls


def _episode(env: Any, action: Any, alone: bool) -> Callable[[], Any]:
    def alone_() -> None:
        env.reset()
        env.step(action)

    # As a caller needs them, not as a promise of them.
    return alone_ if alone else lambda: np.asarray(env.step(action)[1])


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """One bandit after the other, alone and many of it."""
    settled(report, num_envs=options.num_envs)
    for name in options.bandits:
        found: dict[str, Any] = {}
        for kind, num_envs in (("one", None), ("many", options.num_envs)):
            rates = {
                who: partial(steps_a_second, call, num_envs or 1, options.seconds)
                for who, call in stepping(name, num_envs).items()
            }
            found[kind] = in_turn(rates, options.repeats)
            print(name, kind, found[kind], flush=True)
        report.setdefault("bandits", {})[name] = found
        save()


def facts(report: Report) -> dict[str, Any]:
    """The medians of the ratios, and the smallest of all of one environment alone."""

    def ratio(cell: Mapping[str, Any]) -> float:
        return float(np.median(cell["ratios"]))

    bandits = report["bandits"].values()
    return {
        "own": OWN,
        "peer": PEER,
        "ratio": ratio,
        "least": min(min(kinds["one"]["ratios"]) for kinds in bandits),
        "together": sorted(ratio(kinds["many"]) for kinds in bandits),
    }


EXPERIMENT = Experiment(
    "gymnasium_speed",
    "Bandits for Gymnasium",
    measure,
    facts=facts,
    options=Options,
    keys=("bandits",),
)
