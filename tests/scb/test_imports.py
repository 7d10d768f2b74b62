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


def unit(module):
    """What a module counts as: itself, or the subpackage that it is in."""
    return ".".join(module.split(".")[:2])


def imports_of(package, starting):
    """{unit: units of the same package that it imports}, what is only imported for types left out.

    Args:
      starting: only what runs as the module is imported, without imports inside functions.
    """
    found = {}
    for path in MODULES[package]:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        tree = ast.parse(path.read_text())
        skipped = {
            id(inner)
            for node in ast.walk(tree)
            if (isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING")
            or (starting and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
            for inner in ast.walk(node)
        }
        imports = found.setdefault(unit(module) if package == "lpo" else module, set())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and id(node) not in skipped and node.module:
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    known = (ROOT / Path(*full.split("."))).with_suffix(".py").exists()
                    imports.add(full if known else node.module)
    if package == "lpo":
        found = {name: {unit(x) for x in imports} for name, imports in found.items()}
    return {name: (imports & found.keys()) - {name} for name, imports in found.items()}


def levels(imports):
    """{unit: 1 + the highest of what it imports}; an AssertionError names a circle."""
    done = {}

    def level(name, path):
        assert name not in path, " -> ".join((*path, name))
        if name not in done:
            below = [level(other, (*path, name)) for other in sorted(imports[name])]
            done[name] = 1 + max(below, default=0)
        return done[name]

    for name in imports:
        level(name, ())
    return done


def test_a_circle_is_found():
    assert levels({"a": {"b"}, "b": set(), "c": {"a", "b"}}) == {"a": 2, "b": 1, "c": 3}
    with pytest.raises(AssertionError, match="a -> b -> a"):
        levels({"a": {"b"}, "b": {"a"}})


@pytest.mark.parametrize("package", MODULES)
def test_no_modules_import_each_other(package):
    levels(imports_of(package, starting=True))


def test_lpo_has_at_most_seven_levels():
    # Imports inside functions count: the command line has them to configure JAX first.
    found = levels(imports_of("lpo", starting=False))
    del found["lpo.__main__"]  # the command line by another name
    assert len(found) > 10 and max(found.values()) <= 7, sorted(found.items(), key=lambda x: x[1])
