"""Objectives by name or file: PPO's clip, DPO, no drift, the learned ones of the zoo, and formulas."""

import contextlib
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from lpo.certificate import Certificate, certify
from lpo.drifts import ClipDrift, DPODrift, Drift, NoDrift, drift_from_config
from lpo.drifts.contract import check_static, with_defaults
from lpo.drifts.surrogate import SurrogateDrift
from scb import artefacts, own
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.keys import root_key
from scb.own import code_of

KIND = "drift"
KNOWN: dict[str, Drift] = {"ppo": ClipDrift(), "dpo": DPODrift(), "none": NoDrift()}
REFERENCE = "ppo"
REFERENCES = (REFERENCE, "dpo")  # what an objective is compared with where nothing else is asked
CLIPS = ("ppo-0.1", "ppo", "ppo-0.3", "ppo-0.5", "ppo-1")  # among which a tuned one is looked for
_SUGGESTED = tuple(dict.fromkeys((*KNOWN, *CLIPS, "dpo-4-1.2")))  # to who mistypes a name
_ZOO = Path(__file__).parent / "zoo"
_NUMBER = r"(\d*\.?\d+(?:e-?\d+)?)"
_CLIP_NAME = re.compile(f"ppo-{_NUMBER}")
_DPO_NAME = re.compile(f"dpo-{_NUMBER}-{_NUMBER}")


@dataclass(frozen=True, eq=False)  # parameters are arrays: `same_drift` compares
class Objective:
    """A drift with its parameters: what `scb.PPO` and its hyperparameters take.

    Two are equal where they are the same object; `lpo.objectives.same_drift` compares what they say.

    Attributes:
      name: as on the command line; a file's is its own, or of the objective.npz of a run its folder's.
      drift: the family, passed to `PPO(env, config, drift)`; of a clip or DPO it has the default settings, and the
        parameters say which it is.
      parameters: traced, passed as `PPOHyperparameters.drift`.
      metadata: of a learned objective, what its artefact says.

    Raises:
      UserError: the drift is of no family, or of one that is no frozen dataclass of hashable settings.
    """

    name: str
    drift: Drift
    parameters: Any
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.drift, Drift):
            raise UserError(
                f"the drift of the objective {self.name} is of the class {type(self.drift).__name__}: give an "
                "lpo.Drift, or a function of ratio and advantage to lpo.load_objective."
            )
        check_static(self.drift)

    def __repr__(self) -> str:
        drift = self.drift
        # Parameters of another drift are told where they are used, and not where they are shown.
        with contextlib.suppress(Exception):
            drift = drift.with_parameters(self.parameters)
        sizes = [x.size for x in jax.tree.leaves(self.parameters) if hasattr(x, "size")]
        return f"Objective({self.name!r}, {drift!r}, {sum(sizes)} parameters)"

    @property
    def sha256(self) -> str:
        """The checksum of the file that it was loaded from; empty where there is none."""
        return str(self.metadata.get("sha256", ""))

    @property
    def digests(self) -> dict[str, str]:
        """{name: SHA-256} of what its name does not tell: a file's contents, and code of somebody's own."""
        told = " ".join(filter(None, (*code_of(self.drift).values(), self.sha256)))
        return {self.name: told} if told else {}

    @property
    def learned_on(self) -> tuple[str, ...]:
        """The tasks of its search, or of that of the objective which a formula writes down; none of other formulas."""
        config = self.metadata.get("config", {})
        return tuple(config.get("meta_training", {}).get("tasks", config.get("learned_on", ())))

    @property
    def homes(self) -> tuple[str, ...]:
        """The environments that it was learned for: its tasks, or what they stand for.

        Raises:
          UserError: a task is a file that is not there, and what the objective was saved with does not say.
        """
        tasks = (environment_spec(task).evaluation_environment for task in self.learned_on)
        return tuple(self.metadata.get("config", {}).get("homes") or dict.fromkeys(tasks))


def zoo_names() -> list[str]:
    """Names of the learned objectives that ship with the library."""
    return artefacts.names_in(_ZOO)


Named: TypeAlias = "str | Path | Objective | Drift | Callable[..., Any]"


def load_objective(name: Named) -> Objective:
    """An objective by name, from a file, or of one's own.

    Args:
      name: one of
        "ppo", "ppo-0.3" (its clip), "dpo", "dpo-4-1.2" (its alpha and beta), "none", or a name of the zoo;
        a file: path.npz, or path;
        "package.module:attribute", of a module that Python finds from here, of any of the following;
        a function that returns [B] what PPO is to maximise the mean of, and takes by these names what it needs of
        ratio, log_ratio, advantage, progress, [B] each, and xp (`jax.numpy`, `numpy` or `torch`);
        an `lpo.Drift`, or its class, with the parameters that it starts with; an `Objective` is itself.

    Raises:
      UserError: unknown name (with near matches), a file that is no learned objective, or something else.
    """
    if isinstance(name, Objective):
        return name
    if isinstance(name, type) and issubclass(name, Drift):
        name = with_defaults(name, name.__name__, "give an instance with its settings")
    if isinstance(name, Drift):
        return closed_form(name.name, name)
    if callable(name) and not isinstance(name, type):
        surrogate = SurrogateDrift(name)
        return closed_form(surrogate.called, surrogate)
    if not isinstance(name, str | Path):
        raise UserError(
            f"something of the class {type(name).__name__} is no objective: give a name, a file, a function of ratio "
            "and advantage, or lpo.Objective(name, drift, parameters)."
        )
    if own.is_own(str(name)):
        mine = own.imported(str(name), "objective", "function")
        if isinstance(mine, str | Path):
            raise UserError(
                f"objective {str(name)!r} is a {type(mine).__name__}: give a function of ratio and advantage, an "
                "lpo.Drift, or an lpo.Objective."
            )
        return replace(load_objective(mine), name=str(name))
    text = str(name)
    if text in KNOWN:
        return closed_form(text, KNOWN[text])
    if clip := _CLIP_NAME.fullmatch(text):
        return closed_form(text, ClipDrift(float(clip.group(1))))
    if constants := _DPO_NAME.fullmatch(text):
        return closed_form(text, DPODrift(*map(float, constants.groups())))
    return _from_file(artefacts.named(text, _ZOO, "objective", _SUGGESTED))


def check_names(objectives: Sequence[Objective]) -> None:
    """Raises a UserError where two objectives bear one name."""
    names = [objective.name for objective in objectives]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise UserError(
            f"objective {repeated[0]!r} is there twice: give each once, and each a name of its own, in Python by a "
            "dict {name: objective}."
        )


def same_drift(one: Objective, other: Objective) -> bool:
    """Whether two objectives differ in nothing but their names, as "ppo" and "ppo-0.2" do."""
    return one.drift == other.drift and all(
        jax.tree.leaves(jax.tree.map(jnp.array_equal, one.parameters, other.parameters))
    )


def load_apart(
    names: Iterable[Named] | Mapping[str, Named], kept: Collection[str] = ()
) -> list[Objective]:
    """Objectives by what `load_objective` takes, with names of their own.

    Files of one name go by what was typed, and those of a mapping by its keys.

    Args:
      names: what to load.
      kept: names by which there are results of files already: the first file of such a name keeps it.

    Raises:
      UserError: as for `load_objective`, or one stands there twice.
    """
    if isinstance(names, str | Path | Objective | Drift) or callable(names):
        raise UserError("the objectives are a single one: give a list of them.")
    if isinstance(names, Set):
        raise UserError(
            "the objectives are a set, which has no order: give a list, with whose first the others are compared."
        )
    if isinstance(names, Mapping):
        for name in names:
            if not isinstance(name, str):
                raise UserError(
                    f"an objective is named {name!r}, which is no text: give a dict of texts, such as "
                    f"{{{str(name)!r}: ...}}."
                )
        return [replace(load_objective(of), name=name) for name, of in names.items()]
    names = list(names)
    loaded = [load_objective(name) for name in names]
    known = [objective.name for objective in loaded]
    apart: list[Objective] = []
    for objective, typed in zip(loaded, names, strict=True):
        first = objective.name in kept and objective.name not in (x.name for x in apart)
        if known.count(objective.name) > 1 and isinstance(typed, str | Path) and not first:
            objective = replace(objective, name=str(typed))
        apart.append(objective)
    check_names(apart)
    return apart


def learned_in(objectives: Sequence[Objective]) -> list[str]:
    """The environments that objectives were learned for: themselves, or what their bandits stand for."""
    return sorted({home for objective in objectives for home in objective.homes})


def run_name(file: Path) -> str:
    """What to call an objective's file: every run's is objective.npz, and its folder tells runs apart."""
    return file.parent.name if file.stem == "objective" else file.stem


def closed_form(name: str, drift: Drift) -> Objective:
    """The objective of a drift whose parameters its settings say: none of them is random."""
    if isinstance(drift, SurrogateDrift):
        drift.check_slope()
    return Objective(name, _family(drift), drift.init(root_key(0)))


def _family(drift: Drift) -> Drift:
    """The drift with default settings where parameters say all that settings do: one program then trains all such."""
    # Of a subclass there may be settings that its parameters do not say.
    return type(drift)() if type(drift) in (ClipDrift, DPODrift) else drift


def _from_file(path: Path) -> Objective:
    artefact = artefacts.load(path, KIND)
    with artefacts.described(path, "drift", "config entry 'drift'"):
        drift = drift_from_config(artefact.metadata["config"]["drift"])
        shapes = drift.shapes()
    artefacts.expect_shapes(artefact, shapes)
    parameters = jax.tree.map(jnp.asarray, dict(artefact.arrays))
    # Where settings say the parameters, a reader trusts those.
    if drift.with_parameters(parameters) != drift:
        raise UserError(
            f"{path} holds other numbers than the expression in its .json: fetch or save both again."
        )
    return Objective(run_name(path.resolve()), _family(drift), parameters, artefact.metadata)


def save_objective(
    path: str | Path,
    drift: Drift,
    parameters: Any,
    metadata: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Path, Certificate]:
    """Writes a learned objective, or a formula, with its certificate.

    Args:
      path: NAME.npz; NAME.json is written beside it.
      drift: any member of the contract.
      parameters: its own.
      metadata: config (of the meta-training), seeds, results, cost, command, what of it there is to tell.

    Raises:
      UserError: parameters of another drift, or of one that is its settings.
    """
    if not isinstance(drift, Drift):
        raise UserError(
            f"something of the class {type(drift).__name__} is no drift: give that of the search's configuration, or "
            "an objective's objective.drift with its objective.parameters."
        )
    if not isinstance(drift.init(root_key(0)), Mapping):
        raise UserError(
            f"a drift of the family {drift.name} is its settings, and its parameters are no dict to be saved: name "
            "the objective, such as ppo-0.3."
        )
    if not isinstance(parameters, Mapping):
        raise UserError(
            f"the parameters of a drift of the family {drift.name} are a dict of arrays, and not of the class "
            f"{type(parameters).__name__}: of a search give outcome.mean."
        )
    told = drift.with_parameters(parameters)
    if told != drift:  # trained on: what its text says now is what is saved
        drift, parameters = told, told.init(root_key(0))
    held = artefacts.Artefact(drift.name, parameters, {"kind": KIND})
    artefacts.expect_shapes(held, drift.shapes())
    artefacts.expect_numbers(path, parameters)
    certificate = certify(drift, parameters)
    config = {**metadata.get("config", {}), "drift": drift.to_config()}
    full = {**metadata, "kind": KIND, "config": config, "certificate": certificate.as_dict()}
    return artefacts.save(path, jax.device_get(parameters), full), certificate
