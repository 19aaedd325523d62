"""Designing a magnet of rings: radii, layers and sizes of blocks for a homogeneous field.

`halbach_fe.design.ring_search` chooses among the rings that the study allows. Where it allows radii
between those it lists, all radii are then moved together by a sequence of linear programs, each of
which holds for small moves, as the extremes of the field are linear in them to first order.

Designs of more field than the most homogeneous one are found by the same search with larger least
fields, each from the one before and from the strongest; what remains is a front on which more field
costs homogeneity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.core.numbers import check_number
from halbach_fe.design.forces import DENSITY_KG_PER_M3
from halbach_fe.design.ring_catalogue import Catalogue, Option, design_of, designed, tables_of
from halbach_fe.design.ring_search import MISSES, Found, Task, moved_radii, search
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.response.homogeneity import PPM, Slice, extremes, slice_points, slices_of
from halbach_fe.response.region import Region, default_region, region_points
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.routes import finite_element_part, vacuum_part
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.study.grades import grade
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class RingDesign:
    """Rings along z, and their field in the region."""

    z_m: Floats
    """Places from the middle upwards; those at -z hold equal rings. Shape (p,)."""
    rings: tuple[Option, ...]
    """The ring of each layer in each place, None where it is empty."""
    mean_T: float
    """Mean of |B| over the region's volume."""
    rms_ppm: float
    peak_to_peak_ppm: float
    """Deviations of |B| from it, over the volume and between its extremes, as those of
    `halbach_fe.response.homogeneity`."""
    mass_kg: float
    blocks: int

    def deviation_ppm(self, objective: str) -> float:
        """Return the deviation that the objective names."""
        return self.rms_ppm if objective == "rms" else self.peak_to_peak_ppm


@dataclass(frozen=True)
class Designed(ShownInNotebook):
    """The designs that a search has found.

    Attributes
    ----------
    study : Study
        The study with the rings of the best design.
    region : Region
    best : RingDesign
        The most homogeneous one of those that reach what is asked.
    front : tuple of RingDesign
        Designs of which none is better than another in both field and homogeneity, from the
        weakest to the strongest; the best is among them.
    reached : bool
        Whether the best design reaches least field and largest mass.
    slices : list of Slice
        |B| of the best design in three planes.
    """

    study: Study
    region: Region
    best: RingDesign
    front: tuple[RingDesign, ...]
    reached: bool
    slices: list[Slice]


@alone
def design_rings(
    study: Study, session: Session = NOT_KEPT, region: Region | None = None, seed: int = 1
) -> Designed:
    """Choose the rings of a magnet so that its field in a region is homogeneous.

    Parameters
    ----------
    study : Study
        Its ``design`` lists the rings to choose from and says what is asked.
    session : Session, optional
        Its folder receives what is solved for permeable blocks.
    region : Region, optional
        By default that of the study's ``homogeneity``, or else the sphere about the origin of half
        the radius of its bore.
    seed : int
        Of the random changes of the search.

    Returns
    -------
    Designed

    Raises
    ------
    StudyError
        If the study has no design, rings cannot stand where they are asked to, the region reaches
        into them, or ``seed`` is no whole number of at least 0.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> layer = {"radii_m": [0.09, 0.1, 0.11, 0.12]}
    >>> study = hf.read_study("mri.toml").with_(
    ...     design={"rings": 4, "spacing_m": 0.055, "layer": [layer]})
    >>> found = hf.design_rings(study, hf.Session.open("results"), hf.Region.sphere(0.03))
    >>> len(found.best.rings), found.reached
    (2, True)
    """
    check_number("seed", "design_rings", seed, 0, whole=True)
    design_of(study)  # refuses other magnets, whose array has no rings
    region = region or default_region(build_magnet(study))
    catalogue = Catalogue.of(study, region, _density(study))
    design, generator = catalogue.design, np.random.default_rng(seed)
    direction = catalogue.sample.direction
    reaction = np.zeros_like(catalogue.sample.points)
    task = task_of(catalogue, reaction @ direction)
    places, options = task.table.shape[:2]
    restarts, start_count = 300, 4  # number of random changes from each of several first designs
    starts = np.linspace(0, options - 1, start_count).round().astype(int)
    found = min((search(task, np.full(places, start), restarts, generator)
                 for start in dict.fromkeys(starts.tolist())), key=lambda one: one.ppm)
    if not any(ring for option in catalogue.rings(found.chosen) for ring in option):
        raise StudyError(must_be(
            "`design`", f"study {study.name}", "with limits that some rings can keep",
            "least_field_T and most_mass_kg that no ring comes nearer to than an empty bore",
            "Are they in tesla and kilograms? Raise most_mass_kg."))
    rounds = 3  # largest number of searches with the reaction of permeable blocks
    for _ in range(rounds):
        chosen = found.chosen
        reaction = _reaction(catalogue, chosen, session)
        if not reaction.any():
            break
        task = task_of(catalogue, reaction @ direction)
        found = search(task, chosen, restarts, generator)
        if np.array_equal(chosen, found.chosen):
            break
    every = list({tuple(one.chosen): one
                  for one in (found, *_front(task, found, generator))}.values())
    # the search for more field may find a better design
    number = int(np.argmin([one.ppm for one in every]))
    found = every[number]
    if number:
        reaction = _reaction(catalogue, found.chosen, session)
    reached = found.ppm < MISSES
    # the search worked for the component along the main field, at points
    judged = [_judged(catalogue, region, catalogue.rings(one.chosen), reaction)
              for one in every if not reached or one.ppm < MISSES]
    best = judged[number] if not reached else _least(judged, design.objective)
    if design.between_radii:
        moved = _judged(catalogue, region, moved_radii(
            catalogue, best.rings, reaction @ direction, task), reaction)
        best = moved if not reached else _least([moved, best], design.objective)
    # what is asked of the study next, such as its tolerances, is asked of the same region
    result = designed(study, tables_of(study, catalogue.z_m, best.rings)).with_(
        homogeneity=region.table)
    return Designed(result, region, best, _not_beaten([best, *judged], design.objective),
                    reached, _slices(result, region, session))


def _least(designs: Sequence[RingDesign], objective: str) -> RingDesign:
    """Return the design of the least deviation, of equal ones the strongest."""
    return min(designs, key=lambda one: (one.deviation_ppm(objective), -one.mean_T))


def task_of(catalogue: Catalogue, reaction: Floats) -> Task:
    """Return the search in a catalogue, with the reaction (k,) in T of permeable blocks."""
    design, sample, decide = catalogue.design, catalogue.sample, catalogue.decide
    mean = catalogue.field_T @ sample.weights
    table = np.concatenate([catalogue.field_T[..., decide], mean[..., None],
                            catalogue.mass_kg[..., None]], axis=-1)
    return Task(table, np.append(reaction[decide], [reaction @ sample.weights, 0.0]),
                sample.weights[decide], design.objective, design.least_field_T or 0.0,
                design.most_mass_kg or np.inf)


def _density(study: Study) -> float:
    """Return the density of the blocks in kg/m^3."""
    name = study.array.of_ring(1).material
    return float(np.mean(grade(str(name)).density_kg_per_m3)) if name else DENSITY_KG_PER_M3


def _reaction(catalogue: Catalogue, chosen: Ints, session: Session) -> Floats:
    """Return what permeability adds to B (k, 3) in T at the points of the catalogue's sample."""
    study = designed(catalogue.study, tables_of(catalogue.study, catalogue.z_m,
                                                catalogue.rings(chosen)))
    magnet, sample = build_magnet(study), catalogue.sample
    return _added(magnet, sample.points, session)


def _added(magnet: Magnet, points: Floats, session: Session) -> Floats:
    """Return what permeability adds to B (n, 3) in T at points in air."""
    return finite_element_part(magnet, points, session, columns=False, estimate=False).nominal


def _front(task: Task, best: Found, generator: np.random.Generator) -> list[Found]:
    """Return homogeneous designs of larger and larger fields, towards the strongest one."""
    start = float(task.total(best.chosen)[-2])
    strongest = task.table[..., -2].argmax(axis=1)
    end = float(task.total(strongest)[-2])
    found, last = [], best
    # number of steps from the most homogeneous to the strongest design, which grow with the field:
    # near the strongest one there is nothing left to choose
    levels = 6
    # number of random changes for each design of larger field: it begins near a good one
    restarts = 60
    rounding = 1e-9  # part of a least field by which rounding may miss it
    for step in range(1, levels):
        level = max(start + (end - start) * (step / levels)**2, task.least_field_T)
        harder = replace(task, least_field_T=level * (1 - rounding))
        last = min((search(harder, one, restarts, generator)
                    for one in (last.chosen, strongest)), key=lambda one: one.ppm)
        if last.ppm < MISSES:
            found.append(last)
    return found


def _judged(
    catalogue: Catalogue, region: Region, rings: tuple[Option, ...], reaction: Floats
) -> RingDesign:
    """Return a design with its field, to which permeability adds ``reaction`` (k, 3) in T.

    By how much the extremes exceed those at the points of the catalogue's sample is found from the
    field in vacuum.
    """
    sample = catalogue.sample
    magnet = build_magnet(designed(catalogue.study, tables_of(
        catalogue.study, catalogue.z_m, rings)))
    vacuum = field_of(magnet.blocks, sample.points)
    bare, size = (np.linalg.norm(field, axis=1) for field in (vacuum, vacuum + reaction))
    near = region_points(magnet, region)
    low, high = extremes(region, near.points, near.steps,
                         field_of(magnet.blocks, near.points)[..., None])
    whole = np.ptp(size) + max(high[0] - bare.max(), 0.0) + max(bare.min() - low[0], 0.0)
    mean = float(sample.weights @ size)
    deviation = PPM * (size / mean - 1)
    return RingDesign(
        catalogue.z_m, rings, mean, float(np.sqrt(sample.weights @ deviation**2)),
        float(PPM * whole / mean), catalogue.mass_of(rings), catalogue.blocks_of(rings))


def _not_beaten(designs: Sequence[RingDesign], objective: str) -> tuple[RingDesign, ...]:
    """Return the designs that no other one beats in field and homogeneity, the weakest first."""
    found: list[RingDesign] = []
    for one in sorted(designs, key=lambda each: (-each.mean_T, each.deviation_ppm(objective))):
        if not found or one.deviation_ppm(objective) < found[-1].deviation_ppm(objective):
            found.append(one)
    return tuple(reversed(found))


def _slices(study: Study, region: Region, session: Session) -> list[Slice]:
    """Return |B| in three planes through the region."""
    magnet, points = build_magnet(study), slice_points(region)
    in_air = ~magnet.contains(points)
    size = np.full(len(points), np.nan)
    size[in_air] = np.linalg.norm(vacuum_part(magnet, points[in_air])
                                  + _added(magnet, points[in_air], session), axis=1)
    return slices_of(region, size)
