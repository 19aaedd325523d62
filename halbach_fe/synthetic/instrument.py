"""The mapper and its Hall probe, with all their faults: from the field to what is written down.

A map records where the probe should have been. Faults of position mean that the field is taken
elsewhere; the recorded points stay the nominal ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.synthetic.bodies import NOWHERE, Vector

PERFECT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class FaultyInstrument:
    """Faults of a mapper; a default one has none. Lengths in m, angles in rad, fields in T.

    Attributes
    ----------
    translation, rotation : tuple
        Of the whole mapper, axes of the probe included, along the magnet's axes; a rotation
        vector about the origin.
    z_scale, radius_scale : float
        True z, true radius is 1 + this times the recorded.
    radius_error : float
        What the true radius is larger by; on the axis it points along x.
    run_out : tuple
        Amplitude, and the angle where the radius is largest: r + d cos(phi - phi_0).
    sag : tuple
        How far the arm hangs down, along -y, at its far end, and the z of its two ends; it hangs
        as the square of the distance from the first.
    vibration : float
        Standard deviation of the probe's position along each axis.
    sensors : tuple of three tuples
        Displacements of the sensors of B_x, B_y and B_z, along the mapper's axes.
    axes : tuple of three tuples
        ``axes[i][j]``: what sensor i picks up of component j.
    planar_hall, quadratic, cubic : float
        Sensor i adds planar_hall times the product of the two other components, in 1/T, and
        quadratic times the square, cubic times the third power of its reading, in 1/T and 1/T^2.
    gain, offset : tuple
        Of every sensor: (1 + gain) times the reading, plus the offset.
    drift : float
        What is added to all readings from the first of the map to the last, growing with time.
    outliers : tuple
        The fraction of the readings that are off, and by how much.
    reversed_z : bool
        The probe is at -z.
    order, signs : tuple
        Which sensor is written down for each component, and with which sign.
    length_unit, field_unit : float
        What a metre, a tesla is written down as.
    """

    translation: Vector = NOWHERE
    rotation: Vector = NOWHERE
    z_scale: float = 0.0
    radius_scale: float = 0.0
    radius_error: float = 0.0
    run_out: tuple[float, float] = (0.0, 0.0)
    sag: Vector = NOWHERE
    vibration: float = 0.0
    sensors: tuple[Vector, Vector, Vector] = (NOWHERE, NOWHERE, NOWHERE)
    axes: tuple[Vector, Vector, Vector] = PERFECT
    planar_hall: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    gain: Vector = NOWHERE
    offset: Vector = NOWHERE
    drift: float = 0.0
    outliers: tuple[float, float] = (0.0, 0.0)
    reversed_z: bool = False
    order: tuple[int, int, int] = (0, 1, 2)
    signs: Vector = (1.0, 1.0, 1.0)
    length_unit: float = 1.0
    field_unit: float = 1.0

    def places(self, points: Floats, generator: np.random.Generator) -> Floats:
        """Where each of the three sensors is, (3, n, 3) in m, instead of at points (n, 3)."""
        x, y, z = points.T
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        swing, phase = self.run_out
        outward = (self.radius_scale * radius + self.radius_error
                   + swing * np.cos(angle - phase))
        depth, start, end = self.sag
        along = (z - start) / (end - start) if depth else np.zeros(len(z))
        height = -z if self.reversed_z else z
        probe = np.column_stack([
            x + outward * np.cos(angle),
            y + outward * np.sin(angle) - depth * along**2,
            (1 + self.z_scale) * height])
        turn = Rotation.from_rotvec(self.rotation)
        shaken = self.vibration * generator.standard_normal(points.shape)
        return np.array([turn.apply(probe + sensor) + self.translation + shaken
                         for sensor in self.sensors])

    def readings(self, fields: Floats, time: Floats, generator: np.random.Generator) -> Floats:
        """What the sensors show, (n, 3) in T, without noise.

        Parameters
        ----------
        fields : ndarray, shape (3, n, 3), in T
            At each sensor's places, along the magnet's axes.
        time : ndarray, shape (n,)
            From 0 at the map's first reading to 1 at its last.
        """
        turn = Rotation.from_rotvec(self.rotation).as_matrix()
        columns = []
        for sensor, field in enumerate(fields @ turn):
            shown = field @ self.axes[sensor]
            shown += self.planar_hall * np.prod(np.delete(field, sensor, axis=1), axis=1)
            shown += self.quadratic * shown**2 + self.cubic * shown**3
            columns.append((1 + self.gain[sensor]) * shown + self.offset[sensor])
        fraction, size = self.outliers
        shown = np.column_stack(columns)
        off = generator.random(shown.shape) < fraction
        jump = size * generator.uniform(0.5, 1.5, shown.shape) * generator.choice(
            [-1.0, 1.0], shown.shape)
        return np.asarray(shown + self.drift * time[:, None] + np.where(off, jump, 0.0))

    def record(self, points: Floats, readings: Floats) -> tuple[Floats, Floats]:
        """What is written down of points (n, 3) in m and readings (n, 3) in T."""
        return (points * self.length_unit,
                readings[:, self.order] * self.signs * self.field_unit)
