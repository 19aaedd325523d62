"""Field of coils in vacuum, by Biot and Savart's law in closed forms.

A round coil is the sum over radii, by Gauss-Legendre quadrature, of thin solenoids (N. Derby, S.
Olbert, Am. J. Phys. 78 (2010) 229, with Carlson's integrals) or, without a length, of loops (J. D.
Jackson, Classical Electrodynamics, 3rd ed., section 5.5). Other coils are filaments of straight
segments (J. D. Hanson, S. P. Hirshman, Phys. Plasmas 9 (2002) 4410). For points nearer than half a
side of the section the winding is halved across that side, again and again, until 8 radii, or 4 x 4
filaments, serve for each part; corners near a point have more chords than 12.

Against many more loops the field of a round coil was measured to be 1e-6 of the largest one off at
1 mm from a winding of 20 mm, and that of racetracks, with round corners of 100 mm, 5e-4 from 0.1 to
20 mm. Beside the thin wire of such a corner it is 1e-3 at 1 mm, and 4e-3 at 0.1 mm. `closest` says
where windings begin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from halbach_fe.core.arrays import Floats, slices, unit_circle
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.coils import closed_polygon, closest, distance, turn_corners
from halbach_fe.study.magnet import AnyCoil, Racetrack, RoundCoil
from halbach_fe.study.materials import MU_0


def coil_field(coil: AnyCoil, points: Floats, name: str) -> Floats:
    """Return B (n, 3) in T of a coil of study ``name`` at points (n, 3) in m.

    Raises
    ------
    StudyError
        If a point lies in the winding, or nearer to it than `closest`.
    """
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    own = (points - coil.centre_m) @ axes
    near = np.flatnonzero(distance(coil, own) < closest(coil))
    if len(near):
        x, y, z = points[near[0]]
        raise StudyError(must_be(
            "`external.coils`", f"study {name}", "clear of readings, blocks and iron",
            f"a coil ({coil.kind}) whose winding holds, or all but touches, the point ({x:g}, "
            f"{y:g}, {z:g}) m", "Move the coil, or what is in its winding; they must stay "
            f"{1e3 * closest(coil):.2g} mm apart."))
    current = MU_0 * coil.current_A * coil.turns
    if coil.kind == "polygon":
        found = _straight(np.ones(1), closed_polygon(coil)[None], own)
    else:
        found = _round(coil, own) if coil.kind == "round" else _racetrack(coil, own)
    return np.asarray(current * found @ axes.T)


def _gauss(side: float, count: int) -> tuple[Floats, Floats]:
    """Return places in m across a side and their weights, which add up to 1."""
    if not side:
        return np.zeros(1), np.ones(1)
    places, weights = np.polynomial.legendre.leggauss(count)
    return places * side / 2, weights / 2


def _round(coil: RoundCoil, points: Floats) -> Floats:
    """Return B (n, 3) of a round coil of mu_0 N I = 1 at points in its own axes."""
    near = distance(coil, points) < coil.section_m[0] / 2
    found = np.zeros((len(points), 3))
    found[~near] = _thin_solenoids(coil, points[~near])
    if near.any():
        width, length = coil.section_m
        for offset in (-width / 4, width / 4):
            half = coil.model_copy(update={
                "section_m": (width / 2, length), "radius_m": coil.radius_m + offset})
            found[near] += _round(half, points[near]) / 2
    return found


def _thin_solenoids(coil: RoundCoil, points: Floats) -> Floats:
    """Return B (n, 3) of a round coil as the sum over 8 radii."""
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


def _racetrack(coil: Racetrack, points: Floats, chords: int = 12) -> Floats:
    """Return B (n, 3) of a racetrack of mu_0 N I = 1 at points in its own axes."""
    radius = coil.corner_radius_m + coil.section_m[0] / 2
    chord = np.pi / 2 / chords * radius
    # Chords serve at twice their length, or where the point is 100 times as far from them as the
    # arc, chord^2 / (8 radius).
    needed = np.array([*np.array(coil.section_m) / 2,
                       min(2 * chord, 12.5 * chord**2 / (radius or 1.0))])
    side = int(needed.argmax())
    near = distance(coil, points) < needed[side]
    found = np.zeros((len(points), 3))
    found[~near] = _straight(*_filaments(coil, chords), points[~near])
    if near.any() and side == 2:
        found[near] = _racetrack(coil, points[near], 2 * chords)
    elif near.any():
        for sign in (-1, 1):
            half, place = _half(coil, side, sign)
            found[near] += _racetrack(half, points[near] - place, chords) / 2
    return found


def _half(coil: Racetrack, side: int, sign: int) -> tuple[Racetrack, Floats]:
    """Return the half of a racetrack on one side of its section's middle, and its place (3,)."""
    section = np.array(coil.section_m)
    section[side] /= 2
    offset = sign * section[side] / 2
    changes: dict[str, object] = {"section_m": tuple(section.tolist())}
    if side == 0:
        changes |= {"corner_radius_m": coil.corner_radius_m + offset,
                    "size_m": tuple(size + 2 * offset for size in coil.size_m)}
    return coil.model_copy(update=changes), np.array([0.0, 0.0, side * offset])


def _filaments(coil: Racetrack, chords: int) -> tuple[Floats, Floats]:
    """Return closed filaments: their shares (k,) of the current, and corners (k, m, 3) in m."""
    shares, found = [], []
    for across, share in zip(*_gauss(coil.section_m[0], 4), strict=True):
        turn = turn_corners(coil, across, chords)
        for height, part in zip(*_gauss(coil.section_m[1], 4), strict=True):
            shares.append(share * part)
            found.append(turn + np.array([0.0, 0.0, height]))
    return np.array(shares), np.array(found)


def current_elements(coil: AnyCoil) -> tuple[Floats, Floats]:
    """Return places (n, 3) in m of pieces of a coil and I dl (n, 3) in A m, for forces on it."""
    longest = 1 / 100  # part of a turn that a piece may be
    turns: Sequence[Floats] | Floats
    if coil.kind == "polygon":
        shares, turns = np.ones(1), [closed_polygon(coil)]
    elif coil.kind == "racetrack":
        shares, turns = _filaments(coil, 12)
    else:
        angle = np.linspace(0, 2 * np.pi, round(1 / longest) + 1)
        circle = unit_circle(angle)
        # a polygon of the same area
        circle *= np.sqrt(angle[1] / np.sin(angle[1]))
        rules = [_gauss(side, 4) for side in coil.section_m]
        shares = np.outer(*(rule[1] for rule in rules)).ravel()
        turns = [(coil.radius_m + across) * circle + np.array([0.0, 0.0, height])
                 for across in rules[0][0] for height in rules[1][0]]
    places, along = [], []
    for share, turn in zip(shares, turns, strict=True):
        sides = np.diff(turn, axis=0)
        lengths = np.linalg.norm(sides, axis=1)
        counts = np.maximum(np.ceil(lengths / (longest * lengths.sum())).astype(int), 1)
        number = np.repeat(np.arange(len(sides)), counts)
        within = (np.arange(len(number)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5)
        places.append(turn[number] + (within / counts[number])[:, None] * sides[number])
        along.append(share * sides[number] / counts[number][:, None])
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    return (np.vstack(places) @ axes.T + coil.centre_m,
            coil.current_A * coil.turns * np.vstack(along) @ axes.T)


def _straight(shares: Floats, corners: Floats, points: Floats) -> Floats:
    """Return B (n, 3) of filaments of mu_0 I = 1, shares (k,) and corners (k, m, 3) in m."""
    starts, along = corners[:, :-1].reshape(-1, 3), np.diff(corners, axis=1).reshape(-1, 3)
    lengths = np.linalg.norm(along, axis=1)
    share = np.repeat(shares, corners.shape[1] - 1)[lengths > 0]
    starts, along, lengths = (part[lengths > 0] for part in (starts, along, lengths))
    found = np.zeros((len(points), 3))
    at_once = max(1, 100_000 // len(starts))  # so that arrays stay in the cache
    for some in slices(len(points), at_once):
        x, y, z = (points[some, None, i] - starts[:, i] for i in range(3))
        u, v, w = along.T
        near = np.sqrt(x**2 + y**2 + z**2)
        far = np.sqrt((x - u)**2 + (y - v)**2 + (z - w)**2)
        total = near + far
        factor = share * 2 * total / (near * far * (total**2 - lengths**2))
        found[some] = np.column_stack([
            np.einsum("nm,nm->n", factor, part)
            for part in (v * z - w * y, w * x - u * z, u * y - v * x)])
    return found / (4 * np.pi)
