"""What becomes of a run that is killed, and of files that somebody damaged: nothing is lost, and nothing is believed.

    make torture

Kills: a discovery and a meta-training, each a command of its own, are ended at random moments of their lives, by
SIGKILL and SIGTERM in turn, and resumed until they have ended; the bytes of what they leave are compared with
those of a run that nobody disturbed. Mutations: artefacts of the zoo, configurations and rows of runs, changed
at random in their JSON or their bytes, are read as the commands read them.
"""

import contextlib
import copy
import hashlib
import io
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Experiment, Save
from experiments.reports import Report, settled
from lpo import objectives
from lpo.commands import MetaTrain
from scb.commands import Discover
from scb.configurations import config_dict
from scb.environments import zoo
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least, one_of
from scb.gymnasium import SyntheticEnv
from scb.rows import Rows, pivot

SMALL = [
    "--population-size=4",
    "--agents-per-candidate=1",
    "--generations=12",
    "--checkpoint-every=3",
]
SMALL += ["--mean-evaluations=4", "--evaluate-mean-every=6"]
COMMANDS = {
    "discovery": ["scb", "discover", "--init=random", *SMALL],
    "meta-training": ["lpo", "meta-train", *SMALL],
}
# What a run does not keep among its settings.
ALWAYS = {"discover": ["--judge-agents=0"], "meta-train": []}
SIGNALS = (signal.SIGKILL, signal.SIGTERM)
# What takes the place of a value.
VALUES: list[Any] = [None, True, False, 0, -1, 1, 3, 10**9, -0.5, 1e308, 1e-320]
VALUES += ["", "x", "0", "nan", "__class__", "../../x", [], [0], {}, {"x": 1}, [[[]]], "é" * 9]
# Of an artefact's configuration, what is computed with.
USED = ("bandit", "observation_size", "action_space", "evaluation_environment", "drift")


@dataclass(frozen=True)
class Options:
    """How often."""

    kills: int = 100
    """of each command"""
    commands: tuple[str, ...] = tuple(COMMANDS)
    """that are killed"""
    mutations: int = 10_000
    """of all kinds together"""
    seed: int = 0
    """decides moments and mutations"""

    def __post_init__(self) -> None:
        at_least(0, self, "kills", "mutations", "seed")
        for name in self.commands:
            one_of("command", name, COMMANDS)


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """Kills first; what a report holds already is not done again."""
    settled(report, seed=options.seed)
    kills = report.setdefault("kills", {})
    with tempfile.TemporaryDirectory() as folder:
        for name in options.commands:
            command = COMMANDS[name]
            killed = kills.setdefault(name, [])
            if len(killed) < options.kills:
                torment(Path(folder), name, command, options, killed, save)
        if report.get("mutations", {}).get("number", -1) < options.mutations:
            report["mutations"] = mutate_all(Path(folder), options)
            save()


# -- kills ----------------------------------------------------------------------------------------


def torment(
    folder: Path,
    name: str,
    command: list[str],
    options: Options,
    killed: list[dict[str, Any]],
    save: Save,
) -> None:
    """Ends runs of one command until `killed` has as many entries as are wanted, and says of each what came of it."""
    whole = folder / f"{name}-whole"
    ended(command, whole)
    wanted = fingerprint(whole)
    shutil.rmtree(whole)
    started = time.monotonic()
    ended(command, whole)  # the second is not compiled again, as those that are killed are not
    seconds = time.monotonic() - started
    attempt = 0
    while len(killed) < options.kills:
        number = len(killed)
        rng = random.Random(f"{options.seed} {name} {number} {attempt}")
        run, deaths = folder / f"{name}-{number}-{attempt}", []
        attempt += 1
        # Several ends of one run, so that a resumed one is ended too.
        for _ in range(rng.randint(1, 3)):
            how = rng.choice(SIGNALS)
            status = ended(command, run, rng.uniform(0, seconds), how)
            deaths.append([how.name, status])
            if status == 0:
                break
        if not any(status for _, status in deaths):
            continue  # it had ended before its moment came
        status = ended(command, run)
        same = fingerprint(run) == wanted
        killed.append({"ends": deaths, "status": status, "same": same})
        save()
        print(name, number, killed[-1], flush=True)
        shutil.rmtree(run, ignore_errors=True)


def ended(
    command: list[str],
    run: Path,
    after: float | None = None,
    how: signal.Signals = signal.SIGKILL,
) -> int:
    """Starts or resumes a run, ends it after so many seconds where they are given, and returns its exit status."""
    if run.exists() and not (run / "config.json").exists():
        shutil.rmtree(run)  # killed before there was anything to resume
    program, subcommand, *flags = command
    flags = [f"--resume={run}"] if run.exists() else [*flags, f"--out={run}"]
    code = f"import sys; from {program}.cli import main; sys.exit(main())"
    quiet = subprocess.DEVNULL
    command = [sys.executable, "-c", code, subcommand, *flags, *ALWAYS[subcommand]]
    process = subprocess.Popen(command, stdout=quiet, stderr=quiet)
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(after)
    process.send_signal(how)
    return process.wait()


def fingerprint(run: Path) -> dict[str, str]:
    """{file: digest} of what a run leaves and no clock decides."""
    files = [*sorted(run.glob("*.npz")), run / "metrics.jsonl"]
    return {x.name: hashlib.sha256(x.read_bytes()).hexdigest() if x.exists() else "" for x in files}


# -- mutations ------------------------------------------------------------------------------------


def mutate_all(folder: Path, options: Options) -> dict[str, Any]:
    """Outcomes of all mutations, {kind: {outcome: number}}, and what ended in a traceback."""
    kinds = list(targets(folder / "mutated"))
    outcomes: dict[str, Counter[str]] = {name: Counter() for name, _, _ in kinds}
    failures: list[str] = []
    slowest = 0.0
    for number in range(options.mutations):
        name, change, read = kinds[number % len(kinds)]
        rng = random.Random(f"{options.seed} {name} {number}")
        said = change(rng)
        started = time.monotonic()
        outcome = read_mutated(read)
        slowest = max(slowest, time.monotonic() - started)
        if outcome not in ("taken", "refused"):
            failures.append(f"{name}, {said}: {outcome}")
            outcome = "traceback"
        outcomes[name][outcome] += 1
    return {
        "number": options.mutations,
        "outcomes": {name: dict(counts) for name, counts in outcomes.items()},
        "failures": failures,
        "slowest_seconds": round(slowest, 1),
    }


def read_mutated(read: Callable[[], None]) -> str:
    """What becomes of a file: taken, refused in a sentence, or the traceback's last lines."""
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            read()
    except UserError as error:
        return "refused" if "\n" not in str(error) else f"several lines: {error}"
    except SystemExit as error:
        return "refused" if error.code == 2 else f"exit {error.code}"
    except Exception:
        return "".join(traceback.format_exc().splitlines(keepends=True)[-4:])
    return "taken"


def targets(
    folder: Path,
) -> Iterator[tuple[str, Callable[[random.Random], str], Callable[[], None]]]:
    """(kind, what changes its files at random and says how, what reads them) of everything that is read."""
    folder.mkdir(parents=True)
    bandits = [zoo._ZOO / f"{name}.npz" for name in zoo.zoo_names()]
    drifts = [
        Path(objectives.__file__).with_name("zoo") / f"{n}.npz" for n in objectives.zoo_names()
    ]
    artefact = folder / "made.npz"

    def use_bandit() -> None:
        env = SyntheticEnv(str(artefact))
        env.reset(seed=0)
        env.step(env.action_space.sample())
        environment_spec(environment_spec(str(artefact)).evaluation_environment)

    def use_objective() -> None:
        loaded = objectives.load_objective(artefact)
        zeros = np.zeros(3, np.float32)
        loaded.drift(loaded.parameters, zeros, zeros, zeros)

    for name, paths, use in (("bandit", bandits, use_bandit), ("objective", drifts, use_objective)):

        def in_json(rng: random.Random, paths: list[Path] = paths) -> str:
            original = rng.choice(paths)
            shutil.copy(original, artefact)
            metadata = json.loads(original.with_suffix(".json").read_text())
            # Most of it says where it came from, which nobody computes with.
            parts = [x for x in USED if x in metadata["config"]]
            if rng.random() < 0.8:
                part = rng.choice(parts)
                metadata["config"][part], said = mutated(metadata["config"][part], rng)
                said = f"config.{part}: {said}"
            else:
                metadata, said = mutated(metadata, rng)
            artefact.with_suffix(".json").write_text(json.dumps(metadata))
            return f"{original.stem} {said}"

        def in_arrays(rng: random.Random, paths: list[Path] = paths) -> str:
            original = rng.choice(paths)
            data, said = mutated_bytes(original.read_bytes(), rng)
            artefact.write_bytes(data)
            metadata = json.loads(original.with_suffix(".json").read_text())
            if rng.random() < 0.8:  # as one does who means it
                metadata["sha256"] = hashlib.sha256(data).hexdigest()
            artefact.with_suffix(".json").write_text(json.dumps(metadata))
            return f"{original.stem} {said}"

        yield f"{name}: its JSON", in_json, use
        yield f"{name}: its arrays", in_arrays, use

    for command in (Discover, MetaTrain):
        made: Any = command()
        stored = {"command": made.command, "config": config_dict(made.config)}
        run = folder / command.__name__

        def in_config(rng: random.Random, stored: Any = stored, run: Path = run) -> str:
            run.mkdir(exist_ok=True)
            config, said = mutated(copy.deepcopy(stored), rng)
            (run / "config.json").write_text(json.dumps(config))
            return said

        def resume(command: Any = command, run: Path = run) -> None:
            command.parse([f"--resume={run}"]).open().close()

        yield f"configuration of {command.program}", in_config, resume

    rows, whole = folder / "rows.jsonl", folder / "whole.jsonl"
    agent = {"environment": "x", "backend": None, "trained_in": "y", "algorithm": "ppo"}
    columns = {**agent, "objective": None}
    configuration = {"agent": {"config": 1}, "objective": None}
    measured = Rows(whole).cell(columns, configuration, 2)
    for number in range(2):
        earned = {"actions": "mode", "return": 1.0}
        measured.add((1, number), [{"step": step, **earned} for step in (0, 10)])

    def in_rows(rng: random.Random) -> str:
        lines, said = mutated([*map(json.loads, whole.read_text().splitlines())], rng)
        listed = lines if isinstance(lines, list) else [lines]
        text = "".join(json.dumps(x) + "\n" for x in listed)
        described, also = json.loads(whole.with_suffix(".json").read_text()), "none"
        if rng.random() < 0.5:  # else few are read as far as the rows
            described, also = mutated(described, rng)
        cut = rng.randrange(len(text) + 1) if rng.random() < 0.3 else len(text)
        rows.write_text(text[:cut])
        rows.with_suffix(".json").write_text(json.dumps(described))
        return f"{said}, {also}, cut at {cut}"

    def use_rows() -> None:
        found = Rows(rows).cell(columns, configuration, 2)
        for of_it in found.done.values():
            pivot(of_it, "step")

    yield "rows of a measurement", in_rows, use_rows


def mutated(tree: Any, rng: random.Random) -> tuple[Any, str]:
    """A JSON tree with one to three places changed: another value, a missing or a further entry."""
    tree, said = copy.deepcopy(tree), []
    for _ in range(rng.randint(1, 3)):
        path: list[Any] = []
        parent: Any = None
        key: Any = None
        node = tree
        while isinstance(node, dict | list) and node and (parent is None or rng.random() < 0.8):
            parent = node
            key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
            node = parent[key]
            path.append(key)
        value = copy.deepcopy(rng.choice(VALUES))
        if parent is None:
            tree = value
            continue
        action = rng.choice(("replaced", "replaced", "removed", "added"))
        said.append(f"{'.'.join(map(str, path))} {action}{f': {value!r}' * (action != 'removed')}")
        if action == "replaced":
            parent[key] = value
        elif action == "removed":
            del parent[key]
        elif isinstance(parent, dict):
            parent[rng.choice(["x", "", "name", "weights"])] = value
        else:
            parent.append(value)
    return tree, "; ".join(said)


def mutated_bytes(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """An .npz with bytes flipped, cut off or added, or with arrays of another shape, type or content."""
    how = rng.choice(("flipped", "cut", "added", "array", "array", "pickled", "renamed"))
    if how == "flipped":
        changed = bytearray(data)
        for _ in range(rng.randint(1, 8)):
            changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(changed), how
    if how == "cut":
        return data[: rng.randrange(len(data))], how
    if how == "added":
        return data + rng.randbytes(rng.randint(1, 99)), how
    with np.load(io.BytesIO(data)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = rng.choice(list(arrays))
    if how == "renamed":
        arrays[rng.choice(["x", "a/b/c", "../x", f"{name}/x"])] = arrays.pop(name)
    elif how == "pickled":
        arrays[name] = np.array([{"__reduce__": print}, None], object)
    else:
        array = arrays[name]
        others: list[Any] = [
            array[None],
            array.ravel(),
            array.ravel()[:0],
            array * np.nan,
            array + np.inf,
        ]
        others += [array.astype(np.float64), array.astype(bool), array.astype("U"), array + 1j]
        others += [np.float32(3), array.T, np.zeros((2,) * 12, np.float32), array * 1e30]
        arrays[name] = rng.choice(others)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue(), f"{how} {name}"


# -- the page -------------------------------------------------------------------------------------


def facts(report: Report) -> dict[str, Any]:
    """Counts of what became of everything."""
    kills = report["kills"]
    return {
        "tables": {
            name: {
                "runs": len(runs),
                "ends": Counter(how for run in runs for how, status in run["ends"] if status),
                "told": Counter(
                    status
                    for run in runs
                    for how, status in run["ends"]
                    if how == "SIGTERM" and status
                ),
                "same": sum(run["same"] for run in runs),
            }
            for name, runs in kills.items()
        },
        "runs": sum(map(len, kills.values())),
        "same": sum(run["same"] for runs in kills.values() for run in runs),
        "tracebacks": len(report["mutations"]["failures"]),
    }


EXPERIMENT = Experiment(
    "reliability",
    "What happens to a run that is killed, and with a damaged file?",
    measure,
    facts=facts,
    options=Options,
    keys=("seed", "kills", "mutations"),
)
