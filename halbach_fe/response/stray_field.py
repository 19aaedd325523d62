"""How far outside of a magnet its field is strong: the 0.5 mT line of rooms for MRI.

Outside of its sources every component of B is harmonic, so that |B| has no maximum there. The
largest |B| on a cylinder around the magnet therefore falls strictly with the cylinder's radius, and
that on the planes beyond both ends with their distance: the largest distances at which |B| reaches
a limit are roots of these functions, whatever lobes the field has.

The field is that of the magnet alone, without the study's external sources. Permeable blocks and
iron answer to the nominal magnet; what they answer to deviations from it is neglected, see
`halbach_fe.response.block_variation`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import PointsOutsideError
from halbach_fe.core.numbers import check_number
from halbach_fe.geometry.blocks import vector
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.block_variation import Deviations, distribution_of, with_magnetizations
from halbach_fe.solver.separate_blocks import applies, field_in_vacuum, solve_separate
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.external_keys import External

LIMIT_T = 5e-4
"""Flux density above which people with pacemakers must not be (IEC 60601-2-33): 5 gauss."""

NEAREST = 0.01
"""Distance from the cylinder around the magnet at which the search begins, relative to the radius
of the magnet. Nearer to the edges of blocks the field is strong in any magnet."""

DISTANCES: Floats = np.array([0.125, 0.25, 0.5, 1.0, 2.0])
"""Distances from the magnet with which the search begins, relative to its radius."""

Surface = Callable[[float | Floats, Floats], Floats]
"""Takes a distance in m from the cylinder around the magnet, and places (n, 2): angles about the
axis, and coordinates from -1 to 1. Returns points (n, 3) in m."""

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns B (n, 3) in T."""


@dataclass(frozen=True)
class Reach:
    """The largest distance at which |B| reaches the limit."""

    distance_m: float
    """From the z axis, or from the plane through the middle of the magnet across z."""
    sd_m: float
    """Its standard deviation, linearized; 0 for the nominal magnet."""
    at_m: tuple[float, float, float]
    """The point."""


@dataclass(frozen=True)
class StrayPlane:
    """|B| outside of the magnet in a plane through its middle."""

    across: str
    """The axis that is normal to the plane."""
    first_m: Floats
    second_m: Floats
    size_T: Floats
    """Coordinates along the other axes, in the order of x, y and z, and |B|: k curves around the
    magnet, from the nearest outwards, of which the last point is the first one again.
    Shape (k, m)."""


@dataclass(frozen=True)
class StrayField:
    """How far outside of a magnet |B| reaches a limit.

    Attributes
    ----------
    limit_T : float
    radius_m, half_length_m : float
        Of the smallest cylinder around the magnet that is symmetric about its middle.
    middle_z_m : float
        Place of that middle along z, see `halbach_fe.Magnet.middle_z_m`.
    radial, axial : Reach or None
        The largest distance from the z axis beside the magnet, and from the middle beyond its
        ends; None if |B| is below the limit wherever it is looked for, see `NEAREST`.
    planes : tuple of StrayPlane
        The planes across x, y and z.
    unknown : str
        Why the field outside is not computed; empty if it is.
    left_out : tuple of str
        The study's other sources, which are no part of it, in words.
    """

    limit_T: float
    radius_m: float
    half_length_m: float
    middle_z_m: float = 0.0
    radial: Reach | None = None
    axial: Reach | None = None
    planes: tuple[StrayPlane, ...] = ()
    unknown: str = ""
    left_out: tuple[str, ...] = ()

    def summary(self) -> dict[str, object]:
        """Return the distances as plain data for JSON."""
        return {"limit_T": self.limit_T, "middle_z_m": self.middle_z_m,
                "unknown": self.unknown or None,
                "left_out": list(self.left_out),
                "radial": None if self.radial is None else asdict(self.radial),
                "axial": None if self.axial is None else asdict(self.axial)}


@alone
def stray_field(
    magnet: Magnet, session: Session = NOT_KEPT, magnetizations: Gaussian | None = None,
    limit_T: float = LIMIT_T,
) -> StrayField | None:
    """Tell how far outside of a magnet |B| reaches a limit, by default 0.5 mT.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
    magnetizations : Gaussian, optional
        Distribution of the magnetizations in A/m, for example the posterior of
        `halbach_fe.infer`; by default the nominal ones.
    limit_T : float, optional

    Returns
    -------
    StrayField or None
        None for a cross-section, whose magnet has no ends. By the method `direct` it only says that
        the field far outside is not known.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> stray = hf.stray_field(magnet, hf.Session.open("results"))
    >>> stray.radial.distance_m > magnet.radius
    True
    """
    check_number("limit_T", "stray_field", limit_T, 1e-9, 1.0)
    if magnet.dimension == 2:
        return None
    radius, half = magnet.radius, magnet.half_length_about_middle
    middle = magnet.middle_z_m
    if not applies(magnet):
        return StrayField(limit_T, radius, half, middle, unknown=(
            "The magnet is solved on a mesh as a whole, which does not tell the field far "
            "outside."))
    field = _field(magnet, session, magnetizations)
    near = NEAREST * radius

    def beside(distance: float | Floats, place: Floats) -> Floats:
        angle, along = place.T
        away = radius + distance
        return np.column_stack([away * np.cos(angle), away * np.sin(angle),
                                middle + (half + distance) * along])

    def beyond(distance: float | Floats, place: Floats) -> Floats:
        angle, along = place.T
        out = np.abs(along) * (radius + distance)
        return np.column_stack([out * np.cos(angle), out * np.sin(angle),
                                middle + np.where(along < 0, -1, 1) * (half + distance)])

    wider = 1.5  # distance from the magnet up to which pictures go, relative to that of the line
    try:
        found = [_farthest(field, surface, near, radius * DISTANCES, limit_T)
                 for surface in (beside, beyond)]
        reached = max((distance for distance, _ in found), default=near)
        planes = _planes(field, (radius, half), middle, near,
                         max(wider * reached, radius / 2))
    except PointsOutsideError:
        return StrayField(limit_T, radius, half, middle, unknown=(
            "The mesh around the iron ends before the field has fallen to that."))
    radial, axial = (
        None if point is None else Reach(
            start + distance, _sd(magnet, field, magnetizations, point, outwards), vector(point))
        for start, (distance, point), outwards in (
            (radius, found[0], np.array([1.0, 1.0, 0.0])), (half, found[1], np.array([0, 0, 1.0]))))
    return StrayField(limit_T, radius, half, middle, radial, axial, planes,
                      left_out=tuple(magnet.external.stated))


def _field(magnet: Magnet, session: Session, magnetizations: Gaussian | None) -> Field:
    """Return the field of a magnet alone, of the mean of all parameters."""
    blocks, others = magnet.blocks, np.zeros(0)
    deviations, own = _deviations_alone(magnet)
    if magnetizations is not None:
        distribution_of(magnet, magnetizations, "magnetizations")
        uniform = slice(0, len(magnet.parameter_names))
        blocks, others = with_magnetizations(
            magnet, magnetizations.mean[uniform]), magnetizations.mean[own]
        others[uniform] = 0.0
    of_blocks = field_in_vacuum(blocks)

    def vacuum(points: Floats) -> Floats:
        found = of_blocks(points)
        return found + deviations.field(others, points) if others.any() else found

    if magnet.is_vacuum:
        return vacuum
    alone = magnet.with_(external=External())
    if magnet.has_losses and not magnet.iron:
        alone = magnet  # what other sources have made it lose is lost without them, too
    # beside iron as for the readings: without other sources that is solved already
    as_readings = bool(magnet.iron)
    reaction = solve_separate(
        alone if magnet.has_losses or as_readings else alone.with_(mesh__cells_per_side=1),
        session.within("stray"), estimate=as_readings)
    return lambda points: vacuum(points) + reaction.field(points)


def _deviations_alone(magnet: Magnet) -> tuple[Deviations, Ints]:
    """Return the deviations of a magnet without external sources, and the numbers of their
    parameters among those of the magnet.
    """
    amplitudes = magnet.study.uncertain_of_magnet
    changes = [{name: change for name, change in one.change.items()
                if not name.startswith("external.")} for one in amplitudes]
    alone = magnet.with_(external=External(), uncertain=tuple(
        one.with_(change=change) for one, change in zip(amplitudes, changes, strict=True)
        if change))
    first = Deviations.of(magnet).count - len(amplitudes)
    return Deviations.of(alone), np.append(np.arange(first), first + np.flatnonzero(
        [bool(change) for change in changes])).astype(int)


def _farthest(
    field: Field, surface: Surface, near: float, distances: Floats, limit_T: float
) -> tuple[float, Floats | None]:
    """Return the largest distance in m at which |B| reaches a limit, and the point (3,) in m.

    The search begins at the last of some distances in m and goes on outwards, or else inwards: the
    nearer a surface, the more of its places are looked at. If |B| is smaller at the distance
    ``near`` already, the point is None.
    """
    inwards = [*np.geomspace(near, distances[0], 5).tolist(), *distances[1:].tolist()]
    middle = inwards.pop()
    size, place = _largest(field, surface, middle)
    is_beyond = size > limit_T
    while size <= limit_T:
        if not inwards:
            return near, None
        middle = inwards.pop()
        size, place = _largest(field, surface, middle)
    while is_beyond and (farther := _largest(field, surface, 2 * middle))[0] > limit_T:
        middle, place = 2 * middle, farther[1]
    farthest = surface(middle, place[None])[0]
    # along the line through that place the field is a power of the distance, nearly; farther out
    # the largest |B| may be elsewhere
    for _ in range(12):
        logarithms = np.log(middle) + np.linspace(-0.1, 0.8, 37)
        line = np.vstack([surface(distance, place[None]) for distance in np.exp(logarithms)])
        falling = np.log(np.linalg.norm(field(line), axis=1) / limit_T)
        distance = float(np.exp(np.interp(0.0, -falling, logarithms)))
        if distance <= middle:  # where coarse elements of iron make the field rough
            break
        middle, farthest = distance, surface(distance, place[None])[0]
        size, place = _largest(field, surface, distance)
        if size <= 1.0001 * limit_T:
            break
    return middle, farthest


def _largest(field: Field, surface: Surface, distance: float) -> tuple[float, Floats]:
    """Return the largest |B| in T at a distance, and its place (2,)."""
    # limits of the number of places about the axis and along the other direction at which the
    # largest |B| of a surface is looked for. They lie as far apart as the surface is from the
    # magnet: finer patterns of the field have decayed there. Near a large magnet they are farther
    # apart; there it is looked for about the best place of every row.
    fewest, most = 16, 64
    (x, y, high), (_, _, low) = surface(distance, np.array([[0.0, 1.0], [0.0, -1.0]]))
    out = float(np.hypot(x, y))
    needed = np.array([2 * np.pi * out, 2 * max(abs(high - low) / 2, out)]) / distance
    angles, rows = np.clip(needed, fewest, most).astype(int).tolist()
    places = np.stack(np.meshgrid(2 * np.pi * np.arange(angles) / angles,
                                  np.linspace(-1, 1, rows)), axis=-1)
    size = np.linalg.norm(field(surface(distance, places.reshape(-1, 2))), axis=1)
    best = size.reshape(rows, angles).argmax(axis=1)
    chosen = np.arange(rows) if (needed > most).any() else [int(size.argmax()) // angles]
    place, step = places[chosen, best[chosen]], np.array([2 * np.pi / angles, 2 / (rows - 1)])
    around = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 5)]), axis=-1).reshape(-1, 2)
    for _ in range(5):
        tried = place[:, None] + step * around
        tried[..., 1] = np.clip(tried[..., 1], -1, 1)
        size = np.linalg.norm(field(surface(distance, tried.reshape(-1, 2))), axis=1)
        size = size.reshape(len(place), -1)
        place, step = tried[np.arange(len(place)), size.argmax(axis=1)], step / 2
    best = int(size.max(axis=1).argmax())
    return float(size.max()), place[best]


def _sd(
    magnet: Magnet, field: Field, magnetizations: Gaussian | None, point: Floats, outwards: Floats
) -> float:
    """Return the standard deviation in m of the distance at which |B| falls to that at a point.

    It is that of |B| there, divided by the slope of |B| outwards.
    """
    if magnetizations is None:
        return 0.0
    direction = outwards * (point - [0.0, 0.0, magnet.middle_z_m])
    direction /= np.linalg.norm(direction)
    step = 1e-3 * float(np.linalg.norm(point))
    there = field(point + step * np.outer([-1.0, 0.0, 1.0], direction))
    inner, size, outer = np.linalg.norm(there, axis=1)
    deviations, own = _deviations_alone(magnet)
    row = np.zeros(len(magnetizations.mean))
    row[own] = there[1] / size @ deviations.columns(point[None])
    return float(magnetizations.sd_of(row[None])[0] * 2 * step / abs(inner - outer))


def _planes(
    field: Field, cylinder: tuple[float, float], middle_z_m: float, near: float, far: float
) -> tuple[StrayPlane, ...]:
    """Return |B| in three planes, from one distance in m from the ``cylinder`` around (radius and
    half length in m) to another.
    """
    radius, half = cylinder
    # numbers of points of a plane's picture around the magnet, and outwards
    n_around, n_outward = 96, 20
    distances = np.geomspace(near, far, n_outward)[:, None]
    turn = np.linspace(0, 2 * np.pi, n_around + 1)
    ring = (np.outer(radius + distances, np.cos(turn)), np.outer(radius + distances, np.sin(turn)))
    # around a rectangle: equal steps along its four sides, which grow with the distance
    side = np.linspace(-1, 1, n_around // 4 + 1)[:-1]
    one = np.ones_like(side)
    along = np.concatenate([side, one, -side, -one, side[:1]])
    up = np.concatenate([-one, side, one, -side, -one[:1]])
    box = ((radius + distances) * along, middle_z_m + (half + distances) * up)
    found = []
    for number, (across, (first, second)) in enumerate((("x", box), ("y", box), ("z", ring))):
        points = np.full((*first.shape, 3), [0.0, 0.0, middle_z_m])
        a, b = (axis for axis in range(3) if axis != number)
        points[..., a], points[..., b] = first, second
        size = np.linalg.norm(field(points.reshape(-1, 3)), axis=1).reshape(first.shape)
        found.append(StrayPlane(across, first, second, size))
    return tuple(found)
