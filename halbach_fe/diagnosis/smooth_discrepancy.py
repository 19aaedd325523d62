"""Smooth fields of any kind and smooth errors of a sensor, for causes outside the catalogue.

A field whose sources are outside the bore is ``-grad phi`` with ``phi`` harmonic: modified Bessel
functions times ``cos n phi``, ``cos k z`` and their sines, and polynomials that do not depend on z
(J. D. Jackson, Classical Electrodynamics, 3rd ed., section 3.7). Errors of a sensor do not have to
be a field: each component is an independent Fourier series in z and in the azimuth. Both have many
terms, whose amplitudes decrease with order; `halbach_fe.diagnosis.flexible_causes` judges them.

The solver's own error is also such a field, smooth and of known size. No effect may be identified
for a misfit that it can explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.surface import is_in_plane

DECAY_RATES = ((0.25, 0.125), (1.0, 0.4), (2.0, 1.0))
"""Candidate decay rates of the logarithm of the amplitudes: per azimuthal order, and per half wave
in z."""


@dataclass(frozen=True)
class SmoothTerms:
    """The terms of a smooth discrepancy.

    Attributes
    ----------
    fields : ndarray, shape (k, n, 3)
        Normalized fields at the points of a map.
    fineness : ndarray, shape (k, 2)
        Azimuthal order and number of half waves in z of each term.
    """

    fields: Floats
    fineness: Floats


def harmonic_fields(
    points: Floats, orders: int = 6, waves: int = 10, in_plane: int = 0
) -> SmoothTerms:
    """Return fields without sources at the points, each with an rms magnitude of 1.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    orders : int
        Largest azimuthal order.
    waves : int
        Largest number of half waves over the length of the map.
    in_plane : int
        The same of a map in one plane, over its diameter: the field varies along z there, too.
    """
    radius = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(points[:, 1], points[:, 0])
    z = points[:, 2] - points[:, 2].mean()
    # longer than the map, on which the terms must not be periodic
    flat, scale = is_in_plane(points), max(radius.max(), 1e-9)
    length = (2 * scale if flat else max(np.ptp(z), 1e-9)) * 1.2
    along, across = np.eye(3)[2], np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    around = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    found: list[Floats] = []
    fineness: list[tuple[int, int]] = []

    def add(radial: Floats, azimuthal: Floats, axial: Floats, order: int, wave: int) -> None:
        field = radial[:, None] * across + azimuthal[:, None] * around + axial[:, None] * along
        size = float(np.sqrt(np.mean(field**2) * 3))
        if size > 0:
            found.append(field / size)
            fineness.append((order, wave))

    for order in range(1, orders + 1):
        power = order * (radius / scale) ** (order - 1)
        for phase in (0.0, np.pi / 2):
            add(power * np.cos(order * angle - phase), -power * np.sin(order * angle - phase),
                0 * radius, order, 0)
    add(0 * radius, 0 * radius, np.ones_like(radius), 0, 0)
    for wave in range(1, (in_plane if flat else waves) + 1):
        k = wave * np.pi / length
        for order in range(orders + 1):
            bessel, slope = special.iv(order, k * radius), special.ivp(order, k * radius)
            over = np.where(radius > 0, bessel / np.maximum(radius, 1e-12),
                            k / 2 if order == 1 else 0.0)
            for phase in (0.0, np.pi / 2)[:1 + (order > 0)]:
                turn, sine = np.cos(order * angle - phase), -np.sin(order * angle - phase)
                for shift in (0.0, np.pi / 2):
                    wave_z, slope_z = np.cos(k * z - shift), -np.sin(k * z - shift)
                    add(k * slope * turn * wave_z, order * over * sine * wave_z,
                        k * bessel * turn * slope_z, order, wave)
    return SmoothTerms(np.array(found), np.array(fineness, float))


def fields_of_rms(terms: SmoothTerms, size: float) -> Floats:
    """Return fields (k, n, 3) whose sum has an rms of ``size`` in each component.

    The amplitudes of the sum are independent with a standard deviation of 1. Finer terms are
    smaller by the first of `DECAY_RATES`.
    """
    weights = np.exp(-terms.fineness @ DECAY_RATES[0])
    weights *= np.sqrt(3) * size / np.linalg.norm(weights)
    return weights[:, None, None] * terms.fields


def sensor_errors(points: Floats, orders: int = 3, waves: int = 8) -> SmoothTerms:
    """Return smooth errors at the points, of one component each with an rms of sqrt(3).

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    orders : int
        Largest azimuthal order.
    waves : int
        Largest number of half waves over the length of the map.
    """
    angle = np.arctan2(points[:, 1], points[:, 0])
    z = points[:, 2] - points[:, 2].mean()
    length = max(np.ptp(z), 1e-9)
    found: list[Floats] = []
    fineness: list[tuple[int, int]] = []
    for wave in range(1 if is_in_plane(points) else waves + 1):
        for shift in (0.0, np.pi / 2)[:1 + (wave > 0)]:
            along = np.cos(wave * np.pi * z / length - shift)
            for order in range(orders + 1):
                for phase in (0.0, np.pi / 2)[:1 + (order > 0)]:
                    shape = along * np.cos(order * angle - phase)
                    shape = shape / max(float(np.sqrt(np.mean(shape**2))), 1e-12)
                    for axis in np.eye(3):
                        found.append(np.sqrt(3) * shape[:, None] * axis)
                        fineness.append((order, wave))
    return SmoothTerms(np.array(found), np.array(fineness, float))

