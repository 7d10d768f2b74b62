"""Objectives by name and file: what loads is what was saved; anything else is refused, and why."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from lpo.certificate import certify
from lpo.drifts import ClipDrift, DPODrift, LearnedDrift, NoDrift
from lpo.drifts.contract import BASES
from lpo.drifts.network import FEATURES
from lpo.objectives import (
    KNOWN,
    Objective,
    learned_in,
    load_apart,
    load_objective,
    save_objective,
    zoo_names,
)
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import save_bandit
from scb.errors import UserError


@pytest.fixture
def file(tmp_path: Path, objective_file: Path) -> Path:
    """A copy of the learned objective, to be damaged."""
    for path in (objective_file, objective_file.with_suffix(".json")):
        shutil.copy(path, tmp_path)
    return tmp_path / objective_file.name


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as error:
        load_objective(path)
    return str(error.value)


def test_of_a_run_folder_the_file_is_asked_for(tmp_path):
    assert refusal(tmp_path).endswith("give the objective's file, a path.npz.")
    (tmp_path / "objective.npz").touch()
    assert refusal(tmp_path).endswith(f"such as {tmp_path / 'objective.npz'}.")


def edit(path: Path, change) -> None:
    """Changes a copy of the metadata in place, or replaces it by what `change` returns."""
    json_path = path.with_suffix(".json")
    metadata = json.loads(json_path.read_text())
    change(metadata)
    json_path.write_text(json.dumps(metadata))


def sign(path: Path) -> None:
    """Makes the checksum fit again, as one would who tampers with both files."""
    edit(path, lambda m: m.update(sha256=hashlib.sha256(path.read_bytes()).hexdigest()))


# -- names --------------------------------------------------------------------------------------


def test_closed_forms_load_by_name():
    # One drift for each family, so that one program trains all its members: what differs are the parameters.
    clips = {"ppo": 0.2, "ppo-0.3": 0.3, "ppo-1": 1.0, "ppo-1e-3": 1e-3}
    constants = {"dpo": (2.0, 0.6), "dpo-4-1.2": (4.0, 1.2), "dpo-1-.5": (1.0, 0.5)}
    for name, clip in clips.items():
        assert load_objective(name).drift == ClipDrift()
        assert float(load_objective(name).parameters) == pytest.approx(clip)
        assert f"Objective('{name}', ClipDrift(clip={clip}), " in repr(load_objective(name))
    for name, (alpha, beta) in constants.items():
        assert load_objective(name).drift == DPODrift()
        assert load_objective(name).parameters == pytest.approx({"alpha": alpha, "beta": beta})
        shown = f"Objective('{name}', DPODrift(alpha={alpha}, beta={beta}), "
        assert shown in repr(load_objective(name))
    assert load_objective("none").drift == NoDrift()
    assert "Objective('none', NoDrift(), " in repr(load_objective("none"))


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("dpo-4", "dpo-4-1.2"),
        ("dpo-4-1.2-1", "dpo-4-1.2"),
        ("ppo-x", "ppo-1"),
        ("ppo-pendulum", "lpo-pendulum"),
    ],
)
def test_a_name_without_its_constants_is_told_from_what_was_meant(name, meant):
    with pytest.raises(UserError, match=f"unknown objective .*{re.escape(meant)}"):
        load_objective(name)


@pytest.mark.parametrize(
    ("name", "wrong"), [("dpo-0-0.6", "alpha"), ("dpo-2-0", "beta"), ("ppo-0", "clip")]
)
def test_constants_are_positive(name, wrong):
    with pytest.raises(UserError, match=f"{wrong} is 0.0: it must be positive"):
        load_objective(name)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("ppo-1e-50", "clip"), ("dpo-1e-50-0.6", "alpha"), (f"dpo-2-1{'0' * 50}", "beta")],
)
def test_constants_are_numbers_of_32_bits(name, wrong, one_sentence):
    with pytest.raises(UserError, match=f"{wrong} is 1e.50, and parameters have 32 bits") as error:
        load_objective(name)
    one_sentence(str(error.value))


@pytest.mark.parametrize("name", ["ppo", "ppo-0.3", "dpo", "dpo-4-1.2", "none"])
def test_an_objective_bears_the_name_that_it_was_loaded_by(name):
    assert load_objective(name).name == name


def test_every_listed_name_loads():
    for name in [*KNOWN, *zoo_names()]:
        assert load_objective(name).name == name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dop", "unknown objective 'dop': did you mean dpo?"),
        ("PPO", "unknown objective 'PPO': did you mean ppo"),
        ("nothing-like-it", "unknown objective 'nothing-like-it': known are dpo, "),
        ("ppo-0", "clip is 0.0: it must be positive, and finite."),
    ],
)
def test_an_unknown_name_is_told_what_is_known(name, message, one_sentence):
    assert message in one_sentence(refusal(Path(name)))


# -- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", BASES)
def test_a_saved_objective_charges_the_same_bit_for_bit(tmp_path, base):
    drift = LearnedDrift(base=base, hidden_size=3, clip=0.1, xi=1e-4, gate=0.25)
    parameters = drift.init(jax.random.key(5))
    path, certificate = save_objective(tmp_path / "mine.npz", drift, parameters)
    loaded = load_objective(path)
    assert (loaded.name, loaded.drift) == ("mine", drift)
    assert loaded.metadata["certificate"] == certificate.as_dict()
    assert certificate.holds

    log_ratio = jnp.linspace(-2.0, 2.0, 101)
    arguments = (log_ratio, jnp.cos(7.0 * log_ratio), jnp.zeros(101))
    np.testing.assert_array_equal(
        loaded.drift(loaded.parameters, *arguments), drift(parameters, *arguments)
    )


def test_a_closed_form_without_parameters_by_name_is_not_saved(tmp_path):
    drift = ClipDrift(0.3)
    with pytest.raises(UserError, match=r"family clip is its settings.* such as ppo-0\.3"):
        save_objective(tmp_path / "mine.npz", drift, drift.init(jax.random.key(0)))
    with pytest.raises(UserError, match=r"family clip is its settings.* such as ppo-0\.3"):
        save_objective(tmp_path / "mine.npz", drift, {})
    assert not list(tmp_path.iterdir())


def test_parameters_of_another_drift_are_not_saved(tmp_path):
    parameters = {"hidden": np.zeros((8, 3)), "output": np.zeros((3, 1))}
    with pytest.raises(
        UserError, match=r"array 'hidden' .* shape \(8, 3\) where \(8, 128\) is expec"
    ):
        save_objective(tmp_path / "mine.npz", LearnedDrift(), parameters)
    assert not list(tmp_path.iterdir())


def test_weights_that_are_no_numbers_are_not_saved(tmp_path, recwarn):
    drift = LearnedDrift()
    parameters = jax.tree.map(lambda x: x * jnp.nan, drift.init(jax.random.key(0)))
    with pytest.raises(
        UserError, match=r"mine\.npz was not written, since array 'hidden' has 1024"
    ):
        save_objective(tmp_path / "mine.npz", drift, parameters)
    assert not list(tmp_path.iterdir()) and not recwarn.list


def test_dpo_is_saved_with_the_parameters_it_has(tmp_path):
    trained = {"alpha": jnp.float32(4.0), "beta": jnp.float32(1.5)}
    path, _ = save_objective(tmp_path / "mine.npz", DPODrift(), trained)
    loaded = load_objective(path)
    assert loaded.drift == DPODrift() and loaded.parameters == trained
    again, _ = save_objective(tmp_path / "again.npz", loaded.drift, loaded.parameters)
    assert load_objective(again).metadata["config"]["drift"]["alpha"] == 4.0
    path, _ = save_objective(tmp_path / "own.npz", DPODrift(), DPODrift().init(None))
    assert load_objective(path).drift == DPODrift()


def test_what_a_formula_writes_down_was_learned_where_its_original_was():
    config = {"distill": {}, "of": "lpo-pendulum", "learned_on": ["Synthetic-Pendulum-v1"]}
    formula = Objective("closed_form", DPODrift(), {}, {"config": config})
    assert learned_in([formula]) == ["Pendulum-v1"]


def test_what_an_objective_was_learned_for_is_known_where_its_bandit_is_gone():
    config = {"meta_training": {"tasks": ["gone.npz"]}}
    gone = Objective("mine", DPODrift(), {}, {"config": config})
    with pytest.raises(UserError, match=r"gone\.npz does not exist"):
        learned_in([gone])
    told = Objective("mine", DPODrift(), {}, {"config": {**config, "homes": ["CartPole-v1"]}})
    assert learned_in([told]) == ["CartPole-v1"]


def test_a_copy_goes_by_the_name_of_its_own_file(file):
    # All run folders have an objective.npz: copied under two names they can be compared.
    for suffix in (".npz", ".json"):
        file.with_suffix(suffix).rename(file.with_name(f"another{suffix}"))
    assert load_objective(file.with_name("another.npz")).name == "another"


def in_two_folders(file: Path, where: Path, stem: str) -> list[str]:
    """The paths of copies of an objective that bear one name."""
    paths = []
    for folder in ("first", "second"):
        (where / folder).mkdir()
        for suffix in (".npz", ".json"):
            kept = where / folder / f"{stem}{suffix}"
            kept.write_bytes(file.with_suffix(suffix).read_bytes())
        paths.append(str(kept.with_suffix(".npz")))
    return paths


def test_what_a_run_learned_has_its_name_whatever_it_is_compared_with(file, tmp_path):
    paths = in_two_folders(file, tmp_path, "objective")
    assert [x.name for x in load_apart(paths[:1])] == ["first"]
    assert [x.name for x in load_apart(["ppo", *paths])] == ["ppo", "first", "second"]


def test_the_first_file_of_a_name_of_which_there_are_results_keeps_it(tmp_path, file):
    paths = in_two_folders(file, tmp_path, "mine")
    assert [x.name for x in load_apart(paths)] == paths
    assert [x.name for x in load_apart(paths, kept=["ppo", "mine"])] == ["mine", paths[1]]
    assert [x.name for x in load_apart(paths, kept=paths)] == paths
    with pytest.raises(UserError, match="is there twice"):
        load_apart(paths[:1] * 2)


def test_metadata_of_the_meta_training_is_kept(tmp_path, tiny_drift):
    given = {"config": {"meta_training": {"fitness": "transfer"}}, "seeds": {"a": 7}}
    parameters = tiny_drift.init(jax.random.key(0))
    path, _ = save_objective(tmp_path / "mine.npz", tiny_drift, parameters, given)
    metadata = load_objective(path).metadata
    assert metadata["config"]["meta_training"] == {"fitness": "transfer"}
    assert metadata["config"]["drift"]["features"] == list(FEATURES)
    assert metadata["seeds"] == {"a": 7}
    assert given["config"].keys() == {"meta_training"}  # the caller's own is left as it was


def test_a_bandit_is_no_objective(tmp_path, one_sentence):
    bandit = SyntheticBandit(2, spaces.Discrete(2), BanditConfig(hidden_size=2))
    weights = bandit.init_weights(jax.random.key(0))
    path = save_bandit(tmp_path / "bandit.npz", bandit, weights)
    assert "is a bandit: give a drift here." in one_sentence(refusal(path))


def test_a_changed_weight_is_noticed(file, one_sentence):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert "SHA-256 differs" in one_sentence(refusal(file))


@pytest.mark.parametrize("signed", [False, True])
def test_a_file_cut_in_half_is_refused(file, signed, one_sentence):
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    if signed:
        sign(file)
    expected = "not a usable .npz" if signed else "SHA-256 differs"
    assert expected in one_sentence(refusal(file))


class Trap:
    """Unpickling this would call `print`, as another pickle would call `os.system`."""

    def __reduce__(self):
        return print, ("the pickle ran",)


def test_a_pickle_is_refused_and_never_run(file, one_sentence, capsys):
    np.savez(file, hidden=np.array([Trap()], dtype=object), output=np.zeros((4, 1)))
    sign(file)
    assert "not a usable .npz" in one_sentence(refusal(file))
    assert "the pickle ran" not in capsys.readouterr().out


def test_weights_that_are_not_numbers_are_refused(file, one_sentence):
    np.savez(file, hidden=np.full((8, 4), np.nan), output=np.zeros((4, 1)))
    sign(file)
    assert "'hidden' has 32 NaN or infinite among its 32" in one_sentence(refusal(file))


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_one_file_without_the_other_is_refused(file, suffix, one_sentence):
    file.with_suffix(suffix).unlink()
    assert f"tiny{suffix} does not exist" in one_sentence(refusal(file))


def test_other_features_are_refused(file, one_sentence):
    # The same eight in another order, as other code has them, would load and charge something else.
    def swap(metadata):
        metadata["config"]["drift"]["features"] = [*FEATURES[1::-1], *FEATURES[2:]]

    edit(file, swap)
    assert "was learned on other features ((1-r)^2, 1-r, log r," in one_sentence(refusal(file))


@pytest.mark.parametrize("entry", ["base", "hidden_size", "clip", "xi", "features"])
def test_a_missing_config_entry_is_named(file, entry, one_sentence):
    edit(file, lambda m: m["config"]["drift"].pop(entry))
    assert f"its .json lacks config entry '{entry}'." in one_sentence(refusal(file))


def test_a_missing_config_is_named(file, one_sentence):
    edit(file, lambda m: m["config"].pop("drift"))
    assert "its .json lacks config entry 'drift'." in one_sentence(refusal(file))


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("hidden_size", "four", "hidden_size is 'four': it must be a whole number."),
        ("clip", "0.2", "its .json garbles config entry 'drift'"),
        ("xi", None, "its .json garbles config entry 'drift'"),
        ("features", 8, "its .json garbles config entry 'drift'"),
        ("base", "ppo3", "unknown drift base 'ppo3'"),
        ("hidden_size", 0, "hidden_size is 0: it must be at least 1."),
    ],
)
def test_a_garbled_config_entry_is_refused(file, entry, value, message, one_sentence):
    edit(file, lambda m: m["config"]["drift"].update({entry: value}))
    assert message in one_sentence(refusal(file))


def test_a_config_that_is_no_mapping_is_refused(file, one_sentence):
    edit(file, lambda m: m["config"].update(drift="ppo"))
    assert "garbles config entry 'drift'" in one_sentence(refusal(file))


def test_weights_of_another_size_than_the_config_says_are_refused(file, one_sentence):
    edit(file, lambda m: m["config"]["drift"].update(hidden_size=5))
    message = one_sentence(refusal(file))
    assert "array 'hidden' of drift 'tiny' has shape (8, 4) where (8, 5) is expected" in message


def test_weights_of_another_network_are_refused(file, one_sentence):
    np.savez(file, hidden=np.ones((8, 4)), out=np.ones((4, 1)))
    sign(file)
    assert "has no array 'output'" in one_sentence(refusal(file))


# -- the zoo ------------------------------------------------------------------------------------


def test_the_objective_learned_for_pendulum_ships():
    assert "lpo-pendulum" in zoo_names()


@pytest.mark.parametrize("name", zoo_names())
def test_an_objective_of_the_zoo_is_the_drift_that_its_certificate_says(name):
    objective = load_objective(name)
    stored = dict(objective.metadata["certificate"])
    fresh = certify(objective.drift, objective.parameters).as_dict()
    assert stored["holds"] is True
    # Slopes are sums of products, which another machine may round otherwise; the rest is exact.
    for slope in ("slope_at_0_001", "slope_at_0_01", "kink"):
        assert stored.pop(slope) == pytest.approx(fresh.pop(slope), rel=1e-4)
    at_one = fresh.pop("kink_at_one")
    assert fresh["by_construction"] and at_one < 0.03
    # Not said by files from before certificates did.
    assert stored.pop("kink_at_one", at_one) == pytest.approx(at_one, rel=1e-4)
    assert {"by_construction": True, **stored} == fresh


@pytest.mark.parametrize("name", zoo_names())
def test_an_objective_of_the_zoo_says_how_it_was_made(name):
    metadata = load_objective(name).metadata
    assert metadata["command"]
    assert metadata["cost"]["environment_steps_training"] > 0
    assert metadata["results"]


def test_a_temporal_objective_comes_back_as_one(tmp_path):
    drift = LearnedDrift(hidden_size=4, temporal=True)
    parameters = drift.init(jax.random.key(0))
    path, certificate = save_objective(tmp_path / "late.npz", drift, parameters)
    loaded = load_objective(path)
    assert loaded.drift == drift
    assert certificate.holds
    np.testing.assert_array_equal(loaded.parameters["hidden"], parameters["hidden"])


def test_an_objective_is_itself_and_nothing_else_is_one():
    objective = load_objective("ppo-0.3")
    assert load_objective(objective) is objective
    for wrong in (3, None):
        with pytest.raises(UserError, match=f"of the class {type(wrong).__name__} is no objective"):
            load_objective(wrong)


def test_a_file_is_found_by_the_name_that_it_was_saved_with(tmp_path):
    learned, small = load_objective("lpo-pendulum"), LearnedDrift(hidden_size=4)
    save_objective(tmp_path / "mine", small, small.init(jax.random.key(0)))
    assert load_objective(tmp_path / "mine").name == "mine"
    assert load_apart([str(tmp_path / "mine"), learned])[1] is learned
    for unknown in (tmp_path / "other", "x" * 300):
        with pytest.raises(UserError, match="unknown objective"):
            load_objective(unknown)


def test_what_is_saved_is_a_drift_with_its_parameters(tmp_path):
    learned = load_objective("lpo-pendulum")
    with pytest.raises(
        UserError, match=r"not of the class Objective: of a search give outcome.mean"
    ):
        save_objective(tmp_path / "mine", learned.drift, learned)
    with pytest.raises(UserError, match="of the class Objective is no drift"):
        save_objective(tmp_path / "mine", learned, learned.parameters)
    assert not [*tmp_path.iterdir()]
