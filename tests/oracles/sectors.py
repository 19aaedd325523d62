"""The field in the bore of an array of sectors in vacuum, as a sum of multipoles in closed form."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.solver.ring_harmonics_2d import SectorMagnetization


def bore_field(
    sectors: list[SectorMagnetization], inner_radius: float, outer_radius: float, points: Floats,
    terms: int = 400,
) -> Floats:
    """B (n, 2) in T in the bore of an array of sectors of recoil permeability 1.

    A line dipole of remanence j times area dA at z' has ``B_x - i B_y = j dA / (2 pi (z - z')^2)``.
    Integrating its expansion in powers of z/z' over each sector gives the multipoles in closed
    form.

    Parameters
    ----------
    inner_radius, outer_radius : float
        Radii of the sectors in m.
    points : ndarray, shape (n, 2), in m
        Inside the inner radius.
    terms : int
        Number of multipoles; the truncation error falls as (r / inner_radius)^terms.
    """
    k = np.arange(1, terms + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # radii relative to the inner radius, so that no power overflows
        radial = (1 - (outer_radius / inner_radius) ** (1.0 - k)) / (k - 1)
    radial[0] = np.log(outer_radius / inner_radius)
    coefficient = np.zeros(terms, complex)
    for sector in sectors:
        angular = 2 * np.sin((k + 1) * sector.half_width) / (k + 1)
        phase = np.exp(-1j * (k + 1) * sector.middle)
        coefficient += sector.remanence * k * radial * angular * phase / (2 * np.pi)
    z = (points[:, 0] + 1j * points[:, 1]) / inner_radius
    conjugate = np.polynomial.polynomial.polyval(z, coefficient)
    return np.column_stack([conjugate.real, -conjugate.imag])
