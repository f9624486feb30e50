"""Base classes of loss terms: functions of grid nodes, of particles, or of distances.

A term is a class with a few functions that Taichi compiles into the simulator's kernels, for CPU and CUDA. It
depends only on the state: masses of nodes, positions and velocities of particles, distances to manipulators.
The simulator computes the sums and their adjoints.
"""

import numpy as np

from plab.sim.compiler import ti

__all__ = ["DistanceTerm", "NodeTerm", "ParticleTerm", "Term"]


class Term:
    """Base class of loss terms; the subclasses below define the functions of each kind.

    Attributes:
        name: Name of the weight; ``loss_<name>`` is the column in results and the entry in ``info``.
        label: Description of the measure, for reports.
        unit: Unit of the measure, for reports.
        weight: Weight in the loss; with 0 the term is not compiled.
        weighted: Whether the term is part of the loss; otherwise it is only measured, without gradient.
        sim: The simulator's kernels, after :meth:`attach`: numbers such as ``batch``, ``particles``, ``n``,
            ``dx``, ``mass`` (of a particle) and ``real``, Taichi's type of the simulation's numbers.
    """

    name: str = ""
    label: str = ""
    unit: str = ""
    weight: float = 0.0
    weighted: bool = True

    def attach(self, sim) -> None:
        """Attach the term to a simulator and allocate fields; called once."""
        self.sim = sim

    def set_target(self, e: int, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Process a new target.

        Args:
            e: Environment.
            mass: The target's mass tensor, shape [n, n, n], float64.
            sdf: Distance of each node to the target [domain units], same shape.
        """


class NodeTerm(Term):
    """Sum of a function of mass over the nodes of the mass tensor."""

    @ti.func
    def empty(self, e):
        """Value for an environment without any mass, float64."""
        return ti.cast(0.0, ti.f64)

    @ti.func
    def measure(self, e, node, mass):
        """Return the contribution of a node of environment ``e``, minus that of an empty node.

        ``node`` is its index along each axis, 3 integers in [0, n); ``sim.entry(e, node)`` is its entry in
        fields of n^3 numbers per environment. ``mass`` is its mass, positive; with the release's floor it may
        be negative.
        """
        return 0.0 * mass

    @ti.func
    def slope(self, e, node, mass):
        """Derivative of :meth:`measure` with respect to the mass."""
        return 0.0 * mass


class ParticleTerm(Term):
    """Sum of a function of position and velocity over the particles."""

    @ti.func
    def measure(self, e, x, v):
        """Return the contribution of a particle of environment ``e`` with position ``x`` [domain units] and
        velocity ``v``."""
        return 0.0 * x[0]

    @ti.func
    def gradient(self, e, x, v):
        """Derivatives of the term with respect to position and velocity, two 3-vectors."""
        return 0.0 * x, 0.0 * v

    @ti.func
    def finish(self, e):
        """Return the additional contribution of environment ``e``, float64."""
        return ti.cast(0.0, ti.f64)


class DistanceTerm(Term):
    """Sum of a function of the signed distances from all particles over the moving manipulators.

    An accumulator, a pair of float64, reduces the distances of a manipulator; accumulators of groups of
    particles are joined.

    Attributes:
        nearest_only: Whether the derivative with respect to a distance is nonzero for one particle only,
            whose number is the second entry of the accumulator.
    """

    nearest_only: bool = False

    @ti.func
    def start(self):
        """Initial accumulator, without particles."""
        return ti.Vector([0.0, 0.0], ti.f64)

    @ti.func
    def add(self, accumulator, d, particle):
        """Add a particle at distance ``d`` [domain units], negative inside the manipulator."""
        return accumulator

    @ti.func
    def join(self, accumulator, other):
        """Join the accumulators of two groups of particles; must be symmetric in them."""
        return accumulator + other

    @ti.func
    def measure(self, accumulator):
        """Return the contribution of a manipulator, float64."""
        return 0.0 * accumulator[0]

    @ti.func
    def slope(self, accumulator, d, particle):
        """Derivative of :meth:`measure` with respect to the distance of a particle, float64."""
        return 0.0 * accumulator[0]
