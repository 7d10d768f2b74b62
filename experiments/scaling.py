"""What several processes are worth, and from where on more of them would not be: a population that grows with them.

    python -m experiments scaling

Meta-trainings on the Pendulum bandit, each a command, of 1 to 4 processes with one device and as many candidates
each, bound to a core each as far as there are cores. Then by itself what is not divided among processes: gathering
what candidates are worth, and the search's own arithmetic, which each of them does. Nothing else should run beside it.
"""

import math
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, settled
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import MetaTraining
from scb import processes
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.errors import UserError, at_least
from scb.keys import root_key
from scb.runs import log_lines
from scb.stopwatch import Stopwatch
from scb.strategies import strategy_for

# The strategies' work by the number of candidates; the largest is a thousand devices' with sixteen each.
POPULATIONS = (64, 512, 4096, 16_384)
DEVICES = 1000
SHARE = 0.05  # of a generation, from which on gathering is said to cost something
REPEATS = 200


@dataclass(frozen=True)
class Options:
    """How many processes, and how much each of them does."""

    processes: tuple[int, ...] = (1, 2, 3, 4)
    candidates: int = 16
    """of each process"""
    generations: int = 8
    """the first, which compiles, and the last, which is judged, are not counted"""

    def __post_init__(self) -> None:
        at_least(1, self, "candidates")
        at_least(3, self, "generations")
        if min(self.processes, default=0) < 1 or not {1} < set(self.processes):
            raise UserError(
                f"--processes are {self.processes}: give 1, which the others are compared with, and larger numbers."
            )


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """Numbers of processes, then what is not divided among them."""
    settled(report, candidates=options.candidates, devices=DEVICES, searched=options.generations)
    for number in options.processes:
        yield Part(("generations", str(number)), partial(_generations, number, options))
    for number in options.processes:
        if number > 1:
            yield Part(("gathering", str(number)), partial(_gathering, number, options))
    for kind in ("objective", "bandit"):
        for population in POPULATIONS:
            yield Part(("strategy", kind, str(population)), partial(_strategy, kind, population))


measure = InParts(parts)


def _generations(number: int, options: Options) -> list[float]:
    """[G] seconds of generations that several processes computed together."""
    with tempfile.TemporaryDirectory() as folder:
        flags = {
            "population-size": options.candidates * number,
            "generations": options.generations,
            "mean-evaluations": number,
            "evaluate-mean-every": options.generations,
            "out": f"{folder}/run",
        }
        code = "import sys; from lpo.cli import main; sys.exit(main())"
        words = [f"--{name}={value}" for name, value in flags.items()]
        together(number, [code, "meta-train", *words])
        lines = log_lines(Path(folder) / "run" / "timing.jsonl", "seconds")
    return [round(line["seconds"], 3) for line in lines[1:-1]]


def _gathering(number: int, options: Options) -> float:
    """Milliseconds in which several processes gather what their candidates are worth."""
    code = "import sys; from experiments.scaling import gather; gather(*sys.argv[1:])"
    said = together(number, [code, str(options.candidates)])
    return round(float(said.splitlines()[-1]), 3)


def gather(candidates: str, *flags: str) -> None:
    """What each of them does, and the first says how long it took: flags as `lpo meta-train` takes them."""
    processes.start(dict(flag[2:].split("=", 1) for flag in flags))
    mine = {"fitness": np.zeros(int(candidates), np.float32)}
    for _ in range(10):
        processes.gathered(mine)
    watch, seconds = Stopwatch(), []
    for _ in range(REPEATS):
        processes.gathered(mine)
        seconds.append(watch.lap())
    if processes.first():
        print(1000 * float(np.median(seconds)), flush=True)
    processes.end(0)


def together(number: int, command: Sequence[str]) -> str:
    """Starts so many processes of `python -c COMMAND`, of a core and a device each; what the first of them says."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    cores = sorted(os.sched_getaffinity(0))
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "1"}
    started = []
    for i in range(number):
        who = [f"--coordinator=localhost:{port}", f"--processes={number}", f"--process={i}"]
        bound = f"import os; os.sched_setaffinity(0, [{cores[i % len(cores)]}]); {command[0]}"
        started.append(
            subprocess.Popen(
                [sys.executable, "-c", bound, *command[1:], *(who if number > 1 else [])],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    said = [process.communicate() for process in started]
    for process, (_, error) in zip(started, said, strict=True):
        if process.returncode:
            raise UserError(
                f"a process of {number} failed: {(error.strip() or '?').splitlines()[-1]}"
            )
    return said[0][0]


def _strategy(kind: str, population: int) -> dict[str, Any]:
    """{"parameters", "milliseconds"} of drawing candidates and of learning what they are worth, once."""
    problem: Any = (
        MetaTraining(MetaTrainingConfig())
        if kind == "objective"
        else BanditDiscovery(DiscoveryConfig("Pendulum-v1", init="random"))
    )
    solution = problem.initial_solution(root_key(0))
    # With the strategy that each of both searches has.
    config = replace(problem.config.evolution, population_size=population)
    strategy = strategy_for(config, solution)
    state = strategy.start(root_key(1), solution)
    fitness, watch, seconds = np.arange(population, dtype=np.float32), Stopwatch(), []
    for i in range(12):
        candidates, state = strategy.ask(root_key(i), state)
        state = jax.block_until_ready(strategy.tell(root_key(i), candidates, fitness, state))
        seconds.append(watch.lap())
    size = sum(x.size for x in jax.tree.leaves(solution))
    return {"parameters": size, "milliseconds": round(1000 * float(np.median(seconds[2:])), 2)}


def grown(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """(slope, intercept) of the line through points, level at their mean where it would fall, or without any."""
    if not points:
        return 0.0, 0.0
    x, y = np.transpose(points)
    slope, intercept = np.polyfit(x, y, 1) if len(x) > 1 else (0.0, y[0])
    if slope < 0.0:
        return 0.0, float(y.mean())
    return float(slope), max(0.0, float(intercept))


def facts(report: Report) -> dict[str, Any]:
    """The table, and what it would be with a thousand devices."""
    cores = report["machine"]["cores"]
    alone = float(np.median(report["generations"]["1"]))
    rows = []
    for number, seconds in sorted(report["generations"].items(), key=lambda x: int(x[0])):
        took, share = float(np.median(seconds)), math.ceil(int(number) / cores)
        rows.append(
            {
                "processes": int(number),
                "candidates": int(number) * report["candidates"],
                "seconds": took,
                "lowest": min(seconds),
                "highest": max(seconds),
                "efficiency": alone * share / took,
                "gathering": report["gathering"].get(number),
            }
        )
    slope, intercept = grown([(int(n), ms) for n, ms in report["gathering"].items()])
    gathering = intercept + slope * report["devices"]
    largest = str(max(POPULATIONS))
    if not all(largest in found for found in report["strategy"].values()):
        raise UserError(
            "the report of scaling is not complete: leave out --only-render, and the command goes on where it was."
        )
    strategy = {
        kind: {"parameters": found[largest]["parameters"], "times": found}
        for kind, found in report["strategy"].items()
    }
    return {
        "rows": rows,
        "cores": cores,
        "alone": alone,
        "populations": POPULATIONS,
        "many": gathering,
        "slope": slope,
        "share": gathering / 1000 / alone,
        "costly": SHARE,
        "from": max(1.0, (1000 * alone * SHARE - intercept) / slope) if slope > 1e-9 else None,
        "kinds": strategy,
        "largest": largest,
    }


EXPERIMENT = Experiment(
    "scaling",
    "What are several processes worth, and from where on would more of them not be?",
    measure,
    facts=facts,
    options=Options,
    keys=("generations", "gathering", "strategy"),
)
