"""Brax's own PPO trainer with a learned objective in the place of its clipped loss.

python examples/brax_learned_objective.py --objective lpo-pendulum --seed 1

The trainer takes no loss from outside, but looks its own up when it starts: for as long as it trains, that one is
replaced by the same with another policy loss. With the defaults and seeds 1 to 3, agents earned 244, 150 and 418
with lpo-pendulum, and 282, 151 and 513 with ppo.
"""

from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from brax import envs
from brax.training.agents.ppo import losses, train
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import lpo

THEIRS = losses.compute_ppo_loss


def replicated(tree: Any, devices: list[jax.Device]) -> Any:
    """A copy for each device: `jax.device_put_replicated`, which Brax's trainer calls and JAX 0.10 has no more."""
    each = NamedSharding(Mesh(np.asarray(devices), ("devices",)), PartitionSpec("devices"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), each), tree)


def loss_with(objective: str) -> Any:
    """Brax's loss, less its policy loss, plus an objective's.

    Brax doesn't tell its loss how far the training is, so objectives that change with it are refused.
    """
    found = lpo.load_objective(objective)
    if found.drift.temporal:
        raise SystemExit(
            f"{objective} changes with the training, and Brax's loss doesn't know how far it is."
        )
    objective_loss = lpo.loss_function(objective)

    def loss(
        params: Any, normalizer: Any, data: Any, key: jax.Array, ppo_network: Any, **settings: Any
    ) -> tuple[jax.Array, Any]:
        total, metrics = THEIRS(params, normalizer, data, key, ppo_network, **settings)
        # What the objective needs is computed once more here; the compiler finds it twice and does it once.
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
        policy = ppo_network.policy_network.apply(normalizer, params.policy, data.observation)
        taken = data.extras["policy_extras"]
        log_prob = ppo_network.parametric_action_distribution.log_prob(policy, taken["raw_action"])

        def value(observation: Any) -> jax.Array:
            return ppo_network.value_network.apply(normalizer, params.value, observation)

        truncation = data.extras["state_extras"]["truncation"]
        _, advantages = losses.compute_gae(
            truncation=truncation,
            termination=(1 - data.discount) * (1 - truncation),
            rewards=data.reward * settings["reward_scaling"],
            values=value(data.observation),
            bootstrap_value=value(jax.tree.map(lambda x: x[-1], data.next_observation)),
            lambda_=settings["gae_lambda"],
            discount=settings["discounting"],
        )
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_ratio = log_prob - taken["log_prob"]
        policy_loss = objective_loss(log_ratio, advantages)
        total = total - metrics["policy_loss"] + policy_loss
        return total, {**metrics, "total_loss": total, "policy_loss": policy_loss}

    return loss


def main(
    objective: str = "lpo-pendulum",
    environment: str = "inverted_pendulum",
    backend: str = "spring",
    steps: int = 200_000,
    seed: int = 1,
) -> float:
    """Train Brax's PPO with an objective, and print the return along the training.

    Args:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, a name of the zoo (lpo-pendulum) or path/to/objective.npz; one that
        changes with the training is refused.
      environment: of Brax.
      backend: its physics: generalized, positional or spring.
      steps: of the training.
      seed: of the agent.
    """
    earned: list[float] = []

    def progress(step: int, metrics: Any) -> None:
        earned.append(float(metrics["eval/episode_reward"]))
        print(f"{step:8d} steps: {earned[-1]:.1f}", flush=True)

    loss = mock.patch.object(losses, "compute_ppo_loss", loss_with(objective))
    with loss, mock.patch.object(jax, "device_put_replicated", replicated, create=True):
        train.train(
            environment=envs.get_environment(environment, backend=backend),
            num_timesteps=steps,
            episode_length=1000,
            num_envs=128,
            batch_size=128,
            num_minibatches=8,
            unroll_length=10,
            num_updates_per_batch=4,
            discounting=0.97,
            learning_rate=3e-4,
            entropy_cost=1e-2,
            normalize_observations=True,
            num_evals=5,
            num_eval_envs=32,
            seed=seed,
            progress_fn=progress,
        )
    print(f"{objective} after {steps} steps: {earned[-1]:.0f}")
    return earned[-1]


if __name__ == "__main__":
    tyro.cli(main)
