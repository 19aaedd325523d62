"""Closed-form fields of infinitely long arrays of sectors, to check finite-element solves against.

The problem is two-dimensional magnetostatics without currents: div B = 0 and curl H = 0, with
B = mu_0 mu_r H + B_r in the magnets. Complex numbers stand for vectors of the cross-section.

This module imports nothing from this package but `halbach_fe.core`, on purpose: it must not share a
mistake with the code that it checks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, azimuths_of, radii_of

Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class SectorMagnetization:
    """A uniformly magnetized sector."""

    middle: float
    half_width: float
    """Azimuth of the sector's middle, and half of its opening angle, in rad."""
    remanence: complex
    """``B_rx + i B_ry`` in T."""


def ideal_sectors(
    multipole_order: int, blocks: int, remanence: float,
    first_angle: float = 0.0, first_magnetization_angle: float = 0.0,
) -> list[SectorMagnetization]:
    """Return the sectors of a Halbach array without gaps (K. Halbach, NIM 169 (1980) 1).

    Parameters
    ----------
    multipole_order : int
        1 is a dipole, 2 a quadrupole. The magnetization turns by 1 + this order times the azimuth.
    blocks : int
        Number of sectors.
    remanence : float
        In T.
    first_angle, first_magnetization_angle : float
        Azimuth of the first sector's middle and direction of its remanence, in rad.
    """
    pitch = 2 * np.pi / blocks
    return [
        SectorMagnetization(first_angle + i * pitch, pitch / 2,
               remanence * np.exp(1j * (first_magnetization_angle
                                        + (1 + multipole_order) * i * pitch)))
        for i in range(blocks)
    ]


def layered_bore_field(
    sectors: list[SectorMagnetization], inner_radius: float, outer_radius: float,
    recoil_permeability: float,
    points: Floats, iron: tuple[float, float, float] | None = None, terms: int = 200,
) -> Floats:
    """Return B (n, 2) in T in a closed ring of sectors of any permeability, with an iron tube.

    The scalar potential psi (B = -mu_r grad psi + B_r) is solved for harmonic by harmonic. In every
    layer (bore, magnet, air, iron, outside) harmonic k is ``a r^k + b r^-k``, plus in the magnet a
    particular solution of ``mu_r lap(psi) = div B_r``. Tangential H and normal B are continuous at
    each radius, and psi vanishes at infinity.

    Parameters
    ----------
    sectors : list of SectorMagnetization
        Without gaps between them.
    inner_radius, outer_radius : float
        Radii of the magnets in m.
    recoil_permeability : float
        The same for all sectors.
    points : ndarray, shape (n, 2), in m
        In the bore.
    iron : (inner radius in m, outer radius in m, relative permeability), optional
        A tube around the magnets, with an air gap if its inner radius exceeds ``outer_radius``.
    terms : int
        Number of harmonics.
    """
    radii = [inner_radius, outer_radius]
    permeability = [1.0, recoil_permeability, 1.0]
    if iron is not None:
        if iron[0] > outer_radius:
            radii += [iron[0], iron[1]]
            permeability = [1.0, recoil_permeability, 1.0, iron[2], 1.0]
        else:
            radii += [iron[1]]
            permeability = [1.0, recoil_permeability, iron[2], 1.0]
    r = np.array(radii) / inner_radius
    rho = radii_of(points) / inner_radius
    theta = azimuths_of(points)
    field = np.zeros(len(points), complex)  # B_r + i B_theta
    for k in range(1, terms + 1):
        a = _bore_coefficient(sectors, r, permeability, k)
        # psi = 2 Re(a rho^k e^(ik theta)); B = -grad psi
        wave = a * rho ** (k - 1) * np.exp(1j * k * theta)
        field += 2 * (-k * wave.real) + 2j * (-(1j * k * wave).real)
    cartesian = field * np.exp(1j * theta)
    return np.column_stack([cartesian.real, cartesian.imag])


def _bore_coefficient(
    sectors: list[SectorMagnetization], r: Floats, permeability: list[float], k: int
) -> complex:
    """Solve harmonic k for the coefficient of r^k in the bore, with all radii over the inner one.

    The harmonic of psi is 2 Re(a rho^k e^(ik theta)) there. The two rows of the matrix at each
    interface are the continuity of psi (tangential H) and of -mu_r dpsi/dr + B_r (normal B).
    """
    radial = _harmonic(sectors, k, 0)
    divergence = radial + 1j * k * _harmonic(sectors, k, 1)
    scale = divergence / permeability[1]

    def particular(x: float) -> tuple[complex, complex]:
        """Return the particular solution in the magnet and its derivative at radius x."""
        if k == 1:
            return scale * x * np.log(x) / 2, scale * (np.log(x) + 1) / 2
        return scale * x / (1 - k**2), scale / (1 - k**2)

    # Unknowns: a in the bore; in layer i = 1, 2, ... a_i of (r/r_i)^k and b_i of (r_{i-1}/r)^k; b
    # outside. Scaled by the layer's own radii, the powers never exceed 1.
    layers = len(r) - 1
    size = 2 * len(r)
    matrix, right = np.zeros((size, size), complex), np.zeros(size, complex)
    for i, x in enumerate(r):
        for side, layer in ((1, i), (-1, i + 1)):
            mu = permeability[layer]
            if layer == 0:
                terms = [(0, 1.0, k / x)]
            elif layer == layers + 1:
                terms = [(size - 1, 1.0, -k / x)]
            else:
                inner, outer = r[layer - 1], r[layer]
                grow, fall = (x / outer) ** k, (inner / x) ** k
                terms = [(2 * layer - 1, grow, k * grow / x), (2 * layer, fall, -k * fall / x)]
            for column, value, slope in terms:
                matrix[2 * i, column] += side * value
                matrix[2 * i + 1, column] += side * -mu * slope
            if layer == 1:
                value_p, slope_p = particular(x)
                right[2 * i] -= side * value_p
                right[2 * i + 1] -= side * (-mu * slope_p + radial)
    return complex(np.linalg.solve(matrix, right)[0])


def _harmonic(sectors: list[SectorMagnetization], k: int, part: int) -> complex:
    """Return the coefficient of e^(ik theta) in the radial (part 0) or tangential (1) remanence."""
    total = 0j
    for sector in sectors:
        # radial + i tangential = j e^(-i theta): the radial part is half the sum of this expression
        # and its complex conjugate, the tangential part half the difference over i
        plus = _sector_integral(sector, k + 1) * sector.remanence
        minus = _sector_integral(sector, k - 1) * sector.remanence.conjugate()
        total += (plus + minus) / 2 if part == 0 else (plus - minus) / 2j
    return total


def _sector_integral(sector: SectorMagnetization, order: int) -> complex:
    """Return 1/2pi times the integral of e^(-i order theta) over the angles of a sector."""
    width = (2 * sector.half_width if order == 0
             else 2 * np.sin(order * sector.half_width) / order)
    return complex(width * np.exp(-1j * order * sector.middle) / (2 * np.pi))
