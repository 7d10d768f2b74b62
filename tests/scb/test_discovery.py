from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from scb.agents.dqn import DQNConfig
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec, algorithms_for, bandit_agent
from scb.analysis.optimal_actions import optimal_actions, optimal_policy
from scb.configurations import config_dict
from scb.curriculum import CurriculumConfig, paper_curriculum
from scb.discovery import (
    BanditDiscovery,
    DiscoveryConfig,
    discover,
)
from scb.environments.registry import EnvironmentSpec, environment_spec, make
from scb.environments.synthetic import BanditConfig, SyntheticBandit, bandit_for
from scb.environments.zoo import (
    PREFIX,
    bandit_metadata,
    load_bandit,
    save_bandit,
    zoo_names,
)
from scb.errors import UserError
from scb.evaluation import Episodes, evaluate
from scb.evolution import EvolutionConfig, evaluated
from scb.fitting import standardize_reward
from scb.judgement import check_fits, judge
from scb.keys import named_key, split_key
from scb.linear_expert import erring, noisy
from scb.listing import found
from scb.measurement import Place
from scb.population import map_population
from scb.runs import Run
from scb.statistics import iqm
from scb.warm_start import WarmStartConfig
from tests.scb.probes import Corridor, CorridorParams

TINY = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=1, num_minibatches=1, total_steps=20, hidden_sizes=(4,)
)
# 8 random steps, then 4 of two environments side by side: 16.
TINY_DQN = DQNConfig(
    num_envs=2, buffer_size=16, prefill=8, batch_size=4, total_steps=16, hidden_sizes=(4,)
)
CONFIG = DiscoveryConfig(
    environment="CartPole-v1",
    bandit=BanditConfig(hidden_size=4),
    configs={"ppo": asdict(TINY), "dqn": asdict(TINY_DQN)},
    agents_per_candidate=3,
    evaluation_episodes=2,
    init="random",
    evolution=EvolutionConfig(
        population_size=4, num_generations=2, mean_evaluations=2, evaluate_mean_every=1
    ),
)


def flat(weights):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(weights)])


def shapes(weights):
    return {
        f"{network}/{layer}/{name}": array.shape
        for network, layers in weights.items()
        for layer, arrays in layers.items()
        for name, array in arrays.items()
    }


# -- a bandit that stands for an environment
# ----------------------------------------------------------


def two_cell_bandit():
    """Contexts are the two cells, one-hot; action 1 pays 1 in cell 0 and action 0 in cell 1.

    initial_state: the identity of a categorical latent. reward: relu(c0 + a1 - 1) + relu(c1 + a0 -
      1).
    """
    weights = {
        "initial_state": {
            "Dense_0": {"kernel": jnp.eye(2), "bias": jnp.zeros(2)},
            "Dense_1": {"kernel": jnp.eye(2), "bias": jnp.zeros(2)},
        },
        "reward": {
            "Dense_0": {
                "kernel": jnp.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]]),
                "bias": -jnp.ones(2),
            },
            "Dense_1": {"kernel": jnp.ones((2, 1)), "bias": jnp.zeros(1)},
        },
    }
    config = BanditConfig(hidden_size=2, activation="relu", latent="categorical")
    return SyntheticBandit(2, spaces.Discrete(2), config, weights)


def test_agents_trained_in_a_bandit_do_in_the_environment_what_the_bandit_rewards():
    # A corridor of two cells where action 1 pays 1 in cell 0 and action 0 in cell 1: the bandit's
    # own optimum earns 2, that of the bandit with its sign turned 0, and chance 1.
    bandit = two_cell_bandit()
    good = bandit.default_params.weights
    turned = {**good["reward"]["Dense_1"], "kernel": -good["reward"]["Dense_1"]["kernel"]}
    bad = {**good, "reward": {**good["reward"], "Dense_1": turned}}
    corridor = CorridorParams(rewards=jnp.array([[0.0, 1.0], [1.0, 0.0]]), last=1)
    config = replace(TINY, num_steps=64, num_epochs=4, num_minibatches=4, total_steps=128 * 20)
    spec = AgentSpec("ppo", config, PPOHyperparameters(learning_rate=0.02))
    place = Place("corridor", Corridor(cells=2), corridor)
    for weights, best in ((good, 2.0), (bad, 0.0)):
        returns = judge(spec, bandit, weights, place, 0, num_agents=8, num_episodes=4, mode=True)
        np.testing.assert_array_equal(returns["mode_actions"], best)


def worth(name, sampled=True, **size):
    """[N] returns of PPO agents of a bandit of the zoo, on seeds that were not reported."""
    metadata = bandit_metadata(name)
    target, physics = name.removeprefix(PREFIX), metadata["config"].get("backend")
    bandit, params = make(name)
    place, spec = Place.named(target, physics), bandit_agent("ppo", target, sampled)
    returns = judge(spec, bandit, params.weights, place, seed=123_456, mode=False, **size)
    return returns["sampled_actions"]


@pytest.mark.slow
def test_agents_of_the_zoos_pendulum_bandit_swing_the_pendulum_up():
    # The paper's inner loop in full. A random policy earns -1230; the entry says -229 [-361, -176].
    assert worth("Synthetic-Pendulum-v1", sampled=False, num_agents=2, num_episodes=4).min() > -400


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo_names())
def test_a_bandit_of_the_zoo_is_worth_what_it_says(name):
    # Within the reported interval, widened by its own width.
    said = bandit_metadata(name)["results"]["PPO"]
    claimed = said["sampled_actions"]
    measured = iqm(worth(name, num_agents=said["agents"], num_episodes=said["episodes"]))
    width = claimed["high"] - claimed["low"]
    assert claimed["low"] - width <= measured <= claimed["high"] + width


# -- a discovery
# --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def discovered():
    return discover(CONFIG, quiet=True)


def test_a_discovery_ends_with_weights_of_its_bandit(discovered):
    problem, outcome = discovered
    assert problem.bandit.name == "Synthetic-CartPole-v1"
    assert shapes(outcome.mean) == shapes(outcome.best_mean) == problem.bandit.weight_shapes()
    assert len(outcome.metrics) == 2
    for line in outcome.metrics:
        # CartPole pays 1 a step until the pole falls, after 500 at most.
        assert 8 <= line["fitness/min"] <= line["fitness/max"] <= 500
        assert line["failed"] == 0


def test_a_discovered_bandit_is_saved_and_loaded(discovered, tmp_path):
    problem, outcome = discovered
    path = save_bandit(tmp_path / "Synthetic-CartPole-v1", problem.bandit, outcome.mean)
    bandit = load_bandit(path)
    np.testing.assert_array_equal(flat(bandit.default_params.weights), flat(outcome.mean))
    check_fits(bandit, problem.place)


@pytest.mark.parametrize("select", ["final", "best"])
def test_what_a_discovery_saves_says_how_it_was_found(discovered, tmp_path, select):
    problem, outcome = discovered
    if select != problem.config.select:
        problem = BanditDiscovery(replace(problem.config, select=select))
    chosen = outcome.best_mean if select == "best" else outcome.mean
    # Its file may have any name.
    path = problem.save(tmp_path / "mine.npz", outcome)
    np.testing.assert_array_equal(flat(load_bandit(path).default_params.weights), flat(chosen))
    assert environment_spec(str(path)).evaluation_environment == "CartPole-v1"
    metadata = bandit_metadata(path)
    assert metadata["config"]["discovery"] == config_dict(problem.config)
    assert metadata["cost"]["environment_steps_training"] > 0
    assert metadata["config"]["started_from"] is None
    later = BanditDiscovery(replace(problem.config, start=str(path)))
    origin = later.described(outcome, "a test")["config"]["started_from"]
    assert origin["sha256"] == metadata["sha256"] and origin["command"] == "python"


def test_a_candidate_is_judged_by_the_return_of_every_agent(discovered):
    problem, outcome = discovered
    result = jax.eval_shape(problem.evaluate, outcome.mean, jax.random.key(0), jnp.int32(0))
    assert result["fitness"].shape == (3,)
    result = jax.eval_shape(problem.evaluate_mean, outcome.mean, jax.random.key(0))
    assert result["fitness"].shape == ()


def test_environment_steps_of_a_candidate(discovered):
    # 3 agents; 20 steps are rounded up to two batches of 2 x 8; 2 episodes of at most 500 steps
    # each.
    steps = discovered[0].steps()
    assert (steps.training, steps.evaluation) == (3 * 2 * 16, 3 * 2 * 500)


@pytest.mark.slow
def test_judging_is_of_the_same_agents_whatever_their_actions_and_of_others_for_another_seed(
    discovered, monkeypatch
):
    problem, outcome = discovered
    place = problem.place
    arguments = (problem.specs["ppo"], problem.bandit, outcome.mean, place)
    size = {"num_agents": 5, "num_episodes": 2}
    both = judge(*arguments, 1, **size)
    assert set(both) == {"sampled_actions", "mode_actions"}
    assert (both["sampled_actions"] != both["mode_actions"]).any()
    for mode, name in ((False, "sampled_actions"), (True, "mode_actions")):
        alone = judge(*arguments, 1, mode=mode, **size)
        assert alone.keys() == {name}
        np.testing.assert_array_equal(alone[name], both[name])
    # Other agents, in a program that is there already: nothing is traced again.
    monkeypatch.delattr("scb.measurement.train_and_judge")
    other = judge(*arguments, 2, **size)
    for actions, returns in other.items():
        assert returns.shape == (5,)
        assert (returns != both[actions]).any() and len(set(returns)) > 1


# -- several algorithms
# -------------------------------------------------------------------------------

ALL = replace(CONFIG, algorithms=("ppo", "dqn"), mode="all")
# Repetition gives turns: two of three generations are PPO's.
SEQUENTIAL = replace(
    CONFIG,
    algorithms=("ppo", "dqn", "ppo"),
    mode="sequential",
    evolution=replace(
        CONFIG.evolution, num_generations=5, evaluate_mean_every=10, checkpoint_every=2
    ),
)
TURNS = ["ppo", "dqn", "ppo", "ppo", "dqn"]


def candidates(line):
    """{algorithm: mean return} that one generation's line of the log names."""
    prefix = "candidates/fitness/"
    return {k.removeprefix(prefix): v for k, v in line.items() if k.startswith(prefix)}


@pytest.fixture(scope="module")
def trained_by_all():
    return discover(ALL, quiet=True)


@pytest.mark.slow
def test_in_the_mode_all_every_agent_of_every_algorithm_is_a_task(trained_by_all):
    problem, outcome = trained_by_all
    evaluate = jax.jit(problem.evaluate)
    results = evaluate(outcome.mean, jax.random.key(0), jnp.int32(0))
    # 3 agents of each of 2 algorithms; PPO's first.
    assert results["fitness"].shape == (6,)
    assert float(results["fitness/ppo"]) == pytest.approx(float(results["fitness"][:3].mean()))
    assert float(results["fitness/dqn"]) == pytest.approx(float(results["fitness"][3:].mean()))
    # As many agents of each: the whole mean is the mean of the two.
    for line in outcome.metrics:
        means = candidates(line)
        assert means.keys() == {"ppo", "dqn"}
        assert line["fitness/mean"] == pytest.approx(sum(means.values()) / 2, rel=1e-5)
        judged = [line[f"mean/fitness{name}"] for name in ("", "/ppo", "/dqn")]
        assert judged[0] == pytest.approx((judged[1] + judged[2]) / 2, rel=1e-5)


@pytest.mark.slow
def test_the_first_algorithms_agents_are_the_same_whoever_else_is_trained(trained_by_all):
    problem, outcome = trained_by_all
    alone = BanditDiscovery(CONFIG)
    key = jax.random.key(4)
    with_others, by_itself = (
        jax.jit(p.evaluate)(outcome.mean, key, jnp.int32(0))["fitness"] for p in (problem, alone)
    )
    np.testing.assert_array_equal(with_others[:3], by_itself)


@pytest.fixture(scope="module")
def trained_in_turns(tmp_path_factory):
    run = Run.open(tmp_path_factory.mktemp("sequential") / "run", config_dict(SEQUENTIAL))
    return run.folder, *discover(SEQUENTIAL, run, quiet=True)


@pytest.mark.slow
def test_in_the_mode_sequential_a_generation_trains_the_algorithm_whose_turn_it_is(
    trained_in_turns,
):
    _, problem, outcome = trained_in_turns
    assert [list(candidates(line)) for line in outcome.metrics] == [[name] for name in TURNS]
    for line, name in zip(outcome.metrics, TURNS, strict=True):
        # Its agents are the only ones, so the fitness is their mean return.
        assert candidates(line)[name] == pytest.approx(line["fitness/mean"], rel=1e-5)
    # A generation does what a search with that algorithm alone does.
    key, evaluate = jax.random.key(3), jax.jit(problem.evaluate)
    for name, generation in (("dqn", 1), ("ppo", 2), ("dqn", 7)):
        alone = BanditDiscovery(replace(CONFIG, algorithms=(name,)))
        expected = jax.jit(alone.evaluate)(outcome.mean, key, jnp.int32(0))["fitness"]
        assert expected.shape == (3,)
        actual = evaluate(outcome.mean, key, jnp.int32(generation))["fitness"]
        np.testing.assert_array_equal(actual, expected)


def test_in_the_mode_sequential_the_others_are_not_run():
    # The turn stays a branch over a population; as a choice of results it would run all of them.
    problem = BanditDiscovery(SEQUENTIAL)
    start = problem.initial_solution(jax.random.key(0))
    population = jax.tree.map(lambda x: np.stack([x, x]), start)
    evaluate = jax.vmap(problem.evaluate, in_axes=(0, None, None))
    program = jax.make_jaxpr(evaluate)(population, jax.random.key(0), jnp.int32(0))
    branches = [
        equation.params["branches"]
        for equation in program.eqns
        if equation.primitive.name == "cond"
    ]
    # One for each algorithm, however many turns it has.
    assert [len(of_turn) for of_turn in branches] == [2]


@pytest.mark.slow
def test_an_optimal_policy_counts_in_a_judgement_as_in_the_generations_of_a_search(discovered):
    _, outcome = discovered
    config = replace(ALL, agents_per_candidate=3, optimal_policy_episodes=2)
    # Beside three agents of each of two algorithms, and beside three of the one whose turn it is.
    for mode, share in (("all", 1 / 7), ("sequential", 1 / 4)):
        problem = BanditDiscovery(replace(config, mode=mode))
        judged = jax.jit(problem.evaluate_mean)(outcome.mean, jax.random.key(5))
        agents = (judged["fitness/ppo"] + judged["fitness/dqn"]) / 2
        expected = (1 - share) * agents + share * judged["fitness/optimal policy"]
        assert float(judged["fitness"]) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.slow
def test_in_the_mode_sequential_the_mean_is_judged_by_every_algorithm(trained_in_turns):
    judged = trained_in_turns[2].metrics[0]
    both = judged["mean/fitness/ppo"] + judged["mean/fitness/dqn"]
    assert judged["mean/fitness"] == pytest.approx(both / 2, rel=1e-5)


# -- the optimal policy
# -------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["all", pytest.param("sequential", marks=pytest.mark.slow)])
def test_a_candidates_own_optimal_policy_is_one_more_task(discovered, mode):
    _, outcome = discovered
    config = replace(CONFIG, mode=mode, agents_per_candidate=3, optimal_policy_episodes=2)
    problem, without = (
        BanditDiscovery(c) for c in (config, replace(config, optimal_policy_episodes=0))
    )
    key, place = jax.random.key(5), problem.place
    made, agents = (
        jax.jit(p.evaluate)(outcome.mean, key, jnp.int32(0)) for p in (problem, without)
    )
    np.testing.assert_array_equal(made["fitness"][:-1], agents["fitness"])
    # It has the generation's own start states, and what it earns is no agent's.
    policy = optimal_policy(problem.bandit, problem.bandit.params(outcome.mean))
    episodes = evaluate(place.env, place.params, policy, named_key(key, "optimal policy"), 2)
    assert made["fitness"][-1] == made["fitness/optimal policy"] == episodes.returns.mean()
    judged = jax.jit(problem.evaluate_mean)(outcome.mean, key)
    both = 3 * judged["fitness/ppo"] + judged["fitness/optimal policy"]
    assert float(judged["fitness"]) == pytest.approx(float(both) / 4, rel=1e-6)
    # It trains nothing, and CartPole's episodes have 500 steps at most.
    for steps in ("steps", "judgement_steps"):
        more, fewer = (getattr(p, steps)() for p in (problem, without))
        assert (more.training, more.evaluation) == (fewer.training, fewer.evaluation + 2 * 500)


@pytest.mark.slow
def test_an_optimal_policy_errs_in_every_episode_by_another_function():
    config = replace(
        CONFIG, environment="Pendulum-v1", agents_per_candidate=1, optimal_policy_episodes=3
    )
    found, key = [], jax.random.key(6)
    for errors in (0.0, 1e-3, 3.0):
        problem = BanditDiscovery(replace(config, optimal_policy_errors=errors))
        weights = problem.bandit.init_weights(jax.random.key(1))
        found.append(
            jax.jit(problem.evaluate)(weights, key, jnp.int32(0))["fitness/optimal policy"]
        )
    none, small, large = found
    place, bandit = problem.place, problem.bandit
    best, space = optimal_actions(bandit, bandit.params(weights)), bandit.action_space()
    for scale, expected in ((1e-3, small), (3.0, large)):
        returns = []
        for of_episode in split_key(named_key(key, "optimal policy"), 3):
            errs = erring(best, bandit.observation_size, space, scale, of_episode)
            act = noisy(errs, space, 0.0)  # within the bounds
            returns += [*evaluate(place.env, place.params, act, of_episode, 1).returns]
        assert float(np.mean(returns)) == pytest.approx(float(expected), rel=1e-3)
        assert len(set(map(float, returns))) == 3
    assert none != small != large


def test_errors_are_of_an_optimal_policys_continuous_actions():
    with pytest.raises(UserError, match="the optimal policy has no episodes"):
        replace(CONFIG, optimal_policy_errors=0.1)
    config = replace(CONFIG, optimal_policy_episodes=1, optimal_policy_errors=0.1)
    with pytest.raises(UserError, match="those of CartPole-v1 are discrete: leave them out"):
        BanditDiscovery(config)


def test_a_synthetic_mdp_has_no_optimal_policy_to_judge():
    with pytest.raises(UserError, match="leave optimal_policy_episodes out"):
        replace(CONFIG, parameterization="TI", optimal_policy_episodes=1)


class Killed(BaseException):
    """A kill: nothing in the code may catch it."""


class KilledRun(Run):
    """Dies in generation 2, whose turn is PPO's second; generation 1 has the newest checkpoint."""

    def log(self, generation, metrics, seconds):
        super().log(generation, metrics, seconds)
        if generation == 2:
            raise Killed


@pytest.mark.slow
def test_a_resumed_sequential_search_ends_with_the_same_bytes(trained_in_turns, tmp_path):
    whole, _, outcome = trained_in_turns
    run = KilledRun.open(tmp_path / "run", config_dict(SEQUENTIAL))
    with pytest.raises(Killed):
        discover(SEQUENTIAL, run, quiet=True)
    run.close()
    run = Run.open(tmp_path / "run", config_dict(SEQUENTIAL), resume=True)
    _, resumed = discover(SEQUENTIAL, run, quiet=True)
    assert flat(resumed.mean).tobytes() == flat(outcome.mean).tobytes()
    logs = [(folder / "metrics.jsonl").read_bytes() for folder in (whole, tmp_path / "run")]
    assert logs[0] == logs[1]


def test_the_steps_of_several_algorithms_are_counted():
    # A PPO agent takes 2 batches of 2 x 8 = 32 steps, a DQN agent 16; each is evaluated for 2 episodes
    # of at most 500. All: 3 agents of each. Sequential: 3 of PPO, DQN and PPO in turn.
    steps = BanditDiscovery(ALL).steps()
    assert (steps.training, steps.evaluation) == (3 * (32 + 16), 2 * 3 * 2 * 500)
    problem = BanditDiscovery(SEQUENTIAL)
    turns = [problem.steps(generation) for generation in range(4)]
    assert [steps.training for steps in turns] == [3 * 32, 3 * 16, 3 * 32, 3 * 32]
    assert {steps.evaluation for steps in turns} == {3 * 2 * 500}


@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "MountainCarContinuous-v0"])
def test_an_empty_list_stands_for_the_papers_algorithms(environment):
    problem = BanditDiscovery(replace(CONFIG, environment=environment, algorithms=()))
    expected = algorithms_for(problem.place.env.action_space(problem.place.params))
    assert problem.config.algorithms == expected
    assert tuple(problem.specs) == expected


# -- curricula
# ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_curriculum_is_one_program_whose_horizon_is_traced():
    # CartPole pays 1 a step and no pole falls within 3 steps, so a return is the horizon: linear
    # from 1 to 3 within 2 generations.
    config = replace(CONFIG, curriculum=CurriculumConfig("linear", 1, 3, begin=0, transition=2))
    problem = BanditDiscovery(config)
    traces = []

    def evaluate(candidate, key, generation):
        traces.append(generation)
        return problem.evaluate(candidate, key, generation)["fitness"]

    population = map_population(evaluate, 2, (0, None, None))
    weights = problem.bandit.init_weights(jax.random.key(0))
    weights = jax.tree.map(lambda x: jnp.stack([x, x]), weights)
    for generation, expected in enumerate([1.0, 2.0, 3.0, 3.0]):
        fitness = population(weights, jax.random.key(1), jnp.int32(generation))
        np.testing.assert_array_equal(fitness, np.full((2, 3), expected))
    assert len(traces) == 1
    # Three agents of each candidate, two episodes of each; the mean is judged in the environment as it is.
    assert [problem.steps(g).evaluation for g in range(4)] == [6 * 1, 6 * 2, 6 * 3, 6 * 3]
    spent = evaluated(problem, replace(problem.config.evolution, population_size=5), 3)
    assert spent.evaluation == 5 * 6 * (1 + 2 + 3)
    mean = jax.tree.map(lambda x: x[0], weights)
    judged = jax.jit(problem.evaluate_mean)(mean, jax.random.key(2))
    assert judged["fitness"] >= 8


def test_the_papers_curriculum_raises_mountaincars_limit(monkeypatch):
    # MountainCar pays -1 a step until the goal. Who always pushes left never gets there: -200 within
    # its own limit, -1000 within the curriculum's longest episodes, -600 half-way.
    curriculum = paper_curriculum("MountainCar-v0")
    problem = BanditDiscovery(replace(CONFIG, environment="MountainCar-v0", curriculum=curriculum))
    assert problem.steps().evaluation == 3 * 2 * 1000
    assert problem.steps(500).evaluation == 3 * 2 * 600
    agent = problem.specs["ppo"].agent(problem.bandit)
    weights = problem.bandit.init_weights(jax.random.key(0))
    params = problem.bandit.params(weights)
    state = jax.jit(agent.init)(jax.random.key(1), PPOHyperparameters(), params)
    zeros = jax.tree.map(jnp.zeros_like, state.params["policy"])
    state = state.replace(params={**state.params, "policy": zeros})
    judges = []

    def record(agent, hyperparameters, key, params, of_it):
        judges.append(of_it["return"]._replace(mode=True))
        return None, {"return": Episodes(jnp.zeros(2), jnp.zeros(2))}

    monkeypatch.setattr("scb.discovery.train_and_judge", record)
    key = jax.random.key(2)
    problem.evaluate(weights, key, jnp.int32(0))
    problem.evaluate_mean(weights, key)
    along, mean = judges
    assert along.limit == 1000
    cut = jax.jit(lambda limit: along._replace(limit=limit)(agent, state, key))
    for limit in (1000, 600, 200):
        found = cut(jnp.int32(limit))
        np.testing.assert_array_equal(found.returns, -float(limit))
    whole = jax.jit(lambda: mean(agent, state, key))()
    np.testing.assert_array_equal(whole.returns, -200.0)


def test_a_curriculum_must_end_within_the_environments_limit():
    beyond = CurriculumConfig("linear", 10, 501)
    with pytest.raises(UserError, match=r"ends with episodes of 501 steps, .* at most 500"):
        BanditDiscovery(replace(CONFIG, curriculum=beyond))


# -- synthetic MDPs
# ------------------------------------------------------------------------------------


# The command line's test discovers a T every time.
@pytest.mark.slow
@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_a_synthetic_mdp_is_discovered_and_opens_as_an_environment(parameterization, tmp_path):
    config = replace(CONFIG, parameterization=parameterization, max_steps=5)
    problem, outcome = discover(config, quiet=True)
    networks = {"reward", "transition", "termination"}
    assert set(outcome.mean) == networks | (
        {"initial_state"} if parameterization == "TI" else set()
    )
    assert [line["failed"] for line in outcome.metrics] == [0, 0]
    assert shapes(outcome.mean) == problem.bandit.weight_shapes()
    metadata = {"config": {"evaluation_environment": "CartPole-v1"}}
    path = save_bandit(tmp_path / "mdp.npz", problem.bandit, outcome.mean, metadata)
    env, env_params = make(str(path))
    assert env.config.parameterization == parameterization
    assert env_params.max_steps_in_episode == 5
    np.testing.assert_array_equal(flat(env_params.weights), flat(outcome.mean))
    check_fits(env, problem.place)


def test_a_synthetic_mdp_lasts_as_long_as_the_environment_where_nothing_is_said():
    problem = BanditDiscovery(replace(CONFIG, parameterization="TI"))
    assert problem.bandit.config.max_steps == 500


# -- where a discovery starts
# -------------------------------------------------------------------------


def test_a_random_start_is_drawn_from_the_key():
    problem = BanditDiscovery(CONFIG)
    key = jax.random.key(3)
    start = problem.initial_solution(key)
    np.testing.assert_array_equal(flat(start), flat(problem.bandit.init_weights(key)))
    assert (flat(start) != flat(problem.initial_solution(jax.random.key(4)))).any()


@pytest.mark.slow
def test_an_expert_start_is_fitted_once_and_from_the_seed_alone(monkeypatch):
    spec = AgentSpec("ppo", TINY, PPOHyperparameters())
    monkeypatch.setattr("scb.warm_start.environment_agent", lambda algorithm, name: spec)
    # An expert of so few steps may earn less than random actions, which would be refused.
    monkeypatch.setattr(EnvironmentSpec, "random_return", lambda *arguments: 0.0)
    warm = WarmStartConfig(
        construction="q", expert="ppo", num_experts=2, num_states=16, horizon=3, fit_steps=20
    )
    problem = BanditDiscovery(replace(CONFIG, init="expert", warm_start=warm))
    start = problem.initial_solution(jax.random.key(3))
    assert shapes(start) == problem.bandit.weight_shapes()
    # A resumed run asks again, whatever its key: same weights.
    assert problem.initial_solution(jax.random.key(4)) is start
    report = problem.start_reports["warm_start"]
    assert set(report) == {
        "expert_return",
        "environment_steps",
        "seconds",
        "reward_r2",
        "energy_distance",
    }
    # Two experts of two batches of 2 x 8 steps, each judged by 20 episodes of at most 500, the better one by 20
    # more; 256 trajectories of 200 steps, and 16 states with 2 actions of 3 steps.
    experts = 2 * (2 * 16 + 20 * 500) + 20 * 500
    assert report["environment_steps"] == experts + 256 * 200 + 16 * 2 * 3
    assert 8 <= report["expert_return"] <= 500


def saved(folder, environment, **config):
    bandit = bandit_for(*make(environment), BanditConfig(**config), f"Synthetic-{environment}")
    weights = bandit.init_weights(jax.random.key(1))
    return save_bandit(folder / f"Synthetic-{environment}", bandit, weights), weights


def test_a_discovery_starts_from_a_bandit_in_a_file(discovered, tmp_path):
    path, weights = saved(tmp_path, "CartPole-v1", hidden_size=4)
    problem = BanditDiscovery(replace(CONFIG, start=str(path)))
    start = problem.initial_solution(jax.random.key(0))
    np.testing.assert_array_equal(flat(start), flat(weights))
    # Whose file does not say how it was found, as one of the published ones does not.
    metadata = problem.described(discovered[1], "a test")
    assert metadata["config"]["started_from"]["found"] == "elsewhere"
    assert found(metadata) == "elsewhere, evolved"


@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1"])
def test_the_starts_reward_can_be_standardized(environment):
    config = replace(CONFIG, environment=environment, configs={})
    plain, scaled = (
        BanditDiscovery(replace(config, reward_std=std)).initial_solution(jax.random.key(1))
        for std in (None, 8.0)
    )
    env, env_params = make(environment)
    bandit = bandit_for(env, env_params, BanditConfig(4), f"Synthetic-{environment}")
    keys, keys_action = jax.random.split(jax.random.key(2), (2, 5000))
    actions = jax.vmap(bandit.action_space().sample)(keys_action)
    rewards = []
    for weights in (plain, scaled):
        params = bandit.params(weights)
        contexts, _ = jax.vmap(bandit.reset_env, (0, None))(keys, params)
        rewards.append(
            np.asarray(jax.vmap(bandit.mean_reward, (0, 0, None))(contexts, actions, params))
        )
    # 5000 other samples know the mean to 8 / sqrt(5000) = 0.11 and the deviation to 1 %.
    assert abs(rewards[1].mean()) < 0.5
    assert rewards[1].std() == pytest.approx(8.0, rel=0.05)
    constant = {**plain, "reward": jax.tree.map(jnp.zeros_like, plain["reward"])}
    last = constant["reward"][max(constant["reward"])]
    last["bias"] = last["bias"] + 1.1
    with pytest.raises(UserError, match=r"is 1\.1 everywhere, and no factor gives it"):
        standardize_reward(bandit, constant, 8.0)
    # An affine function of the same reward in the same contexts.
    slope, offset = np.polyfit(rewards[0], rewards[1], 1)
    np.testing.assert_allclose(rewards[1], slope * rewards[0] + offset, atol=1e-3)
    assert slope > 0


@pytest.mark.parametrize(
    ("environment", "other", "message"),
    [
        (
            "CartPole-v1",
            {"hidden_size": 8},
            "has the hidden_size 8, and the bandit to discover 4: ask for 8",
        ),
        (
            "CartPole-v1",
            {"activation": "relu"},
            "has the activation relu, and the bandit to discover tanh",
        ),
        (
            "CartPole-v1",
            {"latent": "uniform"},
            "has the latent uniform, and the bandit to discover normal",
        ),
        ("CartPole-v1", {"latent_size": 2}, "has the latent_size 2, and the bandit to discover 4"),
        (
            "Acrobot-v1",
            {},
            r"bandit Synthetic-Acrobot-v1 has 6 observations and 3 discrete actions, CartPole-v1 has 4 "
            r"observations and 2 discrete actions: take the bandit of that environment",
        ),
    ],
)
def test_a_start_of_another_form_is_refused_at_once(tmp_path, environment, other, message):
    path, _ = saved(tmp_path, environment, **{"hidden_size": 4, **other})
    with pytest.raises(UserError, match=message):
        BanditDiscovery(replace(CONFIG, start=str(path)))


def test_a_bandit_fits_the_environments_of_its_shapes_only():
    cartpole = bandit_for(*make("CartPole-v1"), BanditConfig(), "a")
    check_fits(cartpole, Place.named("CartPole-v1"))
    for other in ("Pendulum-v1", "Acrobot-v1", "MountainCar-v0"):
        with pytest.raises(UserError, match=f"bandit a has 4 observations .*, {other} has "):
            check_fits(cartpole, Place.named(other))
    # Two numbers seen and three pushed: discrete or not, the number alone doesn't make it fit.
    box = SyntheticBandit(2, spaces.Box(-1.0, 1.0, (3,), jnp.float32), name="b")
    with pytest.raises(UserError, match="2 observations and 3 action dimensions, MountainCar-v0"):
        check_fits(box, Place.named("MountainCar-v0"))


# -- configuration
# ------------------------------------------------------------------------------------


def test_hyperparameters_are_drawn_from_the_papers_lists_or_fixed():
    sampled, fixed = (
        BanditDiscovery(replace(CONFIG, fixed_hyperparameters=fixed))
        .specs["ppo"]
        .sample(jax.random.key(0), 5)
        for fixed in (False, True)
    )
    np.testing.assert_array_equal(fixed.learning_rate, np.full(5, 5e-3, np.float32))
    # Five agents share the five learning rates out, 0.01 among them where actions are discrete.
    assert sorted(sampled.learning_rate.tolist()) == sorted(
        np.float32([0.01, 0.005, 0.001, 0.0005, 0.0001]).tolist()
    )


def test_own_lists_take_the_place_of_the_papers():
    lists = {"ppo": {"learning_rate": (0.25,), "discount": (0.5, 0.75)}}
    problem = BanditDiscovery(replace(ALL, lists=lists))
    own = problem.specs["ppo"].sample(jax.random.key(0), 4)
    np.testing.assert_array_equal(own.learning_rate, np.full(4, 0.25))
    assert sorted(own.discount.tolist()) == [0.5, 0.5, 0.75, 0.75]
    # What the lists leave out keeps its default, and an algorithm that they leave out the paper's.
    np.testing.assert_array_equal(own.gae_lambda, np.full(4, np.float32(0.95)))
    paper = bandit_agent("dqn", "CartPole-v1")
    assert problem.specs["dqn"].lists == paper.lists


def test_own_values_change_the_papers_configuration_and_leave_its_others():
    configs = {"ppo": {"num_steps": 20, "hidden_sizes": [8]}}
    problem = BanditDiscovery(replace(CONFIG, environment="Pendulum-v1", configs=configs))
    changed = PPOConfig(num_steps=20, hidden_sizes=(8,), activation="relu")
    assert problem.specs["ppo"].config == changed


def test_the_inner_loop_is_the_papers_where_no_agent_is_given():
    problem = BanditDiscovery(replace(CONFIG, environment="Pendulum-v1", configs={}))
    spec = problem.specs["ppo"]
    assert spec == bandit_agent("ppo", "Pendulum-v1")
    assert spec.config == PPOConfig(activation="relu")
    # 10 000 steps each, and 2 episodes of Pendulum's 200.
    assert problem.steps().training == 3 * 10_000
    assert problem.steps().evaluation == 3 * 2 * 200
    assert 0.01 not in spec.lists["learning_rate"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"init": "exprt"}, "unknown initialisation 'exprt': did you mean expert"),
        ({"agents_per_candidate": 0}, "agents_per_candidate is 0: it must be at least 1"),
        ({"evaluation_episodes": -1}, "evaluation_episodes is -1: it must be at least 1"),
        (
            {"environment": "Pendulum-v2"},
            "unknown environment 'Pendulum-v2': did you mean Pendulum",
        ),
        ({"start": "Synthetic-Pendulum"}, "unknown bandit 'Synthetic-Pendulum'"),
        ({"reward_std": 0.0}, "reward_std is 0.0: it must be positive, and finite."),
        ({"reward_std": float("inf")}, "reward_std is inf: it must be positive, and finite"),
        ({"reward_std": 1.0, "parameterization": "TI"}, "reward_std is for bandits, and"),
        ({"mode": "al"}, "unknown mode 'al': did you mean all"),
        ({"parameterization": "IT"}, "unknown parameterization 'IT': did you mean"),
        (
            {"parameterization": "T", "init": "expert"},
            "cannot be fitted to an expert, as is the def",
        ),
        ({"parameterization": "TI", "start": "x"}, "cannot start from a bandit: leave the start"),
        ({"max_steps": 5}, "max_steps is 5, and parameterization I has episodes of 1 step"),
        ({"algorithms": ("ppo", "ddpg")}, "ddpg does not fit the environment's discrete actions"),
        ({"algorithms": ("pop",)}, "unknown algorithm 'pop': did you mean ppo"),
        ({"algorithms": ("ppo", "ppo")}, "an algorithm stands twice in ppo, ppo: name each once"),
        (
            {"init": "expert", "warm_start": WarmStartConfig(expert="td3")},
            "td3 does not fit the environment's discrete actions",
        ),
        (
            {"lists": {"ppo": {"lr": (0.1,)}}},
            "unknown hyperparameter 'lr': known are learning_rate",
        ),
        ({"lists": {"ppo": {"discount": ()}}}, "for a list of values: give one or more numbers"),
        ({"lists": {"ppo": {"discount": (True,)}}}, "discount has the value True"),
        (
            {"lists": {"sac": {"discount": (0.9,)}}},
            "there are hyperparameter lists for sac, but the inner loop trains ppo",
        ),
        ({"algorithms": "ppo"}, "the algorithms are 'ppo', a text: give a tuple of names"),
        (
            {"lists": {"ppo": {"discount": (0.9,)}}, "fixed_hyperparameters": True},
            "fixed hyperparameters are not drawn from lists",
        ),
        (
            {
                "environment": "Pendulum-v1",
                "init": "expert",
                "bandit": BanditConfig(form="linear"),
                "warm_start": WarmStartConfig("q"),
            },
            "the construction is q, and a linear bandit's reward is a distance of actions",
        ),
    ],
)
def test_impossible_discoveries_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        BanditDiscovery(replace(CONFIG, **arguments))


@pytest.mark.slow
def test_a_folder_keeps_a_discovery_from_python(tmp_path):
    folder = tmp_path / "run"
    longer = replace(CONFIG, evolution=replace(CONFIG.evolution, num_generations=3))
    discover(replace(CONFIG, evolution=replace(CONFIG.evolution, num_generations=2)), folder, True)
    _, grown = discover(longer, str(folder), quiet=True)
    _, whole = discover(longer, quiet=True)
    jax.tree.map(np.testing.assert_array_equal, grown.mean, whole.mean)
    with pytest.raises(UserError, match=r"its config differs at config\.environment"):
        discover(replace(longer, environment="Acrobot-v1"), folder, quiet=True)


def test_a_search_with_the_papers_curriculum_does_not_grow():
    # It is stretched to the search's length.
    assert DiscoveryConfig(environment="MountainCar-v0", curriculum="paper").growing == ()
    assert DiscoveryConfig(curriculum="linear:10:20:1:2").growing == ("evolution.num_generations",)
    # For Pendulum it has none.
    assert DiscoveryConfig(curriculum="paper").growing == ("evolution.num_generations",)
