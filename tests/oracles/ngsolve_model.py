"""Halbach arrays in NGSolve: another mesher, curved elements of high order, other formulations.

Shares nothing with halbach_fe but numbers: the geometry is built anew from radii and angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import netgen.occ as occ
import ngsolve as ngs
import numpy as np

MU_0 = 4e-7 * np.pi


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
    def at(radius, angle):
        return occ.Pnt(radius * np.cos(angle), radius * np.sin(angle), z_min)

    middle = (start + stop) / 2
    corners = [at(inner, start), at(outer, start), at(outer, stop), at(inner, stop)]
    wire = occ.Wire([
        occ.Segment(corners[0], corners[1]),
        occ.ArcOfCircle(corners[1], at(outer, middle), corners[2]),
        occ.Segment(corners[2], corners[3]),
        occ.ArcOfCircle(corners[3], at(inner, middle), corners[0])])
    return occ.Face(wire).Extrude(occ.Vec(0, 0, z_max - z_min))


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
    """B (n, 3) in T at points by the curl-curl equation: real materials minus vacuum.

    B is along x on the plane x = 0 (natural) and tangential on y = 0, z = 0 and far away.
    """
    space = ngs.HCurl(mesh, order=order, dirichlet="y0|z0|far", nograds=True)
    u, v = space.TnT()
    remanence = mesh.MaterialCF({f"block{b}": dipole.remanence_of(b)
                                 for b in range(dipole.blocks)}, default=(0, 0, 0))
    fields = []
    for real in (True, False):
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
        inverse_a = ngs.solvers.CGSolver(a.mat, preconditioner, maxiter=2000, tol=1e-10)
        solution.vec.data = inverse_a * right
        solution.vec.data += a.harmonic_extension * solution.vec
        solution.vec.data += a.inner_solve * f.vec
        fields.append(_at(ngs.curl(solution), mesh, points))
    return fields[0] - fields[1]


def _at(field, mesh: ngs.Mesh, points: np.ndarray) -> np.ndarray:
    """An even-in-z, symmetric field in the octant at any points, by its symmetries."""
    sign = np.where(points < 0, -1.0, 1.0)
    where = np.abs(points)
    values = np.array(field(mesh(*where.T)))
    # B_x is even in all; B_y is odd in x and y; B_z odd in x and z
    return values * np.column_stack([np.ones(len(points)), sign[:, 0] * sign[:, 1],
                                     sign[:, 0] * sign[:, 2]])
