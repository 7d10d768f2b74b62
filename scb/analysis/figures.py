"""Figures of what a bandit knows about its environment."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from scb import plotting
from scb.analysis.planes import Plane

POINTS = 80  # of a plane's grid in either direction
BARS = 12  # of what the reward depends on, beyond which the others are left out
# Discrete actions, in order; they stay apart for colour-blind readers and in grey.
DISCRETE = ("#D9F0D3", "#FFFFFF", "#C2A5CF", "#F1A340")


def action_map(
    axes: Axes,
    plane: Plane,
    best: Callable[[NDArray[np.floating]], NDArray[Any]],
    num_actions: int | None,
    bounds: tuple[float, float] | None = None,
) -> Any:
    """The best action over a plane, as the background of an axes.

    Args:
      best: [N, O] observations -> [N] actions; of several dimensions, the one to draw.
      num_actions: of a discrete space; None for continuous actions.
      bounds: of continuous actions.

    Returns:
      What a colour bar is made from.
    """
    _, _, observations = plane.grid(POINTS)
    actions = np.reshape(best(observations), (POINTS, POINTS))
    return action_grid(axes, plane, actions, num_actions, bounds)


def action_colors(number: int) -> list[str]:
    """A colour for each of so many discrete actions."""
    if number == 2:
        return list(DISCRETE[::2])  # white would look as if there were nothing
    if number <= len(DISCRETE):
        return list(DISCRETE[:number])
    return [to_hex(x) for x in colormaps["tab20"](np.linspace(0.0, 1.0, number))]


def action_grid(
    axes: Axes,
    plane: Plane,
    actions: NDArray[Any],
    num_actions: int | None,
    bounds: Sequence[float] | None = None,
) -> Any:
    """`action_map` of [P, P] actions that are known, x fastest."""
    x, y = (np.linspace(low, high, len(actions)) for low, high in plane.limits)
    low, high = (-0.5, num_actions - 0.5) if num_actions else (bounds or (None, None))
    colors: Any = ListedColormap(action_colors(num_actions)) if num_actions else "PuOr"
    axes.grid(False)
    _label_axes(axes, plane)
    return axes.pcolormesh(
        x, y, actions, cmap=colors, vmin=low, vmax=high, shading="nearest", rasterized=True
    )


def _label_axes(axes: Axes, plane: Plane) -> None:
    axes.set(
        xlabel=plane.labels[0], ylabel=plane.labels[1], xlim=plane.limits[0], ylim=plane.limits[1]
    )


def importance_bars(
    axes: Axes,
    names: Sequence[str],
    importance: Sequence[float],
    intervals: Sequence[tuple[float, float]] | None = None,
) -> None:
    """The share of the reward's variance that each observation entry causes, with (low, high) where given."""
    positions = np.arange(len(names))
    axes.barh(positions, importance, color=plotting.BLUE)
    for position, (low, high) in zip(positions, intervals or (), strict=False):
        axes.hlines(position, low, high, color=plotting.BLACK, linewidth=2.5)
    plotting.name_rows(axes, names)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("share of the reward's variance,\nalone or with others", fontsize=9)


def trajectory_line(plane: Plane, states: NDArray[np.floating]) -> NDArray[np.floating]:
    """[T, O] states of one episode -> points of a line in the plane, interrupted by NaN where the angle jumps."""
    points = plane.project(states).astype(float)
    widths = np.ptp(np.asarray(plane.limits), axis=1)
    jumps = np.any(np.abs(np.diff(points, axis=0)) > 0.5 * widths, axis=1)
    return np.insert(points, np.flatnonzero(jumps) + 1, np.nan, axis=0)


def draw_trajectory(axes: Axes, plane: Plane, states: NDArray[np.floating]) -> None:
    """[T, O] states of one episode as a black line, its end a cross, on the edge where it is beyond."""
    line = trajectory_line(plane, states)
    end = np.clip(line[-1], *np.transpose(plane.limits))
    axes.plot(*line.T, color=plotting.BLACK, linewidth=1.2, label="an episode in the environment")
    cross: dict[str, Any] = {"marker": "x", "linestyle": "", "markersize": 8, "label": "its end"}
    axes.plot(*end, color=plotting.BLACK, clip_on=False, **cross)


def explained(parts: Mapping[str, Any]) -> Figure:
    """Optimal actions with an episode, states of bandit and environment, and importance, side by side.

    Of many observations the most important have their bars; of a single one the actions are a line over it.

    Args:
      parts: "name", "plane" (None of a single observation), "best", "num_actions", "bounds", "episode" [T, O],
        "contexts" [N, O], "visited" [N, O], "names", "importance", "action" (its name), "summary", as
        `scb.analysis.explain.explain` gives them.
    """
    with plotting.figure_style():
        figure = Figure(figsize=(12.0, 4.0))
        actions, states, bars = figure.subplots(1, 3)
        draw = _over_a_line if parts["plane"] is None else _over_a_plane
        draw(actions, states, parts)
        actions.set_title("the bandit's best action", fontsize=10)
        states.set_title("states", fontsize=10)
        legend = states.legend(loc="upper right", fontsize=7, frameon=True)
        for handle in legend.legend_handles:
            handle.set_alpha(1.0)
        shares, of_all = list(zip(parts["names"], parts["importance"], strict=True)), ""
        if len(shares) > BARS:
            of_all = f" ({BARS} of {len(shares)})"
            shares = sorted(shares, key=lambda of: -of[1])[:BARS]
        importance_bars(bars, *zip(*shares, strict=True))
        bars.set_title(f"the reward depends on{of_all}", fontsize=10)
        plotting.figure_title(figure, f"{parts['name']}: {parts['summary']}")
    return figure


_CLOUDS = (
    ("contexts", plotting.SKY_BLUE, "contexts of the bandit"),
    ("visited", plotting.VERMILLION, "visited by its optimal policy"),
)


def _over_a_plane(actions: Axes, states: Axes, parts: Mapping[str, Any]) -> None:
    plane: Plane = parts["plane"]
    drawn = action_map(actions, plane, parts["best"], parts["num_actions"], parts["bounds"])
    bar = actions.figure.colorbar(drawn, ax=actions, label=parts["action"])
    if parts["num_actions"]:
        bar.set_ticks(range(parts["num_actions"]))
    draw_trajectory(actions, plane, parts["episode"])
    actions.legend(loc="upper right", fontsize=7, frameon=True)
    for name, color, label in _CLOUDS:
        points = plane.project(parts[name])
        states.plot(*points.T, ".", markersize=2, alpha=0.4, color=color, label=label)
    _label_axes(states, plane)


def _over_a_line(actions: Axes, states: Axes, parts: Mapping[str, Any]) -> None:
    """The same over a single observation, without an episode, of which a line shows no course."""
    (name,) = parts["names"]
    known = {cloud: parts[cloud][np.isfinite(parts[cloud])] for cloud, _, _ in _CLOUDS}
    ends = [np.quantile(values, (0.005, 0.995)) for values in known.values() if values.size]
    low, high = (min(x[0] for x in ends), max(x[1] for x in ends)) if ends else (0.0, 1.0)
    points = np.linspace(low, high, 4 * POINTS)[:, None]
    actions.plot(points, parts["best"](points), color=plotting.BLUE)
    actions.set(xlabel=name, ylabel=parts["action"], xlim=(low, high))
    if parts["num_actions"]:
        actions.set_yticks(range(parts["num_actions"]))
    else:
        least, most = parts["bounds"]
        actions.set_ylim(least - 0.05 * (most - least), most + 0.05 * (most - least))
    for cloud, color, label in _CLOUDS:
        density, edges = np.histogram(known[cloud], 40, (low, high))
        share = density / max(1, known[cloud].size)
        states.stairs(share, edges, fill=True, alpha=0.5, color=color, label=label)
    states.set(xlabel=name, ylabel="share", xlim=(low, high))
