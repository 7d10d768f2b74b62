"""The bandits that the paper's authors published, put into this project's format.

Liesen et al. (2024) released theirs as synthetic-gymnax (Apache-2.0). This reads their arrays, one
.npz file for each evaluation environment; the release's own checkpoints are pickles, which run code
when they are opened, and are never read here.
"""

import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from scb.artefacts import Artefact, expect_shapes, read_arrays, unflatten
from scb.environments.registry import environment_spec, make
from scb.environments.spec import BANDIT
from scb.environments.synthetic import BanditConfig, SyntheticBandit, bandit_for
from scb.environments.zoo import save_bandit
from scb.errors import UserError, one_of
from scb.files import make_folder

# The release's name of a bandit -> its evaluation environment.
PUBLISHED_BANDITS = {
    "acrobot": "Acrobot-v1",
    "cartpole": "CartPole-v1",
    "mountaincar": "MountainCar-v0",
    "continuous_mountaincar": "MountainCarContinuous-v0",
    "pendulum": "Pendulum-v1",
    "hopper": "hopper",
    "walker2d": "walker2d",
    "halfcheetah": "halfcheetah",
    "swimmer": "swimmer",
    "humanoidstandup": "humanoidstandup",
}
ORIGIN = "published by Liesen et al. (2024), released as synthetic-gymnax, Apache-2.0"

# The paper's table says tanh; the released code's default is ReLU, and these weights go with it.
_CONFIG = BanditConfig(hidden_size=32, activation="relu", latent="normal")
_PICKLE_SUFFIXES = (".pkl", ".pickle", ".p", ".ckpt")


def published_bandit(path: str | Path) -> SyntheticBandit:
    """One published bandit from its arrays.

    Args:
      path: an .npz file with `initial_state/Dense_0/kernel` and the seven other arrays of two
        networks with 32 hidden units. Its name says the evaluation environment: "pendulum.npz" is
        Pendulum-v1's.

    Returns:
      The bandit, under the name "Synthetic-<environment>".

    Raises:
      UserError: the file is missing, a pickle, damaged, of an unknown name, or holds other arrays.
    """
    path = Path(path)
    _check_is_npz(path)
    home = _environment_of(path)
    env, env_params = make(home)
    bandit = bandit_for(env, env_params, _CONFIG, environment_spec(home).bandit)
    artefact = Artefact(str(path), unflatten(path, read_arrays(path)), {"kind": BANDIT})
    expect_shapes(artefact, bandit.weight_shapes())
    weights: Any = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), artefact.arrays)
    return SyntheticBandit(
        bandit.observation_size, bandit.action_space(), _CONFIG, weights, bandit.name
    )


def import_published(source: str | Path, out: str | Path) -> list[Path]:
    """Writes published bandits as `out/Synthetic-<environment>.npz`, each with its .json.

    All are read and checked before the first is written.

    Args:
      source: a folder with .npz files, or one such file.
      out: where to write; made if it is missing.

    Returns:
      The written .npz files, in the order of the sources' names.

    Raises:
      UserError: see `published_bandit`; or the folder is missing or holds no .npz.
    """
    bandits = [(path, published_bandit(path)) for path in _sources(Path(source))]
    make_folder(Path(out))
    return [
        save_bandit(
            Path(out) / f"{bandit.name}.npz",
            bandit,
            bandit.default_params.weights,
            _metadata(path),
        )
        for path, bandit in bandits
    ]


def import_published_command(
    directory: tyro.conf.Positional[Path], out: Path = Path("runs/published")
) -> None:
    """Import the bandits that the paper's authors published, so that every command takes them by file.

    Their checkpoints are pickles, which run code when they are opened, and which a current JAX does not read: convert
    them where you trust them, with the versions that wrote them. A file holds eight float32 arrays:
    initial_state/Dense_0/kernel [latent, 32], /bias [32], initial_state/Dense_1/kernel [32, observation], /bias, and
    reward/Dense_0/kernel [observation + action, 32], /bias, reward/Dense_1/kernel [32, 1], /bias.

    Args:
      directory: folder with their arrays, such as pendulum.npz, or one such file.
      out: folder for the bandits, such as Synthetic-Pendulum-v1.npz.
    """
    for path in import_published(directory, out):
        print(f"bandit: {path}")


def _sources(source: Path) -> list[Path]:
    if not source.is_dir():
        _check_is_npz(source)
        return [source]
    paths = sorted(path for path in source.iterdir() if path.suffix == ".npz")
    if not paths:
        pickles = any(path.suffix in _PICKLE_SUFFIXES for path in source.iterdir())
        raise UserError(
            f"{source} holds no .npz file"
            + (", only pickles, which run code when they are opened" if pickles else "")
            + ": give the folder with the published bandits' arrays, such as pendulum.npz."
        )
    return paths


def _check_is_npz(path: Path) -> None:
    if path.suffix in _PICKLE_SUFFIXES:
        raise UserError(
            f"{path} holds pickled objects, which run code when they are opened: only plain arrays in "
            "an .npz file are read, so convert it where you trust it."
        )
    if path.is_dir():
        raise UserError(f"{path} is a folder: give one bandit's .npz file here.")
    if not path.is_file():
        raise UserError(
            f"{path} does not exist: give the published bandits' folder, or one of its .npz files."
        )
    if path.suffix != ".npz":
        raise UserError(f"{path} is no .npz file: give the bandit's arrays, such as pendulum.npz.")


def _environment_of(path: Path) -> str:
    one_of("published bandit", path.stem, PUBLISHED_BANDITS)
    return PUBLISHED_BANDITS[path.stem]


def _metadata(path: Path) -> dict[str, Any]:
    return {
        "config": {"evaluation_environment": _environment_of(path)},
        # The release says none of these.
        "seeds": {},
        "results": {},
        "cost": {},
        "command": ORIGIN,
        "source": {
            "file": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        },
    }
