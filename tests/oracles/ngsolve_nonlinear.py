"""Saturating iron and anisotropic magnets in NGSolve: the laws in closed form, written anew.

Shares nothing with halbach_fe but numbers; NGSolve differentiates the weak forms symbolically.
"""

from __future__ import annotations

from dataclasses import dataclass

import netgen.occ as occ
import ngsolve as ngs
import numpy as np

from tests.oracles.ngsolve_model import MU_0, Dipole, even_field

RESIDUAL = 1e-11
"""Newton's method stops there, relative to the first residual; one or two steps more and it is at
rounding, some 1e-14."""

MAX_STEPS = 40


@dataclass(frozen=True)
class Iron:
    """B = mu_0 H + J_s H / (H + h); radii in m, J_s in T, h for the initial permeability."""

    inner: float
    outer: float
    initial: float
    saturation: float

    @property
    def half(self) -> float:
        """h in A/m."""
        return self.saturation / (MU_0 * (self.initial - 1))

    def reluctivity(self, square):
        """mu_0 H / B at B^2 in T^2: the positive root of mu_0 H^2 + (mu_0 h + J_s - B) H = B h."""
        root = ngs.sqrt if isinstance(square, ngs.CoefficientFunction) else np.sqrt
        size = root(square + 1e-24)  # the root has no slope at 0
        p = MU_0 * self.half + self.saturation - size
        return 2 * MU_0 * self.half / (p + root(p * p + 4 * MU_0 * self.half * size))

    def permeability(self, square):
        """B / (mu_0 H) at (mu_0 H)^2 in T^2."""
        return 1 + self.saturation / (ngs.sqrt(square + 1e-24) + MU_0 * self.half)


@dataclass(frozen=True)
class Section:
    """The cross-section of a ring of sectors; lengths in m, angles in rad.

    The recoil permeability is ``along`` the easy axes, whose angles are ``easy`` (blocks,), and
    ``across`` them; magnetizations (blocks, 2) are M = nu B - H in A/m.
    """

    inner: float
    outer: float
    magnetizations: np.ndarray
    easy: np.ndarray
    along: float
    across: float
    first_angle: float = np.pi / 2
    iron: Iron | None = None

    def reluctivity(self, block: int) -> np.ndarray:
        """Relative, (2, 2)."""
        axis = np.array([np.cos(self.easy[block]), np.sin(self.easy[block])])
        outer = np.outer(axis, axis)
        return outer / self.along + (np.eye(2) - outer) / self.across


def disk(section: Section, size: float, far: float = 20.0) -> ngs.Mesh:
    """The cross-section in a disk; arcs are curved."""
    blocks = len(section.magnetizations)
    pitch = 2 * np.pi / blocks

    def circle(radius):
        return occ.Circle((0, 0), radius).Face()

    def at(radius, angle):
        return occ.Pnt(radius * np.cos(angle), radius * np.sin(angle), 0)

    faces = []
    for block in range(blocks):
        start = section.first_angle + (block - 0.5) * pitch
        stop, middle = start + pitch, start + pitch / 2
        corners = [at(section.inner, start), at(section.outer, start),
                   at(section.outer, stop), at(section.inner, stop)]
        face = occ.Face(occ.Wire([
            occ.Segment(corners[0], corners[1]),
            occ.ArcOfCircle(corners[1], at(section.outer, middle), corners[2]),
            occ.Segment(corners[2], corners[3]),
            occ.ArcOfCircle(corners[3], at(section.inner, middle), corners[0])]))
        face.faces.name = f"block{block}"
        faces.append(face)
    if section.iron is not None:
        ring = circle(section.iron.outer) - circle(section.iron.inner)
        ring.faces.name = "iron"
        faces.append(ring)
    bore = circle(section.inner)
    bore.faces.name = "air"
    for face in [*faces, bore]:
        face.faces.maxh = size
    world = circle(far)
    world.edges.name = "far"
    for face in [*faces, bore]:
        world = world - face
    world.faces.name = "air"
    geometry = occ.OCCGeometry(occ.Glue([*faces, bore, world]), dim=2)
    mesh = ngs.Mesh(geometry.GenerateMesh(maxh=far / 4, grading=0.3))
    mesh.Curve(5)
    return mesh


def section_field(section: Section, mesh: ngs.Mesh, order: int, points: np.ndarray) -> np.ndarray:
    """B (n, 3) in T at points, by the vector potential."""
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()

    def curl(a):
        return ngs.CF((ngs.grad(a)[1], -ngs.grad(a)[0]))

    blocks = range(len(section.magnetizations))
    unity = (1.0, 0.0, 0.0, 1.0)
    nu = mesh.MaterialCF({f"block{b}": tuple(section.reluctivity(b).ravel()) for b in blocks},
                         default=unity)
    nu = ngs.CF(nu, dims=(2, 2))
    source = mesh.MaterialCF({f"block{b}": tuple(MU_0 * section.magnetizations[b])
                              for b in blocks}, default=(0.0, 0.0))
    form = ngs.BilinearForm(space)
    form += (nu * curl(u)) * curl(v) * ngs.dx("block.*|air")
    form += -source * curl(v) * ngs.dx("block.*")
    if section.iron is not None:
        form += (section.iron.reluctivity(curl(u) * curl(u)) * curl(u) * curl(v)
                 * ngs.dx("iron", bonus_intorder=4))
    solution = ngs.GridFunction(space)
    newton(form, solution)
    field = np.zeros((len(points), 3))
    field[:, :2] = np.array(curl(solution)(mesh(*points[:, :2].T)))
    return field


def potential_reaction(
    dipole: Dipole, iron: Iron, mesh: ngs.Mesh, order: int, points: np.ndarray,
    remanence: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """What permeability and iron add to B (n, 3) in T at points, by the scalar potential in an
    octant: real materials minus vacuum. With ``remanence`` all blocks have the same, along x.

    The potential vanishes on x = 0, which B crosses at right angles.
    """
    space = ngs.H1(mesh, order=order, dirichlet="far|x0")
    u, v = space.TnT()
    source = mesh.MaterialCF({f"block{b}": remanence or dipole.remanence_of(b)
                              for b in range(dipole.blocks)}, default=(0.0, 0.0, 0.0))
    fields = []
    for real in (True, False):
        mu = mesh.MaterialCF({"block.*": dipole.permeability if real else 1.0}, default=1.0)
        if real:
            mu = mesh.MaterialCF({"iron": iron.permeability(ngs.grad(u) * ngs.grad(u))},
                                 default=mu)
        form = ngs.BilinearForm(space)
        form += mu * ngs.grad(u) * ngs.grad(v) * ngs.dx
        form += -source * ngs.grad(v) * ngs.dx("block.*")
        solution = ngs.GridFunction(space)
        newton(form, solution)
        fields.append(even_field(-ngs.grad(solution), mesh, points))
    return fields[0] - fields[1]


def newton(form: ngs.BilinearForm, solution: ngs.GridFunction) -> list[float]:
    """Newton's method, halving steps until the residual falls; its residuals."""
    free = solution.space.FreeDofs()
    residual, step, kept = (solution.vec.CreateVector() for _ in range(3))

    def norm():
        form.Apply(solution.vec, residual)
        residual[~free] = 0.0
        return residual.Norm()

    norms = [norm()]
    while norms[-1] > RESIDUAL * norms[0]:
        if len(norms) > MAX_STEPS:
            raise RuntimeError(f"NGSolve did not converge: {norms}")
        form.AssembleLinearization(solution.vec)
        step.data = form.mat.Inverse(free, "sparsecholesky") * residual
        kept.data = solution.vec
        length = 1.0
        while True:
            solution.vec.data = kept - length * step
            norms_now = norm()
            if norms_now < norms[-1] or length < 1e-3:
                break
            length /= 2
        norms.append(norms_now)
    return norms
