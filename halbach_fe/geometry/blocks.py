"""The blocks of a magnet: their place, shape and nominal magnetization.

Every block is a prism along the z axis of its frame, between two values of z. Its outline in the
frame's (x, y) plane consists of straight edges and of arcs about the frame's z axis. Blocks of
rings are described in the magnet's own frame, and free blocks each in a frame of their own. The
mesh, the exact field and the checks of a user's points are all derived from these blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.geometry.outline import (
    Outline,
    along_edges,
    at_heights,
    mean_corner,
    outline_area,
    outline_centroid,
    outline_part,
    points_on,
    ring_radii,
)
from halbach_fe.geometry.surface import (
    Contact,
    contact_of_prism,
    contact_of_tube,
    distance_from_prism,
    distance_from_tube,
)
from halbach_fe.study.materials import MU_0


@dataclass(frozen=True)
class MagnetBlock:
    """One block of the array."""

    ring: int
    slot: int
    """Counted from 1."""
    outline: Outline
    """Outline of its nominal place in the (x, y) plane of its frame, in m."""
    z_min: float
    z_max: float
    """Limits of its nominal place along the z axis of its frame; infinite in 2D. In m."""
    easy_axis: tuple[float, float, float]
    """Unit vector along x, y and z of the magnet, rotated with the block."""
    remanence: float
    """Negative for a block that is mounted upside down. In T."""
    recoil_permeability: float
    recoil_permeability_across: float
    """Relative, along the easy axis and perpendicular to it."""
    displacement_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement from the nominal place along x, y and z."""
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector, about the block's middle."""
    gradient: float = 0.0
    corner_loss: float = 0.0
    """Non-uniformity of the magnetization, see ``magnetization_gradient`` and ``inner_corner_loss``
    of `halbach_fe.study.array_keys.BlockException`."""
    mounted_from: tuple[int, int] | None = None
    """Ring and slot that the block was made for, if that is another place."""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the block's frame in the magnet; zero for blocks of rings."""
    orientation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector that turns the magnet's axes into those of the frame; zero for blocks of
    rings."""
    label: str | None = None
    """The name of a free block."""
    angle_deg: float = 0.0
    facing_deg: float = 0.0
    """Nominal angles to the x axis of the block's position about the z axis, and of its
    thickness."""

    @property
    def has_four_edges(self) -> bool:
        """Whether its outline has four edges, of which those at its sides are straight."""
        return len(self.outline) == 4 and not self.outline[0].arc

    @property
    def in_place(self) -> bool:
        """Whether the block is neither displaced nor rotated."""
        return not (any(self.displacement_m) or any(self.rotation_rad))

    @property
    def in_magnet_frame(self) -> bool:
        """Whether outline and limits describe the block in the magnet's own frame, as it lies."""
        return self.in_place and not (any(self.origin_m) or any(self.orientation_rad))

    @cached_property
    def middle(self) -> Floats:
        """Mean of the corners of the nominal place, (3,) in m; z is 0 for an infinite block."""
        z = 0.0 if np.isinf(self.z_max) else (self.z_min + self.z_max) / 2
        turn = rotation_matrix(self.orientation_rad)
        return np.asarray(turn @ [*mean_corner(self.outline), z] + np.array(self.origin_m))

    @cached_property
    def mounted_middle(self) -> Floats:
        """Middle of the block where it is mounted, (3,) in m."""
        return np.asarray(self.middle + self.displacement_m)

    @cached_property
    def centre_of_mass(self) -> Floats:
        """Centre of mass of a block of finite length where it is mounted, (3,) in m."""
        return self.from_frame(np.append(
            outline_centroid(self.outline), (self.z_min + self.z_max) / 2))

    @cached_property
    def axes(self) -> Floats:
        """Axes of the block's frame as columns (3, 3), turned with a rotated block."""
        nominal = rotation_matrix(self.orientation_rad)
        return np.asarray(rotation_matrix(self.rotation_rad) @ nominal)

    @cached_property
    def shape_axes(self) -> Floats:
        """Axes of the block's shape in its nominal place, as columns (3, 3).

        x is radial, or along the nominal magnetization for cuboids that are oriented along it. Of a
        free block they are the axes of its table.
        """
        return rotation_matrix((0.0, 0.0, np.radians(self.facing_deg)) if self.label is None
                               else self.orientation_rad)

    def carried_from(self, place: MagnetBlock) -> Floats:
        """Return the rotation (3, 3) of what is moved here from the place of another block.

        It turns with the shape, so that it fits the place where it comes to lie.
        """
        return np.asarray(self.shape_axes @ place.shape_axes.T)

    @cached_property
    def position(self) -> Floats:
        """Origin of the block's frame, (3,) in m, moved with a displaced or rotated block."""
        turned = rotation_matrix(self.rotation_rad) @ (np.array(self.origin_m) - self.middle)
        return np.asarray(turned + self.mounted_middle)

    def to_frame(self, points: Floats) -> Floats:
        """Return points (n, 3) of the magnet in the block's frame, in m."""
        return np.asarray((points - self.position) @ self.axes)

    def from_frame(self, points: Floats) -> Floats:
        """Return points (n, 3) of the block's frame in the magnet, in m: inverts `to_frame`."""
        return np.asarray(points @ self.axes.T + self.position)

    @cached_property
    def parts(self) -> tuple[tuple[float, MagnetBlock], ...]:
        """Uniformly magnetized parts, which may overlap, whose superposition is the block.

        Every part has a weight: its magnetization is the weight times the block's.
        """
        if not (self.gradient or self.corner_loss):
            return ((1.0, self),)
        whole = replace(self, gradient=0.0, corner_loss=0.0)

        def part(*limits: float) -> MagnetBlock:
            return replace(whole, outline=outline_part(self.outline, *limits))

        found = [(1.0, whole)]
        if self.gradient:
            found += [(-self.gradient / 2, part(0.0, 0.5, 0.0, 1.0)),
                      (self.gradient / 2, part(0.5, 1.0, 0.0, 1.0))]
        # extent of a corner (see ``inner_corner_loss``) as a fraction of a block's width and
        # thickness
        lost_share = 1 / 6
        if self.corner_loss:
            found += [(-self.corner_loss, part(0.0, lost_share, 0.0, lost_share)),
                      (-self.corner_loss, part(0.0, lost_share, 1 - lost_share, 1.0))]
        return tuple(found)

    @property
    def isotropic(self) -> bool:
        """Whether the recoil permeability is the same in all directions."""
        return self.recoil_permeability == self.recoil_permeability_across

    @property
    def recoil_tensor(self) -> Floats:
        """Relative recoil permeability as a tensor, (3, 3), along x, y and z."""
        axis = np.array(self.easy_axis)
        along, across = self.recoil_permeability, self.recoil_permeability_across
        return across * np.eye(3) + (along - across) * np.outer(axis, axis)

    @property
    def place(self) -> tuple[int, int]:
        """Ring and slot."""
        return self.ring, self.slot

    @property
    def name(self) -> str:
        """Name of the block in regions, parameters and reports: ``r01s05`` is ring 1, slot 5."""
        return self.label or f"r{self.ring:02d}s{self.slot:02d}"

    @cached_property
    def area(self) -> float:
        """Area of the cross-section in m^2."""
        return outline_area(self.outline)

    @property
    def volume(self) -> float:
        """Volume in m^3."""
        return self.area * (self.z_max - self.z_min)

    @property
    def thickness(self) -> float:
        """Twice the volume by the surface in m: a third of a cube's side, or that of a plate."""
        height = self.z_max - self.z_min
        around = sum(edge.length for edge in self.outline)
        return 2 * self.area * height / (2 * self.area + around * height)

    @property
    def polarization(self) -> Floats:
        """The remanence (3,) in T along the easy axis."""
        return np.array(self.easy_axis) * self.remanence

    @property
    def is_permeable(self) -> bool:
        """Whether the block has another permeability than vacuum."""
        return not self.isotropic or self.recoil_permeability != 1.0

    @property
    def magnetization(self) -> Floats:
        """Nominal magnetization M = B_r / (mu_0 mu_r) of ``nu B = H + M``, (3,) in A/m."""
        return self.polarization / (MU_0 * self.recoil_permeability)

    def contains(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m lie inside the block, and not on its surface."""
        return self.contact(points).inside

    def contact(self, points: Floats) -> Contact:
        """Return where points (n, 3) in m of the magnet lie relative to the block's surface."""
        if self.in_magnet_frame:
            return self.contact_in_frame(points)
        found = self.contact_in_frame(self.to_frame(points))
        return replace(found, outward=found.outward @ self.axes.T)

    def contact_in_frame(self, points: Floats) -> Contact:
        """Return `contact` of points (n, 3) in m of the block's frame."""
        if radii := ring_radii(self.outline):
            return contact_of_tube(*radii, self.z_min, self.z_max, points)
        found = contact_of_prism(self.outline, self.z_min, self.z_max, points)
        for _, part in self.parts[1:]:  # whose edges are on the block's faces
            own = contact_of_prism(part.outline, part.z_min, part.z_max, points).on_edge
            found = replace(found, on_edge=found.on_edge | (own & found.on_face),
                            on_face=found.on_face & ~own)
        return found


def present_blocks(blocks: Sequence[MagnetBlock]) -> tuple[MagnetBlock, ...]:
    """Return the blocks that are there: a missing one has neither remanence nor permeability."""
    return tuple(block for block in blocks if block.remanence or block.is_permeable)


def moved_block(block: MagnetBlock, turn_rad: float, z_m: float, factor: float) -> MagnetBlock:
    """Return a block turned about the magnet's z axis, then moved along it.

    Its remanence is multiplied by ``factor``.
    """
    turn = Rotation.from_rotvec([0.0, 0.0, turn_rad]).as_matrix()
    return replace(
        block, origin_m=vector(turn @ block.position + [0.0, 0.0, z_m]),
        orientation_rad=vector(Rotation.from_matrix(turn @ block.axes).as_rotvec()),
        displacement_m=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0),
        easy_axis=vector(turn @ np.array(block.easy_axis)), remanence=factor * block.remanence)


def rotation_matrix(vector: tuple[float, float, float]) -> Floats:
    """Return the matrix (3, 3) of a rotation vector in rad."""
    if not any(vector):  # most blocks of most magnets, which may have thousands
        return np.eye(3)
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def rotation_about_z(angle: float) -> Floats:
    """Return the matrix (3, 3) of a rotation about z by ``angle`` rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


def frames_of(blocks: Sequence[MagnetBlock]) -> tuple[Floats, Floats]:
    """Return `position` (blocks, 3) in m and `axes` (blocks, 3, 3) of many blocks."""
    turns, turned, origins, moves = (
        np.array([getattr(block, key) for block in blocks]).reshape(-1, 3) for key in (
            "rotation_rad", "orientation_rad", "origin_m", "displacement_m"))
    positions = origins + moves
    for number, block in enumerate(blocks):
        if any(block.rotation_rad):
            positions[number] = block.position
    return positions, np.asarray(
        Rotation.from_rotvec(turns).as_matrix() @ Rotation.from_rotvec(turned).as_matrix())


def vector(values: Floats) -> tuple[float, float, float]:
    """Return an array (3,) as a tuple of Python floats."""
    x, y, z = values.tolist()
    return x, y, z


def bore_radius(blocks: Sequence[MagnetBlock], axis_m: Floats) -> float:
    """Return the radius in m of the largest cylinder along z about an axis at x and y in m that
    nominal blocks leave free, by points on their outlines, at least 1e-4 m. If a block covers the
    axis, it is how far the block's outline is from it.
    """
    smallest = np.inf
    for block in blocks:
        outline = along_edges(block.outline, 17)
        if any(block.orientation_rad) or any(block.origin_m):
            heights = [0.0] if np.isinf(block.z_max) else np.linspace(block.z_min, block.z_max, 9)
            nominal = rotation_matrix(block.orientation_rad)
            outline = (at_heights(outline, *heights) @ nominal.T + block.origin_m)[:, :2]
        smallest = min(smallest, float(np.hypot(*(outline - axis_m).T).min()))
    return max(smallest, 1e-4)


def block_in_words(ring: int, slot: int, label: str = "") -> str:
    """Describe a block by its own label, or else by ring and slot; 0 stands for all of them."""
    if label and label != f"r{ring:02d}s{slot:02d}":
        return f"block {label}"
    return ", ".join(f"{noun} {number}" for noun, number in (("ring", ring), ("slot", slot))
                     if number)


def distance_from_blocks(blocks: Sequence[MagnetBlock], points: Floats, far_m: float) -> Floats:
    """Return the distances (n,) in m of points (n, 3) from the nearest of some blocks.

    They are negative inside, and ``far_m`` where all blocks are farther than that.
    """
    found = np.full(len(points), far_m)
    for block in blocks:
        corners = points_on(block.outline)
        if radii := ring_radii(block.outline):
            corners = radii[1] * np.array([[-1.0, -1.0], [1.0, 1.0]])
        places = block.to_frame(points)
        low = np.append(corners.min(axis=0), block.z_min)
        high = np.append(corners.max(axis=0), block.z_max)
        # arcs bulge by less than their chords
        bulge = float(np.linalg.norm(np.ptp(corners, axis=0))) if any(
            edge.arc for edge in block.outline) else 0.0
        beyond = np.maximum(np.maximum(low - places, places - high), 0.0)
        near = np.flatnonzero(np.linalg.norm(beyond, axis=1) - bulge < found)
        if not len(near):
            continue
        if radii := ring_radii(block.outline):
            own = distance_from_tube(*radii, block.z_min, block.z_max, places[near])
        else:
            own = distance_from_prism(block.outline, block.z_min, block.z_max, places[near])
        found[near] = np.minimum(found[near], own)
    return found
