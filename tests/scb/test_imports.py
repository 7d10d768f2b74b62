"""The layering: lpo imports scb, scb never imports lpo, and nothing imports experiments."""

import ast
from pathlib import Path

import pytest

import scb

ROOT = Path(scb.__file__).parents[1]
MODULES = {
    package: sorted((ROOT / package).rglob("*.py")) for package in ("scb", "lpo", "experiments")
}
FORBIDDEN = {"scb": {"lpo", "experiments"}, "lpo": {"experiments"}}


def imported(source):
    """Top-level packages that a module imports by absolute name, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
        elif isinstance(node, ast.Call) and node.args:
            function, argument = node.func, node.args[0]
            name = (
                function.attr
                if isinstance(function, ast.Attribute)
                else getattr(function, "id", "")
            )
            if name in ("import_module", "__import__") and isinstance(argument, ast.Constant):
                names.add(argument.value)
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize(
    "source",
    [
        "import lpo",
        "import os, lpo.cli as cli",
        "from lpo.drifts import Drift",
        "def f():\n    from lpo import cli",
        "import importlib\nimportlib.import_module('lpo.cli')",
        "from importlib import import_module\nimport_module('lpo')",
    ],
)
def test_every_way_to_import_is_seen(source):
    assert "lpo" in imported(source)


def test_a_relative_import_or_a_string_is_no_import():
    assert imported("from . import lpo\nname = 'lpo'\nprint('lpo')") == set()


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_module_imports_what_lies_above_it(package):
    assert len(MODULES[package]) > 5
    for path in MODULES[package]:
        forbidden = imported(path.read_text()) & FORBIDDEN[package]
        assert not forbidden, f"{path.relative_to(ROOT)} imports {forbidden}"


@pytest.mark.parametrize("package", MODULES)
def test_no_package_imports_its_tests(package):
    assert not any("tests" in imported(path.read_text()) for path in MODULES[package])


def test_what_a_family_is_made_of_is_known_to_its_adapter_alone():
    # Everything else asks `environment_spec`. Brax's viewer takes Brax's environments.
    adapters = {"scb.environments.brax", "scb.environments.gymnax"}
    allowed = {"scb/environments/__init__.py", "scb/analysis/animation.py"}
    for path in (path for paths in MODULES.values() for path in paths):
        nodes = ast.walk(ast.parse(path.read_text()))
        names = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
        assert str(path.relative_to(ROOT)) in allowed or not names & adapters, path
