"""Episodes as moving pictures: classic control as a GIF, Brax in its own HTML viewer."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from scb import plotting
from scb.analysis.states import record_episode
from scb.environments.brax import BraxEnvironment
from scb.errors import UserError

Floats = NDArray[np.floating]
FRAMES_PER_SECOND = 25
INCHES, DPI = 2.4, 70  # of a picture: a GIF of some hundred kilobytes


def _pendulum(axes: Axes, observation: Floats) -> None:
    # The angle is from upright, and grows counter-clockwise.
    cos, sin = observation[:2]
    axes.plot([0, -sin], [0, cos], color=plotting.VERMILLION, linewidth=8, solid_capstyle="round")
    axes.plot(0, 0, "o", color=plotting.BLACK, markersize=5)
    _view(axes, (-1.3, 1.3), (-1.3, 1.3))


def _acrobot(axes: Axes, observation: Floats) -> None:
    first = np.arctan2(observation[1], observation[0])
    second = first + np.arctan2(observation[3], observation[2])
    # Both angles are from hanging down.
    elbow = np.array([np.sin(first), -np.cos(first)])
    tip = elbow + np.array([np.sin(second), -np.cos(second)])
    axes.axhline(1.0, color=plotting.GREY, linestyle=":", linewidth=1)
    for start, end, color in (
        (np.zeros(2), elbow, plotting.BLUE),
        (elbow, tip, plotting.VERMILLION),
    ):
        axes.plot(*np.stack([start, end]).T, color=color, linewidth=5, solid_capstyle="round")
    _view(axes, (-2.2, 2.2), (-2.2, 2.2))


def _cart_pole(axes: Axes, observation: Floats) -> None:
    position, angle = observation[0], observation[2]
    axes.axhline(0.0, color=plotting.GREY, linewidth=1)
    axes.add_patch(Rectangle((position - 0.3, -0.15), 0.6, 0.3, color=plotting.BLACK))
    end = (position + np.sin(angle), 0.15 + np.cos(angle))
    axes.plot(
        [position, end[0]],
        [0.15, end[1]],
        color=plotting.VERMILLION,
        linewidth=5,
        solid_capstyle="round",
    )
    _view(axes, (-2.4, 2.4), (-1.6, 3.2))


def _mountain_car(goal: float, axes: Axes, observation: Floats) -> None:
    def height(x: Any) -> Any:
        return np.sin(3 * x) * 0.45 + 0.55

    x = np.linspace(-1.2, 0.6, 100)
    axes.plot(x, height(x), color=plotting.GREY, linewidth=1.5)
    axes.plot([goal, goal], [height(goal), height(goal) + 0.4], color=plotting.GREEN, linewidth=2)
    axes.plot(
        observation[0], height(observation[0]) + 0.04, "o", color=plotting.VERMILLION, markersize=9
    )
    _view(axes, (-1.4, 0.8), (-0.2, 2.0))


def _view(axes: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.set_aspect("equal")
    axes.axis("off")


PICTURES: dict[str, Callable[[Axes, Floats], None]] = {
    "Acrobot-v1": _acrobot,
    "CartPole-v1": _cart_pole,
    "MountainCar-v0": partial(_mountain_car, 0.5),
    "MountainCarContinuous-v0": partial(_mountain_car, 0.45),
    "Pendulum-v1": _pendulum,
}


def picture(axes: Axes, environment: str, observation: Floats) -> None:
    """[O] one observation of a classic-control environment, drawn.

    Raises:
      UserError: an environment that there is no picture of.
    """
    if environment not in PICTURES:
        raise UserError(
            f"there is no picture of {environment}: choose one of {', '.join(PICTURES)}, or a Brax environment."
        )
    PICTURES[environment](axes, observation)


def save_gif(path: str | Path, environment: str, observations: Floats, every: int = 1) -> Path:
    """An episode as an animated GIF.

    Args:
      path: of the file.
      environment: of classic control, by name.
      observations: [T, O] of one episode, a picture each.
      every: steps of the episode between them.
    """
    path = Path(path)
    with plotting.figure_style():
        figure = Figure(figsize=(INCHES, INCHES), dpi=DPI)
        axes = figure.subplots()
        picture(axes, environment, observations[0])

        def draw(frame: int) -> list[Any]:
            axes.clear()
            picture(axes, environment, observations[frame])
            axes.set_title(f"step {frame * every}", fontsize=8, loc="left", fontweight="normal")
            return []

        animation = FuncAnimation(figure, draw, frames=len(observations), init_func=lambda: [])
        path.parent.mkdir(parents=True, exist_ok=True)
        animation.save(path, writer=PillowWriter(fps=FRAMES_PER_SECOND), dpi=DPI)
    return path


def save_brax_html(
    path: str | Path,
    env: BraxEnvironment,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    key: jax.Array,
    num_steps: int,
) -> tuple[Path, float]:
    """An episode in Brax's viewer: a page that a browser shows, which loads the viewer's script from the web.

    Returns:
      (the file, the return of what it shows).
    """
    from brax.io import html

    record, standing = jax.jit(
        lambda key: record_episode(env, env.default_params, policy, key, num_steps)
    )(key)
    length = int(np.sum(record.active))
    shown = standing.brax_state.pipeline_state
    states = [jax.tree.map(lambda x, i=i: x[i], shown) for i in range(length)]
    system = env.brax_env.sys.tree_replace({"opt.timestep": env.brax_env.dt})
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html.render(system, states, colab=False))
    return path, float(np.sum(np.asarray(record.rewards)[:length]))
