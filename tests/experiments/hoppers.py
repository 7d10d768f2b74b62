"""Trainings on Hopper that nobody trained, and a report of them."""

import numpy as np

from experiments import locomotion as module
from lpo.comparison import LearningCurves
from scb.agents.ppo import DIAGNOSIS

STEPS = [0, 50, 100]


def curves(objective, seeds, end=100.0, steps=STEPS):
    returns = np.array([[0.0, 50.0, end + seed % 10] for seed in seeds])
    place = "hopper", "generalized", objective
    further = {
        "lengths": returns * 2,
        "speeds": returns / 100,
        "diagnosis": {name: returns / (10 * i + 10) for i, name in enumerate(DIAGNOSIS)},
    }
    # Of three joints, whose deviations start at 1.
    further["diagnosis"]["entropy"] += 3 * 1.4189
    return LearningCurves(*place, np.array(steps), returns, list(seeds), 20, True, **further)


def report(number):
    agents = {
        name: module.kept(curves(name, range(number), end))
        for name, end in (("ppo", 100.0), ("dpo", 200.0), ("lpo-pendulum", 50.0))
    }
    return {
        "environments": {
            "hopper": {
                "backend": "generalized",
                "steps": STEPS,
                "episodes": 20,
                "agents": agents,
            }
        }
    }
