"""What commands that train agents with given objectives have in common."""

from dataclasses import dataclass
from typing import ClassVar

from lpo.objectives import Objective, load_apart
from scb.command_line import Measuring
from scb.environments.zoo import digests
from scb.errors import agents_at_least, at_least
from scb.measurement import check_seeds
from scb.runs import read_config


@dataclass(frozen=True)
class Agents:
    """Which agents are trained, and how.

    Attributes:
      environment: Pendulum-v1, CartPole-v1, hopper, Synthetic-Pendulum-v1, ..., or one's own as
        package.module:factory; Pendulum-v1 where nothing says another.
      steps: environment steps, rounded up to whole batches; the environment's own setting where left out.
      seed: the first of the agents' seeds.
      backend: Brax physics: generalized, positional, spring or mjx.
    """

    environment: str | None = None
    steps: int | None = None
    seed: int = 0
    backend: str | None = None

    # The field that says how many agents of each objective there are.
    number_field: ClassVar[str] = "seeds"

    def seed_list(self) -> list[int]:
        """Consecutive seeds; a UserError for none or a negative one."""
        agents_at_least(1, self, self.number_field)
        at_least(0, self, "seed")
        seeds = list(range(self.seed, self.seed + getattr(self, self.number_field)))
        check_seeds(seeds)
        return seeds


@dataclass(frozen=True, kw_only=True)
class OfObjectives(Measuring):
    """A command that trains with objectives in an environment."""

    def inputs(self) -> dict[str, str]:
        environment = self.config.environment
        told = digests([] if environment is None else [environment])
        for objective in self.loaded():
            told |= objective.digests
        return told

    def loaded(self) -> list[Objective]:
        """The objectives, those of a resumed run by the names under which their agents are kept."""
        resumed = self.output.resume
        kept = {} if resumed is None else read_config(resumed).get("inputs", {})
        return load_apart(self.config.objectives, kept)
