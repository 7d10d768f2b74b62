"""The command line `lpo`: what works, and how its processes are set up."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import lpo
import scb.cli
import scb.commands
from lpo import cli, commands
from lpo.drifts import ClosedFormDrift, NoDrift
from lpo.objectives import Objective, closed_form, load_objective, zoo_names
from lpo.pipeline import RunAll
from scb.errors import UserError

pytestmark = pytest.mark.usefixtures("working_folder", "no_training")


# -- processes of its own -----------------------------------------------------------------------


@pytest.fixture
def python(working_folder):
    """Runs Python with arguments, and with environment variables changed or (None) left out."""

    def run(*arguments: str, **changes: str | None) -> subprocess.CompletedProcess[str]:
        variables = {**os.environ, "PYTHONPATH": str(Path(lpo.__file__).parents[1]), **changes}
        return subprocess.run(
            [sys.executable, *arguments],
            capture_output=True,
            text=True,
            check=False,
            env={name: value for name, value in variables.items() if value is not None},
            cwd=working_folder,
        )

    return run


CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
CONFIGURED = """
import lpo.cli
from experiments import __main__ as experiments
experiments.found()  # none of them computes at import
from scb.cli import configure_jax
configure_jax()
import jax
print(jax.device_count("cpu"), jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(
    ("devices", "cache", "expected"),
    [
        (None, None, f"{CORES} home/lpo/jax"),
        pytest.param("3", "elsewhere", "3 elsewhere", marks=pytest.mark.slow),
    ],
)
def test_jax_gets_a_device_a_core_and_a_cache_unless_told_otherwise(
    python, devices, cache, expected
):
    finished = python(
        "-c",
        CONFIGURED,
        JAX_NUM_CPU_DEVICES=devices,
        JAX_COMPILATION_CACHE_DIR=cache,
        XLA_FLAGS=None,
        XDG_CACHE_HOME="home",
    )
    assert finished.stdout.strip() == expected


def test_a_device_that_is_not_there_is_told_in_a_sentence(python):
    finished = python("-c", "import scb", JAX_PLATFORMS="foo")
    assert finished.returncode == 1
    assert finished.stderr.splitlines()[-1].startswith(
        "scb.errors.UserError: JAX_PLATFORMS is foo, and JAX finds no such device here"
    )


def test_a_caller_that_has_used_jax_keeps_its_devices(monkeypatch):
    before = jax.device_count()
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    cores = set(range(before + 1))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: cores, raising=False)
    scb.cli.configure_jax()
    assert jax.device_count() == before


def test_without_a_home_there_is_no_cache(monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        scb.cli.configure_jax()
        assert jax.config.values["jax_compilation_cache_dir"] is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_every_public_name_is_there():
    for name in lpo.__all__:
        assert getattr(lpo, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'lpo' has no attribute 'Drfit'"):
        _ = lpo.Drfit


def test_a_bug_is_not_dressed_up_as_a_mistake(monkeypatch):
    def broken(name):
        raise ValueError("a bug")

    monkeypatch.setattr(commands, "load_objective", broken)
    with pytest.raises(ValueError, match="a bug") as error:
        cli.main(["certify", "ppo"])
    assert not isinstance(error.value, UserError)


# -- what works ---------------------------------------------------------------------------------


def test_certify_says_what_it_found(capsys):
    assert cli.main(["certify", "ppo-0.3"]) == 0
    assert capsys.readouterr().out.startswith("ppo-0.3 is a drift: min f 0,")


def test_certify_exits_with_one_where_the_conditions_fail(monkeypatch, capsys):
    class Bias(NoDrift):
        def __call__(self, parameters, log_ratio, advantage, progress):
            return jnp.ones_like(log_ratio)

    monkeypatch.setattr(commands, "load_objective", lambda name: Objective(name, Bias(), ()))
    with pytest.raises(SystemExit) as stop:
        cli.main(["certify", "mine"])
    assert stop.value.code == 1
    assert capsys.readouterr().out.startswith("mine is NOT a drift: min f 1, at ratio 1 |f| 1")


def test_certify_exits_with_one_where_a_drift_holds_policies_still(monkeypatch, capsys):
    barrier = closed_form("mine", ClosedFormDrift("0.2*abs(log_r)"))
    monkeypatch.setattr(commands, "load_objective", lambda name: barrier)
    with pytest.raises(SystemExit) as stop:
        cli.main(["certify", "mine"])
    assert stop.value.code == 1
    assert "is a drift whatever its weights, but one that MAY HOLD" in capsys.readouterr().out


@pytest.mark.parametrize(("command", "together"), [("run", False), ("meta-train", True)])
def test_flags_of_several_processes_are_shown_where_they_are_taken(command, together, capsys):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    assert ("--coordinator" in capsys.readouterr().out) == together


def test_a_run_of_everything_takes_its_seed_and_its_preset():
    command = RunAll.parse(["--preset", "paper", "--seed", "3"])
    assert command.command == "lpo run --preset=paper --seed=3"
    search = command.config.meta_training
    assert (search.evolution.seed, search.validation) == (3, True)
    assert (search.evolution.population_size, search.evolution.num_generations) == (64, 512)


def test_objectives_are_listed_with_what_ppo_earns_with_them(capsys):
    assert cli.main(["list"]) == 0
    rows = [line.strip(" │").split("│") for line in capsys.readouterr().out.splitlines()]
    table = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}
    # README's figures.
    assert table["ppo"][:3] == ["-250", "-950", "nothing: a formula"]
    assert table["lpo-pendulum"] == ["-177", "-231", "Synthetic-Pendulum-v1", "3"]
    assert cli.main(["list", "--json"]) == 0
    listed = {x["name"]: x for x in json.loads(capsys.readouterr().out)}
    assert listed.keys() == {"ppo", "dpo", "none", *zoo_names()}
    entry = listed["lpo-multi"]
    metadata = load_objective("lpo-multi").metadata
    assert entry["command"] == metadata["command"]
    assert entry["results"]["Pendulum-v1"]["n"] == 20 and entry["certificate"]["holds"]
    assert entry["learned_on"] == ["Synthetic-Pendulum-v1", "Synthetic-CartPole-v1"]
    # A command that finds others now says so.
    assert entry["random_keys"] == metadata["random_keys"]
    assert "random_keys" not in listed["lpo-cartpole-ee"]
