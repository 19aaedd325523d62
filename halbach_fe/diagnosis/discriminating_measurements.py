"""Find the further measurement that distinguishes two effects which one map cannot.

If an effect is present, with the signature s (its amplitude included), the expected log Bayes
factor of it over a rival with signatures J is half the squared distance that remains when the
blocks, the rival's amplitudes and those of other effects have been fitted to s,

    D = 1/2 min_b [(s - J b)' S^-1 (s - J b) + b'b],    S = Sigma + H C_0 H',

with amplitudes b in units of their prior standard deviation. S is the covariance of the readings
with the blocks integrated out. The gain of a further measurement is D of all readings, old and new,
less D of the old readings. Blocks and amplitudes are the same in both: the offset of a sensor, for
example, turns with the probe, whereas a background field does not.

All fields are those of the nominal blocks in vacuum, without the identified effects, except for
effects that need a finite-element solution. Signatures are therefore accurate to a few per cent,
which is sufficient for a choice between measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sparse
import xarray as xr

from halbach_fe.core.arrays import Bools, Floats, radii_of, spread
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, Place
from halbach_fe.diagnosis.marginal_evidence import Marginal
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign, keys_of
from halbach_fe.geometry.blocks import rotation_about_z, rotation_matrix
from halbach_fe.geometry.domain import boundary_half_length
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.result import HELD_OUT_MAP, InstrumentTerms
from halbach_fe.measurement.campaign_maps import Data
from halbach_fe.measurement.positions import motion
from halbach_fe.response.block_variation import Deviations, vacuum_changes
from halbach_fe.solver.exact_block_field import external_field
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import NoiseCovariance, independent_noise
from halbach_fe.study.measurement_keys import PROBE_KEYS, Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

SEPARATING_GAIN = 5.0
"""Expected gain in the log Bayes factor above which a measurement distinguishes two effects."""

MAX_READINGS = 1500
"""Number of readings to which the present map is thinned for the comparison. The noise of the
remaining readings is reduced, so that the thinned map holds the same information."""

SENSOR_KEYS = {*PROBE_KEYS, "offset_T", "drift_T"}
"""Keys of the study's instrument that belong to the sensors and turn with the probe. All others
belong to the mapper and stay fixed."""

TEMPERATURE_EFFECTS = {"temperature", "temperature_gradient"}
"""Effects that vanish if the magnet's temperature is uniform and measured."""


@dataclass(frozen=True)
class ProposedScan:
    """Readings of a map, present or proposed."""

    points: Floats
    """Points in the mapper's axes. Shape (n, 3), in m."""
    time: Floats
    """Time of each point, from 0 to 1. Shape (n,)."""
    analysis: sparse.csr_array
    """Matrix from B at the points to the readings. Shape (readings, 3 n)."""
    noise: NoiseCovariance
    """Noise of the readings."""
    probe_rotation: Floats
    magnet_rotation: Floats
    """Rotations of the probe and of the magnet in the mapper's axes, relative to their orientation
    in the study. Shape (3, 3)."""
    temperature_known: bool = False
    """Whether the magnet's temperature is uniform and measured."""
    mapped: bool = True
    """Whether the mapper and its probe take the readings; False for an NMR teslameter."""
    map: str | None = None
    """Name of the map, of those that the study lists, whose mapper and probe take them."""
    way: Floats | None = None
    """See `NominalFields.way`; None if all lines go one way, so that a lag does not show.
    Shape (n, 3)."""


@dataclass(frozen=True)
class CandidateMeasurement:
    """A further measurement that can be made."""

    name: str
    title: str
    """Description for a report."""
    scan: ProposedScan
    """The readings that the measurement adds."""


@dataclass(frozen=True)
class Separation:
    """The measurements that can distinguish an identified effect from a rival."""

    identified: Hypothesis
    rival: Hypothesis
    candidates: tuple[CandidateMeasurement, ...]
    """All candidate measurements, the cheapest first."""
    gains: dict[str, float]
    """Expected gain in the log Bayes factor by name of the candidate."""
    recommended: CandidateMeasurement | None
    """The cheapest candidate whose gain exceeds `SEPARATING_GAIN`."""


@dataclass(frozen=True)
class ScanFields(NominalFields):
    """Nominal fields at the points of one scan, in the axes of the rotated probe.

    The magnet is rotated before the mapper. Effects of the instrument take their signatures from
    these fields.
    """

    unrotated: NominalFields
    """The study's magnet at the points of all scans, in the magnet's own axes."""
    part: slice
    """The points of this scan among all points of ``unrotated``."""
    magnet_rotation: Floats
    probe_rotation: Floats
    """Shape (3, 3)."""

    @cached_property
    def field(self) -> Floats:
        """See `NominalFields.field`."""
        own = self.unrotated.block_fields[:, self.part].sum(axis=0) @ self.magnet_rotation.T
        return np.asarray((own + external_field(self.unrotated.magnet, self.points))
                          @ self.probe_rotation)

    @cached_property
    def gradient(self) -> Floats:
        """See `NominalFields.gradient`."""
        turn = self.probe_rotation.T @ self.magnet_rotation
        return np.asarray(turn @ self.unrotated.gradient[self.part] @ turn.T)


def separations(
    diagnosis: Diagnosis, data: Data, session: Session, effects: Sequence[Effect] | None = None,
) -> list[Separation]:
    """Compute what every candidate measurement would gain for each pair of effect and rival.

    Of several maps, the one whose instrument may be in error is measured again, or else the one
    with the most readings. What is open of its instrument remains so.

    Parameters
    ----------
    data : Dataset or dict of str to Dataset
        The maps that were diagnosed.
    effects : sequence of Effect, optional
        The effects among which the diagnosis chose; default the whole catalogue.
    """
    catalogued = {effect.name: effect for effect in effects or catalogue()}
    study = diagnosis.before.study
    campaign = Campaign.of(study, data)
    pairs = [(effect, rival) for effect in diagnosis.identified
             for rival in _rivals(effect, study, catalogued, campaign)]
    if not pairs:
        return []
    names: list[str | None] = [None] if isinstance(data, xr.Dataset) else list(data)
    present = [present_scan(diagnosis, data, name) for name in names]
    again = [_map_of(pair, diagnosis) for pair in pairs]
    candidates = {name: candidate_measurements(diagnosis, data, name)
                  for name in dict.fromkeys(again)}
    scans = [(name, candidate) for name, own in candidates.items() for candidate in own]
    readings = _readings(diagnosis, [*present, *(one.scan for _, one in scans)], session)
    old, all_new = readings[:len(present)], readings[len(present):]
    blocks = np.vstack([one.blocks for one in old])
    marginal_now = Marginal.of(blocks)
    before = [_distance(diagnosis, marginal_now, old, *pair) for pair in pairs]
    found: list[dict[str, float]] = [{} for _ in pairs]
    for (name, candidate), new in zip(scans, all_new, strict=True):
        marginal_after = Marginal.of(np.vstack([blocks, new.blocks]))
        for pair, own, gains, already in zip(pairs, again, found, before, strict=True):
            if own == name:
                total = _distance(diagnosis, marginal_after, [*old, new], *pair)
                gains[candidate.name] = total - already
    return [Separation(effect.hypothesis, rival, tuple(candidates[own]), gains, next(
        (candidate for candidate in candidates[own] if gains[candidate.name] > SEPARATING_GAIN),
        None)) for (effect, rival), own, gains in zip(pairs, again, found, strict=True)]


def _map_of(pair: tuple[IdentifiedEffect, Hypothesis], diagnosis: Diagnosis) -> str | None:
    """Return the name of the map that is to be measured again; None if the study lists none."""
    update = diagnosis.before
    if not update.study.maps:
        return None
    for maps in (pair[0].hypothesis.place.maps, pair[1].place.maps):
        if maps:
            return maps[0]
    listed = [one.name for one in update.study.maps]
    return max(listed, key=update.maps.count)


def candidate_measurements(
    diagnosis: Diagnosis, data: Data, name: str | None = None
) -> list[CandidateMeasurement]:
    """Return the measurements that can be made of a study's magnet, the cheapest first.

    They are made by the mapper and probe of map ``name``, or of the only one.
    """
    nmr_min_field_t = 0.04  # lowest field that the usual NMR probes measure
    nmr_relative_sd = 2e-6  # standard deviation of an NMR teslameter relative to the field
    study, observation = diagnosis.before.study, diagnosis.before.observation
    present = present_scan(diagnosis, data, name)
    same = "the same map" if name is None else f"map {name} again,"
    own = np.array(diagnosis.before.maps) == name if name else slice(None)
    places = observation.positions if name is None else observation.places[own]
    sigma = _point_sigma(diagnosis, own)
    magnet = build_magnet(study)
    middle = np.array([magnet.middle_m])
    centre = NominalFields(study, middle, np.zeros(1), lambda other: np.zeros((1, 3))).field[0]
    size = float(np.linalg.norm(centre))
    found = [
        CandidateMeasurement(
            "probe_rolled", f"{same} with the probe turned by 180° about z",
            replace(present, probe_rotation=present.probe_rotation @ np.diag([-1.0, -1.0, 1.0]))),
        CandidateMeasurement(
            "probe_reversed", f"{same} with the probe turned by 180° about x",
            replace(present, probe_rotation=present.probe_rotation @ np.diag([1.0, -1.0, -1.0])))]
    if size > nmr_min_field_t and not magnet.contains(middle).any():
        found.append(CandidateMeasurement(
            "nmr_point", "one NMR reading in the middle of the bore", ProposedScan(
                middle, np.zeros(1), sparse.csr_array(centre[None] / size),
                independent_noise(np.array([nmr_relative_sd * size])), np.eye(3), np.eye(3),
                mapped=False)))
    radii = np.unique(np.round(radii_of(places), 6))
    radius = 0.8 * magnet.bore_radius
    if radii[-1] > 0.9 * radius:
        radius = 0.5 * max(float(radii[0]), 0.5 * radius)
    heights = spread(np.unique(np.round(places[:, 2], 9)), 40)
    others = [("second_radius", f"circles of radius {1e3 * radius:.0f} mm",
               np.vstack([_circle(radius, z) for z in heights]))]
    if study.dimension == 3:
        half, reach = magnet.array_half_length, magnet.array_outer_radius
        farthest = min(4 * reach, 0.4 * (boundary_half_length(magnet, "extruded") - half))
        low, high = magnet.array_ends
        steps = farthest * np.linspace(0.2, 1, 5)
        beyond = [*(low - steps), *(high + steps)]
        others.append(("far_field", f"points up to {1e3 * farthest:.0f} mm beyond the ends",
                       np.vstack([_circle(0.5 * reach, z, 4) for z in beyond])))
    in_air = [(which, title, points[~magnet.contains(points)]) for which, title, points in others]
    return [
        *found,
        *(CandidateMeasurement(which, title, _point_scan(points, sigma, name))
          for which, title, points in in_air if len(points)),
        CandidateMeasurement(
            "magnet_turned", f"{same} with the magnet turned by 90° about its axis",
            replace(present, magnet_rotation=rotation_about_z(np.pi / 2))),
        CandidateMeasurement(
            "known_temperature", f"{same} at another temperature of the magnet, which is "
            "uniform and measured on the magnet", replace(present, temperature_known=True))]


def present_scan(diagnosis: Diagnosis, data: Data, name: str | None = None) -> ProposedScan:
    """Return a map that was diagnosed, by its name among several.

    All maps together are thinned to about `MAX_READINGS` readings.
    """
    update = diagnosis.before
    observation, campaign = update.observation, Campaign.of(update.study, data)
    used_for_update = np.array(update.parts) != HELD_OUT_MAP
    own = used_for_update & ((np.array(update.maps) == name) | (name is None))
    _, owner = np.unique(observation.positions, axis=0, return_inverse=True)
    count = len(np.unique(owner[own]))
    wanted = max(1, round(count * min(1.0, MAX_READINGS / used_for_update.sum())))
    # steps of the golden ratio, which do not alias with the angles of a circle
    chosen = (np.arange(wanted) * (np.sqrt(5) - 1) / 2 % 1 * count).astype(int)
    kept = own & ((wanted == count) | np.isin(owner.ravel(), np.unique(owner[own])[chosen]))
    analysis = observation.analysis[np.flatnonzero(kept)]
    used = np.unique(analysis.indices // len(COMPONENTS))
    columns = (len(COMPONENTS) * used[:, None] + np.arange(len(COMPONENTS))).ravel()
    covariance = update.errors.subset(kept).covariance * (kept.sum() / own.sum())
    one = campaign.maps[0] if name is None else next(
        each for each in campaign.maps if each.name == name)
    turned = rotation_matrix(one.study_of(update.study).instrument.rotation_rad)
    points = campaign.points_of(update.study)
    way = np.vstack([motion(points[each.rows]) for each in campaign.maps])
    return ProposedScan(
        points[used], campaign.times[used],
        sparse.csr_array(sparse.csc_array(analysis)[:, columns]),
        NoiseCovariance(sparse.csr_array(covariance)), turned, np.eye(3), map=name, way=way[used])


def distance(blocks: Marginal, signature: Floats, rivals: Floats) -> float:
    """Return the expected log Bayes factor of an effect over its rivals.

    It is D of the module's docstring.

    Parameters
    ----------
    blocks : Marginal
        The readings with the blocks integrated out.
    signature : ndarray, shape (n,)
        Whitened signature of the effect, times its amplitude.
    rivals : ndarray, shape (n, k)
        Whitened signatures of the rivals, per standard deviation of their amplitudes.
    """
    return blocks.evidence(rivals, signature).given(range(rivals.shape[1])).chi2 / 2


class _NominalMagnet:
    """The study's magnet at the points of all scans; each signature is computed once."""

    def __init__(self, nominal: NominalFields) -> None:
        self.nominal = nominal
        self.signatures: dict[Hypothesis, Floats] = {}

    @cached_property
    def response(self) -> Floats:
        """B (parameters, n, 3) in T per unit of all parameters of the magnet, in its axes."""
        columns = Deviations.of(self.nominal.magnet).columns(self.nominal.points)
        return np.moveaxis(columns.reshape(*self.nominal.points.shape, -1), 2, 0)

    def seen(self, scan: ProposedScan, part: slice) -> Floats:
        """Return `response` (parameters, k, 3) at the points of a scan, in the mapper's axes.

        What is outside of the magnet does not turn with it.
        """
        found = self.response[:, part] @ scan.magnet_rotation.T
        amplitudes = self.nominal.study.uncertain_of_magnet
        outside = np.flatnonzero([all(name.startswith("external.") for name in one.change)
                                  for one in amplitudes])
        if len(outside):
            found[len(found) - len(amplitudes) + outside] = vacuum_changes(
                self.nominal.magnet, scan.points)[outside]
        return found

    def signature(self, hypothesis: Hypothesis) -> Floats:
        """Return the signature (k, n, 3) in T of an effect of the magnet, in the magnet's axes."""
        if hypothesis not in self.signatures:
            self.signatures[hypothesis] = hypothesis.effect.signature(
                self.nominal, hypothesis.place)
        return self.signatures[hypothesis]


def _readings(
    diagnosis: Diagnosis, scans: Sequence[ProposedScan], session: Session
) -> list[_Readings]:
    """Return the readings of scans.

    Scans with the same points in the magnet's axes share the fields at these points.
    """
    study = diagnosis.before.study
    subsession = replace(session, folder=session.folder / "signatures")
    first: dict[bytes, int] = {}
    stacked: list[Floats] = []
    for scan in scans:
        points = scan.points @ scan.magnet_rotation  # in the magnet's axes
        if points.tobytes() not in first:
            first[points.tobytes()] = sum(map(len, stacked))
            stacked.append(points)
    places = np.vstack(stacked)
    magnet = _NominalMagnet(NominalFields(
        study, places, np.zeros(len(places)),
        lambda other: solve_nominal(build_magnet(other), places, subsession)))
    starts = [first[(scan.points @ scan.magnet_rotation).tobytes()] for scan in scans]
    return [_Readings(diagnosis, scan, magnet, slice(start, start + len(scan.points)))
            for scan, start in zip(scans, starts, strict=True)]


class _Readings:
    """Whitened signatures of effects and blocks in the readings of a scan."""

    def __init__(
        self, diagnosis: Diagnosis, scan: ProposedScan, magnet: _NominalMagnet, part: slice
    ) -> None:
        nominal = magnet.nominal
        self.scan, self.magnet, self.part = scan, magnet, part
        self.mapper = ScanFields(
            nominal.study.with_(instrument=Instrument()), scan.points, scan.time, nominal.solve,
            nominal, part, scan.magnet_rotation, np.eye(3),
            way=np.zeros_like(scan.points) if scan.way is None else scan.way)
        self.sensors = replace(self.mapper, probe_rotation=scan.probe_rotation)
        self.blocks = np.hstack([
            self._whitened(magnet.seen(scan, part)) @ diagnosis.before.prior.root,
            self._open_terms(diagnosis.before.terms)])

    def _open_terms(self, terms: InstrumentTerms | None) -> Floats:
        """Return whitened readings (n, terms) per standard deviation of what the study leaves open
        of the instruments, which are integrated out like the blocks.
        """
        found, effects = [], {effect.name: effect for effect in catalogue()}
        for name, sd in zip(terms.names, terms.prior_sd, strict=True) if terms else ():
            owner, _, term = name.rpartition(".")
            effect, number = _effect_of(term)
            listed = self.magnet.nominal.study.maps
            maps = tuple(one.name for one in listed if owner in (one.name, one.probe, one.stage))
            if listed and not maps:  # of a map that is only predicted
                continue
            found.append(sd * self.of(Hypothesis(effects[effect], Place(maps=maps)))[:, number])
        return np.array(found).T.reshape(self.scan.analysis.shape[0], len(found))

    def of(self, hypothesis: Hypothesis) -> Floats:
        """Return whitened readings (n, k) per unit of each parameter of an effect."""
        return self._whitened(self._signature(hypothesis))

    def _signature(self, hypothesis: Hypothesis) -> Floats:
        """Return the change of B (k, n, 3) in T in the mapper's axes per unit of each parameter."""
        effect, place, scan = hypothesis.effect, hypothesis.place, self.scan
        owner = owner_of(hypothesis, self.magnet.nominal.study)
        gone = scan.temperature_known and effect.name in TEMPERATURE_EFFECTS
        gone |= bool(place.maps) and scan.map not in place.maps
        if gone or (not scan.mapped and owner in ("mapper", "sensors")):
            return np.zeros((len(effect.parameters), len(scan.points), 3))
        if owner == "magnet":
            return self.magnet.signature(hypothesis)[:, self.part] @ scan.magnet_rotation.T
        if owner != "sensors":
            return effect.signature(self.mapper, place)
        return effect.signature(self.sensors, place) @ scan.probe_rotation.T

    def _whitened(self, fields: Floats) -> Floats:
        """Return the whitened readings (readings, k) of fields (k, n, 3) in T."""
        readings = self.scan.analysis @ fields.reshape(len(fields), -1).T
        return self.scan.noise.whiten(np.asarray(readings))


def _effect_of(term: str) -> tuple[str, int]:
    """Return the effect, and the number of its parameter, that a term of an instrument is."""
    kind, *axes = term.removesuffix("_m").removesuffix("_rad").removesuffix("_T").split("_")
    kind, axes = ("translation", axes[1:]) if kind == "stage" else (kind, axes)
    number = COMPONENTS.index(axes[-1]) if axes and axes[-1] in COMPONENTS else 0
    if not axes:  # of a probe of |B|
        return f"{kind}_of_magnitude", 0
    return {"translation": ("mapper_translation", number), "drift": ("drift", number),
            "rotation": (("mapper_tilt_x", "mapper_tilt_y", "mapper_roll")[number], 0),
            "crosstalk": (f"misalignment_{axes[0]}", 0),
            "sensor": (f"sensor_position_{axes[0]}", number)}.get(kind, (f"{kind}_{axes[0]}", 0))


def _distance(
    diagnosis: Diagnosis, blocks: Marginal, readings: Sequence[_Readings],
    identified: IdentifiedEffect, rival: Hypothesis,
) -> float:
    """Return the `distance` of an identified effect from a rival, with the other effects free."""
    # without refinements: they change how large the effect is, which hardly changes what a
    # measurement tells
    def of(hypothesis: Hypothesis) -> Floats:
        return np.vstack([scan.of(hypothesis) for scan in readings])[
            :, :len(hypothesis.effect.parameters)]

    in_full = identified.hypothesis.effect.applied_in_full
    signature = of(identified.hypothesis)
    signature = signature @ (np.ones(1) if in_full else identified.values[:signature.shape[1]])
    if rival.effect.is_binary:
        signature = signature - of(rival)[:, 0]
    free = [other for other in (rival, *(effect.hypothesis for effect in diagnosis.identified))
            if other != identified.hypothesis and not other.effect.is_binary]
    columns = [of(other) * [parameter.sd for parameter in other.effect.parameters]
               for other in free]
    return distance(blocks, signature, np.hstack([np.zeros((len(signature), 0)), *columns]))


def owner_of(
    hypothesis: Hypothesis, study: Study
) -> Literal["magnet", "surroundings", "mapper", "sensors"]:
    """Return the object with which an effect turns.

    It follows from the keys of the study that the effect changes.
    """
    effect, place = hypothesis.effect, hypothesis.place
    own = study.of_map([one.name for one in study.maps].index(place.maps[0])
                       ) if place.maps else study
    if effect.kind == "instrument":
        return "sensors" if keys_of(effect, place, own) & SENSOR_KEYS else "mapper"
    changed = effect.apply(study, place, [parameter.sd for parameter in effect.parameters])
    return "magnet" if changed.external == study.external else "surroundings"


def _rivals(
    identified: IdentifiedEffect, study: Study, catalogued: Mapping[str, Effect],
    campaign: Campaign,
) -> list[Hypothesis]:
    """Return the best effects that the readings cannot distinguish, each at its best place."""
    # Largest number of rivals from which each identified effect is to be distinguished.
    max_rivals = 3
    found: dict[str, Hypothesis] = {}
    for rival, _ in identified.selection.alternatives:
        if rival.effect not in (identified.selection.candidate.effect, *found):
            effect = catalogued[rival.effect]
            # a shortlist may hold places that this omits
            for place in campaign.places(effect, study):
                if place.name == rival.place:
                    found[rival.effect] = Hypothesis(effect, place)
    return list(found.values())[:max_rivals]


def _point_scan(points: Floats, sigma: float, name: str | None) -> ProposedScan:
    """Return a scan of all three components at points, with independent noise ``sigma`` in T."""
    count = 3 * len(points)
    return ProposedScan(
        points, np.linspace(0, 1, len(points)), sparse.csr_array(sparse.eye_array(count)),
        independent_noise(np.full(count, sigma)), np.eye(3), np.eye(3), map=name)


def _point_sigma(diagnosis: Diagnosis, own: Bools | slice) -> float:
    """Return the noise in T of one component at one point, among ``own`` readings.

    The noise of a study with Fourier coefficients is that of a coefficient, which averages over the
    points of a circle.
    """
    update = diagnosis.before
    sigma = float(np.median(update.noise.sd[own]))
    settings = update.study.observation
    if settings.quantity == "fourier_coefficients":
        return sigma * float(np.sqrt(settings.positions.angles / 2))
    return sigma


def _circle(radius: float, z: float, count: int = 12) -> Floats:
    """Return points (count, 3) on a circle about the axis."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])
