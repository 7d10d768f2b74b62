import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.curriculum import (
    PAPER_CURRICULA,
    SHAPES,
    CurriculumConfig,
    check_curriculum,
    horizon,
    paper_curriculum,
    with_limit,
)
from scb.environments.brax import BRAX_NAMES, BraxParams
from scb.environments.registry import make
from scb.errors import UserError
from scb.evaluation import evaluate
from tests.scb.probes import Corridor

MOVING = [shape for shape in SHAPES if shape != "constant"]
MOUNTAIN_CAR = CurriculumConfig("linear", 1000, 200, 200, 600)


def lengths(config, generations):
    return jax.vmap(horizon(config))(jnp.array(generations)).tolist()


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        # From 16 to 256 between generations 10 and 18; at a quarter, a half and three quarters:
        # 16 + 240 p for p = 1/4, 1/2, 3/4.
        ("linear", [76, 136, 196]),
        # 256 - 240 (1 - p)^2: 256 - 135, 256 - 60, 256 - 15.
        ("quadratic", [121, 196, 241]),
        # 256 - 120 (1 + cos(pi p)) with cos = 0.7071, 0, -0.7071: 51.1, 136, 220.9.
        ("cosine", [51, 136, 221]),
        # 16 * 16^p: 16 * 2, 16 * 4, 16 * 8.
        ("exponential", [32, 64, 128]),
        # One jump at a half.
        ("step", [16, 256, 256]),
    ],
)
def test_each_shape_goes_its_own_way(shape, expected):
    config = CurriculumConfig(shape, 16, 256, begin=10, transition=8)
    assert lengths(config, [12, 14, 16]) == expected


def test_a_curriculum_may_go_down():
    # The same numbers from the other side: 256 * (1/16)^p = 128, 64, 32.
    down = CurriculumConfig("exponential", 256, 16, begin=10, transition=8)
    assert lengths(down, [12, 14, 16]) == [128, 64, 32]
    # 256 - 240 p.
    assert lengths(CurriculumConfig("linear", 256, 16, 10, 8), [12, 14, 16]) == [196, 136, 76]


@pytest.mark.parametrize("shape", MOVING)
@pytest.mark.parametrize(("initial", "final"), [(1000, 200), (100, 1000), (1, 3), (7, 7)])
def test_every_shape_keeps_exactly_to_its_ends_and_never_turns_back(shape, initial, final):
    config = CurriculumConfig(shape, initial, final, begin=20, transition=37)
    values = lengths(config, range(200))
    assert values[:21] == [initial] * 21
    assert values[57:] == [final] * (200 - 57)
    steps = np.diff(values) * np.sign(final - initial)
    assert (steps >= 0).all()
    assert lengths(config, [10**9]) == [final]


@pytest.mark.parametrize("shape", MOVING)
def test_the_shortest_transition_is_one_generation(shape):
    config = CurriculumConfig(shape, 5, 9, begin=3, transition=1)
    assert lengths(config, [0, 3, 4, 5]) == [5, 5, 9, 9]


def test_a_constant_curriculum_is_constant():
    assert lengths(CurriculumConfig("constant", 150, 150), [0, 1, 1000]) == [150, 150, 150]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_horizon_is_an_integer_scalar_for_a_generation_of_any_type(shape):
    schedule = horizon(CurriculumConfig(shape, 4, 4, begin=2, transition=4))
    for generation in (3, 3.0, np.int64(3), jnp.int32(3), jnp.uint32(3)):
        assert schedule(generation).dtype == jnp.int32
        assert schedule(generation).shape == ()
        assert schedule(generation) == 4


def test_mountain_cars_curriculum_is_the_papers():
    assert paper_curriculum("MountainCar-v0") == MOUNTAIN_CAR
    # 1000 until 200, then 800 steps less in 600 generations: 4 less every 3.
    generations = [0, 200, 203, 500, 797, 800, 999]
    assert lengths(MOUNTAIN_CAR, generations) == [1000, 1000, 996, 600, 204, 200, 200]


@pytest.mark.parametrize(
    "name", ["hopper", "walker2d", "swimmer", "halfcheetah", "ant", "humanoidstandup"]
)
def test_locomotions_curriculum_is_the_papers(name):
    config = paper_curriculum(name)
    assert name in BRAX_NAMES
    assert config == CurriculumConfig("linear", 100, 1000, 200, 1600)
    # 100 until 200, then 900 steps more in 1600 generations: 9 more every 16.
    assert lengths(config, [0, 200, 216, 1000, 1784, 1800, 1999]) == [
        *(100, 100, 109, 550, 991, 1000, 1000)
    ]


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1", "reacher", "inverted_pendulum"])
def test_where_the_paper_has_no_curriculum_there_is_none(name):
    assert paper_curriculum(name) is None
    assert paper_curriculum(name, 100) is None


def test_a_curriculum_is_rescaled_with_the_search():
    # A tenth: 200 / 10 and 1600 / 10; the lengths stay.
    assert paper_curriculum("hopper", 200) == CurriculumConfig("linear", 100, 1000, 20, 160)
    # Twice.
    assert paper_curriculum("MountainCar-v0", 2000) == CurriculumConfig(
        "linear", 1000, 200, 400, 1200
    )
    # 200 * 7 / 1000 = 1.4 and 600 * 7 / 1000 = 4.2, rounded down.
    assert MOUNTAIN_CAR.rescaled(1000, 7) == CurriculumConfig("linear", 1000, 200, 1, 4)
    assert MOUNTAIN_CAR.rescaled(1000, 1000) == MOUNTAIN_CAR


@pytest.mark.parametrize("name", PAPER_CURRICULA)
def test_a_rescaled_curriculum_reaches_its_end_within_the_search(name):
    for generations in range(2, 100):
        config = paper_curriculum(name, generations)
        assert config.begin + config.transition <= generations - 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("linaer", 1, 2, 0, 1),
            "unknown curriculum shape 'linaer': did you mean linear or cosine?",
        ),
        (("linear", 0, 2, 0, 1), "the curriculum's initial length is 0: it must be at least 1."),
        (("linear", 1, -2, 0, 1), "final length is -2"),
        (("linear", 1, 2, -1, 1), "begins is -1: it must be 0 or larger."),
        (("linear", 1, 2, 0, 0), "transition is 0"),
        (("constant", 1, 2, 0, 1), "cannot go from 1 to 2"),
        (
            ("linear", 1, 2**31, 0, 1),
            "the curriculum's final length is 2147483648: it must be at least 1, and below 2^31",
        ),
        (
            ("linear", 1, 2, 0, 2**31),
            "the curriculum's transition is 2147483648: it must be at least 1, and below 2^31",
        ),
    ],
)
def test_a_curriculum_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(UserError) as error:
        CurriculumConfig(*arguments)
    assert message in str(error.value)


@pytest.mark.parametrize("generations", [(0, 5), (5, 0), (5, -1)])
def test_a_search_without_generations_is_refused(generations):
    with pytest.raises(UserError, match="it must be at least 1"):
        MOUNTAIN_CAR.rescaled(*generations)


def test_a_search_of_no_generations_has_no_paper_curriculum():
    with pytest.raises(UserError, match="to_generations is 0"):
        paper_curriculum("hopper", 0)


@pytest.mark.parametrize("name", PAPER_CURRICULA)
def test_the_papers_curricula_end_at_the_environments_own_limit(name):
    env_params = BraxParams() if name in BRAX_NAMES else make(name)[1]
    limit = env_params.max_steps_in_episode
    config = paper_curriculum(name)
    assert config.final == limit
    check_curriculum(config, limit, name)


def test_only_the_end_must_keep_to_the_environments_limit():
    check_curriculum(MOUNTAIN_CAR, 200, "MountainCar-v0")
    with pytest.raises(UserError) as error:
        check_curriculum(MOUNTAIN_CAR, 199, "MountainCar-v0")
    assert str(error.value) == (
        "the curriculum ends with episodes of 200 steps, but one of MountainCar-v0 takes at most "
        "199: give a final length up to that."
    )


@pytest.mark.parametrize("shape", MOVING)
def test_an_episode_is_cut_where_the_curriculum_says_in_one_program(shape):
    # An endless corridor that pays 1 a step: return = length = horizon.
    config = CurriculumConfig(shape, 10, 60, begin=2, transition=4)
    endless = Corridor().default_params.replace(last=1000)
    traces = []

    @jax.jit
    def episodes(generation):
        traces.append(generation)
        env_params = with_limit(endless, config.longest)
        return evaluate(
            Corridor(),
            env_params,
            lambda observation, key: jnp.int32(0),
            jax.random.key(0),
            2,
            horizon(config)(generation),
        )

    for generation, expected in enumerate(lengths(config, range(8))):
        result = episodes(generation)
        assert result.lengths.tolist() == [expected, expected]
        assert result.returns.tolist() == [expected, expected]
    assert (lengths(config, [0]), lengths(config, [7])) == ([10], [60])
    assert len(traces) == 1


def test_mountain_cars_episodes_last_1000_steps_at_first_and_200_in_the_end():
    # Without a push the car stays in the valley, at -1 a step, until it is cut. Its own limit of 200
    # would cut it in every generation.
    env, env_params = make("MountainCar-v0")

    @jax.jit
    def episodes(env_params, generation):
        def coast(observation, key):
            return jnp.int32(1)

        key = jax.random.key(0)
        return evaluate(env, env_params, coast, key, 2, horizon(MOUNTAIN_CAR)(generation))

    raised = with_limit(env_params, MOUNTAIN_CAR.longest)
    for generation, expected in ((0, 1000), (500, 600), (800, 200)):
        assert episodes(raised, generation).lengths.tolist() == [expected, expected]
        assert episodes(raised, generation).returns.tolist() == [-expected, -expected]
        assert episodes(env_params, generation).lengths.tolist() == [200, 200]
    assert episodes._cache_size() == 1


def test_a_raised_limit_changes_nothing_else():
    _, env_params = make("MountainCar-v0")
    raised = with_limit(env_params, 1000)
    assert raised.max_steps_in_episode == 1000
    assert with_limit(raised, 200) == env_params
