"""What the regions say of a drift must be what its formula does."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from experiments import understanding
from lpo import drift_figures
from lpo.drifts import Drift, LearnedDrift
from lpo.objectives import Objective, load_objective
from lpo.update_regions import REGIONS, Analysis, analyze, classify, midpoints, surface
from scb.errors import UserError

# Ratios on either side of both ends of PPO's clip, and an advantage of either sign.
RATIOS = np.array([0.6, 0.9, 1.1, 1.5])
GRID = {"log_ratios": np.log(RATIOS), "advantages": np.array([-1.0, 1.0])}


@dataclass(frozen=True)
class Formula(Drift):
    """A drift by formula: (log ratio, advantage, progress) -> penalty."""

    formula: Callable[..., jax.Array]

    def init(self, key: jax.Array, scale: float = 1.0) -> Any:
        return ()

    def __call__(self, parameters, log_ratio, advantage, progress):
        return self.formula(log_ratio, advantage, progress)


def objective(formula: Callable[..., jax.Array]) -> Objective:
    return Objective("toy", Formula(formula), ())


def names(analysis: Analysis) -> list[list[str]]:
    return [[list(REGIONS)[i] for i in row] for row in analysis.regions]


def test_ppo_is_flat_beyond_its_clip_and_free_elsewhere():
    analysis = analyze(load_objective("ppo"), **GRID)
    # A = -1 moves to lower ratios and stops below 0.8; A = +1 to higher ones and stops above 1.2.
    assert names(analysis) == [["flat", "free", "free", "free"], ["free", "free", "free", "flat"]]
    assert analysis.fractions["flat"] == pytest.approx(2 / 8)
    assert analysis.fractions["free"] == pytest.approx(6 / 8)
    assert analysis.beyond["positive"]["flat"] == analysis.beyond["negative"]["flat"] == 1.0
    # f = (0.8 - 0.6) 1 and (1.5 - 1.2) 1; the gradient is r A elsewhere.
    np.testing.assert_allclose(analysis.drift, [[0.2, 0, 0, 0], [0, 0, 0, 0.3]], atol=1e-6)
    np.testing.assert_allclose(
        analysis.gradient, [[0, -0.9, -1.1, -1.5], [0.6, 0.9, 1.1, 0]], atol=1e-6
    )


def test_the_share_that_ppo_stops_is_that_of_its_clip():
    # Uniform in log r over [log 0.5, log 2], either sign half of the time: the half of
    # log(2 / 1.2) / log 4 = 0.3685 and log(0.8 / 0.5) / log 4 = 0.3390. Cells are 1 / 400 wide.
    analysis = analyze(load_objective("ppo"))
    assert analysis.fractions["flat"] == pytest.approx(0.3538, abs=0.003)
    assert sum(analysis.fractions.values()) == pytest.approx(1.0)
    assert analysis.stops[1.0] == pytest.approx(1.2, rel=1e-3)
    assert analysis.stops[-1.0] == pytest.approx(0.8, rel=1e-3)


def test_advantages_count_by_the_normal_density():
    # Densities at 0.5 and 2 are as exp(-0.125) = 0.8825 to exp(-2) = 0.1353.
    analysis = analyze(
        # Charges twice the surrogate where the advantage is 2 alone: h = 1 - 2 = -1.
        objective(lambda x, a, p: jnp.where(a > 1.0, 2.0, 0.0) * a * jnp.expm1(x)),
        log_ratios=np.log([1.5]),
        advantages=np.array([0.5, 2.0]),
    )
    assert analysis.fractions["rolls back"] == pytest.approx(0.1353 / (0.1353 + 0.8825), abs=1e-4)
    assert analysis.beyond["positive"]["rolls back"] == analysis.fractions["rolls back"]


def test_an_update_stops_where_next_to_nothing_of_the_surrogate_is_left():
    # Beyond 1.3 four hundredths.
    slow = objective(lambda x, a, p: 0.96 * a * jax.nn.relu(jnp.exp(x) - 1.3))
    assert analyze(slow).stops == {1.0: pytest.approx(1.3, rel=1e-3), -1.0: None}


def test_without_a_drift_nothing_is_held_back():
    analysis = analyze(load_objective("none"))
    assert analysis.fractions["rolls back"] == analysis.fractions["flat"] == 0.0
    assert analysis.fractions["cautious"] == analysis.fractions["hindered"] == 0.0
    assert analysis.beyond["positive"]["optimistic"] == pytest.approx(1.0)
    assert analysis.stops == {1.0: None, -1.0: None}
    np.testing.assert_allclose(analysis.relative, 1.0, atol=1e-6)


def test_a_wider_clip_is_optimistic_between_the_two():
    analysis = analyze(
        load_objective("ppo-0.4"), log_ratios=np.log([1.3, 1.5]), advantages=np.array([1.0])
    )
    assert names(analysis) == [["optimistic", "flat"]]


def test_dpo_turns_round_for_bad_actions_only():
    # DPO with A = -2 at r = 0.5: h = 1 - tanh²(log 0.5 (-2) / 0.6) / 0.5 = 1 - 0.9615 / 0.5 = -0.923.
    analysis = analyze(load_objective("dpo"), log_ratios=np.log([0.5]), advantages=np.array([-2.0]))
    assert names(analysis) == [["rolls back"]]
    assert analysis.relative[0, 0] == pytest.approx(-0.923, abs=1e-3)
    assert analyze(load_objective("dpo")).beyond["positive"]["rolls back"] == 0.0


@pytest.mark.parametrize(
    ("relative", "inside", "beyond", "returning"),
    [
        # h, and the regions at ratios 1.1 and 1.5 with A = 1, and at 0.6 with A = 1.
        (-0.06, "rolls back", "rolls back", "hindered"),
        (-0.04, "flat", "flat", "hindered"),
        (0.04, "flat", "flat", "hindered"),
        (0.06, "cautious", "optimistic", "hindered"),
        (0.94, "cautious", "optimistic", "hindered"),
        (0.96, "free", "optimistic", "free"),
        (1.04, "free", "optimistic", "free"),
        (1.06, "amplified", "optimistic", "amplified"),
    ],
)
def test_regions_are_what_their_texts_say(relative, inside, beyond, returning):
    found = classify(np.full((1, 3), relative), np.log([1.1, 1.5, 0.6]), np.array([1.0]))
    assert [list(REGIONS)[i] for i in found[0]] == [inside, beyond, returning]
    # A negative advantage sees the mirror image: 1 / 1.1 = 0.91 is inside, 1 / 1.5 = 0.67 is not.
    mirrored = classify(np.full((1, 3), relative), -np.log([1.1, 1.5, 0.6]), np.array([-1.0]))
    np.testing.assert_array_equal(mirrored, found)


def test_a_drift_that_depends_on_progress_is_judged_at_it():
    # Charges 2 A d at the end of training and nothing at its start.
    late = objective(lambda x, a, p: 2.0 * p * a * jnp.expm1(x))
    grid = {"log_ratios": np.log([1.5]), "advantages": np.array([1.0])}
    assert names(analyze(late, 0.0, **grid)) == [["optimistic"]]
    assert names(analyze(late, 0.5, **grid)) == [["flat"]]
    assert names(analyze(late, 1.0, **grid)) == [["rolls back"]]
    assert analyze(late, 0.0, **grid).stops[1.0] is None
    assert analyze(late, 1.0, **grid).stops[1.0] == pytest.approx(1.0, abs=1e-3)


def test_gradients_are_those_of_the_objective():
    # f = 3 d² has df/d(log r) = 6 d r; the objective's gradient is r A - 6 d r.
    x, a = np.log([0.7, 1.4]), np.array([-2.0, 0.5])
    drift, gradient = surface(objective(lambda x, a, p: 3.0 * jnp.expm1(x) ** 2), x, a, 0.5)
    r, d = np.exp(x), np.expm1(x)
    np.testing.assert_allclose(drift, np.tile(3 * d**2, (2, 1)), rtol=1e-5)
    np.testing.assert_allclose(gradient, r * a[:, None] - 6 * d * r, rtol=1e-5)


def test_midpoints_lie_in_the_middle_of_equal_cells():
    assert midpoints(-1.0, 1.0, 4).tolist() == [-0.75, -0.25, 0.25, 0.75]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"progress": 1.5}, "progress is 1.5: it is a fraction of training, from 0 to 1."),
        ({"advantages": np.array([0.0, 1.0])}, "the advantages hold a 0"),
        ({"log_ratios": np.array([0.0, 1.0])}, "the log-ratios hold a 0"),
    ],
)
def test_a_grid_that_cannot_be_judged_is_refused(arguments, message, one_sentence):
    with pytest.raises(UserError) as error:
        analyze(load_objective("ppo"), **arguments)
    assert message in one_sentence(str(error.value))


def test_the_figure_has_a_row_for_every_fraction_of_a_temporal_drift():
    drift = LearnedDrift(hidden_size=2, temporal=True)
    temporal = Objective("late", drift, drift.init(jax.random.key(0)))
    assert temporal.drift.temporal and not load_objective("dpo").drift.temporal
    figure = drift_figures.drift_and_gradient(
        [load_objective("ppo"), temporal], progress=(0.0, 1.0)
    )
    meshes = [
        mesh
        for axes in figure.axes
        for mesh in axes.collections
        if isinstance(mesh, QuadMesh) and axes.get_label() != "<colorbar>"
    ]
    assert len(meshes) == 3 * (1 + 2)
    low, high = meshes[1].norm.vmin, meshes[1].norm.vmax
    assert low == -high < 0.0  # white is no gradient
    regions = analyze(load_objective("ppo")).regions
    np.testing.assert_array_equal(np.asarray(meshes[2].get_array()).reshape(regions.shape), regions)


def test_the_page_has_the_numbers():
    rows = [
        {**analyze(load_objective(name)).as_dict(), "temporal": False} for name in ("ppo", "none")
    ]
    page = understanding.EXPERIMENT.page({"analyses": rows, "formulas": [], "comparisons": []})
    assert "| `ppo` | 0 % | 100 % | 0 % | 1.20 | 0 % | 100 % | 0 % | 0.80 |\n" in page
    assert "| `none` | 100 % | 0 % | 0 % | never | 100 % | 0 % | 0 % | never |\n" in page
    # 0.3538, by the arithmetic above.
    assert "| `ppo` | 0 % | 35 % | 0 % | 65 % | 0 % | 0 % | 0 % |\n" in page


def test_a_figure_of_nothing_is_refused():
    with pytest.raises(UserError, match="there are no objectives to draw"):
        drift_figures.drift_and_gradient([])


def test_an_objective_that_is_no_number_somewhere_has_no_regions_there():
    below = objective(lambda x, advantage, progress: jnp.sqrt(jnp.exp(x) - 0.8))
    with pytest.raises(UserError, match=r"toy is no number on 25% .* a ratio of 0\.6 with an adv"):
        analyze(below, **GRID)
    # A gradient without a number is none either.
    kinked = objective(lambda x, advantage, progress: jnp.sqrt(jnp.maximum(jnp.exp(x) - 0.8, 0.0)))
    with pytest.raises(UserError, match="toy is no number on 25%"):
        analyze(kinked, **GRID)
