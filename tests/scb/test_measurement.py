"""Training and judging, once: numbers as before, rows that survive a kill, arrays out of them."""

import json
import random
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scb import measurement
from scb.agents.agent import evaluated_after
from scb.agents.drift import clipped_surrogate_drift
from scb.agents.ppo import DIAGNOSIS, PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec, environment_agent
from scb.errors import UserError
from scb.measurement import (
    Agents,
    Judge,
    Place,
    check_seeds,
    measure,
    spaced,
    train_and_judge,
)
from scb.population import map_population
from scb.rows import Rows, _description, pivot

# Seven batches of eight contexts, which have no divisor near three points: nine are trained.
CONFIG = PPOConfig(
    num_envs=8, num_steps=1, num_epochs=2, num_minibatches=2, total_steps=72, hidden_sizes=(4,)
)
SPEC = AgentSpec("ppo", CONFIG, PPOHyperparameters(learning_rate=0.03))
SEEDS = (3, 4, 5)


class Clip(NamedTuple):
    """PPO's clip as an objective."""

    name: str
    parameters: float
    drift: object = clipped_surrogate_drift


CLIPS = (Clip("ppo", 0.2), Clip("wide", 0.3))


@pytest.fixture(scope="module")
def bandit() -> Place:
    return Place.named("Synthetic-Pendulum-v1")


@pytest.fixture(scope="module")
def measured(bandit):
    """(path, the measurement into it): six agents of four points; bytes are not to be changed."""

    def again(path, agents=SEEDS, spec=SPEC, objectives=CLIPS, **changes):
        arguments = {"objectives": objectives, "points": 3, "episodes": 5, **changes}
        return measure(spec, bandit, agents=agents, rows=Rows(path), **arguments)

    return again


@pytest.fixture(scope="module")
def file(measured, tmp_path_factory):
    path = tmp_path_factory.mktemp("measured") / "rows.jsonl"
    rows = measured(path)
    return path, rows


@pytest.fixture
def copy(file, tmp_path):
    path, _ = file
    for suffix in (".jsonl", ".json"):
        (tmp_path / f"rows{suffix}").write_bytes(path.with_suffix(suffix).read_bytes())
    return tmp_path / "rows.jsonl"


def test_agents_earn_what_they_earned_before_there_was_one_measurement(file):
    # Recorded from `learning_curves` as it was, on these seeds.
    _, rows = file
    before = [
        [
            [1.9580097, 1.2264253, -0.9998045, 2.1975716],
            [-0.5916117, -0.076801, -3.010956, -0.4676509],
            [-5.3140559, 0.5298367, 2.0485418, 3.4786708],
        ],
        [
            [1.9580097, 1.2264253, -0.9954948, 2.2488105],
            [-0.5916117, -0.105544, -3.4801071, -0.4867207],
            [-5.3140559, 0.5298367, 2.0754659, 3.4736264],
        ],
    ]
    np.testing.assert_allclose(pivot(rows, "objective", "seed", "step"), before, rtol=1e-3)
    assert list(dict.fromkeys(row["step"] for row in rows)) == [0, 24, 48, 72]


def test_a_row_says_who_was_measured_where_and_how(file):
    _, rows = file
    assert len(rows) == 2 * 3 * 4
    row = dict(rows[-1])
    assert abs(row.pop("return") - 3.4736) < 0.01
    assert len(row.pop("configuration")) == 12
    assert row == {
        "environment": "Synthetic-Pendulum-v1",
        "backend": None,
        "trained_in": "Synthetic-Pendulum-v1",
        "algorithm": "ppo",
        "objective": "wide",
        "seed": 5,
        "agent": 0,
        "step": 72,
        "actions": "mode",
        "length": 1.0,
        "speed": None,
    }


def test_pandas_opens_the_rows_in_a_line(file):
    pandas = pytest.importorskip("pandas")
    path, rows = file
    table = pandas.read_json(path, lines=True)
    assert len(table) == len(rows)
    means = table.groupby(["objective", "step"])["return"].mean()
    np.testing.assert_allclose(
        means["wide"], pivot(rows, "objective", "seed", "step")[1].mean(axis=0)
    )


# -- a kill -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_killed_measurement_goes_on_to_the_same_bytes(file, copy, measured, seed):
    path, rows = file
    whole = path.read_bytes()
    # Anywhere: in the middle of a line, of an agent, or before the first.
    copy.write_bytes(whole[: random.Random(seed).randrange(len(whole))])
    assert measured(copy) == rows
    assert copy.read_bytes() == whole


def test_what_is_there_is_not_measured_again(file, copy, measured, monkeypatch):
    monkeypatch.delattr(measurement, "_program_of")
    assert measured(copy) == file[1]
    # Of fewer agents, or one objective, it is a part.
    assert measured(copy, SEEDS[1:], objectives=CLIPS[1:]) == [
        row for row in file[1] if row["objective"] == "wide" and row["seed"] > 3
    ]


def test_long_trainings_are_kept_as_they_come(copy, measured, file):
    copy.unlink()

    def kill(line):
        raise KeyboardInterrupt(line)

    # In the order of the objectives: three agents of "ppo" and one of "wide" in two pairs.
    with pytest.raises(KeyboardInterrupt, match="Synthetic-Pendulum-v1, ppo, wide: 2 of 6 agents"):
        measured(copy, side_by_side=2, tell=kill)
    assert len(copy.read_text().splitlines()) == 2 * 4
    np.testing.assert_allclose(
        pivot(measured(copy, side_by_side=2), "objective", "seed", "step"),
        pivot(file[1], "objective", "seed", "step"),
        rtol=1e-3,
    )


@pytest.mark.slow
def test_with_physics_different_drifts_share_a_program(bandit, monkeypatch):
    def square(parameters, log_ratio, advantage, progress):
        return parameters["factor"] * log_ratio**2

    objectives = [*CLIPS, Clip("square", {"factor": 2.0}, square)]

    def earned(place):
        programs = []

        def counted(*arguments):
            programs.append(arguments)
            return map_population(*arguments)

        monkeypatch.setattr(measurement, "map_population", counted)
        rows = measure(SPEC, place, bandit, SEEDS, objectives=objectives, episodes=5)
        return len(programs), pivot(rows, "objective", "seed")

    apart, expected = earned(bandit)
    together, found = earned(replace(bandit, backend="generalized"))
    assert (apart, together) == (2, 1)
    assert len({tuple(x) for x in np.round(expected, 3)}) == 3
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"episodes": 6}, "it differs at episodes (5 there, 6 now)"),
        (
            {"spec": AgentSpec("ppo", CONFIG, PPOHyperparameters(learning_rate=0.02))},
            "it differs at agent.hyperparameters.learning_rate (0.03 there, 0.02 now)",
        ),
        ({"objectives": (Clip("ppo", 0.1),)}, "hold another objective with the name ppo: give"),
    ],
)
def test_rows_of_another_configuration_are_refused(copy, measured, changes, difference):
    before = copy.read_bytes()
    with pytest.raises(UserError) as error:
        measured(copy, **changes)
    assert difference in str(error.value)
    assert copy.read_bytes() == before


def test_rows_of_another_evaluation_environment_are_refused(copy, measured, bandit):
    noisy = Place(bandit.name, bandit.env, bandit.params.replace(reward_noise=1.0))
    with pytest.raises(
        UserError, match=r"differs at judged_in\.reward_noise \(0\.0 there, 1\.0 now"
    ):
        measured(copy, judge_in=noisy)


def test_rows_from_before_the_evaluation_environment_was_written_down_are_taken(
    copy, file, measured, monkeypatch
):
    described, text = json.loads(copy.with_suffix(".json").read_text()), copy.read_text()
    for i, digest in enumerate(list(described)):
        del described[digest]["judged_in"]
        described[f"old {i}"] = described.pop(digest)
        text = text.replace(digest, f"old {i}")
    copy.with_suffix(".json").write_text(json.dumps(described))
    copy.write_text(text)
    monkeypatch.delattr(measurement, "_program_of")
    assert [row["return"] for row in measured(copy)] == [row["return"] for row in file[1]]


@pytest.mark.parametrize("content", ["[1]\n", "no rows\n", '{"a": 1}\n'])
def test_a_file_of_something_else_is_refused_and_stays(copy, content):
    copy.write_text(content)
    with pytest.raises(UserError, match="choose another file"):
        Rows(copy)
    assert copy.read_text() == content


def test_a_damaged_row_is_named_and_its_agent_is_measured_again_without_it(copy, file, measured):
    whole = copy.read_text().splitlines(keepends=True)
    copy.write_text("".join([whole[0], "{half\n", *whole[2:]]))
    with pytest.raises(UserError, match=r"line 2, is damaged .*: take the line out"):
        Rows(copy)
    copy.write_text("".join([whole[0], *whole[2:]]))
    returns = [[row["return"] for row in rows] for rows in (measured(copy), file[1])]
    np.testing.assert_allclose(*returns, rtol=1e-3)


@pytest.mark.parametrize("content", ["[]\n", "[1]\n", "{}\n", "no JSON\n"])
def test_rows_without_their_configurations_are_refused(copy, content):
    copy.with_suffix(".json").write_text(content)
    with pytest.raises(UserError, match="choose another file"):
        Rows(copy)


# -- agents -----------------------------------------------------------------------------------------


def test_a_diagnosed_training_is_the_same_and_its_rows_say_what_an_iteration_does(file, measured):
    still = replace(SPEC, hyperparameters=replace(SPEC.hyperparameters, learning_rate=0.0))
    for spec, quiet in (SPEC, False), (still, True):
        rows = measured(None, spec=spec, diagnose=True)
        for row in rows:
            assert (row["kl"] < 1e-6) == (row["outside"] == 0) == (abs(row["gain"]) < 1e-5) == quiet
            assert row["value_error"] > 0
        if not quiet:
            without = [{k: x for k, x in row.items() if k not in DIAGNOSIS} for row in rows]
            assert without == file[1]


def test_a_drift_that_is_a_function_is_the_same_in_another_process():
    def drift(*arguments):
        return 0.0

    one, other = (_description(x) for x in (drift, jax.nn.relu))
    assert one.endswith(
        "test_a_drift_that_is_a_function_is_the_same_in_another_process.<locals>.drift"
    )
    assert "0x" not in one + other


def test_agents_of_one_seed_share_out_what_is_drawn_and_their_rows_say_it(bandit):
    # As `lpo` judges a bandit: recorded from `judge` as it was.
    spec = AgentSpec(
        "ppo", CONFIG, PPOHyperparameters(), {"learning_rate": (0.001, 0.01)}
    ).with_values(total_steps=24)
    cartpole = Place.named("CartPole-v1")
    rows = measure(
        spec,
        Place.named("Synthetic-CartPole-v1"),
        cartpole,
        Agents.drawn_from(spec, seed=7, number=4),
        episodes=3,
        actions=("sampled", "mode"),
    )
    before = [[52.33, 17.33, 33.67, 33.0], [107.0, 9.67, 207.0, 51.33]]
    # A compiler's rounding makes an episode a step longer.
    np.testing.assert_allclose(pivot(rows, "actions", "agent"), before, rtol=0.05)
    # CartPole pays 1 a step.
    assert all(row["return"] == row["length"] for row in rows)
    rates = sorted(row["learning_rate"] for row in rows if row["actions"] == "mode")
    np.testing.assert_allclose(rates, [0.001, 0.001, 0.01, 0.01])


def test_rows_say_the_clip_that_was_drawn_where_no_objective_took_its_place(bandit):
    spec = AgentSpec("ppo", CONFIG, PPOHyperparameters(), {"drift": (0.1, 0.4)})
    agents = Agents.drawn_from(spec, seed=7, number=2)
    place = Place.named("CartPole-v1")
    size = {"episodes": 1, "points": 1}
    own = measure(spec, place, place, agents, **size)
    assert {round(row["drift"], 3) for row in own} == {0.1, 0.4}
    assert not any(
        "drift" in row for row in measure(spec, place, place, agents, objectives=CLIPS, **size)
    )


def test_a_traced_number_of_iterations_trains_as_long(bandit):
    agent = SPEC.agent(bandit.env)
    judge = Judge(bandit.env, bandit.params, episodes=2)

    @jax.jit
    def train(iterations):
        state, earned = train_and_judge(
            agent,
            SPEC.hyperparameters,
            jax.random.key(0),
            bandit.params,
            {"a": judge, "b": judge},
            iterations=iterations,
        )
        return state.iteration, earned

    iteration, earned = train(4)
    assert iteration == 4
    # One key for all judges.
    np.testing.assert_array_equal(earned["a"].returns, earned["b"].returns)
    assert earned["a"].returns.shape == (2,)


def test_agents_that_were_trained_under_other_physics_are_others(bandit, tmp_path):
    """Rows say where agents are judged; where they trained is in their configuration."""

    def trained(place):
        rows = Rows(tmp_path / "rows.jsonl")
        return measure(SPEC, place, bandit, agents=[0], episodes=5, rows=rows)

    first = trained(replace(bandit, backend="spring"))
    with pytest.raises(UserError, match=r"differs at physics \('spring' there, 'positional' now\)"):
        trained(replace(bandit, backend="positional"))
    assert trained(replace(bandit, backend="spring")) == first


def test_draws_of_another_number_are_others(bandit, tmp_path):
    # Agents share the values of a list out, so that the second of two is not the second of three.
    spec = replace(SPEC, lists={"learning_rate": (0.03, 0.01, 0.003)})

    def drawn(number):
        agents = Agents.drawn_from(spec, 0, number)
        rows = Rows(tmp_path / "rows.jsonl")
        return measure(spec, bandit, agents=agents, episodes=5, rows=rows)

    drawn(2)
    with pytest.raises(UserError, match=r"differs at drawn \(2 there, 3 now\)"):
        drawn(3)


def test_seeds_of_numpy_are_kept_as_numbers(measured, file, tmp_path):
    rows = measured(tmp_path / "rows.jsonl", agents=np.array(SEEDS))
    assert rows == file[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": []}, "no seeds: give at least one."),
        (
            {"agents": [0, -1]},
            "a seed is -1: each must be a whole number, 0 or larger, and below 2^32.",
        ),
        ({"agents": [2**32]}, "a seed is 4294967296"),
        ({"agents": [1.5]}, "a seed is 1.5: each must be a whole number"),
        ({"agents": ["1"]}, "a seed is 1: each must be a whole number"),
        ({"agents": [3, 4, 3]}, "seed 3 is there twice: give each once."),
        ({"actions": ("most likely",)}, "unknown kind of actions 'most likely'"),
        ({"actions": "modes"}, "unknown kind of actions 'modes': did you mean mode"),
        ({"spec": replace(SPEC, algorithm="sac")}, "of PPO's updates, and the algorithm is sac"),
        ({"points": 0}, "points is 0: it must be at least 1."),
        ({"episodes": 0}, "episodes is 0: it must be at least 1."),
        ({"side_by_side": 0}, "side_by_side is 0: it must be at least 1."),
    ],
)
def test_what_cannot_be_measured_is_refused(measured, tmp_path, changes, message):
    with pytest.raises(UserError) as error:
        measured(tmp_path / "rows.jsonl", **changes)
    assert message in str(error.value)


# -- arrays -----------------------------------------------------------------------------------------


def test_rows_become_arrays_in_the_order_of_the_rows():
    rows = [{"a": a, "b": b, "return": 10 * a + b} for a in (2, 1) for b in (0, 5)]
    assert pivot(rows, "a", "b").tolist() == [[20, 25], [10, 15]]
    assert pivot(rows, "b", "a").tolist() == [[20, 10], [25, 15]]
    assert np.isnan(pivot([{"a": 0, "return": None}], "a")).all()
    with pytest.raises(ValueError, match="not one for every combination of a, b"):
        pivot(rows[:3], "a", "b")
    with pytest.raises(ValueError, match="not one for every combination of a"):
        pivot(rows, "a")


# -- points -----------------------------------------------------------------------------------------


@given(iterations=st.integers(1, 500), points=st.integers(1, 50))
def test_points_are_about_as_many_as_asked(iterations, points):
    judged = len(evaluated_after(iterations, spaced(iterations, points))) - 1
    asked = min(points, iterations)
    assert asked / 2 <= judged <= 2 * asked


@pytest.mark.parametrize(
    ("iterations", "points", "expected"),
    [
        (15, 15, 1),
        (150, 15, 10),
        # 16 gives 16, 8, 4, 2 or 1 points; 16 is nearest to 15.
        (16, 15, 1),
        # 7 gives 7 or 1, both too far from 3: two iterations a point, and one for the last.
        (7, 3, 2),
        (97, 15, 6),
        (5120, 15, 320),
    ],
)
def test_points_of_some_trainings(iterations, points, expected):
    assert spaced(iterations, points) == expected


def test_a_training_is_as_long_as_asked_wherever_its_points_lie():
    spec = environment_agent("ppo", "Pendulum-v1").with_values(
        num_steps=2, num_envs=1, num_minibatches=1
    )
    rows = measure(
        spec.with_steps(14), Place.named("Pendulum-v1"), agents=[0], points=3, episodes=1
    )
    assert [row["step"] for row in rows] == [0, 4, 8, 12, 14]


def test_a_configuration_can_be_read(file):
    path, rows = file
    configurations = json.loads(path.with_suffix(".json").read_text())
    assert set(configurations) == {row["configuration"] for row in rows}
    for configuration in configurations.values():
        assert configuration["episodes"] == 5
        assert configuration["agent"]["config"]["total_steps"] == 72


def test_rows_in_memory_refuse_another_configuration_too():
    rows = Rows()
    row = {"environment": "e", "configuration": "", "seed": 0, "agent": 0, "return": 1.0}
    digest = rows.cell({"environment": "e"}, {"a": 1}, 1).digest
    rows.add([row | {"configuration": digest}])
    with pytest.raises(UserError, match="the rows were measured under another configuration"):
        rows.cell({"environment": "e"}, {"a": 2}, 1)


@pytest.mark.parametrize("seeds", [range(2), np.arange(2), jnp.arange(2), [0.0, 1.0]])
def test_seeds_of_any_kind_become_pythons_integers(seeds):
    found = check_seeds(seeds)
    assert found == [0, 1] and {type(x) for x in found} == {int}


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("seed", [0]),
        ("agent", {"x": 1}),
        ("step", 1.5),
        ("step", True),
        ("return", "much"),
        ("length", [1.0]),
        ("actions", 3),
        ("configuration", ["a"]),
    ],
)
def test_a_column_of_another_kind_is_a_damaged_row(copy, column, value):
    lines = copy.read_text().splitlines(keepends=True)
    row = json.loads(lines[1]) | {column: value}
    copy.write_text("".join([lines[0], json.dumps(row) + "\n", *lines[2:]]))
    with pytest.raises(UserError, match=rf"line 2, is damaged \({column} is .*: take the line out"):
        Rows(copy)


def test_a_point_that_is_there_twice_in_place_of_another_is_measured_again(copy, file, measured):
    lines = copy.read_text().splitlines(keepends=True)
    copy.write_text("".join([lines[1], *lines[1:]]))
    points = [(row["seed"], row["step"], row["objective"]) for row in measured(copy)]
    assert points == [(row["seed"], row["step"], row["objective"]) for row in file[1]]


def test_rows_without_their_step_are_refused(copy):
    lines = copy.read_text().splitlines(keepends=True)
    row = {k: x for k, x in json.loads(lines[0]).items() if k != "step"}
    copy.write_text("".join([json.dumps(row) + "\n", *lines[1:]]))
    with pytest.raises(UserError, match="holds no rows of a measurement"):
        Rows(copy)
