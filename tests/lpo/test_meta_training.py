"""Learning an objective: what a candidate is worth, and what it costs."""

import shutil
from dataclasses import replace
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpo import inner_loop
from lpo.fitness import FITNESSES, Fitness
from lpo.inner_loop import MetaTrainingConfig, TaskTraining, task_agent
from lpo.meta_training import MetaTraining, meta_train
from scb.agents.ppo import PPOConfig
from scb.agents.spec import environment_agent
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig
from scb.environments.synthetic_mdp import synthetic_for
from scb.environments.zoo import save_bandit
from scb.evaluation import Episodes
from scb.evolution import Outcome

PENDULUM = "Synthetic-Pendulum-v1"


# -- it learns ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(config) -> Outcome:
    return meta_train(config, quiet=True)


def check_run(config: MetaTrainingConfig, outcome: Outcome) -> list[float]:
    """Checks the log and that the mean has moved; returns every fitness."""
    start = config.drift.init(jax.random.key(0))
    assert jax.tree.map(np.shape, outcome.mean) == jax.tree.map(np.shape, start)
    assert [line["generation"] for line in outcome.metrics] == [0, 1]
    assert [line["failed"] for line in outcome.metrics] == [0, 0]
    names = ("fitness/mean", "fitness/max", "mean/fitness", "final_mean/fitness")
    values = [line[name] for line in outcome.metrics for name in names if name in line]
    # Two generations' mean and maximum, the mean's at the start and at the end.
    assert len(values) == 6
    assert np.all(np.isfinite(values))
    # evolve splits its seed in four and draws the start from the first.
    key_start = jax.random.split(jax.random.key(config.evolution.seed), 4)[0]
    initial = MetaTraining(config).initial_solution(key_start)
    for name, weights in outcome.mean.items():
        assert np.all(np.isfinite(weights))
        assert np.any(weights != np.asarray(initial[name]))
    return [float(value) for value in values]


# A step of Pendulum costs at most pi^2 + 0.1 * 8^2 + 0.001 * 2^2 = 16.3, and it takes 200.
WORST_PENDULUM_RETURN = -16.3 * 200


@pytest.mark.parametrize("fitness", ["return", pytest.param("area", marks=pytest.mark.slow)])
def test_fitness_in_the_bandit_is_the_reward_of_one_step(config, plain, fitness):
    config = replace(config, fitness=fitness)
    values = check_run(config, plain if fitness == "return" else meta_train(config, quiet=True))
    assert np.abs(values).max() < 100


def test_fitness_transfer_is_the_return_in_the_evaluation_environment(config):
    config = replace(config, fitness="transfer")
    values = check_run(config, meta_train(config, quiet=True))
    # 24 contexts make no swing-up.
    assert WORST_PENDULUM_RETURN < min(values) <= max(values) < -100


@pytest.mark.slow
def test_the_same_code_trains_on_the_environment_itself(config):
    # Two epochs: at the first update of a batch the ratio is 1, where all drifts are alike and all
    # candidates tie.
    agent = PPOConfig(
        num_envs=2, num_steps=10, num_epochs=2, num_minibatches=1, total_steps=20, hidden_sizes=(4,)
    )
    config = replace(config, tasks=("Pendulum-v1",), agent=agent)
    values = check_run(config, meta_train(config, quiet=True))
    assert WORST_PENDULUM_RETURN < min(values) <= max(values) < -100


@pytest.mark.parametrize(
    ("name", "value"),
    [
        # (1 + 2 + 6) / 3 = 3, and 27.25 with the untrained agent's 100.
        ("area", 3.0),
        ("worst", 1.0),
    ],
)
def test_area_is_the_mean_over_the_training_and_a_new_fitness_is_one_entry(
    config, monkeypatch, name, value
):
    worst = Fitness("worst", "worst point", along=True, of=lambda returns: returns.min())
    monkeypatch.setitem(FITNESSES, "worst", worst)

    class Recorded:
        def train_with_evaluations(self, *arguments):
            returns = jnp.array([[100.0], [1.0], [2.0], [6.0]])
            return None, {"return": Episodes(returns, returns)}

    problem = TaskTraining(replace(config, fitness=name, reward_noise=0.0), PENDULUM)
    problem.agent = Recorded()
    assert problem.fitness({}, jax.random.key(0), 1).tolist() == [value]


def test_a_fitness_says_which_actions_judge_and_where(config):
    seen = []

    class Recorded:
        def train(self, *arguments):
            return None

        def evaluate(self, state, key, episodes, env, env_params, mode, limit):
            seen.append((type(env).__name__, mode))
            return Episodes(*[jnp.full(episodes, -1.0)] * 2)

    for name in ("return", "return-sampled", "transfer"):
        problem = TaskTraining(replace(config, fitness=name, reward_noise=0.0), PENDULUM)
        problem.agent = Recorded()
        assert problem.fitness({}, jax.random.key(0), 1).tolist() == [-1.0]
    assert seen == [("SyntheticBandit", True), ("SyntheticBandit", False), ("Pendulum", True)]


# -- where it starts ----------------------------------------------------------------------------


def test_the_search_starts_near_the_base_but_not_at_zero(config):
    key = jax.random.key(4)
    start = MetaTraining(replace(config, reward_noise=0.0)).initial_solution(key)
    plain = config.drift.init(key)
    np.testing.assert_array_equal(start["hidden"], plain["hidden"])
    np.testing.assert_allclose(start["output"], 0.1 * plain["output"], rtol=1e-6)
    assert np.all(np.asarray(start["output"]) != 0.0)


def test_the_inner_loop_on_a_bandit_keeps_the_number_of_updates():
    # Pendulum's setting has 100 environments x 100 steps a batch and 150 000 steps: 15 batches.
    # With 200 contexts a batch, 15 batches are 3000 transitions, fifty times fewer.
    there, here = (
        task_agent(name, 200).config for name in ("Pendulum-v1", "Synthetic-Pendulum-v1")
    )
    assert (there.num_iterations, there.batch_size) == (15, 10_000)
    assert (here.num_iterations, here.batch_size) == (15, 200)
    for name in ("num_epochs", "num_minibatches", "hidden_sizes", "activation"):
        assert getattr(here, name) == getattr(there, name)


def test_the_inner_loop_on_a_synthetic_mdp_is_the_environments_own(tmp_path):
    env, params = make("Pendulum-v1")
    mdp = synthetic_for(env, params, "TI", BanditConfig(hidden_size=2), "mdp", None)
    path = tmp_path / "mdp.npz"
    told = {"config": {"evaluation_environment": "Pendulum-v1"}}
    save_bandit(path, mdp, mdp.init_weights(jax.random.key(0)), told)
    # Its episodes have many steps, of which batches of one would see the first few.
    assert task_agent(str(path), 200) == task_agent("Pendulum-v1", 200)


def test_a_renamed_bandit_is_trained_in_as_before(tmp_path):
    with resources.as_file(resources.files("scb") / "zoo") as folder:
        for end in ("npz", "json"):
            shutil.copy(folder / f"{PENDULUM}.{end}", tmp_path / f"mine.{end}")
    renamed = str(tmp_path / "mine.npz")
    assert task_agent(renamed, 200) == task_agent(PENDULUM, 200)
    config = MetaTrainingConfig(tasks=(renamed,), fitness="transfer")
    assert config.homes == config.judged_in == ("Pendulum-v1",)


@pytest.mark.parametrize("environment", ["Synthetic-Pendulum-v1", "Pendulum-v1"])
def test_hyperparameters_are_the_evaluation_environments_own(config, environment):
    # An objective is learned under the learning rate under which it will be used.
    problem = TaskTraining(replace(config, reward_noise=0.0), environment)
    assert problem.spec.hyperparameters == environment_agent("ppo", "Pendulum-v1").hyperparameters


def test_inner_agents_draw_from_the_lists_or_take_the_settings_own(config):
    class Echo:
        """An agent whose return is the sum of what it was trained with."""

        def train(self, key, hyperparameters, env_params):
            return hyperparameters

        def evaluate(self, state, *arguments, **named):
            total = state.learning_rate + state.entropy_coefficient
            return Episodes(jnp.array([total]), jnp.array([1]))

    def worth(**lists):
        problem = TaskTraining(replace(config, reward_noise=0.0, hyperparameters=lists), PENDULUM)
        problem.agent = Echo()
        return problem.fitness({}, jax.random.key(0), 50)

    both = worth(learning_rate=(1.0, 2.0), entropy_coefficient=(10.0, 20.0))
    assert set(both.tolist()) == {11.0, 12.0, 21.0, 22.0}
    # Dealt evenly: 25 agents have each value.
    assert float(both.sum()) == 25 * (1.0 + 2.0) + 25 * (10.0 + 20.0)
    # Pendulum's setting has a learning rate of 0.001 and an entropy coefficient of 0.01.
    np.testing.assert_allclose(worth(), 0.011, rtol=1e-6)


# -- what it costs ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "training", "evaluation"),
    [
        # 3 agents x 3 batches of 8 = 72; 3 agents x 5 episodes x 200 steps of Pendulum = 3000.
        ({"fitness": "transfer"}, 72, 3000),
        # In the bandit an episode is one step: 3 x 5 x 1.
        ({"fitness": "return"}, 72, 15),
        # 3 batches, evaluated before the first and after each: 3 x 4 points x 5.
        ({"fitness": "area"}, 72, 60),
        # Left open, it is 50 episodes of one step, or 20 of more: 3 x 50 x 1 and 3 x 20 x 200.
        ({"fitness": "return", "evaluation_episodes": None}, 72, 150),
        ({"fitness": "transfer", "evaluation_episodes": None}, 72, 12_000),
        ({"tasks": ("Pendulum-v1",), "fitness": "return"}, 72, 3000),
        ({"tasks": ("Pendulum-v1",), "fitness": "area"}, 72, 12_000),
        # Pendulum's image on the bandit: 3 agents x 15 batches of 50.
        ({"fitness": "return", "agent": None, "contexts": 50}, 2250, 15),
        # A fifth of 15 batches is 3, which divides them: 5 points and the start, 3 x 6 x 5.
        ({"fitness": "area", "agent": None, "contexts": 50}, 2250, 90),
    ],
)
def test_steps_of_a_candidate(config, changes, training, evaluation):
    changes = {"agents_per_candidate": 3, "evaluation_episodes": 5, "reward_noise": 0.0, **changes}
    steps = MetaTraining(replace(config, **changes)).steps()
    assert (steps.training, steps.evaluation) == (training, evaluation)
    assert steps.total == training + evaluation


def test_area_of_a_training_with_a_prime_number_of_batches_trains_no_more_of_them(config):
    # Nothing near a fifth of 13 divides it: three batches a point and one for the last, and the start.
    agent = replace(config.agent, total_steps=13 * 8)
    problem = MetaTraining(replace(config, fitness="area", agent=agent, reward_noise=0.0))
    steps = problem.steps()
    assert (steps.training, steps.evaluation) == (13 * 8, 6 * 2)


# -- several tasks -------------------------------------------------------------------------------


class Worth:
    """A task whose agents are worth what its number says, whatever trains them."""

    def __init__(self, number: float) -> None:
        self.number = number

    def fitness(self, candidate, key, number, horizon=1.0):
        return jnp.full(number, candidate["output"].sum() * self.number)


def test_every_task_gives_its_own_entries_of_fitness(config):
    problem = MetaTraining(replace(config, tasks=(PENDULUM, "Pendulum-v1"), agent=None))
    assert [task.env.name for task in problem.tasks.values()] == [PENDULUM, "Pendulum-v1"]
    problem.tasks = problem.judges = {"a": Worth(1.0), "b": Worth(-100.0)}
    problem.config = replace(config, agents_per_candidate=3)
    candidate = {"output": jnp.full((2, 1), 2.0)}
    result = problem.evaluate(candidate, jax.random.key(0), jnp.int32(0))
    assert result["fitness"].tolist() == [4.0] * 3 + [-400.0] * 3
    assert (float(result["fitness/a"]), float(result["fitness/b"])) == (4.0, -400.0)
    judged = problem.evaluate_mean(candidate, jax.random.key(0))
    assert {name: float(x) for name, x in judged.items()} == {
        "fitness": -198.0,
        "fitness/a": 4.0,
        "fitness/b": -400.0,
    }


def test_steps_of_several_tasks_are_the_sum_of_each(config):
    tasks = ("Synthetic-Pendulum-v1", "Synthetic-CartPole-v1")
    several = replace(config, tasks=tasks, agent=None, contexts=20)
    problem, alone = (
        MetaTraining(several),
        [MetaTraining(replace(several, tasks=(t,))) for t in tasks],
    )
    for steps in ("steps", "judgement_steps"):
        each = [getattr(one, steps)() for one in alone]
        assert getattr(problem, steps)().training == sum(x.training for x in each)
        assert getattr(problem, steps)().evaluation == sum(x.evaluation for x in each)


def test_tasks_have_keys_of_their_own(config, monkeypatch):
    def drawn(task, candidate, key, number, horizon=1.0):
        return jnp.full(number, jax.random.uniform(key))

    monkeypatch.setattr(TaskTraining, "fitness", drawn)
    tasks = ("Synthetic-Pendulum-v1", "Synthetic-CartPole-v1")
    problem = MetaTraining(replace(config, tasks=tasks, agent=None))
    one, other = problem.evaluate({}, jax.random.key(0), jnp.int32(0))["fitness"]
    assert one != other


@pytest.mark.slow
def test_tasks_of_other_shapes_learn_one_objective(config):
    # Three observations and a torque, four observations and two actions; ranks, since a pendulum
    # earns thousands below zero and a pole one a step.
    tasks = (PENDULUM, "Synthetic-CartPole-v1")
    evolution = replace(config.evolution, combine="ranks")
    several = replace(config, tasks=tasks, agent=None, contexts=20, evolution=evolution)
    outcome = meta_train(several, quiet=True)
    line = outcome.metrics[-1]
    assert {f"candidates/fitness/{task}" for task in tasks} <= set(line)
    assert {f"final_mean/fitness/{task}" for task in tasks} <= set(line)
    alone = [MetaTraining(replace(several, tasks=(task,))).steps() for task in tasks]
    assert MetaTraining(several).steps().total == sum(steps.total for steps in alone)
    # Two generations of two candidates.
    assert line["steps/total"] == 4 * sum(steps.total for steps in alone)


# -- validation ----------------------------------------------------------------------------------


def test_validation_judges_the_mean_on_the_environment_and_the_search_never_sees_it(
    config, plain, monkeypatch
):
    validated = replace(config, validation=True)
    short = environment_agent("ppo", "Pendulum-v1").with_values(
        num_envs=2, num_steps=10, total_steps=20, num_minibatches=2
    )
    monkeypatch.setattr(
        inner_loop,
        "task_agent",
        lambda name, contexts, own=task_agent: (
            short if name == "Pendulum-v1" else own(name, contexts)
        ),
    )
    outcome = meta_train(validated, quiet=True)
    for line, other in zip(outcome.metrics, plain.metrics, strict=True):
        assert line["fitness/mean"] == other["fitness/mean"]
        assert line["steps/total"] == other["steps/total"]
    judged = [outcome.metrics[0]["mean/fitness"], outcome.metrics[-1]["final_mean/fitness"]]
    # A pendulum that hangs, and not one reward of the bandit.
    assert WORST_PENDULUM_RETURN < min(judged) <= max(judged) < -100
    np.testing.assert_array_equal(outcome.mean["output"], plain.mean["output"])
    # An agent that judges: 20 steps, and 2 episodes of 200.
    steps = MetaTraining(validated).judgement_steps()
    assert (steps.training, steps.evaluation) == (20, 2 * 200)


def test_several_environments_validate_by_their_normalised_scores(config):
    tasks = (PENDULUM, "Synthetic-CartPole-v1")
    problem = MetaTraining(replace(config, tasks=tasks, agent=None, validation=True))
    assert list(problem.judges) == ["Pendulum-v1", "CartPole-v1"]
    assert problem.judges["CartPole-v1"].env.name == "CartPole-v1"
    zero, one = problem.scales["CartPole-v1"]
    assert 19.0 < zero < 26.0 and one == 500.0
    problem.judges = {"Pendulum-v1": Worth(-137.4), "CartPole-v1": Worth(zero)}
    # One agent at the expert's return, one at that of random actions: (1 + 0) / 2.
    judged = problem.evaluate_mean({"output": jnp.ones((1, 1))}, jax.random.key(0))
    assert float(judged["fitness"]) == pytest.approx(0.5, abs=1e-6)
