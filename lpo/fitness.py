"""Fitnesses: what is made of a trained agent's returns, and so of the objective that trained it.

Meta-training maximises one of them, and `lpo.alignment` asks of each whether it ranks objectives as their
environment does. All of them are here: a new one is one more entry of `FITNESSES`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax


@dataclass(frozen=True)
class Fitness:
    """How an agent is judged; rewards come without the noise that it was trained with.

    Attributes:
      name: as `lpo meta-train --fitness` takes it.
      label: as tables and stored alignments have it.
      mode: by its most likely actions rather than by sampled ones.
      at_home: in the environment that its bandit stands for, rather than where it was trained.
      along: at points along its training, the first of them before it, rather than at its end alone.
      of: [points] mean returns -> the fitness.
    """

    name: str
    label: str
    mode: bool = True
    at_home: bool = False
    along: bool = False
    of: Callable[[jax.Array], jax.Array] = lambda returns: returns[-1]

    @property
    def judge(self) -> tuple[bool, bool]:
        """(at home, mode): fitnesses that agree in these are made of the same episodes."""
        return self.at_home, self.mode


FITNESSES = {
    fitness.name: fitness
    for fitness in (
        Fitness("return-sampled", "return, sampled actions", mode=False),
        Fitness("return", "return, mode actions"),
        # The first point tells nothing of the objective.
        Fitness("area", "area under the curve", along=True, of=lambda returns: returns[1:].mean()),
        Fitness("transfer", "transfer", at_home=True),
    )
}
LABELS = tuple(fitness.label for fitness in FITNESSES.values())
