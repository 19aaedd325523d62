"""Fit of the relative poses of several maps in one field without sources, with the probe's terms.

The probe of each map reads as that of `halbach_fe.measurement.probe_fit` does, in axes of its
own stage, which sees the charges turned and shifted. Terms of the probe are common to all maps, or
added for one.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.probe_fit import (
    LEAST_OWN,
    PRIOR_SD,
    ProbeFit,
    ProbeModel,
    State,
    weights_of,
)
from halbach_fe.measurement.source_free_field import Charges, HarmonicFit
from halbach_fe.measurement.suspect_rows import scatter_around

TERMS = len(PRIOR_SD)
"""Number of the terms of a probe."""

SHIFT, TURN, GAIN = slice(0, 3), slice(3, 6), 6
"""Places of a map's own numbers: shift of its middle, turn about it, and gain of |B|."""

PLACED_SD = (*(0.05,) * 3, *(0.05,) * 3, 0.02)
"""Prior standard deviations of these from where the fit starts, in m, rad and 1: shifts are open,
and axes that a stage states are not turned by more than some degrees."""

TURN_RAD = PLACED_SD[TURN.start]
"""That of a turn, if nothing else is said of the stages."""


@dataclass(frozen=True)
class Pose:
    """Where a stage stands: a place p in its coordinates is ``turn p + shift_m``."""

    turn: Floats
    """Shape (3, 3)."""
    shift_m: Floats
    """Shape (3,)."""

    def places(self, points: Floats) -> Floats:
        """Return the places (n, 3) of points (n, 3) of the stage, both in m."""
        return np.asarray(points @ self.turn.T + self.shift_m)

    def moved(self, middle: Floats, shift: Floats, turn: Floats) -> Pose:
        """Return the pose that is shifted by (3,) in m, and turned by (3,) in rad about the place
        of ``middle`` (3,), a point of the stage.
        """
        rotation = Rotation.from_rotvec(turn).as_matrix() @ self.turn
        return Pose(rotation, self.places(middle) + shift - rotation @ middle)

    def of(self, other: Pose) -> Pose:
        """Return where a stage stands that has the pose ``other`` on this stage."""
        return Pose(self.turn @ other.turn, self.places(other.shift_m))

    @property
    def inverse(self) -> Pose:
        """The pose of these coordinates on the stage."""
        return Pose(self.turn.T, -self.turn.T @ self.shift_m)


@dataclass(frozen=True)
class PosedCharges(Charges):
    """Charges in the coordinates of a stage that has a pose among them."""

    pose: Pose

    @classmethod
    def seen_from(cls, charges: Charges, pose: Pose) -> PosedCharges:
        """Return charges in the coordinates of a stage."""
        return cls(charges.places, charges.scale, pose)

    def fields(self, points: Floats) -> Floats:
        """Return B (n, 3, amplitudes) along the axes of the stage."""
        return np.einsum("ij,nik->njk", self.pose.turn, super().fields(self.pose.places(points)))

    def fields_along(self, points: Floats, directions: Floats) -> Floats:
        """Return B . u (n, amplitudes) for u (n, 3) along the axes of the stage."""
        return super().fields_along(self.pose.places(points), directions @ self.pose.turn.T)

    def field(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return B (n, 3) in T along the axes of the stage."""
        return super().field(self.pose.places(points), amplitudes) @ self.pose.turn

    def gradient(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return the gradient (n, 3, 3) of B, both along the axes of the stage."""
        there = super().gradient(self.pose.places(points), amplitudes)
        return np.einsum("ij,nik,kl->njl", self.pose.turn, there, self.pose.turn)

    def by_pose(
        self, points: Floats, reads: Floats, arms: Floats, amplitudes: Floats
    ) -> Floats:
        """Return the derivatives (n, s, 6) of u . B by shift and turn of the stage.

        ``reads`` (n, s, 3) are the directions u of s sensors at points (n, 3), which are ``arms``
        (n, 3) away from the axis of turn. A turn d changes u . B by ``d . (u x B + r x grad(u .
        B))``.
        """
        field = self.field(points, amplitudes)
        gradient = np.einsum("nsc,ncj->nsj", reads, self.gradient(points, amplitudes))
        turning = np.cross(reads, field[:, None]) + np.cross(arms[:, None], gradient)
        return np.asarray(np.concatenate([gradient, turning], axis=2).reshape(
            *reads.shape[:2], 2, 3) @ self.pose.turn.T).reshape(*reads.shape[:2], 6)


class JoinedModel(ProbeModel):
    """Readings of several maps in one harmonic field.

    `ProbeFit.instrument` holds the terms of the probe that are common, those that each map has in
    addition, and the numbers of `PLACED_SD` of each map. Points count in the first map's frame.
    """

    def __init__(
        self, charges: Charges, maps: Sequence[ProbeModel], starts: Sequence[Pose],
        turn_rad: float = TURN_RAD,
    ) -> None:
        self.charges, self.maps, self.starts = charges, maps, starts
        self.middles = [(one.points.max(axis=0) + one.points.min(axis=0)) / 2 for one in maps]
        self.points = np.vstack([start.places(one.points)
                                 for start, one in zip(starts, maps, strict=True)])
        self.field = np.vstack([one.field for one in maps])
        self.scatter = np.concatenate([one.scatter for one in maps])
        self.weights = weights_of(self.scatter)
        placed = np.array(PLACED_SD)
        placed[TURN] = turn_rad
        self.any_sd = np.concatenate([maps[0].any_sd, *(one.any_sd for one in maps),
                                      *(placed,) * len(maps)])
        self.prior_sd = self.any_sd
        self.ends = np.cumsum([0, *(len(one.points) for one in maps)])
        self._last = []
        self.near = np.zeros(len(self.any_sd))  # what maps share is known better than a design

    def rows_of(self, number: int) -> slice:
        """Return the rows of a map."""
        return slice(self.ends[number], self.ends[number + 1])

    def only(self, number: int, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the rows (n,) that are of a map."""
        found = np.zeros(len(rows), bool)
        found[self.rows_of(number)] = rows[self.rows_of(number)]
        return found

    def own(self, number: int) -> slice:
        """Return where the terms of the probe that only one map has are in the instrument."""
        return slice((number + 1) * TERMS, (number + 2) * TERMS)

    def placed(self, number: int) -> slice:
        """Return where shift, turn and gain of a map are in the instrument."""
        first = (len(self.maps) + 1) * TERMS + number * len(PLACED_SD)
        return slice(first, first + len(PLACED_SD))

    def pose(self, at: ProbeFit, number: int) -> Pose:
        """Return the pose of a map in the frame of the first one."""
        value = (at.instrument * self.prior_sd)[self.placed(number)]
        return self.starts[number].moved(self.middles[number], value[SHIFT], value[TURN])

    def _posed(self, at: ProbeFit, number: int) -> tuple[ProbeModel, ProbeFit, float]:
        """Return the model of a map by itself, its fit, and its gain."""
        value, one = at.instrument * self.prior_sd, copy(self.maps[number])
        one.charges = PosedCharges.seen_from(self.charges, self.pose(at, number))
        one.weights, one.prior_sd = self.weights[self.rows_of(number)], one.any_sd
        instrument = (value[:TERMS] + value[self.own(number)]) / np.where(
            one.any_sd > 0, one.any_sd, np.inf)
        lag = one.lag_shows(np.ones(len(one.points), bool))
        return (one, replace(at, instrument=instrument, prior_sd=one.any_sd, lag=lag),
                1 + float(value[self.placed(number)][GAIN]))

    def _each(self, rows: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return the numbers of the maps that have some of the rows, and these rows of theirs."""
        found = [(number, rows[self.rows_of(number)]) for number in range(len(self.maps))]
        return [(number, own) for number, own in found if own.any()]

    def lag_shows(self, rows: NDArray[np.bool_]) -> bool:
        """Each map knows of its own, see `_posed`."""
        return True

    def offsets(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the change (n, 3) in T of the sensors' offsets."""
        found = []
        for number, own in self._each(rows):
            one, fit, _ = self._posed(at, number)
            found.append(one.offsets(fit, own))
        return np.vstack(found)

    def by_amplitude(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the weighted readings (n, 3, k) per amplitude."""
        found, done = np.empty((int(rows.sum()), 3, len(self.charges))), 0
        for number, own in self._each(rows):
            one, fit, gain = self._posed(at, number)
            part = slice(done, done := done + int(own.sum()))
            found[part] = one.by_amplitude(fit, own)
            found[part] *= gain
        return found

    def by_parameter(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the weighted derivatives (n, 3, p) in T by the instrument."""
        found, done = np.zeros((int(rows.sum()), 3, len(self.any_sd))), 0
        for number, own in self._each(rows):
            one, fit, gain = self._posed(at, number)
            part = slice(done, done := done + int(own.sum()))
            by_term = gain * one.by_parameter(fit, own) / np.where(
                one.any_sd > 0, one.any_sd, np.inf)
            found[part, :, :TERMS] = by_term
            found[part, :, self.own(number)] = by_term
            found[part, :, self.placed(number)] = (
                self._by_place(number, one, fit, own) * [*(gain,) * 6, 1.0]
                * one.weights[own][..., None])
        return found * self.prior_sd

    def _by_place(
        self, number: int, one: ProbeModel, fit: ProbeFit, rows: NDArray[np.bool_]
    ) -> Floats:
        """Return the derivatives (n, 3, 7) in T by shift, turn and gain, for a gain of 1."""
        found = np.empty((int(rows.sum()), 3, len(PLACED_SD)))
        charges = one.charges
        assert isinstance(charges, PosedCharges)
        for sensor in range(3):
            places, reads = one.read_by(fit, rows, sensor)
            found[:, sensor, :GAIN] = charges.by_pose(
                places, reads[:, None], places - self.middles[number], fit.amplitudes)[:, 0]
            found[:, sensor, GAIN] = np.sum(
                reads * charges.field(places, fit.amplitudes), axis=1)
        return found

    def readings(self, at: ProbeFit, rows: NDArray[np.bool_] | None = None) -> Floats:
        """Return what the probes read (n, 3) in T at some rows, by default at all."""
        rows = np.ones(len(self.points), bool) if rows is None else rows
        found = []
        for number, own in self._each(rows):
            one, fit, gain = self._posed(at, number)
            offsets = one.offsets(fit, own)
            found.append(gain * (one.readings(fit, own) - offsets) + offsets)
        return np.vstack(found)

    def weighted(self, at: ProbeFit, rows: NDArray[np.bool_], width2: float) -> JoinedModel:
        """Return a model that weights the readings of each map by how far they are off a field that
        this map alone has: where maps contradict each other, they count no less.
        """
        other = copy(self)
        other.scatter = self.scatter.copy()
        for number, own in self._each(rows):
            alone = self.alone(at, number, rows, width2)
            known = self.only(number, rows)
            left = (self.field[known] - self.readings(alone.at, known)) / np.maximum(
                alone.free.diagonal().reshape(-1, 3), LEAST_OWN)
            points = self.maps[number].points
            other.scatter[self.rows_of(number)] = scatter_around(points, points[own], left)
        other.weights = weights_of(other.scatter)
        return other

    def alone(
        self, at: ProbeFit, number: int, rows: NDArray[np.bool_], width2: float
    ) -> State:
        """Return the field of a map alone, read by the probe of a fit."""
        return State.of(self, at, self.only(number, rows), width2)

    def perfect(self) -> ProbeFit:
        """Return the fit that the search of the amplitudes starts from."""
        return self.start(HarmonicFit(np.zeros(len(self.charges)), 1.0, 1.0, 0.0, 0.0))
