"""Stable-Baselines3 trains in a synthetic bandit and acts in Gymnasium's environment.

python examples/sb3_in_a_bandit.py --algorithm sac --steps 10000

It needs stable-baselines3 beside this library. Hyperparameters are the defaults of SB3. The agent of this command
earned −180 on Pendulum; docs/sb3.md has ten of every algorithm.
"""

from typing import Literal

import gymnasium
import stable_baselines3
import tyro
from stable_baselines3.common.evaluation import evaluate_policy

import scb  # noqa: F401, which registers the bandits with Gymnasium

# Those of Brax are not Gymnasium's environments of similar names.
CLASSIC = Literal[
    "Pendulum-v1", "CartPole-v1", "Acrobot-v1", "MountainCar-v0", "MountainCarContinuous-v0"
]


def main(
    algorithm: Literal["ppo", "sac", "td3", "ddpg", "dqn"] = "sac",
    environment: CLASSIC = "Pendulum-v1",
    steps: int = 10_000,
    seed: int = 1,
) -> float:
    """Train an agent in a bandit, then evaluate it.

    Args:
      algorithm: of SB3; dqn takes discrete actions, and sac, td3 and ddpg continuous ones.
      environment: of Gymnasium, for which the zoo has a bandit.
      steps: of the bandit.
      seed: of the agent.
    """
    bandit, judge = gymnasium.make(f"scb/Synthetic-{environment}"), gymnasium.make(environment)
    learner = getattr(stable_baselines3, algorithm.upper())
    agent = learner("MlpPolicy", bandit, seed=seed, device="cpu").learn(steps)
    mean, deviation = evaluate_policy(agent, judge, 20, warn=False)
    print(f"{algorithm} after {steps} steps of the bandit: {mean:.0f} ± {deviation:.0f}")
    return mean


if __name__ == "__main__":
    tyro.cli(main)
