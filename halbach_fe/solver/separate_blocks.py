"""The reaction of separate blocks and of rotationally symmetric iron, without a mesh of the blocks.

The method of moments gives the polarization that recoil permeability induces in the blocks, and
azimuthal modes give the reaction of the iron. If a magnet has both, each is solved in turn in the
field of the other until the polarization of the blocks comes to rest. Recoil permeability is a few
per cent above 1, so that every turn reduces the change by a factor of some 20 or more. The turns
take a coarse mesh of the iron: what its error changes in the polarization of the blocks, and so
in the source of the iron on the usual mesh, is of second order in that small number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats, Ints, of_length
from halbach_fe.core.errors import HalbachError
from halbach_fe.core.progress import Progress
from halbach_fe.geometry.blocks import MagnetBlock, present_blocks
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.axisymmetric_iron import IronReaction, highest_mode_at, solve_iron
from halbach_fe.solver.exact_block_field import FieldOfBlocks, external_field, unit_fields
from halbach_fe.solver.iron_bodies import COARSER, BodiesReaction, key_of, size_of, solve_bodies
from halbach_fe.solver.iron_modes import Asked, Resolution, check_bodies
from halbach_fe.solver.moments.interaction import Interaction
from halbach_fe.solver.moments.solve import (
    KneeLaw,
    Moments,
    System,
    field_with_errors,
    reaction_columns,
    refinement,
    solve_irreversible,
)
from halbach_fe.solver.session import RunSize, Session
from halbach_fe.study.external_keys import External
from halbach_fe.study.materials import MU_0

MANY_BLOCKS = 64
"""Number of blocks from which their field on the iron is summed by expansions."""

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns a field (n, 3) in T."""


@dataclass(frozen=True)
class SeparateReaction:
    """The reaction of blocks and iron to the remanence of the blocks."""

    blocks: tuple[Moments, ...]
    """Polarization of the blocks in cells of the study's size and, for the error bar, of another
    size; none if all permeabilities are 1 and nothing is lost. Of blocks with losses the other one
    has those of the mean field in every cell. It is left out if the study infers variations inside
    the blocks, which make up for errors of the losses."""
    iron: IronReaction | BodiesReaction | None
    without_losses: tuple[Moments, ...] = ()
    """If there are losses, polarization of blocks that have lost nothing, in cells of two sizes:
    for the error bar of what permeability induces."""

    def field(self, points: Floats) -> Floats:
        """Return the reaction (n, 3) in T at points (n, 3) in m."""
        field = np.zeros((len(points), 3))
        if self.blocks:
            field += self.blocks[0].reaction(points)
        if self.iron is not None:
            field += self.iron.field(points)
        return field

    def field_with_errors(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the reaction and its error, both (n, 3) in T, at points (n, 3) in m.

        The length of the error is the error bar in any direction: the sum of those of the parts.
        """
        field, errors = np.zeros((len(points), 3)), [np.zeros((len(points), 3))]
        if self.blocks:
            fine, coarse = self.without_losses or self.blocks
            field, error = field_with_errors(fine, coarse, points)
            errors.append(error)
        if self.without_losses:
            field = self.blocks[0].reaction(points)
            errors.append(self.error_of_losses(points))
        if self.iron is not None:
            of_iron, error = self.iron.field_with_errors(points)
            field = field + of_iron
            errors.append(error)
        return field, of_length(
            np.sum(errors, axis=0), np.linalg.norm(errors, axis=2).sum(axis=0))

    def error_of_losses(self, points: Floats) -> Floats:
        """Return a field (n, 3) in T at points (n, 3) in m as large as the error of the losses."""
        if not self.without_losses or len(self.blocks) < 2:
            return np.zeros((len(points), 3))
        found, by_mean = (each.reaction(points) for each in self.blocks)
        # error bar of the field of irreversible losses, relative to the change that the law of the
        # mean field in every cell makes (`halbach_fe.solver.moments.solve`). Where that
        # module compares 3 and 4 cells a side with finer ones, the error was 0.08 to 0.24 of the
        # change in rings of cuboids, rms, and up to 0.3 near single cubes. The change with 2 cells,
        # which only signatures have, is no measure of their error.
        loss_share = 0.25
        return loss_share * (found - by_mean)


def applies(magnet: Magnet) -> bool:
    """Tell whether the reaction of a magnet can be computed without a mesh of its blocks."""
    return magnet.dimension == 3 and magnet.study.solver.method == "reaction"


def solve_separate(
    magnet: Magnet, session: Session, estimate: bool = True
) -> SeparateReaction:
    """Solve for the reaction of the nominal magnet.

    ``estimate`` tells whether to solve once more for error bars, which takes as long again.

    Raises
    ------
    HalbachError
        If blocks and iron do not come to rest.
    GetDPError
        If the iron cannot be solved.
    """
    own = _Blocks.of(magnet, 2 if estimate else 1)
    if not magnet.iron:
        return _reaction_without_iron(own)
    key: tuple[object, ...] = own, key_of(magnet, session, 1.0)
    if magnet.iron_is_axisymmetric:  # whose mesh follows from the bodies
        study = magnet.study
        key = own, study.iron_ring, study.iron, magnet.array_half_length, session.getdp
    return _latest(Asked(key, partial(_reaction_with_iron, magnet, own, session, estimate)))


@lru_cache(maxsize=1)  # the 0.5 mT line asks for the solution of the field
def _latest(asked: Asked[SeparateReaction]) -> SeparateReaction:
    return asked.compute()


def _reaction_with_iron(
    magnet: Magnet, own: _Blocks, session: Session, estimate: bool
) -> SeparateReaction:
    """Return the reaction of blocks and iron, each in turn in the field of the other."""
    blocks, systems = own.blocks, own.systems()
    remanent = _cached_field(_sum_of_fields(field_in_vacuum(blocks), own.others))
    if not systems:
        return SeparateReaction((), _solve_iron(magnet, remanent, session, estimate))
    iron = _solve_iron(magnet, remanent, session.within("turns"), rough=True)
    middles = np.array([block.mounted_middle for block in blocks])
    scale = max(abs(block.remanence) for block in blocks)
    before = iron.field(middles)
    # largest change of the iron's field in the blocks that may be left when the alternation ends,
    # relative to the largest remanence. The blocks answer with some 5 % of it. It changed readings
    # beside blocks of permeability 1.05 to 2 on a plate by 2e-6 T.
    tolerance = 1e-5
    most_turns, change = 30, np.inf
    # degree of the expansions of the induced polarization at the many points of iron. With 12 it
    # takes five times as long, and changes the field by 5e-5 of its largest value there, rms (990
    # cubes of 12.7 mm, 4 mm from a tube); that field is some 5 % of the source.
    iron_degree = 8
    for _ in range(most_turns):
        polarized = own.polarized(systems[0], iron.field)
        source = _sum_of_fields(remanent, partial(polarized.reaction, degree=iron_degree))
        iron = _solve_iron(magnet, source, session.within("turns"), rough=True, start=iron)
        now = iron.field(middles)
        earlier, change = change, float(np.abs(now - before).max())
        before = now
        # the changes fall as a geometric series, whose rest this is; the first is its own bound
        rest = change if earlier == np.inf else change**2 / max(earlier - change, 1e-300)
        if change < earlier and rest <= tolerance * scale:
            return own.reaction(systems, _solve_iron(magnet, source, session, estimate))
    raise HalbachError(
        f"Blocks and iron of study {magnet.name} do not come to rest in {most_turns} turns: the "
        f"last changed the iron's field by {change:.1e} T. Please report this with the study.")


def external_acts(magnet: Magnet) -> bool:
    """Tell whether iron and blocks answer to the external field: beside iron of any shape."""
    return not magnet.iron_is_axisymmetric and magnet.external != External()


def external_on_losses(magnet: Magnet) -> float:
    """Return the largest external field in T in the middles of blocks with irreversible losses, 0
    if it is too weak for them.
    """
    if not magnet.has_losses or magnet.external == External():
        return 0.0
    # of the coercivity: a hundredth of the width of a usual knee, below which losses hardly change
    weak = 1e-3
    there = external_field(magnet, np.array([
        block.mounted_middle for block in present_blocks(magnet.blocks)]))
    size = float(np.linalg.norm(there, axis=1).max())
    least = min(each.intrinsic_coercivity_A_per_m for each in magnet.demagnetizations)
    return size if size >= weak * MU_0 * least else 0.0


def _solve_iron(
    magnet: Magnet, source: Field, session: Session, estimate: bool = False, rough: bool = False,
    start: Any = None, modes: int | None = None
) -> IronReaction | BodiesReaction:
    """Solve for the reaction of a magnet's iron, on a coarse mesh if ``rough``.

    ``start`` is a solution of the same iron on the same mesh with a similar source. A rough one of
    coaxial iron has azimuthal modes up to ``modes``, by default all that the source needs.
    """
    if magnet.iron_is_axisymmetric:
        resolution = replace(Resolution().coarser(1), modes=modes) if rough else None
        return solve_iron(magnet.iron, source, session, magnet.name, resolution,
                          estimate, start)
    return solve_bodies(magnet, source, session, estimate, start, COARSER if rough else 1.0)


def sizes_of_iron(magnet: Magnet, estimate: bool) -> list[RunSize]:
    """Return the expected sizes of the runs for iron; none if it is rotationally symmetric.

    Raises
    ------
    StudyError
        If bodies overlap.
    """
    if magnet.iron_is_axisymmetric:
        check_bodies(magnet.iron)
        return []
    from halbach_fe.geo.iron_mesh import check_apart  # imports Gmsh

    check_apart(magnet.name, magnet.iron)
    rough = estimate or _permeable(magnet.blocks)
    return [size_of(magnet, coarseness) for coarseness in (1.0, *(COARSER,) * rough)]


def sizes_in_iron(magnet: Magnet) -> list[float]:
    """Return the sizes in m of the elements in bodies of iron of any shape."""
    from halbach_fe.geo.iron_mesh import Sizes  # imports Gmsh

    sizes = Sizes.of(magnet.study.mesh)
    return [sizes.of_body(body) for body in magnet.iron]


def iron_alone(
    magnet: Magnet, points: Floats, session: Session, few_modes: bool = False
) -> Floats:
    """Return the reaction (n, 3) in T of the iron to the blocks in vacuum, at points (n, 3) in m.

    That is a few per cent off the change of field that the iron makes if the blocks are permeable,
    in a small part of the time. The coarse mesh adds 1e-3 of that change, in half the time.
    ``few_modes`` keeps the azimuthal modes that reach the points, where saturation couples more of
    them: in a third of the time, a tube of 2 mm that 1 T saturates was 0.12 off in shape and 0.11
    in amplitude, one of 10 mm 3e-4.
    """
    few = highest_mode_at(magnet.iron, points) if (
        few_modes and magnet.iron_is_axisymmetric) else None
    return _solve_iron(magnet, field_in_vacuum(present_blocks(magnet.blocks)), session,
                       rough=True, modes=few).field(points)


def separate_columns(
    magnet: Magnet, points: Floats, iron: IronReaction | BodiesReaction | None,
    progress: Progress | None = None
) -> Callable[[int, Ints | slice], Floats]:
    """Compute the reaction to every single block at points (n, 3) in m.

    The permeability of the blocks and the iron each answer to the block's own field; what one of
    them answers to the other is neglected, because single blocks describe deviations of a few per
    cent from the nominal magnet.

    Returns
    -------
    callable
        Takes the number of a block, from 0, and indices (k,) of points or a slice; returns the
        reaction (k, 3, 3) in T per T of remanence along each axis.
    """
    blocks = magnet.blocks
    of_blocks = reaction_columns(
        blocks, points, progress=progress) if _permeable(blocks) else None
    of_iron = None if iron is None else np.array(list(columns_of_iron(iron, blocks, points)))

    def column(number: int, some: Ints | slice) -> Floats:
        total = np.zeros((len(points[some]), 3, 3))
        if of_blocks is not None:
            total = total + of_blocks(number, some)
        if of_iron is not None:
            total = total + of_iron[number, some]
        return total

    return column


def columns_of_iron(
    iron: IronReaction | BodiesReaction, blocks: Sequence[MagnetBlock], points: Floats
) -> Iterator[Floats]:
    """Yield the reaction (n, 3, 3) of iron to every single block at points (n, 3) in m, in T per T
    of remanence along each axis. Iron of any shape answers on the coarser mesh of its error bar.
    """
    # angles at which the fields of single blocks on the iron are given, for the 24 modes of
    # `IronReaction.tangent`
    tangent_angles = 64
    acting = (iron.coarse or iron) if isinstance(iron, BodiesReaction) else iron
    for unit in unit_fields(blocks, acting.nodes(tangent_angles)):
        yield np.moveaxis(acting.tangent(np.moveaxis(unit, 2, 0), points), 0, 2)


def field_in_vacuum(blocks: Sequence[MagnetBlock]) -> Field:
    """Return a function of points (n, 3) in m that computes mu_0 H of the blocks in vacuum, in T.

    Many blocks are summed by expansions, at the many points of iron in a small part of the time.
    Their error was measured to be 3e-5 of the largest field 5 mm off cubes of 12 mm, 3e-6 rms.
    """
    if len(blocks) < MANY_BLOCKS or any(
            edge.arc for block in blocks for edge in block.outline) or any(
            block.gradient or block.corner_loss for block in blocks):
        return FieldOfBlocks(blocks)
    system = System.of(blocks, cells_per_side=1, divisions=4)
    cells = system.interaction.cells
    interaction = Interaction(cells, opening=0.4, reading_degree=8)
    polarization = np.broadcast_to(system.remanence[:, None], cells.nodes.shape)
    return interaction.field_function(polarization)


def _cached_field(function: Field) -> Field:
    """Return a function that does not compute the field at the same points again."""
    known: dict[bytes, Floats] = {}

    def field(points: Floats) -> Floats:
        key = hashlib.sha256(points.tobytes()).digest()
        if key not in known:
            known[key] = function(points)
        return known[key]

    return field


def _sum_of_fields(first: Field, second: Field | None) -> Field:
    """Return the sum of two fields."""
    return first if second is None else lambda points: first(points) + second(points)


def _permeable(blocks: Sequence[MagnetBlock]) -> bool:
    """Tell whether any block has another permeability than vacuum."""
    return any(block.is_permeable for block in blocks)


@dataclass(frozen=True)
class _Blocks:
    """What the polarization of blocks depends on."""

    blocks: tuple[MagnetBlock, ...]
    """Those that are there."""
    laws: tuple[KneeLaw, ...] | None
    """Of irreversible losses of each, if there are any."""
    varies: bool
    """Whether the study infers variations inside the blocks."""
    cells_per_side: int | None
    """See `halbach_fe.solver.moments.solve.refinement`."""
    sizes: int
    """Number of sizes of the cells: 2 for error bars."""
    external: External
    """Sources outside that the blocks answer to: beside iron of any shape, and if there are losses
    without iron. Other iron does not answer to them, and may shield the blocks."""
    magnet: Magnet = field(compare=False)
    """Whose blocks are those of neighbours."""

    @classmethod
    def of(cls, magnet: Magnet, sizes: int) -> _Blocks:
        """Return those of a magnet."""
        laws = None
        if magnet.has_losses:
            laws = tuple(KneeLaw.of(material) for block, material in zip(
                magnet.blocks, magnet.demagnetizations, strict=True) if present_blocks((block,)))
        acts = external_acts(magnet) or (not magnet.iron and external_on_losses(magnet))
        return cls(present_blocks(magnet.blocks), laws, magnet.study.prior.variation_sd > 0,
                   magnet.study.mesh.cells_per_side, sizes,
                   magnet.external if acts else External(), magnet)

    @property
    def others(self) -> Field | None:
        """The field of the external sources, if there are any."""
        return None if self.external == External() else partial(external_field, self.magnet)

    def _applied(self, iron: Field | None) -> Field | None:
        """Return the sum of the fields of iron and external sources."""
        return self.others if iron is None else _sum_of_fields(iron, self.others)

    def systems(self) -> tuple[System, ...]:
        """Return the blocks in cells, see `refinement`; none where nothing reacts."""
        if not _permeable(self.blocks) and self.laws is None:
            return ()
        return refinement(self.blocks, self.cells_per_side)[:self.sizes]

    def reaction(
        self, systems: Sequence[System], iron: IronReaction | BodiesReaction | None = None,
        known: Sequence[Moments] = (),
    ) -> SeparateReaction:
        """Return the reaction of blocks in the field of the iron, with another if there are two
        systems for its error bar.

        ``known`` is the polarization of the first system, if it has been solved.
        """
        of_iron = None if iron is None else iron.field
        first = known or [self.polarized(system, of_iron) for system in systems[:1]]
        if self.laws is None or len(systems) < 2:
            return SeparateReaction(
                (*first, *(self.polarized(system, of_iron) for system in systems[1:])), iron)
        by_mean = () if self.varies else (self.polarized(systems[0], of_iron, by_mean=True),)
        applied = self._applied(of_iron)
        return SeparateReaction((*first, *by_mean), iron,
                                tuple(system.solve(applied) for system in systems))

    def polarized(self, system: System, iron: Field | None = None,
                  by_mean: bool = False) -> Moments:
        """Return the polarization of the blocks in the field of the iron, less what they have lost
        irreversibly.

        ``by_mean`` tells whether to use the mean field of the cells, see `solve_irreversible`.
        Neighbours are of the same material, and weaken in the heat as the blocks do; what iron
        answers to other sources is taken to do so, too.
        """
        if self.laws is None:
            return system.solve(self._applied(iron))
        coercivity, remanence = np.array([
            (law.coercivity_T, law.remanence_factor) for law in self.laws])[
                system.interaction.cells.block].T
        law = replace(self.laws[0], coercivity_T=coercivity, remanence_factor=remanence)
        steady = None if self.others is None else partial(
            external_field, self.magnet.with_(external__neighbours=()))
        return solve_irreversible(system, law, self._applied(iron), by_mean=by_mean,
                                  steady=steady)[0]


@lru_cache(maxsize=2)  # every map of a campaign, and every round of an update, asks for the same
def _reaction_without_iron(own: _Blocks) -> SeparateReaction:
    """Return the reaction of blocks without iron."""
    known = _reaction_without_iron(replace(own, sizes=1)).blocks if own.sizes > 1 else ()
    return own.reaction(own.systems(), known=known)
