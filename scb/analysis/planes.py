"""Two dimensions in which a state space is drawn.

Pendulum's observations lie on a cylinder, so its plane is (angle, angular velocity); elsewhere two
entries of the observation span it and the others are held at what is usual.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scb.errors import UserError

Floats = NDArray[np.floating]

OBSERVATION_NAMES: dict[str, tuple[str, ...]] = {
    "Acrobot-v1": (
        "cos of angle 1",
        "sin of angle 1",
        "cos of angle 2",
        "sin of angle 2",
        "angular velocity 1 (rad/s)",
        "angular velocity 2 (rad/s)",
    ),
    "CartPole-v1": ("position (m)", "velocity (m/s)", "angle (rad)", "angular velocity (rad/s)"),
    "MountainCar-v0": ("position", "velocity"),
    "MountainCarContinuous-v0": ("position", "velocity"),
    "Pendulum-v1": ("cos of angle", "sin of angle", "angular velocity (rad/s)"),
}


def observation_names(environment: str, size: int) -> tuple[str, ...]:
    """What the entries of an observation are called; numbered where the environment is not known."""
    names = OBSERVATION_NAMES.get(environment, ())
    return names if len(names) == size else tuple(f"observation {i}" for i in range(size))


@dataclass(frozen=True)
class Plane:
    """A two-dimensional view of observations.

    Attributes:
      labels: of the two axes.
      limits: ((low, high), (low, high)).
      project: [N, O] observations -> [N, 2].
      embed: [N, 2] -> [N, O] observations.
    """

    labels: tuple[str, str]
    limits: tuple[tuple[float, float], tuple[float, float]]
    project: Callable[[Floats], Floats]
    embed: Callable[[Floats], Floats]

    def grid(self, points: int) -> tuple[Floats, Floats, Floats]:
        """([points], [points], [points * points, O]): the axes, and the observation of each node, x fastest."""
        x, y = (np.linspace(low, high, points) for low, high in self.limits)
        nodes = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)
        return x, y, self.embed(nodes).astype(np.float32)


def plane_for(
    environment: str,
    observations: Floats,
    importance: Sequence[float] | None = None,
    bounds: tuple[Floats, Floats] | None = None,
) -> Plane:
    """The view of an environment's observations.

    Args:
      environment: its name.
      observations: [N, O]; their range (without the outer half per cent at either end) is shown, and
        entries off the plane are held at their median.
      importance: [O]; the two largest choose the entries of the plane. The first two where None.
      bounds: ([O], [O]) of the observation space; nothing outside is shown.

    Raises:
      UserError: observations of fewer than two entries.
    """
    size = observations.shape[1]
    names = observation_names(environment, size)
    if size < 2:
        raise UserError(
            f"{environment} has observations of {size} entry: a plane needs two or more."
        )
    low, high = np.percentile(observations, [0.5, 99.5], axis=0)
    if bounds is not None:
        low, high = np.maximum(low, bounds[0]), np.minimum(high, bounds[1])
    if environment == "Pendulum-v1" and size == 3:
        speed = float(np.abs([low[2], high[2]]).max())

        def angle(states: Floats) -> Floats:
            return np.stack([np.arctan2(states[:, 1], states[:, 0]), states[:, 2]], axis=1)

        def cylinder(nodes: Floats) -> Floats:
            return np.stack([np.cos(nodes[:, 0]), np.sin(nodes[:, 0]), nodes[:, 1]], axis=1)

        labels = ("angle from upright (rad)", names[2])
        return Plane(labels, ((-np.pi, np.pi), (-speed, speed)), angle, cylinder)
    order = range(size) if importance is None else np.argsort(importance)[::-1]
    first, second = sorted(list(order)[:2])
    usual = np.median(observations, axis=0)

    def entries(states: Floats) -> Floats:
        return states[:, [first, second]]

    def held(nodes: Floats) -> Floats:
        states = np.tile(usual, (len(nodes), 1))
        states[:, [first, second]] = nodes
        return states

    limits = (
        (float(low[first]), float(high[first])),
        (float(low[second]), float(high[second])),
    )
    return Plane((names[first], names[second]), limits, entries, held)
