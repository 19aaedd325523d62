"""Filling a shim tray: which small magnets to put where so that the field becomes homogeneous.

The field of the measured magnet in the region is normal with mean b and a covariance that no choice
of shims changes, so that the expected mean square of its deviations is least where that of the mean
field with the shims is. Each place holds one magnet of the inventory at one of its angles, or none:
a quadratic function of choices. Starting from an empty tray, the best change of one place is made
until none helps. Then a few places are filled at random and the same is done again, which is undone
unless it improves the whole (an iterated local search). A shim whose strength is uncertain adds the
square of its field times that uncertainty, so that weak gains are not bought with many magnets.

The shims' field is that of cuboids in vacuum. What permeable blocks answer to it is left out; it
counts among the uncertainty that all shims' strengths share. Magnets with iron, which answers more,
are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints, azimuths_of, radii_of, slices, unit_circle
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.geometry.blocks import MagnetBlock, present_blocks, vector
from halbach_fe.geometry.magnet import Magnet, neighbour_blocks
from halbach_fe.geometry.outline import closed_outline
from halbach_fe.geometry.overlaps import block_in_others, overlapping_blocks
from halbach_fe.inference.posterior_files import distributions_of
from halbach_fe.inference.result import InferenceResult
from halbach_fe.response.block_variation import distribution_of, with_variations
from halbach_fe.response.homogeneity import PPM, Homogeneity, HomogeneityModel, homogeneity_model
from halbach_fe.response.region import Region, default_centre, default_region
from halbach_fe.solver.exact_block_field import unit_field
from halbach_fe.solver.session import Session, alone
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.design_keys import ShimMagnet, ShimTray
from halbach_fe.study.free_blocks import COLUMNS
from halbach_fe.study.materials import grade
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

EMPTY = -1


@dataclass(frozen=True)
class Filled:
    """A magnet in a place of a tray."""

    place: int
    """Number of the place, counted from 1."""
    position_m: tuple[float, float, float]
    magnet: ShimMagnet
    from_radius_deg: float
    """Angle of the polarization from the radius of the place."""
    direction_deg: float
    """Angle of the polarization from the x axis of the magnet."""


@dataclass(frozen=True)
class FilledTray(ShownInNotebook):
    """How a shim tray is to be filled, and the homogeneity before and after.

    Attributes
    ----------
    magnet : Magnet
    model : HomogeneityModel
        The linear model of the field in the region, without the shims.
    shimmed : HomogeneityModel
        The same with the shims, whose relative strengths are its last parameters: of each, and of
        all together.
    before_known, after_known : Gaussian
        Distributions of the parameters of both models.
    before, after : Homogeneity
    filled : tuple of Filled
        In the order of the places; empty places are left out.
    places_m : ndarray, shape (places, 3), in m
    left : dict of str to int
        Number of magnets of each kind that remain in the inventory.
    disagreement : str or None
        Sentences if the update of the posterior disagrees with its map, empty if it agrees; None
        if that is not known.
    filled_study : Study or None
        The study with the magnets of the tray as free blocks; None if the tray stays empty.
    """

    magnet: Magnet
    model: HomogeneityModel
    shimmed: HomogeneityModel
    before_known: Gaussian
    after_known: Gaussian
    before: Homogeneity
    after: Homogeneity
    filled: tuple[Filled, ...]
    places_m: Floats
    left: dict[str, int]
    disagreement: str | None = None

    @property
    def filled_study(self) -> Study | None:
        """The study with the magnets of the tray as free blocks; None if the tray stays empty."""
        if not self.filled:
            return None
        study = _with_free_blocks(self.magnet.study, self.filled)
        return study if study.homogeneity is None else study.with_(  # not moved by its shims
            homogeneity__centre_m=default_centre(self.magnet))


@alone
def shim_tray(
    magnet: Magnet, session: Session, posterior: Gaussian | InferenceResult,
    region: Region | None = None,
) -> FilledTray:
    """Choose small magnets for the places of a shim tray so that the field becomes homogeneous.

    Parameters
    ----------
    magnet : Magnet
        Its study has a ``shim_tray``.
    session : Session
        Its folder receives the runs of GetDP and the response matrix.
    posterior : Gaussian or InferenceResult
        Distribution of the magnetizations of the measured magnet in A/m.
    region : Region, optional
        By default the study's, or the sphere of half the radius of the bore about the axis in the
        middle of the magnet.

    Returns
    -------
    FilledTray

    Raises
    ------
    StudyError
        If the study is a cross-section, has no tray or has iron, or a magnet of the tray would
        touch the region, a block or another place.
    MeasurementError
        If the posterior is that of another magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> tray = {"rings": [{"radius_m": 0.08, "count": 8}], "magnets": [
    ...     {"name": "cube", "size_m": [0.005] * 3, "remanence_T": 1.2, "count": 8}]}
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml").with_(shim_tray=tray))
    >>> known = hf.homogeneity(magnet, hf.Session.open("results")).distributions["prior"]
    >>> found = hf.shim_tray(magnet, hf.Session.open("tray"), known)
    >>> found.after.rms_ppm <= found.before.rms_ppm
    True
    """
    tray = magnet.study.shim_tray
    if tray is None:
        raise StudyError(must_be(
            "`shim_tray`", f"study {magnet.name}", "a tray with its magnets", "nothing",
            "Add a table [shim_tray] with, for example, rings = [{ radius_m = 0.08, count = 24 }] "
            'and magnets = [{ name = "cube", size_m = [0.005, 0.005, 0.005], remanence_T = 1.2, '
            "count = 100 }]."))
    if isinstance(posterior, InferenceResult):
        posterior = distributions_of(magnet, posterior)["posterior"]
    posterior = distribution_of(magnet, posterior, "posterior")
    region = region or default_region(magnet)
    choices = _Choices.of(tray, magnet.name)
    _check(magnet, choices, region)
    model = homogeneity_model(magnet, region, session, shims=choices.largest)
    before = model.of(posterior)
    chosen = _best(model, posterior, before, choices, tray)
    if model.sampling.near_shims and (chosen != EMPTY).any():
        # the points about the extremes are those of the shims that were chosen
        model = homogeneity_model(magnet, region, session, shims=choices.magnets(chosen))
        before = model.of(posterior)
    shimmed, known = _with_shims(model, posterior, choices.fields(model.points, chosen), tray)
    filled = []
    for place in np.flatnonzero(chosen != EMPTY).tolist():
        angle = float(choices.angle[chosen[place]])
        azimuth = float(np.degrees(choices.azimuth[place]))
        filled.append(Filled(place + 1, vector(choices.places[place]), tray.magnets[
            choices.kind[chosen[place]]], angle, round(azimuth + angle, 6) % 360))
    left = {each.name: each.count for each in tray.magnets}
    for one in filled:
        left[one.magnet.name] -= 1
    return FilledTray(magnet, model, shimmed, posterior, known, before, shimmed.of(known),
                      tuple(filled), choices.places, left)


def _with_free_blocks(study: Study, filled: Sequence[Filled]) -> Study:
    """Return the study with the magnets of a tray as free blocks.

    They are a ring of their own, whose slots follow all others, so that neither exceptions nor
    types of the study's blocks hold for them.
    """
    array, there = study.array, study.array.free_blocks
    count, slot = len(there or ()), max(array.blocks_by_ring)
    azimuth = np.radians([one.direction_deg - one.from_radius_deg for one in filled])
    direction = np.radians([one.direction_deg for one in filled])
    strength = np.array([_remanence(one.magnet) for one in filled])
    slots = range(slot + 1, slot + 1 + len(filled))
    decimals = 12  # of components in T, so that those of shims along an axis are 0 across it
    shims: dict[str, Sequence[object]] = {
        "name": [f"shim{count + number}" for number in range(1, len(filled) + 1)],
        "shape": ["cuboid"] * len(filled), "slot": slots,
        "material": [one.magnet.material for one in filled],
        "ring": [len(array.blocks_by_ring) - array.rings + 1] * len(filled),
        **_columns("{}_m", np.array([one.position_m for one in filled])),
        "rotation_z_deg": np.degrees(azimuth).tolist(),
        **_columns("size_{}_m", np.array([one.magnet.size_m for one in filled])),
        **_columns("remanence_{}_T", (strength[:, None] * np.column_stack(
            [np.cos(direction), np.sin(direction), 0 * direction])).round(decimals) + 0.0),
        "recoil_permeability": [1.0] * len(filled)}
    own: dict[str, Sequence[object]] = {}
    if there is not None:
        ring, place = zip(*there.places, strict=True)
        own = there.model_dump() | {"ring": ring, "slot": place}
    columns = {name: [*(own.get(name) or [None] * count),
                      *(shims.get(name) or [None] * len(filled))] for name in COLUMNS}
    exceptions = [one.with_(ring=ring) for one in array.exceptions for ring in (
        [one.ring] if one.ring or one.slot else range(1, len(array.blocks_by_ring) + 1))]
    types = study.prior.types and study.prior.types | {"shims": tuple(slots)}
    return study.with_(array__free_blocks=columns, array__exceptions=exceptions,
                       prior__types=types)


def _columns(name: str, values: Floats) -> dict[str, Sequence[object]]:
    """Return columns of components; {} in ``name`` stands for the axis."""
    return {name.format(axis): column for axis, column in zip(
        COMPONENTS, values.T.tolist(), strict=True)}


@dataclass(frozen=True)
class _Choices:
    """What each place can hold: a kind of magnet at an angle."""

    tray: ShimTray
    places: Floats
    """Shape (p, 3), in m."""
    azimuth: Floats
    """Shape (p,), in rad."""
    kind: Ints
    angle: Floats
    """Number of the magnet and angle in degrees from the radius of each choice for a place.
    Shape (o,)."""

    @classmethod
    def of(cls, tray: ShimTray, study: str) -> _Choices:
        """Return the choices of a tray."""
        places = [np.array([ring.radius_m * np.cos(phi), ring.radius_m * np.sin(phi), z])
                  for ring in tray.rings for z in ring.z_m
                  for phi in np.radians(ring.first_angle_deg) + 2 * np.pi * np.arange(
                      ring.count) / ring.count]
        decimals = 12  # decimals of the places in m, so that those on an axis are
        every = np.array([*places, *map(np.array, tray.places_m)]).round(decimals) + 0.0
        options = [(number, angle) for number, each in enumerate(tray.magnets)
                   for angle in each.angles_deg]
        # largest number of places times magnets times angles, which limits memory to a gigabyte
        most_choices = 6000
        if len(every) * len(options) > most_choices:
            raise StudyError(must_be(
                "`shim_tray`", f"study {study}", f"at most {most_choices} choices",
                f"{len(every)} places times {len(options)} magnets and angles",
                "Leave out places, kinds of magnets or angles."))
        azimuth = azimuths_of(every)
        return cls(tray, every, azimuth, np.array([number for number, _ in options]),
                   np.array([angle for _, angle in options]))

    @cached_property
    def blocks(self) -> list[list[MagnetBlock]]:
        """For each kind of magnet the blocks that it is in all places."""
        return [self._in_all_places(each) for each in self.tray.magnets]

    def all_fields(self, points: Floats) -> Floats:
        """Return B (p, o, n, 3) in T at points (n, 3) in m of every choice for every place."""
        found = np.empty((len(self.places), len(self.kind), len(points), 3))
        for number, blocks in enumerate(self.blocks):
            mine = np.flatnonzero(self.kind == number)
            for place, block in enumerate(blocks):
                unit = block.remanence * unit_field(block, points)
                for option in mine:
                    found[place, option] = unit @ self._direction(place, int(option))
        return found

    @property
    def largest(self) -> list[MagnetBlock]:
        """A block in every place that is as large as the largest magnet in each direction."""
        sizes = np.array([each.size_m for each in self.tray.magnets]).max(axis=0).tolist()
        largest = self.tray.magnets[0].with_(size_m=tuple(sizes), angles_deg=(0.0, 180.0))
        return self._in_all_places(largest)

    def _in_all_places(self, magnet: ShimMagnet) -> list[MagnetBlock]:
        return [_block(magnet, place, float(phi), number) for number, (place, phi) in enumerate(
            zip(self.places, self.azimuth, strict=True), start=1)]

    def magnets(self, chosen: Ints) -> list[MagnetBlock]:
        """Return the magnets that were chosen, in the order of their places."""
        found = []
        for place in np.flatnonzero(chosen != EMPTY).tolist():
            option = int(chosen[place])
            found.append(replace(self.blocks[int(self.kind[option])][place],
                                 easy_axis=vector(self._direction(place, option))))
        return found

    def fields(self, points: Floats, chosen: Ints) -> Floats:
        """Return B (shims, n, 3) in T at points (n, 3) in m of the magnets that were chosen."""
        return np.array([block.remanence * unit_field(block, points) @ block.easy_axis
                         for block in self.magnets(chosen)]).reshape(-1, len(points), 3)

    def _direction(self, place: int, option: int) -> Floats:
        """Return the direction (3,) of a polarization."""
        angle = self.azimuth[place] + np.radians(self.angle[option])
        return unit_circle(angle)


def _block(magnet: ShimMagnet, place: Floats, azimuth: float, number: int) -> MagnetBlock:
    """Return a magnet of the inventory in a place of the tray."""
    x, y, z = np.array(magnet.size_m) / 2
    return MagnetBlock(
        ring=0, slot=number, outline=closed_outline(np.array(
            [(-x, -y), (x, -y), (x, y), (-x, y)])), z_min=-float(z), z_max=float(z),
        easy_axis=(float(np.cos(azimuth)), float(np.sin(azimuth)), 0.0),
        remanence=_remanence(magnet),
        recoil_permeability=1.0, recoil_permeability_across=1.0, origin_m=vector(place),
        orientation_rad=(0.0, 0.0, azimuth), label=f"place {number}")


def _remanence(magnet: ShimMagnet) -> float:
    """Return the remanence in T of a magnet of the inventory."""
    return magnet.remanence_T or grade(str(magnet.material)).nominal_remanence


def _check(magnet: Magnet, choices: _Choices, region: Region) -> None:
    """Raise a StudyError if a magnet of the tray would touch anything.

    The largest magnet in each direction stands for all of them.
    """
    if magnet.dimension == 2:
        raise StudyError(must_be("`dimension`", f"study {magnet.name}", "3, for a shim tray", "2"))
    if magnet.iron:
        raise StudyError(must_be(
            "`shim_tray`", f"study {magnet.name}", "in a magnet without iron", "iron",
            "What iron answers to the shims is not computed: leave it out and measure again with "
            "the tray filled."))
    study = f"study {magnet.name}"
    outer = radii_of(choices.places)
    if (outer > magnet.radius).any():
        first = int(np.argmax(outer > magnet.radius))
        raise StudyError(must_be(
            f"place {first + 1} of `shim_tray`", study,
            f"within the magnet, whose radius is {1e3 * magnet.radius:.4g} mm",
            f"{1e3 * outer[first]:.4g} mm from the axis", "Is it in metres?"))
    along, reach = np.abs(choices.places[:, 2]), magnet.field_reach
    if (along > reach).any():
        first = int(np.argmax(along > reach))
        raise StudyError(must_be(
            f"place {first + 1} of `shim_tray`", study,
            f"within {reach:.3g} m of the middle along z, where there is some field",
            f"{along[first]:.4g} m", "Is it in metres?"))
    blocks = choices.largest
    sizes = np.array([each.size_m for each in choices.tray.magnets]).max(axis=0)

    def refuse(number: int, what: str, hint: str) -> None:
        x, y, z = 1e3 * choices.places[number]
        raise StudyError(must_be(
            f"place {number + 1} of `shim_tray`", study, "free for the largest of its magnets",
            f"({x:.4g}, {y:.4g}, {z:.4g}) mm, where it touches {what}", hint))

    if touched := overlapping_blocks(blocks):
        refuse(touched[1], f"that of place {touched[0] + 1}", "Take fewer or smaller magnets.")
    others = present_blocks(magnet.blocks) + neighbour_blocks(
        magnet.blocks, magnet.external.neighbours)
    if touched := block_in_others(blocks, others):
        refuse(touched[0], f"block {others[touched[1]].name}", "Is the tray within the bore?")
    points, _ = region.points(12)
    # points along each side of a magnet that must be outside of the region
    along_side = np.linspace(-0.5, 0.5, 9)
    lattice = np.stack(np.meshgrid(*3 * [along_side]), axis=-1).reshape(-1, 3)
    for number, block in enumerate(blocks):
        own = block.from_frame(lattice * sizes)
        if block.contains(points).any() or region.contains(own).any():
            refuse(number, "the region whose field is to be homogeneous",
                   "Choose a smaller region or a tray of larger radius.")


def _best(
    model: HomogeneityModel, posterior: Gaussian, before: Homogeneity, choices: _Choices,
    tray: ShimTray,
) -> Ints:
    """Return for each place the number of its choice, or EMPTY, (p,)."""
    inner = model.weights > 0
    weight = np.sqrt(model.weights[inner])

    def whitened(along: Floats) -> Floats:
        """Return deviations in ppm (..., n) of components of B (..., n) along the mean field.

        Their squares sum to the variance.
        """
        return PPM / before.mean_T * weight * (
            along - (along @ model.weights[inner])[..., None])

    field = model.field(posterior.stacked.mean[:, None])[..., 0]
    target = whitened(field[inner] @ before.direction)
    points = model.points[:len(inner)][inner]
    at_once = 1000  # points whose fields are in memory with all components
    effect = whitened(np.concatenate([
        choices.all_fields(points[part]) @ before.direction
        for part in slices(len(points), at_once)], axis=-1))
    flat = effect.reshape(-1, effect.shape[-1])
    # an error that all shims share adds the square of their whole field
    search = _Search((1 + tray.common_sd**2) * (flat @ flat.T), flat @ target,
                     float(target @ target), tray.strength_sd**2,
                     np.tile(choices.kind, len(choices.places)), len(choices.places),
                     np.array([each.count for each in tray.magnets]))
    return search.run()


class _Search:
    """Local search for the choices of least mean square.

    The mean square is ``c + 2 sum g_j + sum G_jl + s sum G_jj`` over the chosen j and l.
    ``products`` (m, m) is G and ``gradient`` (m,) is g in ppm^2, for m = places times options, and
    ``kinds`` (m,) are the numbers of the magnets, of which there are ``counts`` (k,). G is
    symmetric, and read by rows, which are contiguous in memory.
    """

    def __init__(
        self, products: Floats, gradient: Floats, constant: float, variance: float, kinds: Ints,
        places: int, counts: Ints,
    ) -> None:
        self.products, self.gradient = products, gradient.copy()
        self.diagonal = np.diag(products).copy()
        self.cost = variance * self.diagonal
        self.kinds, self.places, self.left = kinds, places, counts.copy()
        self.options = len(kinds) // places
        self.place = np.repeat(np.arange(places), self.options)
        self.chosen = np.full(places, EMPTY)
        # smallest decrease of the mean square for which a place is changed, relative to that of the
        # empty tray: of smaller ones, rounding decides
        least_gain = 1e-9
        self.square, self.least = constant, least_gain * constant

    def run(self) -> Ints:
        """Return the choice for every place, (places,)."""
        self._descend()
        generator, idle = np.random.default_rng(0), 0
        patience = 500  # number of disturbances in a row without a gain after which the search ends
        while idle < patience:
            idle += 1
            before = self.chosen.copy(), self.gradient.copy(), self.left.copy(), self.square
            self._disturb(generator)
            self._descend()
            if self.square < before[-1] - self.least:
                idle = 0
            else:
                self.chosen, self.gradient, self.left, self.square = before
        return np.where(self.chosen == EMPTY, EMPTY, self.chosen % self.options)

    def _disturb(self, generator: np.random.Generator) -> None:
        """Fill a few places with random choices."""
        # numbers of places that are filled at random before single places are changed again
        counts = (2, 3, 4)
        count = min(self.places, int(generator.choice(counts)))
        for place in generator.choice(self.places, count, replace=False).tolist():
            allowed = np.flatnonzero(self._allowed() & (self.place == place))
            self._put(place, int(generator.choice(np.append(allowed, EMPTY))))

    def _descend(self) -> None:
        """Change single places until none helps."""
        while self._change_one():
            pass

    def _change_one(self) -> bool:
        """Make the best change of one place; tell whether it helps."""
        change, empty = self._changes()
        allowed = self._allowed()
        change = np.where(allowed, change, np.inf)
        best, bare = int(np.argmin(change)), int(np.argmin(empty))
        if min(change[best], empty[bare]) >= -self.least:
            return False
        if empty[bare] < change[best]:
            self._put(bare, EMPTY)
        else:
            self._put(int(self.place[best]), best)
        return True

    def _changes(self) -> tuple[Floats, Floats]:
        """Return the change of the mean square by every choice (m,), and by emptying places."""
        own = self.chosen[self.place]
        there = own != EMPTY
        empty = np.zeros(self.places)
        full = np.flatnonzero(self.chosen != EMPTY)
        now = self.chosen[full]
        empty[full] = -2 * self.gradient[now] + self.diagonal[now] - self.cost[now]
        change = 2 * self.gradient + self.diagonal + self.cost + empty[self.place]
        change[there] -= 2 * self.products[own[there], np.flatnonzero(there)]
        return change, empty

    def _allowed(self) -> Bools:
        """Return which choices (m,) the inventory allows, instead of what is in the place."""
        own = self.chosen[self.place]
        same = (own != EMPTY) & (self.kinds[np.maximum(own, 0)] == self.kinds)
        return np.asarray((self.left[self.kinds] > 0) | same)

    def _put(self, place: int, choice: int) -> None:
        """Put a choice into a place."""
        for one, sign in ((self.chosen[place], -1), (choice, 1)):
            if one != EMPTY:
                self.square += (2 * sign * self.gradient[one] + self.products[one, one]
                                + sign * self.cost[one])
                self.gradient += sign * self.products[one]
                self.left[self.kinds[one]] -= sign
        self.chosen[place] = choice


def _with_shims(
    model: HomogeneityModel, posterior: Gaussian, fields: Floats, tray: ShimTray
) -> tuple[HomogeneityModel, Gaussian]:
    """Return the model with shims of B (shims, n, 3) in T, and the distribution of parameters.

    Its last parameters are the errors of the shims' strengths, and the one that they share, in
    their standard deviations.
    """
    columns = fields.reshape(len(fields), 3 * len(model.points)).T
    whole = columns.sum(axis=1)
    response = replace(
        model.response, matrix=np.hstack([
            model.response.whole, tray.strength_sd * columns, tray.common_sd * whole[:, None]]),
        offset=model.response.offset + whole,
        nominal=np.append(model.response.nominal, np.zeros(len(fields) + 1)),
        parameters=(*model.response.parameters, *(
            f"shim {number}" for number in range(1, len(fields) + 1)), "all shims"))
    return replace(model, response=response), with_variations(posterior, len(fields) + 1)
