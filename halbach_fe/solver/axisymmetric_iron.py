"""Iron of rotational symmetry in the field of sources of any shape, which no mesh follows.

The sources' field mu_0 H_s in the iron is given. The iron answers with the polarization
J = (mu_r(|g|) - 1) g, g = mu_0 H. The total potential psi in the iron, g = -grad psi, and the
reaction's potential psi - psi_s, continued into the space around, satisfy

    S (psi - psi_s) + int (mu_r(|grad psi|) - 1) grad psi . grad v = 0    for all v in the iron,

where S is the stiffness of vacuum, condensed to the iron. Since all terms contain the total
potential, nothing cancels in iron of high permeability. psi_s is the potential of the sources'
field in the iron, which has no curl there, projected on the finite elements:

    int grad psi_s . grad v = - int mu_0 H_s . grad v.

(The normal component on the surface would determine psi_s too, at fewer points. But in a thin tube
the fluxes in and out nearly cancel, and the errors of a source that is sampled at a finite number
of angles grow by the ratio of radius and thickness.)

All potentials are sums of azimuthal modes, psi = Re sum_m psi_m(r, z) exp(i m theta). The iron's
law is evaluated at Gauss points of the half-plane times equidistant angles, and Fourier transforms
lead there and back (S. A. Orszag, J. Fluid Mech. 41 (1970) 363). The problem minimizes a convex
energy. Newton's method with a line search therefore converges; its steps are solved by conjugate
gradients, preconditioned by the mean of the differential permeability over the angle, for which the
modes are not coupled.

Many modes are needed where iron saturates close to blocks. The field of the blocks' edges, modes of
high order, saturates the iron locally, and thus weakens its reaction in the modes of low order that
reach the bore.

Potentials in the iron are arrays (modes, iron, c): the complex coefficients of c potentials, for
the modes that `Problem.numbers` lists.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import scipy.fft
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Floats, Ints, azimuths_of, radii_of
from halbach_fe.core.errors import NotConvergedError
from halbach_fe.core.threads import return_memory
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.solver.azimuthal_modes import to_cartesian
from halbach_fe.solver.getdp_files import factorize
from halbach_fe.solver.interpolation import locate
from halbach_fe.solver.iron_modes import (
    Asked,
    Complexes,
    Exterior,
    IronModes,
    Resolution,
    assemble_modes,
    check_bodies,
    points_at,
)
from halbach_fe.solver.magnetostatics import check_inside
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import Curve

Source = Callable[[Floats], Floats]
"""A function from points (n, 3) in m to mu_0 H (n, 3) in T there."""

SOURCE_MODES = 0.03
"""Modes of the source are left out if all higher ones are below this value, relative to the largest
one. They only matter where they saturate the iron locally: blocks 1 mm from a tube of 2 mm at 51 mm
need modes up to 55. The reaction in the bore is then 0.2 % from that of 96 modes on a finer grid;
with modes up to 37 it is 5 % off.
"""

FEWEST_MODES, MOST_MODES = 12, 128
"""Limits of the highest mode that is chosen by `SOURCE_MODES`."""

TANGENT_MODES = 24
"""Highest mode of `IronReaction.tangent`. Modes of higher order decay before they reach the bore.
"""


class WithBar:
    """A reaction of iron that is solved on two meshes: with ``coarse``, the other solution."""

    def error(self: Any, points: Floats) -> Floats:
        """Return the error bar (n, 1) in T of `field`, nan without a coarser solution."""
        return np.asarray(np.linalg.norm(self.field_with_errors(points)[1], axis=1, keepdims=True))

    def inside(self: Any, points: Floats) -> tuple[Floats, Floats]:
        """Return mu_0 H (n, 3) in T of all sources at points (n, 3) in m in iron, and its bar."""
        found = self.strength(points)
        change = np.nan if self.coarse is None else np.linalg.norm(
            found - self.coarse.strength(points), axis=1)[:, None]
        return found, np.broadcast_to(change, found.shape)


@dataclass(frozen=True)
class IronReaction(WithBar):
    """The field that iron adds to that of its sources; `solve_iron` returns it."""

    name: str
    """Name of the study."""
    problem: Problem
    total: Complexes
    reaction: Complexes
    """The total potential in the iron, and the part that the iron adds.
    Shape (modes, iron, 1), in T m."""
    residuals: tuple[float, ...]
    """Relative residual of Newton's method at the start and after every step."""
    coarse: IronReaction | None
    """The solution with a coarser mesh, fewer modes and a nearer boundary, for the error bar."""
    _continued: dict[int, Complexes] = field(default_factory=dict, repr=False)

    def field(self, points: Floats) -> Floats:
        """Return the reaction B (n, 3) in T at points (n, 3) in m outside the iron.

        Raises
        ------
        PointsOutsideError
            If a point lies in iron, or outside the mesh.
        """
        numbers = self.problem.numbers
        needed = numbers <= _modes_at(self.problem, points)
        for number, potential in zip(numbers[needed].tolist(), self.reaction[needed], strict=True):
            if number not in self._continued:
                self._continued[number] = _continue(
                    self.problem.modes, self.problem.modes.exterior(number), potential)
        return _evaluate(self.name, self.problem.modes, {
            number: self._continued[number] for number in numbers[needed].tolist()}, points)[0]

    def field_with_errors(self, points: Floats) -> tuple[Floats, Floats]:
        """Return `field` and its change from the coarser solution, both (n, 3) in T, or nan.

        The length of the change is the error bar in any direction.
        """
        found = self.field(points)
        if self.coarse is None:
            return found, np.full_like(found, np.nan)
        return found, found - self.coarse.field(points)

    def strength(self, points: Floats) -> Floats:
        """Return mu_0 H (n, 3) in T of all sources at points (n, 3) in m in iron."""
        return _inside(self.name, self.problem.modes, self.problem.numbers, self.total, points)[0]

    def nodes(self, angles: int) -> Floats:
        """Return the points (angles k, 3) in m in the iron, angle by angle, for `tangent`."""
        return _nodes(self.problem.modes, _angles(angles))

    def tangent(
        self, sources: Sequence[Source] | Floats, points: Floats, inside: Floats | None = None,
        modes: int = TANGENT_MODES
    ) -> Floats:
        """Return the derivative (c, n + i, 3) in T of the reaction by additional sources.

        For linear iron this is the reaction to the sources.

        Parameters
        ----------
        sources : sequence of callable, or ndarray, shape (c, angles k, 3), in T
            The sources' mu_0 H, or its values at `nodes`.
        points : ndarray, shape (n, 3), in m
        inside : ndarray, shape (i, 3), in m, optional
            Points in iron, for which the derivative of mu_0 H follows that at the points.
        modes : int
            Highest azimuthal mode.
        """
        state, numbers = self.problem, np.arange(modes + 1)
        spaces = [state.modes.exterior(number) for number in numbers.tolist()]
        angles = _fast(4 * modes + 2)
        differential = state.differential(state.field(self.total)[..., 0])
        # only modes up to 2 m of the permeability couple modes up to m
        kept = np.arange(min(2 * modes, (len(differential) - 1) // 2) + 1)
        differential = to_angles(to_modes(differential, kept), kept, angles)
        problem = replace(state, numbers=numbers, angles=angles,
                          stiffnesses=tuple(space.stiffness for space in spaces),
                          gradients=tuple(state.modes.gradient(m) for m in numbers.tolist()))
        tangent = Tangent.of(problem, differential)
        highest = _modes_at(problem, points)
        within = np.zeros((0, 3)) if inside is None else inside
        result = np.empty((len(sources), len(points) + len(within), 3))
        # conjugate gradients stop at this relative residual in `IronReaction.tangent`
        tolerance = 1e-7
        # number of sources that `IronReaction.tangent` solves for at a time, which limits the
        # memory
        step = 8
        for first in range(0, len(sources), step):
            part = sources[first:first + step]
            own = np.concatenate([_source_potential(problem, _sampled(state.modes, source))
                                  for source in part], axis=2)
            total = tangent.solve(problem.stiffness(own), tolerance)
            result[first:first + step, :len(points)] = _evaluate(self.name, state.modes, {
                number: _continue(state.modes, spaces[number], (total - own)[number])
                for number in numbers[numbers <= highest].tolist()}, points)
            if len(within):
                result[first:first + step, len(points):] = _inside(
                    self.name, state.modes, numbers, total, within)
        return result


def solve_iron(
    bodies: Sequence[IronSolid], source: Source, session: Session, name: str = "iron",
    resolution: Resolution | None = None, estimate: bool = True,
    start: IronReaction | None = None,
) -> IronReaction:
    """Solve for the reaction of rotationally symmetric iron to a source.

    Parameters
    ----------
    bodies : sequence of IronSolid
        May touch, but not overlap.
    source : callable
        mu_0 H of the sources in T at points (n, 3) in m in the iron, some 1e5 points.
    session : Session
        Its folder receives the mesh and the runs of GetDP.
    name : str
        Name of the study.
    estimate : bool
        Whether to solve once more with a coarser resolution, for the error bar.
    start : IronReaction, optional
        Solution of the same iron with a similar source. Its matrices are used again, and Newton's
        method starts from it.

    Raises
    ------
    StudyError
        If bodies overlap.
    GetDPError
        If GetDP or Newton's method fails.
    """
    check_bodies(bodies)
    return_memory()  # of an earlier solution, which nobody needs any more
    resolution = resolution or Resolution()
    modes = start.problem.modes if start else _assembled(Asked(
        (tuple(bodies), replace(resolution, modes=None), session.getdp),
        partial(assemble_modes, name, bodies, resolution, session)))
    samples = _sampled(modes, source)
    present, highest = _modes_of(samples)
    highest = resolution.modes or highest
    numbers = coupled_modes([m for m in present if m <= highest], highest)
    if start is not None and np.array_equal(start.problem.numbers, numbers):
        problem = start.problem
    else:
        problem, start = _problem(modes, tuple(bodies), numbers), None
    own = _source_potential(problem, samples)
    total, residuals = newton(problem, own, start.total if start else None)
    coarse = solve_iron(
        bodies, source, session.within("coarse"), name, resolution.coarser(highest),
        estimate=False, start=start.coarse if start else None) if estimate else None
    return IronReaction(name, problem, total, total - own, residuals, coarse)


@lru_cache(maxsize=1)  # bodies are equal whatever their law: those of a diagnosis differ by it
def _assembled(asked: Asked[IronModes]) -> IronModes:
    return asked.compute()


def _problem(modes: IronModes, bodies: tuple[IronSolid, ...], numbers: Ints) -> Problem:
    """Return the discrete problem for some modes."""
    # angles of the non-linear law per mode: products of two modes do not alias into others
    angles_per_mode = 3
    return Problem(
        modes, bodies, numbers,
        tuple(modes.exterior(number).stiffness for number in numbers.tolist()),
        tuple(modes.gradient(number) for number in numbers.tolist()),
        _fast(angles_per_mode * int(numbers[-1]) + 8))


def _fast(count: int) -> int:
    """Return the next number that Fourier transforms are fast for."""
    return int(scipy.fft.next_fast_len(count, real=True))


def _angles(count: int, shift: float = 0.0) -> Floats:
    """Return equidistant angles in rad; ``shift`` is in steps."""
    return np.asarray(2 * np.pi * (np.arange(count) + shift) / count)


def _nodes(modes: IronModes, angles: Floats) -> Floats:
    """Return the points (angles k, 3) in m that are the iron's Gauss points at some angles."""
    points = modes.gauss
    return np.stack([np.outer(np.cos(angles), points.r), np.outer(np.sin(angles), points.r),
                     np.tile(points.z, (len(angles), 1))], axis=2).reshape(-1, 3)


def _cylindrical(values: Floats, angles: Floats) -> Floats:
    """Return radial, azimuthal and axial components (angles, 3, k) of vectors (angles k, 3)."""
    x, y, z = np.moveaxis(values.reshape(len(angles), -1, 3), 2, 0)
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


def _sampled(modes: IronModes, source: Source | Floats) -> Floats:
    """Return a source (angles, 3, k) in T at the Gauss points, at enough angles for its modes."""
    if not callable(source):
        return _cylindrical(source, _angles(len(source) // len(modes.gauss.r)))
    # limits of the number of angles at which a source is evaluated. Where blocks touch the iron,
    # the modes of their field fall slowly, but these local fields do not reach the bore.
    fewest_angles, most_angles = 64, 512
    angles = _angles(fewest_angles)
    values = _cylindrical(source(_nodes(modes, angles)), angles)
    # angles of the source are doubled until the amplitudes of the highest quarter of the modes are
    # below this value, relative to the largest. Modes fall about geometrically, so that those which
    # would be mistaken for low modes are then below the square of this value.
    aliasing = 1e-2
    while len(values) < most_angles:
        size = np.abs(scipy.fft.rfft(values, axis=0)).max(axis=(1, 2))
        if size[3 * len(size) // 4:].max() <= aliasing * size.max():
            break
        between = _angles(len(values), 0.5)
        more = _cylindrical(source(_nodes(modes, between)), between)
        values = np.stack([values, more], axis=1).reshape(-1, *values.shape[1:])
    return values


def _modes_of(values: Floats) -> tuple[list[int], int]:
    """Return the modes that a source (angles, 3, k) has, and the highest that matters."""
    size = np.abs(to_modes(values, slice(None))[:(len(values) + 1) // 2]).max(axis=(1, 2))
    # modes of the source that are smaller than this, relative to the largest one, are rounding
    # errors
    rounding = 1e-9
    present = np.flatnonzero(size > rounding * size.max())
    highest = int(np.flatnonzero(size >= SOURCE_MODES * size.max())[-1]) if size.any() else 0
    return present.tolist(), int(np.clip(highest, FEWEST_MODES, MOST_MODES))


def _source_potential(problem: Problem, values: Floats) -> Complexes:
    """Return the potential (modes, iron, 1) in T m of a source (angles, 3, k) in the iron.

    In mode 0 the potential of every connected body is free by a constant, which the reaction does
    not depend on.
    """
    highest = int(problem.numbers[-1])
    if len(values) <= 2 * highest:  # modes beyond those that the samples resolve are zero
        known = np.arange((len(values) - 1) // 2 + 1)
        values = to_angles(to_modes(values, known), known, 2 * highest + 2)
    right = -problem.integrate(values[..., None])
    iron = problem.modes
    weights = sparse.diags_array(np.tile(iron.gauss.weights, 3))
    result = np.zeros_like(right)
    for number, operator, part, solution in zip(
            problem.numbers, problem.gradients, right[..., 0], result[..., 0], strict=True):
        matrix = sparse.csr_array(operator.T @ (weights @ operator))
        fixed = iron.iron_on_axis
        if number == 0:
            label = connected_components(matrix, directed=False)[1]
            fixed = np.unique(label, return_index=True)[1]
        free = np.setdiff1d(np.arange(matrix.shape[0]), fixed)
        factor = factorize(matrix[free][:, free])
        solution[free] = (factor.solve(part[free].real.copy())
                          + 1j * factor.solve(part[free].imag.copy()))
    return result


def _continue(modes: IronModes, space: Exterior, iron: Complexes) -> Complexes:
    """Return the potential (unknowns, c) everywhere of potentials (iron, c) on the iron."""
    result = np.zeros((modes.unknowns.count, iron.shape[1]), complex)
    result[modes.iron] = iron
    result[space.rest] = space.extend(iron)
    return result


def _inside(
    name: str, modes: IronModes, numbers: Ints, total: Complexes, points: Floats
) -> Floats:
    """Return -grad (c, n, 3) in T of potentials (modes, iron, c) at points (n, 3) in m in iron."""
    potentials = {}
    for number, part in zip(numbers.tolist(), total, strict=True):
        potentials[number] = np.zeros((modes.unknowns.count, part.shape[1]), complex)
        potentials[number][modes.iron] = part
    return _evaluate(name, modes, potentials, points, anywhere=True)


def highest_mode_at(bodies: Sequence[IronSolid], points: Floats) -> int | None:
    """Return the highest mode that iron produces at points (n, 3) in m; None for all modes."""
    inner = min(body.inner_radius for body in bodies)
    radius = float(radii_of(points).max(initial=0.0))
    if radius >= 0.999 * inner:
        return None
    # modes are left out at points in a bore where (r / inner radius)^m is smaller
    no_amplitude = 1e-7
    return int(np.ceil(np.log(no_amplitude) / np.log(max(radius / inner, 1e-3)))) + 1


def _modes_at(problem: Problem, points: Floats) -> int:
    """Return the highest mode of a problem that the iron produces at points (n, 3) in m."""
    highest, last = highest_mode_at(problem.bodies, points), int(problem.numbers[-1])
    return last if highest is None else min(highest, last)


def _evaluate(
    name: str, modes: IronModes, potentials: dict[int, Complexes], points: Floats,
    anywhere: bool = False
) -> Floats:
    """Return -grad (c, n, 3) in T of potentials (unknowns, c) by mode, at points (n, 3) in m.

    The points are in air, or ``anywhere``.
    """
    mesh = modes.mesh
    check_inside(name, mesh.radius, mesh.half_length, points)
    r, phi = radii_of(points), azimuths_of(points)
    # points nearer to the axis than this fraction of the grid's first line are moved there, since
    # psi/r is a limit on the axis
    axis_radius = 1e-6
    least = axis_radius * mesh.points[mesh.points[:, 0] > 0, 0].min()
    places, where = unique_points(np.column_stack([np.maximum(r, least), points[:, 2], 0 * r]))
    at = points_at(mesh, locate(mesh, places, anywhere), modes.unknowns, anywhere)
    columns = max((part.shape[1] for part in potentials.values()), default=1)
    cylindrical = np.zeros((3, len(points), columns))
    for mode, part in potentials.items():
        wave = np.exp(1j * mode * phi)[:, None]
        for component, operator in enumerate((at.along_r, 1j * mode * at.over_r, at.along_z)):
            cylindrical[component] -= ((operator @ part)[where] * wave).real
    return to_cartesian(cylindrical.transpose(2, 1, 0), phi)


def to_angles(by_mode: Complexes, numbers: Ints, angles: int) -> Floats:
    """Return values (angles, ...) of sums of modes Re c_m exp(i m theta).

    Parameters
    ----------
    by_mode : ndarray, shape (modes, ...)
    numbers : ndarray of int, shape (modes,)
        The modes m, all below half of ``angles``.
    """
    spectrum = np.zeros((angles // 2 + 1, *by_mode.shape[1:]), complex)
    spectrum[numbers] = by_mode * (angles / 2)
    spectrum[0] *= 2
    return np.asarray(scipy.fft.irfft(spectrum, angles, axis=0))


def to_modes(values: Floats, numbers: Ints | slice) -> Complexes:
    """Return coefficients (modes, ...) of values (angles, ...); reverses `to_angles`."""
    spectrum = scipy.fft.rfft(values, axis=0) * (2 / len(values))
    spectrum[0] /= 2
    return np.asarray(spectrum[numbers])


def coupled_modes(present: Sequence[int], highest: int) -> Ints:
    """Return the modes up to ``highest`` that iron makes from those that a source has.

    The permeability depends on |H|^2, whose modes are differences and sums of those of H. All modes
    of H are therefore those present, plus or minus multiples of one number.
    """
    if not present:
        return np.array([0])
    first = present[0]
    step = int(np.gcd.reduce([2 * first, *(abs(m - first) for m in present),
                              *(m + first for m in present)]))
    if step == 0:  # mode 0 alone
        return np.array([0])
    m = np.arange(highest + 1)
    return np.flatnonzero(((m - first) % step == 0) | ((m + first) % step == 0))


def excess_of(law: float | Curve, square: Floats) -> tuple[Floats, Floats]:
    """Return mu_r - 1 and 2 d mu_r / d(|g|^2) of a material, at |g|^2, g = mu_0 H."""
    if isinstance(law, float | int):
        return np.full_like(square, law - 1), np.zeros_like(square)
    return law.permeability.coefficient(square) - 1, 2 * law.permeability.slope(square)


def excess_in(bodies: Sequence[IronSolid], body: Ints, square: Floats) -> tuple[Floats, Floats]:
    """Return `excess_of` where the numbers of bodies, which are broadcast, are ``body``."""
    excess, slope = np.empty_like(square), np.empty_like(square)
    for number, own in enumerate(bodies):
        mine = np.broadcast_to(body == number, square.shape)
        excess[mine], slope[mine] = excess_of(own.law, square[mine])
    return excess, slope


@dataclass(frozen=True)
class Problem:
    """The discrete problem."""

    modes: IronModes
    bodies: tuple[IronSolid, ...]
    numbers: Ints
    """The azimuthal modes, ascending."""
    stiffnesses: tuple[sparse.csr_array, ...]
    """By mode: the stiffness of vacuum, condensed to the iron. Shape (iron, iron)."""
    gradients: tuple[sparse.csr_array, ...]
    """By mode: the operators to d/dr, m/r and d/dz at the k Gauss points of the iron.
    Shape (3 k, iron)."""
    angles: int
    """Angles at which the law is evaluated."""

    def field(self, potential: Complexes, angles: int | None = None) -> Floats:
        """Return grad psi (angles, 3, k, c) in cylindrical components at the Gauss points."""
        columns = potential.shape[2]
        by_mode = np.stack([(operator @ part).reshape(3, -1, columns) for operator, part in zip(
            self.gradients, potential, strict=True)])
        by_mode[:, 1] *= 1j
        return to_angles(by_mode, self.numbers, angles or self.angles)

    def integrate(self, vectors: Floats) -> Complexes:
        """Return the integrals (modes, iron, c) of vectors (angles, 3, k, c) times grad v."""
        by_mode = to_modes(vectors, self.numbers)
        by_mode[:, 1] *= -1j
        by_mode *= self.modes.gauss.weights[:, None]
        return np.stack([operator.T @ part.reshape(-1, part.shape[2]) for operator, part in zip(
            self.gradients, by_mode, strict=True)])

    def stiffness(self, potential: Complexes) -> Complexes:
        """Return S psi (modes, iron, c)."""
        return np.stack([matrix @ part for matrix, part in zip(
            self.stiffnesses, potential, strict=True)])

    def dot(self, a: Complexes, b: Complexes) -> Floats:
        """Return the scalar products (c,) of potentials and residuals (modes, iron, c)."""
        shares = np.where(self.numbers == 0, 1.0, 0.5)  # means of cos^2(m theta)
        return np.asarray(np.einsum("m,mic,mic->c", shares, a.conj(), b).real)

    def law(self, field: Floats) -> tuple[Floats, Floats]:
        """Return `excess_in` (angles, k) for grad psi (angles, 3, k)."""
        return excess_in(self.bodies, self.modes.body, np.einsum("aik,aik->ak", field, field))

    def residual(self, total: Complexes, source: Complexes) -> Complexes:
        """Return the residual (modes, iron, 1) of the total potential."""
        field = self.field(total)
        excess, _ = self.law(field[..., 0])
        return self.stiffness(total - source) + self.integrate(excess[:, None, :, None] * field)

    def tangent(self, total: Complexes) -> Tangent:
        """Return the derivative of the residual at a total potential (modes, iron, 1)."""
        return Tangent.of(self, self.differential(self.field(total)[..., 0]))

    def differential(self, field: Floats) -> Floats:
        """Return d mu_0 M / d mu_0 H (angles, 3, 3, k) for grad psi (angles, 3, k)."""
        excess, slope = self.law(field)
        return np.asarray(excess[:, None, None] * np.eye(3)[:, :, None]
                          + (slope[:, None] * field)[:, :, None] * field[:, None])


@dataclass(frozen=True)
class Tangent:
    """The derivative of the residual at a state, and its preconditioner."""

    problem: Problem
    differential: Floats
    """d mu_0 M / d mu_0 H. Shape (angles, 3, 3, k)."""
    factors: tuple[sparse_linalg.SuperLU, ...]
    """By mode: the derivative with the mean of ``differential`` over the angle."""

    @classmethod
    def of(cls, problem: Problem, differential: Floats) -> Tangent:
        """Return the tangent with a given differential susceptibility."""
        mean = differential.mean(axis=0) * problem.modes.gauss.weights
        # the radial and axial components are in phase; the azimuthal one is not, so that its
        # product with them is left out
        weights = sparse.block_array([[
            sparse.diags_array(mean[i, j]) if (i == 1) == (j == 1) else None
            for j in range(3)] for i in range(3)], format="csr")
        return cls(problem, differential, tuple(
            factorize(matrix + operator.T @ (weights @ operator)) for matrix, operator in zip(
                problem.stiffnesses, problem.gradients, strict=True)))

    def apply(self, step: Complexes) -> Complexes:
        """Return the derivative of the residual along steps (modes, iron, c)."""
        field = self.problem.field(step, len(self.differential))
        change = np.stack([sum(self.differential[:, i, j, :, None] * field[:, j]
                               for j in range(3)) for i in range(3)], axis=1)
        return self.problem.stiffness(step) + self.problem.integrate(change)

    def precondition(self, residual: Complexes) -> Complexes:
        """Return approximate solutions (modes, iron, c)."""
        result = np.empty_like(residual)
        for factor, part, solution in zip(self.factors, residual, result, strict=True):
            for column in range(part.shape[1]):  # SuperLU is slow with many columns at once
                solution[:, column] = (factor.solve(part[:, column].real.copy())
                                       + 1j * factor.solve(part[:, column].imag.copy()))
        return result

    def solve(self, right: Complexes, tolerance: float) -> Complexes:
        """Solve for steps (modes, iron, c), see `conjugate_gradients`."""
        return conjugate_gradients(self.apply, self.precondition, self.problem.dot, right,
                                   tolerance)


def conjugate_gradients(
    apply: Callable[[Any], Any], precondition: Callable[[Any], Any],
    dot: Callable[[Any, Any], Floats], right: Any, tolerance: float,
) -> Any:
    """Solve for columns (..., c) of right-hand sides by conjugate gradients.

    ``tolerance`` is relative, in the norm of the preconditioner.

    Raises
    ------
    NotConvergedError
        If the residual does not fall to the tolerance.
    """
    solution, residual = np.zeros_like(right), right.copy()
    direction = better = precondition(residual)
    size = first = dot(residual, better)
    most_steps = 400
    for _ in range(most_steps):
        if (size <= tolerance**2 * first).all():
            return solution
        applied = apply(direction)
        curvature = dot(direction, applied)
        length = np.divide(size, curvature, out=np.zeros_like(size), where=curvature > 0)
        solution = solution + length * direction
        residual = residual - length * applied
        better = precondition(residual)
        before, size = size, np.maximum(dot(residual, better), 0.0)
        direction = better + np.divide(size, before, out=np.zeros_like(size),
                                       where=before > 0) * direction
    worst = float(np.sqrt(np.max(size / np.maximum(first, 1e-300))))
    raise NotConvergedError(
        f"Conjugate gradients on the iron left a residual of {worst:.1e} after {most_steps} "
        "steps. Smooth the H(B) curve.", (worst,))


def newton(
    problem: Any, source: Any, start: Any = None,
    advance: Callable[[float], None] = lambda share: None,
) -> tuple[Any, tuple[float, ...]]:
    """Solve for the total potential (..., 1) in T m by Newton's method.

    ``problem`` is a `Problem`, or that of `halbach_fe.solver.iron_bodies`. ``advance`` is told how
    far the residual has fallen, from 0 to 1, by its logarithm.

    A step is halved until the energy no longer rises steeply at its end; the energy is convex.

    Returns
    -------
    total : ndarray
    residuals : tuple of float
        Relative residual at the start and after every step.

    Raises
    ------
    NotConvergedError
    """
    total = np.zeros_like(source) if start is None else start
    right = problem.stiffness(source)
    residual = problem.residual(total, source)
    norms: list[float] = []
    # Newton's method stops at this residual relative to the sources, in the norm of the
    # preconditioner. The reaction has then converged to some 1e-8.
    tolerance = 1e-8
    most_steps = 60
    # step length, relative to the full Newton step, at which the line search gives up
    smallest_step = 2.0**-20
    while True:
        tangent = problem.tangent(total)
        scale, size = (float(problem.dot(vector, tangent.precondition(vector))[0])
                       for vector in (right, residual))
        norms.append(float(np.sqrt(max(size, 0.0) / scale)) if scale > 0 else 0.0)
        if norms[-1] <= tolerance:
            advance(1.0)
            return total, tuple(norms)
        if len(norms) > most_steps or not np.isfinite(norms[-1]):
            raise NotConvergedError(
                f"Newton's method on the iron left a residual of {norms[-1]:.1e} after "
                f"{len(norms) - 1} steps. Smooth the H(B) curve.", tuple(norms))
        advance(float(np.clip(np.log(min(norms)) / np.log(tolerance), 0.0, 1.0)))
        step = tangent.solve(-residual, min(0.1, max(norms[-1], 1e-4)))
        slope = abs(float(problem.dot(residual, step)[0]))
        length = 1.0
        while True:
            trial = problem.residual(total + length * step, source)
            if float(problem.dot(trial, step)[0]) <= 0.5 * slope or length < smallest_step:
                break
            length /= 2
        total, residual = total + length * step, trial
