import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

import scb
from scb.analysis import figures
from scb.analysis.explain import explain
from scb.analysis.importance import reward_variance
from scb.analysis.optimal_actions import optimal_actions, optimal_policy
from scb.analysis.planes import observation_names, plane_for
from scb.analysis.states import Trajectories, bandit_states, follow, thinned
from scb.cli import main
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import load_bandit
from scb.errors import UserError
from scb.evaluation import evaluate
from scb.measurement import Place


def tent(observation_size: int = 3, size: int = 1) -> SyntheticBandit:
    """Its reward is -sum |a_i - x_0|, so the best action is x_0 within the bounds [-1, 1]."""
    space = spaces.Box(-1.0, 1.0, (size,))
    hidden = 2 * size
    kernel = np.zeros((observation_size + size, hidden), np.float32)
    for i in range(size):
        kernel[0, 2 * i : 2 * i + 2] = (-1.0, 1.0)
        kernel[observation_size + i, 2 * i : 2 * i + 2] = (1.0, -1.0)
    bandit = SyntheticBandit(observation_size, space, BanditConfig(hidden, "relu"))
    weights = jax.jit(bandit.init_weights)(jax.random.key(0))
    weights["reward"] = {
        "Dense_0": {"kernel": kernel, "bias": np.zeros(hidden, np.float32)},
        "Dense_1": {"kernel": -np.ones((hidden, 1), np.float32), "bias": np.zeros(1, np.float32)},
    }
    return SyntheticBandit(observation_size, space, bandit.config, weights, "tent")


@pytest.mark.parametrize("method", ["gradient", "grid"])
@pytest.mark.parametrize("size", [1, 2])
def test_optimal_action_of_a_known_reward(method, size):
    contexts = jnp.array([[-0.62, 5.0, 1.0], [0.0, 1.0, 1.0], [0.37, 0.0, 0.0], [3.0, 0.0, 0.0]])
    best = jax.jit(jax.vmap(optimal_actions(tent(size=size), method=method)))(contexts)
    expected = np.repeat([[-0.62], [0.0], [0.37], [1.0]], size, axis=1)
    # Half a cell of the grid is 0.01.
    np.testing.assert_allclose(best, expected, atol=0.011)


def test_gradient_is_no_worse_than_the_grid_in_a_discovered_bandit():
    bandit = load_bandit("Synthetic-Pendulum-v1")
    contexts = jnp.asarray(bandit_states(bandit, jax.random.key(1), 200))
    rewards = {}
    for method in ("gradient", "grid"):
        best = jax.jit(jax.vmap(optimal_actions(bandit, method=method)))(contexts)
        reward = jax.jit(jax.vmap(bandit.mean_reward, (0, 0, None)))
        rewards[method] = reward(contexts, best, bandit.default_params)
    spread = float(np.std(rewards["grid"]))
    assert float(np.min(rewards["gradient"] - rewards["grid"])) > -0.02 * spread


def test_a_linear_bandits_optimum_is_read_off_its_weights():
    bandit = load_bandit("Synthetic-MountainCarContinuous-v0")
    contexts = jnp.asarray(bandit_states(bandit, jax.random.key(1), 50))
    read, tried = (
        jax.jit(jax.vmap(optimal_actions(bandit, method=method)))(contexts)
        for method in ("gradient", "grid")
    )
    assert read.shape == (50, 1)
    np.testing.assert_allclose(read, tried, atol=0.011)
    assert float(jnp.ptp(read)) > 1  # they are no constant


def test_discrete_optimum_is_the_argmax_over_all_actions():
    bandit = load_bandit("Synthetic-Acrobot-v1")
    contexts = jnp.asarray(bandit_states(bandit, jax.random.key(1), 50))

    @jax.jit
    def reward(action):
        mean_reward = jax.vmap(bandit.mean_reward, (0, None, None))
        return mean_reward(contexts, action, bandit.default_params)

    every = [reward(action) for action in range(3)]
    best = jax.jit(jax.vmap(optimal_actions(bandit)))(contexts)
    np.testing.assert_array_equal(best, np.argmax(every, axis=0))


def test_a_grid_too_large_and_an_unknown_method_are_refused():
    with pytest.raises(UserError, match="3 action dimensions"):
        optimal_actions(tent(size=3), method="grid")
    with pytest.raises(UserError, match="did you mean grid"):
        optimal_actions(tent(), method="grids")


def test_optimal_policy_of_a_shipped_bandit_balances_the_pole():
    env, env_params = scb.make("CartPole-v1")
    policy = optimal_policy(load_bandit("Synthetic-CartPole-v1"))
    returns = jax.jit(lambda k: evaluate(env, env_params, policy, k, 8).returns)(jax.random.key(3))
    assert float(jnp.median(returns)) == 500.0


def test_reward_variance_is_zero_for_entries_that_the_reward_ignores():
    observations = jax.random.normal(jax.random.key(0), (400, 3))
    importance = reward_variance(tent(), observations, jax.random.key(1))
    np.testing.assert_array_equal(importance[1:], 0.0)
    # -|a - x| of independent uniform a in [-1, 1] and normal x: the share by simulation.
    rng = np.random.default_rng(0)
    a, x = rng.uniform(-1, 1, (20_000, 1)), rng.normal(size=(20_000, 64))
    r = -np.abs(a - x)
    assert float(importance[0]) == pytest.approx(r.var(axis=1).mean() / r.var(), abs=0.1)


def test_reward_variance_draws_entries_apart_from_each_other():
    # -|a - x_0 - x_1 - x_2|, where x_1 + x_2 = 0 in every observation, and not where they are drawn apart.
    bandit = tent()
    weights = jax.tree.map(np.array, bandit.default_params.weights)
    kernel = weights["reward"]["Dense_0"]["kernel"]
    kernel[1] = kernel[2] = kernel[0]
    mixed = SyntheticBandit(3, bandit.action_space(), bandit.config, weights, "mixed")
    x, y = jax.random.normal(jax.random.key(2), (2, 4000))
    shares = reward_variance(mixed, jnp.stack([x, y, -y], axis=1), jax.random.key(1))
    rng = np.random.default_rng(0)
    a, others = rng.uniform(-1, 1, (20_000, 1)), rng.normal(scale=np.sqrt(2), size=(20_000, 1))
    r = -np.abs(a - others - rng.normal(size=(20_000, 64)))
    np.testing.assert_allclose(shares, r.var(axis=1).mean() / r.var(), atol=0.06)


def test_what_comes_after_an_episodes_end_is_no_part_of_its_return():
    rewards, active = np.array([[1.0, 2.0, np.nan]]), np.array([[True, True, False]])
    followed = Trajectories(np.zeros((1, 3, 1)), rewards, active)
    np.testing.assert_array_equal(followed.returns(), [3.0])


def test_follow_earns_what_evaluate_earns():
    env, env_params = scb.make("CartPole-v1")

    def policy(observation, key):
        return (observation[2] > 0).astype(jnp.int32)

    followed = follow(env, env_params, policy, jax.random.key(0), 64)
    evaluated = jax.jit(lambda key: evaluate(env, env_params, policy, key, 64))(jax.random.key(1))
    lengths = followed.active.sum(axis=1)
    assert followed.active[:, 0].all() and not followed.active[:, -1].any()
    np.testing.assert_array_equal(followed.returns(), lengths)
    # Other start states, the same distribution: the policy falls after some forty steps.
    assert np.mean(lengths) == pytest.approx(float(evaluated.lengths.mean()), rel=0.15)
    assert followed.states().shape == (lengths.sum(), 4)
    # A pole's first observation is within 0.05 of zero, as the environment says.
    assert np.abs(followed.observations[:, 0]).max() <= 0.05


def test_pendulum_is_drawn_over_its_angle():
    angles = np.linspace(-3, 3, 50)
    states = np.stack([np.cos(angles), np.sin(angles), 2 * angles], axis=1)
    plane = plane_for("Pendulum-v1", states)
    np.testing.assert_allclose(plane.project(states)[:, 0], angles)
    np.testing.assert_allclose(plane.embed(plane.project(states)), states, atol=1e-12)


def test_a_plane_holds_the_less_important_entries_at_their_median():
    states = np.random.default_rng(0).normal([1.0, 2.0, 3.0, 4.0], size=(500, 4))
    plane = plane_for("CartPole-v1", states, importance=[0.1, 0.5, 0.2, 0.9])
    assert plane.labels == ("velocity (m/s)", "angular velocity (rad/s)")
    x, y, nodes = plane.grid(5)
    assert nodes.shape == (25, 4)
    np.testing.assert_allclose(nodes[:, 0], np.median(states[:, 0]), rtol=1e-6)
    np.testing.assert_allclose(nodes[1, [1, 3]], [x[1], y[0]], rtol=1e-6)
    with pytest.raises(UserError, match="two or more"):
        plane_for("mine", states[:, :1])


def test_unknown_environments_have_numbered_observations():
    assert observation_names("mine", 2) == ("observation 0", "observation 1")
    assert observation_names("CartPole-v1", 3)[0] == "observation 0"


@pytest.mark.parametrize("number", [2, 4, 6, 18])
def test_every_discrete_action_has_a_colour_of_its_own(number):
    assert len(set(figures.action_colors(number))) == number


def test_a_jump_of_the_angle_is_not_drawn_as_a_line():
    from matplotlib.figure import Figure

    angles = np.array([3.0, 3.1, -3.1, -3.0])
    states = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    plane = plane_for("Pendulum-v1", states + np.array([0, 0, 1.0]))
    axes = Figure().subplots()
    figures.draw_trajectory(axes, plane, states)
    x = axes.lines[0].get_xdata()
    assert len(x) == 5 and np.isnan(x[2])


@pytest.mark.parametrize("number", [799, 400, 401, 5])
def test_thinned_states_are_of_all_episodes(number):
    shown = thinned(np.arange(number)[:, None], 400)
    assert len(shown) <= 400 and shown[-1, 0] >= number - 2


def test_explain_writes_what_it_found(tmp_path, capsys):
    arguments = ["explain", "Synthetic-MountainCar-v0", "--episodes", "8"]
    assert main([*arguments, "--out", str(tmp_path / "a")]) == 0
    numbers = json.loads((tmp_path / "a" / "explain.json").read_text())
    # Random actions never reach the goal and earn -200.
    assert numbers["return_of_optimal_policy"]["value"] > -150
    assert set(numbers["importance"]) == {"position", "velocity"}
    # A car is pushed the way it rolls.
    assert numbers["importance"]["velocity"] > numbers["importance"]["position"]
    assert (tmp_path / "a" / "explain.png").stat().st_size > 10_000
    assert "of the reward's variance, alone or with others: velocity" in capsys.readouterr().out


def test_explain_takes_observations_that_are_numbers_of_states():
    place = Place.named("FrozenLake-misc")
    assert isinstance(place.env.observation_space(place.params), spaces.Discrete)
    shapes = SyntheticBandit(1, spaces.Discrete(4), BanditConfig(hidden_size=4), name="Test")
    weights = shapes.init_weights(jax.random.key(0))
    bandit = SyntheticBandit(1, spaces.Discrete(4), shapes.config, weights, "Test")
    numbers, parts = explain(bandit, place, episodes=2, seed=0)
    assert parts["plane"] is None and len(numbers["importance"]) == 1


def parts_of(size, plane):
    """What `explain` finds of a bandit with so many observations, the last the most important."""
    states = np.random.default_rng(0).normal(size=(50, size))
    return {
        "name": "Synthetic-Point",
        "summary": "its optimal policy earns 1",
        "plane": plane,
        "best": lambda observations: np.clip(observations[:, 0], -0.5, 0.5),
        "num_actions": None,
        "bounds": (-0.5, 0.5),
        "episode": states[:5],
        "contexts": states,
        "visited": 2 * states,
        "names": [f"observation {i}" for i in range(size)],
        "importance": (np.arange(size) / size).tolist(),
        "action": "force",
    }


def test_of_a_single_observation_the_best_action_is_a_line_over_it():
    actions, states, bars = figures.explained(parts_of(1, None)).axes
    (line,) = actions.lines
    np.testing.assert_allclose(line.get_ydata(), np.clip(line.get_xdata(), -0.5, 0.5))
    assert (actions.get_xlabel(), actions.get_ylabel()) == ("observation 0", "force")
    # The whole range of actions, and of both clouds.
    assert actions.get_ylim() == pytest.approx((-0.55, 0.55))
    contexts, visited = (patch.get_data().values for patch in states.patches)
    assert contexts.max() > visited.max()  # the wider spread is the lower
    assert len(bars.patches) == 1


def test_few_states_far_away_and_what_is_no_number_are_drawn():
    parts = parts_of(1, None)
    visited = np.array([[100.0], [101.0], [np.nan], [np.inf]])
    actions, states, _ = figures.explained({**parts, "visited": visited}).axes
    assert actions.get_xlim()[1] > 100
    contexts, few = (patch.get_data().values for patch in states.patches)
    # A share of each: what lies beyond its outer half per cents is not drawn.
    assert contexts.sum() > 0.9 and few.sum() == 0.5


def test_of_many_observations_the_most_important_are_drawn():
    states = parts_of(40, None)["contexts"]
    plane = plane_for("hopper", states, [0.0] * 38 + [1.0, 0.5], None)
    *_, bars, _ = figures.explained(parts_of(40, plane)).axes
    names = [text.get_text() for text in bars.get_yticklabels()]
    assert names == [f"observation {i}" for i in range(39, 27, -1)]
    assert bars.get_title("left") == "the reward depends on (12 of 40)"


PENDULUM = "Synthetic-Pendulum-v1"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["Synthetic-Pendulum"], "did you mean"),
        ([PENDULUM, "--episodes", "0"], "episodes is 0"),
        ([PENDULUM, "--seed", "-1"], "seed is -1"),
        (
            [PENDULUM, "--evaluation-environment", "CartPole-v1"],
            "take the bandit of that environment",
        ),
    ],
)
def test_explain_refuses_what_makes_no_sense(arguments, said, capsys, tmp_path):
    assert main(["explain", "--out", str(tmp_path / "a"), *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
