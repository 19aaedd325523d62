"""B and H on parallel lines with their bars, their first and second integrals, and kick maps.

The first integral of B along a line is ``int B ds`` in T m, the second ``int int B ds' ds`` in
T m^2. A kick map has the second-order kicks of an undulator, whose first integrals vanish: with the
potential ``Phi = int |int B_across ds'|^2 ds`` in T^2 m^3 they are ``-1/2 grad Phi / (B rho)^2``
(P. Elleaume, EPAC 1992, p. 661). With the first integrals I from the start of a line, grad Phi is
``2 int I . grad I ds``, so that every line has the kicks of its own, whatever the others are. Of
grad I, the derivative along u is of central differences over lines close beside it; that along v
follows from curl B = 0 and div B = 0 in air.
The integrals are Simpson's. What the spacing of the points makes of them is in their
bars: lines through faces of blocks, where B jumps, need more points.

Inside a block B is mu_0 H, that of all charges, plus the polarization of the block, ``B_r + chi
mu_0 H``. With permeability 1 all of it is a closed form. Inside iron mu_0 H is the gradient of the
potential in its elements, and B is ``mu_r`` times that. In a cross-section with permeable blocks or
iron, B is the curl of the vector potential everywhere, and H follows from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson

from halbach_fe.core.arrays import Bools, Floats, plain
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.numbers import MU_0, check_number
from halbach_fe.geometry.blocks import MagnetBlock, present_blocks
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.surface import Surroundings
from halbach_fe.measurement.observation_operator import flux_density_at
from halbach_fe.response.block_variation import neighbour_remanences
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.axisymmetric_iron import IronReaction, excess_of
from halbach_fe.solver.exact_block_field import external_field, field_of, unit_fields
from halbach_fe.solver.iron_bodies import BodiesReaction
from halbach_fe.solver.moments.solve import field_within
from halbach_fe.solver.routes import check_plane, check_points, finite_element_part
from halbach_fe.solver.separate_blocks import (
    SeparateReaction,
    applies,
    external_acts,
    solve_separate,
)
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.external_keys import External


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
    across: tuple[Floats, Floats] = (np.zeros(1), np.zeros(1))
    count: int = 201

    def __post_init__(self) -> None:
        try:
            for name in ("start", "end"):
                object.__setattr__(self, name, plain(getattr(self, name)))
            first, second = self.across
            object.__setattr__(self, "across", tuple(map(np.atleast_1d, (
                plain(first), plain(second)))))
        except (TypeError, ValueError) as error:
            raise StudyError(must_be("start, end and across", "lines", "numbers in m, and two "
                                     "arrays of offsets", f"what is none: {error}")) from None
        values = np.concatenate([self.start.ravel(), self.end.ravel(), *self.across])
        if self.start.shape != (3,) or self.end.shape != (3,) or not np.isfinite(values).all():
            raise StudyError(must_be("start and end", "lines", "finite x, y, z in m, and across "
                                     "finite", f"{self.start.tolist()} and {self.end.tolist()}"))
        fewest = 3  # Simpson's rule needs them
        check_number("count", "lines", self.count, whole=True)
        if self.count < fewest or np.array_equal(self.start, self.end):
            raise StudyError(must_be(
                "lines", "the field", f"of at least {fewest} points, and end elsewhere than they "
                "start", f"{self.count} points from {self.start.tolist()} to {self.end.tolist()}"))

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

    @property
    def points(self) -> Floats:
        """Points (lines, count, 3) in m; lines run along the second offset first."""
        u, v = (one.ravel() for one in np.meshgrid(*self.across, indexing="ij"))
        middle = self.start + np.linspace(0, 1, self.count)[:, None] * (self.end - self.start)
        return np.asarray((u[:, None] * self.axes[0] + v[:, None] * self.axes[1])[:, None] + middle)


@dataclass(frozen=True)
class Slope:
    """Derivative of B along u on lines; nan of those that have no air beside them."""

    values: Floats
    """Mean and root. Shape (lines, count, 3, 1 + q), in T/m."""
    error: Floats
    """Error bar of the finite elements and the difference. Shape (lines, count, 3), in T/m."""
    spacing: Floats
    """Error that the spacing of the points makes of its integral. Shape (lines,), in T."""


@dataclass(frozen=True)
class FieldOnLines(ShownInNotebook):
    """B, linear in the magnetizations, at the points of lines.

    Attributes
    ----------
    magnet : Magnet
    lines : Lines
    mean : ndarray, shape (lines, count, 3), in T
        B along x, y and z.
    root : ndarray, shape (lines, count, 3, q), in T
        Root of its covariance.
    error, strength_error : ndarray, shape (lines, count, 3), in T
        Error bars of the finite elements, of B and of mu_0 H.
    polarization : ndarray, shape (lines, count, 3, 1 + q), in T
        Mean and root of J of the block or iron in which a point is; 0 in air.
    in_block : ndarray of str, shape (lines, count)
        Name of that block, ``iron 1`` in the first body of iron, empty in air.
    spacing : ndarray, shape (2, lines), in T m and T m^2
        Error that the spacing of the points makes of first and of second integrals.
    slope : Slope, optional
        Derivative of B along u. Grids of lines have it, for kicks.
    measured : bool
        Whether the magnetizations are those of a posterior, not of the study's prior.
    disagreement : str or None
        Sentences if the update of the posterior disagrees with its map, empty if it agrees; None
        if that is not known.
    """

    magnet: Magnet
    lines: Lines
    mean: Floats
    root: Floats
    error: Floats
    strength_error: Floats
    polarization: Floats
    in_block: NDArray[np.str_]
    spacing: Floats
    slope: Slope | None = None
    measured: bool = False
    disagreement: str | None = None

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation (lines, count, 3) of B in T."""
        return np.asarray(np.hypot(np.linalg.norm(self.root, axis=-1), self.error))

    @cached_property
    def strength(self) -> tuple[Floats, Floats]:
        """H (lines, count, 3) in A/m and its standard deviation."""
        return ((self.mean - self.polarization[..., 0]) / MU_0, np.hypot(
            np.linalg.norm(self.root - self.polarization[..., 1:], axis=-1),
            self.strength_error) / MU_0)

    def integrals(self, order: int) -> tuple[Floats, Floats]:
        """Return the first or second integral (lines, 3) in T m or T m^2, and its bar.

        Errors of finite elements are counted as if they had one sign along the line.
        """
        mean, root, error = (self._integrated(values, order)[:, -1]
                             for values in (self.mean, self.root, self.error))
        return mean, np.hypot(np.linalg.norm(root, axis=-1),
                              error + self.spacing[order - 1][:, None])

    @property
    def relative_spacing(self) -> float:
        """The largest `spacing` of first integrals, relative to the largest integral of |B|.

        It is 0 where the field is nothing but rounding, as on the axis of a quadrupole.
        """
        nothing_T = 1e-12
        if np.abs(self.mean).max() <= nothing_T >= self.spacing[0].max() / self.lines.length:
            return 0.0
        whole = self._integrated(np.linalg.norm(self.mean, axis=2))[:, -1].max()
        return float(self.spacing[0].max() / max(whole, nothing_T * self.lines.length))

    @property
    def spacing_in_words(self) -> str:
        """Say how large the largest `spacing` is beside the largest integral of |B|."""
        share = self.relative_spacing
        return f"{f'{100 * share:.2g} % of' if share < 1 else 'more than'} the integral of |B|"

    @property
    def without_integrals(self) -> str:
        """Say that the points are too far apart for the integrals to be known, or nothing."""
        known = 0.1  # part of the integral of |B|, up to which an error bar may stand beside it
        if self.relative_spacing <= known:
            return ""
        return (f"the {self.lines.count} points of a line are too far apart, which makes an error "
                f"of {self.spacing[0].max():.2g} T m, {self.spacing_in_words}")

    def _integrated(self, values: Floats, order: int = 1) -> Floats:
        """Return the integrals (lines, count, ...) from the start of a line to every point."""
        return _integrated(values, self.lines.length / (self.lines.count - 1), order, axis=1)

    @cached_property
    def _across(self) -> tuple[Floats, Floats]:
        """First integrals (lines, count, 2, 1 + q) in T m across the lines, and their bar.

        The integrals, mean and root, go from the start of a line to every point; the bar (lines,
        count, 2) is that of the finite elements and of the spacing.
        """
        integrals = self._integrated(np.concatenate([self.mean[..., None], self.root], axis=3))
        return (np.einsum("lncq,ac->lnaq", integrals, self.lines.axes[:2]),
                self._integrated(self.error) @ np.abs(self.lines.axes[:2].T)
                + self.spacing[0][:, None, None])

    def kick_potential(self) -> tuple[Floats, Floats]:
        """Return Phi (lines,) in T^2 m^3 and its standard deviation, linearized at the mean."""
        across, off = self._across
        mean = across[..., :1]
        return self._summed(np.concatenate([
            mean**2, 2 * mean * across[..., 1:]], axis=3), (2 * np.abs(mean[..., 0]) + off) * off)

    def kicks(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Return the kicks (n, m) in T^2 m^2 along both axes across, times (B rho)^2.

        Each comes with its standard deviation. Lines through or at blocks or iron have nan.

        Raises
        ------
        StudyError
            If the lines are no grid of at least two offsets along both axes.
        """
        if self.slope is None:
            raise StudyError(must_be(
                "across", "the kicks", "a grid of at least 2 x 2 lines",
                f"{' x '.join(str(len(one)) for one in self.lines.across)} of them"))
        axes = self.lines.axes
        across, off = self._across
        slope = self._integrated(self.slope.values)
        bar = self._integrated(self.slope.error) + self.slope.spacing[:, None, None]
        along = np.einsum("lncq,c->lnq", np.concatenate(
            [self.mean[..., None], self.root], axis=3), axes[2])
        by_u = np.einsum("lncq,ac->lnaq", slope, axes[:2])
        by_v = np.stack([by_u[:, :, 1], along[:, :1] - along - by_u[:, :, 0]], axis=2)
        found = []
        for by in (by_u, by_v):
            change = across[..., :1] * by
            change[..., 1:] += across[..., 1:] * by[..., :1]
            doubt = (np.abs(across[..., 0]) + off) * bar[..., :1] + off * np.abs(by[..., 0])
            kick, sd = self._summed(-change, doubt)
            shape = tuple(map(len, self.lines.across))
            found.append((kick.reshape(shape), sd.reshape(shape)))
        return found[0], found[1]

    def _summed(self, density: Floats, doubt: Floats) -> tuple[Floats, Floats]:
        """Return the integral (lines,) of a density along the lines, and its standard deviation.

        ``density`` (lines, count, 2, 1 + q) is its mean and root by the axes across, and ``doubt``
        (lines, count, 2) what the finite elements and the spacing of the points make of it.
        """
        whole = self._integrated(density.sum(axis=2))[:, -1]
        return whole[:, 0], np.hypot(np.linalg.norm(whole[:, 1:], axis=1),
                                     self._integrated(doubt.sum(axis=2))[:, -1])


OF_LINES = "--from-m and --to-m"
"""What places the points, for messages."""


def field_on_lines(
    magnet: Magnet, lines: Lines, magnetizations: Gaussian, session: Session,
    inside: bool = False
) -> FieldOnLines:
    """Return B on lines for normally distributed magnetizations in A/m.

    Parameters
    ----------
    magnetizations : Gaussian
        Of all parameters of the response matrix, with those of neighbours' blocks beside.
    inside : bool
        Whether points may lie inside blocks and iron; see `_through_blocks` for what magnets.

    Raises
    ------
    StudyError
        If a point is not in air, and it was not asked for, or cannot be computed.
    """
    points = lines.points.reshape(-1, 3)
    number = _blocks_of(magnet, points)
    if inside:
        _check_faces(magnet, lines)
    if not inside and (number >= 0).any():
        raise StudyError(must_be(
            "points", magnet.name, "in air", f"{int((number >= 0).sum())} of {len(points)} inside "
            "blocks or iron", "If B and H inside them are wanted, add --inside."))
    beside = _Beside.of(magnet, lines) if min(map(len, lines.across)) > 1 else None
    if beside is not None:
        points = np.concatenate([points, beside.points.reshape(-1, 3)])
        number = np.concatenate([number, np.full(len(points) - len(number), -1)])
    if (number >= 0).any():
        flux, polarization, (error, weak) = _through_blocks(
            magnet, points, number, magnetizations, session)
        polarization = polarization[:lines.points[..., 0].size]
    else:
        check_points(magnet, points, OF_LINES)
        model = response_matrix(magnet, flux_density_at(points), session)
        flux = np.column_stack([model.offset + model.whole @ magnetizations.mean,
                                model.whole @ magnetizations.root]).reshape(len(points), 3, -1)
        error = weak = model.error
        polarization = np.zeros((lines.points[..., 0].size, 3, flux.shape[2]))
        if (others := magnetizations.beside) is not None:
            flux = flux + model.of_neighbours.reshape(*points.shape, -1) @ np.column_stack(
                [others.mean, np.asarray(others.root)])
    shape = lines.points.shape
    every, bars = (each.reshape(-1, *shape[1:], *each.shape[2:]) for each in (
        flux, error.reshape(-1, 3)))
    count = len(lines.points)
    flux, error = every[:count], bars[:count]
    names = np.array([*(block.name for block in magnet.blocks),
                      *(f"iron {body}" for body in range(1, len(magnet.iron) + 1)), ""])
    return FieldOnLines(
        magnet, lines, flux[..., 0], flux[..., 1:], error, weak.reshape(-1, *shape[1:])[:count],
        polarization.reshape(*shape, -1), names[number[:shape[0] * shape[1]]].reshape(shape[:2]),
        _spacing_error(magnet, lines, flux[..., 0]),
        None if beside is None else beside.slope(magnet, lines, every[count:], error))


@dataclass(frozen=True)
class _Beside:
    """Lines close beside others, in the air, for the derivative of B along u."""

    points: Floats
    """Of the lines at every multiple of the step of `offsets`.
    Shape (offsets * m, count, 3), in m."""
    number: NDArray[np.intp]
    """Which of the lines have air beside them. Shape (m,)."""
    step: Floats
    """Shape (m,), in m."""
    offsets: tuple[int, ...]
    """+1, -1 for exact fields, and +2, -2 besides for those of finite elements."""

    @classmethod
    def of(cls, magnet: Magnet, lines: Lines) -> _Beside:
        """Place them; where the first step leads into blocks or iron it is halved."""
        # Steps relative to the radius of the magnet, and the least distance of what is beside in
        # steps. The error of a central difference is a sixth of the square of the step over that
        # distance, of the next order less. Exact fields are good to 1e-10; those of meshes and of
        # several routes jump by some of their bars.
        exact = magnet.is_vacuum and magnet.study.solver.method != "direct"
        relative, margin, offsets = (1e-4, 20, (1, -1)) if exact else (1e-2, 8, (1, -1, 2, -2))
        step = np.full(len(lines.points), relative * magnet.radius)
        halvings = 8

        def blocked(factors: tuple[int, ...], numbers: NDArray[np.intp]) -> Bools:
            found = np.zeros(len(numbers), bool)
            for factor in factors:
                shift = factor * step[numbers, None, None] * lines.axes[0]
                around = magnet.surroundings((lines.points[numbers] + shift).reshape(-1, 3))
                found |= (around.no_air | (around.faces > 0)).reshape(
                    len(numbers), lines.count).any(axis=1)
            return found

        number = np.arange(len(step))
        number = number[~blocked((0,), number)]
        reach = (*offsets, -margin, margin)
        for _ in range(halvings):
            step[number[blocked(reach, number)]] /= 2
        number = number[~blocked(reach, number)]
        return cls(np.concatenate([
            lines.points[number] + factor * step[number, None, None] * lines.axes[0]
            for factor in offsets]), number, step[number], offsets)

    def slope(self, magnet: Magnet, lines: Lines, flux: Floats, error: Floats) -> Slope:
        """Return the derivative of B along u of all lines.

        Parameters
        ----------
        flux : ndarray, shape (offsets * m, count, 3, 1 + q), in T
            Mean and root of B at `points`.
        error : ndarray, shape (lines, count, 3), in T
            Error bar of the finite elements on the lines themselves.
        """
        values, bar = np.full((*error.shape, flux.shape[3]), np.nan), np.full(error.shape, np.nan)
        spacing = np.full(len(error), np.nan)
        at = flux.reshape(len(self.offsets), len(self.number), *flux.shape[1:])
        step = self.step[:, None, None]
        near = (at[0] - at[1]) / (2 * step[..., None])
        values[self.number], bar[self.number] = near, 0.0
        if len(self.offsets) > 2:  # the next order, and what it changes as the bar
            change = (near - (at[2] - at[3]) / (4 * step[..., None])) / 3
            values[self.number] += change
            # Errors of the finite elements change across a line faster than B does. Measured 8 and
            # 12 mm beside a permeable cube of 20 mm: 3 and 1.6 times as fast.
            faster = 3.0
            sizes = [np.linalg.norm(one[..., 0], axis=2).max(axis=1) for one in (at.mean(0), near)]
            rate = np.maximum(sizes[1] / sizes[0], 1 / magnet.radius)[:, None, None]
            bar[self.number] = np.abs(change[..., 0]) + faster * rate * error[self.number]
        if len(self.number):
            spacing[self.number] = _spacing_error(
                magnet, lines, values[self.number, ..., 0], self)[0]
        return Slope(values, bar, spacing)


def _check_faces(magnet: Magnet, lines: Lines) -> None:
    """Refuse points on faces where blocks touch, at which B has the values of both.

    The advice is a number of points of which none is there, if there is one near theirs.
    """
    def around(lines: Lines) -> Surroundings:
        return magnet.surroundings(lines.points.reshape(-1, 3))

    def free(lines: Lines) -> bool:
        found = around(lines)
        return not (found.no_air & ~found.inside).any()

    own, fewest = around(lines), 3  # Simpson's rule needs these points
    there = int(((own.faces > 1) & ~own.inside & ~own.on_edge).sum())
    if not there:
        return
    counts = (lines.count + more for more in (-1, 1, -2, 2, 3, 4, 5))
    other = next((count for count in counts if count >= fewest and free(
        replace(lines, count=count))), None)
    way = "across itself" if there == len(own.faces) else "along itself"
    raise StudyError(must_be(
        "points", magnet.name, "in air or inside a block", f"{there} of {len(own.faces)} on faces "
        "where blocks touch, at which B jumps", f"Move the line by 0.1 mm {way}."
        if other is None else f"With --count {other} no point is there."))


def _spacing_error(
    magnet: Magnet, lines: Lines, mean: Floats, beside: _Beside | None = None
) -> Floats:
    """Return what the spacing of the points makes of the first and second integrals of lines.

    It is (2, lines), in T m and T m^2. The field of blocks and external sources is integrated over
    more points. What permeability and iron add to it in ``mean`` (lines, count, 3) is known at
    these points alone, of which every second one is left out. With ``beside`` it is that of the
    derivative of B along u, in T and T m.
    """
    fewest = 200  # steps, which are enough across a gap of some mm
    finer = max(2, int(np.ceil(fewest / (lines.count - 1))))
    dense = replace(lines, count=finer * (lines.count - 1) + 1)
    step = dense.length / (dense.count - 1)

    def change(values: Floats, every: int, step: float) -> Floats:
        return np.array([np.abs(
            _integrated(values, step, order)[-1]
            - _integrated(values[::every], every * step, order)[-1]).max() for order in (1, 2)])

    def exact(points: Floats) -> Floats:
        flux = field_of(magnet.blocks, points) + external_field(magnet, points)
        number = _blocks_of(magnet, points)
        for block in set(number[(number >= 0) & (number < len(magnet.blocks))]):
            flux[number == block] += magnet.blocks[block].polarization
        return np.nan_to_num(flux, posinf=0.0, neginf=0.0)  # on edges

    def sampled() -> Iterator[Floats]:
        if beside is None:
            yield from map(exact, dense.points)
        else:
            for points, width in zip(dense.points[beside.number], beside.step, strict=True):
                shift = width * lines.axes[0]
                yield (exact(points + shift) - exact(points - shift)) / (2 * width)

    found = []
    for flux, own in zip(sampled(), mean, strict=True):
        added = (own - flux[::finer])[:lines.count - 1 + lines.count % 2]
        found.append(change(flux, finer, step) + (0.0 if magnet.is_vacuum else change(
            added, 2, finer * step)))
    return np.transpose(found)


def _integrated(values: Floats, step: float, order: int, axis: int = 0) -> Floats:
    """Return the integrals of values, `order` times, from the first point to every point."""
    for _ in range(order):
        values = cumulative_simpson(values, dx=step, axis=axis, initial=0.0)
    return np.asarray(values)


def _blocks_of(magnet: Magnet, points: Floats) -> NDArray[np.intp]:
    """Return the number (n,) of the block that contains every point, -1 in air.

    Bodies of iron count on after the blocks.
    """
    found = np.full(len(points), -1)
    for number, block in enumerate(magnet.blocks):
        found[block.contains(points)] = number
    for number, body in enumerate(magnet.iron, len(magnet.blocks)):
        found[body.contains(points)] = number
    return found


def _through_blocks(
    magnet: Magnet, points: Floats, number: NDArray[np.intp], magnetizations: Gaussian,
    session: Session,
) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Return B and J, mean and root (n, 3, 1 + q), and the bars (n, 3) of B and mu_0 H, in T.

    ``number`` (n,) is the block or iron that a point is in, see `_blocks_of`. In 3D iron answers to
    the deviations of the blocks too, as to those of neighbours if these act on it; what their
    permeability adds is an error bar, chi times that field.

    StudyError if blocks are not uniformly magnetized, or a 3D magnet is not solved by moments.
    """
    blocks = magnet.blocks
    in_iron = number >= len(blocks)
    _check_inside(magnet, len(magnetizations.mean), int(in_iron.sum()))
    check_plane(magnet, points, OF_LINES)
    points = points.copy()
    points[number < 0] = check_points(magnet, points[number < 0], OF_LINES)
    if magnet.dimension == 2:
        return _through_cross_section(magnet, points, number, magnetizations, session)
    solved = None if magnet.is_vacuum else solve_separate(magnet, session)
    nominal, weak = _nominal_strength(magnet, points, number, solved)
    tensors, remanence = _remanence(magnet, magnetizations)
    deviations = [(blocks, remanence), *_of_neighbours(magnet, magnetizations)]
    strength = np.zeros((*points.shape, remanence.shape[2]))
    for others, each in deviations:
        for block, field in enumerate(unit_fields(others, points[~in_iron])):
            strength[~in_iron] += field @ each[block]
    if solved is not None and solved.iron is not None:
        acting = deviations if external_acts(magnet) else deviations[:1]
        for others, each in acting:
            _add_answer(strength, solved.iron, others, each, points, in_iron)
    weak += np.abs(tensors - np.eye(3)).max(initial=0.0) * np.abs(strength[..., 0])
    strength[..., 0] += nominal
    polarization, error = np.zeros_like(strength), weak.copy()
    remanence[..., 0] += np.array([block.polarization for block in blocks])
    for body in set(number[number >= 0].tolist()):
        here = number == body
        if body >= len(blocks):
            polarization[here], times = _induced(magnet.iron[body - len(blocks)], strength[here])
            error[here] *= times
        else:
            tensor = tensors[body]
            polarization[here] = remanence[body] + (tensor - np.eye(3)) @ strength[here]
            error[here] = error[here] @ np.abs(tensor)
    return strength + polarization, polarization, (error, weak)


def _check_inside(magnet: Magnet, parameters: int, in_iron: int) -> None:
    """Raise a StudyError if the field inside the blocks, or at so many points in iron, is not known
    here.
    """
    uniform = (parameters == magnet.dimension * len(magnet.blocks)
               and all(len(block.parts) == 1 for block in magnet.blocks))
    if not uniform or magnet.has_losses or not (magnet.dimension == 2 or applies(magnet)):
        raise StudyError(must_be(
            "points inside blocks", magnet.name, "of a magnet of uniform blocks without "
            "irreversible losses, and in 3D of the method reaction", "another magnet",
            "End the line before the blocks."))
    if in_iron and magnet.external != External() and not external_acts(magnet):
        raise StudyError(must_be(
            "points inside iron", magnet.name, "of a study without `external`, to which this iron "
            "does not answer here", f"{in_iron} such points",
            "Leave `external` out, or end the line before the iron."))


def _nominal_strength(
    magnet: Magnet, points: Floats, number: NDArray[np.intp], solved: SeparateReaction | None
) -> tuple[Floats, Floats]:
    """Return mu_0 H (n, 3) in T of the nominal magnet, and its bars; see `_through_blocks`."""
    in_iron = number >= len(magnet.blocks)
    free = np.flatnonzero(~in_iron)
    strength, error = np.zeros_like(points), np.zeros_like(points)
    strength[free] = external_field(magnet, points[free]) + field_of(magnet.blocks, points[free])
    if solved is not None:
        reaction, error[free] = reaction_within(magnet, points[free], number[free], solved)
        strength[free] += reaction
        if solved.iron is not None and in_iron.any():
            strength[in_iron], error[in_iron] = solved.iron.inside(points[in_iron])
    return strength, error


def _remanence(magnet: Magnet, magnetizations: Gaussian) -> tuple[Floats, Floats]:
    """Return the recoil tensors (blocks, 3, 3), and the remanences (blocks, 3, 1 + q) in T by which
    mean and root differ from the nominal magnet.
    """
    tensors = np.array([block.recoil_tensor for block in magnet.blocks])
    change = np.column_stack([magnetizations.mean - magnet.nominal_magnetization,
                              magnetizations.root]).reshape(len(tensors), magnet.dimension, -1)
    return tensors, MU_0 * tensors[:, :, :magnet.dimension] @ change


def _of_neighbours(
    magnet: Magnet, magnetizations: Gaussian
) -> list[tuple[tuple[MagnetBlock, ...], Floats]]:
    """Return the blocks of every neighbour, and the remanences (blocks, 3, 1 + q) in T by which
    mean and root differ from those that the study states.
    """
    if (others := magnetizations.beside) is None:
        return []
    change = np.column_stack([others.mean, np.asarray(others.root)])
    known = neighbour_remanences(magnet)
    parts = change.reshape(len(known), len(magnet.blocks), 3, -1)
    return [(blocks, matrices @ part)
            for (blocks, matrices), part in zip(known, parts, strict=True)]


def _through_cross_section(
    magnet: Magnet, points: Floats, number: NDArray[np.intp], magnetizations: Gaussian,
    session: Session,
) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Return the same of a cross-section: B by the vector potential, from which H follows."""
    magnet = magnet.with_(solver__method="reaction")
    blocks = magnet.blocks
    parts = finite_element_part(magnet, points, session, anywhere=True)
    error = reading_errors(magnet, flux_density_at(points), parts,
                           session).reshape(-1, 3)
    tensors, remanence = _remanence(magnet, magnetizations)
    flux = np.zeros((*points.shape, remanence.shape[2]))
    for block, unit in enumerate(unit_fields(blocks, points)):
        flux += (unit[..., :2] + parts.block(block, slice(None))) @ remanence[block, :2]
    flux[..., 0] += external_field(magnet, points) + field_of(blocks, points) + parts.nominal
    remanence[..., 0] += [block.polarization for block in blocks]
    polarization, weak = np.zeros_like(flux), error.copy()
    for body in set(number[number >= 0]):
        here = number == body
        if body < len(blocks):
            flux[here] += remanence[body]
            inverse = np.linalg.inv(tensors[body])
            polarization[here] = flux[here] - inverse @ (flux[here] - remanence[body])
            weak[here] = error[here] @ np.abs(inverse)
        else:
            polarization[here], share = _magnetized(magnet.iron[body - len(blocks)], flux[here])
            weak[here] *= share
    return flux, polarization, (error, weak)


def _magnetized(body: IronSolid, flux: Floats) -> tuple[Floats, Floats]:
    """Return J (n, 3, 1 + q) of iron in T for B, and d mu_0 H / dB (n, 1) at most.

    Of the roots it is that of a small change.
    """
    square = np.sum(flux[..., 0]**2, axis=1)
    if isinstance(body.law, float | int):
        share, slope = np.full_like(square, 1 / body.law), np.zeros_like(square)
    else:
        curve = body.law.reluctivity
        share, slope = MU_0 * curve.coefficient(square), 2 * MU_0 * curve.slope(square)
    return (flux - _linearized(share, slope, flux),
            np.maximum(share, share + slope * square)[:, None])


def _linearized(factor: Floats, slope: Floats, field: Floats) -> Floats:
    """Return f(|F|^2) F of the first of fields F (n, 3, 1 + q), and its change by the others.

    ``factor`` is f and ``slope`` 2 df/d(|F|^2), both (n,).
    """
    along = np.einsum("ni,niq->nq", field[..., 0], field)
    along[:, 0] = 0.0
    return factor[:, None, None] * field + (
        slope[:, None] * field[..., 0])[..., None] * along[:, None]


def _add_answer(
    of_change: Floats, iron: IronReaction | BodiesReaction, blocks: Sequence[MagnetBlock],
    remanence: Floats, points: Floats, in_iron: Bools
) -> None:
    """Add to mu_0 H (n, 3, q) in T of deviations what iron answers to them.

    ``remanence`` (blocks, 3, q) in T are the deviations. In iron it is all of mu_0 H.
    """
    # angles at which the fields of single blocks on iron with rotational symmetry are given
    angles = 64
    nodes = iron.nodes(angles)
    order = np.concatenate([np.flatnonzero(~in_iron), np.flatnonzero(in_iron)])
    for block, unit in enumerate(unit_fields(blocks, nodes)):
        if remanence[block].any():
            answer = iron.tangent(np.moveaxis(unit, 2, 0), points[~in_iron], points[in_iron])
            of_change[order] += np.moveaxis(answer, 0, 2) @ remanence[block]


def _induced(body: IronSolid, strength: Floats) -> tuple[Floats, Floats]:
    """Return J (n, 3, 1 + q) of iron in T for mu_0 H, and dB / d mu_0 H (n, 1) at most.

    Of the roots it is that of a small change.
    """
    square = np.sum(strength[..., 0]**2, axis=1)
    excess, slope = excess_of(body.law, square)
    return (_linearized(excess, slope, strength),
            np.maximum(1 + excess, 1 + excess + slope * square)[:, None])


def reaction_within(
    magnet: Magnet, points: Floats, number: NDArray[np.intp], solved: SeparateReaction
) -> tuple[Floats, Floats]:
    """Return what permeability and iron add to mu_0 H of the nominal magnet, and its error bar.

    Both are (n, 3) in T; ``number`` (n,) is the block that a point is in, -1 in air.
    """
    present = present_blocks(magnet.blocks)
    place = np.full(len(points), -1)  # number of the block of a point among those that are there
    for block in set(number[number >= 0]):
        if magnet.blocks[block] in present:
            place[number == block] = present.index(magnet.blocks[block])

    def sources(places: Floats) -> Floats:
        iron = solved.iron.field(places) if solved.iron is not None else 0.0
        return known(places) + iron

    def known(places: Floats) -> Floats:
        blocks = field_of(magnet.blocks, places)
        return blocks + external_field(magnet, places) if external_acts(magnet) else blocks

    field, error = np.zeros_like(points), np.zeros_like(points)
    free = place < 0 if solved.blocks else np.ones(len(points), bool)
    if free.any():
        field[free], change = solved.field_with_errors(points[free])
        error[free] = np.linalg.norm(change, axis=1, keepdims=True)
    for block in set(place[~free]):
        here = place == block
        strength, bar = field_within(solved.blocks[0], block, present[block], points[here], sources)
        field[here] = strength - known(points[here])
        error[here] = bar + (solved.iron.error(points[here]) if solved.iron is not None else 0.0)
    return field, error
