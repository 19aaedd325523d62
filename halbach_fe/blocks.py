"""The blocks of an array: where they stand, their shape, their nominal magnetization.

Every block is a prism along z: an outline in the (x, y) plane, of straight edges and arcs about
the z axis, between two z. The mesh, the exact field and the checks of a user's points all start
from the blocks listed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.errors import StudyError
from halbach_fe.study import MU_0, Array, BlockException, Study

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CORNER = 1 / 6
"""Share of a block's width and thickness that is a corner."""


@dataclass(frozen=True)
class Edge:
    """A directed edge of an outline, straight or (``arc``) along a circle about the z axis."""

    start: tuple[float, float]
    end: tuple[float, float]
    arc: bool = False

    @property
    def angles(self) -> tuple[float, float]:
        """Start angle and signed sweep in rad of an arc; the sweep is the shorter way round."""
        first = np.arctan2(self.start[1], self.start[0])
        last = np.arctan2(self.end[1], self.end[0])
        sweep = (last - first + np.pi) % (2 * np.pi) - np.pi
        return float(first), float(sweep)

    @property
    def radius(self) -> float:
        """Distance of the start from the z axis in m."""
        return float(np.hypot(*self.start))

    @property
    def length(self) -> float:
        """Length in m."""
        if self.arc:
            return abs(self.angles[1]) * self.radius
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Return points (n, 2) in m and outward normals times speed (n, 2) in m, t in [0, 1].

        Outlines run counter-clockwise, so outward is to the right of the edge.
        """
        t = np.asarray(t, float)[:, None]
        if self.arc:
            first, sweep = self.angles
            radial = np.hstack([np.cos(first + sweep * t), np.sin(first + sweep * t)])
            return self.radius * radial, self.radius * sweep * radial
        start, end = np.array(self.start), np.array(self.end)
        along = end - start
        return start + t * along, np.broadcast_to([along[1], -along[0]], (len(t), 2))


Outline = tuple[Edge, ...]


@dataclass(frozen=True)
class MagnetBlock:
    """One block; ``ring`` and ``slot`` count from 1. Lengths in m, remanence in T.

    The recoil permeability is relative, along the easy axis and across it. Outline and z limits are
    the block's place; it stands off it by ``shift`` in m, turned by the rotation vector ``turn`` in
    rad about its middle. ``factor``, ``gradient`` and ``corner_loss`` are of its magnetization, see
    `halbach_fe.study.BlockException`.
    """

    ring: int
    slot: int
    outline: Outline
    z_min: float
    z_max: float
    easy_axis: tuple[float, float, float]
    remanence: float
    recoil_permeability: float
    recoil_permeability_across: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gradient: float = 0.0
    corner_loss: float = 0.0
    mounted_from: tuple[int, int] | None = None

    @property
    def in_place(self) -> bool:
        """Whether it stands where it should."""
        return not (any(self.shift) or any(self.turn))

    @property
    def middle(self) -> Floats:
        """Mean of its corners, (3,) in m; z is 0 if it is infinitely long."""
        x, y = np.mean([edge.start for edge in self.outline], axis=0)
        z = 0.0 if np.isinf(self.z_max) else (self.z_min + self.z_max) / 2
        return np.array([x, y, z])

    def to_place(self, points: Floats) -> Floats:
        """Where points (n, 3) in m lie as seen from the block if it stood in its place."""
        return np.asarray((points - self.middle - self.shift) @ turn_of(self.turn) + self.middle)

    def from_place(self, points: Floats) -> Floats:
        """Where points (n, 3) in m lie that `to_place` would put at the given ones."""
        return np.asarray((points - self.middle) @ turn_of(self.turn).T + self.middle + self.shift)

    @cached_property
    def parts(self) -> tuple[tuple[float, MagnetBlock], ...]:
        """The block, or pieces of it, and how much of its magnetization each has."""
        if not (self.gradient or self.corner_loss):
            return ((1.0, self),)
        whole = replace(self, gradient=0.0, corner_loss=0.0)

        def part(*limits: float) -> MagnetBlock:
            return replace(whole, outline=_part(self.outline, *limits))

        found = [(1.0, whole)]
        if self.gradient:
            found += [(-self.gradient / 2, part(0.0, 0.5, 0.0, 1.0)),
                      (self.gradient / 2, part(0.5, 1.0, 0.0, 1.0))]
        if self.corner_loss:
            found += [(-self.corner_loss, part(0.0, CORNER, 0.0, CORNER)),
                      (-self.corner_loss, part(0.0, CORNER, 1 - CORNER, 1.0))]
        return tuple(found)

    @property
    def isotropic(self) -> bool:
        """Whether the recoil permeability is the same in all directions."""
        return self.recoil_permeability == self.recoil_permeability_across

    @property
    def recoil_tensor(self) -> Floats:
        """Relative recoil permeability as a tensor, (3, 3)."""
        axis = np.array(self.easy_axis)
        along, across = self.recoil_permeability, self.recoil_permeability_across
        return across * np.eye(3) + (along - across) * np.outer(axis, axis)

    @property
    def name(self) -> str:
        """Label used in regions, parameters and reports."""
        return f"r{self.ring:02d}s{self.slot:02d}"

    @cached_property
    def area(self) -> float:
        """Cross-section in m^2, by Green's theorem (exact: the integrand is a polynomial, or a
        constant on arcs).
        """
        t, weight = np.polynomial.legendre.leggauss(3)
        total = 0.0
        for edge in self.outline:
            points, normals = edge.at((t + 1) / 2)
            total += float(np.sum(weight / 2 * np.einsum("ij,ij->i", points, normals))) / 2
        return total

    @property
    def volume(self) -> float:
        """Volume in m^3."""
        return self.area * (self.z_max - self.z_min)

    @property
    def magnetization(self) -> Floats:
        """Nominal M = B_r / (mu_0 mu_r) of ``nu B = H + M``, (3,) in A/m."""
        return np.array(self.easy_axis) * self.remanence / (MU_0 * self.recoil_permeability)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m lie inside the block or on its end faces."""
        if not self.in_place:
            points = self.to_place(points)
        inside = (points[:, 2] >= self.z_min) & (points[:, 2] <= self.z_max)
        inside[inside] = outline_contains(self.outline, points[inside, :2])
        return inside


def outline_contains(outline: Outline, points: Floats) -> NDArray[np.bool_]:
    """Tell which points (n, 2) lie inside an outline, by their angle of view of each edge.

    Outlines are polygons, of which some edges bulge as arcs about the origin: the polygon's
    winding number is corrected by the circular segments between chord and arc.
    """
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for edge in outline:  # even-odd rule along +x
        (x0, y0), (x1, y1) = edge.start, edge.end
        crosses = (y0 > y) != (y1 > y)
        if y1 != y0:
            inside ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    for edge in outline:
        if edge.arc:  # a point between chord and arc is on the other side than the chord says
            (x0, y0), (x1, y1) = edge.start, edge.end
            side = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
            beyond = side < 0 if edge.angles[1] > 0 else side > 0
            inside ^= beyond & (np.hypot(x, y) < edge.radius)
    return inside


def blocks_of(study: Study) -> tuple[MagnetBlock, ...]:
    """Return all blocks of a study, ring by ring (lowest z first), slot by slot.

    In a 2D study the one ring stretches from z = -inf to +inf.

    Raises
    ------
    StudyError
        If neighbouring blocks overlap.
    """
    array = study.array
    outlines = [_outline(array, slot) for slot in range(1, array.blocks_per_ring + 1)]
    _check_overlaps(tuple(outlines))
    return tuple(
        _block(array, ring, slot, outline, limits)
        for ring, limits in enumerate(ring_limits(study), start=1)
        for slot, outline in enumerate(outlines, start=1))


def _block(
    array: Array, ring: int, slot: int, outline: Outline, limits: tuple[float, float]
) -> MagnetBlock:
    """One block, as its array or the exceptions to it have it."""
    ours = _exceptions_of(array, ring, slot)
    angle, remanence = magnetization_angle_deg(array, slot), array.remanence_T
    permeability = array.recoil_permeability
    across = array.recoil_permeability_across or permeability
    meant: tuple[int, int] | None = None
    gradient = corner_loss = 0.0
    for exception in ours:
        if exception.mounted_from is not None:
            meant = exception.mounted_from
            angle = (magnetization_angle_deg(array, meant[1]) + position_angle_deg(array, slot)
                     - position_angle_deg(array, meant[1]))
        if exception.magnetization_angle_deg is not None:
            angle = exception.magnetization_angle_deg
        if exception.recoil_permeability is not None:
            permeability = across = exception.recoil_permeability
        across = exception.recoil_permeability_across or across
        remanence = exception.remanence_T or remanence
        if exception.magnetization_gradient is not None:
            gradient = exception.magnetization_gradient
        if exception.inner_corner_loss is not None:
            corner_loss = exception.inner_corner_loss
    direction = np.radians(angle)
    easy_axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    block = MagnetBlock(
        ring=ring, slot=slot, outline=outline, z_min=limits[0], z_max=limits[1],
        easy_axis=_three(easy_axis), remanence=np.nan if remanence is None else remanence,
        recoil_permeability=permeability, recoil_permeability_across=across, gradient=gradient,
        corner_loss=corner_loss, mounted_from=meant)
    if remanence is None:
        block = replace(block, remanence=_remanence_of_moment(array, block))
    factor = _factor(ours)
    if factor != 1.0:
        block = replace(block, remanence=block.remanence * factor)
    return _posed(block, array, ours)


def _posed(
    block: MagnetBlock, array: Array, exceptions: Sequence[BlockException]
) -> MagnetBlock:
    """The block where its exceptions put it; its easy axis turns with it."""
    axes = turn_of((0.0, 0.0, np.radians(position_angle_deg(array, block.slot))))
    shift, turn = np.zeros(3), np.zeros(3)
    for one in exceptions:
        twist = np.array([0.0, 0.0, np.radians(one.twist_deg)])
        shift += axes @ one.displacement_m + one.shift_m
        shift += turn_of(_three(twist)) @ block.middle - block.middle
        turn += axes @ np.radians(one.rotation_deg) + twist
    if not (shift.any() or turn.any()):
        return block
    return replace(block, shift=_three(shift), turn=_three(turn),
                   easy_axis=_three(turn_of(_three(turn)) @ block.easy_axis))


def mountings(study: Study) -> list[tuple[int, Floats]]:
    """By block: the number of the block that was meant for where this one comes from, and the
    matrix (3, 3) from its magnetization there to the one here (0 for a missing block).
    """
    array, found = study.array, []
    for block in blocks_of(study):
        ring, slot = block.mounted_from or (block.ring, block.slot)
        moved = position_angle_deg(array, block.slot) - position_angle_deg(array, slot)
        turn = turn_of(block.turn) @ turn_of((0.0, 0.0, np.radians(moved)))
        factor = _factor(_exceptions_of(array, block.ring, block.slot))
        found.append(((ring - 1) * array.blocks_per_ring + slot - 1, factor * turn))
    return found


def as_meant(study: Study) -> Study:
    """The study with every block as it was meant to be mounted."""
    meant = {"mounted_from": None, "magnetization_factor": 1.0, "rotation_deg": (0.0, 0.0, 0.0),
             "twist_deg": 0.0}
    array = study.array.model_copy(update={"exceptions": tuple(
        one.model_copy(update=meant) for one in study.array.exceptions)})
    return study.model_copy(update={"array": array})


def _exceptions_of(array: Array, ring: int, slot: int) -> list[BlockException]:
    return [one for one in array.exceptions
            if one.ring in (None, ring) and one.slot in (None, slot)]


def _factor(exceptions: Sequence[BlockException]) -> float:
    return float(np.prod([one.magnetization_factor for one in exceptions]))


def turn_of(vector: tuple[float, float, float]) -> Floats:
    """Matrix (3, 3) of a rotation vector in rad."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _three(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def position_angle_deg(array: Array, slot: int) -> float:
    """Angle of the middle of block ``slot`` (from 1) about the z axis."""
    return array.first_block_angle_deg + (slot - 1) * 360.0 / array.blocks_per_ring


def magnetization_angle_deg(array: Array, slot: int) -> float:
    """Nominal direction of magnetization of block ``slot`` (from 1)."""
    turn = (1 + array.multipole_order) * (slot - 1) * 360.0 / array.blocks_per_ring
    return array.first_magnetization_angle_deg + turn


def facing_angle_deg(array: Array, slot: int) -> float:
    """Angle about z that the faces of block ``slot`` (from 1) follow."""
    if array.block.shape == "cuboid" and array.block.orientation == "magnetization":
        return magnetization_angle_deg(array, slot)
    return position_angle_deg(array, slot)


def ring_limits(study: Study) -> list[tuple[float, float]]:
    """z limits in m of every ring; the array is centred at z = 0, infinite in 2D."""
    array = study.array
    if study.dimension == 2:
        return [(-np.inf, np.inf)]
    assert array.ring_length_m is not None  # the study model guarantees it
    pitch = array.ring_length_m + array.ring_gap_m
    length = array.rings * pitch - array.ring_gap_m
    starts = -length / 2 + pitch * np.arange(array.rings)
    return [(float(z), float(z + array.ring_length_m)) for z in starts]


def array_half_length(study: Study) -> float:
    """Half the length of the array in m; infinite in 2D."""
    return ring_limits(study)[-1][1]


def iron_half_length(study: Study) -> float:
    """Half the length of the iron ring in m: its own, or the array's; infinite in 2D."""
    iron = study.iron_ring
    if study.dimension == 3 and iron is not None and iron.length_m:
        return iron.length_m / 2
    return array_half_length(study)


def array_outer_radius(study: Study) -> float:
    """Radius in m of the smallest cylinder around all blocks (corners included)."""
    return max(edge.radius for slot in range(1, study.array.blocks_per_ring + 1)
               for edge in _outline(study.array, slot))


def points_in_material(study: Study, points: Floats) -> NDArray[np.bool_]:
    """Tell which points (n, 3) in m lie inside a block or the iron ring."""
    inside = np.zeros(len(points), bool)
    for block in blocks_of(study):
        inside |= block.contains(points)
    ring = study.iron_ring
    if ring is not None:
        radius = np.hypot(points[:, 0], points[:, 1])
        half = iron_half_length(study)
        inside |= ((radius >= ring.inner_radius_m) & (radius <= ring.outer_radius_m)
                   & (np.abs(points[:, 2]) <= half))
    return inside


def _remanence_of_moment(array: Array, block: MagnetBlock) -> float:
    """A moment m means B_r = mu_0 m / V, m being the remanent moment.

    (The moment that a Helmholtz coil shows of a lone block is smaller by the self-demagnetization
    1 + N (mu_r - 1), at most some 2 %; a nominal value does not know it.)
    """
    assert array.block_moment_A_m2 is not None  # the study model guarantees both
    assert array.ring_length_m is not None
    remanence = MU_0 * array.block_moment_A_m2 / (block.area * array.ring_length_m)
    if remanence > 2.0:
        raise StudyError(
            f"Input `array.block_moment_A_m2` of study must be a moment of a remanence up to "
            f"2 T; instead received {array.block_moment_A_m2:g}, which is {remanence:.3g} T in "
            f"this block. Check moment, radii and ring length."
        )
    return remanence


def _outline(array: Array, slot: int) -> Outline:
    """Outline of block ``slot``, counter-clockwise."""
    middle = np.radians(position_angle_deg(array, slot))
    half_pitch = np.pi / array.blocks_per_ring
    inner, outer, block = array.inner_radius_m, array.outer_radius_m, array.block
    if block.shape == "sector":
        half = half_pitch - np.radians(block.angular_gap_deg) / 2
        if half <= 0:
            raise StudyError(
                f"Input `array.block.angular_gap_deg` of study must be less than the pitch of "
                f"{np.degrees(2 * half_pitch):g} deg; instead received {block.angular_gap_deg:g}."
                " Reduce the gap or the number of blocks."
            )
        corners = [(r, middle + s * half) for r, s in
                   ((inner, -1), (outer, -1), (outer, 1), (inner, 1))]
        local = np.array([(r * np.cos(a), r * np.sin(a)) for r, a in corners])
        return _edges(local, arcs=(1, 3))
    if block.shape == "trapezoid":
        # The side faces are parallel to the sector's limits, half a gap inside them.
        inset = block.side_gap_m / 2 / np.cos(half_pitch)
        widths = [r * np.tan(half_pitch) - inset for r in (inner, outer)]
        if widths[0] <= 0:
            raise StudyError(
                f"Input `array.block.side_gap_m` of study must leave the block some width at the "
                f"inner radius; instead received {block.side_gap_m:g}. Reduce the gap."
            )
        local = np.array([(inner, -widths[0]), (outer, -widths[1]),
                          (outer, widths[1]), (inner, widths[0])])
        return _edges(local @ _turn(middle).T)
    half_width, half_depth = block.width_m / 2, (outer - inner) / 2
    local = np.array([(-half_depth, -half_width), (half_depth, -half_width),
                      (half_depth, half_width), (-half_depth, half_width)])
    facing = np.radians(facing_angle_deg(array, slot))
    centre = (inner + outer) / 2 * np.array([np.cos(middle), np.sin(middle)])
    return _edges(local @ _turn(facing).T + centre)


def _turn(angle: float) -> Floats:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def places_in(outline: Outline, depth: Floats, width: Floats) -> Floats:
    """Points (n, m, 2) in m at fractions (n,) of an outline's thickness, from the inner side, and
    (m,) of its width.

    The second and fourth edge, from inner to outer corners and back in all shapes, are joined by
    straight lines.
    """
    far, near = outline[1].at(width)[0], outline[3].at(1 - width)[0]
    share = depth[:, None, None]
    return np.asarray((1 - share) * near + share * far)


def _part(outline: Outline, inner: float, outer: float, start: float, stop: float) -> Outline:
    """The part of an outline between two fractions of its thickness, from the inner side, and of
    its width.
    """
    (one, two), (four, three) = places_in(
        outline, np.array([inner, outer]), np.array([start, stop])).swapaxes(0, 1)
    return _edges(np.array([one, two, three, four]), tuple(
        number for number in (1, 3) if outline[number].arc))


def _edges(corners: Floats, arcs: tuple[int, ...] = ()) -> Outline:
    points = [(float(x), float(y)) for x, y in corners]
    return tuple(Edge(points[i], points[(i + 1) % len(points)], arc=i in arcs)
                 for i in range(len(points)))


@lru_cache(maxsize=32)  # a diagnosis asks for the same blocks hundreds of times
def _check_overlaps(outlines: tuple[Outline, ...]) -> None:
    """Refuse outlines that overlap: one holds a point of another, or their edges cross.

    Shared faces are allowed; outlines are drawn in by 1e-6 so that rounding decides nothing.
    """
    t = np.linspace(0.0, 1.0, 9)
    drawn_in, centres, reaches, widths = [], [], [], []
    for outline in outlines:
        boundary = np.vstack([edge.at(t)[0][:-1] for edge in outline])
        centre = np.mean([edge.start for edge in outline], axis=0)
        drawn_in.append(centre + (1 - 1e-6) * (boundary - centre))
        centres.append(centre)
        reaches.append(1.1 * np.hypot(*(boundary - centre).T).max())  # arcs bulge between samples
        widths.append([np.abs(_angles(polygon, centre)).max()
                       for polygon in (drawn_in[-1], boundary)])
    places, sizes = np.array(centres), np.array(reaches)
    inside, whole = np.where(np.array(widths) < np.pi / 2, widths, np.pi).T  # or the axis is in it
    for i, polygon in enumerate(drawn_in):
        samples = np.vstack([polygon, polygon.mean(axis=0)])
        # those in other sectors about the axis are apart: with shared faces, by what is drawn in
        near = (np.hypot(*(places - places[i]).T) <= sizes + sizes[i]) & (
            np.abs(_angles(places, places[i])) <= inside[i] + whole)
        for j in np.flatnonzero(near).tolist():
            if i != j and (outline_contains(outlines[j], samples).any()
                           or _cross(polygon, drawn_in[j])):
                raise StudyError(
                    f"Input `array.block` of study must leave neighbours apart; instead blocks "
                    f"{i + 1} and {j + 1} of a ring overlap. Reduce the block's width, or place "
                    "the blocks on a larger radius."
                )


def _angles(points: Floats, from_: Floats) -> Floats:
    """Angles (n,) about the axis in rad of points (n, 2), from that of another one (2,)."""
    turned = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(from_[1], from_[0])
    return np.asarray((turned + np.pi) % (2 * np.pi) - np.pi)


def _cross(one: Floats, two: Floats) -> bool:
    """Tell whether any side of one closed polygon crosses any of another."""
    a, b = one[:, None], np.roll(one, -1, axis=0)[:, None]
    c, d = two[None], np.roll(two, -1, axis=0)[None]

    def side(p: Floats, q: Floats, x: Floats) -> Floats:
        return ((q[..., 0] - p[..., 0]) * (x[..., 1] - p[..., 1])
                - (q[..., 1] - p[..., 1]) * (x[..., 0] - p[..., 0]))

    def apart(x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Clearly on two sides: sides of aligned blocks are collinear but for rounding."""
        return (np.minimum(x, y) < -tiny) & (np.maximum(x, y) > tiny)

    tiny = 1e-9 * float(np.ptp(one)) ** 2
    return bool((apart(side(a, b, c), side(a, b, d)) & apart(side(c, d, a), side(c, d, b))).any())
