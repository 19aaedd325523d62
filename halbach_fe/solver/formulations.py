"""The finite-element formulations: problem file, unknowns, and field from unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse

from halbach_fe.solver.dofs import Unknowns
from halbach_fe.solver.interpolation import (
    Located,
    curl_operators,
    nodal_operators,
)
from halbach_fe.solver.mesh import Entities, VerifiedMesh


@dataclass(frozen=True)
class Formulation:
    """A problem file, what its unknowns are, and what solves it.

    Attributes
    ----------
    problem : str
    unknowns : callable
        How many there must be, by what a mesh has off the boundary.
    flux_density : callable
        Mesh, located points and unknowns to the sparse operators of Bx, By, Bz there.
    factorized : int
        Up to so many unknowns the matrix is factorized, beyond it conjugate gradients are used.
    factorized_for_newton : int
        The same of Newton's method, where every step has a matrix of its own.
    numbers : mapping
        Constants of the problem.
    law : str
        Which of a curve's laws it solves with: ``reluctivity`` or ``permeability``.
    route : str
        Its name in a study, see `halbach_fe.solver.field.choose_route`.
    """

    problem: str
    unknowns: Callable[[Entities], int]
    flux_density: Callable[[VerifiedMesh, Located, Unknowns], list[sparse.csr_array]]
    factorized: float = np.inf
    factorized_for_newton: float = np.inf
    numbers: Mapping[str, float] = field(default_factory=dict)
    law: str = "reluctivity"
    route: str = "edge_elements"


def _curl_of_axial(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    _, (x, y) = nodal_operators(mesh, located, unknowns)
    return [y, -x, 0 * x]


def _minus_gradient(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    return [-slope for slope in nodal_operators(mesh, located, unknowns)[1]]


FACTORIZED = 200_000
"""Unknowns of a scalar potential of second order: 160 000 take 4 GiB and 25 s, while thin iron
takes conjugate gradients 2400 iterations, 60 s, for every source."""

CROSS_SECTION = Formulation("magnetostatics_2d.pro", lambda inner: inner.nodes, _curl_of_axial,
                            route="cross_section")
SCALAR_POTENTIAL = Formulation("scalar_potential_3d.pro", lambda inner: inner.nodes,
                               _minus_gradient, FACTORIZED, FACTORIZED // 4, law="permeability",
                               route="scalar_potential")


def edge_elements(order: int) -> Formulation:
    """Edge elements of order 1 or 2."""
    return Formulation(
        # the tree of the gauge, started on the boundary, has one edge per corner off it
        "magnetostatics_3d.pro", lambda inner: inner.edges - inner.corners + (
            2 * inner.faces if order == 2 else 0),
        curl_operators, numbers={"ORDER": order})
