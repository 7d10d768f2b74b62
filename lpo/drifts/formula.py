"""Formulas as drifts: a small language, read and never run, and the drift that computes what it says.

An expression such as "0.5*A*d - tanh(2*A*log_r)" becomes a member of the drift contract,

    relu(base + gate * expression - xi),

where every term of the expression vanishes at ratio 1. A text is checked for that when it is read,
by its structure, so the conditions of mirror learning hold whatever its numbers are. `lpo.formula_search`
finds such expressions for learned drifts.
"""

import ast
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Self, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.contract import Array, CorrectedDrift
from scb.agents.drift import MAX_LOG_RATIO
from scb.errors import UserError

# What an expression is made of, beside numbers, +, -, * and parentheses: with its largest magnitude
# in training, and for `d` and `log_r`, which are 0 at ratio 1. A minibatch of 10 000 has no
# normalised advantage above 100.
VARIABLES: dict[str, float] = {
    "d": math.expm1(MAX_LOG_RATIO),  # r - 1
    "log_r": MAX_LOG_RATIO,
    "A": 100.0,
    "progress": 1.0,  # the fraction of training done
}
VANISHING = ("d", "log_r")
# Float32 ends at 3e38; its gradient multiplies a term once more.
LARGEST = 1e30
LONGEST = 4000
DEEPEST = 150
_ADDITIVE = (ast.Add, ast.Sub)
_Number: TypeAlias = tuple[float, int, int]

# All three are 0 at 0 and continuous, so that what vanishes inside vanishes outside.
FUNCTIONS: dict[str, Callable[[Array, Any], Array]] = {
    "tanh": lambda x, xp: xp.tanh(x),
    "relu": lambda x, xp: 0.5 * (x + xp.abs(x)),
    "abs": lambda x, xp: xp.abs(x),
}


@dataclass(frozen=True)
class Node:
    """An expression's part: `operator` is "number", "variable", "+", "*", "negative" or a function.

    Sums and products have any number of arguments, so that a long text is no deep tree.

    A number is held by its position among the expression's numbers, a variable by its name.
    """

    operator: str
    arguments: tuple["Node", ...] = ()
    position: int = -1
    name: str = ""


@dataclass(frozen=True)
class Expression:
    """A text, what it says, and its numbers in their order, each with where it begins and ends."""

    text: str
    root: Node
    numbers: tuple[_Number, ...]

    @property
    def constants(self) -> tuple[float, ...]:
        return tuple(value for value, _, _ in self.numbers)


@lru_cache(maxsize=256)
def parse(text: str) -> Expression:
    """Reads an expression such as "0.5*A*d - tanh(2*A*log_r)" by Python's grammar; nothing in it is ever run.

    Raises:
      UserError: says where it stops being one; or a term does not vanish at ratio 1, or grows beyond
        32-bit numbers.
    """
    if len(text) > LONGEST:
        raise UserError(
            f"the expression has {len(text)} characters: at most {LONGEST} are read, so shorten it."
        )
    text = " ".join(text.split())
    strange = re.search(r"[^\w\s.+*()-]", text, re.ASCII)
    if strange:
        raise _unreadable(text, repr(strange.group()), strange.start())
    try:
        tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        raise _unreadable(text, "no formula", max(error.offset or 1, 1) - 1) from error
    except (RecursionError, MemoryError) as error:
        raise _too_deep(text) from error
    numbers: list[_Number] = []
    root = _read(tree, text, numbers)
    expression = Expression(text, root, tuple(numbers))
    if not _vanishes(root):
        raise UserError(
            f"the expression {_quoted(text)} does not vanish at ratio 1 whatever its numbers are: give every "
            "term a factor d (r - 1) or log_r."
        )
    if not _bound(root, expression.constants) <= LARGEST:
        raise UserError(
            f"the expression {_quoted(text)} grows beyond 32-bit numbers at the largest ratios of training: "
            "use lower powers, or tanh(d) in place of d."
        )
    return expression


def _read(tree: ast.expr, text: str, numbers: list[_Number], depth: int = 1) -> Node:
    """What a part of Python's tree says; its numbers are added to those before it."""
    if depth > DEEPEST:
        raise _too_deep(text)

    def inside(part: ast.expr) -> Node:
        return _read(part, text, numbers, depth + 1)

    match tree:
        case ast.Constant(value=bool()):
            pass
        case ast.Constant(value=int() | float() as value) if value <= LARGEST:
            numbers.append((float(value), tree.col_offset, tree.end_col_offset or 0))
            return Node("number", position=len(numbers) - 1)
        case ast.Name(id=name) if name in VARIABLES:
            return Node("variable", name=name)
        case ast.Call(ast.Name(id=name), [argument], []) if name in FUNCTIONS:
            return Node(name, (inside(argument),))
        case ast.UnaryOp(ast.USub(), part):
            return Node("negative", (inside(part),))
        case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult()):
            first, rest = _chain(tree, ast.Mult if isinstance(tree.op, ast.Mult) else _ADDITIVE)
            arguments = [inside(first)]
            for operator, part in rest:
                node = inside(part)
                arguments.append(Node("negative", (node,)) if operator is ast.Sub else node)
            return Node("*" if isinstance(tree.op, ast.Mult) else "+", tuple(arguments))
    raise _unreadable(text, repr(ast.get_source_segment(text, tree)), tree.col_offset)


def _chain(tree: ast.expr, operators: Any) -> tuple[ast.expr, list[tuple[type, ast.expr]]]:
    """Of a - b + c: a, and [(Sub, b), (Add, c)]."""
    rest: list[tuple[type, ast.expr]] = []
    while isinstance(tree, ast.BinOp) and isinstance(tree.op, operators):
        rest.append((type(tree.op), tree.right))
        tree = tree.left
    return tree, rest[::-1]


def _unreadable(text: str, found: str, start: int) -> UserError:
    return UserError(
        f"the expression {_quoted(text)} has {found} at character {start + 1}: it takes numbers up to "
        f"{LARGEST:g}, {', '.join(VARIABLES)}, +, -, *, parentheses, and {', '.join(FUNCTIONS)} of one of these."
    )


def _too_deep(text: str) -> UserError:
    return UserError(
        f"the expression {_quoted(text)} is nested more than {DEEPEST} deep: simplify it."
    )


def _quoted(text: str) -> str:
    return repr(text if len(text) <= 60 else f"{text[:57]}...")


def _vanishes(node: Node) -> bool:
    """Whether a part is 0 at ratio 1, whatever the numbers, the advantage and the progress are."""
    if node.operator == "variable":
        return node.name in VANISHING
    if node.operator == "number":
        return False
    combine = any if node.operator == "*" else all
    return combine(_vanishes(argument) for argument in node.arguments)


def _bound(node: Node, constants: Sequence[float]) -> float:
    """A bound of every intermediate value's magnitude; infinite where one is beyond `LARGEST`."""
    if node.operator == "variable":
        return VARIABLES[node.name]
    if node.operator == "number":
        return abs(constants[node.position])
    bounds = [_bound(argument, constants) for argument in node.arguments]
    if any(bound > LARGEST for bound in bounds):
        return math.inf
    if node.operator == "tanh":
        return min(1.0, bounds[0])
    return math.prod(bounds) if node.operator == "*" else sum(bounds)


def evaluate(
    node: Node,
    constants: Sequence[float] | Array,
    variables: Mapping[str, Array],
    xp: Any,
) -> Array:
    """The value of an expression.

    Args:
      node: its root.
      constants: [K] numbers in their order.
      variables: [B] arrays under the names of `VARIABLES`.
      xp: `jax.numpy`, `numpy`, or another with `abs` and `tanh`.

    Returns:
      [B].
    """
    if node.operator == "number":
        return constants[node.position]
    if node.operator == "variable":
        return variables[node.name]
    values = [evaluate(argument, constants, variables, xp) for argument in node.arguments]
    match node.operator:
        case "+":
            return sum(values[1:], start=values[0])
        case "*":
            return math.prod(values[1:], start=values[0])
        case "negative":
            return -values[0]
        case function:
            return FUNCTIONS[function](values[0], xp)


@dataclass(frozen=True, kw_only=True)
class ClosedFormDrift(CorrectedDrift):
    """A formula as a drift: relu(base + gate * expression - xi).

    Its parameters are the formula's numbers, so they can be traced and evolved like a network's
    weights. The conditions of mirror learning hold whatever they are: every term vanishes at ratio 1.

    Attributes:
      expression: in the language of `parse`: numbers, d (r - 1), log_r, A, progress; +, -, *, tanh,
        relu, abs.
      base, clip, xi, gate: as `CorrectedDrift`'s, the correction being the expression.

    Raises:
      UserError: as `parse`.
    """

    name: ClassVar[str] = "formula"

    expression: str = field(kw_only=False)
    base: str = "none"
    gate: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        parse(self.expression)

    @property
    def temporal(self) -> bool:
        return any(node.name == "progress" for node in _nodes(parse(self.expression).root))

    def init(self, key: jax.Array, scale: float = 1.0) -> dict[str, jax.Array]:
        """The numbers that the text has; nothing about them is random."""
        return {"constants": jnp.asarray(parse(self.expression).constants, jnp.float32)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        return super().from_config({**config, "expression": str(config["expression"])})

    def with_parameters(self, parameters: Any) -> Self:
        """The same formula with these numbers in its text, which reads back to charge exactly the same.

        A negative number becomes a minus sign and its magnitude, since numbers are read without one.
        """
        read = parse(self.expression)
        numbers = np.asarray(parameters["constants"], np.float32)
        if np.array_equal(numbers, np.asarray(read.constants, np.float32)):
            return self
        text, end = "", 0
        for (_, start, after), number in zip(read.numbers, numbers, strict=True):
            text += read.text[end:start] + str(number)
            end = after
        return replace(self, expression=text + read.text[end:])

    def correction(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any
    ) -> Array:
        variables = {
            "d": xp.expm1(log_ratio),
            "log_r": log_ratio,
            "A": advantage,
            "progress": progress,
        }
        return evaluate(parse(self.expression).root, parameters["constants"], variables, xp)


def _nodes(node: Node) -> Iterator[Node]:
    yield node
    for argument in node.arguments:
        yield from _nodes(argument)
