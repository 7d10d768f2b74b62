import math
import re
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from scipy import stats

from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import (
    ALGORITHMS,
    AgentSpec,
    algorithms_for,
    bandit_agent,
    check_algorithms,
    check_lists,
    environment_agent,
)
from scb.agents.tables import (
    DDPG_INNER_LOOP,
    DQN_INNER_LOOP,
    PPO_INNER_LOOP,
    SAC_INNER_LOOP,
    TD3_INNER_LOOP,
)
from scb.agents.td3 import TD3Config, TD3Hyperparameters
from scb.environments.brax import BRAX_NAMES
from scb.environments.registry import environment_names, families, make
from scb.errors import UserError
from tests.scb.probes import ContinuousCorridor, Corridor

DISCRETE, BOX = spaces.Discrete(2), spaces.Box(-1.0, 1.0, (1,), jnp.float32)
# {algorithm: (its lists, an environment of classic control that it fits)}
TABLES = {
    "ppo": (PPO_INNER_LOOP, "CartPole-v1"),
    "sac": (SAC_INNER_LOOP, "CartPole-v1"),
    "dqn": (DQN_INNER_LOOP, "CartPole-v1"),
    "ddpg": (DDPG_INNER_LOOP, "MountainCarContinuous-v0"),
    "td3": (TD3_INNER_LOOP, "MountainCarContinuous-v0"),
}
DRAWS, AGENTS = 2000, 3


def ppo(lists):
    """PPO on its defaults, but for what is drawn."""
    return AgentSpec("ppo", PPOConfig(), PPOHyperparameters(), lists)


@pytest.fixture(scope="module")
def draws():
    """[DRAWS, AGENTS] hyperparameters."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return jax.vmap(lambda key: ppo(PPO_INNER_LOOP).sample(key, AGENTS))(keys)


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
    drawn = ppo(PPO_INNER_LOOP).sample(jax.random.key(number), number)
    for name, values in PPO_INNER_LOOP.items():
        array = np.asarray(getattr(drawn, name))
        assert array.shape == (number,)
        counts = [np.sum(array == np.float32(value)) for value in values]
        assert sum(counts) == number and max(counts) - min(counts) <= 1


def test_what_has_no_list_keeps_its_default():
    drawn = ppo({"discount": [0.5]}).sample(jax.random.key(0), 2)
    np.testing.assert_array_equal(drawn.discount, 0.5)
    nothing_drawn = ppo({}).sample(jax.random.key(0), 2)
    for name, default in vars(PPOHyperparameters()).items():
        if default is None:
            assert getattr(nothing_drawn, name) is getattr(drawn, name) is None
            continue
        np.testing.assert_array_equal(getattr(nothing_drawn, name), np.full(2, default, np.float32))
        if name != "discount":
            np.testing.assert_array_equal(getattr(drawn, name), getattr(nothing_drawn, name))


def test_the_order_of_the_lists_does_not_matter():
    backwards = dict(reversed(PPO_INNER_LOOP.items()))
    a, b = (ppo(x).sample(jax.random.key(3), 4) for x in (PPO_INNER_LOOP, backwards))
    chex.assert_trees_all_equal(a, b)


# -- the inner loop
# -----------------------------------------------------------------------------------


def test_algorithms_are_the_papers_for_each_kind_of_action():
    assert algorithms_for(DISCRETE) == ("ppo", "sac", "dqn")
    assert algorithms_for(BOX) == ("ppo", "sac", "ddpg", "td3")


@pytest.mark.parametrize(
    ("space", "kind", "environment"),
    [(DISCRETE, "discrete", "CartPole-v1"), (BOX, "continuous", "MountainCarContinuous-v0")],
)
def test_the_papers_algorithms_fit_and_make_agents_of_their_own_configuration(
    space, kind, environment
):
    env = Corridor() if space is DISCRETE else ContinuousCorridor()
    for algorithm in algorithms_for(space):
        check_algorithms([algorithm], kind)
        loop = bandit_agent(algorithm, environment)
        agent = loop.agent(env)
        assert agent.env is env and agent.config is loop.config
        assert loop.algorithm == algorithm


@pytest.mark.parametrize("algorithm", TABLES)
def test_the_defaults_are_values_of_the_lists(algorithm):
    lists, environment = TABLES[algorithm]
    hyperparameters = bandit_agent(algorithm, environment).hyperparameters
    for name, values in lists.items():
        assert getattr(hyperparameters, name) in values


@pytest.mark.parametrize("algorithm", algorithms_for(BOX))
def test_continuous_actions_drop_the_largest_learning_rate_of_ppo_alone(algorithm):
    lists = dict(TABLES[algorithm][0])
    assert lists["learning_rate"][0] == 0.01
    if algorithm == "ppo":
        lists["learning_rate"] = (0.005, 0.001, 0.0005, 0.0001)
    assert bandit_agent(algorithm, "MountainCarContinuous-v0").lists == lists


@pytest.mark.parametrize("algorithm", algorithms_for(BOX))
def test_only_pendulum_has_relu_networks(algorithm):
    assert bandit_agent(algorithm, "Pendulum-v1").config.activation == "relu"
    for environment in ("MountainCarContinuous-v0", "hopper"):
        assert bandit_agent(algorithm, environment).config.activation == "tanh"


@pytest.mark.parametrize("algorithm", algorithms_for(BOX))
def test_nothing_is_drawn_in_brax_or_where_it_is_not_asked_for(algorithm):
    for loop in (
        bandit_agent(algorithm, "hopper"),
        bandit_agent(algorithm, "Pendulum-v1", sampled=False),
    ):
        assert loop.lists == {}
        drawn = loop.sample(jax.random.key(0), 3)
        for name, default in vars(loop.hyperparameters).items():
            if default is None:
                assert getattr(drawn, name) is None
                continue
            np.testing.assert_array_equal(getattr(drawn, name), np.full(3, default, np.float32))


def test_ddqn_is_a_dqn_that_is_always_double():
    ddqn, dqn = (bandit_agent(name, "CartPole-v1") for name in ("ddqn", "dqn"))
    assert ddqn.config == dqn.config
    assert set(dqn.lists) - set(ddqn.lists) == {"double"}
    np.testing.assert_array_equal(ddqn.sample(jax.random.key(0), 8).double, 1.0)
    assert set(np.asarray(dqn.sample(jax.random.key(0), 8).double)) == {0.0, 1.0}


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_ddpg_is_a_td3_of_one_critic_no_delay_and_no_target_noise(algorithm):
    loop = bandit_agent(algorithm, "Pendulum-v1")
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
    for algorithm, (_, environment) in TABLES.items():
        assert bandit_agent(algorithm, environment).steps == 10_000


# -- what is refused
# ----------------------------------------------------------------------------------


def test_an_unknown_hyperparameter_or_an_empty_list_is_refused():
    with pytest.raises(
        UserError, match="unknown hyperparameter 'momentum': known are learning_rate"
    ):
        ppo({"momentum": [0.9]})
    with pytest.raises(UserError, match="for a list of values: give one or more numbers"):
        ppo({"discount": []})


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"gae_lambda": [0.9]}, "unknown hyperparameter 'gae_lambda': known are learning_rate"),
        ({"polyak": ()}, "for a list of values: give one or more numbers"),
        ({"polyak": [0.9, "x"]}, "polyak has the value 'x', which is no number"),
        ({"polyak": [True]}, "polyak has the value True, which is no number"),
    ],
)
def test_lists_are_checked_against_the_algorithms_own_hyperparameters(lists, message):
    check_lists(TD3_INNER_LOOP, TD3Hyperparameters())
    with pytest.raises(UserError, match=message):
        check_lists(lists, TD3Hyperparameters())


@pytest.mark.parametrize(
    ("names", "kind", "message"),
    [
        (
            [],
            "discrete",
            "the list of algorithms is empty: give one or more of ppo, sac, dqn, ddqn",
        ),
        (["tdd"], "continuous", "unknown algorithm 'tdd': did you mean td3"),
        (
            ["ppo", "td3"],
            "discrete",
            "td3 does not fit .* discrete actions: use ppo, sac, dqn, ddqn",
        ),
        (["dqn"], "continuous", "dqn does not fit .* continuous actions: use ppo, sac, ddpg, td3"),
    ],
)
def test_algorithms_that_cannot_be_trained_are_refused(names, kind, message):
    with pytest.raises(UserError, match=message):
        check_algorithms(names, kind)


# -- settings for environments themselves
# --------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_settings_are_for_environments_that_exist_and_have_numbers_in_their_range(algorithm):
    own = ALGORITHMS[algorithm].environments
    assert set(own) <= {*environment_names(), *families()}
    for name in (*set(own) - {"minatar"}, "Breakout-MinAtar", "CartPole-v1"):
        spec = environment_agent(algorithm, name)
        assert 0 < spec.hyperparameters.learning_rate <= 0.01
        assert 0 < spec.hyperparameters.discount <= 1
        assert 0 <= spec.steps - spec.config.total_steps < 20_000
        assert spec.config.batch_size <= spec.config.total_steps
        assert spec.source


def test_only_mountain_cars_training_has_longer_episodes_than_the_environment():
    limits = {
        (name, algorithm): row.episode_limit
        for algorithm, tables in ALGORITHMS.items()
        for name, row in tables.environments.items()
    }
    assert {k: v for k, v in limits.items() if v is not None} == {("MountainCar-v0", "sac"): 1000}
    _, params = make("MountainCar-v0")
    longer = environment_agent("sac", "MountainCar-v0").training_params(params)
    assert longer.max_steps_in_episode == 1000 and params.max_steps_in_episode == 200
    assert environment_agent("sac", "Acrobot-v1").training_params(params) is params


def test_an_unknown_algorithm_has_no_settings():
    with pytest.raises(UserError, match="unknown algorithm 'tdd': did you mean td3"):
        environment_agent("tdd", "CartPole-v1")


def test_an_environment_without_a_setting_gets_ten_times_the_inner_loops_steps():
    assert (
        environment_agent("ppo", "CartPole-v1").config.total_steps == 10 * PPOConfig().total_steps
    )


def test_other_values_take_the_place_of_a_settings_own():
    own = environment_agent("ppo", "Pendulum-v1")
    shorter, small = own.with_steps(20_000), own.with_values(policy_output_scale=0.01)
    assert own.config.total_steps == 150_000
    assert shorter == replace(own, config=replace(own.config, total_steps=20_000))
    numbers = replace(own.hyperparameters, policy_output_scale=0.01)
    assert small == replace(own, hyperparameters=numbers)
    assert own.with_steps(None).with_values(policy_output_scale=None) == own


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"policy_output_scale": -1.0},
            "policy_output_scale has the value -1.0: it must be 0 or larger",
        ),
        ({"learning_rate": math.inf}, "learning_rate has the value inf, which is no number"),
        ({"discount": math.nan}, "discount has the value nan, which is no number"),
        ({"discount": 3.0}, "discount has the value 3.0: it must be between 0 and 1"),
        ({"polyak": 0.9}, "ppo has no polyak: known are num_envs, .*learning_rate"),
    ],
)
def test_values_that_cannot_be_are_refused(values, message):
    with pytest.raises(UserError, match=message):
        ppo({}).with_values(**values)


@pytest.mark.parametrize("steps", [0, -5])
def test_no_steps_are_refused(steps):
    with pytest.raises(UserError, match=f"^steps is {steps}: it must be at least 1.$"):
        ppo({}).with_steps(steps)


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
        # "(without 0.01 for continuous environments)" is read by itself.
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
    lists, classic = TABLES[algorithm]
    heading, *rows = table(f"tab:hyper_se_{algorithm}")
    listed, left_out = {}, {}
    for column, title in enumerate(heading[1:], 1):
        loop = bandit_agent(algorithm, "hopper" if title == "brax" else classic)
        for row in rows:
            if row[column] == "n.a.":
                continue
            values, fixed = value(row[column])
            if values is not None:
                listed[FIELDS[row[0]]] = tuple(values)
            without = re.search(r"without (\S+) for continuous", row[column])
            if without:
                left_out[FIELDS[row[0]]] = number(without[1])
            if fixed is not None:
                assert_field(loop, FIELDS[row[0]], fixed, (algorithm, title, row[0]))
    assert listed == lists
    if algorithm not in ("dqn", "ddqn"):
        continuous = {
            name: tuple(x for x in values if x != left_out.get(name))
            for name, values in listed.items()
        }
        assert bandit_agent(algorithm, "MountainCarContinuous-v0").lists == continuous
    assert len(rows) >= 12


@needs_paper
@pytest.mark.parametrize("algorithm", ["ppo", "sac", "ddpg", "td3"])
def test_the_brax_experts_are_the_papers_tables(algorithm):
    heading, *rows = table(f"tab:{algorithm}_expert_brax")
    names = [title.lower() for title in heading[1:]]
    settings = ALGORITHMS[algorithm].environments
    # Classic control has settings from elsewhere.
    assert set(names) == set(settings) & set(BRAX_NAMES) and len(names) == 5
    for column, name in enumerate(names, 1):
        for row in rows:
            assert len(row) == 6, row
            _, expected = value(row[column])
            assert_field(
                environment_agent(algorithm, name),
                FIELDS[row[0]],
                expected,
                (algorithm, name, row[0]),
            )
    assert len(rows) >= 12
