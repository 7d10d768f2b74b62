"""The examples for other libraries run, in an environment of their own with the versions that make names."""

import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


def earned(python, name, *flags):
    """Runs an example, and returns the mean that its last line says."""
    command = [python, ROOT / "examples" / f"{name}.py", *flags]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return float(re.search(r": (-?\d+)(?: ± \d+)?$", done.stdout.strip())[1])


def environment(name):
    """The Python of an environment that the Makefile makes."""
    subprocess.run(["make", f"{name}/.installed"], cwd=ROOT, check=True)
    return ROOT / name / "bin" / "python"


@pytest.fixture(scope="module")
def sb3():
    return partial(earned, environment(".venv-sb3"))


@pytest.fixture(scope="module")
def rejax():
    return partial(earned, environment(".venv-rejax"))


def test_an_agent_of_sb3_learns_in_a_bandit_what_its_environment_pays(sb3):
    # Random actions earn about -1200.
    assert sb3("sb3_in_a_bandit", "--algorithm", "sac", "--steps", "2500") > -700


@pytest.mark.parametrize("objective", ["ppo", "lpo-pendulum"])
def test_sb3s_ppo_trains_with_an_objective(sb3, objective):
    # Random actions earn about -1200. Not a whole number of batches: SB3 collects whole ones.
    assert -700 < sb3("sb3_learned_objective", "--objective", objective, "--steps", "40000") < 0


# The objective that ships, whose file is read without this library.
@pytest.mark.parametrize("objective", ["ppo", "lpo/zoo/lpo-pendulum.npz"])
def test_rejaxs_ppo_trains_with_an_objective(rejax, objective):
    # Random actions earn about -1200.
    flags = ["--agents", "2", "--steps", "150000"]
    assert rejax("rejax_learned_objective", "--objective", objective, *flags) > -1100


@pytest.mark.parametrize("objective", ["ppo", "lpo-pendulum"])
def test_ppo_in_one_file_swings_the_pendulum_up_with_an_objective(objective):
    assert earned(sys.executable, "purejax_ppo_pendulum", "--objective", objective) > -400


@pytest.mark.parametrize("objective", ["ppo", "lpo-pendulum"])
def test_braxs_ppo_trains_with_an_objective(objective):
    # What has not learned holds the pole up for about 25 steps.
    flags = ["--objective", objective, "--steps", "60000"]
    assert earned(sys.executable, "brax_learned_objective", *flags) > 60
