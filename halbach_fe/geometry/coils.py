"""Places of the windings of coils, to keep readings, blocks and iron clear of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from halbach_fe.core.arrays import Floats, Ints, unit_circle
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.study.external_keys import AnyCoil, PolygonCoil, Racetrack, RoundCoil


def closest(coil: AnyCoil) -> float:
    """Return the distance in m from a winding below which its field is not computed."""
    nearest_probe_m, of_section = 1e-6, 1e-4  # a winding is halved 13 times for the latter
    return max(nearest_probe_m,
               0.0 if coil.kind == "polygon" else of_section * max(coil.section_m))


def distance(coil: AnyCoil, points: Floats) -> Floats:
    """Return distances (n,) in m of points (n, 3) in its own axes from a coil.

    They are negative in its winding.
    """
    if coil.kind == "polygon":
        return np.min([_from_segment(points, *ends) for ends in pairwise(closed_polygon(coil))],
                      axis=0)
    if coil.kind == "round":
        across = np.hypot(*points[:, :2].T) - coil.radius_m
    else:
        beyond = np.abs(points[:, :2]) - np.array(coil.size_m) / 2 + coil.corner_radius_m
        across = np.hypot(*np.maximum(beyond, 0.0).T) + np.minimum(
            beyond.max(axis=1), 0.0) - coil.corner_radius_m
    apart = np.abs(np.column_stack([across, points[:, 2]])) - np.array(coil.section_m) / 2
    return np.asarray(np.hypot(*np.maximum(apart, 0.0).T) + np.minimum(apart.max(axis=1), 0.0))


def _from_segment(points: Floats, start: Floats, end: Floats) -> Floats:
    """Return distances (n,) of points (n, 3) from a straight segment."""
    along = end - start
    share = np.clip((points - start) @ along / (float(along @ along) or 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


def closed_polygon(coil: PolygonCoil) -> Floats:
    """Return the corners (m + 1, 3) in m of a polygon, the first one again at the end."""
    return np.array([*coil.points_m, coil.points_m[0]])


def turn_corners(coil: Racetrack, across: float, chords: int) -> Floats:
    """Return the corners (m, 3) in m of a closed turn of a racetrack, ``across`` m off the middle.

    An arc becomes ``chords`` chords around the same area.
    """
    step = np.pi / 2 / chords
    # radius of the inner corners of the chords, relative to that of the arc, for the same area
    wider = (np.sqrt(1 + (chords - 2) * chords * step / np.sin(step)) - 1) / (chords - 2)
    radii = np.array([1.0, *(wider,) * (chords - 1), 1.0])
    middle = np.array(coil.size_m) / 2 - coil.corner_radius_m
    corners = [np.array(sign) * middle + (coil.corner_radius_m + across) * radii[:, None]
               * unit_circle(angle)[:, :2]
               for number, sign in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)])
               for angle in [np.pi / 2 * number + step * np.arange(chords + 1)]]
    turn = np.vstack([*corners, corners[0][:1]])
    return np.column_stack([turn, np.zeros(len(turn))])


def distance_in_magnet(coil: AnyCoil, points: Floats) -> Floats:
    """Return the `distance` (n,) in m of points (n, 3) in m of the magnet from a coil."""
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    return distance(coil, (points - coil.centre_m) @ axes)


def in_winding(coil: AnyCoil, points: Floats) -> Ints:
    """Return which points (n, 3) in m of the magnet lie in a winding, and not at its surface."""
    if coil.kind == "polygon" or not all(coil.section_m):
        return np.zeros(0, int)
    return np.flatnonzero(distance_in_magnet(coil, points) < -closest(coil))


def distance_from_axis(coil: AnyCoil, accuracy: float) -> float:
    """Return the distance in m of a winding from the z axis, too large by at most the accuracy.

    It is negative if the axis runs through the winding. Of the axis all parts are halved that may
    be nearer to the winding than what was found.
    """
    middle = np.array(coil.centre_m)
    half = 2 * float(np.linalg.norm(points_in_winding(coil) - middle, axis=1).max())
    nearest, heights = np.inf, middle[2:]
    while len(heights):
        apart = distance_in_magnet(coil, heights[:, None] * [0.0, 0.0, 1.0])
        nearest = min(nearest, float(apart.min()))
        half /= 2
        heights = (heights[apart - 2 * half < nearest - accuracy, None] + [-half, half]).ravel()
    return nearest


def crosses_disc(coil: AnyCoil, radius: float, z: float) -> bool:
    """Return whether a winding comes within 1/200 of its radius to a flat disc about the z axis.

    Squares of the disc at ``z`` in m that the winding does not reach are left out, and the others
    quartered.
    """
    half, places = radius, np.zeros((1, 2))
    while len(places):
        off_axis = np.hypot(*places.T)
        apart = distance_in_magnet(coil, np.column_stack([places, np.full(len(places), z)]))
        if half < radius / 400 or ((apart <= 0) & (off_axis <= radius)).any():
            return True
        corner = np.sqrt(2) * half
        near = places[(apart < corner) & (off_axis < radius + corner)]
        half /= 2
        places = (near[:, None] + half * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])).reshape(
            -1, 2)
    return False


def points_in_winding(coil: AnyCoil) -> Floats:
    """Return points (n, 3) in m of the magnet all along a winding: in its middle and its edges."""
    at = np.linspace(0.0, 1.0, POINTS_OF_TURN)
    return _from_axes(coil, np.vstack([turn(at) for _, turn in _turns(coil)]))


def runs_into(coil: AnyCoil, distance: Callable[[Floats], Floats], apart: float) -> bool:
    """Tell whether a turn of a winding runs through something.

    ``distance`` takes points (n, 3) in m and returns (n,) in m how far it is away at least,
    negative within it. Pieces of turns that cannot reach it are left out, and the others halved
    until they are ``apart`` m long.
    """
    pieces = POINTS_OF_TURN - 1
    for length, turn in _turns(coil):
        half = 1 / (2 * pieces)
        middle = np.asarray(half * (1.0 + 2.0 * np.arange(pieces)), float)
        while len(middle):
            off = distance(_from_axes(coil, turn(middle)))
            if (off < 0).any():
                return True
            if half * length < apart / 2:
                break
            middle, half = middle[off <= half * length], half / 2
            middle = np.concatenate([middle - half, middle + half])
    return False


def _from_axes(coil: AnyCoil, points: Floats) -> Floats:
    """Return points (n, 3) in m of the magnet from those in the coil's own axes."""
    return np.asarray(points @ rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist())).T
                      + coil.centre_m)


POINTS_OF_TURN = 200
"""Points of a turn by which windings are first seen; near bodies they lie closer."""

Turn = Callable[[Floats], Floats]
"""Takes places (n,) from 0 to 1 along a closed turn, and returns points (n, 3) in m."""


def _turns(coil: AnyCoil) -> list[tuple[float, Turn]]:
    """Return the lengths in m of turns in the middle of a winding and its edges, and the turns."""
    if coil.kind == "polygon":
        return [_polygon(closed_polygon(coil))]
    # bodies in a thick winding hold points in it themselves, those that a sheet cuts do not
    just_inside = np.linspace(-0.49, 0.49, 3 if all(coil.section_m) else 97)
    return [_arcs(coil, across, height)
            for across in np.unique(just_inside * coil.section_m[0]).tolist()
            for height in np.unique(just_inside * coil.section_m[1]).tolist()]


def _arcs(coil: RoundCoil | Racetrack, across: float, height: float) -> tuple[float, Turn]:
    """Return a turn ``across`` and ``height`` m off the middle of the section, and its length.

    Points lie on its arcs, not on chords: those would reach into what touches the winding.
    """
    if coil.kind == "round":
        middle, radius = np.zeros(2), coil.radius_m + across
    else:
        middle = np.array(coil.size_m) / 2 - coil.corner_radius_m
        radius = coil.corner_radius_m + across
    centres = np.array([(1, 1), (1, 1), (-1, 1), (-1, 1), (-1, -1), (-1, -1), (1, -1), (1, -1),
                        (1, 1)]) * middle
    angles = np.pi / 2 * np.array([0, 1, 1, 2, 2, 3, 3, 4, 4])
    place = np.cumsum([0.0, *np.linalg.norm(np.diff(centres, axis=0), axis=1)
                       + radius * np.diff(angles)])

    def turn(at: Floats) -> Floats:
        angle, x, y = (np.interp(at * place[-1], place, part) for part in (angles, *centres.T))
        return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle),
                                np.full(len(at), height)])

    return float(place[-1]), turn


def _polygon(corners: Floats) -> tuple[float, Turn]:
    """Return a closed line with the corners (m, 3), and its length in m."""
    place = np.cumsum([0.0, *np.linalg.norm(np.diff(corners, axis=0), axis=1)])
    return float(place[-1]), lambda at: np.column_stack([
        np.interp(at * place[-1], place, part) for part in corners.T])
