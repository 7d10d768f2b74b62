"""Stable-Baselines3's PPO with a learned objective in the place of its clipped loss.

python examples/sb3_learned_objective.py --objective lpo-pendulum --seed 1

It needs stable-baselines3 beside this library. What the objective changes is the line with `policy_loss`; the
rest of `train` is SB3's own, but for clipped values, early stopping and most of the log. With the defaults, three
agents earned −147 with lpo-pendulum (−158 to −130) and −195 with ppo (−206 to −175).
"""

from typing import Any

import gymnasium
import torch
import tyro
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from torch.nn import functional

import lpo


class LPO(PPO):
    """PPO whose policy loss is an objective's: whatever `lpo.load_objective` takes."""

    def __init__(self, *arguments: Any, objective: str = "lpo-pendulum", **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.policy_loss = lpo.torch_loss(objective)

    def train(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        # Before this batch was collected, as where objectives are learned; SB3's own counts it in.
        collected = self.num_timesteps - self.n_steps * self.n_envs
        progress = collected / self._total_timesteps
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                discrete = isinstance(self.action_space, spaces.Discrete)
                actions = batch.actions.long().flatten() if discrete else batch.actions
                values, log_prob, entropy = self.policy.evaluate_actions(
                    batch.observations, actions
                )
                advantages = batch.advantages - batch.advantages.mean()
                advantages = advantages / (advantages.std() + 1e-8)
                policy_loss = self.policy_loss(log_prob - batch.old_log_prob, advantages, progress)
                entropy_loss = log_prob.mean() if entropy is None else -entropy.mean()
                value_loss = functional.mse_loss(batch.returns, values.flatten())
                loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
                self.policy.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1
        self.logger.record("train/policy_loss", policy_loss.item())


def main(
    objective: str = "lpo-pendulum",
    environment: str = "Pendulum-v1",
    steps: int = 100_000,
    seed: int = 1,
) -> float:
    """Train PPO with an objective, then evaluate it. Hyperparameters are those of SB3's zoo for Pendulum, but for gSDE.

    Args:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, a name of the zoo (lpo-pendulum) or path/to/objective.npz.
      environment: of Gymnasium.
      steps: of the training.
      seed: of the agent.
    """
    torch.set_num_threads(1)
    envs = make_vec_env(environment, n_envs=4, seed=seed)
    agent = LPO(
        "MlpPolicy",
        envs,
        objective=objective,
        n_steps=1024,
        gamma=0.9,
        learning_rate=1e-3,
        seed=seed,
        device="cpu",
    ).learn(steps)
    mean, deviation = evaluate_policy(agent, gymnasium.make(environment), 20, warn=False)
    print(f"{objective} after {steps} steps: {mean:.0f} ± {deviation:.0f}")
    return mean


if __name__ == "__main__":
    tyro.cli(main)
