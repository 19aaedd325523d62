"""The demagnetization margin: H along the easy axis compared with the knee of the B-H curve.

Inside a block ``mu_0 H`` is the sum of the exact field of all blocks in vacuum, from their magnetic
surface charge, and the reaction field of the permeability of the blocks and of the iron: by the
method of moments where the study's route is that one, and by finite elements elsewhere. H diverges
logarithmically at the edges of blocks. The smallest margin therefore depends on the size of the
cells, but the share of the volume past the knee converges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.files import atomic
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.progress import Progress
from halbach_fe.core.threads import available_memory
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Edge, places_in
from halbach_fe.response.field_on_lines import reaction_within
from halbach_fe.solver.azimuthal_modes import is_axisymmetric
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.solver.magnetostatics import (
    CROSS_SECTION,
    SCALAR_POTENTIAL,
    solve_sources,
    solve_tangent,
)
from halbach_fe.solver.separate_blocks import applies, solve_separate
from halbach_fe.solver.session import Session
from halbach_fe.study.array_keys import BlockException
from halbach_fe.study.materials import MU_0, Demagnetization, grade_of
from halbach_fe.study.model import Study
from halbach_fe.study.types import ABSOLUTE_ZERO_C

ACROSS = 6
"""Default number of cells across the radial thickness of a block, and least one along its other
sides.
"""

SHARES = (0.0, 0.01)
"""Shares of the magnet's volume for which the limit temperature is reported."""

OPPOSED = -0.2
"""Cells with less of mu_0 H along the magnetization, over the remanence, are looked at in more
places than their middles. Knees of magnets are below -0.5 at room temperature."""

LINEAR = 0.25, 2.0
"""Change of the coercivity up to which its coefficient is believed: that of NdFeB doubles at about
-145 °C, where its easy axis turns (-138 °C), and linear laws of data sheets end above 1/4."""


@dataclass(frozen=True)
class Cells:
    """Blocks cut into small cells, layer by layer."""

    vertices: Floats
    """Shape (v, 3), in m."""
    corners: Ints
    """Numbers of the vertices of each cell, in VTK's order.
    Shape (cells, 8), or in 2D (cells, 4)."""
    block: Ints
    """Number of the block that each cell belongs to, counted from 0. Shape (cells,)."""
    middles: Floats
    """Centres of the cells, where H is computed. Shape (cells, 3), in m."""
    volumes: Floats
    """Shape (cells,), in m^3 (in 2D areas in m^2)."""


@dataclass(frozen=True)
class Places:
    """Places anywhere in cells that are in an opposed field, and the middles of other ones."""

    cell: Ints
    """Number of the cell of each place. Shape (n,)."""
    volumes: Floats
    """What of the volume of its cell each stands for. Shape (n,), in m^3 (in 2D areas in m^2)."""
    along: Floats
    """H along the magnetization. Shape (n,), in A/m."""
    outside: Floats
    """The part of it that external sources make which do not change with the temperature: all but
    neighbours. Shape (n,), in A/m."""


@dataclass(frozen=True)
class DemagnetizationMap(ShownInNotebook):
    """H in the blocks of a magnet at a given temperature, compared with the knee.

    Attributes
    ----------
    magnet : Magnet
        The magnet with its remanence at the reference temperature.
    material : Demagnetization
        The study's demagnetization data, of the array's material.
    blocks : tuple of MagnetBlock
        Blocks with their remanence at the material's temperature.
    cells : Cells
    along : ndarray, shape (cells,), in A/m
        H along the magnetization in the middles; negative where H opposes the magnetization.
    places : Places
        H along the magnetization anywhere in the cells, of which shares and limits follow: the
        middles miss what is past the knee in parts of cells alone, as at faces and edges.
    along_error : float, in A/m
        Error bar of H in the middles of the block with the smallest margin, by the cells in which
        its permeability is solved for. It is 0 for other routes, beside iron, and of blocks that
        are not uniform.
    """

    magnet: Magnet
    material: Demagnetization
    blocks: tuple[MagnetBlock, ...]
    cells: Cells
    along: Floats
    places: Places
    along_error: float = 0.0

    @property
    def study(self) -> Study:
        """The study of the magnet."""
        return self.magnet.study

    @cached_property
    def kinds(self) -> tuple[Demagnetization, ...]:
        """Data of every material among the magnetized blocks."""
        found = [self.magnet.demagnetizations[number] for number in np.unique(self.cells.block)]
        return tuple(dict.fromkeys(found))

    def _of(self, cells: Ints, law: Callable[[Demagnetization], Floats | float]) -> Floats:
        """Return what a law says of the materials of cells (n,), (n,)."""
        return np.array([float(law(kind)) for kind in self.kinds])[self._kind_of_cell[cells]]

    @cached_property
    def _kind_of_cell(self) -> Ints:
        """Number (cells,) of each cell's material among `kinds`."""
        numbers = {kind: number for number, kind in enumerate(self.kinds)}
        return np.array([numbers.get(kind, -1) for kind in self.magnet.demagnetizations])[
            self.cells.block]

    @property
    def share_error(self) -> float:
        """By how much `share_beyond_now` depends on the places: on every second one of them.

        These may agree by chance: it is at least the share of the volume of a place of twice the
        length, if anything is past the knee.
        """
        past, volumes = self.past_the_knee, self.places.volumes
        if not past.any():
            return 0.0
        least = 2 ** self.magnet.dimension * float(volumes[past].max() / volumes.sum())
        half = volumes[::2][past[::2]].sum() / volumes[::2].sum()
        return max(abs(self.share_beyond_now - float(half)), least)

    @property
    def past_the_knee(self) -> Bools:
        """Whether the places (n,) are past the knee at the temperature of the map."""
        return np.asarray(self.places.along < -self._of(self.places.cell, knee_now))

    @property
    def margin(self) -> Floats:
        """Margin between H and the knee, (cells,) in A/m; negative past the knee."""
        return self.along + self._of(np.arange(len(self.along)), knee_now)

    @property
    def share_beyond_now(self) -> float:
        """Share of the volume that is past the knee at the temperature of the map."""
        volumes = self.places.volumes
        return float(volumes[self.past_the_knee].sum() / volumes.sum())

    def share_beyond(self, temperature_C: Floats) -> Floats:
        """Return the share of the volume past the knee, for temperatures (t,) in °C.

        H is assumed to be proportional to the block's own remanence when the temperature changes,
        but for that of external sources. This is exact of one material without iron, and for iron
        of constant permeability unless these magnetize it.
        """
        weight = self.places.volumes / self.places.volumes.sum()
        outside = self.places.outside
        own = self.places.along - outside

        def beyond(temperature_C: float) -> float:
            grown = self._of(self.places.cell, lambda kind: remanence_factor(kind, temperature_C)
                             / remanence_factor(kind, kind.temperature_C))
            limit = self._of(self.places.cell, lambda kind: knee(kind, temperature_C))
            return float(weight[own * grown + outside < -limit].sum())

        return np.array([beyond(each) for each in temperature_C.tolist()])

    @property
    def worst_when_cold(self) -> bool:
        """Whether more is past the knee in the cold, as of ferrite."""
        return self.material.worst_when_cold

    def limit_temperature(self, share: float) -> float:
        """Return the highest temperature in °C with at most a share of the volume past the knee.

        It is infinite if more of the volume is past the knee at no temperature, and -infinity if at
        every one above absolute zero. Where `worst_when_cold`, it is the lowest such temperature,
        and the signs of the infinities are the others.
        """
        cell, outside = self.places.cell, self.places.outside
        at_reference = (outside - self.places.along) / self._of(
            cell, lambda kind: remanence_factor(kind, kind.temperature_C))
        # solve -own (1 + alpha d) - outside = knee (1 + beta d) for the temperature difference d of
        # each place, where alpha and beta are the coefficients of remanence and coercivity
        before = self._of(cell, lambda kind: knee(kind, kind.reference_temperature_C))
        rate = (at_reference * self._of(cell, lambda kind: kind.remanence_coefficient_per_K)
                - before * self._of(cell, lambda kind: kind.coercivity_coefficient_per_K))
        spare = before - at_reference + outside
        sign = -1 if self.worst_when_cold else 1
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.where(sign * rate > 0, spare / rate,
                             np.where(spare > 0, sign * np.inf, -sign * np.inf))
        limit += self._of(cell, lambda kind: kind.reference_temperature_C)
        order = np.argsort(sign * limit)
        passed = np.cumsum(self.places.volumes[order]) / self.places.volumes.sum()
        first = int(np.searchsorted(passed, share + 1e-12))
        found = float(limit[order][min(first, len(limit) - 1)])
        return found if found > ABSOLUTE_ZERO_C else -np.inf

    @property
    def far_from_reference(self) -> float | None:
        """Factor by which the linear law changes the coercivity, if it is beyond `LINEAR`."""
        factor = self.coercivity_factor(self.material.temperature_C)
        return None if LINEAR[0] <= factor <= LINEAR[1] else factor

    def coercivity_factor(self, temperature_C: float) -> float:
        """Return the coercivity at a temperature by the linear law, over that of the reference, of
        the material of which it changes most.
        """
        return max((float(knee(kind, temperature_C) / knee(kind, kind.reference_temperature_C))
                    for kind in self.kinds), key=lambda factor: abs(np.log(max(factor, 1e-9))))

    def by_block(self) -> list[dict[str, Any]]:
        """Return a row per magnetized block: H, margins, and the coercivity that it would need."""
        share_of_coercivity = self._of(np.arange(len(self.along)), lambda kind: knee_now(kind)
                                       / kind.intrinsic_coercivity_A_per_m)
        rows: list[dict[str, Any]] = []
        past, block = self.past_the_knee, self.cells.block[self.places.cell]
        for number in np.unique(self.cells.block):
            mine = self.cells.block == number
            along, volume = self.along[mine], self.cells.volumes[mine]
            worst = int(np.argmin(along))
            x, y, z = self.cells.middles[mine][worst].tolist()
            rows.append({
                "block": self.blocks[number].name,
                "ring": self.blocks[number].ring, "slot": self.blocks[number].slot,
                "mean_H_A_per_m": float(np.average(along, weights=volume)),
                "least_H_A_per_m": float(along[worst]), "x_m": x, "y_m": y, "z_m": z,
                "margin_A_per_m": float(self.margin[mine].min()),
                "share_beyond_knee": float(
                    self.places.volumes[past & (block == number)].sum() / volume.sum()),
                "needed_coercivity_A_per_m": max(0.0, -float(along[worst]))
                / float(share_of_coercivity[mine][worst]),
            })
        return rows


def remanence_factor(material: Demagnetization, temperature_C: Floats | float) -> Floats:
    """Return the remanence relative to that at the reference temperature."""
    return np.asarray(1 + material.remanence_coefficient_per_K * (
        np.asarray(temperature_C) - material.reference_temperature_C))


def knee(material: Demagnetization, temperature_C: Floats | float) -> Floats:
    """Return |H| of the knee in A/m, at least 0."""
    factor = 1 + material.coercivity_coefficient_per_K * (
        np.asarray(temperature_C) - material.reference_temperature_C)
    return np.asarray(material.squareness * material.intrinsic_coercivity_A_per_m
                      * np.maximum(0.0, factor))


def knee_now(material: Demagnetization) -> float:
    """Return |H| of the knee in A/m at the temperature that the study states."""
    return float(knee(material, material.temperature_C))


def demagnetization_map(
    magnet: Magnet, session: Session, across: int = ACROSS,
    progress: Progress | None = None,
) -> DemagnetizationMap:
    """Compute H in all blocks of the nominal magnet, at the temperature that the study states.

    Parameters
    ----------
    across : int
        Number of cells across the radial thickness of a block. In the other directions the cells
        have about the same length, but are no fewer: through a thin block H varies most.
    progress : callable, optional
        Is told how many cells are done, and how many there are.

    Raises
    ------
    StudyError
        If the study has no demagnetization data of its material, or no block is magnetized.
    """
    material = magnet.study.demagnetization
    if material is None:
        found = grade_of(magnet.array)
        known = found.demagnetization_defaults if found else {}
        keys = [key for key, field in Demagnetization.model_fields.items()
                if field.is_required() and key not in known]
        raise StudyError(must_be(
            "`demagnetization`", f"study {magnet.name}", "what the material withstands", "nothing",
            "Add [demagnetization] with temperature_C"
            + (f", and {', '.join(keys)} from the data sheet." if keys else
               f": the rest is known of {magnet.array.material}.")))
    if len({each.worst_when_cold for each in magnet.demagnetizations}) > 1:
        raise StudyError(must_be(
            "`material` of rings and blocks", f"study {magnet.name}", "all of ferrite or none",
            "both", "Ferrite loses magnetization in the cold, and other magnets in the heat."))
    warm = at_temperature(magnet)
    blocks = warm.blocks
    magnetized = [number for number, block in enumerate(blocks) if block.remanence]
    cells = cut(blocks, magnetized, across)
    easy = np.array([np.array(block.easy_axis) * np.sign(block.remanence) for block in blocks])
    field = _vacuum_field(blocks, cells.middles, progress)
    from_outside = external_field(warm, cells.middles)
    strength = np.array([abs(block.remanence) for block in blocks])[cells.block]
    opposed = np.einsum("nc,nc->n", field + from_outside, easy[cells.block]) < OPPOSED * strength
    cell, points = _anywhere(cells, np.flatnonzero(opposed))
    number = np.append(cells.block, cells.block[cell])
    everywhere = np.vstack([cells.middles, points])
    field = _field_strength(
        warm, cells, np.vstack([field, _vacuum_field(blocks, points, None)]), everywhere, number,
        session)
    fixed = external_field(warm.with_(external__neighbours=()), everywhere) / MU_0
    along, outside = (np.einsum("nc,nc->n", each, easy[number]) for each in (field, fixed))
    cell = np.append(np.flatnonzero(~opposed), cell)
    used = np.append(np.flatnonzero(~opposed), np.arange(len(opposed), len(number)))
    here = DemagnetizationMap(magnet, material, blocks, cells, along[:len(opposed)], Places(
        cell, (cells.volumes / np.maximum(1, np.bincount(cell, minlength=len(opposed))))[cell],
        along[used], outside[used]))
    return replace(here, along_error=_error_in_worst_block(warm, here, easy, session))


def _error_in_worst_block(
    magnet: Magnet, found: DemagnetizationMap, easy: Floats, session: Session
) -> float:
    """Return the error bar in A/m of H along easy axes (blocks, 3) in the middles of the cells of
    the block with the smallest margin.

    In one block the deviation of the polarization from its mean has a closed form, which the cells
    of the method of moments have not, see `halbach_fe.solver.moments.solve.field_within`.
    """
    reacting = magnet.with_(solver__method="reaction")
    if magnet.is_vacuum or magnet.iron or magnet.has_losses or not _by_moments(reacting) or any(
            len(block.parts) > 1 for block in magnet.blocks):
        return 0.0
    cells = found.cells
    number = cells.block[np.argmin(found.margin)]
    here = cells.block == number
    points = cells.middles[here]
    reaction, bar = reaction_within(
        reacting, points, cells.block[here], solve_separate(reacting, session, estimate=False))
    strength = _vacuum_field(magnet.blocks, points, None) + reaction + external_field(
        magnet, points)
    off = np.abs(strength @ easy[number] / MU_0 - found.along[here])
    return float(np.max(off + np.linalg.norm(bar, axis=1) / MU_0))


def _anywhere(cells: Cells, numbers: Ints) -> tuple[Ints, Floats]:
    """Return the cells (n,) and points (n, 3) in m of places anywhere in cells of some numbers.

    There is at least one in each cell. They follow the sequence R3 of M. Roberts (2018), whose
    steps are the powers of 1/1.2207: no place in a cell is preferred.
    """
    within = 0.005  # of the cell: at its rim a place may be outside of an arc
    enough, most = 20_000, 8  # places, and in each cell
    each = min(-(-enough // max(1, len(numbers))), most)
    cell, steps = np.repeat(numbers, each), 1.2207440846057596 ** -np.arange(1.0, 4.0)
    place = within + (1 - 2 * within) * ((0.5 + np.outer(np.arange(len(cell)), steps)) % 1.0)
    return cell, _inside(cells, cell, place)


def _inside(cells: Cells, cell: Ints, place: Floats) -> Floats:
    """Return the points (n, 3) in m at places (n, 3), from 0 to 1 each way, in cells (n,)."""
    u, v, w = place.T
    weights = np.array([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]).T
    if cells.corners.shape[1] > weights.shape[1]:
        weights = np.hstack([weights * (1 - w)[:, None], weights * w[:, None]])
    return np.asarray(np.einsum("nc,nck->nk", weights, cells.vertices[cells.corners[cell]]))


def _reaction_by_moments(
    reacting: Magnet, cells: Cells, points: Floats, session: Session
) -> Floats:
    """Return mu_0 H (n, 3) in T of what permeability induces, at points (n, 3) in m inside blocks.

    The method of moments has blocks of uniform parts, on whose edges its field is infinite. The
    first points are the middles of the cells, which lie on these edges where the parts are as
    regular (a cube in 6 cells across and 4 parts). There the field is the mean of four places
    about the middle, whose differences cancel to first order.
    """
    reaction = solve_separate(reacting, session, estimate=False)
    beside = 0.23  # of the cell; 0.13 to 0.27 do as well, but 0.25 would be on edges again
    ways = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    every = np.arange(len(cells.block))
    field = [reaction.field(_inside(cells, every, np.tile(0.5 + beside * way, (len(every), 1))))
             for way in ways]
    return np.vstack([np.mean(field, axis=0), reaction.field(points[len(every):])])


def at_temperature(magnet: Magnet) -> Magnet:
    """Return the magnet whose blocks have the remanence of their materials' temperature, and have
    lost nothing: the map says where they would, also at other temperatures.
    """
    factors = {block.place: float(remanence_factor(material, material.temperature_C))
               for block, material in zip(magnet.blocks, magnet.demagnetizations, strict=True)}
    weaker = [BlockException(ring=ring, slot=slot, magnetization_factor=factor)
              for (ring, slot), factor in factors.items()]
    if len(set(factors.values())) == 1:
        weaker = [weaker[0].with_(ring=None, slot=None)]
    return magnet.with_(demagnetization__irreversible=False,
                        array__exceptions=(*magnet.array.exceptions, *weaker))


def cut(blocks: Sequence[MagnetBlock], numbers: Sequence[int], across: int) -> Cells:
    """Divide the blocks with the given numbers into cells, ``across`` the radial thickness."""
    parts: list[Cut] = []
    count = 0
    for number in numbers:
        parts.append(_cut_block(blocks[number], across))
        count += len(parts[-1][3])
        _check_memory(count, across)
    vertices, corners, middles, volumes = _joined(parts)
    return Cells(vertices, corners, np.repeat(numbers, [len(part[3]) for part in parts]),
                 middles, volumes)


Cut = tuple[Floats, Ints, Floats, Floats]
"""Vertices, corners, centres and volumes of cells, as in `Cells`."""


def _check_memory(count: int, across: int) -> None:
    """Refuse more cells than fit into memory."""
    bytes_each = 800  # of 0.44 million cells 765 were measured
    needed, left = count * bytes_each / 2**30, available_memory()
    if left is not None and needed > left:
        raise StudyError(must_be(
            "--across", "the blocks", f"so small that their cells fit into the {left:.3g} GiB of "
            "memory that are left", f"{across}, for some {count / 1e6:.3g} million cells and "
            f"{needed:.3g} GiB", "Take fewer cells: the thinnest blocks need most."))


def _joined(parts: Sequence[Cut]) -> Cut:
    """Return the cells of several parts together."""
    vertices, corners, middles, volumes = zip(*parts, strict=True)
    starts = np.cumsum([0, *map(len, vertices[:-1])])
    return (np.vstack(vertices),
            np.vstack([own + start for own, start in zip(corners, starts, strict=True)]),
            np.vstack(middles), np.concatenate(volumes))


def _cut_block(block: MagnetBlock, across: int) -> Cut:
    """Return the cells of a block.

    A block of four edges with straight sides is cut along its thickness and width, any other shape
    first into a part about each corner.
    """
    outline = block.outline
    if len(outline) == 4 and not (outline[0].arc or outline[2].arc):
        return _cut_part(block, partial(places_in, outline), across, across)
    return _joined([_cut_part(block, place, max(1, across // 2), across)
                    for place in corner_parts(block)])


def corner_parts(block: MagnetBlock) -> list[Callable[[Floats, Floats], Floats]]:
    """Return the parts of a block's outline about its corners, as functions like `places_in`.

    A part has the corner, the middles of the two edges that meet there, and the middle of the
    outline as its own corners (a Coons patch).

    Raises
    ------
    StudyError
        If some part of the outline cannot be seen from its middle.
    """
    outline = block.outline
    middle = np.mean([edge.at(np.array([0.0, 0.5]))[0] for edge in outline], axis=(0, 1))

    def part(after: Edge, before: Edge) -> Callable[[Floats, Floats], Floats]:
        def place(depth: Floats, width: Floats) -> Floats:
            u, v = depth[:, None, None], width[None, :, None]
            one, other = after.at(depth / 2)[0][:, None], before.at(1 - width / 2)[0][None]
            corner = np.array(after.start)
            ends = after.at(np.array([0.5]))[0][0], before.at(np.array([0.5]))[0][0]
            along = (1 - v) * one + v * ((1 - u) * ends[1] + u * middle)
            across = (1 - u) * other + u * ((1 - v) * ends[0] + v * middle)
            bilinear = ((1 - u) * (1 - v) * corner + u * (1 - v) * ends[0]
                        + (1 - u) * v * ends[1] + u * v * middle)
            return np.asarray(along + across - bilinear)
        return place

    for edge in outline:
        points, normals = edge.at(np.linspace(0.0, 1.0, 9))
        if np.einsum("ij,ij->i", points - middle, normals).min() <= 0:
            raise StudyError(
                f"Input `array.free_blocks` of study must have blocks whose whole outline can be "
                f"seen from its middle, for a map of the demagnetization; instead block "
                f"{block.name} has another. Divide it into several blocks.")
    return [part(after, before)
            for before, after in zip((outline[-1], *outline[:-1]), outline, strict=True)]


def _cut_part(
    block: MagnetBlock, place: Callable[[Floats, Floats], Floats], across: int, fewest_high: int
) -> Cut:
    """Return the cells of a part of a block, as `_cut_block`; ``place`` is like `places_in`.

    They are at least ``across`` in thickness and width, and ``fewest_high`` along z.
    """
    half = np.array([0.5])
    (inner,), (outer,) = place(np.array([0.0, 1.0]), half)
    size = float(np.hypot(*(outer - inner))) / across
    start, stop = place(half, np.array([0.0, 1.0]))[0]
    wide = max(across, _count(float(np.hypot(*(stop - start))), size))
    infinite = np.isinf(block.z_max)
    high = 0 if infinite else max(fewest_high, _count(block.z_max - block.z_min, size))
    _check_memory(across * wide * max(high, 1), across)
    z = np.zeros(1) if infinite else np.linspace(block.z_min, block.z_max, high + 1)

    def lattice(depth: Floats, width: Floats, height: Floats) -> Floats:
        flat = place(depth, width).reshape(-1, 2)
        places = np.column_stack([np.tile(flat, (len(height), 1)), np.repeat(height, len(flat))])
        return places if block.in_magnet_frame else block.from_frame(places)

    vertices = lattice(np.linspace(0, 1, across + 1), np.linspace(0, 1, wide + 1), z)
    middles = lattice((np.arange(across) + 0.5) / across, (np.arange(wide) + 0.5) / wide,
                      z if infinite else (z[1:] + z[:-1]) / 2)
    number = np.arange(len(vertices)).reshape(len(z), across + 1, wide + 1)
    face = np.stack([number[:, :-1, :-1], number[:, 1:, :-1], number[:, 1:, 1:],
                     number[:, :-1, 1:]], axis=-1)
    corners = (face if infinite else np.concatenate([face[:-1], face[1:]], axis=-1))
    corners = corners.reshape(-1, corners.shape[-1])
    first, second, third, fourth = vertices[corners[:, :4]].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(third - first, fourth - second), axis=1) / 2  # of its diagonals
    return vertices, corners, middles, area if infinite else area * (z[1] - z[0])


def _count(length: float, size: float) -> int:
    """Return the number of cells of about a given size along a length."""
    return max(1, round(length / size))


def _vacuum_field(
    blocks: Sequence[MagnetBlock], points: Floats, progress: Progress | None
) -> Floats:
    """Return mu_0 H (n, 3) in T of blocks in vacuum at points (n, 3) in m inside of them."""
    field = np.empty_like(points)
    # of all blocks at some points, which take seconds
    for some in np.array_split(np.arange(len(points)), 1 + len(points) * len(blocks) // 10**7):
        field[some] = field_of(blocks, points[some])
        if progress is not None and len(some):
            progress(int(some[-1]) + 1, len(points))
    return field


def _field_strength(
    magnet: Magnet, cells: Cells, vacuum: Floats, points: Floats, number: Ints, session: Session,
) -> Floats:
    """Return H (n, 3) in A/m at points (n, 3) in m inside the blocks of some numbers (n,).

    The first points are the middles of the cells; ``vacuum`` is that of `_vacuum_field` there.
    """
    field = vacuum
    reacting = magnet.with_(solver__method="reaction")
    if not magnet.is_vacuum and _by_moments(reacting):
        field += _reaction_by_moments(reacting, cells, points, session)
    elif not magnet.is_vacuum:
        _check_equal_rings(magnet)
        formulation = CROSS_SECTION if magnet.dimension == 2 else SCALAR_POTENTIAL
        if magnet.is_nonlinear:
            field += solve_tangent(reacting, points, (), session, formulation, anywhere=True)[0]
        else:
            field += solve_sources(reacting, points, (), session, formulation, anywhere=True)[0]
        if magnet.dimension == 2:
            # In 2D the vector potential gives the reaction as the change of B, so that ``field`` is
            # mu_0 H_vacuum + (mu_0 mu_r H + B_r) - (mu_0 H_vacuum + B_r) = mu_0 mu_r H. The scalar
            # potential of 3D gives mu_0 H itself.
            tensors = np.array([block.recoil_tensor for block in magnet.blocks])[number]
            field = np.linalg.solve(tensors, field[..., None])[..., 0]
    return (field + external_field(magnet, points)) / MU_0


def _by_moments(magnet: Magnet) -> bool:
    """Tell whether a reaction comes from the method of moments, for separate blocks in 3D."""
    route = magnet.study.solver.route
    asked = route == "moments" or not magnet.array.is_uniform or (
        route == "auto" and not is_axisymmetric(magnet))
    return asked and applies(magnet)


def _check_equal_rings(magnet: Magnet) -> None:
    """Refuse rings of their own and free blocks where a mesh of all space is needed in 3D."""
    if magnet.dimension == 3 and not magnet.array.is_uniform:
        raise StudyError(
            f"Input `array` of study {magnet.name} must consist of equal rings for a map of the "
            "demagnetization with iron that is not a coaxial tube or disc; instead it has rings "
            "of their own or free blocks. Leave the iron out, or make it coaxial.")


def write_vtu(found: DemagnetizationMap, path: Path) -> None:
    """Write a VTU file of the cells with H along the magnetization, margin, ring and slot."""
    cells = found.cells
    kind = "quad" if cells.corners.shape[1] == 4 else "hexahedron"
    ring, slot = (np.array([getattr(block, name) for block in found.blocks])[cells.block]
                  for name in ("ring", "slot"))
    mesh = meshio.Mesh(cells.vertices, [(kind, cells.corners)], cell_data={
        "H_along_A_per_m": [found.along], "margin_A_per_m": [found.margin],
        "ring": [ring], "slot": [slot]})
    with atomic(path) as temporary:
        meshio.write(temporary, mesh, file_format="vtu")
