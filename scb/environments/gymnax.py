"""gymnax's environments (Lange, 2022): classic control, MinAtar (Young & Tian, 2019), and all others."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnax

from scb.environments.spec import Family, Made, Reference
from scb.errors import UserError, first_line

# Liesen et al. (2024), table of SAC experts: interquartile mean and 95 % interval of 200 evaluations.
_SAC_EXPERTS = {
    "CartPole-v1": (500.0, 500.0, 500.0),
    "Acrobot-v1": (-76.7, -78.9, -74.7),
    "MountainCar-v0": (-117.7, -119.2, -115.3),
    "MountainCarContinuous-v0": (94.9, 94.8, 95.0),
    "Pendulum-v1": (-137.4, -151.5, -127.5),
}


class GymnaxFamily(Family):
    """What is registered with gymnax, users' environments included, and belongs to no other family."""

    name = "gymnax"

    def names(self) -> Sequence[str]:
        return gymnax.registered_envs

    def make(self, name: str, **arguments: Any) -> Made:
        try:
            return gymnax.make(name, **arguments)
        except OSError as error:
            raise UserError(
                f"{name} cannot be made ({first_line(error)}): its data are fetched from the network."
            ) from error


class MinAtarFamily(GymnaxFamily):
    """Five small games."""

    name = "minatar"
    suite = tuple(x for x in gymnax.registered_envs if x.endswith("-MinAtar"))

    def names(self) -> Sequence[str]:
        return self.suite


class ClassicFamily(GymnaxFamily):
    """Classic control, with the paper's SAC experts."""

    name = "classic"
    suite = tuple(_SAC_EXPERTS)

    def names(self) -> Sequence[str]:
        return self.suite

    def facts(self, name: str) -> Mapping[str, Any]:
        value, low, high = _SAC_EXPERTS[name]
        expert = Reference(value, "SAC, Liesen et al. (2024)", low, high)
        return {"experts": {None: {"sac": expert}}}
