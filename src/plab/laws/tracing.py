"""Reverse-mode differentiation of functions of components, by tracing.

A function called with the numbers of a :class:`Trace` records a node per operation. :func:`derivatives`
traverses the record backwards and adds the nodes of the adjoints; :func:`evaluated` computes nodes with
numbers of any kind: NumPy arrays, or :class:`plab.sim.codegen.llvm.Number`, which generates LLVM
instructions. Equal nodes are recorded once, and unused nodes are not computed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

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

    def __call__(self, number: Any) -> Any:
        return self.function(number)


class Node(NDArrayOperatorsMixin):
    """A recorded number: an input, or an operation on nodes and constants.

    NumPy calls :meth:`__array_ufunc__` for its functions and for Python's operators.
    """

    # Nodes are keys, equal only to themselves.
    __eq__, __hash__ = object.__eq__, object.__hash__

    def __init__(self, trace: Trace, place: int, operation: Any, arguments: tuple[Number, ...]) -> None:
        self.trace, self.place, self.operation, self.arguments = trace, place, operation, arguments

    @property
    def single(self) -> bool:
        """Whether values have single precision."""
        return self.trace.single

    def __bool__(self) -> bool:
        raise TypeError("`if` on a component: use np.where, and np.minimum and np.maximum to clamp")

    def __array_ufunc__(self, function: np.ufunc, _method: str, *given: Number, out: Any = None) -> Number:
        """Record a NumPy function or an operator; ``out`` of augmented assignments is not needed."""
        require_supported(function)
        trace, given = self.trace, tuple(float(x) if isinstance(x, np.generic) else x for x in given)
        match function:
            case np.add:
                return trace.sum(*given)
            case np.subtract:
                return trace.difference(*given)
            case np.multiply:
                return trace.product(*given)
            case np.negative:
                return self.arguments[0] if _negated(self) else trace.node(np.negative, self)
            case np.greater:
                return trace.node(np.less, *reversed(given))
        return trace.node(function, *given)

    def __array_function__(self, function: Any, _types: Any, given: Any, _keywords: Any) -> Number:
        """Record :func:`numpy.where`."""
        require_supported(function)
        return self.trace.node(function, *given)


SUPPORTED = (
    *(np.add, np.subtract, np.multiply, np.divide, np.negative, np.less, np.greater),
    *(np.sqrt, np.minimum, np.maximum, np.exp, np.log, np.where),
)
"""NumPy's functions of components, the first seven as operators."""


def require_supported(function: Any) -> None:
    """Raise TypeError if a NumPy function of a component is not supported."""
    if function not in SUPPORTED:
        names = ", ".join(one.__name__ for one in SUPPORTED[7:])
        raise TypeError(f"np.{function.__name__} of a component: use + - * /, < and >, and NumPy's {names}")


def frozen(number: Number) -> Number:
    """Return a number that derivatives treat as constant."""
    return number.trace.node(_unchanged, number) if isinstance(number, Node) else number


def _unchanged(number: Number) -> Number:
    return number


class Trace:
    """A record of operations on numbers of single or double precision, in topological order."""

    def __init__(self, single: bool = False) -> None:
        self.single = single
        self.nodes: list[Node] = []
        self._known: dict[tuple[Any, ...], Node] = {}

    def inputs(self, name: str, count: int) -> list[Node]:
        """Return new inputs; ``name`` distinguishes them from other inputs."""
        return [self.node(None, f"{name}{k}") for k in range(count)]

    def node(self, operation: Any, *arguments: Number) -> Node:
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
        return self.difference(b, a.arguments[0]) if _negated(a) else self.node(np.add, a, b)

    def difference(self, a: Number, b: Number) -> Number:
        """Record a - b."""
        if _equals(a, 0.0) or _equals(b, 0.0):
            return -b if _equals(a, 0.0) else a
        return self.sum(a, b.arguments[0]) if _negated(b) else self.node(np.subtract, a, b)

    def product(self, a: Number, b: Number) -> Number:
        """Record a b."""
        if not isinstance(b, Node):
            a, b = b, a
        if not isinstance(a, Node):
            if a in (0.0, 1.0):
                return a * 0.0 if a == 0.0 else b
            if b.operation is np.multiply and not isinstance(b.arguments[0], Node):
                return self.product(a * b.arguments[0], b.arguments[1])
            return self.product(-a, b.arguments[0]) if _negated(b) else self.node(np.multiply, a, b)
        for one, other in ((a, b), (b, a)):
            if _negated(one):
                return -self.product(one.arguments[0], other)
        return self.node(np.multiply, *sorted((a, b), key=lambda one: one.place))


def _equals(one: Number, constant: float) -> bool:
    return not isinstance(one, Node) and one == constant


def _negated(one: Number) -> bool:
    return isinstance(one, Node) and one.operation is np.negative


def _shares(node: Node, bar: Number) -> Sequence[Number]:
    """Return the contributions of a node's adjoint to the adjoints of its arguments."""
    a, *rest = node.arguments
    record = node.trace.node
    if isinstance(node.operation, Primitive):
        return (bar * node.operation.derivative(node, a),)
    match node.operation:
        case np.add:
            return bar, bar
        case np.subtract:
            return bar, -bar
        case np.negative:
            return (-bar,)
        case np.multiply:
            return bar * rest[0], bar * a
        case np.divide:
            share = bar / rest[0]
            return share, -(share * node)
        case np.sqrt:
            return (0.5 * bar / node,)
        case np.minimum:
            least = record(np.less, a, rest[0])
            return record(np.where, least, bar, 0.0), record(np.where, least, 0.0, bar)
        case np.maximum:
            most = record(np.less, rest[0], a)
            return record(np.where, most, bar, 0.0), record(np.where, most, 0.0, bar)
        case np.exp:
            return (bar * node,)
        case np.log:
            return (bar / a,)
        case np.where:
            return 0.0, record(np.where, a, bar, 0.0), record(np.where, a, 0.0, bar)
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
        if node.operation not in (_unchanged, np.less) and any(
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
        values[place] = node.operation(*map(value, node.arguments))
    return [value(one) for one in outputs]
