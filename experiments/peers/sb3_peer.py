"""Trains one agent of Stable-Baselines3; run by `experiments.sb3` under a python that has it and this library.

    python sb3_peer.py '{"algorithm": "ppo", "train_in": "scb/Synthetic-Pendulum-v1", "judge_in": "Pendulum-v1",
                         "steps": [10000, 20000], "episodes": 20, "seed": 0}'

    python sb3_peer.py versions

`train_in` may also be the file of a bandit, path.npz.

All hyperparameters are the defaults. Prints as JSON the mean return of the most likely actions after each number
of steps, and the seconds that training took until there.
"""

# mypy: ignore-errors
import json
import sys
import time

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback

import scb  # noqa: F401, which registers the bandits


class Judge(BaseCallback):
    def __init__(self, job):
        super().__init__()
        self.job, self.left = job, sorted(job["steps"])
        self.env = gymnasium.make(job["judge_in"])
        self.returns, self.seconds = [], []
        self.start, self.judging = time.perf_counter(), 0.0

    def _on_step(self):
        if self.left and self.num_timesteps >= self.left[0]:
            self.left.pop(0)
            before = time.perf_counter()
            self.seconds.append(round(before - self.start - self.judging, 2))
            self.returns.append(round(self.earned(), 2))
            self.judging += time.perf_counter() - before
        return True

    def earned(self):
        returns = []
        for episode in range(self.job["episodes"]):
            # Start states that are no other seed's, and the same for all algorithms and places.
            observation, _ = self.env.reset(seed=self.job["seed"] * 1000 + episode)
            total, over = 0.0, False
            while not over:
                action, _ = self.model.predict(observation, deterministic=True)
                observation, reward, terminated, truncated, _ = self.env.step(action)
                total, over = total + float(reward), terminated or truncated
            returns.append(total)
        return float(np.mean(returns))


def main():
    if sys.argv[1] == "versions":
        versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
        print(json.dumps(versions))
        return
    job = json.loads(sys.argv[1])
    torch.set_num_threads(1)
    algorithm = getattr(stable_baselines3, job["algorithm"].upper())
    train_in = job["train_in"]
    of_file = train_in.endswith(".npz")
    env = gymnasium.make("scb/Synthetic", file=train_in) if of_file else gymnasium.make(train_in)
    model = algorithm("MlpPolicy", env, seed=job["seed"], device="cpu")
    judge = Judge(job)
    model.learn(max(job["steps"]), callback=judge)
    print(json.dumps({"returns": judge.returns, "seconds": judge.seconds}))


if __name__ == "__main__":
    main()
