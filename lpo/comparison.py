"""Does an objective carry over? Train PPO with several objectives on the same seeds and compare.

Every objective meets the same seeds: the same initial networks, start states and evaluation
episodes, so that differences are paired. Final scores are interquartile means with bootstrap
intervals.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from lpo.objectives import Named, load_apart
from scb.agents.ppo import DIAGNOSIS
from scb.agents.spec import AgentSpec, environment_agent
from scb.environments.registry import environment_spec
from scb.errors import UserError, one_of
from scb.files import make_folder, plain
from scb.locks import held
from scb.measurement import EARNED, MODE, SAMPLED, Place, as_random, check_seeds, measure
from scb.rows import Rows, pivot
from scb.statistics import Estimate, estimate, few_agents, paired_difference

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ARRAYS = ("lengths", "speeds", "diagnosis")


@dataclass(frozen=True)
class LearningCurves:
    """Returns of agents over their training.

    Attributes:
      environment: where.
      backend: of Brax's physics; None outside Brax.
      objective: with which.
      steps: [P] environment steps at each evaluation, the first 0.
      returns: [S, P] mean return of `episodes` episodes, per seed.
      mode_actions: whether evaluation took the most likely actions or sampled ones.
      hyperparameters: {name: value} of what is other than in PPO's setting for that environment.
      lengths: [S, P] mean steps of those episodes; None of curves that were made elsewhere.
      speeds: [S, P] their mean forward velocity, NaN where the environment has none; None likewise.
      diagnosis: {name: [S, P]} of what an iteration does to the policy (`scb.agents.ppo.PPO.diagnose`); None where
        it was not asked for.
      failed: agents that had no finite return at some point, where they count as random actions.
    """

    environment: str
    backend: str | None
    objective: str
    steps: np.ndarray
    returns: np.ndarray
    seeds: list[int]
    episodes: int
    mode_actions: bool
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    lengths: np.ndarray | None = None
    speeds: np.ndarray | None = None
    diagnosis: dict[str, np.ndarray] | None = None
    failed: int = 0

    @property
    def final(self) -> np.ndarray:
        """[S] return at the end of training."""
        return self.returns[:, -1]

    @property
    def late(self) -> np.ndarray:
        """[S] mean return over the last quarter of the training: a level, where a single evaluation is a moment."""
        return self.returns[:, self.steps > 0.75 * self.steps[-1]].mean(axis=1)

    @property
    def early(self) -> np.ndarray:
        """[S] mean return over the first half of the training, the untrained agent left out."""
        chosen = (self.steps > 0) & (self.steps <= 0.5 * self.steps[-1])
        if not chosen.any():
            raise UserError(
                "no evaluation lies in the first half of the training: compare with 2 points or more."
            )
        return self.returns[:, chosen].mean(axis=1)

    @property
    def area(self) -> np.ndarray:
        """[S] mean return over the training, the untrained agent left out."""
        return self.returns[:, 1:].mean(axis=1)

    @property
    def diagnosed(self) -> int:
        """How many agents say what an iteration does to them."""
        if self.diagnosis is None:
            return 0
        return int((~np.isnan(self.diagnosis["kl"]).any(axis=1)).sum())

    @property
    def standing_still(self) -> float | None:
        """What an episode without a fall and without moving earns here; None where that means nothing."""
        return environment_spec(self.environment).standing_still(self.backend)

    @property
    def above_standing_still(self) -> float | None:
        """Share of the agents that end above that."""
        standing = self.standing_still
        return None if standing is None else float(np.mean(self.final > standing))

    def paired(
        self, reference: "LearningCurves", of: str = "final"
    ) -> tuple[np.ndarray, np.ndarray]:
        """([S, ...], [S, ...]) "final", "early", "late", "area" or "returns" of both, of the S seeds that both have."""
        shared = [seed for seed in self.seeds if seed in reference.seeds]
        ours, theirs = (
            getattr(x, of)[[x.seeds.index(seed) for seed in shared]] for x in (self, reference)
        )
        return ours, theirs

    def as_dict(self) -> dict[str, Any]:
        moving = {
            name: [plain(x) for x in values[:, -1]]
            for name, values in (("final_lengths", self.lengths), ("final_speeds", self.speeds))
            if values is not None
        }
        return {
            **{k: v for k, v in vars(self).items() if k not in _ARRAYS},
            "steps": self.steps.tolist(),
            "returns": self.returns.tolist(),
            "final_iqm": estimate(self.final).as_dict(),
            "area_iqm": estimate(self.area).as_dict(),
            **moving,
            "standing_still": self.standing_still,
            "above_standing_still": self.above_standing_still,
        }


@dataclass(frozen=True)
class Comparison:
    """Learning curves of several objectives on one environment, the first of them the reference."""

    curves: list[LearningCurves]

    @property
    def by_name(self) -> dict[str, LearningCurves]:
        """{objective: its curves}, in their order."""
        return {curves.objective: curves for curves in self.curves}

    def differences(self, of: str = "final") -> dict[str, Estimate]:
        """{objective: difference of IQM to the reference}, of the seeds of both; positive where it is better.

        Args:
          of: "final", "early", "late" or "area" returns, as `LearningCurves` has them.
        """
        one_of("kind of return", of, ("final", "early", "late", "area"))
        both = {c.objective: c.paired(self.curves[0], of) for c in self.curves[1:]}
        return {name: paired_difference(*x) for name, x in both.items() if x[0].size}

    def figure(self) -> "Figure":
        """Interquartile mean returns along the training, and each seed's at its end, with 95 % intervals."""
        from lpo.figures import learning_curves  # which takes long to import

        return learning_curves(self.curves)

    @property
    def caution(self) -> str:
        """What to hold against the comparison, in sentences; empty for nothing."""
        sentences = [
            f"{c.failed} of {len(c.seeds)} agents of {c.objective} diverged: where they have no return, they count as "
            "random actions."
            for c in self.curves
            if c.failed
        ]
        standing = self.curves[0].standing_still
        if standing is not None and not any(c.above_standing_still for c in self.curves):
            sentences.append(
                f"No agent is above standing still ({standing:g}): of moving, this tells one objective from another "
                "nothing. Train for longer, or with other physics."
            )
        return " ".join(sentences)

    @property
    def few(self) -> str:
        """That there are too few agents for an interval to tell anything; empty where there are enough."""
        return few_agents(min(len(c.seeds) for c in self.curves))

    def as_dict(self) -> dict[str, Any]:
        return {
            "curves": [c.as_dict() for c in self.curves],
            "reference": self.curves[0].objective,
            "paired_differences": {k: v.as_dict() for k, v in self.differences().items()},
            "caution": " ".join(x for x in (self.caution, self.few) if x),
        }


# Of PPO's fields those that are no hyperparameters of a comparison, and what they are.
_APART = {
    "drift": "the objective's own",
    "horizon": "the length of the training, that is, steps",
    "total_steps": "the steps, which --steps gives, and in Python a spec",
}


def ppo_spec(
    environment: str,
    steps: int | None = None,
    hyperparameters: Mapping[str, Any] = MappingProxyType({}),
) -> AgentSpec:
    """PPO as the environment has it, but for steps and hyperparameters where given.

    Args:
      environment: a name that `scb.make` takes.
      steps: environment steps of a training, rounded up to whole batches.
      hyperparameters: {name: value} of `scb.PPOHyperparameters` and `scb.PPOConfig`, such as a learning_rate,
        num_envs or a policy_output_scale.

    Raises:
      UserError: there is no such hyperparameter, or it cannot have the value.
    """
    spec = environment_agent("ppo", environment).with_steps(steps)
    known = _values(spec)
    for name, value in hyperparameters.items():
        if name in _APART:
            raise UserError(f"{name} is no hyperparameter here: it is {_APART[name]}.")
        one_of("hyperparameter of PPO", name, known)
        if value is None:
            raise UserError(
                f"{name} has no value: give one, or leave it out for the environment's own."
            )
    return spec.with_values(**hyperparameters)


def changed(spec: AgentSpec, environment: str) -> dict[str, Any]:
    """{hyperparameter: value} of what a specification has other than PPO's own for the environment."""
    own = _values(ppo_spec(environment))
    return {name: value for name, value in _values(spec).items() if value != own[name]}


def _as_json(value: Any) -> Any:
    """A number of NumPy or JAX as Python's."""
    return value.item() if hasattr(value, "item") else value


def _values(spec: AgentSpec) -> dict[str, Any]:
    return {
        f.name: _as_json(getattr(of, f.name))
        for of in (spec.hyperparameters, spec.config)
        for f in fields(of)
        if f.name not in _APART
    }


def compare(
    environment: str,
    objectives: Sequence[Named] | Mapping[str, Named],
    seeds: Sequence[int],
    spec: AgentSpec | None = None,
    backend: str | None = None,
    points: int = 15,
    episodes: int = 20,
    mode_actions: bool = True,
    diagnose: bool = False,
    rows: Rows | str | Path | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> Comparison:
    """Trains one PPO agent a seed with each objective, evaluating along the way.

    Args:
      environment: a name that `scb.make` takes.
      objectives: what replaces PPO's surrogate, as `load_objective` takes it, or {name: objective}; the first is what
        the others are compared with.
      seeds: one agent each; the same seeds pair agents of different objectives.
      spec: PPO's; the environment's own where None.
      backend: of an environment with a choice of physics, such as "spring" in Brax.
      points: about how many evaluations along the training, the untrained agent not counted.
      episodes: of each evaluation.
      mode_actions: evaluate the most likely actions rather than sampled ones.
      diagnose: whether curves say also what an iteration does to the policy (`scb.PPO.diagnose`).
      rows: a .jsonl file in which results are kept, and found, so that they are not measured again; None for memory.
        It is this process's meanwhile: jobs that run side by side have files of their own.
      tell: takes a line when some agents are done.

    Raises:
      UserError: there are no objectives, or two bear one name, by which their results are told apart; another process
        measures into the same file.
    """
    loaded = load_apart(objectives)
    if not loaded:
        raise UserError("no objectives: give at least one, such as ppo.")
    whole = check_seeds(seeds)
    spec = spec or ppo_spec(environment)
    place = Place.named(environment, backend)
    with _kept(rows) as kept:
        found = measure(
            spec,
            place,
            agents=whole,
            objectives=loaded,
            points=points,
            episodes=episodes,
            actions=(MODE if mode_actions else SAMPLED,),
            diagnose=diagnose,
            rows=kept,
            tell=tell,
        )
    steps = np.asarray(list(dict.fromkeys(row["step"] for row in found)))
    other = changed(spec, environment)
    columns = (*EARNED, *(DIAGNOSIS if diagnose else ()))
    measured = {value: pivot(found, "objective", "seed", "step", value=value) for value in columns}
    measured["return"], failed = as_random(measured["return"], place)
    return Comparison(
        [
            LearningCurves(
                environment,
                place.backend,
                objective.name,
                steps,
                measured["return"][i],
                whole,
                episodes,
                mode_actions,
                other,
                measured["length"][i],
                measured["speed"][i],
                {name: measured[name][i] for name in DIAGNOSIS} if diagnose else None,
                int(failed[i].any(axis=1).sum()),
            )
            for i, objective in enumerate(loaded)
        ]
    )


@contextmanager
def _kept(rows: str | Path | Rows | None) -> Iterator[Rows | None]:
    """Within it a file of rows is this process's: two would each drop what the other has added."""
    if rows is None or isinstance(rows, Rows):
        yield rows
        return
    if not isinstance(rows, str | Path):
        raise UserError(f"rows are {rows!r}: give the path of a .jsonl file, or None.")
    file = Path(rows).expanduser()
    if not file.is_file():
        Rows(file)  # refuses a name before a folder is made
    elif not os.access(file.parent, os.W_OK):
        yield Rows(file)  # to read what is complete
        return
    make_folder(file.parent, "place")
    with held(file):
        yield Rows(file)


def learning_curves(
    environment: str, objective: Named, seeds: Sequence[int], **arguments: Any
) -> LearningCurves:
    """`compare` with a single objective."""
    (curves,) = compare(environment, [objective], seeds, **arguments).curves
    return curves
