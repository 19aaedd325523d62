"""The moment of a single block that a Helmholtz coil measures, by NGSolve or by Gauss points.

The demagnetizing field of a block of recoil permeability mu changes its moment, which is
``int (B_r + (mu - 1) mu_0 H) dV / mu_0``. The field ``mu_0 H = -grad psi`` follows from the same
equation for psi as in `halbach_fe.synthetic.ngsolve_reaction`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.ngsolve_reaction import outline_face
from halbach_fe.synthetic.optional_packages import import_extra
from halbach_fe.synthetic.separate_reaction import lone_moment_matrix
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import Body

PRECISION = 1e-12
"""Relative tolerance of the conjugate gradients."""

VACUUM = tuple(np.eye(3).ravel().tolist())
"""The permeability of vacuum, row by row."""

MOST_SOLVES = 4
"""Largest number of different blocks for which NGSolve solves, some 10 s each. Of more different
ones, `lone_moment_matrix` gives the moments to some 1e-4."""


def moments(bodies: tuple[Body, ...], length: float) -> Floats:
    """Return the moments (n, 3) in A m^2 of single bodies, each in its own axes.

    Bodies of infinite length are given the finite ``length`` in m. Bodies of the same shape and
    permeability share their solves.
    """
    kinds = []
    for body in bodies:
        shape, seat = body.shape, body.seat_orientation.as_matrix()
        if np.isinf(shape.length):
            shape = replace(shape, length=length)
        tensor = seat.T @ body.permeability @ seat
        kinds.append((shape, tuple((tensor.round(12) + 0.0).ravel().tolist())))
    few = len({kind for kind in kinds if kind[1] != VACUUM}) <= MOST_SOLVES
    found = []
    for body, (shape, permeability) in zip(bodies, kinds, strict=True):
        matrix = (_known_matrix if few else _estimated_matrix)(shape, permeability)
        own = body.seat_orientation.inv().apply(body.remanence) * body.mean_factor
        found.append(body.seat_orientation.apply(matrix @ own))
    return np.array(found)


@lru_cache(maxsize=1024)
def _known_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """Return `moment_matrix`, cached; ``permeability`` is the tensor row by row.

    The tensor does not depend on the sign of the easy axis, so opposite blocks share a matrix.
    """
    tensor = np.reshape(permeability, (3, 3))
    vacuum = np.array_equal(tensor, np.eye(3))
    return moment_matrix(shape, tensor, None if vacuum else _known_mesh(shape))


@lru_cache(maxsize=4096)
def _estimated_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """Return `lone_moment_matrix`, cached; ``permeability`` is the tensor row by row."""
    return lone_moment_matrix(shape, np.reshape(permeability, (3, 3)))


@lru_cache(maxsize=1)
def _known_mesh(shape: Shape) -> Any:
    return block_mesh(shape)


def moment_matrix(shape: Shape, permeability: Floats, mesh: Any = None, order: int = 3) -> Floats:
    """Return the matrix (3, 3) in A m^2 / T from a block's remanence to its moment.

    Parameters
    ----------
    shape : Shape
    permeability : ndarray, shape (3, 3)
        Relative recoil permeability in the shape's axes, as is the matrix.
    mesh : ngsolve.Mesh, optional
        A `block_mesh` of the shape, which is made if it is not given.
    order : int
        Order of the elements.
    """
    if np.array_equal(permeability, np.eye(3)):
        return shape.volume / MU_0 * np.eye(3)
    ngs = import_extra("ngsolve")
    mesh = mesh or block_mesh(shape)
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()
    inside = mesh.Materials("block")
    mu = mesh.MaterialCF({"block": tuple(permeability.ravel())}, default=tuple(np.eye(3).ravel()))
    form = ngs.BilinearForm((ngs.CF(mu, dims=(3, 3)) * ngs.grad(u)) * ngs.grad(v) * ngs.dx,
                            symmetric=True)
    preconditioner = ngs.Preconditioner(form, "bddc")
    form.Assemble()
    inverse = ngs.solvers.CGSolver(form.mat, preconditioner, maxiter=1000, tol=PRECISION)
    volume = ngs.Integrate(ngs.CF(1.0), mesh, definedon=inside, order=8)
    columns = []
    for axis in np.eye(3):
        source = ngs.LinearForm(ngs.CF(tuple(axis)) * ngs.grad(v) * ngs.dx("block")).Assemble()
        psi = ngs.GridFunction(space)
        psi.vec.data = inverse * source.vec
        field = np.array(ngs.Integrate(-ngs.grad(psi), mesh, definedon=inside, order=2 * order))
        columns.append((axis * volume + (permeability - np.eye(3)) @ field) / MU_0)
    # the volume of the curved mesh differs slightly from the true one
    return np.array(columns).T * shape.volume / volume


def block_mesh(shape: Shape, size: float | None = None) -> Any:
    """Return a mesh of a block in a large sphere of air, centred at the block's origin.

    Elements in the block have the ``size`` in m, by default a third of the block's thickness. The
    error of the moment is then 4e-5 for a sector of the FASER dipole.
    """
    ngs, occ = import_extra("ngsolve"), import_extra("netgen.occ")
    thickness = shape.thickness
    size = size or thickness / 3
    block = outline_face(shape, np.zeros(2), 0.0, -shape.length / 2).Extrude(
        occ.Vec(0, 0, shape.length))
    block.mat("block")
    block.maxh = size
    block.edges.maxh = size / 3  # the field is singular at the edges
    extent = max(thickness, shape.length)
    centre = occ.Pnt(0, 0, 0)
    near, world = occ.Sphere(centre, 1.5 * extent) - block, occ.Sphere(centre, 30 * extent)
    world.faces.name = "far"
    near.maxh = max(3 * size, extent / 3)
    outside = world - near - block
    for air in (near, outside):
        air.mat("air")
    mesh = ngs.Mesh(occ.OCCGeometry(occ.Glue([block, near, outside])).GenerateMesh(
        maxh=10 * extent, grading=0.4))
    mesh.Curve(4)
    return mesh
