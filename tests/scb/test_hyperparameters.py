import re
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from scipy import stats

from scb.agents.hyperparameters import (
    ALGORITHMS,
    DDPG_INNER_LOOP,
    DQN_INNER_LOOP,
    PPO_INNER_LOOP,
    SAC_INNER_LOOP,
    TD3_INNER_LOOP,
    algorithms_for,
    check_algorithms,
    check_lists,
    inner_loop,
    sample_hyperparameters,
)
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.settings import environment_setting, environment_settings
from scb.agents.td3 import TD3Config, TD3Hyperparameters
from scb.environments.brax import BRAX_NAMES
from scb.environments.registry import environment_names, make
from scb.errors import UserError
from tests.scb.probes import ContinuousCorridor, Corridor

DISCRETE, BOX = spaces.Discrete(2), spaces.Box(-1.0, 1.0, (1,), jnp.float32)
# {algorithm: (its lists, a space that it fits)}
TABLES = {
    "ppo": (PPO_INNER_LOOP, DISCRETE),
    "sac": (SAC_INNER_LOOP, DISCRETE),
    "dqn": (DQN_INNER_LOOP, DISCRETE),
    "ddpg": (DDPG_INNER_LOOP, BOX),
    "td3": (TD3_INNER_LOOP, BOX),
}
DRAWS, AGENTS = 2000, 3


@pytest.fixture(scope="module")
def draws():
    """[DRAWS, AGENTS] hyperparameters."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return jax.vmap(lambda key: sample_hyperparameters(key, PPO_INNER_LOOP, AGENTS))(keys)


@pytest.mark.parametrize("name", PPO_INNER_LOOP)
def test_every_agent_gets_every_value_of_a_list_equally_often(draws, name):
    for agent in np.asarray(getattr(draws, name)).T:
        values, counts = np.unique(agent, return_counts=True)
        np.testing.assert_array_equal(values, np.sort(np.float32(PPO_INNER_LOOP[name])))
        assert stats.chisquare(counts).pvalue > 1e-4


def test_hyperparameters_are_drawn_independently_of_each_other(draws):
    # Of the first agent, over all draws. The error of a correlation of 2000 pairs is 0.022.
    table = np.stack([getattr(draws, name)[:, 0] for name in PPO_INNER_LOOP])
    np.testing.assert_allclose(np.corrcoef(table), np.eye(len(table)), atol=0.09)


@pytest.mark.parametrize("name", PPO_INNER_LOOP)
def test_agents_share_the_values_out(draws, name):
    # Fewer agents than values: no two of them have the same one.
    assert all(len(set(draw.tolist())) == AGENTS for draw in np.asarray(getattr(draws, name)))


@pytest.mark.parametrize("number", [1, 5, 13])
def test_no_value_is_dealt_more_than_once_more_than_another(number):
    # 13 agents and 5 values: two or three agents each.
    drawn = sample_hyperparameters(jax.random.key(number), PPO_INNER_LOOP, number)
    for name, values in PPO_INNER_LOOP.items():
        array = np.asarray(getattr(drawn, name))
        assert array.shape == (number,)
        counts = [np.sum(array == np.float32(value)) for value in values]
        assert sum(counts) == number and max(counts) - min(counts) <= 1


def test_what_has_no_list_keeps_its_default():
    drawn = sample_hyperparameters(jax.random.key(0), {"discount": [0.5]}, 2)
    np.testing.assert_array_equal(drawn.discount, 0.5)
    nothing_drawn = sample_hyperparameters(jax.random.key(0), {}, 2)
    for name, default in vars(PPOHyperparameters()).items():
        if default is None:
            assert getattr(nothing_drawn, name) is getattr(drawn, name) is None
            continue
        np.testing.assert_array_equal(getattr(nothing_drawn, name), np.full(2, default, np.float32))
        if name != "discount":
            np.testing.assert_array_equal(getattr(drawn, name), getattr(nothing_drawn, name))


def test_the_order_of_the_lists_does_not_matter():
    backwards = dict(reversed(PPO_INNER_LOOP.items()))
    a, b = (sample_hyperparameters(jax.random.key(3), x, 4) for x in (PPO_INNER_LOOP, backwards))
    chex.assert_trees_all_equal(a, b)


# -- the inner loop
# -----------------------------------------------------------------------------------


def test_algorithms_are_the_papers_for_each_kind_of_action():
    assert algorithms_for(DISCRETE) == ("ppo", "sac", "dqn")
    assert algorithms_for(BOX) == ("ppo", "sac", "ddpg", "td3")


@pytest.mark.parametrize("space", [DISCRETE, BOX])
def test_the_papers_algorithms_fit_and_make_agents_of_their_own_configuration(space):
    env = Corridor() if space is DISCRETE else ContinuousCorridor()
    for algorithm in algorithms_for(space):
        check_algorithms([algorithm], space)
        loop = inner_loop(algorithm, "CartPole-v1", space)
        agent = loop.agent(env)
        assert agent.env is env and agent.config is loop.config
        assert loop.name == algorithm


@pytest.mark.parametrize("algorithm", TABLES)
def test_the_defaults_are_values_of_the_lists(algorithm):
    lists, space = TABLES[algorithm]
    hyperparameters = inner_loop(algorithm, "CartPole-v1", space).hyperparameters
    for name, values in lists.items():
        assert getattr(hyperparameters, name) in values


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_continuous_actions_drop_the_largest_learning_rate(algorithm):
    # Liesen et al. (2024), in the tables: 0.01 is left out for continuous environments.
    table = dict(TABLES[algorithm][0])
    assert 0.01 in table["learning_rate"]
    assert inner_loop(algorithm, "CartPole-v1", DISCRETE).lists == table
    table["learning_rate"] = (0.005, 0.001, 0.0005, 0.0001)
    assert inner_loop(algorithm, "MountainCarContinuous-v0", BOX).lists == table


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_algorithms_for_continuous_actions_never_draw_the_largest_learning_rate(algorithm):
    lists = inner_loop(algorithm, "Pendulum-v1", BOX).lists
    assert lists["learning_rate"] == (0.005, 0.001, 0.0005, 0.0001)


@pytest.mark.parametrize("algorithm", algorithms_for(BOX))
def test_only_pendulum_has_relu_networks(algorithm):
    assert inner_loop(algorithm, "Pendulum-v1", BOX).config.activation == "relu"
    for environment in ("MountainCarContinuous-v0", "hopper"):
        assert inner_loop(algorithm, environment, BOX).config.activation == "tanh"


@pytest.mark.parametrize("algorithm", algorithms_for(BOX))
def test_nothing_is_drawn_in_brax_or_where_it_is_not_asked_for(algorithm):
    for loop in (
        inner_loop(algorithm, "hopper", BOX),
        inner_loop(algorithm, "Pendulum-v1", BOX, sampled=False),
    ):
        assert loop.lists == {}
        drawn = loop.sample(jax.random.key(0), 3)
        for name, default in vars(loop.hyperparameters).items():
            if default is None:
                assert getattr(drawn, name) is None
                continue
            np.testing.assert_array_equal(getattr(drawn, name), np.full(3, default, np.float32))


def test_ddqn_is_a_dqn_that_is_always_double():
    ddqn, dqn = (inner_loop(name, "CartPole-v1", DISCRETE) for name in ("ddqn", "dqn"))
    assert ddqn.config == dqn.config
    assert set(dqn.lists) - set(ddqn.lists) == {"double"}
    np.testing.assert_array_equal(ddqn.sample(jax.random.key(0), 8).double, 1.0)
    assert set(np.asarray(dqn.sample(jax.random.key(0), 8).double)) == {0.0, 1.0}


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_ddpg_is_a_td3_of_one_critic_no_delay_and_no_target_noise(algorithm):
    loop = inner_loop(algorithm, "Pendulum-v1", BOX)
    assert isinstance(loop.config, TD3Config)
    drawn = loop.sample(jax.random.key(0), 5)
    assert isinstance(drawn, TD3Hyperparameters)
    if algorithm == "ddpg":
        assert (loop.config.num_critics, loop.config.policy_delay) == (1, 1)
        np.testing.assert_array_equal(drawn.target_noise, 0.0)
    else:
        assert (loop.config.num_critics, loop.config.policy_delay) == (2, 2)
        assert set(np.asarray(drawn.target_noise)) <= set(
            np.float32(TD3_INNER_LOOP["target_noise"])
        )


def test_the_steps_of_an_inner_loop_are_the_tables():
    # PPO: 20 batches of 5 x 100. Off-policy: 1000 of prefill, 9000 / num_envs steps of num_envs.
    for algorithm, (_, space) in TABLES.items():
        assert inner_loop(algorithm, "CartPole-v1", space).steps == 10_000


# -- what is refused
# ----------------------------------------------------------------------------------


def test_an_unknown_hyperparameter_or_an_empty_list_is_refused():
    with pytest.raises(
        UserError, match="unknown hyperparameter 'momentum': known are learning_rate"
    ):
        sample_hyperparameters(jax.random.key(0), {"momentum": [0.9]}, 1)
    with pytest.raises(UserError, match="the list of values for discount is empty"):
        sample_hyperparameters(jax.random.key(0), {"discount": []}, 1)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"gae_lambda": [0.9]}, "unknown hyperparameter 'gae_lambda': known are learning_rate"),
        ({"polyak": ()}, "the list of values for polyak is empty: give at least one number"),
        ({"polyak": [0.9, "x"]}, "polyak has the value 'x', which is no number"),
        ({"polyak": [True]}, "polyak has the value True, which is no number"),
    ],
)
def test_lists_are_checked_against_the_algorithms_own_hyperparameters(lists, message):
    check_lists(TD3_INNER_LOOP, TD3Hyperparameters())
    with pytest.raises(UserError, match=message):
        check_lists(lists, TD3Hyperparameters())


@pytest.mark.parametrize(
    ("names", "space", "message"),
    [
        ([], DISCRETE, "the list of algorithms is empty: give one or more of ppo, sac, dqn, ddqn"),
        (["tdd"], BOX, "unknown algorithm 'tdd': did you mean td3"),
        (["ppo", "td3"], DISCRETE, "td3 does not fit .* discrete actions: use ppo, sac, dqn, ddqn"),
        (["dqn"], BOX, "dqn does not fit .* continuous actions: use ppo, sac, ddpg, td3"),
    ],
)
def test_algorithms_that_cannot_be_trained_are_refused(names, space, message):
    with pytest.raises(UserError, match=message):
        check_algorithms(names, space)


# -- settings for environments themselves
# --------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_settings_are_for_environments_that_exist_and_have_numbers_in_their_range(algorithm):
    settings = environment_settings(algorithm)
    assert set(settings) <= set(environment_names())
    for name in (*settings, "CartPole-v1"):
        setting = environment_setting(name, algorithm)
        assert 0 < setting.hyperparameters.learning_rate <= 0.01
        assert 0 < setting.hyperparameters.discount <= 1
        assert 0 <= setting.num_environment_steps - setting.config.total_steps < 20_000
        assert setting.config.batch_size <= setting.config.total_steps
        assert setting.source


def test_only_mountain_cars_training_has_longer_episodes_than_the_environment():
    limits = {
        (name, algorithm): setting.episode_limit
        for algorithm in ALGORITHMS
        for name, setting in environment_settings(algorithm).items()
    }
    assert {k: v for k, v in limits.items() if v is not None} == {("MountainCar-v0", "sac"): 1000}
    _, params = make("MountainCar-v0")
    longer = environment_setting("MountainCar-v0", "sac").training_params(params)
    assert longer.max_steps_in_episode == 1000 and params.max_steps_in_episode == 200
    assert environment_setting("Acrobot-v1", "sac").training_params(params) is params


def test_an_unknown_algorithm_has_no_settings():
    with pytest.raises(UserError, match="unknown algorithm 'tdd': did you mean td3"):
        environment_setting("CartPole-v1", "tdd")


def test_an_environment_without_a_setting_gets_ten_times_the_inner_loops_steps():
    assert environment_setting("CartPole-v1").config.total_steps == 10 * PPOConfig().total_steps


# -- the paper's own tables
# ----------------------------------------------------------------------------

PAPER = Path(__file__).parents[2].parent / "shared" / "paper.tex"
needs_paper = pytest.mark.skipif(not PAPER.exists(), reason="the paper is not beside the checkout")

# Row of a table -> field; what else a table says is compared by hand below.
FIELDS = {
    "network arch.": "hidden_sizes",
    "activation": "activation",
    "num. envs": "num_envs",
    "num. envs.": "num_envs",
    "num. steps": "num_steps",
    "num. epochs": "num_epochs",
    "num. minibatches": "num_minibatches",
    "time steps": "total_steps",
    "max. grad. norm": "max_grad_norm",
    "learning rate": "learning_rate",
    "discount": "discount",
    "lambda for GAE": "gae_lambda",
    "clipping epsilon": "drift",
    "clip_eps": "drift",
    "entropy coef.": "entropy_coefficient",
    "value function coef.": "value_coefficient",
    "norm. obs.": "normalize_observations",
    "buffer size": "buffer_size",
    "prefill buffer": "prefill",
    "batch size": "batch_size",
    "grad. steps": "gradient_steps",
    "gradient steps": "gradient_steps",
    "Polyak tau": "polyak",
    "target entropy ratio": "target_entropy_ratio",
    "target update freq.": "target_update_every",
    "epsilon start": "epsilon_start",
    "epsilon decay fraction": "epsilon_decay",
    "epsilon end": "epsilon_end",
    "Double DQN": "double",
    "expl. noise": "exploration_noise",
    "target noise": "target_noise",
    "target noise clip": "target_noise_clip",
    "policy delay": "policy_delay",
}


def without_commands(cell):
    """A LaTeX cell as plain text: 2.5\\cdot 10^{-4} becomes 2.5*10^-4, underlines are marked by _."""
    cell = re.sub(
        r"\\begin\{tabular\}(\[.*?\])?\{(?:[^{}]|\{[^{}]*\})*\}|\\end\{tabular\}", "", cell
    )
    cell = re.sub(r"\\multicolumn\{\d+\}\{[^{}]*\}", "", cell)
    cell = re.sub(r"\\text\{(\w+)\}", r"\1", cell)
    cell = re.sub(r"\\underline\{([^{}]*)\}", r"_\1", cell)
    cell = re.sub(r"\s*\\cdot\s*", "*", cell).replace("\\_", "_")
    cell = re.sub(r"\\(lambda|epsilon|tau)", r"\1", cell)
    return re.sub(r"[\\{}$]", "", cell).strip()


def table(label):
    """[[cell, ...], ...] of the table with this label, its heading first; a cell over n columns n times."""
    text = PAPER.read_text()
    end = text.index(rf"\label{{{label}}}")
    body = text[text.rindex(r"\begin{table}", 0, end) : end]
    body = body[body.index(r"\hline") : body.rindex(r"\hline")].replace(r"\hline", "")
    # A cell may hold a table of its own, whose line break is none of ours.
    body = re.sub(
        r"\\begin\{tabular\}.*?\\end\{tabular\}",
        lambda m: m[0].replace("\\\\", " "),
        body,
        flags=re.S,
    )
    rows = []
    for line in body.split("\\\\"):
        cells = []
        for cell in line.split("&"):
            span = re.search(r"\\multicolumn\{(\d+)\}", cell)
            cells += [without_commands(cell)] * (int(span[1]) if span else 1)
        if len(cells) > 1:
            rows.append(cells)
    return rows


def number(text):
    """2.5*10^-4, 2^20, 5*2^20, 0.3, true, yes."""
    words = {"true": True, "false": False, "yes": 1.0, "no": 0.0}
    if text in words:
        return words[text]
    product = 1.0
    for factor in text.split("*"):
        base, _, exponent = factor.partition("^")
        product *= float(base) ** int(exponent or 1)
    return product


def value(cell):
    """A cell's (list or None, underlined or only value)."""
    arch = re.fullmatch(r"\((\d+), (\d+)\) MLP", cell)
    if arch:
        return None, (int(arch[1]), int(arch[2]))
    if cell.startswith("tanh"):
        return None, "tanh"  # "(ReLU for Pendulum)" has its test above
    if "," in cell:
        # "(without 0.01 for continuous environments)" has its test above too.
        entries = [entry.strip() for entry in cell.split("(")[0].split(",")]
        underlined = [number(entry[1:]) for entry in entries if entry.startswith("_")]
        return [number(e.lstrip("_")) for e in entries], underlined[0] if underlined else None
    return None, number(cell)


def assert_field(loop, field, expected, where):
    holder = loop.hyperparameters if hasattr(loop.hyperparameters, field) else loop.config
    found = getattr(holder, field)
    if isinstance(expected, float):
        assert float(found) == pytest.approx(expected, rel=1e-9), where
    else:
        assert found == expected, where


@needs_paper
@pytest.mark.parametrize("algorithm", TABLES)
def test_the_inner_loop_is_the_papers_table(algorithm):
    lists, space = TABLES[algorithm]
    heading, *rows = table(f"tab:hyper_se_{algorithm}")
    listed = {}
    for column, title in enumerate(heading[1:], 1):
        environment = "hopper" if title == "brax" else "CartPole-v1"
        loop = inner_loop(algorithm, environment, BOX if title == "brax" else space)
        for row in rows:
            if row[column] == "n.a.":
                continue
            values, fixed = value(row[column])
            if values is not None:
                listed[FIELDS[row[0]]] = tuple(values)
            if fixed is not None:
                assert_field(loop, FIELDS[row[0]], fixed, (algorithm, title, row[0]))
    assert listed == lists
    assert len(rows) >= 12


@needs_paper
@pytest.mark.parametrize("algorithm", ["ppo", "sac", "ddpg", "td3"])
def test_the_brax_experts_are_the_papers_tables(algorithm):
    heading, *rows = table(f"tab:{algorithm}_expert_brax")
    names = [title.lower() for title in heading[1:]]
    settings = environment_settings(algorithm)
    # Classic control has settings from elsewhere.
    assert set(names) == set(settings) & set(BRAX_NAMES) and len(names) == 5
    for column, name in enumerate(names, 1):
        for row in rows:
            assert len(row) == 6, row
            _, expected = value(row[column])
            assert_field(settings[name], FIELDS[row[0]], expected, (algorithm, name, row[0]))
    assert len(rows) >= 12
