"""Halbach arrays in NGSolve: another mesher, curved elements of high order, other formulations.

Shares nothing with halbach_fe's own model but numbers: the geometry is that of synthetic campaigns,
built anew from radii and angles.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import netgen.occ as occ
import ngsolve as ngs
import numpy as np

from halbach_fe.synthetic.ngsolve_reaction import outline_face
from halbach_fe.synthetic.true_magnet_of_study import SectorBody


@dataclass(frozen=True)
class Dipole:
    """A Halbach dipole of closed rings of sectors; lengths in m, B_r in T, angles in rad.

    The first block's middle is at ``first_angle``, magnetized at ``first_direction``; block i is
    i pitches further, its magnetization two.
    """

    blocks: int
    inner: float
    outer: float
    length: float
    remanence: float
    permeability: float
    first_angle: float = np.pi / 2
    first_direction: float = np.pi
    iron: tuple[float, float, float] | None = None  # radii, relative permeability

    def remanence_of(self, block: int) -> tuple[float, float, float]:
        """Remanence vector of a block, from 0."""
        angle = self.first_direction + 2 * block * 2 * np.pi / self.blocks
        return self.remanence * np.cos(angle), self.remanence * np.sin(angle), 0.0


def _wedge(inner, outer, start, stop, z_min, z_max):
    """A sector between two angles; the arcs are true arcs."""
    middle = (start + stop) / 2
    sector = SectorBody(inner, outer, (stop - start) / 2, z_max - z_min)
    centre = sector.middle * np.array([np.cos(middle), np.sin(middle)])
    return outline_face(sector, centre, middle, z_min).Extrude(occ.Vec(0, 0, z_max - z_min))


def eighth(
    dipole: Dipole, size: float, bore_size: float | None = None, far: float = 4.0,
    grading: float = 0.25,
) -> ngs.Mesh:
    """The part x, y, z > 0 of an array whose middle planes are planes of symmetry."""
    pitch = 2 * np.pi / dipole.blocks
    half = dipole.length / 2
    parts = []
    for block in range(dipole.blocks):
        middle = dipole.first_angle + block * pitch
        middle = (middle + np.pi) % (2 * np.pi) - np.pi
        start, stop = max(middle - pitch / 2, 0.0), min(middle + pitch / 2, np.pi / 2)
        if stop - start > 1e-9:
            wedge = _wedge(dipole.inner, dipole.outer, start, stop, 0.0, half)
            wedge.mat(f"block{block}")
            wedge.maxh = size
            parts.append(wedge)
    if dipole.iron is not None:
        iron = _wedge(dipole.iron[0], dipole.iron[1], 0.0, np.pi / 2, 0.0, half)
        iron.mat("iron")
        iron.maxh = size
        parts.append(iron)
    axis = occ.Axes((0, 0, 0), occ.Z)
    octant = occ.Box(occ.Pnt(0, 0, 0), occ.Pnt(2 * far, 2 * far, 2 * far))
    bore = occ.Cylinder(axis, dipole.inner * 0.85, half + 0.3) * octant
    bore.mat("air")
    bore.maxh = bore_size or size
    parts.append(bore)
    world = occ.Sphere(occ.Pnt(0, 0, 0), far) * octant
    for part in parts:
        world = world - part
    world.mat("air")
    for solid in parts:  # fields are singular along the edges of the ends
        for edge in solid.edges:
            if solid.mat != "air" and abs(edge.center.z - half) < 1e-9:
                edge.maxh = size / 3
    shape = occ.Glue([*parts, world])
    for face in shape.faces:
        for name, coordinate in (("x0", face.center.x), ("y0", face.center.y),
                                 ("z0", face.center.z)):
            if abs(coordinate) < 1e-9:
                face.name = name
        if np.linalg.norm([face.center.x, face.center.y, face.center.z]) > 0.8 * far:
            face.name = "far"
    mesh = ngs.Mesh(occ.OCCGeometry(shape).GenerateMesh(maxh=far / 4, grading=grading))
    mesh.Curve(4)
    return mesh


def vector_potential(dipole: Dipole, mesh: ngs.Mesh, order: int, points: np.ndarray) -> np.ndarray:
    """B (n, 3) in T at points by the curl-curl equation: real materials minus vacuum."""
    return (vector_potential_field(dipole, mesh, order, points)
            - vector_potential_field(dipole, mesh, order, points, real=False))


def vector_potential_field(
    dipole: Dipole, mesh: ngs.Mesh, order: int, points: np.ndarray, real: bool = True,
    residual: float = 1e-10,
) -> np.ndarray:
    """B (n, 3) in T at points by the curl-curl equation, of real materials or of their sources in
    vacuum, down to a relative ``residual``. Iron that the mesh has and the dipole has not is air.

    B is along x on the plane x = 0 (natural) and tangential on y = 0, z = 0 and far away.
    """
    space = ngs.HCurl(mesh, order=order, dirichlet="y0|z0|far", nograds=True)
    u, v = space.TnT()
    remanence = mesh.MaterialCF({f"block{b}": dipole.remanence_of(b)
                                 for b in range(dipole.blocks)}, default=(0, 0, 0))
    inverse = {"air": 1.0, "iron": 1.0} | {
        f"block{b}": 1 / dipole.permeability if real else 1.0 for b in range(dipole.blocks)}
    if real and dipole.iron is not None:
        inverse["iron"] = 1 / dipole.iron[2]
    nu = mesh.MaterialCF(inverse)
    a = ngs.BilinearForm(nu * ngs.curl(u) * ngs.curl(v) * ngs.dx + 1e-7 * nu * u * v * ngs.dx,
                         condense=True)
    f = ngs.LinearForm(nu * remanence * ngs.curl(v) * ngs.dx)
    preconditioner = ngs.Preconditioner(a, "bddc")
    a.Assemble()
    f.Assemble()
    solution = ngs.GridFunction(space)
    right = f.vec.CreateVector()
    right.data = f.vec + a.harmonic_extension_trans * f.vec
    inverse_a = ngs.solvers.CGSolver(a.mat, preconditioner, maxiter=2000, tol=residual)
    solution.vec.data = inverse_a * right
    solution.vec.data += a.harmonic_extension * solution.vec
    solution.vec.data += a.inner_solve * f.vec
    return even_field(ngs.curl(solution), mesh, points)


def even_field(field, mesh: ngs.Mesh, points: np.ndarray) -> np.ndarray:
    """An even-in-z, symmetric field in the octant at any points, by its symmetries."""
    sign = np.where(points < 0, -1.0, 1.0)
    where = np.abs(points)
    values = np.array(field(mesh(*where.T)))
    # B_x is even in all; B_y is odd in x and y; B_z odd in x and z
    return values * np.column_stack([np.ones(len(points)), sign[:, 0] * sign[:, 1],
                                     sign[:, 0] * sign[:, 2]])


@dataclass(frozen=True)
class Column:
    """Timings in s and the reaction (n, 3) in T of one block, by a scalar potential of high order
    on the whole magnet.
    """

    unknowns: int
    setup: float
    solve: float
    reaction: np.ndarray


def whole(dipole: Dipole, block: int, z_min: float, z_max: float, size: float,
          far: float = 4.0) -> ngs.Mesh:
    """All of the magnet; only one block, between two heights, is a region of its own."""
    pitch, half = 2 * np.pi / dipole.blocks, dipole.length / 2
    middle = dipole.first_angle + block * pitch
    one = _wedge(dipole.inner, dipole.outer, middle - pitch / 2, middle + pitch / 2, z_min, z_max)
    one.mat("one")
    axis = occ.Axes((0, 0, -half), occ.Z)

    def tube(inner, outer):
        return (occ.Cylinder(axis, outer, dipole.length) - occ.Cylinder(axis, inner, dipole.length))

    ring = tube(dipole.inner, dipole.outer) - one
    ring.mat("ring")
    parts = [one, ring]
    if dipole.iron is not None:
        iron = tube(*dipole.iron[:2])
        iron.mat("iron")
        parts.append(iron)
    for part in parts:
        part.maxh = size
    bore = occ.Cylinder(occ.Axes((0, 0, -half - 0.3), occ.Z), dipole.inner * 0.85,
                        dipole.length + 0.6)
    bore.mat("air")
    bore.maxh = size
    parts.append(bore)
    world = occ.Sphere(occ.Pnt(0, 0, 0), far)
    for face in world.faces:
        face.name = "far"
    for part in parts:
        world = world - part
    world.mat("air")
    mesh = ngs.Mesh(occ.OCCGeometry(occ.Glue([*parts, world])).GenerateMesh(
        maxh=far / 4, grading=0.3))
    mesh.Curve(3)
    return mesh


def scalar_potential_column(
    dipole: Dipole, mesh: ngs.Mesh, order: int, remanence: tuple[float, float, float],
    points: np.ndarray, direct: bool = False, residual: float = 1e-10,
) -> Column:
    """Reaction of the block ``one`` by div(mu_r grad psi) = div B_r: real minus vacuum.

    ``direct`` factorizes, which pays for many sources; conjugate gradients, down to a relative
    ``residual``, are faster for one.
    """
    started = time.monotonic()
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()
    solvers = []
    for real in (True, False):
        mu = mesh.MaterialCF({"one": dipole.permeability if real else 1.0,
                              "ring": dipole.permeability if real else 1.0,
                              "iron": dipole.iron[2] if real and dipole.iron else 1.0},
                             default=1.0)
        a = ngs.BilinearForm(mu * ngs.grad(u) * ngs.grad(v) * ngs.dx, condense=True)
        preconditioner = None if direct else ngs.Preconditioner(a, "bddc")
        a.Assemble()
        solvers.append((a, a.mat.Inverse(space.FreeDofs(coupling=True), "sparsecholesky") if direct
                        else ngs.solvers.CGSolver(
                            a.mat, preconditioner, maxiter=500, tol=residual)))
    setup = time.monotonic() - started
    started = time.monotonic()
    source = mesh.MaterialCF({"one": remanence}, default=(0, 0, 0))
    f = ngs.LinearForm(source * ngs.grad(v) * ngs.dx("one"))
    f.Assemble()
    fields = []
    for a, solver in solvers:
        psi = ngs.GridFunction(space)
        right = f.vec.CreateVector()
        right.data = f.vec + a.harmonic_extension_trans * f.vec
        psi.vec.data = solver * right
        psi.vec.data += a.harmonic_extension * psi.vec
        psi.vec.data += a.inner_solve * f.vec
        fields.append(np.array((-ngs.grad(psi))(mesh(*points.T))))
    return Column(space.ndof, setup, time.monotonic() - started, fields[0] - fields[1])


def cross_section(
    shapes: dict[str, tuple[occ.Face, float]],
    laws: dict[str, float | tuple[np.ndarray, np.ndarray]],
    remanence: dict[str, tuple[float, float]], points: np.ndarray, far: float = 5.0,
    order: int = 3,
) -> np.ndarray:
    """B (n, 2) in T at points (n, 2) in m by the energy of the vector potential, to 1e-9.

    ``shapes`` are faces with their largest element in m; ``laws`` a relative permeability, or B in
    T and H in A/m, by name, 1 for the others and for air.
    """
    mu_0 = 4e-7 * np.pi
    world = occ.Circle((0, 0), far).Face()
    for edge in world.edges:
        edge.name = "far"
    for name, (face, size) in shapes.items():
        face.faces.name, face.maxh = name, size
        world = world - face
    world.faces.name = "air"
    glued = occ.Glue([*(face for face, _ in shapes.values()), world])
    mesh = ngs.Mesh(occ.OCCGeometry(glued, dim=2).GenerateMesh(maxh=far / 3, grading=0.25))
    mesh.Curve(order)
    space = ngs.H1(mesh, order=order, dirichlet="far")
    slope = ngs.grad(space.TrialFunction())
    flux = ngs.CF((slope[1], -slope[0]))
    energy = ngs.BilinearForm(space, symmetric=True)
    for name in set(mesh.GetMaterials()):
        law, region = laws.get(name, 1.0), mesh.Materials(name)
        if isinstance(law, tuple):
            density = ngs.BSpline(2, [0.0, *law[0]], list(law[1])).Integrate()
            energy += ngs.SymbolicEnergy(density(ngs.sqrt(flux * flux + 1e-14)), definedon=region)
        else:
            own = ngs.CF(remanence.get(name, (0.0, 0.0)))
            energy += ngs.SymbolicEnergy(
                (0.5 * flux * flux - own * flux) / (mu_0 * law), definedon=region)
    potential = ngs.GridFunction(space)
    ngs.solvers.NewtonMinimization(energy, potential, printing=False, maxerr=1e-9, maxit=60)
    slope = ngs.grad(potential)
    return np.array(ngs.CF((slope[1], -slope[0]))(mesh(*points.T)))
