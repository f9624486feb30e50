"""Reverse-mode differentiation of functions of components, by tracing.

A function called with the numbers of a :class:`Trace` records a node per operation. :func:`derivatives`
traverses the record backwards and adds the nodes of the adjoints; :func:`evaluated` computes nodes with
numbers of any kind: NumPy arrays, or :class:`plab.sim.codegen.llvm.Number`, which generates LLVM
instructions. Equal nodes are recorded once, and unused nodes are not computed.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Node", "Primitive", "Trace", "derivatives", "evaluated", "frozen", "require_supported"]

Number = Any
"""A node or a constant."""


@dataclass(frozen=True)
class Primitive:
    """A function of one number with an explicit derivative, such as an iteration.

    Attributes:
        function: The function.
        derivative: Its derivative, from its value and its argument.
    """

    function: Callable[[Any], Any]
    derivative: Callable[[Any, Any], Any]


class Node:
    """A recorded number: an input, or an operation on nodes and constants."""

    def __init__(
        self, trace: Trace, place: int, operation: str | Primitive, arguments: tuple[Number, ...]
    ) -> None:
        self.trace, self.place, self.operation, self.arguments = trace, place, operation, arguments

    @property
    def single(self) -> bool:
        """Whether values have single precision."""
        return self.trace.single

    def __add__(self, other: Number) -> Number:
        return self.trace.sum(self, other)

    __radd__ = __add__

    def __sub__(self, other: Number) -> Number:
        return self.trace.difference(self, other)

    def __rsub__(self, other: Number) -> Number:
        return self.trace.difference(other, self)

    def __mul__(self, other: Number) -> Number:
        return self.trace.product(self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Number:
        return self.trace.node("div", self, other)

    def __rtruediv__(self, other: Number) -> Number:
        return self.trace.node("div", other, self)

    def __neg__(self) -> Number:
        return self.arguments[0] if self.operation == "neg" else self.trace.node("neg", self)

    def __lt__(self, other: Number) -> Node:
        return self.trace.node("less", self, other)

    def __gt__(self, other: Number) -> Node:
        return self.trace.node("less", other, self)

    def __bool__(self) -> bool:
        raise TypeError("`if` on a component: use np.where, and np.minimum and np.maximum to clamp")

    def __array_ufunc__(self, function: np.ufunc, _method: str, *given: Number) -> Node:
        """Record a NumPy function, or an operator whose left operand is a NumPy number."""
        if function in OPERATORS:
            left, right = given
            return OPERATORS[function](float(left) if isinstance(left, np.generic) else left, right)
        require_supported(function, _FUNCTIONS)
        return self.trace.node(_FUNCTIONS[function], *given)

    def __array_function__(self, function: Any, _types: Any, given: Any, _keywords: Any) -> Number:
        """Record :func:`numpy.where`."""
        require_supported(function, {np.where: "where"})
        return self.trace.node("where", *given)


_FUNCTIONS = {getattr(np, name): name for name in ("sqrt", "minimum", "maximum", "exp", "log")}


def require_supported(function: Any, supported: Mapping[Any, str]) -> None:
    """Raise TypeError if a NumPy function of a component is not supported."""
    if function not in supported:
        names = ", ".join((*_FUNCTIONS.values(), "where"))
        raise TypeError(f"np.{function.__name__} of a component: use + - * /, < and >, and NumPy's {names}")


OPERATORS: dict[np.ufunc, Callable[..., Any]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.divide: operator.truediv,
}
"""Operators that NumPy numbers call as functions."""


def frozen(number: Number) -> Number:
    """Return a number that derivatives treat as constant."""
    return number.trace.node("frozen", number) if isinstance(number, Node) else number


class Trace:
    """A record of operations on numbers of single or double precision, in topological order."""

    def __init__(self, single: bool = False) -> None:
        self.single = single
        self.nodes: list[Node] = []
        self._known: dict[tuple[Any, ...], Node] = {}

    def inputs(self, name: str, count: int) -> list[Node]:
        """Return new inputs; ``name`` distinguishes them from other inputs."""
        return [self.node("input", f"{name}{k}") for k in range(count)]

    def node(self, operation: str | Primitive, *arguments: Number) -> Node:
        """Record an operation, or return the existing node."""
        key = (operation, *((one.place,) if isinstance(one, Node) else one for one in arguments))
        if key not in self._known:
            self._known[key] = Node(self, len(self.nodes), operation, arguments)
            self.nodes.append(self._known[key])
        return self._known[key]

    def sum(self, a: Number, b: Number) -> Number:
        """Record a + b."""
        if _equals(a, 0.0) or _equals(b, 0.0):
            return b if _equals(a, 0.0) else a
        if _negated(b):
            return self.difference(a, b.arguments[0])
        return self.difference(b, a.arguments[0]) if _negated(a) else self.node("add", a, b)

    def difference(self, a: Number, b: Number) -> Number:
        """Record a - b."""
        if _equals(a, 0.0) or _equals(b, 0.0):
            return -b if _equals(a, 0.0) else a
        return self.sum(a, b.arguments[0]) if _negated(b) else self.node("sub", a, b)

    def product(self, a: Number, b: Number) -> Number:
        """Record a b."""
        if not isinstance(b, Node):
            a, b = b, a
        if not isinstance(a, Node):
            if a in (0.0, 1.0):
                return a * 0.0 if a == 0.0 else b
            if b.operation == "mul" and not isinstance(b.arguments[0], Node):
                return self.product(a * b.arguments[0], b.arguments[1])
            return self.product(-a, b.arguments[0]) if _negated(b) else self.node("mul", a, b)
        for one, other in ((a, b), (b, a)):
            if _negated(one):
                return -self.product(one.arguments[0], other)
        return self.node("mul", *sorted((a, b), key=lambda one: one.place))


def _equals(one: Number, constant: float) -> bool:
    return not isinstance(one, Node) and one == constant


def _negated(one: Number) -> bool:
    return isinstance(one, Node) and one.operation == "neg"


def _shares(node: Node, bar: Number) -> Sequence[Number]:
    """Return the contributions of a node's adjoint to the adjoints of its arguments."""
    a, *rest = node.arguments
    where = node.trace.node
    if isinstance(node.operation, Primitive):
        return (bar * node.operation.derivative(node, a),)
    match node.operation:
        case "add":
            return bar, bar
        case "sub":
            return bar, -bar
        case "neg":
            return (-bar,)
        case "mul":
            return bar * rest[0], bar * a
        case "div":
            share = bar / rest[0]
            return share, -(share * node)
        case "sqrt":
            return (0.5 * bar / node,)
        case "minimum":
            least = where("less", a, rest[0])
            return where("where", least, bar, 0.0), where("where", least, 0.0, bar)
        case "maximum":
            most = where("less", rest[0], a)
            return where("where", most, bar, 0.0), where("where", most, 0.0, bar)
        case "exp":
            return (bar * node,)
        case "log":
            return (bar / a,)
        case "where":
            return 0.0, where("where", a, bar, 0.0), where("where", a, 0.0, bar)
    raise ValueError(f"no derivative of {node.operation}")


def derivatives(outputs: Sequence[Number], bars: Sequence[Number], inputs: Sequence[Node]) -> list[Number]:
    """Return the adjoints of some nodes, given those of the outputs.

    Args:
        outputs: Outputs of the trace.
        bars: Adjoint of each output.
        inputs: Nodes whose adjoints are requested, treated as independent variables.
    """
    trace = inputs[0].trace
    varied = {one.place for one in inputs}
    for node in trace.nodes[min(varied) :]:
        if node.operation not in ("frozen", "less") and any(
            isinstance(one, Node) and one.place in varied for one in node.arguments
        ):
            varied.add(node.place)
    sums: dict[int, Number] = {}

    def share(to: Number, bar: Number) -> None:
        if isinstance(to, Node) and to.place in varied and not _equals(bar, 0.0):
            sums[to.place] = sums[to.place] + bar if to.place in sums else bar

    for output, bar in zip(outputs, bars, strict=True):
        share(output, bar)
    ends = {one.place for one in inputs}
    for node in reversed(trace.nodes[: max(sums, default=-1) + 1]):
        if node.place in sums and node.place not in ends:
            for argument, bar in zip(node.arguments, _shares(node, sums[node.place]), strict=True):
                share(argument, bar)
    return [sums.get(one.place, 0.0) for one in inputs]


OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "less": operator.lt,
    "frozen": lambda number: number,
    "where": np.where,
    **{name: function for function, name in _FUNCTIONS.items()},
}


def evaluated(outputs: Sequence[Number], given: Mapping[Node, Any]) -> list[Any]:
    """Evaluate nodes.

    Args:
        outputs: Nodes or constants.
        given: Values of the inputs, and of other known nodes.

    Returns:
        Values of the outputs, of the same kind.
    """
    values = {node.place: value for node, value in given.items()}
    needed, open_nodes = set(), [one for one in outputs if isinstance(one, Node)]
    while open_nodes:
        node = open_nodes.pop()
        if node.place not in needed and node.place not in values:
            needed.add(node.place)
            open_nodes += [one for one in node.arguments if isinstance(one, Node)]

    def value(one: Number) -> Any:
        return values[one.place] if isinstance(one, Node) else one

    for place in sorted(needed):
        node = next(iter(given)).trace.nodes[place]
        own = node.operation
        function = own.function if isinstance(own, Primitive) else OPERATIONS[own]
        values[place] = function(*map(value, node.arguments))
    return [value(one) for one in outputs]
