"""B and H on parallel lines with their bars, their first and second integrals, and kick maps.

The first integral of B along a line is ``int B ds`` in T m, the second ``int int B ds' ds`` in
T m^2. A kick map has the second-order kicks of an undulator, whose first integrals vanish: with the
potential ``Phi = int |int B_across ds'|^2 ds`` in T^2 m^3 they are ``-1/2 grad Phi / (B rho)^2``
(P. Elleaume, EPAC 1992, p. 661).
The integrals are Simpson's: lines through faces of blocks, where B jumps, need more points.

Inside blocks of permeability 1 the field is a closed form too: B is mu_0 H, that of all charges,
plus the polarization of the block.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import MU_0
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import flux_density_at
from halbach_fe.response.matrix import response_matrix
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.formulation_choice import check_points
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian

FEWEST = 3
"""Fewest points of a line; Simpson's rule needs them."""


@dataclass(frozen=True)
class Lines:
    """Parallel lines of equally spaced points.

    Attributes
    ----------
    start, end : ndarray, shape (3,), in m
        Of the middle line.
    across : tuple of two ndarray, in m
        Offsets of the lines along the two axes that `axes` names.
    count : int
        Number of points of every line.
    """

    start: Floats
    end: Floats
    across: tuple[Floats, Floats]
    count: int

    @property
    def length(self) -> float:
        """Length in m of every line."""
        return float(np.linalg.norm(self.end - self.start))

    @cached_property
    def axes(self) -> Floats:
        """Unit vectors (3, 3): across, across, along. Those of a line along z are x, y and z."""
        along = (self.end - self.start) / self.length
        seed = np.eye(3)[0 if abs(along[0]) < 0.9 else 1]  # not nearly along the line
        first = seed - (seed @ along) * along
        first /= np.linalg.norm(first)
        return np.array([first, np.cross(along, first), along])

    @cached_property
    def points(self) -> Floats:
        """Points (lines, count, 3) in m; lines run along the second offset first."""
        u, v = (one.ravel() for one in np.meshgrid(*self.across, indexing="ij"))
        middle = self.start + np.linspace(0, 1, self.count)[:, None] * (self.end - self.start)
        return np.asarray((u[:, None] * self.axes[0] + v[:, None] * self.axes[1])[:, None] + middle)


@dataclass(frozen=True)
class FieldOnLines:
    """B, linear in the magnetizations, at the points of lines.

    Attributes
    ----------
    lines : Lines
    mean : ndarray, shape (lines, count, 3), in T
        B along x, y and z.
    root : ndarray, shape (lines, count, 3, q), in T
        Root of its covariance.
    error : ndarray, shape (lines, count, 3), in T
        Error bar of the finite elements.
    polarization : ndarray, shape (lines, count, 3, 1 + q), in T
        Mean and root of J of the block in which a point is; 0 in air.
    in_block : ndarray of str, shape (lines, count)
        Name of that block, empty in air.
    """

    lines: Lines
    mean: Floats
    root: Floats
    error: Floats
    polarization: Floats
    in_block: NDArray[np.str_]

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation (lines, count, 3) of B in T."""
        return np.asarray(np.hypot(np.linalg.norm(self.root, axis=-1), self.error))

    @cached_property
    def strength(self) -> tuple[Floats, Floats]:
        """H (lines, count, 3) in A/m and its standard deviation."""
        return ((self.mean - self.polarization[..., 0]) / MU_0, np.hypot(
            np.linalg.norm(self.root - self.polarization[..., 1:], axis=-1), self.error) / MU_0)

    def integrals(self, order: int) -> tuple[Floats, Floats]:
        """Return the first or second integral (lines, 3) in T m or T m^2, and its bar.

        Errors of finite elements are counted as if they had one sign along the line.
        """
        found = [self._integrated(values, order)[:, -1]
                 for values in (self.mean, self.root, self.error)]
        return found[0], np.hypot(np.linalg.norm(found[1], axis=-1), found[2])

    def _integrated(self, values: Floats, order: int = 1) -> Floats:
        """Return the integrals (lines, count, ...) from the start of a line to every point."""
        step = self.lines.length / (self.lines.count - 1)
        for _ in range(order):
            values = cumulative_simpson(values, dx=step, axis=1, initial=0.0)
        return np.asarray(values)

    def kick_potential(self) -> tuple[Floats, Floats]:
        """Return Phi (lines,) in T^2 m^3 and its standard deviation, linearized about the mean."""
        step = self.lines.length / (self.lines.count - 1)
        across = self._integrated(self.mean) @ self.lines.axes[:2].T
        roots = np.einsum("lncq,ac->lnaq", self._integrated(self.root), self.lines.axes[:2])
        own = cumulative_simpson((across**2).sum(axis=2), dx=step, axis=1)[:, -1]
        change = 2 * np.einsum("lna,lnaq->lnq", across, roots)
        return np.asarray(own), np.linalg.norm(
            cumulative_simpson(change, dx=step, axis=1)[:, -1], axis=-1)

    def kicks(self) -> tuple[Floats, Floats]:
        """Return the kicks (n, m) in T^2 m^2 along both axes across, times (B rho)^2."""
        shape = tuple(len(one) for one in self.lines.across)
        potential = self.kick_potential()[0].reshape(shape)
        first, second = (np.asarray(np.gradient(
            potential, offsets, axis=axis, edge_order=2 if len(offsets) > 2 else 1))
            for axis, offsets in enumerate(self.lines.across))
        return -0.5 * first, -0.5 * second


OF_LINES = "--from-m and --to-m"
"""What places the points, for messages."""


def field_on_lines(
    magnet: Magnet, lines: Lines, magnetizations: Gaussian, session: Session,
    inside: bool = False
) -> FieldOnLines:
    """Return B on lines for normally distributed magnetizations in A/m.

    Parameters
    ----------
    magnet : Magnet
    lines : Lines
    magnetizations : Gaussian
        Of all parameters of the response matrix.
    session : Session
    inside : bool
        Whether points may lie inside blocks, of a magnet of permeability 1 without iron.

    Raises
    ------
    StudyError
        If a point is not in air, and it was not asked for, or cannot be computed.
    """
    points = lines.points.reshape(-1, 3)
    count = len(magnetizations.mean)
    number = _blocks_of(magnet, points)
    if not inside and (number >= 0).any():
        raise StudyError(must_be(
            "points", magnet.name, "in air", f"{int((number >= 0).sum())} of {len(points)} inside "
            "blocks", "If B and H inside them are wanted, add --inside."))
    if (number >= 0).any():
        offset, matrix = _closed_form(magnet, points, number, count)
        error = np.zeros(offset.shape)
    else:
        check_points(magnet, points, OF_LINES)
        model = response_matrix(magnet, flux_density_at(points), session)
        offset, matrix, error = (values.reshape(len(points), 3, *values.shape[1:]) for values in (
            model.offset, model.whole, model.error))
    of_block = np.zeros((len(points), 3, count))
    for row in np.flatnonzero(number >= 0):
        of_block[row, range(3), range(3 * number[row], 3 * number[row] + 3)] = MU_0
    flat, own = matrix.reshape(-1, count), of_block.reshape(-1, count)
    shape = lines.points.shape
    names = np.array([*(block.name for block in magnet.blocks), ""])
    return FieldOnLines(
        lines, (offset.ravel() + flat @ magnetizations.mean).reshape(shape),
        (flat @ magnetizations.root).reshape(*shape, -1), error.reshape(shape),
        np.column_stack([own @ magnetizations.mean, own @ magnetizations.root]).reshape(*shape, -1),
        names[number].reshape(shape[:2]))


def _blocks_of(magnet: Magnet, points: Floats) -> NDArray[np.intp]:
    """Return the number (n,) of the block that contains every point, -1 in air."""
    found = np.full(len(points), -1)
    for number, block in enumerate(magnet.blocks):
        found[block.contains(points)] = number
    return found


def _closed_form(
    magnet: Magnet, points: Floats, number: NDArray[np.intp], count: int
) -> tuple[Floats, Floats]:
    """Return B (n, 3) in T of external fields, and B (n, 3, parameters) per A/m.

    Raises
    ------
    StudyError
        If permeability or iron react, or magnetizations are not uniform in blocks.
    """
    uniform = count == 3 * len(magnet.blocks) and all(
        len(block.parts) == 1 for block in magnet.blocks)
    if magnet.dimension != 3 or not magnet.is_vacuum or not uniform:
        raise StudyError(must_be(
            "points inside blocks", magnet.name, "of a 3D magnet of uniform blocks with recoil "
            "permeability 1 and without iron", "another magnet",
            "Set array.recoil_permeability = 1, which changes B inside by some per cent, or leave "
            "the points out."))
    outside = number < 0
    points = points.copy()
    points[outside] = check_points(magnet, points[outside], OF_LINES)
    matrix = np.empty((len(points), 3, count))
    for block, field in enumerate(unit_fields(magnet.blocks, points)):
        field[number == block] += np.eye(3)  # B = mu_0 H + J
        matrix[:, :, 3 * block:3 * block + 3] = MU_0 * field
    return external_field(magnet, points), matrix
