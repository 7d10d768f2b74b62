"""The examples for other libraries run, in an environment of their own with the versions that make names."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sb3():
    """Runs an example of SB3's, and returns the mean that it prints."""
    subprocess.run(["make", ".venv-sb3/.installed"], cwd=ROOT, check=True)

    def run(name, *flags):
        command = [ROOT / ".venv-sb3/bin/python", ROOT / "examples" / f"{name}.py", *flags]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == 0, done.stderr
        return float(re.search(r": (-?\d+) ± \d+$", done.stdout.strip())[1])

    return run


def test_an_agent_of_sb3_learns_in_a_bandit_what_its_environment_pays(sb3):
    # Random actions earn about -1200.
    assert sb3("sb3_in_a_bandit", "--algorithm", "sac", "--steps", "2500") > -700


@pytest.mark.parametrize("objective", ["ppo", "lpo-pendulum"])
def test_sb3s_ppo_trains_with_an_objective(sb3, objective):
    earned = sb3("sb3_learned_objective", "--objective", objective, "--steps", "8192")
    assert -2000 < earned < 0
