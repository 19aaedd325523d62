"""Closed forms for infinitely long arrays of sectors: the oracle that solves are checked against.

Imports nothing of this package on purpose: it must not share a mistake with what it checks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats

Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class SectorMagnetization:
    """A uniformly magnetized sector: angles in rad, remanence as ``B_rx + i B_ry`` in T."""

    middle: float
    half_width: float
    remanence: complex


def ideal_sectors(
    multipole_order: int, blocks: int, remanence: float,
    first_angle: float = 0.0, first_magnetization_angle: float = 0.0,
) -> list[SectorMagnetization]:
    """Sectors of a Halbach array without gaps (K. Halbach, NIM 169 (1980) 1); angles in rad."""
    pitch = 2 * np.pi / blocks
    return [
        SectorMagnetization(first_angle + i * pitch, pitch / 2,
               remanence * np.exp(1j * (first_magnetization_angle
                                        + (1 + multipole_order) * i * pitch)))
        for i in range(blocks)
    ]


def bore_field(
    sectors: list[SectorMagnetization], inner_radius: float, outer_radius: float, points: Floats,
    terms: int = 400,
) -> Floats:
    """Field in the bore of sectors of recoil permeability 1.

    The line dipole j dA at z' has ``B_x - i B_y = j / (2 pi (z - z')^2)``; integrating its
    expansion in z/z' over each sector gives the multipoles in closed form.

    Parameters
    ----------
    inner_radius, outer_radius : float
        In m.
    points : ndarray, shape (n, 2), in m
        Inside the inner radius.
    terms : int
        Multipoles summed; the error falls as (r / inner_radius)^terms.

    Returns
    -------
    ndarray, shape (n, 2), in T
    """
    k = np.arange(1, terms + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # radii over the inner one, so that nothing overflows
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


def layered_bore_field(
    sectors: list[SectorMagnetization], inner_radius: float, outer_radius: float,
    recoil_permeability: float,
    points: Floats, iron: tuple[float, float, float] | None = None, terms: int = 200,
) -> Floats:
    """Field in the bore of a closed ring of sectors of any permeability, with an iron tube.

    Harmonic by harmonic the scalar potential is ``a r^k + b r^-k`` in every layer, plus in the
    magnet a particular solution of ``mu_r lap(psi) = div B_r``; tangential H and normal B are
    continuous at each radius.

    Parameters
    ----------
    sectors : list of Sector
        Without gaps between them.
    inner_radius, outer_radius : float
        Of the magnets, in m.
    recoil_permeability : float
    points : ndarray, shape (n, 2), in m
        In the bore.
    iron : (inner radius in m, outer radius in m, relative permeability), optional
    terms : int
        Harmonics summed.

    Returns
    -------
    ndarray, shape (n, 2), in T
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
    rho = np.hypot(points[:, 0], points[:, 1]) / inner_radius
    theta = np.arctan2(points[:, 1], points[:, 0])
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
    """Solve harmonic k for the coefficient of r^k in the bore; radii over the inner one."""
    radial = _harmonic(sectors, k, 0)
    divergence = radial + 1j * k * _harmonic(sectors, k, 1)
    scale = divergence / permeability[1]

    def particular(x: float) -> tuple[complex, complex]:
        """psi_p and its derivative."""
        if k == 1:
            return scale * x * np.log(x) / 2, scale * (np.log(x) + 1) / 2
        return scale * x / (1 - k**2), scale / (1 - k**2)

    # Unknowns: bore a; layer i (1..): a_i, b_i with (r/r_i)^k, (r_{i-1}/r)^k; outside b.
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
    """Coefficient of e^(ik theta) in the radial (0) or tangential (1) remanence."""
    total = 0j
    for sector in sectors:
        # radial + i tangential = j e^(-i theta); the real function needs both conjugate halves
        plus = _sector_integral(sector, k + 1) * sector.remanence
        minus = _sector_integral(sector, k - 1) * sector.remanence.conjugate()
        total += (plus + minus) / 2 if part == 0 else (plus - minus) / 2j
    return total


def _sector_integral(sector: SectorMagnetization, order: int) -> complex:
    """1/2pi times the integral of e^(-i order theta) over a sector."""
    width = (2 * sector.half_width if order == 0
             else 2 * np.sin(order * sector.half_width) / order)
    return complex(width * np.exp(-1j * order * sector.middle) / (2 * np.pi))
