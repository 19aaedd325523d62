"""Columns of the response by reciprocity: solves for readings in place of solves for blocks.

The reading e of a source b is e . A^-1 b, and A is symmetric. Instead of A^-1 b for every block,
A^-1 e is therefore solved for every reading, and one product with the sources of all blocks gives
their columns (the adjoint method; M. B. Giles, N. A. Pierce, Flow, Turbulence and Combustion 65
(2000) 393). By azimuthal modes, readings at one (r, z) share the three solves of every mode,
whatever their azimuths are; so do the blocks of one ring. An array of many rings with few places
in its map thus takes as many solves as there are places, and not as many as there are rings.

The discrete problem is that of `halbach_fe.solver.azimuthal_modes` to rounding. GetDP assembles the
matrix of mode 0, with which the one from our own Gauss points is compared; those of all modes are
factorized here, because GetDP cannot take a reading for a right-hand side. The columns are compared
with the nominal array, which GetDP solves for, where the response is assembled.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.solver.azimuthal_modes import (
    AXIS_RADIUS,
    ModesCase,
    fill_run_folder,
    meridian_points,
    modes_needed,
    unknowns_of,
)
from halbach_fe.solver.dofs import Unknowns, factorize
from halbach_fe.solver.interpolation import grid_operators
from halbach_fe.solver.iron_modes import (
    GaussPoints,
    assembled,
    axis_unknowns,
    check_matrix,
    gauss_points,
)
from halbach_fe.solver.magnetostatics import variants_of
from halbach_fe.solver.session import LOOK_S, RunSize, Session

SAVED_SOLVES = 2000
"""Solves that reciprocity must save. Below that GetDP takes less than some two minutes for the
blocks, and keeps their solutions in the cache, where they serve other points too."""

COMPONENTS = 3
"""Components of a block's remanence: along its middle, across it, along z. As many solves serve the
readings at one place of the half-plane."""


def saves_solves(magnet: Magnet, points: Floats, blocks: Sequence[int]) -> bool:
    """Tell whether reciprocity takes far fewer solves for the columns of blocks.

    Parameters
    ----------
    magnet : Magnet
        To be solved by azimuthal modes.
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks that are to be solved for.
    """
    rings = len({magnet.blocks[number].ring for number in blocks})
    if COMPONENTS * rings * (modes_needed(magnet, points) + 1) < SAVED_SOLVES:
        return False  # without looking for the places of the points
    places = len(unique_points(meridian_points(magnet, points))[0])
    return COMPONENTS * (rings - places) * (modes_needed(magnet, points) + 1) >= SAVED_SOLVES


@dataclass(frozen=True)
class _Discrete:
    """The discrete problem in the half-plane, for all modes."""

    stiffness: tuple[sparse.csr_array, sparse.csr_array]
    """K and L: the matrix of mode m is w (K + m^2 L), with w = 2 pi for m = 0 and pi otherwise.
    Shape (unknowns, unknowns)."""
    free: tuple[Ints, Ints]
    """The unknowns to solve for, in an order that keeps the factors sparse: of mode 0, and of all
    higher modes, which vanish on the axis."""
    sources: tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array]
    """Integrals over r dr dz, in each ring, of dv/dr, v/r and dv/dz.
    Shape (unknowns, solved rings)."""
    readings: sparse.csr_array
    """Operators to d psi/dr, psi/r and d psi/dz at the m points, one after the other.
    Shape (3 m, unknowns)."""
    half_angle: Floats
    """Shape (solved rings,), in rad."""

    def gradients(self, mode: int) -> Floats:
        """Return d psi/dr, psi/r and d psi/dz (3 solved rings, points, 3) in T of single blocks.

        The numbering of the first axis is that of pro/azimuthal_modes.pro: component by component.
        """
        free = self.free[mode > 0]
        matrix = sparse.csr_array(self.stiffness[0] + mode**2 * self.stiffness[1])
        factor = factorize(matrix[free][:, free], ordered=True)
        in_r, over_r, in_z = (source[free].T for source in self.sources)
        right = sparse.csr_array(self.readings[:, free])
        found = np.empty((COMPONENTS, len(self.half_angle), right.shape[0]))
        cc, ss, plain = angle_integrals(mode, self.half_angle)
        for number in range(right.shape[0]):  # SuperLU is slower with many columns at once
            solution = factor.solve(right[[number]].toarray()[0])
            radial, azimuthal, axial = in_r @ solution, over_r @ solution, in_z @ solution
            found[:, :, number] = (cc * radial + mode * ss * azimuthal,
                                   ss * radial + mode * cc * azimuthal, plain * axial)
        weight = 2 * np.pi if mode == 0 else np.pi
        return np.moveaxis(found.reshape(COMPONENTS * len(self.half_angle), 3, -1), 1, 2) / weight


def angle_integrals(mode: int, half_angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the integrals over a block's angle of cos(t) cos(m t), sin(t) sin(m t) and cos(m t).

    ``half_angle`` (n,) in rad is half of that angle.
    """
    def half_integral(order: int) -> Floats:
        """Return the integral of cos(order t) from 0 to the half angle."""
        return np.asarray(half_angle * np.sinc(order * half_angle / np.pi))

    less, more = half_integral(mode - 1), half_integral(mode + 1)
    return less + more, less - more, 2 * half_integral(mode)


def reciprocal_gradients(case: ModesCase, session: Session) -> dict[int, Floats]:
    """Return what `halbach_fe.solver.azimuthal_modes.solve_modes` needs of single blocks.

    Returns
    -------
    dict of int to ndarray, shape (3 solved rings, m, 3), in T
        d psi/dr, psi/r and d psi/dz at the m points of the half-plane by mode: real materials, and
        for the method ``reaction`` minus vacuum. On the axis the values are placeholders, as those
        of `halbach_fe.solver.azimuthal_modes.read_run`.

    Raises
    ------
    GetDPError
        If GetDP fails, or its matrix differs from that of our Gauss points.
    """
    numbers = range(len(case.weights))
    variants = variants_of(case.magnet)
    if session.counter is not None:
        size = RunSize(
            "azimuthal_modes", case.mesh.elements, unknowns_of(case.mesh.inner, case.mesh.axis, 0),
            COMPONENTS * len(case.meridian) * len(numbers), matrices=len(numbers))
        session.counter.batches.append((session.purpose, [size for _ in variants]))
        return {mode: np.zeros((COMPONENTS * len(case.solved), len(case.meridian), 3))
                for mode in numbers}
    unknowns, theirs = _assembled(case, session)
    points = gauss_points(case.real_mesh, np.arange(case.mesh.elements), unknowns)
    ring, permeability = _materials(case)
    per_element = len(points.r) // case.mesh.elements
    permeability = np.repeat(permeability, per_element)
    check_matrix(points, 0, theirs / (2 * np.pi), permeability)
    problems = [_discrete(case, unknowns, points, np.repeat(ring, per_element), values)
                for values in (permeability, np.ones_like(permeability))[:len(variants)]]
    tasks = [(problem, mode) for mode in numbers for problem in problems]
    results = _in_parallel(tasks, session)
    return {mode: results[number * len(problems)] if len(problems) == 1 else (
        results[2 * number] - results[2 * number + 1]) for number, mode in enumerate(numbers)}


def _in_parallel(tasks: list[tuple[_Discrete, int]], session: Session) -> list[Floats]:
    """Solve problems in modes, ``session.jobs`` at a time, and report progress."""
    with ThreadPoolExecutor(max(1, session.jobs)) as pool:
        futures = [pool.submit(problem.gradients, mode) for problem, mode in tasks]
        try:
            running = set(futures)
            while running:
                done, running = wait(running, LOOK_S, FIRST_EXCEPTION)
                for future in done:
                    future.result()
                if session.progress is not None:
                    session.progress(len(futures) - len(running), len(futures))
        finally:
            for future in futures:
                future.cancel()
    return [future.result() for future in futures]


def _assembled(case: ModesCase, session: Session) -> tuple[Unknowns, sparse.csr_array]:
    """Have GetDP assemble mode 0 with the real materials; return its unknowns and its matrix."""
    # a block along z is a right-hand side that does not vanish
    one = replace(case, solved=case.solved[:1])
    source = one.single[1]
    count = unknowns_of(case.mesh.inner, case.mesh.axis, 0)
    ((unknowns, matrix, _),) = assembled(
        session, case.real_mesh, "azimuthal_modes",
        [("getdp-matrix-mode0", lambda folder: fill_run_folder(
            one, folder, [0], (source, source), source, False, session.time_limit_s))], count)
    return unknowns, matrix


def _materials(case: ModesCase) -> tuple[Ints, Floats]:
    """Return of every element the number of its ring, from 0 (-1: none), and its permeability."""
    mesh, magnet = case.real_mesh, case.magnet
    r, z = mesh.points[mesh.cells, :2].mean(axis=1).T
    ring, permeability = np.full(mesh.elements, -1), np.ones(mesh.elements)
    permeability[mesh.in_iron] = magnet.iron_permeability
    for number, ((low, high), (inner, outer)) in enumerate(magnet.ring_sections):
        inside = (low < z) & (z < high) & (inner < r) & (r < outer)
        ring[inside] = number
        permeability[inside] = magnet.blocks[magnet.number_of(number + 1, 1)].recoil_permeability
    return ring, permeability


def _discrete(
    case: ModesCase, unknowns: Unknowns, points: GaussPoints, ring: Ints, permeability: Floats
) -> _Discrete:
    """Return the discrete problem; ``points``, ``ring`` and ``permeability`` (k,) are those of all
    Gauss points.
    """
    plain, first = (points.stiffness(mode, permeability) for mode in (0, 1))
    fixed = axis_unknowns(case.real_mesh, unknowns)
    order = np.argsort(factorize(plain).perm_c)
    number = np.full(len(case.magnet.ring_sections) + 1, -1)
    number[list(case.solved)] = np.arange(len(case.solved))
    here = np.flatnonzero(number[ring] >= 0)
    integrals = sparse.csr_array((points.weights[here], (here, number[ring][here])),
                                 shape=(len(points.r), len(case.solved)))
    value, (along_r, along_z) = grid_operators(case.real_mesh, case.located, unknowns)
    r = np.where(case.meridian[:, 0] < AXIS_RADIUS * case.magnet.bore_radius, np.inf,
                 case.meridian[:, 0])
    magnet = case.magnet
    return _Discrete(
        (plain, sparse.csr_array(first - plain)), (order, order[~np.isin(order, fixed)]),
        tuple(sparse.csr_array(operator.T @ integrals)
              for operator in (points.along_r, points.over_r, points.along_z)),
        sparse.csr_array(sparse.vstack([along_r, sparse.diags_array(1 / r) @ value, along_z])),
        np.pi / np.array([magnet.blocks_by_ring[number] for number in case.solved]))
