import hashlib
import os
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb import artefacts
from scb.environments.brax import BRAX_NAMES
from scb.environments.registry import make
from scb.environments.zoo import load_bandit
from scb.errors import UserError
from scb.importer import (
    ORIGIN,
    PUBLISHED_BANDITS,
    import_published,
    import_published_command,
    published_bandit,
)

RELEASED = Path(__file__).parents[2].parent / "shared" / "published_scbs"
needs_released = pytest.mark.skipif(
    not RELEASED.is_dir(), reason="the published bandits are not here"
)
CLASSIC = {"pendulum": (3, 1), "mountaincar": (2, 3), "acrobot": (6, 3), "cartpole": (4, 2)}


def released(name="pendulum"):
    """Arrays as the release has them, with the observation and action sizes of an environment."""
    observation, action = CLASSIC[name]
    draw = np.random.default_rng(0).standard_normal
    shapes = {
        "initial_state/Dense_0/kernel": (observation, 32),
        "initial_state/Dense_0/bias": (32,),
        "initial_state/Dense_1/kernel": (32, observation),
        "initial_state/Dense_1/bias": (observation,),
        "reward/Dense_0/kernel": (observation + action, 32),
        "reward/Dense_0/bias": (32,),
        "reward/Dense_1/kernel": (32, 1),
        "reward/Dense_1/bias": (1,),
    }
    return {array: draw(shape).astype(np.float32) for array, shape in shapes.items()}


def write(folder, name="pendulum", arrays=None):
    folder.mkdir(exist_ok=True)
    np.savez(folder / f"{name}.npz", **(released(name) if arrays is None else arrays))
    return folder / f"{name}.npz"


def refusal(path):
    """The one sentence that `published_bandit` and `import_published` both refuse a file with."""
    with pytest.raises(UserError) as error:
        published_bandit(path)
    with pytest.raises(UserError) as other:
        import_published(path, path.parent / "out")
    assert str(other.value) == str(error.value)
    assert not (path.parent / "out").exists()
    message = str(error.value)
    assert message.endswith((".", "?")) and "\n" not in message
    return message


def relu(x):
    return np.maximum(x, 0.0)


def network(arrays, part, x):
    hidden = relu(x @ arrays[f"{part}/Dense_0/kernel"] + arrays[f"{part}/Dense_0/bias"])
    return hidden @ arrays[f"{part}/Dense_1/kernel"] + arrays[f"{part}/Dense_1/bias"]


@pytest.mark.parametrize("name", CLASSIC)
def test_the_bandit_computes_what_its_arrays_say_with_relu(tmp_path, name):
    arrays = released(name)
    bandit = published_bandit(write(tmp_path, name))
    params = bandit.default_params
    latent = np.linspace(-1.0, 1.0, CLASSIC[name][0], dtype=np.float32)
    context = network(arrays, "initial_state", latent)
    np.testing.assert_allclose(bandit.context(latent, params), context, rtol=1e-4, atol=1e-4)
    # A continuous action of 5 counts as Pendulum's bound of 2; discrete action 1 as [0, 1, ...].
    action, encoded = (
        (jnp.int32(1), np.eye(CLASSIC[name][1])[1]) if bandit.discrete else (jnp.array([5.0]), [2])
    )
    reward = network(arrays, "reward", np.concatenate([context, encoded]))[0]
    np.testing.assert_allclose(
        bandit.mean_reward(jnp.asarray(context), action, params), reward, rtol=1e-4, atol=1e-4
    )
    assert bandit.config.latent == "normal"
    assert bandit.latent_size == CLASSIC[name][0]


def test_a_folder_is_imported_as_bandits_that_load_again(tmp_path):
    for name in CLASSIC:
        write(tmp_path / "released", name)
    (tmp_path / "released" / "README.md").write_text("Any other file does not matter.")
    paths = import_published(tmp_path / "released", tmp_path / "out")
    assert paths == [
        tmp_path / "out" / f"Synthetic-{environment}.npz"
        for environment in ("Acrobot-v1", "CartPole-v1", "MountainCar-v0", "Pendulum-v1")
    ]
    for path, name in zip(paths, sorted(CLASSIC), strict=True):
        bandit = load_bandit(path)
        assert bandit.name == path.stem
        assert (bandit.config.activation, bandit.config.latent) == ("relu", "normal")
        flat = artefacts.flatten(bandit.default_params.weights)
        assert flat.keys() == released(name).keys()
        for array, value in released(name).items():
            np.testing.assert_array_equal(flat[array], value)


def test_one_file_is_imported_alone(tmp_path):
    source = write(tmp_path / "released")
    write(tmp_path / "released", "acrobot")
    assert import_published(source, tmp_path / "out") == [
        tmp_path / "out" / "Synthetic-Pendulum-v1.npz"
    ]
    assert len(list((tmp_path / "out").glob("*.npz"))) == 1


def test_the_metadata_says_whose_it_is_and_claims_nothing_else(tmp_path):
    source = write(tmp_path / "released")
    (path,) = import_published(source, tmp_path / "out")
    metadata = artefacts.load(path, "bandit").metadata
    assert metadata["command"] == ORIGIN
    for word in ("Liesen et al. (2024)", "synthetic-gymnax", "Apache-2.0"):
        assert word in ORIGIN
    assert metadata["config"]["evaluation_environment"] == "Pendulum-v1"
    assert metadata["seeds"] == metadata["results"] == metadata["cost"] == {}
    assert metadata["source"] == {
        "file": "pendulum.npz",
        "sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
    }
    assert str(tmp_path) not in path.with_suffix(".json").read_text()


def test_importing_again_gives_the_same_bytes(tmp_path):
    write(tmp_path / "released")
    first, second = (import_published(tmp_path / "released", tmp_path / x)[0] for x in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert first.with_suffix(".json").read_bytes() == second.with_suffix(".json").read_bytes()


def test_the_command_prints_one_line_for_each_bandit(tmp_path, capsys):
    for name in ("pendulum", "acrobot"):
        write(tmp_path / "released", name)
    import_published_command(tmp_path / "released", tmp_path / "out")
    assert capsys.readouterr().out.splitlines() == [
        f"bandit: {tmp_path / 'out' / 'Synthetic-Acrobot-v1.npz'}",
        f"bandit: {tmp_path / 'out' / 'Synthetic-Pendulum-v1.npz'}",
    ]


def test_a_missing_file_or_folder_is_said_by_name(tmp_path):
    assert "nowhere/pendulum.npz does not exist" in refusal(tmp_path / "nowhere" / "pendulum.npz")
    with pytest.raises(UserError, match=r"nowhere does not exist: give the published bandits'"):
        import_published(tmp_path / "nowhere", tmp_path / "out")


def test_a_file_in_the_place_of_the_folder_to_write_is_said(tmp_path):
    source = write(tmp_path / "released")
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "inside"):
        with pytest.raises(UserError, match=r"cannot write to .*file"):
            import_published(source, out)


def test_a_folder_without_an_npz_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"holds no \.npz file: give the folder"):
        import_published(tmp_path, tmp_path / "out")
    (tmp_path / "pendulum.pkl").touch()
    with pytest.raises(UserError, match="only pickles, which run code when they are opened"):
        import_published(tmp_path, tmp_path / "out")


def test_a_folder_is_not_one_bandit(tmp_path):
    with pytest.raises(UserError, match="is a folder"):
        published_bandit(tmp_path)


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "pendulum.txt").write_text("weights")
    assert "pendulum.txt is no .npz file" in refusal(tmp_path / "pendulum.txt")


def test_an_unknown_name_is_refused_with_the_near_ones(tmp_path):
    path = write(tmp_path, "pendulumm", released())
    assert refusal(path) == "unknown published bandit 'pendulumm': did you mean pendulum?"


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.mkdir, (str(self.path),))


def write_object_member(path, thing):
    np.savez(path, **{**released(), "reward/Dense_1/bias": np.array([thing], dtype=object)})


def write_object_array(path, thing):
    with path.open("wb") as file:
        np.save(file, np.array([thing], dtype=object))


def write_pickle(path, thing, protocol=None):
    path.write_bytes(pickle.dumps(thing, protocol))


@pytest.mark.parametrize(
    ("make_file", "name"),
    [
        (write_object_member, "pendulum.npz"),
        (write_object_array, "pendulum.npz"),
        (write_object_array, "pendulum.pkl"),
        (write_pickle, "pendulum.npz"),
        (write_pickle, "pendulum.pkl"),
    ],
)
def test_a_pickle_is_refused_as_one_and_never_run(tmp_path, make_file, name):
    make_file(tmp_path / name, Malicious(tmp_path / "was-run"))
    message = refusal(tmp_path / name)
    assert not (tmp_path / "was-run").exists()
    if name == "pendulum.npz":
        assert "is not a usable .npz" in message
    else:
        assert "holds pickled objects, which run code when they are opened" in message


def test_the_oldest_kind_of_pickle_is_refused_too(tmp_path):
    # Protocol 0 is text and does not start with 0x80.
    write_pickle(tmp_path / "pendulum.npz", Malicious(tmp_path / "was-run"), protocol=0)
    assert "is not a usable .npz" in refusal(tmp_path / "pendulum.npz")
    assert not (tmp_path / "was-run").exists()


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused_and_not_taken_for_a_pickle(tmp_path, kept):
    path = write(tmp_path / "pickles")
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    assert "pendulum.npz is not a usable .npz" in refusal(path)


def test_a_changed_byte_is_noticed(tmp_path):
    path = write(tmp_path)
    data = bytearray(path.read_bytes())
    # In the middle of the first array: 3 * 32 floats of 4 bytes after the headers.
    data[400] ^= 0xFF
    path.write_bytes(bytes(data))
    assert "is not a usable .npz" in refusal(path)


@pytest.mark.parametrize("name", released())
def test_every_missing_array_is_said_by_name(tmp_path, name):
    arrays = released()
    del arrays[name]
    assert f"has no array '{name}'" in refusal(write(tmp_path, arrays=arrays))


def test_an_array_too_many_is_said_by_name(tmp_path):
    arrays = {**released(), "transition/Dense_0/kernel": np.zeros(3)}
    assert "has an array 'transition/Dense_0/kernel'" in refusal(write(tmp_path, arrays=arrays))


def test_sizes_of_another_environment_are_refused(tmp_path):
    # Acrobot's observation has 6 numbers, MountainCar's 2.
    message = refusal(write(tmp_path, "mountaincar", released("acrobot")))
    assert "array 'initial_state/Dense_0/kernel' of " in message
    assert "mountaincar.npz' has shape (6, 32) where (2, 32) is expected" in message


def test_another_number_of_actions_is_refused(tmp_path):
    # 3 observations + 1 action = 4 inputs; here are 5.
    arrays = {**released(), "reward/Dense_0/kernel": np.zeros((5, 32))}
    message = refusal(write(tmp_path, arrays=arrays))
    assert "'reward/Dense_0/kernel'" in message and "has shape (5, 32)" in message
    assert "where (4, 32) is expected" in message


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    arrays = {**released(), "reward/Dense_1/bias": np.array([np.nan])}
    assert "has 1 NaN or infinite" in refusal(write(tmp_path, arrays=arrays))


def test_nothing_is_written_where_one_file_of_a_folder_is_bad(tmp_path):
    write(tmp_path / "released", "acrobot")
    (tmp_path / "released" / "pendulum.npz").write_bytes(b"")
    with pytest.raises(UserError, match=r"pendulum\.npz is not a usable"):
        import_published(tmp_path / "released", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@needs_released
def test_every_released_file_has_a_name_that_is_known():
    assert {path.stem for path in RELEASED.glob("*.npz")} == set(PUBLISHED_BANDITS)


@needs_released
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if environment in BRAX_NAMES else [])
        for name, environment in PUBLISHED_BANDITS.items()
    ],
)
def test_a_released_bandit_steps_like_its_environment_and_pays_a_finite_reward(tmp_path, name):
    (path,) = import_published(RELEASED / f"{name}.npz", tmp_path)
    assert path.stem == f"Synthetic-{PUBLISHED_BANDITS[name]}"
    bandit = load_bandit(path)
    env, env_params = make(PUBLISHED_BANDITS[name])
    key_reset, key_act, key_step = jax.random.split(jax.random.key(0), 3)
    context, state = bandit.reset(key_reset, bandit.default_params)
    assert context.shape == env.observation_space(env_params).shape
    action = env.action_space(env_params).sample(key_act)
    _, _, reward, terminated, _, _ = bandit.step(key_step, state, action, bandit.default_params)
    assert terminated
    assert np.isfinite(reward) and np.isfinite(context).all()
