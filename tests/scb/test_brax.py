import os
import pickle
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.environments import brax as adapter
from scb.environments.brax import BACKENDS, BRAX_NAMES, BraxEnvironment
from scb.environments.registry import environment_spec
from scb.errors import UserError

# The smallest of brax's environments on its fastest backend: a second or two to compile.
NAME, BACKEND = "inverted_pendulum", "spring"
PUSH, NOTHING = jnp.ones(1), jnp.zeros(1)


@pytest.fixture(scope="module")
def env() -> BraxEnvironment:
    return BraxEnvironment(NAME, BACKEND)


@pytest.fixture(scope="module")
def original():
    import brax.envs

    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return brax.envs.get_environment(NAME, backend=BACKEND)


@pytest.fixture(scope="module")
def steps_to_fall(env) -> int:
    """How long the pole stands, from the start state of key 0, while the cart is pushed."""
    _, state = env.reset(jax.random.key(0), env.default_params)
    for step in range(1, 100):
        _, state, _, terminated, _, _ = env.step(
            jax.random.key(step), state, PUSH, env.default_params
        )
        if terminated:
            return step
    raise AssertionError("the pole stood for 100 steps of full push")


def start_of(brax_state) -> tuple[float, ...]:
    return tuple(np.asarray(brax_state.obs).tolist())


@pytest.mark.slow
def test_every_step_is_braxs_own(env, original):
    observation, state = env.reset(jax.random.key(7), env.default_params)
    expected = jax.jit(original.reset)(jax.random.key(7))
    np.testing.assert_allclose(observation, expected.obs, atol=1e-6)
    step = jax.jit(original.step)
    actions = jax.random.uniform(jax.random.key(8), (30, 1), minval=-1.0, maxval=1.0)
    ended = []
    for t, action in enumerate(actions):
        expected = step(expected, action)
        _, state, reward, terminated, truncated, info = env.step(
            jax.random.key(t), state, action, env.default_params
        )
        np.testing.assert_allclose(info["final_observation"], expected.obs, atol=1e-4)
        assert reward == expected.reward
        assert terminated == (expected.done == 1.0)
        assert not truncated
        ended.append(bool(terminated))
        if terminated:
            break
    # Random pushes fell the pole within thirty steps, so that `done` was seen to go both ways.
    assert not ended[0] and ended[-1]


def test_a_fall_terminates_and_is_not_truncated(env, steps_to_fall):
    _, state = env.reset(jax.random.key(0), env.default_params)
    for t in range(steps_to_fall):
        assert state.time == t
        observation, state, _, terminated, truncated, info = env.step(
            jax.random.key(t), state, PUSH, env.default_params
        )
    assert terminated and not truncated
    assert info["terminated"] and not info["truncated"]
    assert info["discount"] == 0.0
    # The pole falls at 0.2 rad and starts within 0.01 rad of upright.
    assert abs(info["final_observation"][1]) > 0.2
    assert abs(observation[1]) <= 0.01
    assert state.time == 0


def test_the_time_limit_truncates_and_does_not_terminate(env):
    params = env.default_params.replace(max_steps_in_episode=3)
    _, state = env.reset(jax.random.key(0), params)
    flags = []
    for t in range(4):
        _, state, _, terminated, truncated, info = env.step(
            jax.random.key(t), state, NOTHING, params
        )
        assert not terminated
        assert info["discount"] == 1.0
        flags.append((bool(truncated), int(state.time)))
    # Steps 1, 2, 3 of one episode, the third truncated, and step 1 of the next.
    assert flags == [(False, 1), (False, 2), (True, 0), (False, 1)]


def test_a_fall_at_the_last_allowed_step_is_a_termination_only(env, steps_to_fall):
    params = env.default_params.replace(max_steps_in_episode=steps_to_fall)
    _, state = env.reset(jax.random.key(0), params)
    for t in range(steps_to_fall):
        _, state, _, terminated, truncated, _ = env.step(jax.random.key(t), state, PUSH, params)
    assert terminated and not truncated


def test_actions_are_clipped_to_the_actuators_bounds(env):
    _, state = env.reset(jax.random.key(0), env.default_params)

    def after(action: float) -> np.ndarray:
        return env.step(
            jax.random.key(1), state, jnp.array([action], jnp.float32), env.default_params
        )[0]

    np.testing.assert_array_equal(after(5.0), after(1.0))
    np.testing.assert_array_equal(after(-7.0), after(-1.0))
    assert not np.array_equal(after(1.0), after(0.5))


def test_a_pole_has_no_forward_velocity(env):
    _, state = env.reset(jax.random.key(0), env.default_params)
    assert np.isnan(env.forward_velocity(state))


@pytest.mark.slow
def test_forward_velocity_is_the_way_of_a_step():
    hopper = BraxEnvironment("hopper", "spring")
    _, state = hopper.reset(jax.random.key(0), hopper.default_params)
    _, after, *_ = hopper.step_env(
        jax.random.key(1), state, jnp.array([0.5, -0.5, 1.0]), hopper.default_params
    )
    way = after.brax_state.pipeline_state.x.pos[0, 0] - state.brax_state.pipeline_state.x.pos[0, 0]
    np.testing.assert_allclose(
        hopper.forward_velocity(after), way / hopper.brax_env.dt, rtol=1e-3, atol=1e-4
    )


def test_an_action_of_another_shape_is_refused(env):
    _, state = env.reset(jax.random.key(0), env.default_params)
    with pytest.raises(AssertionError, match="shape"):
        env.step(jax.random.key(1), state, jnp.zeros(2), env.default_params)


@pytest.fixture(scope="module")
def rollout(env):
    """8 environments, 12 steps, truncated at every second one: 8 * 6 = 48 auto-resets."""
    params = env.default_params.replace(max_steps_in_episode=2)
    keys = jax.random.split(jax.random.key(0), 8)
    first_observation, first = jax.vmap(env.reset, in_axes=(0, None))(keys, params)

    @jax.jit
    def run(state):
        def step(state, t):
            observation, state, reward, _, truncated, _ = jax.vmap(
                env.step, in_axes=(0, 0, 0, None)
            )(jax.random.split(jax.random.key(t), 8), state, actions, params)
            return state, (observation, reward, truncated, state.time)

        return jax.lax.scan(step, state, jnp.arange(12))[1]

    actions = jnp.linspace(-1.0, 1.0, 8)[:, None]
    return first_observation, first, actions, run(first)


def test_episodes_start_anew_under_vmap_and_scan(rollout):
    first_observation, _, _, (observation, _, truncated, time) = rollout
    np.testing.assert_array_equal(truncated, np.tile([[False], [True]], (6, 8)))
    np.testing.assert_array_equal(time, np.tile([[1], [0]], (6, 8)))
    starts = {tuple(start) for start in np.asarray(observation[1::2]).reshape(48, 4).tolist()}
    # Drawn from 1024 states, 48 draws collide 48 * 47 / 2 / 1024 = 1.1 times on average.
    assert len(starts) >= 43
    # None of them is the cached first state of its environment, as it would be in brax's wrapper.
    assert starts.isdisjoint(tuple(start) for start in np.asarray(first_observation).tolist())


def test_a_batch_under_vmap_does_what_each_of_its_environments_does_alone(env, rollout):
    _, first, actions, (observation, reward, _, _) = rollout
    for i in range(8):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], first)
        single = env.step(jax.random.key(0), state, actions[i], env.default_params)
        np.testing.assert_allclose(observation[0, i], single[0], atol=1e-5)
        assert reward[0, i] == single[2]


def test_the_pool_holds_as_many_different_resets_of_brax_as_it_says(original):
    pool = adapter._start_states(NAME, BACKEND, 1024)
    assert len({tuple(start) for start in pool.obs.tolist()}) == 1024
    expected = jax.jit(original.reset)(jax.random.split(jax.random.key(0), 1024)[5])
    np.testing.assert_allclose(pool.obs[5], expected.obs, atol=1e-6)


class FakeBrax:
    """Brax's interface over a counter, with what is awkward in brax: see the comments."""

    action_size = 1

    def reset(self, key):
        from brax.envs import State

        observation = jax.random.uniform(key, (1,))
        physics = {"count": jnp.int32(0), "contact": jnp.array(False), "mass": jnp.ones(2)}
        zero = jnp.float32(0)
        return State(physics, observation, zero, zero, {"speed": zero})

    def step(self, state, action):
        count = state.pipeline_state["count"] + 1
        state.metrics["speed"] = 1  # written into the caller's dictionary; of another dtype
        physics = {**state.pipeline_state, "count": count, "contact": count > 1}
        return state.replace(
            pipeline_state=physics,
            obs=jnp.asarray(count, jnp.float32)[None],
            reward=1.0,  # a Python number
            done=jnp.where(count >= 2, 1.0, 0.0),
        )


class FakeBraxEnvironment(BraxEnvironment):
    def __init__(self):
        super().__init__(NAME, BACKEND, num_start_states=None)
        self.brax_env = FakeBrax()


def test_without_a_pool_each_episode_starts_from_a_fresh_reset():
    env = FakeBraxEnvironment()
    params = env.default_params.replace(max_steps_in_episode=1)
    _, state = env.reset(jax.random.key(0), params)
    key = jax.random.key(1)
    observation, *_ = env.step(key, state, NOTHING, params)
    # gymnax splits its key into one for the step and one for the reset.
    expected, _ = env.reset(jax.random.split(key)[1], params)
    np.testing.assert_array_equal(observation, expected)


def test_integers_and_booleans_of_the_physics_survive_auto_reset():
    env = FakeBraxEnvironment()
    _, state = env.reset(jax.random.key(0), env.default_params)
    counts = []
    for t in range(3):
        _, after, reward, terminated, _, info = env.step(
            jax.random.key(t), state, NOTHING, env.default_params
        )
        assert jax.tree.map(lambda x: x.dtype, after) == jax.tree.map(lambda x: x.dtype, state)
        state = after
        physics = state.brax_state.pipeline_state
        counts.append((int(physics["count"]), bool(physics["contact"]), bool(terminated)))
    # Counts to 1, to 2 and is reset to 0, to 1.
    assert counts == [(1, False, False), (0, False, True), (1, False, False)]
    assert reward.dtype == jnp.float32
    assert info["final_observation"] == 1.0


def test_a_step_leaves_the_callers_state_alone():
    env = FakeBraxEnvironment()
    _, state = env.reset(jax.random.key(0), env.default_params)
    with jax.disable_jit():
        _, after, *_ = env.step_env(jax.random.key(1), state, NOTHING, env.default_params)
    assert state.brax_state.metrics["speed"] == 0.0
    assert after.brax_state.metrics["speed"] == 1.0


@pytest.mark.parametrize(
    ("done", "time", "terminated", "truncated"),
    [
        (0.0, 999, False, False),
        (1.0, 999, True, False),
        (0.0, 1000, False, True),
        (1.0, 1000, True, False),
    ],
)
def test_termination_and_truncation_exclude_each_other(env, done, time, terminated, truncated):
    _, state = env.reset(jax.random.key(0), env.default_params)
    state = state.replace(
        time=jnp.int32(time), brax_state=state.brax_state.replace(done=jnp.float32(done))
    )
    assert env.is_terminated(state, env.default_params) == terminated
    assert env.is_truncated(state, env.default_params) == truncated


def same_structure_after_a_step(name: str, backend: str) -> bool:
    # eval_shape traces and compiles nothing; without a pool, since making one compiles.
    env = BraxEnvironment(name, backend, num_start_states=None)
    params = env.default_params
    observation, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    action = jax.ShapeDtypeStruct((env.num_actions,), jnp.float32)
    new_observation, new_state, reward, terminated, truncated, _ = jax.eval_shape(
        partial(env.step, params=params), jax.random.key(0), state, action
    )

    def kinds(tree: object) -> list[object]:
        return [(leaf.shape, leaf.dtype.name) for leaf in jax.tree.leaves(tree)]

    assert observation.shape == env.observation_space().shape
    assert (reward.shape, reward.dtype) == ((), jnp.float32)
    assert terminated.dtype == truncated.dtype == jnp.bool_
    return kinds((observation, state)) == kinds((new_observation, new_state))


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_backend_can_be_stepped(backend):
    assert same_structure_after_a_step(NAME, backend)


def test_swimmer_can_be_stepped_though_its_fluid_model_calls_a_clip_that_jax_dropped():
    assert same_structure_after_a_step("swimmer", "generalized")


@pytest.mark.slow
def test_standing_still_pays_the_healthy_reward_for_a_whole_episode():
    known = {name: environment_spec(name) for name in BRAX_NAMES}
    for name, spec in known.items():
        if spec.standing_still("spring") is not None:
            env, params = spec.make("spring")
            paid = env.brax_env._healthy_reward * params.max_steps_in_episode
            assert spec.standing_still("spring") == spec.standing_still() == paid, name
    paying = {name for name, spec in known.items() if spec.standing_still("spring") is not None}
    assert paying == {"ant", "hopper", "humanoid", "walker2d"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BRAX_NAMES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_every_environment_steps_on_every_backend(name, backend):
    if name == "swimmer" and backend != "generalized":
        pytest.skip("brax's swimmer has the generalized backend only")
    assert same_structure_after_a_step(name, backend)


@pytest.mark.slow
def test_mjx_physics_run_and_auto_reset():
    env = BraxEnvironment(NAME, "mjx", num_start_states=4)
    params = env.default_params.replace(max_steps_in_episode=1)
    _, state = env.reset(jax.random.key(0), params)
    observation, *_ = env.step(jax.random.key(1), state, NOTHING, params)
    assert tuple(observation.tolist()) in {
        tuple(start) for start in adapter._start_states(NAME, "mjx", 4).obs.tolist()
    }


def test_the_spaces_are_braxs(env):
    assert (env.name, env.backend, env.num_actions) == (NAME, BACKEND, 1)
    assert env.default_params.max_steps_in_episode == 1000
    space = env.action_space(env.default_params)
    assert (space.low, space.high, space.shape) == (-1.0, 1.0, (1,))
    assert env.observation_space(env.default_params).shape == (4,)
    observation, _ = env.reset(jax.random.key(0), env.default_params)
    assert env.observation_space(env.default_params).contains(observation)


def test_environments_made_alike_share_a_compiled_program(env):
    traces = []

    @partial(jax.jit, static_argnums=0)
    def count(env, x):
        traces.append(env)
        return x

    count(env, 1.0)
    count(BraxEnvironment(NAME, BACKEND), 1.0)
    assert len(traces) == 1
    count(BraxEnvironment(NAME, "positional"), 1.0)
    count(BraxEnvironment(NAME, BACKEND, num_start_states=2), 1.0)
    assert len(traces) == 3


def test_an_environment_may_be_pickled(env):
    again = pickle.loads(pickle.dumps(env))
    assert again == env and again.brax_env is env.brax_env  # loaded once
    without = BraxEnvironment(NAME, BACKEND, num_start_states=None)
    assert pickle.loads(pickle.dumps(without)) == without != env


def test_an_environment_made_inside_a_traced_function_leaks_no_tracer():
    adapter._load.cache_clear()
    sizes = jax.jit(lambda x: x + BraxEnvironment("reacher", BACKEND).num_actions)(0)
    assert sizes == 2
    observation = jax.eval_shape(BraxEnvironment("reacher", BACKEND).reset, jax.random.key(0))[0]
    assert observation.shape == (11,)


def test_the_names_are_braxs():
    import brax.envs

    assert set(BRAX_NAMES) == set(brax.envs._envs) - {"fast"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hooper",), "unknown Brax environment 'hooper': did you mean hopper"),
        (("fast",), "unknown Brax environment 'fast'"),
        (("hopper", "sprung"), "unknown Brax backend 'sprung': did you mean spring"),
        (("swimmer", "spring"), "swimmer has no 'spring' backend: use backend='generalized'"),
        (("hopper", "spring", 0), "num_start_states is 0: give 1 or more, or None"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        BraxEnvironment(*arguments)


@pytest.fixture(scope="module")
def fresh_process(tmp_path_factory) -> tuple[list[str], list[str]]:
    """What a new process that makes a cheetah prints, and the files that it leaves."""
    code = (
        "import sys; from scb.environments.brax import BraxEnvironment;"
        "print('brax' in sys.modules); BraxEnvironment('halfcheetah', 'spring');"
        "print('brax' in sys.modules)"
    )
    folder = tmp_path_factory.mktemp("folder")
    completed = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(adapter.__file__).parents[2])},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return completed.stdout.splitlines(), os.listdir(folder)


def test_brax_is_not_imported_before_an_environment_is_made(fresh_process):
    printed, _ = fresh_process
    assert (printed[0], printed[-1]) == ("False", "True")


def test_making_an_environment_prints_nothing_and_leaves_no_log_file(fresh_process):
    # Left alone, brax prints which engines it did not find, and MuJoCo logs a deprecated attribute
    # of the cheetah's model into the working directory. The two lines are this test's own.
    printed, files = fresh_process
    assert len(printed) == 2
    assert files == []
