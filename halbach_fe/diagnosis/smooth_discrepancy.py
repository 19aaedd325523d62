"""What no effect explains: smooth fields of any kind, and smooth errors of a sensor of any kind.

A field whose sources are outside the bore is ``-grad phi`` with ``phi`` harmonic: modified Bessel
functions times ``cos n phi``, ``cos k z`` and their sines, and polynomials that do not depend on z
(J. D. Jackson, Classical Electrodynamics, 3rd ed., section 3.7). Errors of a sensor need not be
one: each component is a Fourier series in z and angle by itself. Both have many terms with
amplitudes of one unknown scale, smaller for finer ones, and the evidence is averaged over the
scale; so a named effect with one amplitude, where it explains as much, is the better explanation.

The solver's own error is such a field as well, smooth and of a size that is known: no effect may be
named for what it can explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Evidence

SCALES = np.geomspace(0.1, 300, 15)
"""Of the amplitudes, over the noise of a reading."""

DECAYS = ((0.25, 0.125), (1.0, 0.4), (2.0, 1.0))
"""Of the logarithm of amplitudes, per order in angle and per half wave in z."""


@dataclass(frozen=True)
class SmoothDiscrepancy:
    """How well one kind of smooth field explains a residual.

    Attributes
    ----------
    log_bayes_factor : float
        Over nothing, averaged over the scale.
    scale : float
        The likeliest, over the noise of a reading.
    mean : ndarray, shape (k,)
        Its amplitudes, of the columns as they were given.
    """

    log_bayes_factor: float
    scale: float
    mean: Floats


@dataclass(frozen=True)
class SmoothTerms:
    """Fields (k, n, 3) of rms 1 over a map, and the order and half waves (k, 2) of each."""

    fields: Floats
    fineness: Floats


def judge_smooth_terms(evidence: Evidence, fineness: Floats) -> SmoothDiscrepancy:
    """Evidence of all columns together, their amplitudes having one unknown scale and decay."""
    found, means = [], []
    for decay in DECAYS:
        weights = np.exp(-fineness @ decay)
        values, vectors = np.linalg.eigh(weights[:, None] * evidence.information * weights)
        values, score = np.maximum(values, 0.0), vectors.T @ (weights * evidence.score)
        for scale in SCALES:
            shrunk = scale**2 * score / (1 + scale**2 * values)
            found.append((score @ shrunk - np.log1p(scale**2 * values).sum()) / 2)
            means.append(weights * (vectors @ shrunk))
    best = int(np.argmax(found))
    return SmoothDiscrepancy(float(special.logsumexp(found) - np.log(len(found))),
                       float(SCALES[best % len(SCALES)]), means[best])


def harmonic_fields(points: Floats, orders: int = 6, waves: int = 10) -> SmoothTerms:
    """Fields without sources at points (n, 3) in m.

    ``orders`` is the largest n, ``waves`` the number of half waves over the length of the map.
    """
    radius = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(points[:, 1], points[:, 0])
    z = points[:, 2] - points[:, 2].mean()
    length = max(np.ptp(z), 1e-9) * 1.2  # beyond the map, lest it be periodic there
    scale = max(radius.max(), 1e-9)
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
    for wave in range(1, waves + 1 if np.ptp(z) else 1):
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


def of_size(terms: SmoothTerms, size: float) -> Floats:
    """Fields (k, n, 3) whose amplitudes of standard deviation 1, finer ones smaller, make an rms of
    ``size`` in each component.
    """
    weights = np.exp(-terms.fineness @ DECAYS[0])
    weights *= np.sqrt(3) * size / np.linalg.norm(weights)
    return weights[:, None, None] * terms.fields


def sensor_errors(points: Floats, orders: int = 3, waves: int = 8) -> SmoothTerms:
    """Errors of each component by itself at points (n, 3) in m."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    z = points[:, 2] - points[:, 2].mean()
    length = max(np.ptp(z), 1e-9)
    found: list[Floats] = []
    fineness: list[tuple[int, int]] = []
    for wave in range(waves + 1 if np.ptp(z) else 1):
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

