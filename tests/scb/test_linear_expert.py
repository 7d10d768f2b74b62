"""Augmented random search finds what a linear policy can do, and counts what that costs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.agents.normalization import RunningStatistics
from scb.environments.registry import make
from scb.errors import UserError
from scb.linear_expert import (
    LinearSearchConfig,
    _LinearSearch,
    erring,
    noisy,
    search_linear_expert,
)
from scb.measurement import Place
from scb.warm_start import WarmStartConfig, expert_agent, find_expert
from tests.scb.probes import TWO_TARGETS, ContinuousCorridor, assert_solves_two_targets

SEARCH = LinearSearchConfig(
    generations=30, directions=8, best=4, sigma=0.2, learning_rate=0.2, judge_every=20
)


def search(key=0, **settings):
    config = replace(SEARCH, **settings)
    return search_linear_expert(
        ContinuousCorridor(cells=2), TWO_TARGETS, jax.random.key(key), config
    )


@pytest.fixture(scope="module")
def expert():
    return search()


def test_a_linear_policy_solves_a_corridor(expert):
    assert_solves_two_targets(expert)


def test_its_steps_are_counted(expert):
    # 30 generations of 2 * 8 episodes of 2 steps; judged after 20 and after the last by 20 episodes, and once more.
    assert expert.environment_steps == 30 * 2 * 8 * 2 + 3 * 20 * 2


class Breaking(ContinuousCorridor):
    """A corridor whose simulation breaks down where the action is large: in some episodes of a search."""

    def step_env(self, key, state, action, params):
        observation, *rest = super().step_env(key, state, action, params)
        return jnp.where(jnp.abs(action[0]) > 0.3, jnp.nan, observation), *rest


def test_episodes_that_break_down_are_counted_and_not_learned_from(capsys):
    env, config = Breaking(cells=2), replace(SEARCH, generations=4, judge_every=4)
    search_linear_expert(env, TWO_TARGETS, jax.random.key(0), config, quiet=False)
    _, first, *_, last = capsys.readouterr().err.splitlines()
    assert "failed" in first + last and "nan" not in first + last


def test_it_says_how_far_it_is(capsys):
    env, config = ContinuousCorridor(cells=2), replace(SEARCH, generations=3, judge_every=2)
    search_linear_expert(env, TWO_TARGETS, jax.random.key(0), config, quiet=False)
    before, *lines = capsys.readouterr().err.splitlines()
    assert before == "generation 1/3: compiling, the first takes longest"
    assert [line.split(":")[0] for line in lines] == [f"generation {n}/3" for n in (1, 2, 3)]
    assert ["mean" in line for line in lines] == [False, True, True]


def test_the_key_alone_decides_it(expert):
    between = jax.random.normal(jax.random.key(2), (40, 2))
    again, other = search(), search(key=1)
    np.testing.assert_array_equal(jax.vmap(again.policy)(between), jax.vmap(expert.policy)(between))
    assert (jax.vmap(other.policy)(between) != jax.vmap(expert.policy)(between)).any()


def test_a_policy_that_bears_errors_is_found_and_chosen_under_noise(monkeypatch):
    """Beside the cliff the best action without noise is 0.5; whoever errs keeps away from it."""

    monkeypatch.setattr("scb.linear_expert.EPISODES", 1000)

    class Cliff(ContinuousCorridor):
        def step_env(self, key, state, action, params):
            observation, state, _, _, info = super().step_env(key, state, action, params)
            falls = action[0] > 0.5
            return observation, state, jnp.where(falls, -5.0, action[0]), jnp.bool_(True), info

    def best(noise):
        # Judged from the first generation on, and well: what comes closest to the cliff is best without noise.
        size = {"generations": 100, "best": 8, "sigma": 0.1, "learning_rate": 0.1, "judge_every": 1}
        config = replace(SEARCH, **size, action_noise=noise)
        env = Cliff(cells=1)
        found = search_linear_expert(env, env.default_params, jax.random.key(0), config)
        return float(found.policy(jnp.ones(1))[0])

    # With a deviation of 0.3 * 1.5 an action of -0.35 earns most; without noise 0.5, to which the search's own
    # deviations keep a distance.
    assert best(0.3) < -0.2 < 0.3 < best(0.0) <= 0.5


def test_what_policies_are_worth_decides_where_that_is_told():
    seen = []

    def worth(expert, key):
        seen.append(np.asarray(jax.vmap(expert.policy)(jnp.eye(2))))
        return [1.0, 3.0, 2.0][len(seen) - 1], 7

    config = replace(SEARCH, generations=3, judge_every=1)
    env = ContinuousCorridor(cells=2)
    found = search_linear_expert(env, TWO_TARGETS, jax.random.key(0), config, worth=worth)
    np.testing.assert_array_equal(jax.vmap(found.policy)(jnp.eye(2)), seen[1])
    assert (seen[1] != seen[2]).any()
    # Three generations of 16 episodes of 2 steps, what the three judgements took, and 20 episodes for its return.
    assert found.environment_steps == 3 * 16 * 2 + 3 * 7 + 20 * 2


def test_a_search_that_was_killed_goes_on_from_its_last_judgement(tmp_path):
    judged = []

    def worth(expert, key):
        judged.append(np.asarray(jax.vmap(expert.policy)(jnp.eye(2))))
        if len(judged) == 3 and killed:
            raise KeyboardInterrupt
        return [1.0, 3.0, 0.0, 2.0][(len(judged) - 1) % 4], 7

    def find(folder=None):
        config = replace(SEARCH, generations=8, judge_every=2)
        env, key = ContinuousCorridor(cells=2), jax.random.key(0)
        return search_linear_expert(env, TWO_TARGETS, key, config, worth=worth, folder=folder)

    killed = False
    whole, judgements = find(), judged.copy()
    judged.clear()
    killed = True
    with pytest.raises(KeyboardInterrupt):
        find(tmp_path)
    killed = False
    # The third judgement again, and the fourth: what was found until the second is there.
    del judged[2]
    again = find(tmp_path)
    np.testing.assert_array_equal(judged, judgements)
    np.testing.assert_array_equal(again.policy(jnp.ones(2)), whole.policy(jnp.ones(2)))
    assert again.environment_steps == whole.environment_steps
    assert again.earlier_seconds > 0 == whole.earlier_seconds


def test_a_search_tells_that_its_last_judgement_is_damaged(tmp_path, capsys):
    def find():
        config = replace(SEARCH, generations=4, judge_every=2)
        env, key = ContinuousCorridor(cells=2), jax.random.key(0)
        return search_linear_expert(env, TWO_TARGETS, key, config, quiet=False, folder=tmp_path)

    whole = find()
    assert "checkpoint" not in capsys.readouterr().err
    for path in [x for x in (tmp_path / "checkpoints" / "4").rglob("*") if x.is_file()]:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    again = find()
    assert (
        "checkpoint 4 is damaged: resuming from checkpoint 2 before it." in capsys.readouterr().err
    )
    np.testing.assert_array_equal(again.policy(jnp.ones(2)), whole.policy(jnp.ones(2)))


def test_a_search_that_was_killed_does_not_repeat_its_starts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("scb.linear_expert.START_GENERATIONS", 2)

    def worth(expert, key):
        if killed:
            raise KeyboardInterrupt
        return 1.0, 7

    def find(folder=None):
        config = replace(SEARCH, generations=4, judge_every=4, starts=3)
        env, key = ContinuousCorridor(cells=2), jax.random.key(0)
        found = search_linear_expert(
            env, TWO_TARGETS, key, config, quiet=False, worth=worth, folder=folder
        )
        return found, capsys.readouterr().err.count("start ")

    killed = False
    whole, starts = find()
    killed = True
    with pytest.raises(KeyboardInterrupt):
        find(tmp_path)
    assert capsys.readouterr().err.count("start ") == starts == 3
    killed = False
    again, starts = find(tmp_path)
    assert starts == 0
    np.testing.assert_array_equal(again.policy(jnp.ones(2)), whole.policy(jnp.ones(2)))
    assert again.environment_steps == whole.environment_steps


@pytest.mark.slow
def test_of_several_starts_the_best_goes_on(capsys, monkeypatch):
    monkeypatch.setattr("scb.linear_expert.START_GENERATIONS", 2)
    env, size = ContinuousCorridor(cells=2), {"generations": 3, "judge_every": 3}

    def find(key, starts):
        config = replace(SEARCH, **size, starts=starts)
        found = search_linear_expert(env, TWO_TARGETS, jax.random.key(key), config, quiet=False)
        lines = [x for x in capsys.readouterr().err.splitlines() if x.startswith("start ")]
        return found, [float(x.split(": ")[1]) for x in lines]

    firsts = []
    for key in range(4):
        (one, nothing), (several, earned) = find(key, 1), find(key, 3)
        assert nothing == [] and len(set(earned)) == 3
        firsts.append(bool(np.argmax(earned) == 0))
        # The first start is the search that is alone without others.
        same = np.array_equal(one.policy(jnp.ones(2)), several.policy(jnp.ones(2)))
        assert same == firsts[-1]
        # Three starts of two generations, and the third of one of them, of 16 episodes of 2 steps; a judgement of 20
        # episodes, and the expert's.
        assert several.environment_steps == (3 * 2 + 1) * 16 * 2 + (20 + 20) * 2
    assert set(firsts) == {True, False}


def test_the_one_action_that_is_best_held_is_found():
    # Of the ends of [-1, 2], 2 pays 1 - 0.5^2 and 1 - 1^2, and -1 pays 1 - 2.5^2 and 1 - 2^2.
    params = TWO_TARGETS.replace(rewards=jnp.array([[1.0, 1.0, 1.5], [1.0, 1.0, 1.0]]))
    config = replace(SEARCH, generations=5, constant=True)
    found = search_linear_expert(ContinuousCorridor(cells=2), params, jax.random.key(0), config)
    np.testing.assert_array_equal(jax.vmap(found.policy)(jnp.eye(2)), [[2.0], [2.0]])
    assert found.mean_return == pytest.approx(0.75)


def test_a_search_that_decays_comes_to_rest():
    biases = []

    def worth(expert, key):
        biases.append(float(expert.policy.args[0]["bias"][0]))
        return 0.0, 0

    config = replace(SEARCH, generations=3, judge_every=1, decay=1e-6)
    env = ContinuousCorridor(cells=2)
    search_linear_expert(env, TWO_TARGETS, jax.random.key(0), config, worth=worth)
    # The first step is a whole one, the next a millionth of it.
    assert abs(biases[0]) > 1e-3
    assert biases[1:] == pytest.approx([biases[0]] * 2, abs=1e-5)


def test_under_errors_of_its_own_in_each_episode_a_corridor_is_solved():
    assert_solves_two_targets(search(action_errors=0.2))


def test_a_policy_that_reaches_beyond_the_ends_bears_errors_there():
    """Only the end at 2 pays. Errors of 0.8 of half the range are borne where the policy lies that far beyond it."""

    class End(ContinuousCorridor):
        def step_env(self, key, state, action, params):
            observation, state, _, _, info = super().step_env(key, state, action, params)
            return observation, state, jnp.where(action[0] > 1.99, 1.0, 0.0), jnp.bool_(True), info

    env, size = End(cells=1), {"generations": 40, "judge_every": 40, "action_errors": 0.8}

    def borne(reach):
        earned = []

        def worth(expert, key):
            policy = noisy_errors(expert.reaching, env)
            earned.append(np.mean(policy(jax.random.split(key, 200)) > 1.99))
            return earned[-1], 0

        config = replace(SEARCH, **size, reach=reach)
        search_linear_expert(env, env.default_params, jax.random.key(0), config, worth=worth)
        return earned[-1]

    assert borne(1.0) < 0.7 < 0.95 < borne(4.0)


def noisy_errors(policy, env):
    """[N] keys -> [N] what a policy does with the errors of each key, in the corridor's one place."""
    space = env.action_space(env.default_params)

    def one(key):
        off = erring(policy, 1, space, 0.8, key)
        return noisy(off, space, 0.0)(jnp.ones(1), key)[0]

    return jax.vmap(one)


def test_what_reaches_further_is_as_steep_where_it_switches():
    found = search(reach=3.0, generations=5)
    space = ContinuousCorridor(cells=2).action_space()
    places = jax.random.normal(jax.random.key(4), (50, 2))
    far, action = (
        (np.asarray(jax.vmap(policy)(places))[:, 0] - 0.5) / 1.5
        for policy in (found.reaching, found.policy)
    )
    # far = 3 tanh(u) and action = tanh(3 u), in halves of a range from -1 to 2.
    np.testing.assert_allclose(action, np.tanh(3 * np.arctanh(far / 3)), atol=1e-4)
    assert np.abs(far).max() > 1
    assert (np.asarray(found.policy(places[0])) <= space.high).all()


def test_a_search_sees_entries_by_a_power_of_their_deviation():
    env, key = ContinuousCorridor(cells=2), jax.random.key(0)
    seen = replace(RunningStatistics.start(2), count=4.0, squares=jnp.array([0.04, 16.0]))
    policy = {"matrix": jnp.full((2, 1), 0.3), "bias": jnp.zeros(1)}
    observation, outputs = jnp.array([0.1, 2.0]), {}
    for power in (1.0, 0.5, 0.0):
        config = replace(SEARCH, normalization=power)
        found = _LinearSearch(env, TWO_TARGETS, key, config, 0.0, None).expert(policy, seen)
        outputs[power] = np.arctanh((found.policy(observation)[0] - 0.5) / 1.5)
    # Deviations of 0.1 and 2: an entry's own is one, its root, and as it is.
    expected = {1.0: 2.0, 0.5: 0.1**0.5 + 2**0.5, 0.0: 2.1}
    assert outputs == pytest.approx({power: 0.3 * x for power, x in expected.items()}, rel=1e-4)


def test_errors_grow_to_their_scale(monkeypatch):
    scales = []
    monkeypatch.setattr(
        "scb.linear_expert.erring",
        lambda policy, size, space, scale, key: (
            jax.debug.callback(lambda x: scales.append(float(x)), scale) or policy
        ),
    )
    search(generations=4, action_errors=0.6, error_warmup=3, judge_every=4)
    jax.effects_barrier()
    # Two generations under less, two under all of it, and so is the judgement.
    assert sorted(set(scales)) == pytest.approx([0.2, 0.4, 0.6])
    assert scales[-1] == pytest.approx(0.6)


class Ledge(ContinuousCorridor):
    """Every step pays 1; an action a above 0.5 ends the episode, and pays 2 a more."""

    def step_env(self, key, state, action, params):
        observation, state, _, _, info = super().step_env(key, state, action, params)
        leaves = action[0] > 0.5
        return observation, state, 1.0 + jnp.where(leaves, 2.0 * action[0], 0.0), leaves, info


@pytest.mark.parametrize(("bonus", "earned"), [(0.0, (30.0, 30.0)), (1.0, (2.0, 5.0))])
def test_what_a_step_pays_without_falling_is_left_out(bonus, earned):
    env = Ledge(cells=1)
    params = env.default_params.replace(last=2, max_steps_in_episode=30)
    config = replace(SEARCH, generations=10, judge_every=10)
    expert = search_linear_expert(env, params, jax.random.key(0), config, bonus)
    assert earned[0] <= expert.mean_return <= earned[1]


def test_a_search_cuts_its_episodes_and_judges_whole_ones():
    config = WarmStartConfig(expert="linear", expert_generations=1, expert_episode_steps=30)
    expert = find_expert(Place.named("Pendulum-v1"), jax.random.key(0), config)
    assert expert.environment_steps == 64 * 30 + (20 + 20) * 200


def test_a_warm_start_takes_a_linear_expert():
    config = WarmStartConfig(expert="linear", expert_generations=1)
    expert = find_expert(Place.named("Pendulum-v1"), jax.random.key(0), config)
    # A generation of 64 episodes, a judgement of 20, and 20 of the expert, of 200 steps each.
    assert expert.environment_steps == (64 + 20 + 20) * 200


def test_a_warm_starts_settings_reach_the_search(monkeypatch):
    searched = []
    monkeypatch.setattr(
        "scb.warm_start.search_linear_expert", lambda *arguments: searched.append(arguments[3])
    )
    for settings in (
        {"expert": "linear"},
        {"expert": "linear", "expert_noise": 0.2},
        {
            "expert": "constant",
            "expert_errors": 0.3,
            "expert_sigma": 0.5,
            "expert_learning_rate": 0.4,
            "expert_decay": 0.99,
            "expert_reach": 2.0,
            "expert_starts": 3,
            "expert_error_warmup": 9,
        },
        {"expert": "linear", "expert_normalization": 0.5},
    ):
        find_expert(
            Place.named("Pendulum-v1"), jax.random.key(0), WarmStartConfig(**settings), quiet=True
        )
    plain = LinearSearchConfig(generations=80)
    assert searched == [
        plain,
        replace(plain, sigma=0.15, learning_rate=0.09, action_noise=0.2),
        replace(
            plain,
            sigma=0.5,
            learning_rate=0.4,
            decay=0.99,
            action_errors=0.3,
            error_warmup=9,
            starts=3,
            reach=2.0,
            constant=True,
        ),
        replace(plain, normalization=0.5),
    ]


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (
            "CartPole-v1",
            {},
            "the expert of a linear search has continuous actions and CartPole-v1 discrete ones",
        ),
        ("Pendulum-v1", {"expert_steps": 9}, "expert_steps is 9, and .* by linear, which trains"),
        (
            "Pendulum-v1",
            {"expert": "td3", "expert_episode_steps": 9},
            "expert_episode_steps is 9, and the expert of Pendulum-v1 is found by td3, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert": "evolution", "expert_pupils": 4},
            "expert_pupils is 4, and the expert of Pendulum-v1 is found by evolution, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert": "ppo", "expert_sigma": 0.1},
            "expert_sigma is 0.1, and the expert of Pendulum-v1 is found by ppo, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert": "td3", "expert_decay": 0.9},
            "expert_decay is 0.9, and the expert of Pendulum-v1 is found by td3, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert_generations": 3, "expert_error_warmup": 4},
            "expert_error_warmup is 4 of 3 generations: the errors would not grow to their scale",
        ),
        (
            "Pendulum-v1",
            {"expert": "linear", "expert_error_warmup": 4},
            "expert_error_warmup is 4, and there are no errors that could grow",
        ),
        ("Pendulum-v1", {"expert_starts": 0}, "expert_starts is 0: it must be at least 1"),
        (
            "Pendulum-v1",
            {"expert": "td3", "expert_starts": 2},
            "expert_starts is 2, and the expert of Pendulum-v1 is found by td3, which has no such setting",
        ),
        ("Pendulum-v1", {"expert_reach": 0.5}, "expert_reach is 0.5: it must be at least 1"),
        (
            "Pendulum-v1",
            {"expert": "td3", "expert_reach": 2.0},
            "expert_reach is 2.0, and the expert of Pendulum-v1 is found by td3, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert_normalization": 1.5},
            "expert_normalization is 1.5: it must be between 0 and 1",
        ),
        (
            "Pendulum-v1",
            {"expert": "td3", "expert_normalization": 0.5},
            "expert_normalization is 0.5, and the expert of Pendulum-v1 is found by td3, which has no such setting",
        ),
        (
            "Pendulum-v1",
            {"expert": "constant", "expert_normalization": 0.5},
            "expert_normalization is 0.5, and .* by constant, which observes nothing: leave it out, or choose linear",
        ),
        (
            "CartPole-v1",
            {"expert": "constant"},
            "the expert of a search for one action has continuous actions and CartPole-v1 discrete ones",
        ),
    ],
)
def test_a_linear_expert_that_cannot_be_found_is_refused(name, arguments, message):
    env, params = make(name)
    with pytest.raises(UserError, match=message):
        config = WarmStartConfig(**{"expert": "linear", **arguments})
        expert_agent(name, env.action_space(params), config)


def test_starts_need_generations_that_tell_them_apart():
    with pytest.raises(UserError, match="there are 5 starts, and 1 generation to choose"):
        LinearSearchConfig(starts=5, generations=1)


@pytest.mark.parametrize(("directions", "best"), [(22, 15), (23, 13), (32, 8), (8, 8)])
def test_as_many_directions_as_said_are_the_best(directions, best):
    env, params = make("Pendulum-v1")
    config = LinearSearchConfig(directions=directions, best=best)
    search = _LinearSearch(env, params, jax.random.key(0), config, 0.0, None)
    assert search._ars.num_elites == best


def test_more_best_directions_than_there_are_are_refused():
    with pytest.raises(UserError, match="best is 9 of 8 directions: take no more"):
        LinearSearchConfig(directions=8, best=9)
