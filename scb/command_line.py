"""A configuration's dataclass is its command line: tyro reads it, and the command of a run is written from it.

A setting is one field with its docstring. Where its flag has another name, or its value is one word of
text (`ppo,sac`), the field's annotation says so, with `tyro.conf.arg` and `text`.
"""

import argparse
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from scb import processes
from scb.configurations import config_dict
from scb.errors import UserError, flag_name, one_of
from scb.locks import released
from scb.machine import package_versions
from scb.rows import Rows
from scb.runs import Run, read_config

T = TypeVar("T")
GENERATIONS = ("evolution.num_generations",)
# Flags are the fields' names without those of the dataclasses that they are in; comments are for readers of code.
_STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff)


def text(
    read: Callable[[str], T], write: Callable[[T], str], metavar: str, spaced: bool = False
) -> Any:
    """Annotates a field whose value is text of the command line; `read` raises a UserError for a wrong one.

    Args:
      spaced: of several words, which may stand in quotes, as a command writes them itself, or not.
    """

    def instance(words: list[str]) -> T:
        if not words:
            raise UserError(f"a flag that takes {metavar} has no value: give one, or leave it out.")
        return read(" ".join(words))

    return PrimitiveConstructorSpec(
        nargs="*" if spaced else 1,
        metavar=metavar,
        instance_from_str=instance,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [write(value)],
    )


def listed(words: str, what: str) -> tuple[str, ...]:
    """The names in "a,b"."""
    names = tuple(name.strip() for name in words.split(",") if name.strip())
    if not names:
        raise UserError(f"the list of {what} is empty: give one or more, separated by commas.")
    return names


def numbers(words: str, what: str) -> tuple[float, ...]:
    """The numbers in "0.25,1"."""
    try:
        return tuple(float(x) for x in listed(words, what))
    except ValueError as error:
        raise UserError(
            f"{what} {words!r} are no numbers: give them separated by commas, such as 0.25,0.5,1."
        ) from error


def flags(config: Any, default: Any) -> Iterator[str]:
    """The flags that make of `default` this configuration, a dataclass of the same type."""
    hints = get_type_hints(type(config), include_extras=True)
    for entry in fields(config):
        value, other = getattr(config, entry.name), getattr(default, entry.name)
        annotations = getattr(hints[entry.name], "__metadata__", ())
        if value == other or tyro.conf.Suppress in annotations:
            continue
        written = [x for x in annotations if isinstance(x, PrimitiveConstructorSpec)]
        if is_dataclass(value) and not written:
            yield from flags(value, other)
            continue
        name = flag_name(hints[entry.name], entry.name).replace("_", "-")
        if isinstance(value, bool):
            yield f"--{name}" if value else f"--no-{name}"
        elif isinstance(value, tuple) and not written:
            yield from (f"--{name}", *map(str, value))
        else:
            yield f"--{name}={written[0].str_from_instance(value)[0] if written else value}"


def flag_names(config: Any, without: type) -> Iterator[str]:
    """Names of the flags of a dataclass and those in it, but for one of that type."""
    hints = get_type_hints(type(config), include_extras=True)
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value) and not isinstance(value, without):
            yield from flag_names(value, without)
        elif not isinstance(value, without):
            yield flag_name(hints[entry.name], entry.name)


@dataclass(frozen=True)
class Output:
    """What the run writes, and where.

    Attributes:
      out: folder to write; must be new or empty.
      resume: a run folder to continue; its configuration applies, and a flag that contradicts it is
        an error.
      wandb: project to log to, with the extra `wandb`.
    """

    out: Path
    resume: Path | None = None
    wandb: str | None = None


@dataclass(frozen=True)
class SharedOutput(Output):
    """As `Output`, of a run that several processes may compute together.

    Attributes:
      coordinator: HOST:PORT of the first of several processes that compute the run together. Started by
        SLURM's srun or Open MPI's mpirun they find each other without these flags.
      processes: how many there are.
      process: which one this is, from 0.
    """

    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None


@dataclass(frozen=True, kw_only=True)
class LongRun(ABC):
    """A command that leaves a run folder: a configuration, which the folder stores, from a preset and flags.

    A subclass has the fields `config` and `output`, and for the class:

    Attributes:
      program: the names of program and command.
      presets: {name: (deciding flags that were given, by name) -> configuration}.
      deciding: flags that other settings' defaults depend on. A flag without a value is "".
      together: whether several processes may compute a run together.
    """

    config: Any
    output: Any
    preset: str = "quick"

    program: ClassVar[str]
    presets: ClassVar[Mapping[str, Callable[[Mapping[str, str]], Any]]]
    deciding: ClassVar[tuple[str, ...]] = ()
    together: ClassVar[bool] = False

    @classmethod
    def decided(cls, config: Any) -> dict[str, str]:
        """The deciding flags that a configuration has."""
        return {}

    def inputs(self) -> Mapping[str, str]:
        """{name: SHA-256} of the bandits that a search begins with, whose names say nothing of what is in them."""
        return {}

    def growing(self) -> Collection[str]:
        """Settings, such as "evolution.num_generations", of which a resumed run may have more (`Run.open`)."""
        return ()

    @abstractmethod
    def run(self) -> None:
        """Does what the command is for."""

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> Self:
        """The command with these flags: those that a resumed run was started with, over its preset, come first."""
        folder = flags_given(arguments, "resume").get("resume")
        if folder == "":
            raise UserError(
                "--resume names no run: give the folder of one, such as --resume runs/NAME."
            )
        if folder is not None:
            out = flags_given(arguments, "out").get("out", folder)
            if Path(out) != Path(folder):
                raise UserError(
                    f"--out is {out} and --resume {folder}: a resumed run goes on in its own folder; leave out --out."
                )
            # Of several processes the first has the folder.
            stored = processes.told(processes.by_first(partial(cls._stored, folder)))
            arguments = [*stored, *arguments]
        given = flags_given(arguments, "preset", *cls.deciding)
        preset = given.get("preset", "quick")
        one_of("preset", preset, cls.presets)
        default = cls(config=cls.presets[preset](given), preset=preset)  # type: ignore[call-arg]
        return tyro.cli(cls, default=default, prog=cls.program, args=arguments, config=_STYLE)

    @classmethod
    def _stored(cls, folder: str) -> list[str]:
        stored = read_config(folder)
        command = stored.get("command")
        if "config" not in stored or not isinstance(command, str):
            raise UserError(
                f"cannot resume {folder} with {cls.program}: an experiment started it, whose command goes on with "
                "it, or an earlier version, with other numbers; start another with --out."
            )
        try:
            words, program = shlex.split(command), cls.program.split()
        except ValueError as error:
            raise UserError(
                f"cannot resume {folder}: the command in its config.json is damaged ({error}); start another."
            ) from error
        if words[: len(program)] != program:
            raise UserError(
                f"cannot resume {folder} with {cls.program}: it was started with {command}."
            )
        return words[len(program) :]

    @property
    def command(self) -> str:
        """What starts the same run afresh, however it was typed or resumed: what differs from the preset."""
        preset, decided = self.presets[self.preset], self.decided(self.config)
        without = self.decided(preset({}))
        words = [] if self.preset == "quick" else [f"--preset={self.preset}"]
        words += [_word(k, v) for k, v in decided.items() if v != without.get(k)]
        words += flags(self.config, preset(decided))
        return shlex.join([*self.program.split(), *words])

    def further(self) -> Iterator[str]:
        """Flags of what a resumed run does besides, or after it, which is no part of what it finds."""
        if wandb := getattr(self.output, "wandb", None):
            yield f"--wandb={wandb}"

    def open(self) -> Run:
        """The run folder, new or resumed."""
        output, wandb = self.output, getattr(self.output, "wandb", None)
        command = " ".join([self.command, *map(shlex.quote, self.further())])
        stored: dict[str, Any] = {"command": command, "config": config_dict(self.config)}
        if inputs := self.inputs():
            stored["inputs"] = inputs
        folder, resumed = output.resume or output.out, output.resume is not None
        growing = [f"config.{name}" for name in self.growing()]
        opened = partial(Run.open, folder, stored, resumed, wandb, growing, self.config)
        return processes.by_first(opened) or Run(folder, resumed)


@dataclass(frozen=True)
class Kept:
    """Where agents' returns are kept as they come.

    Attributes:
      out: folder for rows.jsonl and for what is made of them; must be new or empty, but for a suite that was begun.
      resume: a folder that such a command wrote, and was perhaps interrupted; its settings apply, and a
        flag that contradicts them is an error.
    """

    out: Path | None = None
    resume: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Measuring(LongRun):
    """A command that trains agents and keeps their rows, in a folder where one is named."""

    output: Kept = field(default_factory=Kept)
    preset: tyro.conf.Suppress[str] = "quick"

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> Self:
        command = super().parse(arguments)
        if command.output.resume is None:
            return command
        return replace(command, output=replace(command.output, out=None))  # which is the same

    def opened(self) -> tuple[Path | None, Rows]:
        """The folder of the results, and the rows in it; without a folder in memory."""
        if self.output == Kept():
            return None, Rows()
        folder = self.open().folder
        return folder, Rows(folder / "rows.jsonl")


def call(
    program: str, description: str, commands: Mapping[str, Any], arguments: Sequence[str]
) -> None:
    """Runs the command that the arguments name, of functions and LongRuns by name."""
    name = arguments[0] if arguments else ""
    command = commands.get(name)
    if flags_given(arguments[1:], "out").get("out") == "":
        raise UserError("--out names no folder: give one, such as --out runs/NAME.")
    if name == "--version":
        versions = package_versions()
        beside = ", ".join(f"{k} {v}" for k, v in versions.items() if k != "lpo")
        print(f"{program} {versions['lpo']} ({beside})")
    elif command is None:
        tyro.extras.subcommand_cli_from_dict(
            dict(commands),
            prog=program,
            description=description,
            args=list(arguments),
            sort_subcommands=False,
            config=_STYLE,
        )
    elif isinstance(command, type) and issubclass(command, LongRun):
        others = flags_given(arguments[1:], "coordinator", "processes", "process")
        if others and not command.together:
            raise UserError(
                f"--{next(iter(others))} is given, and {command.program} is no work of several processes: leave it out."
            )
        if command.together and "--help" not in arguments:
            processes.start(others)
        with released():
            command.parse(arguments[1:]).run()
    else:
        tyro.cli(command, prog=f"{program} {name}", args=arguments[1:], config=_STYLE)


def flags_given(arguments: Sequence[str], *names: str) -> dict[str, str]:
    """Flags by name, read before tyro does, and "" for one without a value."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in names:
        parser.add_argument(f"--{name}", nargs="?", const="")
    return {k: v for k, v in vars(parser.parse_known_args(arguments)[0]).items() if v is not None}


def _word(name: str, value: str) -> str:
    return f"--{name}={value}" if value else f"--{name}"
