"""Designing a magnet of rings: radii, layers and sizes of blocks for a homogeneous field.

The field of every possible ring in every place is computed once, so that a design is judged by a
sum of rows of a table. The search is local and repeated: from a design it makes the best change of
one place until none helps, then of two places at once; then it changes a few places at random and
starts again from there, keeping what is better (iterated local search, see H. R. Lourenco,
O. C. Martin and T. Stutzle, Handbook of Metaheuristics (2003) 320). What is asked besides, least
field and largest mass, comes first: of two designs that miss it, the one that misses it by less is
better.

Deviations are those of the component along the main field, which is linear in the rings and
differs from |B| by the square of the components across it. Its extremes lie on the surface of the
region, as it is a harmonic function there. Permeable blocks are taken as they are in vacuum while
the search runs; then their reaction in the design that was found is added to every design, and the
search goes on from there. What is said of a design has its own.

Radii between those of the catalogue are found by a sequence of linear programs (`moved_radii`). For
small moves of the rings the field at every point is linear in them. The moves within a trust region
that make the difference of the largest and the least field smallest, with a mean field as large as
asked, solve a linear program. It is taken if the field itself gets better, with a larger region
next time; otherwise the region shrinks to a quarter.

Designs of more field than the most homogeneous one are found by the same search with larger least
fields, each from the one before and from the strongest; what remains is a front on which more field
costs homogeneity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi, sin, sqrt
from typing import Literal

import numpy as np
from scipy.optimize import linprog

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.numbers import check_number
from halbach_fe.core.threads import compiled
from halbach_fe.design.forces import DENSITY_KG_PER_M3
from halbach_fe.design.ring_catalogue import (
    Catalogue,
    Option,
    RingOfBlocks,
    about_origin,
    design_of,
    designed,
    fields_with_images,
    largest_number,
    reach,
    tables_of,
)
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.response.homogeneity import PPM, Slice, extremes, slice_points, slices_of
from halbach_fe.response.region import Region, default_region, region_points
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.routes import finite_element_part, vacuum_part
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.study.materials import grade
from halbach_fe.study.model import Study

MISSES = 1e9
"""Value in ppm of designs that miss what is asked, above that of every other one."""

TINY_T = 1e-12
"""Mean field below which there is none."""

ROUNDING = 1e-9
"""Part of a least field by which rounding may miss it."""


@dataclass(frozen=True)
class Task:
    """Designs, and what is asked of them."""

    table: Floats
    """Of option o in place p: the component of B along the main field in T at the points that
    decide, its mean over the volume in T, and the mass in kg. Shape (p, o, n + 2)."""
    offset: Floats
    """The same of what every design has besides. Shape (n + 2,)."""
    weights: Floats
    """Of the points in means over the volume. Shape (n,)."""
    objective: Literal["peak_to_peak", "rms"]
    """``peak_to_peak`` or ``rms``."""
    least_field_T: float
    most_mass_kg: float
    """0 and inf where they do not matter."""

    def value(self, total: Floats) -> Floats:
        """Return the deviations (...) in ppm of designs (..., n + 2), and more if they miss."""
        field, mean, mass = total[..., :-2], total[..., -2], total[..., -1]
        if self.objective == "rms":
            deviation = np.sqrt((field - mean[..., None])**2 @ self.weights)
        else:
            deviation = field.max(axis=-1) - field.min(axis=-1)
        missing = (np.maximum(1 - mean / max(self.least_field_T, TINY_T), 0)
                   + np.maximum(mass / self.most_mass_kg - 1, 0))
        return np.asarray(np.where(missing > 0, MISSES * (1 + missing),
                                   PPM * deviation / np.maximum(mean, TINY_T)))

    def total(self, chosen: Ints) -> Floats:
        """Return the sums (n + 2,) of a design (p,)."""
        return np.asarray(self.offset + self.table[np.arange(len(chosen)), chosen].sum(axis=0))


@dataclass(frozen=True)
class Found:
    """A design that a search has found."""

    chosen: Ints
    """Number of the option in each place. Shape (p,)."""
    ppm: float
    """Its deviation, or more than `MISSES`."""


def search(
    task: Task, start: Ints, restarts: int, generator: np.random.Generator, enough: float = 0.0
) -> Found:
    """Return the best design that a local search finds from a design (p,) and its changes.

    It ends after a number of random changes, or with a value of at most ``enough`` in ppm.
    """
    best = _descend(task, start, np.inf)
    places, options = task.table.shape[:2]
    counts = (2, 3, 4)  # numbers of places that are changed at random
    for _ in range(restarts if options > 1 else 0):
        if best.ppm <= enough:
            break
        changed = best.chosen.copy()
        some = generator.choice(places, min(int(generator.choice(counts)), places), replace=False)
        changed[some] = generator.integers(options, size=len(some))
        found = _descend(task, changed, best.ppm)
        if found.ppm < best.ppm:
            best = found
    return best


def _descend(task: Task, start: Ints, best: float) -> Found:
    """Change one place at a time, then two, until none helps.

    ``best`` is the value of the best design so far: pairs are tried where it is not far.
    """
    chosen, total = start.copy(), task.total(start)
    value = float(task.value(total))
    promising = 4.0  # factor to the best value below which pairs are tried
    least_gain = 1e-9  # smallest relative gain of a change: of smaller ones, rounding decides
    while True:
        rest = total - task.table[np.arange(len(chosen)), chosen]
        single = task.value(rest[:, None] + task.table)
        place, option = np.unravel_index(int(np.argmin(single)), single.shape)
        new = {int(place): int(option)}
        least = float(single[place, option])
        if least >= value * (1 - least_gain) and value < promising * best:
            least, new = _best_pair(task, rest, total, single)
        if least >= value * (1 - least_gain):
            return Found(chosen, value)
        chosen[list(new)] = list(new.values())
        total, value = task.total(chosen), least


def _best_pair(
    task: Task, rest: Floats, total: Floats, single: Floats
) -> tuple[float, dict[int, int]]:
    """Return the least value by changes of two places, and the changes.

    ``rest`` (p, n + 2) are the sums without each place, ``single`` (p, o) the values of designs
    with one change.
    """
    paired = 10  # number of rings of each place, the best by themselves, that are tried in pairs
    options = np.argsort(single, axis=1)[:, :paired]
    value, first, one, second, other = best_pair(
        rest, total, task.table, options, task.weights, task.objective == "rms",
        task.least_field_T, task.most_mass_kg, MISSES, TINY_T, PPM)
    return value, {first: one, second: other} if first >= 0 else {}


@compiled
def best_pair(
    rest: Floats, total: Floats, table: Floats, options: Ints, weights: Floats, is_rms: bool,
    least_field: float, most_mass: float, misses: float, tiny: float, ppm: float,
) -> tuple[float, int, int, int, int]:
    """Return the least value of designs with two changes, and the places and options of both.

    The value is that of `Task.value`, of which the other arguments
    are parts. ``rest`` (p, n + 2) are the sums without each place, ``total`` (n + 2,) that with
    all, and ``options`` (p, k) those that are tried in every place. A sum over points ends as soon
    as it is too large for the best.
    """
    points = table.shape[2] - 2
    base = np.empty(table.shape[2])
    best, first, one, second, other = inf, -1, -1, -1, -1
    for a in range(len(rest)):
        for b in range(a + 1, len(rest)):
            for i in options[a]:
                for n in range(points + 2):
                    base[n] = rest[a, n] + rest[b, n] - total[n] + table[a, i, n]
                for j in options[b]:
                    row = table[b, j]
                    mean, mass = base[points] + row[points], base[points + 1] + row[points + 1]
                    missing = max(1 - mean / max(least_field, tiny), 0.0) + max(
                        mass / most_mass - 1, 0.0)
                    if missing > 0:
                        value = misses * (1 + missing)
                    else:
                        scale = ppm / max(mean, tiny)
                        limit = best / scale
                        if is_rms:
                            spread, limit = 0.0, limit * limit
                            for n in range(points):
                                off = base[n] + row[n] - mean
                                spread += weights[n] * off * off
                                if spread > limit:
                                    break
                            value = scale * sqrt(spread)
                        else:
                            least, most = inf, -inf
                            for n in range(points):
                                field = base[n] + row[n]
                                least, most = min(least, field), max(most, field)
                                if most - least > limit:
                                    break
                            value = scale * (most - least)
                    if value < best:
                        best, first, one, second, other = value, a, i, b, j
    return best, first, one, second, other


def moved_radii(
    catalogue: Catalogue, rings: tuple[Option, ...], reaction: Floats, task: Task
) -> tuple[Option, ...]:
    """Return a design whose radii are moved so that its field is more homogeneous.

    Parameters
    ----------
    reaction : ndarray, shape (k,), in T
        Field of permeable blocks, which stays as it is.
    task : Task
        What is asked.
    """
    places = [(place, layer) for place, option in enumerate(rings)
              for layer, ring in enumerate(option) if ring]
    low, high = (np.array(each) for each in zip(*(
        _limits(catalogue, layer, _ring(rings, place, layer)) for place, layer in places),
        strict=True))
    radii = np.array([_ring(rings, place, layer).radius_m for place, layer in places])
    total = _totals(catalogue, rings, places, radii, reaction)
    # first and last size of the trust region; no workshop places a block better than the last
    largest_m, smallest_m = 2e-3, 1e-6
    value, size = float(task.value(total)), largest_m
    tie = _groups(catalogue, places)
    most_programs = 60  # largest number of programs. Each that helps is followed by a larger step.
    for _ in range(most_programs):
        if size < smallest_m:
            break
        slopes = _slopes(catalogue, rings, places, radii) @ tie
        moves = tie @ _program(task, total, slopes, tie, np.maximum(low - radii, -size),
                               np.minimum(high - radii, size),
                               _gaps(catalogue, _with_radii(rings, places, radii), places))
        tried = _totals(catalogue, rings, places, radii + moves, reaction)
        now = float(task.value(tried))
        if now < value:
            radii, total, value, size = radii + moves, tried, now, min(2 * size, largest_m)
        else:
            size /= 4
    return _with_radii(rings, places, radii)


def _ring(rings: Sequence[Option], place: int, layer: int) -> RingOfBlocks:
    """Return the ring in a layer of a place that is not empty."""
    ring = rings[place][layer]
    assert ring is not None
    return ring


def _limits(catalogue: Catalogue, layer: int, ring: RingOfBlocks) -> tuple[float, float]:
    """Return the least and the largest radius in m of a ring with as many blocks."""
    settings, array = catalogue.design.layer[layer], catalogue.study.array.of_ring(1)
    least = min(settings.radii_m)
    if array.block.shape == "cuboid" and largest_number(
            array, least, ring.size_m, settings.gap_m) < ring.blocks:
        if array.block.orientation == "magnetization":
            room = (sqrt(2) * ring.size_m + settings.gap_m) / (2 * sin(pi / ring.blocks))
        else:
            room = (ring.size_m + settings.gap_m) / (2 * np.tan(pi / ring.blocks)) + ring.size_m / 2
        least = min(float(room), ring.radius_m)  # a catalogue may be closer than it need be
    return least, max(settings.radii_m)


def _groups(catalogue: Catalogue, places: Sequence[tuple[int, int]]) -> Floats:
    """Return the matrix (rings, moves) from independent moves to those of all rings."""
    if not catalogue.design.layers_together:
        return np.eye(len(places))
    numbers = sorted({place for place, _ in places})
    return np.array([[float(place == number) for number in numbers] for place, _ in places])


def _with_radii(
    rings: Sequence[Option], places: Sequence[tuple[int, int]], radii: Floats
) -> tuple[Option, ...]:
    """Return the rings with other radii in m."""
    decimals = 7  # decimals of radii in m: finer than any workshop
    new = dict(zip(places, radii.round(decimals).tolist(), strict=True))
    return tuple(tuple(ring and replace(ring, radius_m=new[place, layer])
                       for layer, ring in enumerate(option)) for place, option in enumerate(rings))


def _ring_total(catalogue: Catalogue, ring: RingOfBlocks, place: int) -> Floats:
    """Return the field (n,) in T where it decides and its mean, of a ring and its image."""
    sample = catalogue.sample
    field, = fields_with_images(catalogue.study, ring, catalogue.z_m[place:place + 1],
                                sample.points) @ sample.direction
    return np.append(field[catalogue.decide], sample.weights @ field)


def _totals(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]],
    radii: Floats, reaction: Floats,
) -> Floats:
    """Return the sums (n + 2,) of a design with other radii, see `Task.table`."""
    weights = catalogue.sample.weights
    moved = _with_radii(rings, places, radii)
    total = np.append(reaction[catalogue.decide], weights @ reaction) + np.sum([
        _ring_total(catalogue, _ring(moved, place, layer), place) for place, layer in places],
        axis=0)
    return np.append(total, catalogue.mass_of(moved))


def _slopes(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]],
    radii: Floats,
) -> Floats:
    """Return the derivatives (n + 1, rings) in T/m of field and mean by each radius."""
    found = []
    # step of the derivatives by a radius: that of a field which falls as 1/r^3 is exact to 1e-7
    step_m = 1e-5
    for (place, layer), radius in zip(places, radii.tolist(), strict=True):
        ring = _ring(rings, place, layer)
        above, below = (_ring_total(catalogue, replace(ring, radius_m=radius + step), place)
                        for step in (step_m, -step_m))
        found.append((above - below) / (2 * step_m))
    return np.array(found).T


def _gaps(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]]
) -> list[tuple[int, int, float]]:
    """Return pairs of neighbouring rings at one place, and by how much in m they may approach."""
    ranges = [reach(catalogue.study, _ring(rings, *place)) for place in places]
    return [(number, number + 1, max(outer[0] - inner[1], 0.0))
            for number, (inner, outer) in enumerate(pairwise(ranges))
            if places[number][0] == places[number + 1][0]]


def _program(
    task: Task, total: Floats, slopes: Floats, tie: Floats, low: Floats, high: Floats,
    apart: Sequence[tuple[int, int, float]],
) -> Floats:
    """Return the moves (moves,) in m that a linear program finds.

    Its unknowns are the moves, the least and the largest field, in parts of the mean field.
    """
    field, mean = total[:-2] / total[-2], total[-2]
    by_field, by_mean = slopes[:-1] / mean, slopes[-1]
    one, zero = np.ones((len(field), 1)), np.zeros((len(field), 1))
    rows = [np.hstack([by_field, zero, -one]), np.hstack([-by_field, one, zero]),
            np.append(-by_mean, [0.0, 0.0])[None]]
    limits = [-field, field, [max(mean - task.least_field_T, 0.0)]]
    for inner, outer, gap in apart:
        rows.append(np.append(tie[inner] - tie[outer], [0.0, 0.0])[None])
        limits.append([gap])
    bounds = [(low[mine].max(), high[mine].min()) for mine in (tie.T > 0)]
    aim = np.append(np.zeros(len(bounds)), [-1.0, 1.0])
    found = linprog(aim, np.vstack(rows), np.concatenate(limits),
                    bounds=[*bounds, (None, None), (None, None)])
    return np.asarray(found.x[:-2]) if found.success else np.zeros(len(bounds))


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
    region = region or default_region(about_origin(study))
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
        reaction = _reaction(catalogue, catalogue.rings(chosen), session)
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
    reached = every[number].ppm < MISSES
    # the search worked for the component along the main field, at points
    judged = [_judged(catalogue, region, catalogue.rings(one.chosen), session)
              for one in every if not reached or one.ppm < MISSES]
    strongest = max(judged, key=lambda one: one.mean_T)
    # the reaction that it took for all may have made one stronger than it is
    least = (design.least_field_T or 0.0) * (1 - ROUNDING)
    enough = [one for one in judged if one.mean_T >= least]
    best = _least(enough, design.objective) if reached and enough else (
        strongest if reached else judged[number])
    reached = reached and bool(enough)
    if design.between_radii:
        moved = _judged(catalogue, region, moved_radii(
            catalogue, best.rings, _reaction(catalogue, best.rings, session) @ direction, task),
            session)
        best = moved if not reached else _least([best, *(
            [moved] if moved.mean_T >= least else [])], design.objective)
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


def _magnet(catalogue: Catalogue, rings: tuple[Option, ...]) -> Magnet:
    """Return the magnet of a design."""
    return build_magnet(designed(catalogue.study, tables_of(
        catalogue.study, catalogue.z_m, rings)))


def _reaction(catalogue: Catalogue, rings: tuple[Option, ...], session: Session) -> Floats:
    """Return what permeability adds to B (k, 3) in T at the points of the catalogue's sample."""
    return _added(_magnet(catalogue, rings), catalogue.sample.points, session)


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
    for step in range(1, levels):
        level = max(start + (end - start) * (step / levels)**2, task.least_field_T)
        harder = replace(task, least_field_T=level * (1 - ROUNDING))
        last = min((search(harder, one, restarts, generator)
                    for one in (last.chosen, strongest)), key=lambda one: one.ppm)
        if last.ppm < MISSES:
            found.append(last)
    return found


def _judged(
    catalogue: Catalogue, region: Region, rings: tuple[Option, ...], session: Session
) -> RingDesign:
    """Return a design with its field, and what permeability adds to it.

    By how much the extremes exceed those at the points of the catalogue's sample is found from the
    field in vacuum.
    """
    sample, magnet = catalogue.sample, _magnet(catalogue, rings)
    reaction = _added(magnet, sample.points, session)
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
