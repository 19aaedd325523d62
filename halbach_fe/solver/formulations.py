"""The finite-element formulations: problem file, unknowns, and B as a linear map of the unknowns.

Three weak forms of magnetostatics without currents, all with essential conditions on the outer
boundary (the files in pro/ derive them):

* ``magnetostatics_2d.pro``: vector potential a_z, int nu curl a . curl a' = int M . curl a', nodal
  elements of second order; a = 0 on the boundary, so that B . n = 0.
* ``magnetostatics_3d.pro``: the same weak form for the vector potential in 3D, edge elements of
  order 1 or 2 with a tree gauge; a x n = 0 on the boundary, so that B . n = 0.
* ``scalar_potential_3d.pro``: psi = mu_0 phi, int mu_r grad psi . grad v = int B_r . grad v, nodal
  elements of second order; psi = 0 on the boundary, so that H x n = 0.

The scalar potential is the dual of the vector potential. The difference between their solutions
shows the error that the outer boundary causes by its finite distance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse

from halbach_fe.solver.dofs import Unknowns
from halbach_fe.solver.interpolation import Located, curl_operators, nodal_operators
from halbach_fe.solver.mesh import Entities, VerifiedMesh


@dataclass(frozen=True)
class Formulation:
    """A weak form as a GetDP problem, with its unknowns and its linear solvers.

    Attributes
    ----------
    problem : str
        Name of the problem file in pro/.
    unknowns : callable
        Returns the number of unknowns, from the numbers of mesh entities off the outer boundary.
    flux_density : callable
        Takes a mesh, located points (n,) and unknowns. Returns three sparse operators (n, unknowns)
        from a solution to Bx, By and Bz in T.
    factorized : float
        Largest number of unknowns for which the matrix is factorized. Larger systems are solved by
        conjugate gradients.
    factorized_for_newton : float
        The same limit for Newton's method, where every step has a matrix of its own.
    numbers : mapping
        Constants of the problem, for ``-setnumber``.
    law : str
        Law of the iron's curve that enters the weak form: ``reluctivity`` or ``permeability``.
    route : str
        Name of the route, see `halbach_fe.solver.formulation_choice.choose_route`.
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
    """Return the operators of B = curl (a_z e_z) = (da_z/dy, -da_z/dx, 0)."""
    _, (x, y) = nodal_operators(mesh, located, unknowns)
    return [y, -x, 0 * x]


def _minus_gradient(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    """Return the operators of B = -grad psi, which holds in air only."""
    return [-slope for slope in nodal_operators(mesh, located, unknowns)[1]]


FACTORIZED = 200_000
"""Largest number of unknowns for which the matrix of the scalar potential is factorized. With
160 000 unknowns the factorization takes 4 GiB and 25 s, once for all sources. For thin iron
conjugate gradients need 2400 iterations, 60 s, for every source."""

CROSS_SECTION = Formulation("magnetostatics_2d.pro", lambda inner: inner.nodes, _curl_of_axial,
                            route="cross_section")
SCALAR_POTENTIAL = Formulation("scalar_potential_3d.pro", lambda inner: inner.nodes,
                               _minus_gradient, FACTORIZED, FACTORIZED // 4, law="permeability",
                               route="scalar_potential")


def edge_elements(order: int) -> Formulation:
    """Return the formulation of the vector potential with edge elements of order 1 or 2."""
    return Formulation(
        # The tree of the gauge starts on the outer boundary. It has one edge for every corner off
        # the boundary, and the unknowns of the tree's edges are fixed to 0.
        "magnetostatics_3d.pro", lambda inner: inner.edges - inner.corners + (
            2 * inner.faces if order == 2 else 0),
        curl_operators, numbers={"ORDER": order})
