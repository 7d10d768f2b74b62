"""The shipped Pendulum bandit beside the published one, under the same agents.

    python -m experiments.bandit_comparison --published DIRECTORY

20 PPO agents with hyperparameters sampled from the paper's lists train for 10 000 steps in each
bandit, on the same seeds, and are evaluated for 50 episodes in Pendulum-v1. DIRECTORY holds the
paper's bandits as arrays (pendulum.npz); without it only the shipped one is measured.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lpo.cli import configure_jax

FIRST_REPORTING_SEED = 10_000


def published_bandit(path: Path, environment: str) -> Any:
    """A bandit of the paper's authors: ReLU networks of 32 units, a normal latent, released as plain arrays."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from scb import make
    from scb.artefacts import unflatten
    from scb.environments.synthetic import BanditConfig, SyntheticBandit

    env, env_params = make(environment)
    with np.load(path, allow_pickle=False) as arrays:
        weights: Any = jax.tree.map(
            jnp.asarray, unflatten(path, {name: arrays[name] for name in arrays.files})
        )
    size = weights["initial_state"]["Dense_1"]["bias"].shape[0]
    config = BanditConfig(activation="relu")
    space = env.action_space(env_params)
    return SyntheticBandit(size, space, config, weights, name=f"published {environment}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--published", type=Path, help="folder with the published bandits' .npz files"
    )
    parser.add_argument("--bandit", default="Synthetic-Pendulum-v1", help="a zoo name or path.npz")
    parser.add_argument("--agents", type=int, default=20)
    parser.add_argument("--out", type=Path, help="write the result as JSON")
    arguments = parser.parse_args()
    configure_jax()

    from scb import make
    from scb.agents.hyperparameters import inner_loop_config, inner_loop_lists
    from scb.artefacts import machine_description, package_versions
    from scb.discovery import BanditTraining, judge
    from scb.environments.zoo import open_bandit
    from scb.statistics import estimate, paired_difference

    environment = "Pendulum-v1"
    env, env_params = make(environment)
    bandits = {"discovered here": open_bandit(arguments.bandit)}
    if arguments.published is not None:
        bandits["published"] = published_bandit(arguments.published / "pendulum.npz", environment)
    returns: dict[str, dict[str, Any]] = {}
    for name, bandit in bandits.items():
        lists = inner_loop_lists(bandit.action_space())
        training = BanditTraining(bandit, env, env_params, inner_loop_config(environment), lists)
        weights = bandit.default_params.weights
        returns[name] = {
            actions: judge(training, weights, FIRST_REPORTING_SEED, arguments.agents, mode=mode)
            for actions, mode in (("sampled", False), ("mode", True))
        }
    print(
        "| bandit | sampled actions: IQM [95 %] | mode actions: IQM [95 %] |\n| --- | --- | --- |"
    )
    for name, by_actions in returns.items():
        print(f"| {name} | {estimate(by_actions['sampled'])} | {estimate(by_actions['mode'])} |")
    result: dict[str, Any] = {
        "environment": environment,
        "agents": arguments.agents,
        "episodes": 50,
        "seed": FIRST_REPORTING_SEED,
        "versions": package_versions(),
        "machine": machine_description(),
        "returns": {
            name: {
                actions: {"iqm": estimate(x).as_dict(), "agents": [round(float(r), 1) for r in x]}
                for actions, x in by_actions.items()
            }
            for name, by_actions in returns.items()
        },
    }
    if len(returns) == 2:
        ours, theirs = returns["discovered here"], returns["published"]
        result["difference"] = {
            actions: paired_difference(ours[actions], theirs[actions]).as_dict() for actions in ours
        }
        print(
            f"difference, sampled actions: {paired_difference(ours['sampled'], theirs['sampled'])}"
        )
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
