"""Which further measurement would tell two effects apart that one map cannot.

If an effect is there, with the signature s (its amplitude included), the expected log Bayes factor
of it over a rival with signatures J is half the squared distance that remains when the blocks, the
rival's amplitudes and those of other effects have been fitted to it,

    D = 1/2 min_b [(s - J b)' S^-1 (s - J b) + b'b],    S = Sigma + H C_0 H',

amplitudes b counting in units of their prior standard deviation; S is the covariance of readings
with the blocks integrated out. What a measurement gains is D of all readings, old and new, less D
of the old ones. The blocks are the same in both, and so are amplitudes: an offset of a sensor stays
with the sensor when the probe is turned, a background does not.

All fields are those of blocks in vacuum (but for effects that have to be solved for), of the study
as it was: signatures are a few per cent off, which a choice between measurements does not feel.
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
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.field import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.solver.vacuum_field import unit_fields
from halbach_fe.stats.noise import NoiseCovariance, independent
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

ENOUGH = 5.0
"""Expected log Bayes factor from which a measurement separates."""

MOST_RIVALS = 3
"""Of a named effect, to be told from it."""

MOST_READINGS = 1500
"""Of a map, for the comparison: others are left out, and the noise of the rest is less."""

NMR_ACCURACY = 2e-6
"""Of the field, of a teslameter."""

NMR_LEAST_T = 0.04
"""Below that the usual probes see nothing."""

MAPPER_KEYS = {"translation_m", "rotation_rad", "z_scale", "radius_scale", "radius_offset_m",
               "eccentricity_m", "arm_sag_m"}
"""Of the instrument, what belongs to the mapper and stays when its probe is turned; the rest
belongs to the probe."""

OF_TEMPERATURE = {"temperature", "temperature_gradient"}
"""Effects that are gone when the magnet's temperature is even, and known."""


@dataclass(frozen=True)
class ProposedScan:
    """Readings to come.

    Attributes
    ----------
    points : ndarray, shape (n, 3), in m
        In the mapper's axes.
    time : ndarray, shape (n,)
        Of each point, from 0 to 1.
    analysis : sparse array, shape (readings, 3 n)
        From B there to readings.
    noise : Noise
        Of the readings.
    probe_rotation, magnet_rotation : ndarray, shape (3, 3)
        How the probe stands in the mapper, and the magnet before it; the study has both straight.
    temperature_known : bool
    mapped : bool
        Whether the mapper and its probe took them.
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
    """A measurement that could be made.

    Attributes
    ----------
    name : str
    title : str
        In words, for a report.
    campaign : Campaign
    """

    name: str
    title: str
    campaign: ProposedScan


@dataclass(frozen=True)
class Separation:
    """What would tell a named effect from a rival.

    Attributes
    ----------
    named, rival : Hypothesis
    options : tuple of Option
        The cheapest first.
    gains : dict
        Expected gain in the log Bayes factor, by name of the option.
    recommended : Option or None
        The cheapest that gains enough.
    """

    named: Hypothesis
    rival: Hypothesis
    options: tuple[CandidateMeasurement, ...]
    gains: dict[str, float]
    recommended: CandidateMeasurement | None


@dataclass(frozen=True)
class Seen(NominalFields):
    """What a campaign meets: some points of a scene, its magnet turned before the mapper, in the
    axes of a turned probe.

    Attributes
    ----------
    straight : Scene
        The study's magnet at the points of all campaigns, in its own axes.
    part : slice
        Of these points.
    magnet_rotation, probe_rotation : ndarray, shape (3, 3)
    """

    straight: NominalFields
    part: slice
    magnet_rotation: Floats
    probe_rotation: Floats

    @cached_property
    def field(self) -> Floats:
        """See `NominalFields.field`."""
        own = self.straight.block_fields[:, self.part].sum(axis=0) @ self.magnet_rotation.T
        return np.asarray((own + external_field(self.straight.magnet, self.points))
                          @ self.probe_rotation)

    @cached_property
    def gradient(self) -> Floats:
        """See `NominalFields.gradient`."""
        turn = self.probe_rotation.T @ self.magnet_rotation
        return np.asarray(turn @ self.straight.gradient[self.part] @ turn.T)


def separations(
    diagnosis: Diagnosis, data: xr.Dataset, session: Session,
    effects: Sequence[Effect] | None = None,
) -> list[Separation]:
    """For each named effect and each of its best rivals, what every option would gain.

    Parameters
    ----------
    data : Dataset
        The map that was diagnosed.
    effects : sequence of Effect, optional
        That it was diagnosed with; default the whole catalogue.
    """
    known = {effect.name: effect for effect in effects or catalogue()}
    pairs = [(one, rival) for one in diagnosis.named
             for rival in _rivals(one, diagnosis.before.study, known)]
    if not pairs:
        return []
    choices = candidate_measurements(diagnosis, data)
    old, *all_new = _readings(
        diagnosis, [present_scan(diagnosis, data), *(one.campaign for one in choices)], session)
    now = Marginal.of(old.blocks)
    before = [_distance(diagnosis, now, [old], *pair) for pair in pairs]
    found: list[dict[str, float]] = [{} for _ in pairs]
    for choice, new in zip(choices, all_new, strict=True):
        then = Marginal.of(np.vstack([old.blocks, new.blocks]))
        for pair, gains, already in zip(pairs, found, before, strict=True):
            gains[choice.name] = _distance(diagnosis, then, [old, new], *pair) - already
    return [Separation(one.hypothesis, rival, tuple(choices), gains, next(
        (choice for choice in choices if gains[choice.name] > ENOUGH), None))
        for (one, rival), gains in zip(pairs, found, strict=True)]


def candidate_measurements(diagnosis: Diagnosis, data: xr.Dataset) -> list[CandidateMeasurement]:
    """Measurements that could be made of a study's magnet, the cheapest first."""
    study, observation = diagnosis.before.study, diagnosis.before.observation
    again = present_scan(diagnosis, data)
    array = study.array
    sigma = _point_sigma(diagnosis)
    centre = NominalFields(study, np.zeros((1, 3)), np.zeros(1),
                           lambda other: np.zeros((1, 3))).field[0]
    size = float(np.linalg.norm(centre))
    found = [
        CandidateMeasurement("probe_rolled", "the same map with the probe turned by 180° about z",
               replace(again, probe_rotation=np.diag([-1.0, -1.0, 1.0]))),
        CandidateMeasurement("probe_reversed", "the same map with the probe turned by 180° about x",
               replace(again, probe_rotation=np.diag([1.0, -1.0, -1.0])))]
    if size > NMR_LEAST_T:
        found.append(CandidateMeasurement("nmr_point", "one NMR reading in the middle of the bore",
                                          ProposedScan(
            np.zeros((1, 3)), np.zeros(1), sparse.csr_array(centre[None] / size),
            independent(np.array([NMR_ACCURACY * size])), np.eye(3), np.eye(3), mapped=False)))
    radii = np.unique(np.round(observation.radii, 6))
    radius = 0.8 * array.inner_radius_m
    if radii[-1] > 0.9 * radius:
        radius = 0.5 * max(float(radii[0]), 0.5 * radius)
    heights = np.unique(np.round(observation.map_points[:, 2], 9))
    heights = heights[np.linspace(0, len(heights) - 1, min(len(heights), 40)).astype(int)]
    found.append(
        CandidateMeasurement("second_radius", f"circles of radius {1e3 * radius:.0f} mm", _points(
        np.vstack([_circle(radius, z) for z in heights]), sigma)))
    if study.dimension == 3:
        magnet = build_magnet(study)
        half, reach = magnet.array_half_length, array.outer_radius_m
        farthest = min(4 * reach, 0.4 * (boundary_half_length(magnet, "extruded") - half))
        beyond = [side * (half + farthest * step) for side in (-1, 1)
                  for step in np.linspace(0.2, 1, 5)]
        found.append(CandidateMeasurement(
            "far_field", f"points up to {1e3 * farthest:.0f} mm beyond the ends",
            _points(np.vstack([_circle(0.5 * reach, z, 4) for z in beyond]), sigma)))
    return [
        *found,
        CandidateMeasurement("magnet_turned",
                             "the same map with the magnet turned by 90° about its axis",
               replace(again, magnet_rotation=rotation_about_z(np.pi / 2))),
        CandidateMeasurement("known_temperature",
                             "the same map at another temperature of the magnet, which is "
               "even and measured on it", replace(again, temperature_known=True))]


def present_scan(diagnosis: Diagnosis, data: xr.Dataset) -> ProposedScan:
    """The map that was diagnosed, thinned to `MOST_READINGS`."""
    update = diagnosis.before
    observation = update.observation
    own = np.array(update.parts) != HELD_OUT_MAP
    _, owner = np.unique(observation.positions, axis=0, return_inverse=True)
    count = len(np.unique(owner[own]))
    wanted = max(1, round(count * min(1.0, MOST_READINGS / own.sum())))
    # steps of the golden ratio: no beat with the angles of a circle
    chosen = (np.arange(wanted) * (np.sqrt(5) - 1) / 2 % 1 * count).astype(int)
    kept = own & ((wanted == count) | np.isin(owner.ravel(), np.unique(owner[own])[chosen]))
    analysis = observation.analysis[np.flatnonzero(kept)]
    used = np.unique(analysis.indices // len(COMPONENTS))
    columns = (len(COMPONENTS) * used[:, None] + np.arange(len(COMPONENTS))).ravel()
    covariance = update.errors.part(kept).covariance * (kept.sum() / own.sum())
    return ProposedScan(
        probe_points(update.study.instrument, observation.map_points[used]), map_time(data)[used],
        sparse.csr_array(sparse.csc_array(analysis)[:, columns]),
        NoiseCovariance(sparse.csr_array(covariance)), np.eye(3), np.eye(3))


def distance(blocks: Marginal, signature: Floats, rivals: Floats) -> float:
    """Expected log Bayes factor of an effect over what else there may be, see the module.

    Parameters
    ----------
    blocks : Marginal
        Readings with the blocks integrated out.
    signature : ndarray, shape (n,)
        Of the effect, whitened.
    rivals : ndarray, shape (n, k)
        Others, whitened, per standard deviation of their amplitudes.
    """
    return blocks.evidence(rivals, signature).given(range(rivals.shape[1])).chi2 / 2


class _Magnet:
    """The study's magnet at the points of all campaigns, solved for once."""

    def __init__(self, scene: NominalFields) -> None:
        self.scene = scene
        self.known: dict[Hypothesis, Floats] = {}

    @cached_property
    def response(self) -> Floats:
        """B (parameters, n, 3) in T of every magnetization of 1 A/m."""
        size = self.scene.study.dimension
        return np.concatenate([
            np.moveaxis(unit @ (MU_0 * block.recoil_tensor[:, :size]), 2, 0) for block, unit in zip(
                self.scene.blocks, unit_fields(self.scene.blocks, self.scene.points), strict=True)])

    def signature(self, hypothesis: Hypothesis) -> Floats:
        """Of an effect of the magnet, (k, n, 3) in T."""
        if hypothesis not in self.known:
            self.known[hypothesis] = hypothesis.effect.signature(self.scene, hypothesis.place)
        return self.known[hypothesis]


def _readings(
    diagnosis: Diagnosis, campaigns: Sequence[ProposedScan], session: Session
) -> list[_Readings]:
    """What campaigns see; those at the same points of the magnet share them."""
    study, room = diagnosis.before.study, replace(session, folder=session.folder / "signatures")
    first: dict[bytes, int] = {}
    stacked: list[Floats] = []
    for campaign in campaigns:
        points = campaign.points @ campaign.magnet_rotation  # in the magnet's axes
        if points.tobytes() not in first:
            first[points.tobytes()] = sum(map(len, stacked))
            stacked.append(points)
    places = np.vstack(stacked)
    magnet = _Magnet(NominalFields(study, places, np.zeros(len(places)),
                           lambda other: solve_nominal(build_magnet(other), places, room)))
    starts = [first[(one.points @ one.magnet_rotation).tobytes()] for one in campaigns]
    return [_Readings(diagnosis, one, magnet, slice(start, start + len(one.points)))
            for one, start in zip(campaigns, starts, strict=True)]


class _Readings:
    """Signatures of effects and blocks in a campaign, whitened."""

    def __init__(
        self, diagnosis: Diagnosis, campaign: ProposedScan, magnet: _Magnet, part: slice
    ) -> None:
        scene = magnet.scene
        self.campaign, self.magnet, self.part = campaign, magnet, part
        self.mapper = Seen(scene.study, campaign.points, campaign.time, scene.solve, scene, part,
                           campaign.magnet_rotation, np.eye(3))
        self.sensors = replace(self.mapper, probe_rotation=campaign.probe_rotation)
        self.blocks = self._whitened(
            magnet.response[:, part] @ campaign.magnet_rotation.T) @ diagnosis.before.prior.root

    def of(self, hypothesis: Hypothesis) -> Floats:
        """Whitened readings (n, k) per unit of each parameter of an effect."""
        return self._whitened(self._signature(hypothesis))

    def _signature(self, hypothesis: Hypothesis) -> Floats:
        """Change of B (k, n, 3) in T in the mapper's axes."""
        effect, place, campaign = hypothesis.effect, hypothesis.place, self.campaign
        owner = owner_of(hypothesis, self.magnet.scene.study)
        gone = campaign.temperature_known and effect.name in OF_TEMPERATURE
        if gone or (not campaign.mapped and owner in ("mapper", "sensors")):
            return np.zeros((len(effect.parameters), len(campaign.points), 3))
        if owner == "magnet":
            return self.magnet.signature(hypothesis)[:, self.part] @ campaign.magnet_rotation.T
        if owner != "sensors":
            return effect.signature(self.mapper, place)
        return effect.signature(self.sensors, place) @ campaign.probe_rotation.T

    def _whitened(self, fields: Floats) -> Floats:
        """Fields (k, n, 3) to whitened readings (readings, k)."""
        readings = self.campaign.analysis @ fields.reshape(len(fields), -1).T
        return self.campaign.noise.whiten(np.asarray(readings))


def _distance(
    diagnosis: Diagnosis, blocks: Marginal, readings: Sequence[_Readings], named: IdentifiedEffect,
    rival: Hypothesis,
) -> float:
    """`distance` of a named effect from its rival, the other named ones being free as well."""
    def of(hypothesis: Hypothesis) -> Floats:
        return np.vstack([one.of(hypothesis) for one in readings])

    whole = named.hypothesis.effect.discrete
    signature = of(named.hypothesis) @ (np.ones(1) if whole else named.values)
    if rival.effect.certain:
        signature = signature - of(rival)[:, 0]
    free = [one for one in (rival, *(other.hypothesis for other in diagnosis.named))
            if one != named.hypothesis and not one.effect.certain]
    columns = [of(one) * [parameter.sd for parameter in one.effect.parameters] for one in free]
    return distance(blocks, signature, np.hstack([np.zeros((len(signature), 0)), *columns]))


def owner_of(
    hypothesis: Hypothesis, study: Study
) -> Literal["magnet", "surroundings", "mapper", "sensors"]:
    """What an effect stays with when something is turned: told by what it changes in a study."""
    effect = hypothesis.effect
    changed = effect.apply(study, hypothesis.place, [one.sd for one in effect.parameters])
    if effect.kind == "field":
        return "magnet" if changed.external == study.external else "surroundings"
    keys = {name for name, value in changed.instrument
            if value != getattr(study.instrument, name)}
    return "mapper" if keys <= MAPPER_KEYS else "sensors"


def _rivals(
    named: IdentifiedEffect, study: Study, known: Mapping[str, Effect]
) -> list[Hypothesis]:
    """The best other effects that would do as well, each at its best place."""
    found: dict[str, Hypothesis] = {}
    for candidate, _ in named.found.alternatives:
        if candidate.effect not in (named.found.candidate.effect, *found):
            effect = known[candidate.effect]
            for place in effect.places(study):  # not all that was looked at is listed
                if place.name == candidate.place:
                    found[candidate.effect] = Hypothesis(effect, place)
    return list(found.values())[:MOST_RIVALS]


def _points(points: Floats, sigma: float) -> ProposedScan:
    """All components at points, once, with the noise of a point."""
    count = 3 * len(points)
    return ProposedScan(points, np.linspace(0, 1, len(points)),
                    sparse.csr_array(sparse.eye_array(count)),
                    independent(np.full(count, sigma)), np.eye(3), np.eye(3))


def _point_sigma(diagnosis: Diagnosis) -> float:
    """Noise in T of one component at one point, where a Fourier coefficient is a mean of many."""
    update = diagnosis.before
    sigma = float(np.median(update.noise.sd))
    settings = update.study.observation
    if settings.quantity == "fourier_coefficients":
        return sigma * float(np.sqrt(settings.positions.angles / 2))
    return sigma


def _circle(radius: float, z: float, count: int = 12) -> Floats:
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])
