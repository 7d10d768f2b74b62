"""rejax's PPO with a learned objective in the place of its clipped loss.

python examples/rejax_learned_objective.py --objective lpo/zoo/lpo-pendulum.npz --agents 5

rejax 0.1.3 needs gymnax 0.0.9, on which this library doesn't run, so the objective is read from its two files
without it: `make .venv-rejax/.installed` makes an environment for this example. Five agents earned −894 on
average with this command, and −1138 with `--objective ppo`; random actions earn about −1200.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from rejax import PPO


def drift_from(path: Path) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """(log_ratio, advantage) -> penalty of a learned drift with a PPO base, as docs/elsewhere.md writes it down."""
    weights = {name: jnp.asarray(x) for name, x in np.load(path).items()}
    family = json.loads(path.with_suffix(".json").read_text())["config"]["drift"]
    if (family.get("base"), len(family.get("features", ()))) != ("ppo", 8):
        raise SystemExit(
            f"{path} is no network on PPO's clip without progress: docs/elsewhere.md says what differs."
        )
    clip, xi, gate = family["clip"], family["xi"], family["gate"]

    def drift(log_ratio: jax.Array, advantage: jax.Array) -> jax.Array:
        log_ratio = jnp.clip(log_ratio, -20.0, 20.0)
        delta = -jnp.expm1(log_ratio)
        away = jnp.stack([delta, delta**2, log_ratio, log_ratio**2], axis=-1)
        features = jnp.concatenate([away, advantage[..., None] * away], axis=-1)
        penalty = (jnp.tanh(features @ weights["hidden"]) @ weights["output"])[..., 0]
        if gate:
            penalty *= -jnp.expm1(-((log_ratio / gate) ** 2))
        ratio = jnp.exp(log_ratio)
        penalty += jax.nn.relu((ratio - jnp.clip(ratio, 1.0 - clip, 1.0 + clip)) * advantage)
        return jax.nn.relu(penalty - xi)

    return drift


class LPO(PPO):
    """rejax's PPO whose policy loss is an objective's."""

    drift: Callable[[jax.Array, jax.Array], jax.Array] = struct.field(
        pytree_node=False, default=None
    )

    def update_actor(self, ts: Any, batch: Any) -> Any:
        """One gradient step of the policy; all but the objective is rejax's own."""

        def loss(params: Any) -> jax.Array:
            log_prob, entropy = self.actor.apply(
                params, batch.trajectories.obs, batch.trajectories.action, method="log_prob_entropy"
            )
            advantages = batch.advantages - batch.advantages.mean()
            advantages = advantages / (batch.advantages.std() + 1e-8)
            log_ratio = log_prob - batch.trajectories.log_prob
            # Clipped for the ratio too: what lies further out costs no more, but the ratio would grow.
            log_ratio = jnp.clip(log_ratio, -20.0, 20.0)  # the objective
            penalty = self.drift(log_ratio, advantages)  # the objective
            surrogate = jnp.mean(jnp.exp(log_ratio) * advantages - penalty)  # the objective
            return -surrogate - self.ent_coef * entropy.mean()

        gradients = jax.grad(loss)(ts.actor_ts.params)
        return ts.replace(actor_ts=ts.actor_ts.apply_gradients(grads=gradients))


def main() -> None:
    """Trains agents side by side and prints what each earns at the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--objective", default="lpo/zoo/lpo-pendulum.npz", help="path of an objective, or ppo"
    )
    parser.add_argument("--agents", type=int, default=5)
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    clipped = arguments.objective == "ppo"
    settings = {} if clipped else {"drift": drift_from(Path(arguments.objective))}
    algorithm = (PPO if clipped else LPO).create(
        env="Pendulum-v1",
        total_timesteps=arguments.steps,
        eval_freq=arguments.steps,
        num_envs=100,
        num_steps=100,
        num_epochs=10,
        num_minibatches=10,
        learning_rate=1e-3,
        gamma=0.995,
        gae_lambda=0.95,
        ent_coef=0.01,
        max_grad_norm=10.0,
        **settings,
    )
    keys = jax.random.split(jax.random.PRNGKey(arguments.seed), arguments.agents)
    _, (_, returns) = jax.jit(jax.vmap(algorithm.train))(keys)
    earned = np.asarray(returns[:, -1].mean(axis=-1))
    print(
        f"{arguments.objective} after {arguments.steps} steps: {', '.join(f'{x:.0f}' for x in sorted(earned))}"
    )
    print(f"mean: {earned.mean():.0f}")


if __name__ == "__main__":
    main()
