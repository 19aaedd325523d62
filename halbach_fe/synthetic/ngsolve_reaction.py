"""The field that recoil permeability and iron add to that of bodies in vacuum, by NGSolve.

The scalar potential psi, ``mu_0 H = -grad psi``, satisfies ``div(mu_r grad psi) = div B_r``. It is
computed with curved elements of high order; every body is a region with its own magnetization. The
materials respond to the field with the polarization ``(mu_r - 1) mu_0 H``. The reaction is the
field of this polarization, summed over the quadrature points of the elements as that of dipoles.
The sum is insensitive to the errors of the potential near the edges of bodies, where the field is
singular: the gradient of the potential at the points, less that of vacuum on the same mesh, is 40
times less accurate.

Bodies are meshed in their nominal places. A displacement of a tenth of a millimetre, or a gap as
narrow, would need elements of that size, so only the magnetizations follow the true body. The
neglected field is mu_r - 1 times the change that the displacement makes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.core.installation import import_extra
from halbach_fe.core.threads import in_threads, reordered, share_out
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.shapes import CylinderBody, PolygonBody, SectorBody, Shape
from halbach_fe.synthetic.true_magnet import (
    Ball,
    Body,
    FroehlichLaw,
    IronLaw,
    Pole,
    TableLaw,
    TrueMagnet,
    Tube,
)

MAX_STEPS = 40
"""Largest number of steps of Newton's method."""

FAR = {2: 100.0, 3: 8.0}
"""Distance of the outer boundary relative to the magnet's largest extent, by dimension.

The potential of a dipole falls with the first power of the distance in two dimensions and with the
second in three. The boundary therefore changes the reaction by (1/100)^2 or (1/8)^3 of the dipole's
field, and Halbach arrays have a very small dipole moment.
"""

USUAL_ORDER = {2: 5, 3: 3}
"""Polynomial order of the potential by dimension."""

END_SIZE = 1 / 8
"""Smallest size of elements at the ends of tubes and plates of iron, relative to that elsewhere;
above it they are as large as the iron is thick. The field is singular at these edges. Around a
dipole of four rings in a tube of 6 mm, what the materials add was wrong by 39 uT rms of 5.5 mT
without such elements, and is by 4 uT."""


@dataclass(frozen=True)
class Elements:
    """How finite elements resolve a magnet."""

    size: float | None = None
    """Largest element size in the magnet; by default a third of the blocks' thickness in three
    dimensions, a sixth in two; less at the ends of iron tubes, see `END_SIZE`, and half as much in
    other iron: beside plates of 8 mm the error fell from 1.2e-4 T to 2.2e-5 T rms. In m."""
    order: int | None = None
    """Polynomial order of the potential, by default `USUAL_ORDER`."""
    grading: float = 0.3
    """Growth of the elements with the distance from the magnet, from 0 (slow) to 1 (fast)."""
    mirrored: tuple[int, int, int] = (0, 0, 0)
    """How the potential in three dimensions changes if x, y or z is mirrored: 1 if it is
    the same, -1 if it changes its sign, 0 if nothing is known. What is mirrored is not meshed."""
    edge: float | None = None
    """Size along the edges of iron, where the field is singular, in three dimensions; by default
    only the ends of tubes have smaller elements. In m."""
    tip: float | None = None
    """With ``size`` and ``edge``, size along edges whose middles are within two elements of a
    point, and twice that on such faces: the tip of a pole that saturates is magnetized least
    evenly, next to where its field is asked for. In m."""


def reaction_field(magnet: TrueMagnet, points: Floats, elements: Elements | None = None) -> Floats:
    """Return the part of B (n, 3) in T, at points (n, 3) in m in air, that the materials add.

    It is the difference between the field with their response and that of `vacuum_field`.
    """
    if magnet.is_vacuum:
        return np.zeros((len(points), 3))
    elements, size = elements or Elements(), magnet.dimension
    with import_extra("ngsolve").TaskManager():
        mirrored = np.flatnonzero(elements.mirrored)
        near = points[:, :size].copy()
        near[:, mirrored] = np.abs(near[:, mirrored])
        mesh = mesh_of(magnet, near, elements)
        potential = solve_potential(magnet, mesh, elements.order or USUAL_ORDER[size])
        places, moments = _response(magnet, mesh, potential, near)
    for axis in mirrored:
        sign = np.full(size, float(elements.mirrored[axis]))
        sign[axis] *= -1  # -grad psi
        flip = np.where(np.arange(size) == axis, -1.0, 1.0)
        places, moments = np.vstack([places, flip * places]), np.vstack([moments, sign * moments])
    field = np.zeros((len(points), 3))
    field[:, :size] = moment_field(places, moments, points[:, :size])
    return field


def _response(magnet: TrueMagnet, mesh: Any, potential: Any, points: Floats
              ) -> tuple[Floats, Floats]:
    """Return the dipoles that represent the materials' response at points (m, d) in m.

    These are their positions (n, d) in m, which are the quadrature points of the elements, and mu_0
    times their moments (n, d) in T m^d. Elements that have points nearby, relative to their size,
    take a rule of three times the order: 2 mm off plates, elements of 7 mm made 5.9 mT of 67 mT
    wrong without it.
    """
    ngs, size = import_extra("ngsolve"), magnet.dimension
    field = -ngs.grad(potential)
    unity = ngs.CF(tuple(np.eye(size).ravel()), dims=(size, size))
    polarization = (_recoil(magnet, mesh) - unity) * field
    laws = magnet.all_iron.laws if magnet.all_iron else {}
    for region, law in laws.items():
        polarization = polarization + mesh.MaterialCF({region: 1.0}, default=0.0) * (
            permeability(law, field * field) - 1) * field
    kind = ngs.TRIG if size == 2 else ngs.TET
    responding = mesh.Materials("|".join([*laws, *(
        f"block{number}" for number, body in enumerate(magnet.all_bodies)
        if not body.is_vacuum)]))

    def dipoles(order: int) -> tuple[Floats, Floats, Floats]:
        """Return positions, moments, and the edges of the elements in m, by element (n, rule)."""
        rule = ngs.IntegrationRule(kind, order)
        where = mesh.MapToAllElements({kind: rule}, responding)
        places = np.array(ngs.CF((ngs.x, ngs.y, ngs.z)[:size])(where))
        jacobian = np.array(ngs.specialcf.JacobianMatrix(size, size)(where)).reshape(
            -1, size, size)
        volume = np.abs(np.linalg.det(jacobian)).reshape(-1, len(rule))
        weights = np.asarray(rule.weights) * volume
        moments = np.array(polarization(where)).reshape(*volume.shape, size) * weights[..., None]
        return places.reshape(moments.shape), moments, volume**(1 / size)

    order, near = 2 * (potential.space.globalorder - 1), 1.5
    places, moments, sizes = dipoles(order)
    fine = (KDTree(points).query(places)[0] < near * sizes).any(axis=1)
    parts = [(places[~fine], moments[~fine])]
    if fine.any():
        places, moments, _ = dipoles(3 * order)
        parts.append((places[fine], moments[fine]))
    return (np.vstack([one.reshape(-1, size) for one, _ in parts]),
            np.vstack([one.reshape(-1, size) for _, one in parts]))


@reordered
def _field_of_lines(points: Floats, places: Floats, moments: Floats, first: int, last: int,
                    out: Floats) -> None:
    """Write 2 pi B (n, 2) of lines of dipoles at points ``first`` to ``last`` of (n, 2) in m.

    ``places`` (2, m) in m and ``moments`` (2, m) have a row per axis.
    """
    for n in range(first, last):
        bx = by = 0.0
        for k in range(places.shape[1]):
            x, y = points[n, 0] - places[0, k], points[n, 1] - places[1, k]
            inverse = 1 / (x * x + y * y)
            along = 2 * (x * moments[0, k] + y * moments[1, k]) * inverse
            bx += (along * x - moments[0, k]) * inverse
            by += (along * y - moments[1, k]) * inverse
        out[n, 0], out[n, 1] = bx, by


@reordered
def _field_of_dipoles(points: Floats, places: Floats, moments: Floats, first: int, last: int,
                      out: Floats) -> None:
    """Write 4 pi B (n, 3) of dipoles at points ``first`` to ``last`` of (n, 3) in m.

    ``places`` (3, m) in m and ``moments`` (3, m) have a row per axis.
    """
    for n in range(first, last):
        bx = by = bz = 0.0
        for k in range(places.shape[1]):
            x, y, z = (points[n, 0] - places[0, k], points[n, 1] - places[1, k],
                       points[n, 2] - places[2, k])
            square = 1 / (x * x + y * y + z * z)
            cube = square * sqrt(square)
            along = 3 * square * (x * moments[0, k] + y * moments[1, k] + z * moments[2, k])
            bx += (along * x - moments[0, k]) * cube
            by += (along * y - moments[1, k]) * cube
            bz += (along * z - moments[2, k]) * cube
        out[n, 0], out[n, 1], out[n, 2] = bx, by, bz


def moment_field(places: Floats, moments: Floats, points: Floats) -> Floats:
    """Return B (n, d) in T of dipoles at points (n, d) in m.

    ``places`` (m, d) in m are the positions of the dipoles, ``moments`` (m, d) mu_0 times their
    moments in T m^d. In two dimensions they are lines of dipoles. Source: J. D. Jackson, Classical
    Electrodynamics, 3rd ed., equation 5.56; in two dimensions the same integrated along z.
    """
    size = points.shape[1]
    kernel = {2: _field_of_lines, 3: _field_of_dipoles}[size]
    points, places, moments = (
        np.ascontiguousarray(each, float) for each in (points, places.T, moments.T))
    field = np.empty_like(points)
    in_threads(lambda first, last: kernel(points, places, moments, first, last, field),
               share_out(len(points)))
    return field / (2 * np.pi * (size - 1))


# --- geometry ----------------------------------------------------------------------------------


def mesh_of(magnet: TrueMagnet, points: Floats, elements: Elements) -> Any:
    """Return a mesh with the regions ``block0``, ``block1``, ..., those of iron, and ``air``.

    Its outer boundary is named ``far`` and encloses all ``points`` (n, 3) in m.

    Raises
    ------
    CheckFailedError
        If Netgen cannot mesh the bodies.
    """
    ngs, occ = import_extra("ngsolve"), import_extra("netgen.occ")
    flat = magnet.dimension == 2
    sizes = [elements.size or body.shape.thickness / (6 if flat else 3)
             for body in magnet.all_bodies]
    of_blocks = tuple(sizes)
    parts = []
    for number, body in enumerate(magnet.all_bodies):
        parts.append(_solid(body, flat))
        _name(parts[-1], f"block{number}", flat)
    iron = magnet.all_iron
    for number, solid in enumerate(iron.bodies if iron else ()):
        parts.append(_iron(solid, flat))
        sizes.append(min(of_blocks) * (1.0 if elements.size or isinstance(solid, Tube) else 0.5))
        _name(parts[-1], iron.region(number) if iron else "", flat)
        if elements.edge and not flat:
            parts[-1].edges.maxh = elements.edge
            _refine_tip(parts[-1], points, elements)
    for part, size in zip(parts, sizes, strict=True):
        (part.faces if flat else part).maxh = size
    if not flat and elements.size is None:
        for solid, part in zip(iron.bodies if iron else (), parts[len(magnet.all_bodies):],
                               strict=True):
            if isinstance(solid, Tube):
                _refine_ends(solid, part, min(of_blocks))
    extent = max(abs(value) for part in parts for corner in part.bounding_box
                 for value in (corner.x, corner.y, corner.z))
    reach = max(extent, float(np.abs(points[:, :magnet.dimension]).max()))
    far = FAR[magnet.dimension] * reach
    if flat:
        world = occ.Circle((0, 0), far).Face()
        world.edges.name = "far"
    else:
        world = occ.Sphere(occ.Pnt(0, 0, 0), far)
        world.faces.name = "far"
        world, *parts = _meshed_part([world, *parts], elements.mirrored, 2 * far)
    air = world - occ.Glue(parts)
    _name(air, "air", flat)
    geometry = occ.OCCGeometry(occ.Glue([*parts, air]), dim=magnet.dimension)
    rules = import_extra("netgen.meshing").MeshingParameters(maxh=far / 4, grading=elements.grading)
    try:
        mesh = ngs.Mesh(geometry.GenerateMesh(mp=rules))
    except Exception as error:  # of a type that netgen does not export
        raise CheckFailedError(f"Netgen cannot mesh the bodies of the magnet: {error}") from None
    mesh.Curve(3)
    return mesh


def _meshed_part(solids: list[Any], mirrored: tuple[int, int, int], far: float) -> list[Any]:
    """Return what lies where mirrored coordinates are positive, of solids that end before ``far``.

    The faces on which the potential vanishes, as it changes its sign there, are named as the outer
    boundary is.
    """
    occ = import_extra("netgen.occ")
    if not any(mirrored):
        return solids
    lowest = [0.0 if each else -far for each in mirrored]
    kept = occ.Box(occ.Pnt(*lowest), occ.Pnt(far, far, far))
    solids = [part for part in (solid * kept for solid in solids) if len(part.solids)]
    for part in solids:
        for face in part.faces:
            middle = (face.center.x, face.center.y, face.center.z)
            if any(sign < 0 and value < 1e-9 * far  # nothing is left at negative values
                   for sign, value in zip(mirrored, middle, strict=True)):
                face.name = "far"
    return solids


def _name(shape: Any, name: str, flat: bool) -> None:
    """Name the region of a shape, which is a face if ``flat`` and a solid otherwise."""
    if flat:
        shape.faces.name = name
    else:
        shape.mat(name)


def _solid(body: Body, flat: bool) -> Any:
    """Return the body in its nominal place as a solid, or as a face if ``flat``."""
    shape, turn = body.meshed_shape or body.shape, body.nominal_orientation
    x, y, z = body.centre
    upright = turn.apply([0.0, 0.0, 1.0])[2] > 1 - 1e-12
    angle = body.angle + body.seat[2] if upright else 0.0
    face = outline_face(shape, np.array([x, y]), angle, 0.0 if flat else z - shape.length / 2)
    if flat:
        return face
    occ = import_extra("netgen.occ")
    solid = face.Extrude(occ.Vec(0, 0, shape.length))
    return solid if upright else _rotated(solid, turn, body.centre)


def _rotated(solid: Any, turn: Rotation, centre: tuple[float, float, float]) -> Any:
    """Return a solid rotated about a point in m."""
    occ = import_extra("netgen.occ")
    vector = turn.as_rotvec()
    return solid.Rotate(occ.Axis(occ.Pnt(*centre), occ.Dir(*vector)),
                        float(np.degrees(np.linalg.norm(vector))))


def outline_face(shape: Shape, centre: Floats, angle: float, z: float) -> Any:
    """Return the cross-section of a body as a face at height ``z``, with exact arcs.

    The body's origin is at ``centre`` (2,) in m, and its own x axis at ``angle`` in rad.
    """
    occ = import_extra("netgen.occ")
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])

    def at(x: float, y: float) -> Any:
        return occ.Pnt(*(np.array([x, y]) @ turn + centre), z)

    if isinstance(shape, CylinderBody):
        eighths = [at(shape.radius * np.cos(phi), shape.radius * np.sin(phi))
                   for phi in np.pi / 4 * np.arange(9)]
        return occ.Face(occ.Wire([occ.ArcOfCircle(*eighths[first:first + 3])
                                  for first in (0, 2, 4, 6)]))
    if not isinstance(shape, SectorBody):
        corners = [at(*corner) for corner in shape.corners]
        return occ.Face(occ.Wire([occ.Segment(start, end) for start, end in
                                  zip(corners, [*corners[1:], corners[0]], strict=True)]))

    def corner(radius: float, phi: float) -> Any:
        return at(radius * np.cos(phi) - shape.middle, radius * np.sin(phi))

    inner, outer, half = shape.inner, shape.outer, shape.half_angle
    return occ.Face(occ.Wire([
        occ.Segment(corner(inner, -half), corner(outer, -half)),
        occ.ArcOfCircle(corner(outer, -half), corner(outer, 0), corner(outer, half)),
        occ.Segment(corner(outer, half), corner(inner, half)),
        occ.ArcOfCircle(corner(inner, half), corner(inner, 0), corner(inner, -half))]))


def _iron(body: Tube | Pole | Ball, flat: bool) -> Any:
    """Return a body of iron in its place as a solid, or as a face if ``flat``."""
    occ = import_extra("netgen.occ")
    solid = _iron_in_own_axes(body, flat)
    if any(body.turn):
        solid = _rotated(solid, Rotation.from_rotvec(body.turn), (0.0, 0.0, 0.0))
    return solid.Move(occ.Vec(*body.origin)) if any(body.origin) else solid


def _iron_in_own_axes(body: Tube | Pole | Ball, flat: bool) -> Any:
    occ = import_extra("netgen.occ")
    if isinstance(body, Ball):
        return occ.Sphere(occ.Pnt(0, 0, 0), body.radius)
    if isinstance(body, Pole):
        face = outline_face(PolygonBody(body.outline, np.inf), np.zeros(2), 0.0,
                            0.0 if flat else body.middle - body.half_length)
        return face if flat else face.Extrude(occ.Vec(0, 0, 2 * body.half_length))
    if flat:
        disc = occ.Circle((0, 0), body.outer).Face()
        return disc - occ.Circle((0, 0), body.inner).Face() if body.inner else disc
    axis = occ.Axes((0, 0, body.middle - body.half_length), occ.Z)
    cylinder = occ.Cylinder(axis, body.outer, 2 * body.half_length)
    return (cylinder - occ.Cylinder(axis, body.inner, 2 * body.half_length) if body.inner
            else cylinder)


def _refine_tip(solid: Any, points: Floats, elements: Elements) -> None:
    """Make elements small where iron is next to points (n, 3) in m, see `Elements.tip`."""
    if elements.tip is None or elements.size is None:
        return
    beside, places = 2 * elements.size, KDTree(points)
    for parts, size in ((solid.edges, elements.tip), (solid.faces, 2 * elements.tip)):
        for part in parts:
            middle = part.center
            if places.query((middle.x, middle.y, middle.z))[0] < beside:
                part.maxh = size


def _refine_ends(body: Tube, solid: Any, size: float) -> None:
    """Make elements small at the ends of a tube or plate, elsewhere of at most ``size`` in m."""
    # Distance from an end of a tube, relative to its radius, within which an edge lies there.
    on_end = 1e-6
    thickness = min(body.outer - body.inner, 2 * body.half_length)
    for edge in solid.edges:
        middle = edge.center
        height = body.in_own_axes(np.array([[middle.x, middle.y, middle.z]]))[0, 2]
        if abs(abs(height - body.middle) - body.half_length) < on_end * body.outer:
            edge.maxh = min(size, max(thickness, END_SIZE * size))


# --- materials ---------------------------------------------------------------------------------


def _region(body: Body) -> tuple[Floats, Floats]:
    """Return remanence (3,) in T and permeability (3, 3) of a meshed body, along the magnet's axes.

    The remanence is the mean over the body, scaled to the body's moment where the meshed shape has
    another volume.
    """
    turn = body.orientation.as_matrix()
    remanence = turn @ body.remanence * body.mean_factor
    room = body.meshed_shape or body.shape
    if np.isfinite(room.length):
        remanence *= body.shape.volume / room.volume  # keep the moment
    return remanence, turn @ body.permeability @ turn.T


def permeability(law: IronLaw, square: Any) -> Any:
    """Return the relative permeability B / (mu_0 H) of iron, a number or an NGSolve function.

    ``square`` is (mu_0 H)^2 in T^2, an NGSolve function.
    """
    ngs = import_extra("ngsolve")
    if isinstance(law, float):
        return law
    size = ngs.sqrt(square + 1e-24)  # the square root is not differentiable at 0
    if isinstance(law, FroehlichLaw):
        return 1 + law.saturation / (size + half_field(law))
    return 1 + _polarization(law)(size) / size


def half_field(law: FroehlichLaw) -> float:
    """Return mu_0 h in T, the field mu_0 H at which the polarization is half of J_s."""
    return law.saturation / (law.initial - 1)


def _polarization(table: TableLaw) -> Any:
    """Return the polarization J in T as an NGSolve function of mu_0 H in T.

    It is piecewise linear between many points of a monotone interpolation of the table.
    """
    table_points = 4000  # number of points at which an H(B) table is interpolated
    from scipy.interpolate import PchipInterpolator

    h, b = MU_0 * np.array(table.field), np.array(table.flux_density)
    fine_b = np.linspace(0, b[-1], table_points)
    fine_h = PchipInterpolator(b, h)(fine_b)
    j = fine_b - fine_h
    knots = [0.0, *fine_h.tolist(), 1e4]
    return import_extra("ngsolve").BSpline(2, knots, [*j.tolist(), float(j[-1])])


# --- solution ----------------------------------------------------------------------------------


def _recoil(magnet: TrueMagnet, mesh: Any) -> Any:
    """Return the relative permeability (d, d) of the bodies; it is 1 elsewhere, in iron too."""
    size = magnet.dimension
    tensors = {f"block{number}": tuple(_region(body)[1][:size, :size].ravel())
               for number, body in enumerate(magnet.all_bodies)}
    return import_extra("ngsolve").CF(mesh.MaterialCF(tensors, default=tuple(np.eye(size).ravel())),
                                dims=(size, size))


def solve_potential(magnet: TrueMagnet, mesh: Any, order: int) -> Any:
    """Return the potential psi in T m, with ``mu_0 H = -grad psi`` and psi = 0 on the boundary."""
    ngs = import_extra("ngsolve")
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()
    size = magnet.dimension
    source = mesh.MaterialCF({f"block{number}": tuple(_region(body)[0][:size])
                              for number, body in enumerate(magnet.all_bodies)},
                             default=(0.0,) * size)
    form = ngs.BilinearForm(space, condense=True)
    form += _recoil(magnet, mesh) * ngs.grad(u) * ngs.grad(v) * ngs.dx("block.*|air")
    form += -source * ngs.grad(v) * ngs.dx("block.*")
    for region, law in (magnet.all_iron.laws if magnet.all_iron else {}).items():
        form += (permeability(law, ngs.grad(u) * ngs.grad(u)) * ngs.grad(u) * ngs.grad(v)
                 * ngs.dx(region, bonus_intorder=4))
    solution = ngs.GridFunction(space)
    newton(form, solution, iterate=size == 3)
    return solution


def newton(form: Any, solution: Any, iterate: bool = False) -> list[float]:
    """Solve a nonlinear form for ``solution`` by Newton's method, and return the residuals.

    A step is halved until the residual falls. A linear problem takes one step or two. With
    ``iterate`` the steps are computed by conjugate gradients instead of a factorization.

    Raises
    ------
    CheckFailedError
        If the residual has not fallen to `largest_residual` of the first after `MAX_STEPS` steps.
    """
    # Residual, relative to the first, at which Newton's method stops. Rounding errors limit it to
    # some 1e-14, one or two steps further on.
    largest_residual = 1e-11
    ngs = import_extra("ngsolve")
    space = solution.space
    free = space.FreeDofs()
    preconditioner = ngs.Preconditioner(form, "bddc") if iterate else None
    residual, right, step, kept = (solution.vec.CreateVector() for _ in range(4))

    def norm() -> float:
        form.Apply(solution.vec, residual)
        residual[~free] = 0.0
        return float(residual.Norm())

    norms = [norm()]
    while norms[-1] > largest_residual * norms[0]:
        if len(norms) > MAX_STEPS:
            raise CheckFailedError(f"NGSolve did not converge: residuals {norms}.")
        form.AssembleLinearization(solution.vec)
        if preconditioner is None:
            inverse = form.mat.Inverse(space.FreeDofs(coupling=form.condense), "sparsecholesky")
        else:
            inverse = ngs.solvers.CGSolver(form.mat, preconditioner, maxiter=2000, tol=1e-12)
        right.data = residual
        if form.condense:
            right.data += form.harmonic_extension_trans * residual
        step.data = inverse * right
        if form.condense:
            step.data += form.harmonic_extension * step
            step.data += form.inner_solve * residual
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
