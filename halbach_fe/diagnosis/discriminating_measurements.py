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

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import Diagnosis, Hypothesis, IdentifiedEffect
from halbach_fe.geometry.domain import boundary_half_length
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.inference.result import HELD_OUT_MAP
from halbach_fe.measurement.instrument import map_time, probe_points
from halbach_fe.solver.exact_block_field import unit_fields
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.formulation_choice import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats.noise import NoiseCovariance, independent_noise
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

SEPARATING_GAIN = 5.0
"""Expected gain in the log Bayes factor above which a measurement distinguishes two effects."""

MAX_RIVALS = 3
"""Largest number of rivals from which each identified effect is to be distinguished."""

MAX_READINGS = 1500
"""Number of readings to which the present map is thinned for the comparison. The noise of the
remaining readings is reduced, so that the thinned map holds the same information."""

NMR_RELATIVE_SD = 2e-6
"""Standard deviation of an NMR teslameter relative to the field."""

NMR_MIN_FIELD_T = 0.04
"""Lowest field that the usual NMR probes measure."""

MAPPER_KEYS = {"translation_m", "rotation_rad", "z_scale", "radius_scale", "radius_offset_m",
               "eccentricity_m", "arm_sag_m"}
"""Keys of the study's instrument that belong to the mapper and stay fixed when its probe is turned.
All other keys belong to the probe."""

TEMPERATURE_EFFECTS = {"temperature", "temperature_gradient"}
"""Effects that vanish if the magnet's temperature is uniform and measured."""


@dataclass(frozen=True)
class ProposedScan:
    """Readings of a map, present or proposed.

    Attributes
    ----------
    points : ndarray, shape (n, 3), in m
        Points in the mapper's axes.
    time : ndarray, shape (n,)
        Time of each point, from 0 to 1.
    analysis : sparse array, shape (readings, 3 n)
        Matrix from B at the points to the readings.
    noise : NoiseCovariance
        Noise of the readings.
    probe_rotation, magnet_rotation : ndarray, shape (3, 3)
        Rotations of the probe and of the magnet in the mapper's axes, relative to their orientation
        in the study.
    temperature_known : bool
        Whether the magnet's temperature is uniform and measured.
    mapped : bool
        Whether the mapper and its probe take the readings; False for an NMR teslameter.
    """

    points: Floats
    time: Floats
    analysis: sparse.csr_array
    noise: NoiseCovariance
    probe_rotation: Floats
    magnet_rotation: Floats
    temperature_known: bool = False
    mapped: bool = True


@dataclass(frozen=True)
class CandidateMeasurement:
    """A further measurement that can be made.

    Attributes
    ----------
    name : str
    title : str
        Description for a report.
    scan : ProposedScan
        The readings that the measurement adds.
    """

    name: str
    title: str
    scan: ProposedScan


@dataclass(frozen=True)
class Separation:
    """The measurements that can distinguish an identified effect from a rival.

    Attributes
    ----------
    identified, rival : Hypothesis
    candidates : tuple of CandidateMeasurement
        All candidate measurements, the cheapest first.
    gains : dict
        Expected gain in the log Bayes factor by name of the candidate.
    recommended : CandidateMeasurement or None
        The cheapest candidate whose gain exceeds `SEPARATING_GAIN`.
    """

    identified: Hypothesis
    rival: Hypothesis
    candidates: tuple[CandidateMeasurement, ...]
    gains: dict[str, float]
    recommended: CandidateMeasurement | None


@dataclass(frozen=True)
class ScanFields(NominalFields):
    """Nominal fields at the points of one scan, in the axes of the rotated probe.

    The magnet is rotated before the mapper. Effects of the instrument take their signatures from
    these fields.

    Attributes
    ----------
    unrotated : NominalFields
        The study's magnet at the points of all scans, in the magnet's own axes.
    part : slice
        The points of this scan among all points of ``unrotated``.
    magnet_rotation, probe_rotation : ndarray, shape (3, 3)
    """

    unrotated: NominalFields
    part: slice
    magnet_rotation: Floats
    probe_rotation: Floats

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
    diagnosis: Diagnosis, data: xr.Dataset, session: Session,
    effects: Sequence[Effect] | None = None,
) -> list[Separation]:
    """Compute what every candidate measurement would gain for each pair of effect and rival.

    Parameters
    ----------
    diagnosis : Diagnosis
    data : Dataset
        The map that was diagnosed.
    session : Session
    effects : sequence of Effect, optional
        The effects among which the diagnosis chose; default the whole catalogue.
    """
    catalogued = {effect.name: effect for effect in effects or catalogue()}
    pairs = [(effect, rival) for effect in diagnosis.identified
             for rival in _rivals(effect, diagnosis.before.study, catalogued)]
    if not pairs:
        return []
    candidates = candidate_measurements(diagnosis, data)
    old, *all_new = _readings(diagnosis, [
        present_scan(diagnosis, data), *(candidate.scan for candidate in candidates)], session)
    marginal_now = Marginal.of(old.blocks)
    before = [_distance(diagnosis, marginal_now, [old], *pair) for pair in pairs]
    found: list[dict[str, float]] = [{} for _ in pairs]
    for candidate, new in zip(candidates, all_new, strict=True):
        marginal_after = Marginal.of(np.vstack([old.blocks, new.blocks]))
        for pair, gains, already in zip(pairs, found, before, strict=True):
            total = _distance(diagnosis, marginal_after, [old, new], *pair)
            gains[candidate.name] = total - already
    return [Separation(effect.hypothesis, rival, tuple(candidates), gains, next(
        (candidate for candidate in candidates if gains[candidate.name] > SEPARATING_GAIN), None))
        for (effect, rival), gains in zip(pairs, found, strict=True)]


def candidate_measurements(diagnosis: Diagnosis, data: xr.Dataset) -> list[CandidateMeasurement]:
    """Return the measurements that can be made of a study's magnet, the cheapest first."""
    study, observation = diagnosis.before.study, diagnosis.before.observation
    present = present_scan(diagnosis, data)
    sigma = _point_sigma(diagnosis)
    centre = NominalFields(study, np.zeros((1, 3)), np.zeros(1),
                           lambda other: np.zeros((1, 3))).field[0]
    size = float(np.linalg.norm(centre))
    found = [
        CandidateMeasurement(
            "probe_rolled", "the same map with the probe turned by 180° about z",
            replace(present, probe_rotation=np.diag([-1.0, -1.0, 1.0]))),
        CandidateMeasurement(
            "probe_reversed", "the same map with the probe turned by 180° about x",
            replace(present, probe_rotation=np.diag([1.0, -1.0, -1.0])))]
    if size > NMR_MIN_FIELD_T:
        found.append(CandidateMeasurement(
            "nmr_point", "one NMR reading in the middle of the bore", ProposedScan(
                np.zeros((1, 3)), np.zeros(1), sparse.csr_array(centre[None] / size),
                independent_noise(np.array([NMR_RELATIVE_SD * size])), np.eye(3), np.eye(3),
                mapped=False)))
    radii = np.unique(np.round(observation.radii, 6))
    magnet = build_magnet(study)
    radius = 0.8 * magnet.bore_radius
    if radii[-1] > 0.9 * radius:
        radius = 0.5 * max(float(radii[0]), 0.5 * radius)
    heights = np.unique(np.round(observation.map_points[:, 2], 9))
    heights = heights[np.linspace(0, len(heights) - 1, min(len(heights), 40)).astype(int)]
    found.append(CandidateMeasurement(
        "second_radius", f"circles of radius {1e3 * radius:.0f} mm",
        _point_scan(np.vstack([_circle(radius, z) for z in heights]), sigma)))
    if study.dimension == 3:
        half, reach = magnet.array_half_length, magnet.array_outer_radius
        farthest = min(4 * reach, 0.4 * (boundary_half_length(magnet, "extruded") - half))
        beyond = [side * (half + farthest * step) for side in (-1, 1)
                  for step in np.linspace(0.2, 1, 5)]
        found.append(CandidateMeasurement(
            "far_field", f"points up to {1e3 * farthest:.0f} mm beyond the ends",
            _point_scan(np.vstack([_circle(0.5 * reach, z, 4) for z in beyond]), sigma)))
    return [
        *found,
        CandidateMeasurement(
            "magnet_turned", "the same map with the magnet turned by 90° about its axis",
            replace(present, magnet_rotation=rotation_about_z(np.pi / 2))),
        CandidateMeasurement(
            "known_temperature", "the same map at another temperature of the magnet, which is "
            "uniform and measured on the magnet", replace(present, temperature_known=True))]


def present_scan(diagnosis: Diagnosis, data: xr.Dataset) -> ProposedScan:
    """Return the map that was diagnosed, thinned to about `MAX_READINGS` readings."""
    update = diagnosis.before
    observation = update.observation
    own = np.array(update.parts) != HELD_OUT_MAP
    _, owner = np.unique(observation.positions, axis=0, return_inverse=True)
    count = len(np.unique(owner[own]))
    wanted = max(1, round(count * min(1.0, MAX_READINGS / own.sum())))
    # steps of the golden ratio, which do not alias with the angles of a circle
    chosen = (np.arange(wanted) * (np.sqrt(5) - 1) / 2 % 1 * count).astype(int)
    kept = own & ((wanted == count) | np.isin(owner.ravel(), np.unique(owner[own])[chosen]))
    analysis = observation.analysis[np.flatnonzero(kept)]
    used = np.unique(analysis.indices // len(COMPONENTS))
    columns = (len(COMPONENTS) * used[:, None] + np.arange(len(COMPONENTS))).ravel()
    covariance = update.errors.subset(kept).covariance * (kept.sum() / own.sum())
    return ProposedScan(
        probe_points(update.study.instrument, observation.map_points[used]), map_time(data)[used],
        sparse.csr_array(sparse.csc_array(analysis)[:, columns]),
        NoiseCovariance(sparse.csr_array(covariance)), np.eye(3), np.eye(3))


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
        """B (parameters, n, 3) in T for a magnetization of 1 A/m of each block along each axis."""
        size = self.nominal.study.dimension
        return np.concatenate([
            np.moveaxis(unit @ (MU_0 * block.recoil_tensor[:, :size]), 2, 0)
            for block, unit in zip(
                self.nominal.blocks, unit_fields(self.nominal.blocks, self.nominal.points),
                strict=True)])

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
            nominal.study, scan.points, scan.time, nominal.solve, nominal, part,
            scan.magnet_rotation, np.eye(3))
        self.sensors = replace(self.mapper, probe_rotation=scan.probe_rotation)
        self.blocks = self._whitened(
            magnet.response[:, part] @ scan.magnet_rotation.T) @ diagnosis.before.prior.root

    def of(self, hypothesis: Hypothesis) -> Floats:
        """Return whitened readings (n, k) per unit of each parameter of an effect."""
        return self._whitened(self._signature(hypothesis))

    def _signature(self, hypothesis: Hypothesis) -> Floats:
        """Return the change of B (k, n, 3) in T in the mapper's axes per unit of each parameter."""
        effect, place, scan = hypothesis.effect, hypothesis.place, self.scan
        owner = owner_of(hypothesis, self.magnet.nominal.study)
        gone = scan.temperature_known and effect.name in TEMPERATURE_EFFECTS
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


def _distance(
    diagnosis: Diagnosis, blocks: Marginal, readings: Sequence[_Readings],
    identified: IdentifiedEffect, rival: Hypothesis,
) -> float:
    """Return the `distance` of an identified effect from a rival, with the other effects free."""
    def of(hypothesis: Hypothesis) -> Floats:
        return np.vstack([scan.of(hypothesis) for scan in readings])

    in_full = identified.hypothesis.effect.applied_in_full
    signature = of(identified.hypothesis)
    # refinements change how large the effect is, which hardly changes what a measurement tells
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
    effect = hypothesis.effect
    amplitudes = [parameter.sd for parameter in effect.parameters]
    changed = effect.apply(study, hypothesis.place, amplitudes)
    if effect.kind == "field":
        return "magnet" if changed.external == study.external else "surroundings"
    keys = {name for name, value in changed.instrument
            if value != getattr(study.instrument, name)}
    return "mapper" if keys <= MAPPER_KEYS else "sensors"


def _rivals(
    identified: IdentifiedEffect, study: Study, catalogued: Mapping[str, Effect]
) -> list[Hypothesis]:
    """Return the best effects that the readings cannot distinguish, each at its best place."""
    found: dict[str, Hypothesis] = {}
    for rival, _ in identified.selection.alternatives:
        if rival.effect not in (identified.selection.candidate.effect, *found):
            effect = catalogued[rival.effect]
            for place in effect.places(study):  # a shortlist may hold places that this omits
                if place.name == rival.place:
                    found[rival.effect] = Hypothesis(effect, place)
    return list(found.values())[:MAX_RIVALS]


def _point_scan(points: Floats, sigma: float) -> ProposedScan:
    """Return a scan of all three components at points, with independent noise ``sigma`` in T."""
    count = 3 * len(points)
    return ProposedScan(
        points, np.linspace(0, 1, len(points)), sparse.csr_array(sparse.eye_array(count)),
        independent_noise(np.full(count, sigma)), np.eye(3), np.eye(3))


def _point_sigma(diagnosis: Diagnosis) -> float:
    """Return the noise in T of one component at one point.

    The noise of a study with Fourier coefficients is that of a coefficient, which averages over the
    points of a circle.
    """
    update = diagnosis.before
    sigma = float(np.median(update.noise.sd))
    settings = update.study.observation
    if settings.quantity == "fourier_coefficients":
        return sigma * float(np.sqrt(settings.positions.angles / 2))
    return sigma


def _circle(radius: float, z: float, count: int = 12) -> Floats:
    """Return points (count, 3) on a circle about the axis."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])
