"""Field of coils in vacuum, by Biot and Savart's law in closed forms.

A round coil is the sum over radii, by Gauss-Legendre quadrature, of thin solenoids (N. Derby, S.
Olbert, Am. J. Phys. 78 (2010) 229, with Carlson's integrals) or, without a length, of loops (J. D.
Jackson, Classical Electrodynamics, 3rd ed., section 5.5). Other coils are filaments of straight
segments (J. D. Hanson, S. P. Hirshman, Phys. Plasmas 9 (2002) 4410). At a distance of half the
larger side of a section, the sum over it was measured to be 2e-8 of the largest field off with 8
radii, and 3e-4 with 4 x 4 filaments and the chords of corners.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import special

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.study.magnet import AnyCoil, PolygonCoil, Racetrack, RoundCoil
from halbach_fe.study.materials import MU_0


def coil_field(coil: AnyCoil, points: Floats, name: str) -> Floats:
    """Return B (n, 3) in T of a coil of study ``name`` at points (n, 3) in m.

    Raises
    ------
    StudyError
        If a point lies in the winding.
    """
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    own = (points - coil.centre_m) @ axes
    closest_m = 1e-6  # nearer than any probe can be
    inside = np.flatnonzero(distance(coil, own) < closest_m)
    if len(inside):
        x, y, z = points[inside[0]]
        raise StudyError(must_be(
            "`external.coils`", f"study {name}", "clear of readings, blocks and iron",
            f"a coil ({coil.kind}) whose winding holds the point ({x:g}, {y:g}, {z:g}) m",
            "Move the coil, or what is in its winding."))
    current = MU_0 * coil.current_A * coil.turns
    found = _round(coil, own) if coil.kind == "round" else _straight(_filaments(coil), own)
    return np.asarray(current * found @ axes.T)


def distance(coil: AnyCoil, points: Floats) -> Floats:
    """Return distances (n,) in m of points (n, 3) in its own axes from a coil; 0 in its winding."""
    if coil.kind == "polygon":
        return np.min([_from_segment(points, *ends) for ends in pairwise(_closed(coil))], axis=0)
    if coil.kind == "round":
        across = np.hypot(*points[:, :2].T) - coil.radius_m
    else:
        beyond = np.abs(points[:, :2]) - np.array(coil.size_m) / 2 + coil.corner_radius_m
        across = np.hypot(*np.maximum(beyond, 0.0).T) + np.minimum(
            beyond.max(axis=1), 0.0) - coil.corner_radius_m
    apart = np.abs(np.column_stack([across, points[:, 2]])) - np.array(coil.section_m) / 2
    return np.asarray(np.hypot(*np.maximum(apart, 0.0).T))


def _from_segment(points: Floats, start: Floats, end: Floats) -> Floats:
    """Return distances (n,) of points (n, 3) from a straight segment."""
    along = end - start
    share = np.clip((points - start) @ along / (float(along @ along) or 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


def _gauss(side: float, count: int) -> tuple[Floats, Floats]:
    """Return places in m across a side and their weights, which add up to 1."""
    if not side:
        return np.zeros(1), np.ones(1)
    places, weights = np.polynomial.legendre.leggauss(count)
    return places * side / 2, weights / 2


def _round(coil: RoundCoil, points: Floats) -> Floats:
    """Return B (n, 3) of a round coil of mu_0 N I = 1 at points in its own axes."""
    rho, z = np.hypot(*points[:, :2].T), points[:, 2]
    half = coil.section_m[1] / 2
    along_rho, along_z = np.zeros(len(points)), np.zeros(len(points))
    for offset, weight in zip(*_gauss(coil.section_m[0], 8), strict=True):
        part = (_sheet(coil.radius_m + offset, half, rho, z) if half
                else _loop(coil.radius_m + offset, rho, z))
        along_rho += weight * part[0]
        along_z += weight * part[1]
    direction = points[:, :2] / np.maximum(rho, 1e-300)[:, None]
    return np.column_stack([along_rho[:, None] * direction, along_z])


def _loop(radius: float, rho: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return B_rho and B_z (n,) of a loop of mu_0 I = 1."""
    far, near = (radius + rho) ** 2 + z**2, (radius - rho) ** 2 + z**2
    first, second = special.ellipkm1(near / far), special.ellipe(1 - near / far)
    scale = 1 / (2 * np.pi * np.sqrt(far))
    square = rho**2 + z**2
    on_axis = rho < 1e-9 * radius
    along_rho = scale * z / np.where(on_axis, 1.0, rho) * (
        (radius**2 + square) / near * second - first)
    return np.where(on_axis, 0.0, along_rho), scale * (
        first + (radius**2 - square) / near * second)


def _sheet(radius: float, half: float, rho: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return B_rho and B_z (n,) of a thin solenoid with mu_0 N I = 1, ``half`` as long as it is."""
    ratio = (radius - rho) / (radius + rho)
    ratio = np.where(np.abs(ratio) < 1e-10, 1e-10, ratio)  # its limit, beyond the ends
    found = np.zeros((2, len(rho)))
    for sign in (1.0, -1.0):
        end = z + sign * half
        far = end**2 + (radius + rho) ** 2
        square = (end**2 + (radius - rho) ** 2) / far
        first = special.elliprf(0.0, square, 1.0)
        found[0] += sign * radius / np.sqrt(far) * (
            first - 2 / 3 * special.elliprd(0.0, square, 1.0))
        found[1] += sign * end / np.sqrt(far) * radius / (radius + rho) * (
            first + (ratio - ratio**2) / 3 * special.elliprj(0.0, square, 1.0, ratio**2))
    along_rho, along_z = found / (2 * np.pi * half)
    return along_rho, along_z


def _closed(coil: PolygonCoil) -> Floats:
    """Return the corners (m + 1, 3) in m of a polygon, the first one again at the end."""
    return np.array([*coil.points_m, coil.points_m[0]])


def _filaments(coil: Racetrack | PolygonCoil) -> list[tuple[float, Floats]]:
    """Return closed filaments: their shares of the current, and corners (m, 3) in m."""
    if coil.kind == "polygon":
        return [(1.0, _closed(coil))]
    chords = 12
    step = np.pi / 2 / chords
    # radius of the inner corners of the chords, relative to that of the arc, for the same area
    wider = (np.sqrt(1 + (chords - 2) * chords * step / np.sin(step)) - 1) / (chords - 2)
    radii = np.array([1.0, *(wider,) * (chords - 1), 1.0])
    middle = np.array(coil.size_m) / 2 - coil.corner_radius_m
    found = []
    for across, share in zip(*_gauss(coil.section_m[0], 4), strict=True):
        corners = [np.array(sign) * middle + (coil.corner_radius_m + across) * radii[:, None]
                   * np.column_stack([np.cos(angle), np.sin(angle)])
                   for number, sign in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)])
                   for angle in [np.pi / 2 * number + step * np.arange(chords + 1)]]
        turn = np.vstack([*corners, corners[0][:1]])
        for height, part in zip(*_gauss(coil.section_m[1], 4), strict=True):
            found.append((share * part, np.column_stack([turn, np.full(len(turn), height)])))
    return found


def _straight(filaments: list[tuple[float, Floats]], points: Floats) -> Floats:
    """Return B (n, 3) of filaments of mu_0 I = 1 at points (n, 3) in m in their axes."""
    found = np.zeros((len(points), 3))
    for share, corners in filaments:
        for start, end in pairwise(corners):
            length = float(np.linalg.norm(end - start))
            if not length:
                continue
            first, last = points - start, points - end
            near, far = np.linalg.norm(first, axis=1), np.linalg.norm(last, axis=1)
            factor = share * 2 * (near + far) / (near * far * ((near + far) ** 2 - length**2))
            found += factor[:, None] * np.cross(end - start, first)
    return found / (4 * np.pi)
