"""Formulas as sums of products, which an expression of a drift is one text of: added, multiplied, taken apart.

Programs that are the same formula become the same sum, with no number in two places.
"""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lpo.drifts.formula import Node, evaluate

# A sum of coefficients times products. A product's factors, sorted, are variables, "abs(A)", and
# functions of further sums.
Factor: TypeAlias = "str | tuple[str, Sum]"
Sum: TypeAlias = "tuple[tuple[tuple[Factor, ...], float], ...]"

_MOST_TERMS = 48  # of a program that is being multiplied out


def as_sum(program: Sequence[Any]) -> Sum:
    """A program in prefix notation as a sum, multiplied out; empty where it grew too long."""
    stack: list[Sum] = []
    # Backwards: a function's arguments lie on the stack, the first on top, when it is met.
    for symbol in reversed(program):
        if symbol[0] not in _OPERATIONS:
            stack.append(((tuple(sorted(symbol)), 1.0),))
            continue
        name, arity = symbol
        arguments = [stack.pop() for _ in range(arity)]
        made = _OPERATIONS[name](*arguments)
        if len(made) > _MOST_TERMS:
            return ()
        stack.append(made)
    return stack[0]


def collect(terms: "Sequence[tuple[tuple[Factor, ...], float]]") -> Sum:
    """Terms of which some may be alike -> the sum of them, in its one order."""
    total: dict[tuple[Factor, ...], float] = {}
    for factors, coefficient in terms:
        total[factors] = total.get(factors, 0.0) + coefficient
    return tuple(sorted(((k, v) for k, v in total.items() if v != 0.0), key=repr))


def scaled(terms: Sum, by: float) -> Sum:
    """A number times a sum."""
    return tuple((factors, by * coefficient) for factors, coefficient in terms)


def product(left: Sum, right: Sum) -> Sum:
    """A sum times a sum, multiplied out."""
    return collect([(tuple(sorted(f + g, key=repr)), c * k) for f, c in left for g, k in right])


def function(name: str) -> Callable[[Sum], Sum]:
    """A function, "tanh" or "relu", of a sum as a sum."""

    def made(argument: Sum) -> Sum:
        if not argument:
            return ()
        if name == "relu":  # a positive factor inside is the same as one outside
            size = max(abs(c) for _, c in argument)
            return (((("relu", scaled(argument, 1.0 / size)),), size),)
        return ((((name, argument),), 1.0),)

    return made


_OPERATIONS: dict[str, Callable[..., Sum]] = {
    "add": lambda x, y: collect([*x, *y]),
    "sub": lambda x, y: collect([*x, *scaled(y, -1.0)]),
    "mul": product,
    "half": lambda x: scaled(x, 0.5),
    "double": lambda x: scaled(x, 2.0),
    "tanh": function("tanh"),
    "relu": function("relu"),
}


def structure_of(terms: Sum) -> str:
    """A formula without its numbers."""
    return as_text(with_numbers(terms, itertools.repeat(1.0)))


def size_of(terms: Sum) -> int:
    """Numbers, variables and functions in a formula."""
    return len(numbers_of(terms)) + len(re.findall(r"\w+", structure_of(terms)))


def node_of(terms: Sum, numbers: list[float]) -> Node:
    """A formula as `evaluate` takes it; its `numbers_of` join the numbers."""
    made = []
    for factors, coefficient in terms:
        numbers.append(coefficient)
        parts = [Node("number", position=len(numbers) - 1)]
        for factor in factors:
            if isinstance(factor, str):
                parts.append(Node("variable", name=factor))
            else:
                parts.append(Node(factor[0], (node_of(factor[1], numbers),)))
        made.append(Node("*", tuple(parts)))
    return Node("+", tuple(made))


def numbers_of(terms: Sum) -> list[float]:
    """A formula's coefficients, each before those inside its term."""
    numbers: list[float] = []
    node_of(terms, numbers)
    return numbers


def with_numbers(terms: Sum, numbers: Iterator[float]) -> Sum:
    """The formula with other numbers: the inverse of `numbers_of`."""
    made = []
    for factors, _ in terms:
        coefficient = next(numbers)
        inside = tuple(
            f if isinstance(f, str) else (f[0], with_numbers(f[1], numbers)) for f in factors
        )
        made.append((inside, float(coefficient)))
    return tuple(made)


def value_of(terms: Sum, variables: Mapping[str, NDArray[np.floating]]) -> NDArray[np.floating]:
    """A formula's values at points, {variable: [S]} -> [S]."""
    numbers: list[float] = []
    root = node_of(terms, numbers)
    return np.asarray(evaluate(root, numbers, variables, np))


def one_fewer(terms: Sum) -> Iterator[Sum]:
    """The formulas that lack one term, of the sum or inside a function; never an empty sum."""
    for i, (factors, coefficient) in enumerate(terms):
        if len(terms) > 1:
            yield (*terms[:i], *terms[i + 1 :])
        for j, factor in enumerate(factors):
            if not isinstance(factor, str):
                for inside in one_fewer(factor[1]):
                    made = (*factors[:j], (factor[0], inside), *factors[j + 1 :])
                    yield (*terms[:i], (made, coefficient), *terms[i + 1 :])


def as_text(terms: Sum) -> str:
    """A sum in the language of `parse`; a coefficient of 1 is left out."""
    text = ""
    for factors, coefficient in terms:
        sign, size = ("-" if coefficient < 0 else "+"), f"{abs(coefficient):.4g}"
        shown = [f if isinstance(f, str) else f"{f[0]}({as_text(f[1])})" for f in factors]
        term = "*".join([*([] if size == "1" else [size]), *shown])
        text += f" {sign} {term}" if text else (term if sign == "+" else f"-{term}")
    return text
