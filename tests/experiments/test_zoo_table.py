"""The table says what was measured, and nothing is measured twice."""

import json
from dataclasses import replace

import numpy as np
import pytest

import scb.agents.spec as specs
from experiments import zoo_table, zoo_table_page
from scb.agents.spec import bandit_agent
from scb.environments.registry import environment_spec, make
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.environments.zoo import load_bandit, save_bandit
from scb.errors import UserError
from scb.judgement import judge
from scb.measurement import Place
from scb.statistics import estimate, iqm

MACHINE = {"processor": "AMD EPYC", "cores": 2}


def entry(environment, algorithm, kind, mode, sampled, **changes):
    """A made-up entry with these agents' returns."""
    made = {
        "environment": environment,
        "algorithm": algorithm,
        "bandit": kind,
        "sha256": kind,
        "agents": len(mode),
        "episodes": 50,
        "seed": 10_000,
        "backend": None,
        "training_steps": 10_000,
        "inner_loop": algorithm,
    } | changes
    judge_in = Place(environment, None, None, made["backend"])
    for actions, returns in (("mode_actions", mode), ("sampled_actions", sampled)):
        made[actions] = zoo_table.summary(np.asarray(returns, float), judge_in)
    return made


def report(*entries):
    return {
        "experiment": "zoo_table",
        "commands": ["python -m experiments zoo_table"],
        "machine": MACHINE,
        "differences": zoo_table.differences(entries),
        "entries": list(entries),
    }


def row_of(text, environment, algorithm):
    """The cells of the first row of an environment and algorithm."""
    start = f"| {environment} | {algorithm} |"
    [line, *_] = [line for line in text.splitlines() if line.startswith(start)]
    return [cell.strip() for cell in line.strip("|").split("|")]


PENDULUM = report(
    # IQMs of four are the means of the middle two: -160 and -180, -200 and -210.
    entry("Pendulum-v1", "td3", "ours", [-170, -150, -900, -130], [-190, -170, -900, -130]),
    entry("Pendulum-v1", "td3", "published", [-210, -190, -950, -140], [-220, -200, -950, -150]),
)


def test_a_row_holds_the_measured_the_papers_and_the_target():
    cells = row_of(zoo_table.EXPERIMENT.page(PENDULUM), "Pendulum-v1", "TD3")
    values = [cell.split(" [")[0] for cell in cells[2:6]]
    assert values == ["−160.0", "−180.0", "−200.0", "−210.0"]
    # -160 is above the target of -170, -180 is not.
    assert cells[6:] == ["−168.5", "−170: yes / no"]


def test_the_difference_is_paired_and_signed():
    text = zoo_table.EXPERIMENT.page(PENDULUM).split("## Ours − published")[1]
    cells = row_of(text, "Pendulum-v1", "TD3")
    # -160 - -200 = 40 and -180 - -210 = 30.
    assert [cell.split(" [")[0] for cell in cells[2:]] == ["+40.00", "+30.00"]


def test_bandits_measured_differently_are_not_subtracted():
    ours, theirs = PENDULUM["entries"]
    assert len(zoo_table.differences([ours, theirs])) == 1
    for changed in ({"agents": 3}, {"episodes": 5}, {"seed": 1}, {"inner_loop": "other"}):
        assert zoo_table.differences([ours, theirs | changed]) == []


def test_an_agent_without_a_finite_return_counts_as_random_actions_and_is_told():
    made = entry("Pendulum-v1", "ppo", "ours", [np.nan, -4, -3, -2000], [-1, -2, -3, -4])
    # The NaN counts as what random actions earn, about -1200: it is next to the worst.
    random = environment_spec("Pendulum-v1").random_return()
    assert made["mode_actions"]["iqm"]["value"] == pytest.approx((random - 4) / 2)
    assert made["mode_actions"]["agents"] == [None, -4.0, -3.0, -2000.0]
    assert zoo_table_page.returns_of(made, "mode_actions") == [random, -4.0, -3.0, -2000.0]
    none = entry("Pendulum-v1", "ppo", "ours", [np.nan] * 2, [-1, -2])["mode_actions"]
    assert none == {"iqm": None, "failed": 2, "agents": [None, None]}
    text = zoo_table.EXPERIMENT.page(report(made))
    assert "PPO on Pendulum-v1 (ours, most likely actions): 1 of 4" in text


def test_the_page_says_how_many_episodes_and_which_physics():
    hopper = entry("hopper", "ppo", "ours", [1, 2, 3], [1, 2, 3], episodes=5, backend="generalized")
    text = zoo_table.EXPERIMENT.page(report(hopper, *PENDULUM["entries"]))
    prose = " ".join(text.split())
    assert "Classic control: hyperparameters drawn from the paper's lists, 50 episodes" in prose
    assert "Brax (generalized physics): the paper's fixed hyperparameters, 5 episodes" in prose
    rows = [line for line in text.splitlines() if line.startswith(("| Pendulum", "| hopper"))]
    assert rows[0].startswith("| Pendulum-v1")  # classic control comes first


def test_the_figure_draws_what_the_table_says():
    hopper = entry("hopper", "ppo", "ours", [1, 2, 3], [1, 2, 3], episodes=5, backend="generalized")
    drawn = zoo_table.EXPERIMENT.figures(report(*PENDULUM["entries"], hopper))["zoo_table"]
    pendulum, brax = drawn.axes
    assert brax.get_title(loc="left") == "hopper (generalized, 5 episodes)"
    points = {line.get_xdata()[0]: line for line in pendulum.lines if line.get_marker() in "os"}
    assert sorted(points) == pytest.approx([-210, -200, -180, -160])
    filled = {x for x, line in points.items() if line.get_markerfacecolor() != "white"}
    assert filled == {-160.0, -200.0}  # the most likely actions'
    # The paper's expert.
    assert any(list(line.get_xdata()) == [-137.4, -137.4] for line in pendulum.lines)
    [expected] = [e for e in PENDULUM["entries"] if e["bandit"] == "ours"]
    ends = [segment[:, 0].tolist() for c in pendulum.collections for segment in c.get_segments()]
    assert [expected["mode_actions"]["iqm"][end] for end in ("low", "high")] in ends


def test_brax_is_scored_between_random_actions_and_the_papers_best():
    spec = environment_spec("hopper")
    random, best = spec.random_return("generalized"), 3325.8  # TD3's
    half, brax = (random + best) / 2, {"backend": "generalized"}
    entries = [
        entry("hopper", "ppo", "ours", [random] * 3, [0] * 3, **brax),
        entry("hopper", "td3", "ours", [best] * 3, [0] * 3, **brax),
        entry("hopper", "td3", "published", [half] * 3, [0] * 3, **brax),
        entry("swimmer", "td3", "published", [0, None, 9], [0] * 3, **brax),
        entry("hopper", "td3", "ours", [9e9] * 3, [0] * 3, backend="spring"),
        *PENDULUM["entries"],
    ]
    found = zoo_table_page.brax_scores(entries)
    values = {(name, kind): x.value for name, kinds in found.items() for kind, x in kinds.items()}
    # The swimmer has no bandit of ours: it is left out of the last row.
    assert list(found) == ["hopper", "swimmer", zoo_table_page.BOTH]
    for name in ("hopper", zoo_table_page.BOTH):
        assert [values[name, kind] for kind in zoo_table_page.BANDITS] == pytest.approx([0.5] * 2)
    drawn = zoo_table.EXPERIMENT.figures(report(*entries))["zoo_table_brax"]
    (axes,) = drawn.axes
    assert [x.get_text() for x in axes.get_yticklabels()] == list(found)
    page = zoo_table.EXPERIMENT.page(report(*entries))
    assert "| hopper | 0.50 [0.50, 0.50] | 0.50 [0.50, 0.50] | 3326 |" in page
    assert "Over 1 Brax environments ours are at" in page
    assert "zoo_table_brax" not in zoo_table.EXPERIMENT.figures(PENDULUM)


def test_agents_that_all_ended_without_a_number_count_as_random_actions():
    brax = {"backend": "generalized"}
    best = [3325.8] * 3
    agents = {"ppo": best, "td3": [None] * 3}
    entries = [entry("hopper", name, "ours", x, x, **brax) for name, x in agents.items()]
    (ours,) = zoo_table_page.brax_scores(entries)["hopper"].values()
    assert ours.n == 6 and ours.value == pytest.approx(0.5)
    with pytest.raises(UserError, match="agents is 1: it must be at least 2"):
        zoo_table.Options(agents=1)


def test_an_algorithm_that_is_not_registered_has_its_place_after_the_others():
    entry = {"environment": "CartPole-v1", "backend": None, "bandit": "ours"}
    names = ("mpo", "td3", "ppo", "ddqn", "dqn")
    places = sorted(names, key=lambda name: zoo_table_page.place({**entry, "algorithm": name}))
    assert places == ["ppo", "dqn", "ddqn", "td3", "mpo"]


def test_every_target_and_paper_figure_is_of_a_fitting_algorithm():
    assert set(zoo_table_page.TARGETS) < set(zoo_table_page.PAPER)
    for environment, figures in zoo_table_page.PAPER.items():
        spec = environment_spec(environment)
        assert spec.reference(algorithm="sac").source.startswith("SAC")
        if spec.family == "brax":  # whose actions are all continuous
            assert tuple(figures) == ("ppo", "sac", "ddpg", "td3")
            continue
        env, params = spec.make()
        assert tuple(figures) == specs.algorithms_for(env.action_space(params))


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A CartPole bandit that nobody evolved, and PPO with 16 steps as the only algorithm."""
    bandit = bandit_for(*make("CartPole-v1"), BanditConfig(hidden_size=4), "Synthetic-CartPole-v1")
    path = tmp_path / "Synthetic-CartPole-v1.npz"
    metadata = {"config": {"evaluation_environment": "CartPole-v1"}}
    save_bandit(path, bandit, bandit.init_weights(zoo_key()), metadata)
    full = specs.bandit_agent

    def small(*arguments, **keywords):
        sizes = {"num_envs": 2, "num_steps": 8, "num_epochs": 1, "num_minibatches": 1}
        return full(*arguments, **keywords).with_values(total_steps=16, hidden_sizes=(4,), **sizes)

    monkeypatch.setattr(zoo_table, "bandit_agent", small)
    monkeypatch.setattr(zoo_table, "algorithms_for", lambda space: ("ppo",))
    arguments = ["--bandits", str(path), "--agents", "2", "--episodes", "2"]
    arguments += ["--out", str(tmp_path / "data" / "zoo_table.json"), "--docs", str(tmp_path)]
    return path, arguments, small


def zoo_key():
    import jax

    return jax.random.key(0)


def test_a_measurement_is_what_judging_gives_and_is_not_repeated(tiny, tmp_path, monkeypatch):
    path, arguments, small = tiny
    assert zoo_table.EXPERIMENT.main(arguments) == 0
    stored = json.loads((tmp_path / "data" / "zoo_table.json").read_text())
    [made] = stored["entries"]

    env, params = make("CartPole-v1")
    bandit = load_bandit(path)
    spec = small("ppo", "CartPole-v1")
    place = Place("CartPole-v1", env, params)
    expected = judge(spec, bandit, bandit.default_params.weights, place, 10_000, 2, 2)
    for actions, returns in expected.items():
        assert made[actions]["agents"] == pytest.approx(returns, abs=1e-3)
        assert made[actions]["iqm"]["value"] == pytest.approx(float(iqm(returns)), abs=1e-3)
        assert made[actions]["iqm"]["low"] == pytest.approx(estimate(returns).low, abs=1e-3)
    assert (made["training_steps"], made["seed"], made["backend"]) == (16, 10_000, None)
    assert str(tmp_path) not in json.dumps(stored)
    assert (tmp_path / "zoo_table.md").read_text() == zoo_table.EXPERIMENT.page(stored)
    assert (tmp_path / "figures" / "zoo_table.png").stat().st_size > 10_000

    calls = []

    def counted(spec, synthetic, weights, judge_in, seed, num_agents, num_episodes):
        calls.append((seed, num_agents, num_episodes))
        return {"sampled_actions": np.ones(num_agents), "mode_actions": np.ones(num_agents)}

    monkeypatch.setattr(zoo_table, "judge", counted)
    assert zoo_table.EXPERIMENT.main(arguments) == 0
    assert calls == []
    # Another number of episodes is another measurement, and takes the old one's place.
    arguments[arguments.index("--episodes") + 1] = "3"
    assert zoo_table.EXPERIMENT.main(arguments) == 0
    assert calls == [(10_000, 2, 3)]
    stored = json.loads((tmp_path / "data" / "zoo_table.json").read_text())
    assert [e["episodes"] for e in stored["entries"]] == [3]
    # And so is another bandit under the same name.
    bandit_weights = load_bandit(path).init_weights(zoo_key())
    bandit_weights["reward"]["Dense_1"]["bias"] += 1.0
    save_bandit(path, bandit, bandit_weights)
    assert zoo_table.EXPERIMENT.main(arguments) == 0
    assert len(calls) == 2


def test_only_rendering_measures_nothing(tmp_path, monkeypatch):
    def forbidden(*arguments):
        raise AssertionError("measured")

    monkeypatch.setattr(zoo_table, "measure_bandits", forbidden)
    out = tmp_path / "report.json"
    out.write_text(json.dumps(PENDULUM))
    arguments = ["--only-render", "--out", str(out), "--docs", str(tmp_path)]
    assert zoo_table.EXPERIMENT.main(arguments) == 0
    assert (tmp_path / "zoo_table.md").read_text() == zoo_table.EXPERIMENT.page(PENDULUM)


def test_rendering_without_a_report_says_to_measure_first(tmp_path, capsys):
    out = tmp_path / "report.json"
    assert (
        zoo_table.EXPERIMENT.main(["--only-render", "--out", str(out), "--docs", str(tmp_path)])
        == 2
    )
    assert "measure first" in capsys.readouterr().err


def published_pendulum(folder):
    """A folder like the released one, with Pendulum's and hopper's arrays, all zeros but the biases."""
    folder.mkdir()
    for name, environment in (("pendulum", "Pendulum-v1"), ("hopper", "hopper")):
        bandit = bandit_for(*make(environment), BanditConfig(), environment)
        shapes = bandit.weight_shapes()
        np.savez(folder / f"{name}.npz", **{k: np.ones(v, np.float32) for k, v in shapes.items()})
    return folder


def test_published_bandits_count_only_where_their_folder_is_named(tmp_path, monkeypatch):
    # Such a folder beside the checkout changes nothing.
    (tmp_path / "shared").mkdir()
    published_pendulum(tmp_path / "shared" / "published_scbs")
    (tmp_path / "checkout").mkdir()
    monkeypatch.chdir(tmp_path / "checkout")
    asked = []
    monkeypatch.setattr(zoo_table, "measure_bandits", lambda found, *_: asked.append(found))
    options = zoo_table.Options(bandits=("Synthetic-Pendulum-v1",))
    zoo_table.measure(options, {}, lambda: None)
    zoo_table.measure(
        replace(options, published=tmp_path / "shared" / "published_scbs"), {}, lambda: None
    )
    assert [[x.kind for x in found] for found in asked] == [["ours"], ["ours", "published"]]


def test_ours_comes_before_the_published_and_brax_last(tmp_path):
    folder = published_pendulum(tmp_path / "published")
    found = zoo_table.candidates(None, folder)
    ours = [x for x in found if x.kind == "ours"]
    pendulum = [x for x in found if x.environment == "Pendulum-v1"]
    assert [x.kind for x in pendulum] == ["ours", "published"]
    assert [x.bandit.config.activation for x in pendulum] == ["tanh", "relu"]
    ranks = [zoo_table_page.ENVIRONMENTS.index(x.environment) for x in found]
    assert ranks == sorted(ranks)
    assert len(ours) + 2 == len(found)
    without = zoo_table.candidates(None, folder, skip_brax=True)
    assert "hopper" not in {x.environment for x in without}


def test_a_named_bandit_brings_its_published_peer_only(tmp_path):
    folder = published_pendulum(tmp_path / "published")
    named = zoo_table.candidates(["Synthetic-Pendulum-v1"], folder)
    assert {x.environment for x in named} == {"Pendulum-v1"}
    with pytest.raises(UserError, match="unknown bandit"):
        zoo_table.candidates(["Synthetic-Nowhere-v1"], folder)


def test_the_digest_is_of_the_arrays_and_not_of_their_packing(tmp_path):
    arrays = {"a": np.arange(3.0), "b": np.zeros((2, 2))}
    np.savez(tmp_path / "one.npz", **arrays)
    np.savez_compressed(tmp_path / "two.npz", **dict(reversed(arrays.items())))
    np.savez(tmp_path / "three.npz", a=arrays["a"] + 1, b=arrays["b"])
    one, two, three = (zoo_table._digest(tmp_path / f"{x}.npz") for x in ("one", "two", "three"))
    assert one == two != three


def test_a_bandit_stands_in_the_table_once_for_every_physics():
    both = [
        entry("hopper", "ppo", kind, [x, x, x], [x, x, x], episodes=5, backend=physics)
        for physics, x in (("generalized", 1.0), ("spring", 5.0))
        for kind in ("ours", "published")
    ]
    text = zoo_table.EXPERIMENT.page(report(*both))
    rows = [line for line in text.splitlines() if line.startswith("| hopper")]
    assert [row.split(" | ")[0] for row in rows[:2]] == [
        "| hopper (generalized)",
        "| hopper (spring)",
    ]
    # What the paper states is of the generalized physics.
    assert "853.5" in rows[0] and "853.5" not in rows[1]
    titles = [
        axes.get_title(loc="left")
        for axes in zoo_table.EXPERIMENT.figures(report(*both))["zoo_table"].axes
    ]
    assert titles == ["hopper (generalized, 5 episodes)", "hopper (spring, 5 episodes)"]
    assert [row["environment"] for row in zoo_table.differences(both)] == [
        "hopper (generalized)",
        "hopper (spring)",
    ]


def test_the_committed_measurements_are_of_todays_inner_loops(committed):
    # So that the command goes on from them instead of measuring all of it again.
    for found in committed("zoo_table")["entries"]:
        spec = bandit_agent(found["algorithm"], found["environment"])
        assert found["inner_loop"] == zoo_table.inner_loop(spec)
