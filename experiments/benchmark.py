"""How long PPO takes in the bandit: this project against rejax, in one go on one machine.

    make bench

Both train a population of 32 PPO agents for 10 000 steps in the shipped Pendulum bandit with the
paper's inner-loop configuration. rejax needs an older gymnax, so it runs in a virtual environment
of its own (`make bench` makes it). Timings are of the machine that runs them: compare the ratio.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

POPULATION = 32
REPEATS = 5
PEER = Path(__file__).with_name("rejax_peer.py")


def time_this_project() -> list[float]:
    """Seconds an agent of each repeat, after one run that compiles. Runs in a process of its own."""
    from lpo.cli import configure_jax

    configure_jax()
    import jax

    import scb
    from scb.evolution import map_population

    env, params = scb.make("Synthetic-Pendulum-v1")
    agent = scb.PPO(env, scb.PPOConfig(activation="relu"))
    train = map_population(
        lambda key: agent.train(key, scb.PPOHyperparameters(), params).params, POPULATION, (0,)
    )
    seconds = []
    for repeat in range(REPEATS + 1):
        keys = jax.random.split(jax.random.key(repeat), POPULATION)
        start = time.perf_counter()
        train(keys)
        seconds.append((time.perf_counter() - start) / POPULATION)
    return seconds[1:]


def bandit_arrays(path: Path) -> None:
    """Writes the shipped bandit's weights where the peer, which can't import this project, finds them."""
    from scb.artefacts import flatten
    from scb.environments.zoo import open_bandit

    bandit = open_bandit("Synthetic-Pendulum-v1")
    weights = flatten({k: dict(v) for k, v in bandit.default_params.weights.items()})
    arrays: dict[str, Any] = {"activation": bandit.config.activation, **weights}
    np.savez(path, **arrays)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--rejax-python", type=Path, help="python of an environment with rejax 0.1.3, gymnax 0.0.9"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark.json"))
    parser.add_argument("--only-this", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only_this:
        print(json.dumps(time_this_project()))
        return 0
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"population": POPULATION, "steps": 10_000, "seconds_per_agent": {}}
    result["seconds_per_agent"]["this project"] = _json_of(
        [sys.executable, "-m", "experiments.benchmark", "--only-this"]
    )
    if arguments.rejax_python is not None:
        weights = arguments.out.with_name("benchmark_bandit.npz")
        bandit_arrays(weights)
        result["seconds_per_agent"]["rejax 0.1.3"] = _json_of(
            [str(arguments.rejax_python), str(PEER), str(weights), str(POPULATION), str(REPEATS)]
        )
    for name, seconds in result["seconds_per_agent"].items():
        print(
            f"{name:14} {np.median(seconds):.4f} s an agent (of {', '.join(f'{s:.4f}' for s in seconds)})"
        )
    medians = [float(np.median(s)) for s in result["seconds_per_agent"].values()]
    if len(medians) == 2:
        result["ratio"] = medians[1] / medians[0]
        print(f"rejax takes {result['ratio']:.2f} times as long")
    else:
        print("rejax was not timed: `make bench` does that.")
    arguments.out.write_text(json.dumps(result, indent=2) + "\n")
    return 0


def _json_of(command: list[str]) -> list[float]:
    completed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return list(json.loads(completed.stdout.strip().splitlines()[-1]))


if __name__ == "__main__":
    sys.exit(main())
