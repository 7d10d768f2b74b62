"""Configures JAX before anything else imports it for good; counts what tests compile."""

import os
from collections.abc import Generator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

# Two devices, so that sharding is tested on every machine. Set as environment variables, which the
# processes that tests start inherit and which `scb.cli.configure_jax` leaves alone.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
# Tests compile more than they compute. Without the compiler's optimisations, without MLIR between XLA
# and LLVM, and with one module a program, compiling takes a quarter of the time. XLA ends a process
# at a flag that it does not know, and only the first of these is a documented one.
_flags = {"xla_backend_optimization_level": "0", "xla_llvm_disable_expensive_passes": "true"}
if version("jaxlib").startswith("0.10."):
    _flags |= {"xla_cpu_use_fusion_emitters": "false", "xla_cpu_parallel_codegen_split_count": "1"}
_given = os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = " ".join(
    [_given, *(f"--{name}={value}" for name, value in _flags.items() if name not in _given)]
).strip()
_cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_cache / "lpo" / "jax-tests"))
# The default leaves out what compiles within a second, which here is nearly everything.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--count-compilations",
        type=int,
        metavar="N",
        help="Print the N tests that ask XLA for most programs, and the seconds that lowering and compiling took.",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--count-compilations") is not None:
        config.pluginmanager.register(Compilations())


class Compilations:
    """The programs that a test made XLA compile, or read from the cache on disk, its fixtures' included.

    An operation outside of `jit` is a program too. Processes that a test starts are not seen.
    """

    def __init__(self) -> None:
        import jax

        self.programs, self.seconds = 0, 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, seconds: float, **_: Any) -> None:
        # Tracing is left out: it reports what it traces within once more.
        if event.endswith(("jaxpr_to_mlir_module_duration", "backend_compile_duration")):
            self.seconds += seconds
            self.programs += event.endswith("backend_compile_duration")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None]:
        self.programs, self.seconds = 0, 0.0
        yield

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> None:
        # A report's properties come back from xdist's workers.
        item.user_properties.append(("compilations", (self.programs, round(self.seconds, 3))))

    def pytest_terminal_summary(self, terminalreporter: Any, config: pytest.Config) -> None:
        counts = {
            report.nodeid: dict(report.user_properties)["compilations"]
            for reports in terminalreporter.stats.values()
            for report in reports
            if getattr(report, "when", "") == "teardown"
        }
        files: dict[str, tuple[int, float]] = {}
        for test, (programs, seconds) in counts.items():
            file = test.partition("::")[0]
            before = files.get(file, (0, 0.0))
            files[file] = (before[0] + programs, before[1] + seconds)
        number = config.getoption("--count-compilations")
        for title, table in (("tests", counts), ("files", files)):
            terminalreporter.section(f"{title} that compile most")
            worst = sorted(table.items(), key=lambda item: -item[1][0])[:number]
            for name, (programs, seconds) in worst:
                terminalreporter.write_line(f"{programs:6d} programs {seconds:7.2f} s  {name}")


@pytest.fixture
def small_agents() -> Generator[None]:
    """For the test, agents that the paper's tables specify take 16 steps, with networks of four units."""
    from tests.scb import probes

    with probes.small_agents():
        yield


@pytest.fixture
def corridors(monkeypatch: pytest.MonkeyPatch) -> None:
    """A family of environments of the tests' own, registered for one test."""
    # Here and not above: they import JAX.
    from scb.environments import registry
    from tests.scb.probes import Corridors

    monkeypatch.setattr(registry, "_FAMILIES", registry.families())
    registry.register(Corridors())
