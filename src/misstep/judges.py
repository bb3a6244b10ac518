"""What a success, a failure and a cost are, said in formulas over named observation columns.

    abs(theta) > 30deg and not (-2.4 < x < 2.4m)

A formula is parsed into nested functions and never evaluated as Python. It knows numbers, columns,
``+ - * /``, comparisons that may be chained, ``and or not``, parentheses and the functions abs,
min, max, sin, cos, sqrt; precedence is Python's.

A number may carry a unit, ``30deg`` or ``5 cm``. Everything is reckoned in m, rad, s, N and kg:
columns in other units are brought to these where they are read, and units that do not fit are
refused. A plain number beside a column is in the column's own unit, whatever that is; beside a
product of columns it is in the units without prefixes.

Where an environment is judged step by step, ``terminated`` and ``truncated`` are conditions too:
what it said of its last step.
"""

import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.trajectory import Column
from misstep.units import UNITS

Observation = NDArray[np.float64]
Judge = str | Callable[[Observation], Any]
"""A formula, or a Python function of the observation (n,)."""

LONGEST = 500
"""Characters of a formula."""
DEEPEST = 40
"""Parentheses, functions and signs inside each other."""

FLAGS = ("terminated", "truncated")
"""What can be asked of a step of an environment, beside what it observes."""

PYTHON = "python:"
"""Starts the text of what was judged by a Python function, which no text can bring back."""


@dataclass(frozen=True)
class Formula:
    """A function of an observation and the text that it was read from.

    Predicates are combined with ``&``, ``|`` and ``~``, also with plain Python functions.

    Parameters
    ----------
    text : str
        The formula; of a Python function ``"python:"`` and its name.
    function : callable
        From an observation (n,) to a truth or a number.
    reads_flags : bool
        Whether the function also wants the `FLAGS`, after the observation's columns.
    """

    text: str
    function: Callable[[Observation], Any]
    reads_flags: bool = False

    def __call__(self, observation: Observation, /) -> Any:
        """Return the value for an observation, shape (n,): a truth or a number."""
        return self.function(observation)

    def __and__(self, other: "Formula | Callable[[Observation], Any]") -> "Formula":
        second = _formula(other)
        first, second, flags = _of_one_row(self, second)
        text = _joined(self, "and", second)
        return Formula(text, lambda o: bool(first(o)) and bool(second(o)), flags)

    def __or__(self, other: "Formula | Callable[[Observation], Any]") -> "Formula":
        second = _formula(other)
        first, second, flags = _of_one_row(self, second)
        text = _joined(self, "or", second)
        return Formula(text, lambda o: bool(first(o)) or bool(second(o)), flags)

    def __invert__(self) -> "Formula":
        inner = self.text.removeprefix(PYTHON)
        origin = PYTHON if self.text.startswith(PYTHON) else ""
        return Formula(f"{origin}not ({inner})", lambda o: not self(o), self.reads_flags)


def parse_predicate(
    text: Judge,
    columns: Sequence[Column],
    what: str = "the predicate",
    flags: Sequence[str] = (),
) -> Formula:
    """Read a condition on the columns of an observation.

    Parameters
    ----------
    text : str or callable
        Such as ``"abs(theta) > 30deg"``; a Python function is taken as it is.
    columns : sequence of Column
        Those of the observation, in its order.
    what : str
        What the condition is for, for messages.
    flags : sequence of str
        Conditions that may be named too: `FLAGS`, where a row holds them after its columns.

    Returns
    -------
    Formula
        Maps an observation, shape (n,), to a bool. With no number (0/0) every comparison is false
        but ``!=``.

    Raises
    ------
    MisstepError
        If it is no condition, names an unknown column, mixes units that do not fit, or is longer
        than 500 characters or deeper than 40 levels; the message marks where.
    """
    return _parse(text, columns, what, "truth", flags)


def parse_cost(
    text: Judge, columns: Sequence[Column], what: str = "the cost", flags: Sequence[str] = ()
) -> Formula:
    """Read a number from the columns of an observation, such as ``"abs(theta) * 57.3"``.

    Parameters, result and errors are those of `parse_predicate`, but for the result's value: a
    number, infinite or NaN after a division by zero.
    """
    return _parse(text, columns, what, "number", flags)


def _parse(
    text: Judge,
    columns: Sequence[Column],
    what: str,
    kind: Literal["truth", "number"],
    flags: Sequence[str],
) -> Formula:
    if not isinstance(text, str):
        return _formula(text, what)
    if text.startswith(PYTHON):
        raise MisstepError(
            f"{what} was the Python function {text.removeprefix(PYTHON)!r}, which a file cannot "
            "hold: give that function, or a formula"
        )
    parser = _Parser(text, columns, what, flags)
    node = parser.formula(kind)
    words = " ".join(text.split())
    return Formula(words, lambda row: node.value(row.tolist()), parser.reads_flags)


def _of_one_row(first: Formula, second: Formula) -> tuple[Formula, Formula, bool]:
    """Return both with the flags in their row if one of them reads these, and whether it does."""
    if first.reads_flags == second.reads_flags:
        return first, second, first.reads_flags
    if first.reads_flags:
        return first, _without_flags(second), True
    return _without_flags(first), second, True


def _without_flags(formula: Formula) -> Formula:
    return Formula(formula.text, lambda o: formula(o[: -len(FLAGS)]), True)


def _formula(judge: object, what: str = "the predicate") -> Formula:
    if isinstance(judge, Formula):
        return judge
    if not callable(judge):
        raise MisstepError(f"{what} is {judge!r}: give a formula or a function of the observation")
    return Formula(PYTHON + getattr(judge, "__name__", type(judge).__name__), judge)


def _joined(first: Formula, word: str, second: Formula) -> str:
    texts = (first.text, second.text)
    origin = PYTHON if any(text.startswith(PYTHON) for text in texts) else ""
    a, b = (text.removeprefix(PYTHON) for text in texts)
    return f"{origin}({a}) {word} ({b})"


_LONGEST_FIRST = sorted(UNITS, key=len, reverse=True)

_SPACE = re.compile(r"\s*")
_NUMBER = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_UNIT = re.compile(rf"({'|'.join(map(re.escape, _LONGEST_FIRST))})(?!\w)")
_NAME = re.compile(r"[^\W\d][\w.]*")
_SIGN = re.compile(r"<=|>=|==|!=|[-+*/<>(),]")
_KEYWORDS = ("and", "or", "not")

Row = list[float]
Value = Callable[[Row], Any]


class _Token(NamedTuple):
    kind: str  # number, name, sign or end
    text: str
    start: int
    unit: str | None = None


@dataclass(frozen=True)
class _Node:
    """A part of a formula: how to compute it from an observation, and what is known of it."""

    value: Value
    start: int
    truth: bool = False
    constant: bool = False
    unit: str | None = None  # without prefixes; None: a plain number, fits every unit; "": none
    scale: float = 1.0  # of the unit that a plain number beside it is in


def _quotient(a: float, b: float) -> float:
    """Divide as floating-point arithmetic does."""
    if b != 0.0:
        return a / b
    return (
        math.nan
        if a == 0.0 or math.isnan(a)
        else math.copysign(math.inf, a) * math.copysign(1.0, b)
    )


def _real(function: Callable[[float], float]) -> Callable[[float], float]:
    """Return `function` with NaN where it has no value."""

    def defined(x: float) -> float:
        try:
            return function(x)
        except ValueError:
            return math.nan

    return defined


_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_ONE_ARGUMENT: dict[str, Callable[[float], float]] = {
    "abs": abs,
    "sin": _real(math.sin),
    "cos": _real(math.cos),
    "sqrt": _real(math.sqrt),
}
_MANY_ARGUMENTS: dict[str, Callable[[list[float]], float]] = {"min": min, "max": max}
_FUNCTIONS = (*_ONE_ARGUMENT, *_MANY_ARGUMENTS)


class _Parser:
    """Recursive descent: one method a level of precedence, each returns a node.

    or:          and ("or" and)*
    and:         not ("and" not)*
    not:         "not" not | comparison
    comparison:  sum (("<" | "<=" | ">" | ">=" | "==" | "!=") sum)*
    sum:         product (("+" | "-") product)*
    product:     factor (("*" | "/") factor)*
    factor:      ("-" | "+") factor | number [unit] | column | function "(" or ("," or)* ")"
                 | "(" or ")"
    """

    def __init__(
        self, text: str, columns: Sequence[Column], what: str, flags: Sequence[str]
    ) -> None:
        self._text, self._what = text, what
        self._columns = {column.name: (i, column.unit) for i, column in enumerate(columns)}
        self._flags = {name: len(columns) + i for i, name in enumerate(flags)}
        self.reads_flags = False
        if len(text) > LONGEST:
            raise MisstepError(
                f"{what} has {len(text)} characters; at most {LONGEST} are read as a formula"
            )
        self._tokens = self._read_tokens()
        self._at = 0
        self._depth = 0

    def formula(self, kind: Literal["truth", "number"]) -> _Node:
        """Read the whole text as a condition or a number."""
        node = self._or()
        if self._next.kind != "end":
            self._fail(self._next.start, f"{self._next.text!r} does not belong here")
        return self._truth(node) if kind == "truth" else self._number(node)

    def _fail(self, start: int, reason: str) -> NoReturn:
        before, after = self._text[:start], self._text[start:]
        marked = " ".join(f"{before} [here] {after}".split())
        raise MisstepError(f"{self._what}, character {start + 1}: {reason}: {marked!r}")

    # Tokens

    def _read_tokens(self) -> list[_Token]:
        tokens, at = [], self._skip(0)
        while at < len(self._text):
            token, at = self._token(at)
            tokens.append(token)
            at = self._skip(at)
        return [*tokens, _Token("end", "the end", len(self._text))]

    def _skip(self, at: int) -> int:
        space = _SPACE.match(self._text, at)
        return at if space is None else space.end()

    def _token(self, at: int) -> tuple[_Token, int]:
        if number := _NUMBER.match(self._text, at):
            return self._number_token(number)
        for kind, pattern in (("name", _NAME), ("sign", _SIGN)):
            if match := pattern.match(self._text, at):
                return _Token(kind, match[0], at), match.end()
        self._fail(at, f"{self._text[at]!r} is no part of a formula")

    def _number_token(self, number: "re.Match[str]") -> tuple[_Token, int]:
        start, end = number.span()
        if not math.isfinite(float(number[0])):
            self._fail(start, f"{number[0]} is too large a number")
        at = self._skip(end)
        if unit := _UNIT.match(self._text, at):
            return _Token("number", number[0], start, unit[0]), unit.end()
        name = _NAME.match(self._text, at)
        if name and name[0] not in _KEYWORDS:
            self._fail(at, f"{name[0]!r} is no unit; there are: {', '.join(UNITS)}")
        return _Token("number", number[0], start), end

    @property
    def _next(self) -> _Token:
        return self._tokens[self._at]

    def _take(self, *texts: str) -> _Token | None:
        """Go past the next token if it is one of `texts`."""
        token = self._next
        if token.kind in ("name", "sign") and token.text in texts:
            self._at += 1
            return token
        return None

    # Levels of precedence

    def _or(self) -> _Node:
        return self._logic("or", self._and, any)

    def _and(self) -> _Node:
        return self._logic("and", self._not, all)

    def _logic(self, word: str, part: Callable[[], _Node], combine: Callable[[Any], bool]) -> _Node:
        node = part()
        nodes = [node]
        while self._take(word):
            nodes.append(part())
        if len(nodes) == 1:
            return node
        values = [self._truth(n).value for n in nodes]
        return _Node(lambda row: combine(value(row) for value in values), node.start, truth=True)

    def _not(self) -> _Node:
        token = self._take("not")
        if token is None:
            return self._comparison()
        value = self._truth(self._deeper(self._not, token.start)).value
        return _Node(lambda row: not value(row), token.start, truth=True)

    def _comparison(self) -> _Node:
        node = self._sum()
        nodes, compare = [node], []
        while token := self._take(*_COMPARISONS):
            compare.append(_COMPARISONS[token.text])
            nodes.append(self._sum())
        if not compare:
            return node
        values = [n.value for n in self._aligned(nodes)]

        def holds(row: Row) -> bool:
            numbers = [value(row) for value in values]
            return all(c(a, b) for c, a, b in zip(compare, numbers, numbers[1:], strict=False))

        return _Node(holds, node.start, truth=True)

    def _sum(self) -> _Node:
        node = self._product()
        nodes, signs = [node], [1.0]
        while token := self._take("+", "-"):
            signs.append(1.0 if token.text == "+" else -1.0)
            nodes.append(self._product())
        if len(nodes) == 1:
            return node
        nodes = self._aligned(nodes)
        terms = [(n.value, sign) for n, sign in zip(nodes, signs, strict=True)]

        def total(row: Row) -> float:
            result: float = terms[0][0](row)
            for value, sign in terms[1:]:
                result += sign * value(row)
            return result

        return _Node(total, node.start, False, _constant(nodes), *_common_unit(nodes))

    def _product(self) -> _Node:
        node = self._factor()
        nodes, divides = [node], [False]
        while token := self._take("*", "/"):
            divides.append(token.text == "/")
            nodes.append(self._factor())
        if len(nodes) == 1:
            return node
        nodes = [self._number(n) for n in nodes]
        united = [i for i, n in enumerate(nodes) if n.unit]
        # Twice an angle is an angle; of other products nothing is said.
        alone = nodes[united[0]] if len(united) == 1 and not divides[united[0]] else None
        unit, scale = (None, 1.0) if alone is None else (alone.unit, alone.scale)
        factors = [(n.value, divide) for n, divide in zip(nodes, divides, strict=True)]

        def product(row: Row) -> float:
            result: float = factors[0][0](row)
            for value, divide in factors[1:]:
                other = value(row)
                result = _quotient(result, other) if divide else result * other
            return result

        return _Node(product, node.start, False, _constant(nodes), unit, scale)

    def _factor(self) -> _Node:
        token = self._next
        if sign := self._take("-", "+"):
            node = self._number(self._deeper(self._factor, token.start))
            value = node.value
            return node if sign.text == "+" else replace(node, value=lambda row: -value(row))
        if self._take("("):
            node = self._deeper(self._or, token.start)
            self._close(token)
            return node
        if token.kind == "number":
            self._at += 1
            base, factor = (None, 1.0) if token.unit is None else _base(token.unit)
            number = factor * float(token.text)
            return _Node(lambda row: number, token.start, constant=True, unit=base)
        if token.kind == "name" and token.text not in _KEYWORDS:
            self._at += 1
            is_call = self._next.text == "(" and token.text not in self._columns
            return self._call(token) if is_call else self._column(token)
        self._fail(token.start, f"a value is missing before {_quoted(token)}")

    def _call(self, token: _Token) -> _Node:
        if token.text not in _FUNCTIONS:
            self._fail(
                token.start, f"no function {token.text!r}; there are: {', '.join(_FUNCTIONS)}"
            )
        opening = self._next
        self._at += 1
        nodes = [self._deeper(self._or, opening.start)]
        while self._take(","):
            nodes.append(self._deeper(self._or, opening.start))
        self._close(opening)
        if token.text in _MANY_ARGUMENTS:
            choose = _MANY_ARGUMENTS[token.text]
            nodes = self._aligned(nodes)
            values = [n.value for n in nodes]
            return _Node(
                lambda row: choose([value(row) for value in values]),
                token.start,
                False,
                _constant(nodes),
                *_common_unit(nodes),
            )
        if len(nodes) != 1:
            self._fail(token.start, f"{token.text} takes one value, not {len(nodes)}")
        return self._function_of_one(token, self._number(nodes[0]))

    def _function_of_one(self, token: _Token, node: _Node) -> _Node:
        unit, scale = (node.unit, node.scale) if token.text == "abs" else (None, 1.0)
        if token.text in ("sin", "cos") and node.unit and node.unit != "rad":
            self._fail(node.start, f"{token.text} takes an angle, but this is in {node.unit}")
        function, value = _ONE_ARGUMENT[token.text], node.value
        return _Node(
            lambda row: function(value(row)), token.start, False, node.constant, unit, scale
        )

    def _column(self, token: _Token) -> _Node:
        if token.text not in self._columns and token.text in self._flags:
            self.reads_flags = True
            flag = self._flags[token.text]
            return _Node(lambda row: bool(row[flag]), token.start, truth=True)
        if token.text not in self._columns:
            listed = ", ".join(n + (f" [{u}]" if u else "") for n, (_, u) in self._columns.items())
            self._fail(token.start, f"no column {token.text!r}; there are: {listed}")
        index, unit = self._columns[token.text]
        base, factor = _base(unit)
        if factor == 1.0:
            return _Node(operator.itemgetter(index), token.start, unit=base)
        return _Node(lambda row: factor * row[index], token.start, unit=base, scale=factor)

    # What may stand where

    def _deeper(self, part: Callable[[], _Node], start: int) -> _Node:
        self._depth += 1
        if self._depth > DEEPEST:
            self._fail(start, f"more than {DEEPEST} levels inside each other")
        node = part()
        self._depth -= 1
        return node

    def _close(self, opening: _Token) -> None:
        if not self._take(")"):
            self._fail(
                self._next.start,
                f"')' is missing before {_quoted(self._next)}, for the '(' at character "
                f"{opening.start + 1}",
            )

    def _truth(self, node: _Node) -> _Node:
        if not node.truth:
            self._fail(node.start, "a condition is wanted here, such as x > 1, not a number")
        return node

    def _number(self, node: _Node) -> _Node:
        if node.truth:
            self._fail(node.start, "a number is wanted here, not a condition")
        return node

    def _aligned(self, nodes: list[_Node]) -> list[_Node]:
        """Return the nodes with plain numbers in the unit of the first column beside them."""
        united = [self._number(n) for n in nodes if n.unit is not None or n.truth]
        first = next((n for n in united if not n.constant), None) or next(iter(united), None)
        if first is None:
            return nodes
        for node in united:
            if node.unit != first.unit:
                self._fail(
                    node.start,
                    f"this is {_in(node.unit)} and cannot be set against what is {_in(first.unit)}",
                )
        scale = first.scale
        return [_scaled(n, scale) if n.unit is None and n.constant else n for n in nodes]


def _quoted(token: _Token) -> str:
    return token.text if token.kind == "end" else repr(token.text)


def _in(unit: str | None) -> str:
    return f"in {unit}" if unit else "without a unit"


def _constant(nodes: Sequence[_Node]) -> bool:
    return all(node.constant for node in nodes)


def _common_unit(aligned: Sequence[_Node]) -> tuple[str | None, float]:
    """Return the unit of the first node that has one, and its scale."""
    first = next((node for node in aligned if node.unit is not None), None)
    return (None, 1.0) if first is None else (first.unit, first.scale)


def _base(unit: str) -> tuple[str, float]:
    """Return the unit without a prefix, and how many of those it is; itself if it is not known."""
    return UNITS.get(unit, (unit, 1.0))


def _scaled(node: _Node, factor: float) -> _Node:
    value = node.value
    return node if factor == 1.0 else replace(node, value=lambda row: factor * value(row))
