"""Formulas as drifts: a small language, read and never run, and the drift that computes what it says.

An expression such as "0.5*A*d - tanh(2*A*log_r)" becomes a member of the drift contract,

    relu(base + gate * expression - xi),

where every term of the expression vanishes at ratio 1. A text is checked for that when it is read,
by its structure, so the conditions of mirror learning hold whatever its numbers are. `lpo.distill`
finds such expressions for learned drifts.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.contract import Array, CorrectedDrift
from scb.agents.ppo import MAX_LOG_RATIO
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
DEEPEST = 50

_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_TOKEN = re.compile(rf"\s*(?:({_NUMBER})|(\w+)|(.))", re.S)

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
    """A text, what it says, and its numbers in their order."""

    text: str
    root: Node
    constants: tuple[float, ...]


@lru_cache(maxsize=256)
def parse(text: str) -> Expression:
    """Reads an expression such as "0.5*A*d - tanh(2*A*log_r)"; nothing in it is ever run.

    Raises:
      UserError: says at which character it stops being one; or a term does not vanish at ratio 1, or
        grows beyond 32-bit numbers.
    """
    if len(text) > LONGEST:
        raise UserError(
            f"the expression has {len(text)} characters: at most {LONGEST} are read, so shorten it."
        )
    expression = _Parser(text).expression()
    if not _vanishes(expression.root):
        raise UserError(
            f"the expression {_quoted(text)} does not vanish at ratio 1 whatever its numbers are: give every "
            "term a factor d (r - 1) or log_r."
        )
    bound = _bound(expression.root, expression.constants)
    if not bound <= LARGEST:
        raise UserError(
            f"the expression {_quoted(text)} grows beyond 32-bit numbers at the largest ratios of training: "
            "use lower powers, or tanh(d) in place of d."
        )
    return expression


class _Parser:
    """Recursive descent over sum := term ((+|-) term)*, term := factor (* factor)*."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = [
            (m.group(1) or m.group(2) or m.group(3), m.start(m.lastindex or 0))
            for m in _TOKEN.finditer(text.rstrip())
        ]
        self.next = 0
        self.depth = 0
        self.constants: list[float] = []

    def expression(self) -> Expression:
        root = self.sum()
        if self.next < len(self.tokens):
            raise self.unexpected("+, - or *")
        return Expression(self.text, root, tuple(self.constants))

    def peek(self) -> str:
        return self.tokens[self.next][0] if self.next < len(self.tokens) else ""

    def take(self, token: str) -> bool:
        found = self.peek() == token
        self.next += found
        return found

    def sum(self) -> Node:
        terms = [self.term()]
        while True:
            if self.take("+"):
                terms.append(self.term())
            elif self.take("-"):
                terms.append(Node("negative", (self.term(),)))
            else:
                return Node("+", tuple(terms)) if len(terms) > 1 else terms[0]

    def term(self) -> Node:
        factors = [self.factor()]
        while self.take("*"):
            factors.append(self.factor())
        return Node("*", tuple(factors)) if len(factors) > 1 else factors[0]

    def factor(self) -> Node:
        self.depth += 1
        if self.depth > DEEPEST:
            raise UserError(
                f"the expression {_quoted(self.text)} is nested more than {DEEPEST} deep: simplify it."
            )
        node = self.innermost()
        self.depth -= 1
        return node

    def innermost(self) -> Node:
        if self.take("-"):
            return Node("negative", (self.factor(),))
        if self.take("("):
            return self.closed(self.sum())
        token = self.peek()
        if re.fullmatch(_NUMBER, token):
            return self.number(float(token))
        if token in VARIABLES:
            self.next += 1
            return Node("variable", name=token)
        if token in FUNCTIONS:
            self.next += 1
            if not self.take("("):
                raise self.unexpected(f"( after {token}")
            return Node(token, (self.closed(self.sum()),))
        raise self.unexpected(
            f"a number, {', '.join(VARIABLES)}, {', '.join(FUNCTIONS)}, - or parentheses"
        )

    def number(self, value: float) -> Node:
        if value > LARGEST:
            raise self.unexpected(f"a number of at most {LARGEST:g}")
        self.next += 1
        self.constants.append(value)
        return Node("number", position=len(self.constants) - 1)

    def closed(self, node: Node) -> Node:
        if not self.take(")"):
            raise self.unexpected("+, -, * or )")
        return node

    def unexpected(self, expected: str) -> UserError:
        if self.next < len(self.tokens):
            token, start = self.tokens[self.next]
            found = f"{_quoted(token)} at character {start + 1}"
        else:
            found = "its end"
        return UserError(
            f"the expression {_quoted(self.text)} has {found} where {expected} is expected: correct it there."
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
        numbers = np.asarray(parameters["constants"], np.float32)
        if np.array_equal(numbers, np.asarray(parse(self.expression).constants, np.float32)):
            return self
        values = iter(numbers)

        def replaced(match: re.Match[str]) -> str:
            if match.group(1) is None:
                return match.group()
            return match.group().removesuffix(match.group(1)) + str(next(values))

        return replace(self, expression=_TOKEN.sub(replaced, self.expression))

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
