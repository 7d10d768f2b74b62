"""What is known of environments, and what a new family of them takes: what `probes.Corridors` shows."""

import numpy as np
import pytest

from experiments.returns import EXPERIMENT
from scb.agents.spec import bandit_agent, environment_agent
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.environments import returns
from scb.environments.registry import environment_names, environment_spec, make
from scb.environments.returns import random_return
from scb.environments.zoo import bandit_metadata, load_bandit, save_bandit, zoo_names
from scb.errors import UserError


def saved(folder, config, name="mine", bandit="Synthetic-CartPole-v1"):
    """A bandit of the zoo under another name, with what its .json is to say of its environment."""
    original = load_bandit(bandit)
    metadata = dict(bandit_metadata(bandit)) | {"config": config}
    path = save_bandit(folder / f"{name}.npz", original, original.default_params.weights, metadata)
    return str(path)


def test_a_bandit_knows_its_environment_whatever_its_file_is_called(tmp_path):
    path = saved(tmp_path, {"evaluation_environment": "CartPole-v1"}, "Synthetic-Pendulum-v1")
    spec = environment_spec(path)
    assert (spec.family, spec.evaluation_environment) == ("bandit", "CartPole-v1")


def test_a_bandit_that_says_nothing_goes_by_the_name_it_was_saved_under(tmp_path):
    path = saved(tmp_path, {}, "Synthetic-CartPole-v1")
    assert environment_spec(path).evaluation_environment == "CartPole-v1"
    spec = environment_spec(saved(tmp_path, {}))
    assert spec.synthetic and spec.make()[0].num_actions == 2
    with pytest.raises(
        UserError, match=r'mine\.npz does not say which .* "evaluation_environment"'
    ):
        spec.evaluation_environment  # noqa: B018


def test_a_bandit_of_a_file_is_called_by_the_files_name(tmp_path):
    assert environment_spec(saved(tmp_path, {}, "mine")).bandit == "Synthetic-mine"


@pytest.mark.parametrize("name", zoo_names())
def test_the_zoos_bandits_stand_for_environments_whose_bandits_they_are(name):
    home = environment_spec(environment_spec(name).evaluation_environment)
    assert home.bandit == name
    assert not home.synthetic and home.evaluation_environment == home.name


def test_every_name_has_a_specification_without_anything_being_made():
    for name in environment_names():
        spec = environment_spec(name)
        assert spec.name == name
        assert (spec.default_backend in spec.backends) == (spec.family == "brax")
        # Of bandits only its own metadata is read; the expert's physics are its own.
        assert spec.reference("spring") is None or spec.family == "classic"


def test_physics_are_named_only_where_there_is_a_choice():
    hopper, cart_pole = environment_spec("hopper"), environment_spec("CartPole-v1")
    assert [hopper.physics(x) for x in (None, "spring")] == ["generalized", "spring"]
    assert [cart_pole.physics(x) for x in (None, "spring")] == [None, None]


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_the_table_of_random_returns_is_what_is_measured(name):
    # Means of 256 returns with standard deviations near 12 (CartPole) and 300: standard errors of 3 and 1.5 %.
    spec = environment_spec(name)
    assert spec.random_return() == pytest.approx(random_return(*spec.make()), rel=0.12)
    assert spec.random_return() < spec.reference().value


def test_the_table_is_written_by_its_command(corridors, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(returns, "TABLE", tmp_path / "returns.json")
    returns.TABLE.write_text('{"random": {"hopper:spring": 128.5}, "idle": {}}')
    assert EXPERIMENT.main(["Corridor-v0"]) == 0
    assert capsys.readouterr().out == "Corridor-v0: {'random': 3.0}\n"
    returns.table.cache_clear()
    assert returns.table("random") == {"hopper": {"spring": 128.5}, "Corridor-v0": {None: 3.0}}
    assert returns.table("idle") == {}
    returns.table.cache_clear()


def test_doing_nothing_is_measured_where_nothing_is_paid_for_standing():
    # Pendulum at rest below pays least, and hanging there with no torque no more than turning.
    env, params = environment_spec("Pendulum-v1").make()
    assert -2000 < returns.idle_return(env, params, 32) < -800
    # brax pays 1 a step for a hopper that stands, whatever it does; a cheetah is paid for its way alone.
    assert environment_spec("hopper").standing_still("positional") == 1000
    for name in ("halfcheetah", "swimmer", "humanoidstandup"):
        spec = environment_spec(name)
        assert spec.standing_still() == returns.table("idle")[name]["generalized"]
        assert spec.standing_still() < spec.reference().value


def test_a_new_family_takes_a_class_and_a_line(corridors):
    spec = environment_spec("Corridor-v0")
    assert (spec.family, spec.bandit) == ("corridors", "Synthetic-Corridor-v0")
    assert spec.reference() is None and spec.standing_still() is None and spec.episode_limit == 100
    # Not in the table: measured. Three cells, each of which pays 1.
    assert spec.random_return() == 3.0
    env, env_params = make("Corridor-v0", num_actions=4)
    assert env.action_space(env_params).n == 4
    with pytest.raises(UserError, match="and Corridor-v0 has no choice of physics: leave it out"):
        make("Corridor-v0", "spring")
    with pytest.raises(UserError, match="did you mean Corridor-v0"):
        make("Coridor-v0")


def test_a_new_family_is_trained_in_with_general_settings(corridors):
    for agent in bandit_agent, environment_agent:
        assert agent("ppo", "Corridor-v0") == agent("ppo", "CartPole-v1")


def test_a_bandit_can_be_discovered_for_a_new_family(corridors):
    problem = BanditDiscovery(DiscoveryConfig(environment="Corridor-v0", init="random"))
    assert problem.bandit.name == "Synthetic-Corridor-v0"
    assert (problem.bandit.observation_size, problem.bandit.num_actions) == (3, 2)


def test_a_score_is_0_for_random_actions_and_1_for_the_reference_of_its_physics():
    hopper = environment_spec("hopper")
    ends = [hopper.random_return("generalized"), hopper.reference_return("generalized")]
    np.testing.assert_allclose(hopper.score([ends]), [[0, 1]], atol=1e-12)
    with pytest.raises(UserError, match="no reference return of hopper with spring physics"):
        hopper.score(ends, "spring")
