import json
from importlib import resources

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

import scb
from scb import artefacts
from scb.environments.synthetic import BanditConfig, BanditParams, SyntheticBandit
from scb.environments.zoo import (
    PREFIX,
    bandit_metadata,
    load_bandit,
    save_bandit,
    zoo_names,
)
from scb.errors import UserError
from scb.judgement import check_fits
from scb.measurement import Place
from tests.scb.probes import context_bandit

CONFIG = BanditConfig(hidden_size=4, activation="relu", latent="softmax_categorical", latent_size=2)
BANDITS = {
    "box": SyntheticBandit(3, spaces.Box(jnp.array([-2.0, 0.0]), 1.5, (2,), jnp.float32), CONFIG),
    "discrete": SyntheticBandit(3, spaces.Discrete(4), CONFIG),
}


def saved(folder, bandit, name="Synthetic-Test"):
    weights = bandit.init_weights(jax.random.key(1))
    path = save_bandit(folder / f"{name}.npz", bandit, weights, {"command": "scb discover"})
    return path, weights


def edit(path, change):
    """Rewrites NAME.json as a hand would."""
    path = path.with_suffix(".json")
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("original", BANDITS.values(), ids=BANDITS)
def test_a_saved_bandit_comes_back_exactly(tmp_path, original):
    path, weights = saved(tmp_path, original)
    bandit = load_bandit(path)
    assert bandit.name == "Synthetic-Test"
    assert bandit.config == original.config
    assert bandit.weight_shapes() == original.weight_shapes()
    restored = bandit.default_params.weights
    assert jax.tree.structure(restored) == jax.tree.structure(weights)
    jax.tree.map(np.testing.assert_array_equal, restored, weights)
    ours, theirs = bandit.action_space(), original.action_space()
    assert type(ours) is type(theirs) and ours.shape == theirs.shape
    if not original.discrete:
        np.testing.assert_array_equal(ours.low, [-2.0, 0.0])
        np.testing.assert_array_equal(ours.high, [1.5, 1.5])
    # And so it plays the same: an action far outside is clipped to the same bounds.
    params = BanditParams(weights=weights)
    key_reset, key_step = jax.random.split(jax.random.key(0))
    action = jnp.int32(3) if original.discrete else jnp.array([9.0, -9.0])
    observation, state = bandit.reset(key_reset)
    expected, expected_state = original.reset(key_reset, params)
    np.testing.assert_array_equal(observation, expected)
    reward = bandit.step(key_step, state, action)[2]
    assert reward == original.step(key_step, expected_state, action, params)[2]


def test_the_metadata_is_kept_beside_what_the_bandit_needs(tmp_path):
    bandit, weights = context_bandit(), context_bandit().default_params.weights
    path = save_bandit(
        tmp_path / "a.npz",
        bandit,
        weights,
        {"config": {"discovery": {"sigma": 0.1}}, "seeds": {"discovery": 3}},
    )
    metadata = artefacts.load(path, "bandit").metadata
    assert metadata["config"]["discovery"] == {"sigma": 0.1}
    assert metadata["config"]["observation_size"] == 1
    assert metadata["config"]["action_space"] == {
        "type": "box",
        "shape": [1],
        "low": [-1.0],
        "high": [2.0],
    }
    assert (metadata["kind"], metadata["seeds"]) == ("bandit", {"discovery": 3})


def test_what_could_not_be_loaded_is_not_saved(tmp_path):
    path = tmp_path / "bandit.npz"
    other = BANDITS["discrete"].init_weights(jax.random.key(0))
    with pytest.raises(UserError, match=r"array 'reward/Dense_0/kernel' .* is expected"):
        save_bandit(path, BANDITS["box"], other)
    with pytest.raises(
        UserError, match="something of the class dict is no bandit: give save_bandit"
    ):
        save_bandit(path, other, BANDITS["box"])
    with pytest.raises(UserError, match="the arrays are a ndarray: give a dictionary of them"):
        artefacts.save(path, np.zeros(420), {"kind": "bandit", "config": {}})
    assert not path.exists()
    with pytest.raises(UserError, match="cannot write to /proc/nowhere"):
        artefacts.save(
            "/proc/nowhere/bandit.npz",
            {"x": np.zeros(1)},
            {"kind": "bandit", "config": {}},
        )


def test_weights_of_another_architecture_are_refused(tmp_path):
    path, _ = saved(tmp_path, BANDITS["box"])
    edit(path, lambda content: content["config"]["bandit"].update(hidden_size=5))
    with pytest.raises(UserError, match=r"has shape \(4,\) where \(5,\) is expected"):
        load_bandit(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda config: config.pop("observation_size"),
        lambda config: config.pop("action_space"),
        lambda config: config["action_space"].pop("low"),
        lambda config: config.update(bandit={"depth": 3}),
        lambda config: config.update(action_space="box"),
        lambda config: config.update(observation_size="three"),
        lambda config: config.update(observation_size=-3),
    ],
)
def test_a_description_that_is_no_bandits_is_refused(tmp_path, change):
    path, _ = saved(tmp_path, BANDITS["box"])
    edit(path, lambda content: change(content["config"]))
    with pytest.raises(UserError, match=r"Synthetic-Test\.npz does not describe a bandit"):
        load_bandit(path)


def test_an_artefact_of_another_kind_is_refused(tmp_path):
    path = artefacts.save(tmp_path / "a.npz", {"x": np.zeros(2)}, {"kind": "drift", "config": {}})
    with pytest.raises(UserError, match="is a drift: give a bandit here"):
        load_bandit(path)


def test_a_foreign_file_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(2))
    with pytest.raises(UserError, match=r"a\.json does not exist"):
        load_bandit(tmp_path / "a.npz")


def test_a_bandit_opens_by_file_or_by_name(tmp_path):
    path, _ = saved(tmp_path, BANDITS["box"])
    assert load_bandit(str(path)).name == "Synthetic-Test"
    assert load_bandit(zoo_names()[0]).name == zoo_names()[0]
    assert scb.make(path)[0].name == "Synthetic-Test"
    with pytest.raises(UserError, match="unknown bandit 'Pendulum': did you mean Synthetic-P"):
        load_bandit("Pendulum")
    with pytest.raises(UserError, match=rf"is a folder: give .* such as {path}"):
        load_bandit(tmp_path)


@pytest.mark.parametrize("begun", [[], ["warm_start"], ["warm_start", "refinement"]])
def test_a_run_whose_search_has_not_ended_is_told(tmp_path, begun):
    (tmp_path / "checkpoints").mkdir()
    for name in begun:
        (tmp_path / f"{name}.npz").touch()
    with pytest.raises(
        UserError, match=rf"search has not ended: go on with it by --resume {tmp_path}"
    ):
        load_bandit(tmp_path)
    (tmp_path / "Synthetic-Test.npz").touch()
    with pytest.raises(UserError, match=r"give the bandit's file in it, such as .*Synthetic-Test"):
        load_bandit(tmp_path)


def test_a_bandit_is_saved_with_what_there_is_to_tell(tmp_path):
    bandit = BANDITS["box"]
    path = save_bandit(
        tmp_path / "Synthetic-Test.npz", bandit, bandit.init_weights(jax.random.key(0))
    )
    metadata = bandit_metadata(path)
    assert metadata["results"] == metadata["cost"] == metadata["seeds"] == {}
    assert load_bandit(path).observation_size == bandit.observation_size


# -- what ships
# ---------------------------------------------------------------------------------------


def test_the_pendulum_bandit_ships():
    assert f"{PREFIX}Pendulum-v1" in zoo_names()


def test_the_zoo_is_what_its_folder_holds_and_is_registered_once():
    folder = resources.files("scb") / "zoo"
    files = {p.name for p in folder.iterdir() if p.name.endswith((".npz", ".json"))}
    assert files == {f"{name}.{end}" for name in zoo_names() for end in ("npz", "json")}
    scb.environments.zoo.register_zoo()  # a second time, which gymnax alone would refuse
    assert set(zoo_names()) <= set(gymnax.registered_envs)


def test_every_bandit_of_the_zoo_is_a_gymnax_environment_for_its_namesake():
    for name in zoo_names():
        env, params = gymnax.make(name)
        assert env.name == name
        target = name.removeprefix(PREFIX)
        check_fits(env, Place.named(target))
        key_reset, key_action, key_step = jax.random.split(jax.random.key(0), 3)
        observation, state = env.reset(key_reset, params)
        assert env.observation_space(params).contains(observation)
        action = env.action_space(params).sample(key_action)
        _, _, reward, terminated, truncated, _ = env.step(key_step, state, action, params)
        assert terminated and not truncated and np.isfinite(reward)


def test_every_bandit_of_the_zoo_says_what_it_is_worth_and_how_it_was_found():
    for name in zoo_names():
        metadata = bandit_metadata(name)
        result = metadata["results"]["PPO"]["sampled_actions"]
        assert result["low"] <= result["value"] <= result["high"]
        assert metadata["command"].startswith("scb discover")
        assert metadata["config"]["evaluation_environment"] == name.removeprefix(PREFIX)
        assert metadata["seeds"]["reporting"] != metadata["seeds"]["discovery"]


def test_the_metadata_of_a_bandit_is_read_by_name_or_file(tmp_path):
    path, _ = saved(tmp_path, BANDITS["box"])
    assert bandit_metadata(str(path))["command"] == "scb discover"
    for name in zoo_names():
        assert bandit_metadata(name)["name"] == name
