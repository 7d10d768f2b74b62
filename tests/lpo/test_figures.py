"""What the figures claim must be what the numbers say."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.collections import FillBetweenPolyCollection, QuadMesh

from lpo import drift_figures, figures, search_figures
from lpo.comparison import LearningCurves
from lpo.drifts import Drift
from lpo.inner_loop import MetaTrainingConfig
from lpo.objectives import Objective, load_objective, zoo_names
from lpo.update_regions import surface
from scb import plotting
from scb.agents.ppo import DIAGNOSIS
from scb.errors import UserError
from scb.statistics import estimate, iqm


def curve(objective="ppo", returns=None, **changes) -> LearningCurves:
    if returns is None:
        returns = np.random.default_rng(0).normal(size=(4, 3))
    returns = np.asarray(returns, float)
    seeds, points = returns.shape
    made = LearningCurves(
        environment="Pendulum-v1",
        backend=None,
        objective=objective,
        steps=np.arange(points) * 1000,
        returns=returns,
        seeds=list(range(seeds)),
        episodes=20,
        mode_actions=True,
    )
    return replace(made, **changes)


def line(axes, label):
    [found] = [line for line in axes.lines if line.get_label() == label]
    return found


def bands(axes):
    return [c for c in axes.collections if isinstance(c, FillBetweenPolyCollection)]


def meshes(figure):
    """[column][row] of the heat maps; colour bars hold meshes too, and come after the panels."""
    found = [
        mesh
        for axes in figure.axes
        for mesh in axes.collections
        if isinstance(mesh, QuadMesh) and axes.get_label() != "<colorbar>"
    ]
    return [found[column::3] for column in range(3)]


@dataclass(frozen=True)
class SpikeDrift(Drift):
    """Nothing but one enormous corner."""

    def init(self, key: jax.Array, scale: float = 1.0) -> Any:
        return jnp.zeros(())

    def __call__(self, parameters, log_ratio, advantage, progress):
        return jnp.where((log_ratio > jnp.log(1.79)) & (advantage > 2.9), 1000.0, 0.0)


def test_the_curve_is_the_interquartile_mean_over_seeds():
    # Of four seeds the lowest and the highest are dropped: (10 + 20) / 2 = 15, (1 + 2) / 2 = 1.5.
    returns = [[0.0, 1.0], [10.0, -9.0], [20.0, 2.0], [1000.0, 99.0]]
    figure = figures.learning_curves([curve(returns=returns)])
    drawn = line(figure.axes[0], "ppo").get_ydata()
    np.testing.assert_allclose(drawn, [15.0, 1.5])
    np.testing.assert_allclose(drawn, iqm(np.array(returns), axis=0))


def test_the_band_is_the_interval_that_the_table_shows():
    made = curve(returns=np.random.default_rng(1).normal(size=(8, 3)))
    training, final = figures.learning_curves([made]).axes
    [band] = bands(training)
    end = estimate(made.final)
    at_the_end = [y for x, y in band.get_paths()[0].vertices if x == made.steps[-1]]
    assert min(at_the_end) == pytest.approx(end.low)
    assert max(at_the_end) == pytest.approx(end.high)
    [bar] = final.collections[0].get_segments()
    np.testing.assert_allclose(bar[:, 1], [end.low, end.high])


def test_every_seed_is_a_dot():
    made = curve(returns=np.arange(12.0).reshape(4, 3))
    _, final = figures.learning_curves([made]).axes
    [dots] = [line for line in final.lines if len(line.get_xdata()) == 4]
    np.testing.assert_array_equal(dots.get_ydata(), made.final)


def test_a_single_seed_gets_no_interval():
    training, final = figures.learning_curves([curve(returns=[[1.0, 2.0, 3.0]])]).axes
    assert not bands(training)
    assert "no interval" in training.get_title(loc="left")
    assert not final.collections


def test_the_figure_says_under_which_protocol_it_was_measured():
    made = curve(environment="hopper", backend="spring", mode_actions=False)
    title = figures.learning_curves([made]).get_suptitle()
    for said in ("hopper", "spring physics", "sampled actions", "20 episodes", "n = 4 seeds"):
        assert said in title
    made = curve(
        hyperparameters={"learning_rate": 0.0005, "num_minibatches": 32, "gae_lambda": 0.8}
    )
    title = figures.learning_curves([made]).get_suptitle()
    assert "learning_rate 0.0005, num_minibatches 32, gae_lambda 0.8" in title.replace("\n", " ")
    assert max(map(len, title.splitlines())) <= 90 and "\n" in title


def test_only_diagnosed_agents_are_drawn_and_an_objective_without_any_is_refused():
    values = np.array([[0.1, 0.2, 0.4], [0.3, 0.4, 0.8], [np.nan] * 3])
    returns = np.zeros((3, 3))
    made = curve(returns=returns, diagnosis=dict.fromkeys(DIAGNOSIS, values))
    *shown, empty = figures.diagnosis([made]).axes
    kl, *_ = shown
    assert not empty.axison
    for axes in shown:
        np.testing.assert_allclose(line(axes, "ppo").get_ydata(), [0.2, 0.3, 0.6])
        assert len(bands(axes)) == 1
    assert kl.get_yscale() == "log" and made.diagnosed == 2
    # Beyond a training whose learning rate has fallen to zero an iteration does nothing.
    falling = replace(made, hyperparameters={"anneal_learning_rate": True})
    for axes in figures.diagnosis([falling]).axes[:-1]:
        np.testing.assert_allclose(line(axes, "ppo").get_ydata(), [0.2, 0.3])
    with pytest.raises(UserError, match="no agent of dpo was diagnosed"):
        figures.diagnosis([made, curve("dpo", returns)])


@pytest.mark.parametrize(
    "change",
    [
        {"environment": "hopper"},
        {"backend": "spring"},
        {"mode_actions": False},
        {"episodes": 5},
        {"hyperparameters": {"learning_rate": 0.1}},
    ],
)
def test_curves_of_different_protocols_are_refused(change):
    with pytest.raises(UserError, match="one figure compares objectives under one protocol"):
        figures.learning_curves([curve(), curve("dpo", **change)])


def test_nothing_to_draw_is_refused():
    with pytest.raises(UserError, match="no learning curves"):
        figures.learning_curves([])
    with pytest.raises(UserError, match="no objectives"):
        drift_figures.drift_and_gradient([])
    with pytest.raises(UserError, match="no generation"):
        search_figures.meta_training_curve([], searched())


def test_an_objective_looks_the_same_whatever_it_is_drawn_with():
    together = figures.looks(["ppo", "dpo", "mine", "none", "ppo-0.3"])
    assert figures.looks(["none", "dpo"]) == {k: together[k] for k in ("none", "dpo")}
    assert figures.looks(["ppo-0.3", "dpo-4-1.2", "mine", "ppo"])["mine"] == together["mine"]
    # The zoo's also wherever they stand, and each apart from what stands beside it.
    zoo = figures.looks(zoo_names())
    for name in zoo_names():
        beside = figures.looks(["mine", name, "ppo-0.3"])
        assert beside[name] == zoo[name] and len({x.color for x in beside.values()}) == 3
    assert len({x.color for x in zoo.values()}) == len(zoo) == 5


def test_objectives_are_told_apart_without_colour():
    names = ["ppo", "dpo", "none", "mine", "other", "ppo-0.1", "ppo-0.3", "yet another"]
    for aspect in ("color", "linestyle", "marker"):
        assert len({getattr(look, aspect) for look in figures.looks(names).values()}) == len(names)


def test_ppo_is_free_inside_the_clip_and_linear_outside():
    # f = (r - 1.2) A above the clip for A > 0, (r - 0.8) A below it for A < 0.
    ratios = np.array([0.5, 0.9, 1.0, 1.1, 1.5])
    drift, gradient = surface(load_objective("ppo"), np.log(ratios), np.array([-2.0, 2.0]), 0.5)
    np.testing.assert_allclose(drift, [[0.6, 0, 0, 0, 0], [0, 0, 0, 0, 0.6]], atol=1e-6)
    # The whole objective's gradient is A where the drift is flat, and stops where it is not.
    np.testing.assert_allclose(gradient / ratios, [[0, -2, -2, -2, -2], [2, 2, 2, 2, 0]], atol=1e-5)


def test_the_heat_map_of_ppo_is_zero_inside_the_clip():
    figure = drift_figures.drift_and_gradient([load_objective("ppo")])
    mesh = meshes(figure)[0][0]
    values = np.asarray(mesh.get_array())
    ratios = mesh.get_coordinates()[0, :, 0]
    inside = (ratios > 0.8) & (ratios < 1.2)
    assert inside.sum() > 50
    assert np.abs(values[:, inside]).max() == 0.0
    assert values[:, ~inside].max() > 1.0


def test_panels_of_a_column_share_one_scale_and_directions_are_centred_on_zero():
    figure = drift_figures.drift_and_gradient([load_objective(n) for n in ("ppo", "dpo", "none")])
    for column in meshes(figure):
        assert len({(mesh.norm.vmin, mesh.norm.vmax) for mesh in column}) == 1
    norm = meshes(figure)[1][0].norm
    assert norm.vmin == -norm.vmax
    said = [[text.get_text() for text in axes.texts] for axes in figure.axes[:9:3]]
    assert said == [["ppo"], ["dpo"], ["none"]]


def test_one_extreme_corner_does_not_make_the_others_look_flat():
    spike = Objective("spike", SpikeDrift(), jnp.zeros(()))
    figure = drift_figures.drift_and_gradient([load_objective("ppo"), spike])
    assert meshes(figure)[0][0].norm.vmax < 10.0


def generations(count: int) -> list[dict[str, Any]]:
    return [
        {
            "generation": g,
            "fitness/mean": float(g),
            "fitness/std": 0.5,
            "fitness/max": g + 1.0,
            "steps/total": (g + 1) * 100,
            **({"mean/fitness": g + 0.25} if g % 2 == 0 else {}),
        }
        for g in range(count)
    ]


def searched(fitness: str = "return", **evolution) -> MetaTrainingConfig:
    """A search on Pendulum, or with transfer on its bandit."""
    task = "Synthetic-Pendulum-v1" if fitness == "transfer" else "Pendulum-v1"
    default = MetaTrainingConfig(tasks=(task,), fitness=fitness)
    return replace(default, evolution=replace(default.evolution, **evolution))


def test_the_final_judgement_of_the_mean_stands_after_the_last_generation():
    metrics = generations(4)
    metrics[-1]["final_mean/fitness"] = 9.0
    config = searched("transfer", population_size=8, mean_evaluations=64)
    figure = search_figures.meta_training_curve(metrics, config)
    judged = line(figure.axes[0], "search distribution's mean (64 agents a point)")
    np.testing.assert_array_equal(judged.get_xdata(), [0, 2, 4])
    np.testing.assert_array_equal(judged.get_ydata(), [0.25, 2.25, 9.0])
    assert "population of 8" in figure.get_suptitle()
    assert figure.axes[0].get_ylabel().endswith("in Pendulum-v1")


def test_the_upper_axis_counts_environment_steps():
    # 400 steps in 4 generations: 100 a generation.
    figure = search_figures.meta_training_curve(generations(4), searched())
    figure.draw_without_rendering()
    [below] = figure.axes
    [above] = below.child_axes
    np.testing.assert_allclose(above.get_xlim(), 100 * np.array(below.get_xlim()))


def test_the_population_is_drawn_as_mean_and_standard_deviation():
    [axes] = search_figures.meta_training_curve(generations(3), searched()).axes
    np.testing.assert_array_equal(line(axes, "population: mean").get_ydata(), [0, 1, 2])
    [band] = bands(axes)
    at_two = [y for x, y in band.get_paths()[0].vertices if x == 2]
    assert (min(at_two), max(at_two)) == (1.5, 2.5)


def test_a_judgement_that_was_not_finite_is_left_out():
    metrics = generations(3)
    metrics[0]["mean/fitness"] = None
    [axes] = search_figures.meta_training_curve(metrics, searched(mean_evaluations=64)).axes
    judged = line(axes, "search distribution's mean (64 agents a point)")
    assert list(judged.get_xdata()) == [2]


def test_bars_end_at_the_steps_and_the_ratio_is_written_beside_them():
    figure = search_figures.environment_steps(
        {"training": 200, "evaluation": 50, "total": 250},
        {"training": 25_000, "evaluation": 50, "total": 25_050},
    )
    [axes] = figure.axes
    ends = [bar.get_x() + bar.get_width() for bar in axes.patches]
    np.testing.assert_allclose(ends, [200, 50, 250, 25_000, 50, 25_050])
    said = [text.get_text() for text in axes.texts]
    assert [text for text in said if "fewer" in text or "same" in text] == [
        "125 times fewer",
        "the same",
        "100 times fewer",
    ]


@pytest.mark.parametrize(
    ("bandit", "environment", "text"),
    [
        (10, 25, "2.5 times fewer"),
        (25, 10, "2.5 times more"),
        (1, 1234, "1\N{NARROW NO-BREAK SPACE}234 times fewer"),
        (3, 3, "the same"),
        (0, 5, ""),
    ],
)
def test_the_ratio_says_which_way_it_goes(bandit, environment, text):
    assert plotting.ratio_text(bandit, environment) == text


def test_no_steps_are_no_bar():
    nothing = {"training": 0, "evaluation": 0, "total": 0}
    figure = search_figures.environment_steps(nothing, {"training": 9, "evaluation": 0, "total": 9})
    assert [bar.get_width() for bar in figure.axes[0].patches[:3]] == [0, 0, 0]


def all_figures():
    steps = {"training": 10, "evaluation": 5, "total": 15}
    return [
        figures.learning_curves([curve(), curve("dpo"), curve("a-rather-long-name")]),
        search_figures.meta_training_curve(generations(4), searched("area")),
        search_figures.environment_steps(steps, steps),
        drift_figures.drift_and_gradient([load_objective("ppo"), load_objective("dpo")]),
    ]


def test_a_legend_covers_no_data():
    for figure in all_figures():
        figure.draw_without_rendering()
        panels = [axes.get_window_extent() for axes in figure.axes]
        legends = figure.legends + [a.get_legend() for a in figure.axes if a.get_legend()]
        assert legends
        for legend in legends:
            assert not any(legend.get_window_extent().overlaps(panel) for panel in panels)


def test_nothing_is_cut_off_at_the_edges():
    for figure in all_figures():
        figure.draw_without_rendering()
        inside, edge = figure.get_tightbbox(), figure.bbox_inches
        assert inside.x0 >= 0 and inside.y0 >= 0
        assert inside.x1 <= edge.x1 and inside.y1 <= edge.y1


def test_figures_leave_the_global_state_alone():
    before = dict(matplotlib.rcParams)
    all_figures()
    assert pyplot.get_fignums() == []
    assert dict(matplotlib.rcParams) == before


def test_a_saved_figure_depends_on_its_data_alone(tmp_path: Path):
    first = plotting.save(figures.learning_curves([curve()]), tmp_path / "made" / "first.png")
    with matplotlib.rc_context({"font.size": 20, "lines.linewidth": 9, "axes.facecolor": "red"}):
        second = plotting.save(figures.learning_curves([curve()]), tmp_path / "second.png")
    assert first.read_bytes() == second.read_bytes()
    for chunk in (b"tEXt", b"iTXt", b"tIME"):
        assert chunk not in first.read_bytes()
    other = plotting.save(figures.learning_curves([curve("dpo")]), tmp_path / "other.png")
    assert other.read_bytes() != first.read_bytes()


def test_a_validated_mean_has_a_scale_of_its_own():
    metrics = [
        {"generation": 0, "fitness/mean": -0.6, "fitness/std": 0.1, "fitness/max": -0.4},
        {"generation": 1, "fitness/mean": -0.5, "fitness/std": 0.1, "fitness/max": -0.3},
    ]
    metrics[0]["mean/fitness"], metrics[1]["final_mean/fitness"] = -900.0, -300.0
    config = MetaTrainingConfig(tasks=("Synthetic-Pendulum-v1",), validation=True)
    drawn = search_figures.meta_training_curve(metrics, config)
    fitness, judged = drawn.axes[:2]
    assert judged.get_ylabel() == "of the mean: return on Pendulum-v1"
    assert fitness.get_ylim()[0] > -10.0
    np.testing.assert_array_equal(judged.lines[0].get_ydata(), [-900.0, -300.0])
