"""The moment of a single block with recoil permeability, by NGSolve.

The moment is ``int (B_r + (mu - 1) mu_0 H) dV / mu_0``; the demagnetizing field ``mu_0 H = -grad
psi`` follows from the same equation for psi as in `halbach_fe.synthetic.ngsolve_reaction`.
"""

from __future__ import annotations

from typing import Any

import netgen.occ as occ
import ngsolve as ngs
import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.ngsolve_reaction import outline_face
from halbach_fe.synthetic.shapes import Shape


def moment_matrix(shape: Shape, permeability: Floats, mesh: Any = None, order: int = 3) -> Floats:
    """Return the matrix (3, 3) in A m^2 / T from a block's remanence to its moment.

    Parameters
    ----------
    permeability : ndarray, shape (3, 3)
        Relative recoil permeability in the shape's axes, as is the matrix.
    mesh : ngsolve.Mesh, optional
        A `block_mesh` of the shape, which is made if it is not given.
    order : int
        Order of the elements.
    """
    if np.array_equal(permeability, np.eye(3)):
        return shape.volume / MU_0 * np.eye(3)
    mesh = mesh or block_mesh(shape)
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()
    inside = mesh.Materials("block")
    mu = mesh.MaterialCF({"block": tuple(permeability.ravel())}, default=tuple(np.eye(3).ravel()))
    form = ngs.BilinearForm((ngs.CF(mu, dims=(3, 3)) * ngs.grad(u)) * ngs.grad(v) * ngs.dx,
                            symmetric=True)
    preconditioner = ngs.Preconditioner(form, "bddc")
    form.Assemble()
    inverse = ngs.solvers.CGSolver(form.mat, preconditioner, maxiter=1000, tol=1e-9)
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


def block_mesh(shape: Shape, size: float | None = None, improvements: int = 3) -> Any:
    """Return a mesh of a block in a large sphere of air, centred at the block's origin.

    Elements in the block have the ``size`` in m, by default a third of the block's thickness. The
    error of the moment is then 4e-5 for a sector of the FASER dipole. Netgen improves the mesh in
    some rounds of ``improvements``; fewer leave more elements, in less time.
    """
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
        maxh=10 * extent, grading=0.4, optsteps3d=improvements))
    mesh.Curve(4)
    return mesh
