"""The moment that a coil shows of a block on its own, by NGSolve.

A block of recoil permeability mu demagnetizes itself. With psi as in
`halbach_fe.synthetic.ngsolve_reaction` its moment is ``int (B_r + (mu - 1) mu_0 H) dV / mu_0``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.bodies import Body, SectorBody, Shape
from halbach_fe.synthetic.extras import needed
from halbach_fe.synthetic.ngsolve_reaction import outline_face

PRECISION = 1e-12
"""Of conjugate gradients, in the energy."""


def moments(bodies: tuple[Body, ...], length: float) -> Floats:
    """Moments (n, 3) in A m^2 of bodies on their own, in their own axes.

    Infinite bodies are taken for ``length`` in m. Bodies that are alike share the solves.
    """
    found = []
    for body in bodies:
        shape = body.shape
        if np.isinf(shape.length):
            shape = replace(shape, length=length)
        matrix = _known_matrix(shape, tuple(body.permeability.round(12).ravel()))
        found.append(matrix @ body.remanence * body.mean_factor)
    return np.array(found)


@lru_cache(maxsize=1024)
def _known_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """`moment_matrix` of a permeability row by row. An easy axis has no sign: blocks share it."""
    tensor = np.reshape(permeability, (3, 3))
    vacuum = np.array_equal(tensor, np.eye(3))
    return moment_matrix(shape, tensor, None if vacuum else _known_mesh(shape))


@lru_cache(maxsize=1)
def _known_mesh(shape: Shape) -> Any:
    return block_mesh(shape)


def moment_matrix(shape: Shape, permeability: Floats, mesh: Any = None, order: int = 3) -> Floats:
    """Moment over remanence (3, 3) in A m^2 / T, in the block's own axes, of a relative recoil
    permeability (3, 3); ``mesh`` is a `block_mesh`.
    """
    if np.array_equal(permeability, np.eye(3)):
        return shape.volume / MU_0 * np.eye(3)
    ngs = needed("ngsolve")
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
    # the curved mesh misses some of the volume
    return np.array(columns).T * shape.volume / volume


def block_mesh(shape: Shape, size: float | None = None) -> Any:
    """The block in a sphere, its own origin in the middle, in elements of ``size`` in m (default: a
    third of its thickness, which leaves 4e-5 of the moment of a sector of the FASER dipole).
    """
    ngs, occ = needed("ngsolve"), needed("netgen.occ")
    thickness = shape.outer - shape.inner if isinstance(shape, SectorBody) else shape.depth
    size = size or thickness / 3
    block = outline_face(shape, np.zeros(2), 0.0, -shape.length / 2).Extrude(
        occ.Vec(0, 0, shape.length))
    block.mat("block")
    block.maxh = size
    block.edges.maxh = size / 3  # the field is singular there
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
