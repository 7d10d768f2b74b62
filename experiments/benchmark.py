"""How long training in a bandit takes and what it yields: this project against rejax, in one go on one machine.

    make bench

Populations train for 10 000 steps with the paper's inner-loop configuration at its fixed (underlined)
hyperparameters: PPO, SAC, TD3 and DDPG in the Pendulum bandit, DQN and discrete SAC in the CartPole
bandit that ship. Every agent is then evaluated for 20 episodes in the environment itself.

rejax needs an older gymnax, so it runs in a virtual environment of its own (`make bench` makes it)
and evaluates in that gymnax's Pendulum-v1 and CartPole-v1: same dynamics, start states and episode
lengths as in the gymnax used here. Its settings are derived from this project's; what still differs
is the algorithms' own:

- SAC: rejax fills the buffer with its untrained policy's actions, this project with uniform ones.
- DDPG: rejax has none; it is rejax's TD3 without delay and target noise, reduced to one critic.
- TD3: rejax's policy follows the mean of two critics, this project's the first. In one-step
  episodes this project leaves out the second one, and all that serves only bootstrapping.
- Batches: rejax draws them without replacement, this project with.
- Gradients: rejax clips every element, this project the norm; SAC's are not clipped.

Timings are of the machine that runs them: compare the ratio. Both may use all of its cores; this
project deals its population out to them, rejax leaves that to XLA.
"""

import json
import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import scb
from experiments.harness import Experiment, Save, last_line
from experiments.reports import bandit_of, settled
from scb.agents.spec import bandit_agent
from scb.artefacts import flatten
from scb.environments.zoo import space_description
from scb.errors import UserError, at_least, one_of
from scb.keys import named_key, root_key, split_key
from scb.population import map_population
from scb.statistics import Estimate, estimate

EPISODES = 20
STEPS = 10_000
THIS, PEER = "this project", "rejax 0.1.3"
PEER_SCRIPT = Path(__file__).with_name("peers") / "rejax_peer.py"


@dataclass(frozen=True)
class Task:
    algorithm: str
    environment: str
    population: int = 8
    repeats: int = 2


TASKS = {
    "ppo": Task("ppo", "Pendulum-v1", population=32, repeats=5),
    "sac": Task("sac", "Pendulum-v1"),
    "td3": Task("td3", "Pendulum-v1"),
    "ddpg": Task("ddpg", "Pendulum-v1"),
    "dqn": Task("dqn", "CartPole-v1"),
    "sac-discrete": Task("sac", "CartPole-v1"),
}


def spec_of(task: Task, steps: int) -> Any:
    """The paper's inner-loop configuration at its fixed hyperparameters."""
    return bandit_agent(task.algorithm, task.environment, sampled=False).with_steps(steps)


def measure_this_project(task: Task, steps: int) -> dict[str, list[float]]:
    """Seconds an agent of each repeat, after one run that compiles, and the agents' mean returns.

    Runs in a process of its own.
    """
    bandit, _ = bandit_of(task.environment)
    params = bandit.default_params
    spec = spec_of(task, steps)
    agent = spec.agent(bandit)
    env, env_params = scb.make(task.environment)

    def train(key: jax.Array) -> Any:
        state = agent.train(key, spec.hyperparameters, params)
        # What acting takes no part in stays behind.
        unused = {"optimizer", "environment", "buffer", "key"} & set(state.__dataclass_fields__)
        return replace(state, **dict.fromkeys(unused))

    def evaluate(state: Any, key: jax.Array) -> jax.Array:
        return agent.evaluate(state, key, EPISODES, env, env_params).returns.mean()

    train_all = map_population(train, task.population, (0,))
    evaluate_all = map_population(evaluate, task.population, (0, 0))
    seconds: list[float] = []
    returns: list[float] = []
    for repeat in range(task.repeats + 1):
        keys = split_key(root_key(repeat), task.population)
        start = time.perf_counter()
        states = train_all(keys)
        if repeat == 0:
            continue
        seconds.append((time.perf_counter() - start) / task.population)
        keys = split_key(named_key(root_key(repeat), "evaluation"), task.population)
        returns += evaluate_all(states, keys).tolist()
    return {"seconds": seconds, "returns": returns}


def write_rejax_job(folder: Path, task: Task, steps: int) -> Path:
    """Writes the bandit and rejax's settings where the peer, which can't import this project, finds them."""
    bandit, _ = bandit_of(task.environment)
    spec = spec_of(task, steps)
    algorithm, settings = rejax_settings(task.algorithm, spec, bandit.action_space())
    weights = folder / "bandit.npz"
    arrays: dict[str, Any] = {
        **flatten({k: dict(v) for k, v in bandit.default_params.weights.items()})
    }
    np.savez(weights, **arrays)
    job = {
        "bandit": {
            "weights": str(weights),
            "activation": bandit.config.activation,
            "latent": bandit.config.latent,
            "action_space": space_description(bandit.action_space()),
        },
        "algorithm": algorithm,
        "settings": settings,
        "population": task.population,
        "repeats": task.repeats,
        "environment": task.environment,
        "episodes": EPISODES,
    }
    path = folder / "job.json"
    path.write_text(json.dumps(job))
    return path


def rejax_settings(algorithm: str, spec: Any, space: Any) -> tuple[str, dict[str, Any]]:
    """rejax's algorithm and its arguments for this project's configuration and hyperparameters."""
    config, numbers = spec.config, spec.hyperparameters
    activation = {"activation": config.activation}
    settings: dict[str, Any] = {
        "num_envs": config.num_envs,
        "total_timesteps": config.total_steps,
        "learning_rate": numbers.learning_rate,
        "gamma": numbers.discount,
    }
    if hasattr(numbers, "max_grad_norm"):
        settings["max_grad_norm"] = numbers.max_grad_norm
    if algorithm == "ppo":
        return "PPO", settings | {
            "agent_kwargs": {**activation, "hidden_layer_sizes": config.hidden_sizes},
            "num_steps": config.num_steps,
            "num_epochs": config.num_epochs,
            "num_minibatches": config.num_minibatches,
            "gae_lambda": numbers.gae_lambda,
            "clip_eps": numbers.drift,
            "ent_coef": numbers.entropy_coefficient,
            "vf_coef": numbers.value_coefficient,
        }
    settings |= {
        "buffer_size": config.buffer_size,
        "fill_buffer": config.prefill,
        "batch_size": config.batch_size,
        "num_epochs": config.gradient_steps,
    }
    if algorithm == "sac":
        return "SAC", settings | {
            "agent_kwargs": activation,
            "hidden_layer_sizes": config.hidden_sizes,
            "polyak": numbers.polyak,
            "target_entropy_ratio": numbers.target_entropy_ratio,
        }
    # The networks of rejax's DQN and TD3 are fixed.
    if config.hidden_sizes != (64, 64):
        raise ValueError(f"rejax's {algorithm} has hidden layers of (64, 64) only.")
    if algorithm == "dqn":
        return "DQN", settings | {
            "agent_kwargs": activation,
            "ddqn": bool(numbers.double > 0.5),
            "eps_start": numbers.epsilon_start,
            "eps_end": numbers.epsilon_end,
            "exploration_fraction": numbers.epsilon_decay,
            "target_update_freq": config.target_update_every,
            "polyak": 0.0,  # a copy
        }
    half_width = (float(np.max(space.high)) - float(np.min(space.low))) / 2  # rejax's unit is 1
    return "TD3" if config.num_critics == 2 else "DDPG", settings | {
        "actor_kwargs": activation,
        "critic_kwargs": activation,
        "num_critics": config.num_critics,
        "policy_delay": config.policy_delay,
        "polyak": numbers.polyak,
        "exploration_noise": numbers.exploration_noise * half_width,
        "target_noise": numbers.target_noise * half_width,
        "target_noise_clip": numbers.target_noise_clip * half_width,
    }


def summary(task: Task, measured: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """What is written for an algorithm. Agents whose return is no number are counted and left out."""
    result: dict[str, Any] = {
        "environment": task.environment,
        "population": task.population,
        "seconds_per_agent": {who: values["seconds"] for who, values in measured.items()},
        "return": {},
    }
    for who, values in measured.items():
        returns = np.asarray(values["returns"])
        finite = returns[np.isfinite(returns)]
        iqm = estimate(finite).as_dict() if finite.size else None
        result["return"][who] = {"iqm": iqm, "diverged": returns.size - finite.size}
    if PEER in measured:
        medians = {who: float(np.median(values["seconds"])) for who, values in measured.items()}
        result["ratio"] = medians[PEER] / medians[THIS]
    return result


def row(name: str, result: dict[str, Any]) -> str:
    """A line of what is printed."""
    times = [result["seconds_per_agent"].get(who) for who in (THIS, PEER)]
    seconds = ["-" if x is None else f"{np.median(x):.4f}" for x in times]
    returns = []
    for who in (THIS, PEER):
        found = result["return"].get(who)
        if found is None:
            returns.append("-")
            continue
        iqm = "none" if found["iqm"] is None else str(Estimate(**found["iqm"]))
        returns.append(iqm + (f", {found['diverged']} diverged" if found["diverged"] else ""))
    return line(name, *seconds, f"{result['ratio']:.2f}" if "ratio" in result else "-", *returns)


def line(*cells: str) -> str:
    widths = (13, 13, 12, 7, 35, 35)
    return "".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()


@dataclass(frozen=True)
class Options:
    """What is timed."""

    rejax_python: Path | None = None
    """python of an environment with rejax 0.1.3, gymnax 0.0.9"""
    algorithms: str = ",".join(TASKS)
    """some of them, comma-separated"""
    steps: int = STEPS

    def __post_init__(self) -> None:
        if self.rejax_python is not None and not os.access(self.rejax_python, os.X_OK):
            raise UserError(f"{self.rejax_python} is no program: give another --rejax-python.")
        at_least(1, self, "steps")
        for name in self.algorithms.split(","):
            one_of("algorithm", name, TASKS)


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """An algorithm at a time, here and there."""
    settled(report, steps=options.steps, episodes=EPISODES)
    results = report.setdefault("algorithms", {})
    names = options.algorithms.split(",")
    beside = [name for name in names if "ratio" in results.get(name, {})]
    if beside and options.rejax_python is None:
        raise UserError(
            f"the report has rejax's times of {', '.join(beside)}, taken in one go with ours: give --rejax-python, or "
            "another --out."
        )
    print(f"Training for {options.steps} steps in the bandit; median seconds an agent.")
    print(f"Return in the real environment: IQM [95 %] of agents, {EPISODES} episodes each.\n")
    print(line("algorithm", THIS, PEER, "ratio", f"return, {THIS}", f"return, {PEER}"), flush=True)
    for name in names:
        own = f"from experiments import benchmark; benchmark.print_measured({name!r}, {options.steps})"
        measured = {THIS: last_line([sys.executable, "-c", own])}
        if options.rejax_python is not None:
            with tempfile.TemporaryDirectory() as folder:
                job = write_rejax_job(Path(folder), TASKS[name], options.steps)
                peer = [str(options.rejax_python), str(PEER_SCRIPT), str(job)]
                measured[PEER] = last_line(peer)
        results[name] = summary(TASKS[name], measured)
        print(row(name, results[name]), flush=True)
        save()
    if options.rejax_python is None:
        print("\nrejax was not measured: `make bench` does that.")


def print_measured(name: str, steps: int) -> None:
    """What a process of its own does."""
    print(json.dumps(measure_this_project(TASKS[name], steps)))


EXPERIMENT = Experiment(
    "benchmark",
    "Training in a bandit, this project against rejax",
    measure,
    options=Options,
    out=Path("runs/benchmark.json"),
)
