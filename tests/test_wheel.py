"""What is installed from a wheel, without the checkout, runs what the README shows."""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests.test_readme import BLOCKS, shortened

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Of an environment with the wheel, which has its dependencies from this one and nothing of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    source, environment = folder / "source", folder / "environment"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("scb", "lpo"):
        # Not the checkout itself, where an earlier build may have left what is no longer part of it.
        shutil.copytree(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    wheel = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source]
    subprocess.run([*pip, *wheel], check=True)
    venv.create(environment, with_pip=False)
    made = environment / "bin" / "python"
    (built,) = folder.glob("*.whl")
    subprocess.run([*pip, "--python", made, "install", "--no-deps", built], check=True)
    (site,) = environment.glob("lib/python*/site-packages")
    # A folder that a .pth names is searched, and the .pth files in it, such as the checkout's, are not read.
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    return made


def run(python, folder, *arguments):
    command = [python, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_packages_are_the_wheels(python, tmp_path):
    said = run(python, tmp_path, "-c", "import lpo, scb; print(lpo.__file__, scb.__file__)")
    assert str(ROOT) not in said and said.count("site-packages") == 2


def test_the_programs_list_what_ships(python, tmp_path):
    assert "Synthetic-Pendulum-v1" in run(python, tmp_path, python.with_name("scb"), "list")
    assert "meta-train" in run(python, tmp_path, python.with_name("lpo"), "--help")


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_a_block_of_the_readme_runs(python, tmp_path, number):
    run(python, tmp_path, "-c", shortened(BLOCKS[number]))
