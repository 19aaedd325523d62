"""Sealed cases of hidden effects, and how often the diagnosis names them.

Each case draws a magnet, a map and sizes of the effects (`drawn_studies.py`).
Campaigns are by magpylib and NGSolve; every case is kept, and an interrupted run goes on. Cases are
independent, and --jobs of them run at a time::

    python studies/diagnosis/run.py -o results/diagnosis
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import xarray as xr
from drawn_studies import (
    MAGNETS,
    NEWER_OUTSIDE,
    OF_OWN_SIZE,
    OUTSIDE,
    Scan,
    can_have,
    drawn_fault,
    drawn_magnet,
    drawn_study,
)
from sealed_cases_page import page
from stated_probabilities import error_if_calibrated, expected_calibration_error, frequencies

from halbach_fe.cli import common
from halbach_fe.core.errors import CheckFailedError, HalbachError, StudyError
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_selection import best_factors
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.material import TYPICAL_COEFFICIENT_PER_K
from halbach_fe.diagnosis.linearization import NominalSolver, Training
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import HELD_OUT, InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import points_of
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.report.page import write_files
from halbach_fe.response.magnetic_axis import HEIGHTS, LENGTH, RADIUS, magnetic_axis
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.session import Session
from halbach_fe.study.inference_keys import HeldOut
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.hidden_effects import EFFECTS as CAN_BE_HIDDEN
from halbach_fe.synthetic.hidden_effects.effect_types import ChosenEffect, site_of
from halbach_fe.synthetic.simulate import (
    SimulatedCampaign,
    draw_magnet,
    simulate_campaign,
    streams,
    true_field,
    with_hidden,
)
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

HERE = Path(__file__).parent
DETECTABLE = 5.0
"""Log Bayes factor of the true effect, from which a case counts."""

NONE = "none"
STATED = (1e-3, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.001)
"""Probabilities that are compared with how often it was so; of smaller ones there are thousands."""

NO_BLOCKS = {"magnitude_sd": 1e-5, "direction_sd_deg": 1e-3, "common_mode_sd": 1e-5}
"""A prior that leaves nothing to the blocks: a detector that does not integrate them out."""

FAR_M = 100.0

WITHIN_95 = 1.96
"""Standard deviations within which 95 % of normal numbers lie."""

EXACT = 1e-18
"""Variance, relative to the largest one, below which a direction of the magnetizations is exactly
known, as of missing blocks. (Standard deviations of others differ by less than a thousand.)"""

BACK = 3.0
"""Standard deviations of chi-squared within which held-out readings agree with a model that lacks
nothing. A 95 % interval of each case would miss 5 % of them by chance."""

WANTED = {
    "naming_rate_single": (0.95, 1.0), "naming_rate_pairs": (0.9, 1.0),
    "false_alarm_rate": (0.0, 0.02), "unknown_rate": (0.9, 1.0),
    "heldout_recovered_rate": (0.95, 1.0), "iron_fringe_reduction": (10.0, np.inf),
    "others_named_per_case": (0.0, 0.05), "yes_beside_wrong": (0.0, 0.01),
    "clean_named_rate": (0.0, 0.0), "amplitude_z_rms": (0.9, 1.1),
    "posterior_chi2": (0.9, 1.2), "posterior_chi2_max": (0.0, 2.0),
    "axis_coverage": (0.9, 1.0), "control_naming_rate_shuffled_labels": (0.0, 0.2),
    "control_false_alarm_rate_without_blocks": (0.5, 1.0)}
"""Rates; of the controls, which must fail, too."""

SLOW = ("iron_ring", "knee", "recoil_permeability", "recoil_permeability_across")
"""Effects whose true field takes minutes, of which no other magnet has one."""


NEWER = ("ring_tilted", "ring_demagnetized", "halves_apart", "gain_drift")
"""Effects that are hidden in cases after all others, whose seeds thus stay as they were."""


@dataclass(frozen=True)
class Case:
    """What is hidden in one campaign, of which magnet.

    With ``with_blocks`` the diagnosis knows the moments of the single blocks.
    """

    seed: int
    study: Study
    faults: tuple[tuple[str, tuple[float, ...]], ...] = ()
    outside: str = ""
    with_blocks: bool = False

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(name for name, _ in self.faults)

    @property
    def name(self) -> str:
        """Its file."""
        hidden = "-".join(self.hidden) or self.outside or NONE
        return f"{self.seed:04d}-{self.study.name}-{hidden}"


def drawn_case(
    seed: int, hidden: Sequence[str], outside: str = "", magnets: Collection[str] = tuple(MAGNETS)
) -> Case:
    """Draw magnets until one of some kinds, with its map, can have the effects."""
    generator = np.random.default_rng([seed, 45])
    while True:
        study = drawn_study(drawn_magnet(generator), generator)
        faults = [(name, values) for name in hidden
                  if (values := drawn_fault(name, study, generator)) is not None]
        with_blocks = bool(generator.integers(2))
        if len(faults) == len(hidden) and (with_blocks or "rings_swapped" not in hidden) and (
                study.name in magnets and can_have(study, outside)) and (
                can_hide(study, seed, faults)):
            return Case(seed, study, tuple(faults), outside, with_blocks)


def can_hide(study: Study, seed: int, faults: Sequence[tuple[str, tuple[float, ...]]]) -> bool:
    """Tell whether a map shows effects, and blocks leave each other room; not of slow ones."""
    if {name for name, _ in faults} & {*SLOW}:
        return True
    nominal = magnet_of(study)
    hidden = [ChosenEffect(CAN_BE_HIDDEN[name], values) for name, values in faults]
    drawn = draw_magnet(study, nominal, streams(seed)[0])
    try:
        with_hidden(study, drawn.mounted, hidden, site_of(study, nominal), seed)
    except StudyError:
        return False
    return True


def cases(
    singles: int, clean: int, pairs: int, outside: int, newer_outside: int = 0, first: int = 0,
    magnets: Collection[str] = tuple(MAGNETS)
) -> list[Case]:
    """Effects that the campaign can hide, alone and in pairs of small ones; none; others.

    They are mixed, so that the first ones are of all kinds; those that take long are the last, but
    for newer ones. ``first`` is the smallest seed, which no other set of cases may have.
    """
    names = [name for name in CAN_BE_HIDDEN if name not in NEWER]
    small = [name for name in names if CAN_BE_HIDDEN[name].group != "gross" and name not in SLOW]
    generator = np.random.default_rng([first, 1])
    drawn = [((name,), "") for _ in range(singles) for name in names]
    drawn += [(tuple(generator.choice(small, 2, replace=False).tolist()), "")
              for _ in range(pairs)]
    drawn += [((), "") for _ in range(clean)]
    drawn += [((), list(OUTSIDE)[number % len(OUTSIDE)]) for number in range(outside)]
    mixed = [drawn[number] for number in generator.permutation(len(drawn))]
    mixed.sort(key=lambda one: bool(set(one[0]) & set(SLOW)))
    mixed += [((name,), "") for _ in range(singles) for name in NEWER]
    mixed += [((), name) for _ in range(newer_outside) for name in NEWER_OUTSIDE]
    return [drawn_case(first + number, *each, magnets) for number, each in enumerate(mixed)]


OUTSIDE_NAME = "outside"
"""Name of their log Bayes factor among those of hidden effects."""

OUTSIDE_SIZES = (5.0, 20.0)
"""Rms over all readings of causes outside the catalogue, in units of the noise."""


def with_outside(case: Case, campaign: SimulatedCampaign) -> xr.Dataset:
    """Return the map of a campaign with the cause outside the catalogue of a case."""
    assert case.study.noise is not None
    readings, generator = campaign.readings, np.random.default_rng(case.seed)
    points, there = points_of(readings), np.isfinite(readings["B_T"].values)
    at = partial(true_field, campaign.magnet)
    scan = Scan(points, site_of(case.study, campaign.magnet).outer,
                tuple(np.flatnonzero(there.any(axis=0)).tolist()), at(points),
                np.nan_to_num(readings["B_T"].values), at)
    added = (OUTSIDE | NEWER_OUTSIDE)[case.outside](scan, generator)
    size = (generator.choice([-1, 1]) * generator.uniform(*OUTSIDE_SIZES)
            * case.study.noise.regions[0].sigma_T / np.sqrt(np.mean(added[there]**2)))
    return readings.assign(B_T=readings["B_T"] + (
        added if case.outside in OF_OWN_SIZE else size * added))


def run_case(case: Case, session: Session, solver: NominalSolver) -> dict[str, Any]:
    """Simulate, diagnose, and compare with what is sealed."""
    study = case.study
    campaign = simulate_campaign(study, case.seed, hide=[
        (CAN_BE_HIDDEN[name], values) for name, values in case.faults])
    readings = with_outside(case, campaign) if case.outside else campaign.readings
    blocks = campaign.blocks if case.with_blocks else None
    found = diagnose(study, readings, session, blocks, solver=solver)
    best = own_factors(found, case.hidden)
    if case.outside:
        best[OUTSIDE_NAME] = factor_of(found.before, found.corrected_study, readings,
                                       campaign.readings)
    if found.position_noise:  # `own_factors` do not know of it, and count it as evidence
        for name in best.keys() - {one.hypothesis.effect.name for one in found.identified}:
            others = [(CAN_BE_HIDDEN[other], values) for other, values in case.faults
                      if other != name]
            best[name] = factor_of(found.after, found.study, readings,
                                   simulate_campaign(study, case.seed, hide=others).readings)
    result = {"case": case.name, "magnet": study.name, "hidden": list(case.hidden),
              "outside": case.outside, "with_blocks": case.with_blocks,
              "labels": labels_of(study, case.faults), "truth": campaign.truth["effects"],
              **outcome(found), "best": best}
    if found.unknown is None and not found.solver_error:
        result |= after_update(found, campaign, readings, session, blocks)
    beyond = np.abs(points_of(readings)[:, 2]).max() > build_magnet(study).half_length
    if case.hidden == ("iron_ring",) and beyond:
        exact = readings.assign(B_T=(readings["B_T"].dims, campaign.without_noise))
        result["fringe_T"] = [fringe(one, readings, exact, replace(
            session, folder=session.folder / f"fringe-{when}"), blocks)
            for when, one in (("before", found.corrected_study), ("after", found.study))]
    if not case.hidden and not case.outside and case.seed % 4 == 0:  # it takes long
        sure = study.with_(prior=study.prior.with_(**NO_BLOCKS))
        alarm = diagnose(sure, readings, session, solver=solver)
        result["without_blocks"] = bool(alarm.found_anything or alarm.unknown)
    return result


def outcome(found: Diagnosis) -> dict[str, Any]:
    """What is scored of a diagnosis."""
    chi2 = {name: [score.chi2_posterior for score in update.scores if score.part == HELD_OUT]
            for name, update in (("before", found.before), ("after", found.after))}
    named = [sorted({name for reading in (one.convention, *one.alternatives)
                     for name in reading.names}) for one in found.gross_errors]
    named += [[name] for name, there in (
        ("outliers", found.outliers), ("vibration", found.position_noise)) if there]
    return {
        "named": named + [list(one.selection.effects) for one in found.identified],
        "identified": [
            {"effect": one.hypothesis.effect.name, "place": one.place.name,
             "values": list(map(float, one.reported[0])), "sd": list(map(float, one.reported[1])),
             "others": [[other.effect, other.place] for other, _ in one.selection.alternatives]}
            for one in found.identified],
        "held_out": int(found.before.held_out.sum()),
        "trust": answer(found).trust, "suspected": [list(one.effects) for one in found.suspected],
        "at_rest": found.is_at_rest,
        "factors": [one.selection.log_bayes_factor for one in found.identified],
        "unknown": None if found.unknown is None else found.unknown.kind,
        "probabilities": found.probabilities,
        "disagrees": found.before.prior_conflict > found.before.conflict_limit,
        "chi2_before": chi2["before"][0], "chi2_after": chi2["after"][0], "rounds": found.rounds}


def after_update(
    found: Diagnosis, campaign: SimulatedCampaign, readings: xr.Dataset, session: Session,
    blocks: BlockTable | None
) -> dict[str, Any]:
    """Return how far the update of the diagnosed study is from the truth, in its error bars.

    ``posterior_chi2`` is the chi-squared per parameter of all blocks; ``axis_z`` has roll, centre
    and slope of the magnetic axis, as far as they are defined.
    """
    session = replace(session, folder=session.folder / "diagnosed")
    result = infer(build_magnet(found.study), readings, session, blocks)
    size, count = result.magnet.dimension, len(result.magnet.parameter_names)
    true = {(body.ring, body.slot): body.magnetization[:size] for body in campaign.magnet.bodies}
    off = np.concatenate([true[block.ring, block.slot] for block in result.magnet.blocks])
    off -= result.posterior.mean[:count]
    variances, axes = np.linalg.eigh(result.posterior.covariance[:count, :count])
    free = variances > EXACT * variances.max()
    chi2 = float(np.sum((axes.T @ off)[free]**2 / variances[free]) / free.sum())
    return {"posterior_chi2": chi2, "axis_z": axis_errors(found, campaign, result, session)}


def axis_errors(
    found: Diagnosis, campaign: SimulatedCampaign, result: InferenceResult, session: Session
) -> list[float]:
    """Return roll, centre and slope minus their true values, in standard deviations.

    Roll is that from the nominal field, which must be that of the study.
    """
    axis = magnetic_axis(result.magnet, session, result.posterior)
    if axis is None:
        return []
    roll, *true = true_axis(campaign, result.magnet)
    same = found.study.external == campaign.study.external and (  # amplitudes of 0 change none
        build_magnet(found.study).blocks == build_magnet(campaign.study).blocks)
    pairs = [(axis.roll_rad, roll, axis.roll_sd_rad)] if same else []
    if axis.order > 1 and axis.centre_m and axis.centre_sd_m:
        places = [*axis.centre_m, *(axis.slope_rad or ())]
        bars = [*axis.centre_sd_m, *(axis.slope_sd_rad or ())]
        pairs += list(zip(places, true, bars, strict=True))
    return [float((value - right) / sd) for value, right, sd in pairs]


def true_axis(campaign: SimulatedCampaign, magnet: Magnet) -> list[float]:
    """Return roll in rad, centre x and y in m and slopes of the true field's magnetic axis.

    Circles and definitions are those of `halbach_fe.response.magnetic_axis`.
    """
    order, flat = magnet.array.multipole_order, magnet.dimension == 2
    middle = magnet.middle_z_m
    heights = np.zeros(1) if flat else np.linspace(-1, 1, HEIGHTS) * (
        LENGTH * (magnet.array_half_length - abs(middle)))  # from the middle
    count, radius = 2 * (order + 2), RADIUS * magnet.bore_radius
    turns = 2 * np.pi * np.arange(count) / count
    points = np.array([[radius * np.cos(turn), radius * np.sin(turn), middle + z]
                       for z in heights for turn in turns])

    field, nominal = (true_field(source, points).reshape(len(heights), count, 3)
                      for source in (campaign.magnet, magnet_of(campaign.study)))

    def multipole(number: int, field: np.ndarray) -> np.ndarray:
        """Complex coefficient at each height."""
        return (field[..., 1] + 1j * field[..., 0]) @ np.exp(-1j * (number - 1) * turns) / count

    main = multipole(order, field)
    roll = -float(np.angle(np.conj(multipole(order, nominal)) @ main)) / order
    if order == 1:
        return [roll]
    places = -radius / (order - 1) * multipole(order - 1, field) / main
    line = np.polynomial.polynomial.polyfit(heights, places, 0 if flat else 1)
    return [roll, *(float(part) for value in line for part in (value.real, value.imag))]


def fringe(
    study: Study, readings: xr.Dataset, exact: xr.Dataset, session: Session,
    blocks: BlockTable | None
) -> float:
    """Rms error in T of the fringe field, beyond the magnet's ends, as it is foretold by a model
    that was updated with the readings of the bore alone.
    """
    end = build_magnet(study).half_length
    kept = HeldOut(z_ranges_m=((-FAR_M, -end), (end, FAR_M)))
    update = infer(build_magnet(study.with_(inference__held_out=kept)),
        readings, session, blocks)
    truth = update.observation.read(exact["B_T"].values)[update.held_out]
    return float(np.sqrt(np.mean((update.prediction_posterior.mean[update.held_out] - truth)**2)))


def own_factors(found: Diagnosis, hidden: Sequence[str]) -> dict[str, float]:
    """Log Bayes factor of each hidden effect that has a signature, beside the other hidden ones."""
    there = {one.effect for one in found.candidates}
    known = {name: sorted(set(known_as(name)) & there) for name in hidden}
    known = {name: names for name, names in known.items() if names}
    factors = {}
    for name, names in known.items():
        others = [known[other] for other in known if other != name]
        beside = best_factors(found.evidence, found.candidates, others)
        factors[name] = max(beside[one] for one in names)
    return factors


def factor_of(
    update: InferenceResult, study: Study, readings: xr.Dataset, without: xr.Dataset
) -> float:
    """Log Bayes factor of what readings have and others do not, of about that size, over blocks
    that deviate, by the update of a study.
    """
    training = Training.of(update, Campaign.of(study, readings))
    column = training.shown(np.nan_to_num((readings["B_T"] - without["B_T"]).values)[None])
    return training.marginal.evidence(column, training.residual).fit([0]).log_evidence


@cache
def known_as(name: str) -> tuple[str, ...]:
    """Names in the catalogue of what the campaign hides: that, or one of each sensor."""
    return tuple(effect.name for effect in catalogue()
                 if effect.name in (name, *SAME.get(name, ())) or effect.name[:-2] == name
                 ) or (name,)


SAME = {"block_put_in_wrongly": ("block_flipped",), "rings_turned": ("ring_twisted",)}
"""Other names of what is hidden: half a turn may reverse the magnetization, and a ring that is
turned by a slot is rotated."""


def detectable(result: dict[str, Any], name: str) -> bool:
    """Tell whether the readings contain evidence of an effect at all.

    An effect without a signature, such as position noise, is detectable if the readings disagree
    with the model.
    """
    if name not in result["best"]:
        return bool(result["named"] or result["disagrees"])
    return bool(result["best"][name] > DETECTABLE)


def named(result: dict[str, Any], name: str) -> bool:
    """Whether an effect is among those that were named, or named as what they could be instead."""
    return any(_means(result, name, number) for number in range(len(result["named"])))


def first_named(result: dict[str, Any], name: str) -> bool:
    """Whether an effect is named itself, and not only as what another could be instead."""
    return any(names[0] in known_as(name) and _means(result, name, number)
               for number, names in enumerate(result["named"]))


def wrong(result: dict[str, Any]) -> int:
    """How many were named that are not hidden, or of another block or ring."""
    return sum(not any(_means(result, name, number) for name in result["hidden"])
               for number in range(len(result["named"])))


def _means(result: dict[str, Any], name: str, number: int) -> bool:
    """Whether one of what was named, by its number, can be a hidden effect, at its place.

    Gross errors, which come first, have none.
    """
    identified, labels = result.get("identified", []), result.get("labels", {})
    first = number - (len(result["named"]) - len(identified))
    there = [] if first < 0 else [
        (identified[first]["effect"], identified[first]["place"]), *identified[first]["others"]]
    if name == "ring_gap" and any(
            effect == LAST_RING and place in labels.get(LAST_RING, ()) for effect, place in there):
        return True
    if not set(known_as(name)) & set(result["named"][number]):
        return False
    if first < 0 or not labels.get(name):
        return True
    return any(all(label in place for label in labels[name])
               for effect, place in there if effect in known_as(name))


def yes_beside_wrong(result: dict[str, Any]) -> bool:
    """Whether a diagnosis says yes and is wrong."""
    return bool(wrong(result)) and result["trust"].startswith("Yes")


def is_promised(result: dict[str, Any]) -> bool:
    """Whether the update after a diagnosis must be right: its study has all that is hidden.

    That was named, or suspected of no single block or ring. What no reading shows and no prior of
    the study allows, such as the zero of a sensor that blocks imitate, makes an update wrong
    without a diagnosis, too.
    """
    suspected = {name for names in result.get("suspected", []) for name in names}
    return "posterior_chi2" in result and not result["outside"] and not wrong(result) and all(
        named(result, name) or (suspected & set(known_as(name)) and not result["labels"].get(name))
        for name in result["hidden"])


def labels_of(study: Study, faults: Sequence[tuple[str, tuple[float, ...]]]
              ) -> dict[str, list[str]]:
    """Return the blocks, the ring, or that below a seam, of hidden effects, as places of the
    catalogue name them.
    """
    names = {(block.ring, block.slot): block.name for block in build_magnet(study).blocks}
    found = {}
    for effect, values in faults:
        given = dict(zip((one.name for one in CAN_BE_HIDDEN[effect].parameters), values,
                         strict=True))
        places = [(given.get(f"{other}ring"), given.get(f"{other}slot"))
                  for other in ("", "other_")]
        found[effect] = [names[place] for place in places if place in names]
        ring = given.get("seam", given.get("ring"))
        if ring is not None and not given.keys() & {"slot", "slots", "other_ring"}:  # a ring alone
            found[effect] = [f"r{ring:02.0f}"]
        if given.get("seam") == max(number for number, _ in names) - 1:
            found.setdefault(LAST_RING, [f"r{ring + 1:02.0f}"])
    return found


LAST_RING = "ring_shifted_along"
"""What a gap below the last ring is: this ring is displaced along z, and no other."""


LIKE_HIDDEN = (
    "gain", "offset", "misalignment", "mapper", "z_scale", "radius_scale", "arm_sag",
    "sensor_position", "radial_gap", "azimuthal_gap", "inner_radius", "background", "lag",
    "recoil_permeability", "planar_hall", "quadratic", "cubic", "block_displaced", "block_turned",
    "block_demagnetized", "ring_twisted", "ring_shifted", "ring_tilted", "ring_demagnetized")
"""Beginnings of names of effects whose amplitudes are those that are hidden, but for the place."""


def true_amplitudes(effect: str, hidden: dict[str, float]) -> list[float]:
    """Return the true amplitudes of an effect of the catalogue, in its order, from what is hidden.

    Those that are defined in another way are left out.
    """
    own = [value for name, value in hidden.items() if name not in ("ring", "slot")]
    if effect.startswith(LIKE_HIDDEN):
        return own
    if effect == "drift":
        return 3 * own
    if effect == "eccentric_circle":
        return [own[0] * np.cos(own[1]), own[0] * np.sin(own[1])]
    if effect == "temperature":
        return [own[0] * own[1] / TYPICAL_COEFFICIENT_PER_K]
    if effect == "slow_readings":
        return own[:1]
    if effect == "ring_gap":
        return [hidden["distance"]]
    if effect == "magnetization_gradient":
        return [2 * hidden["fraction"]]
    return []


def values_of(hidden: dict[str, Any]) -> dict[str, float]:
    """Return the parameters of a hidden effect by their names."""
    return {each["name"]: each["value"] for each in hidden["parameters"]}


def widened(seam: float, truth: Sequence[dict[str, Any]]) -> float:
    """Return by how much in m hidden shifts of the rings beside a seam widen its gap."""
    shifts = [values_of(hidden) for hidden in truth if hidden["name"] == "ring_shifted_along"]
    return sum(one["z"] * ((one["ring"] == seam + 1) - (one["ring"] == seam)) for one in shifts)


def amplitude_errors(result: dict[str, Any]) -> list[float]:
    """Return amplitudes minus their true values in standard deviations, of right names.

    An amplitude that is exactly 0, as another part of an effect was likelier, has none. A gap of
    which a ring beside it is shifted along, too, is as wide as both make it.
    """
    found: list[float] = []
    for one in result.get("identified", []):
        for hidden in result["truth"]:
            labels = result["labels"].get(hidden["name"]) or []
            if one["effect"] in known_as(hidden["name"]) and all(
                    label in one["place"] for label in labels):
                values = values_of(hidden)
                if one["effect"] == "ring_gap":
                    values["distance"] += widened(values["seam"], result["truth"])
                found += [(value - true) / sd for value, true, sd in zip(
                    one["values"], true_amplitudes(one["effect"], values), one["sd"],
                    strict=False) if sd > 0]
    return found


def rate(hits: Iterable[bool]) -> float:
    """Mean, or NaN of nothing."""
    found = list(hits)
    return float(np.mean(found)) if found else float("nan")


def summary(results: list[dict[str, Any]]) -> dict[str, float]:
    """Rates over all cases."""
    single = [one for one in results if len(one["hidden"]) == 1
              and detectable(one, one["hidden"][0])]
    pairs = [one for one in results if len(one["hidden"]) == 2
             and all(detectable(one, name) for name in one["hidden"])]
    clean = [one for one in results if not one["hidden"] and not one["outside"]]
    outside = [one for one in results if one["outside"] and detectable(one, OUTSIDE_NAME)]
    right = [one for one in single + pairs if all(named(one, name) for name in one["hidden"])]
    iron = [one for one in results if "fringe_T" in one]
    true = np.array([one["hidden"][0] for one in single])
    shuffled = [(one, label) for one, label, own in zip(single, np.roll(true, 1), true, strict=True)
                if label != own]
    known = [one for one in results if is_promised(one)]
    updates = [one["posterior_chi2"] for one in known]
    amplitudes = [error for one in results for error in amplitude_errors(one)]
    axes = [error for one in known for error in one["axis_z"]]
    return {
        "cases": len(results),
        "magnets": len({one["magnet"] for one in results} & MAGNETS.keys()),
        "first_named_single": rate(first_named(one, one["hidden"][0]) for one in single),
        "yes_beside_wrong": rate(map(yes_beside_wrong, results)),
        "clean_named_rate": rate(bool(one["named"]) for one in clean),
        "amplitude_z_rms": float(np.sqrt(np.mean(np.square(amplitudes or [np.nan])))),
        "amplitudes": len(amplitudes),
        "posterior_chi2": float(np.median(updates or [np.nan])),
        "posterior_chi2_max": float(max(updates, default=np.nan)), "updates": len(updates),
        "axis_coverage": rate(abs(error) < WITHIN_95 for error in axes), "axis_numbers": len(axes),
        "naming_rate_single": rate(named(one, one["hidden"][0]) for one in single),
        "single_cases": len(single),
        "naming_rate_pairs": rate(all(named(one, name) for name in one["hidden"])
                                  for one in pairs),
        "pair_cases": len(pairs),
        "others_named_per_case": float(np.mean([wrong(one) for one in single + pairs] or [0])),
        "effects_cases": len(single + pairs),
        "false_alarm_rate": rate(bool(one["named"] or one["unknown"]) for one in clean),
        "clean_cases": len(clean),
        "unknown_rate": rate(one["unknown"] is not None for one in outside),
        "outside_cases": len(outside),
        "iron_fringe_reduction": float(np.median([np.divide(*one["fringe_T"]) for one in iron]
                                                 or [np.nan])),
        "iron_cases": len(iron),
        "heldout_recovered_rate": rate(
            abs(one["chi2_after"] - 1) < BACK * np.sqrt(2 / one["held_out"]) for one in right),
        "recovered_of": len(right),
        "control_naming_rate_shuffled_labels": rate(named(one, label) for one, label in shuffled),
        "control_false_alarm_rate_without_blocks": rate(
            one["without_blocks"] for one in clean if "without_blocks" in one)}


def truly_there(result: dict[str, Any]) -> set[str]:
    """Effects that have a probability and are hidden; what was put right before is none."""
    hidden = {one for name in result["hidden"] for one in known_as(name)}
    return hidden & result["probabilities"].keys() or {NONE}


def single_cases(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the cases whose probabilities are compared with frequencies.

    The probabilities assume at most one effect. Cases with at most one hidden effect count, unless
    the effect is not detectable.
    """
    return [one for one in results if len(one["hidden"]) <= 1 and not one["outside"]
            and all(detectable(one, name) for name in one["hidden"])]


def reliability(results: list[dict[str, Any]]) -> list[dict[str, float]]:
    """Return how often effects are present, for bins of the probability that was stated."""
    stated = [(probability, name in truly_there(one)) for one in single_cases(results)
              for name, probability in one["probabilities"].items()]
    probability, there = np.array(stated, float).reshape(-1, 2).T
    return [asdict(row) for row in frequencies(probability, there > 0, STATED)]


def naming(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the expected calibration error of the likeliest name of each case, with its bins.

    ``limit`` is the error that calibrated probabilities exceed in 5 % of such sets of cases.
    """
    stated = []
    for one in single_cases(results):
        if one["probabilities"]:
            name = max(one["probabilities"], key=one["probabilities"].__getitem__)
            stated.append((one["probabilities"][name], name in truly_there(one)))
    probability, right = np.array(stated, float).reshape(-1, 2).T
    bins = frequencies(probability, right > 0, STATED)
    return {"error": expected_calibration_error(bins), "statements": len(probability),
            "limit": error_if_calibrated(probability, STATED, np.random.default_rng(1)),
            "bins": [asdict(row) for row in bins]}


_known: dict[int, tuple[TemporaryDirectory[str], Session, NominalSolver]] = {}
"""Of each thread of a process: where it works, and what it solved for other cases. (On a worker of
a scheduler, where this file comes with every case, for one case only.)"""


def run_one(
    case: Case, getdp: str | None, time_limit_s: float, processes: int,
    cache: Cache | None,
) -> dict[str, Any]:
    """Run a case, on any machine; return what came of it, or why nothing did as ``failure``."""
    try:
        if threading.get_ident() not in _known:
            folder = TemporaryDirectory(prefix="halbach-fe-")
            session = Session(find_getdp(getdp), Path(folder.name), time_limit_s=time_limit_s,
                                cache=cache, processes=processes)
            _known[threading.get_ident()] = folder, session, NominalSolver(session)
        return run_case(case, *_known[threading.get_ident()][1:])
    except HalbachError as error:
        return {"failure": str(error)}


def run(arguments: argparse.Namespace) -> int:
    """Run all cases and print the rates."""
    chosen = cases(arguments.singles, arguments.clean, arguments.pairs, arguments.outside,
                   arguments.newer_outside, arguments.first, arguments.magnets)
    if arguments.only:
        chosen = [one for one in chosen if one.seed in arguments.only]
    paths = [arguments.output / "cases" / f"{case.name}.json" for case in chosen]
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the cases share the cores
    cache = None if arguments.scheduler else common.cache(arguments)  # a folder of this machine
    with common.workers(arguments) as pool:
        waiting = {pool.submit(
            run_one, case, arguments.getdp, arguments.time_limit, arguments.mpi, cache): path
                   for case, path in zip(chosen, paths, strict=True) if not path.exists()}
        for number, future in enumerate(as_completed(waiting), start=1):
            path, found = waiting[future], future.result()
            if "failure" not in found:
                write_text(path, json.dumps(found, indent=1) + "\n")
            common.say(f"{number}/{len(waiting)} " + (
                f"{path.stem} failed: {found['failure']}" if "failure" in found
                else sentence(found)))
    results = [json.loads(path.read_text()) for path in paths if path.exists()]
    rates = report(read_study(arguments.study), results, arguments.output)
    missed = [f"{len(paths) - len(results)} cases failed"] * (len(results) < len(paths)) + [
        f"{name} is {rates[name]:.3g}" for name, (low, high) in WANTED.items()
        if not (np.isnan(rates[name]) or low <= rates[name] <= high)]
    if missed:
        raise CheckFailedError(f"The diagnosis should be better: {'; '.join(missed)}.")
    return 0


def sentence(one: dict[str, Any]) -> str:
    """What came of a case."""
    return (f"{one['case']}: {one['named']} {one['unknown'] or ''} chi2 {one['chi2_before']:.2f} "
            f"-> {one['chi2_after']:.2f}")


def report(study: Study, results: list[dict[str, Any]], folder: Path) -> dict[str, float]:
    """Write rates, table and page; print and return the rates."""
    stated, named_first = reliability(results), naming(results)
    rates = summary(results) | {
        "naming_ece": named_first["error"], "naming_ece_limit": named_first["limit"],
        "naming_statements": named_first["statements"]}
    known = {name: None if np.isnan(value) else value for name, value in rates.items()}
    write_text(folder / "summary.json", json.dumps(
        {"rates": known, "reliability": stated, "naming": named_first["bins"]}, indent=1,
        allow_nan=False) + "\n")
    confusion = Counter((one["hidden"][0], tuple(names)) for one in results
                        if len(one["hidden"]) == 1 for names in one["named"] or [[NONE]])
    write_files(page(study, results, rates, stated, named_first["bins"], confusion), folder)
    common.print_table([{"hidden": hidden, "named": ", ".join(names), "cases": str(count)}
                        for (hidden, names), count in sorted(confusion.items())],
                       "What was hidden alone, and what was named")
    common.print_table([{"figure": name, "value": f"{value:.3g}"} for name, value in rates.items()],
                       "Rates")
    common.print_table([{name: f"{value:.3g}" for name, value in row.items()} for row in stated],
                       "Probabilities of effects, and how often they were there")
    common.print_table([{name: f"{value:.3g}" for name, value in row.items()}
                        for row in named_first["bins"]],
                       "Probabilities of the likeliest name, and how often it was right")
    common.say(f"Report: {folder / 'sealed_cases.html'}")
    return rates


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    for name, count in (("singles", 1), ("clean", 10), ("pairs", 20), ("outside", 9),
                        ("newer-outside", 1)):
        parser.add_argument(f"--{name}", type=int, default=count, metavar="N",
                            help="cases (of each effect or cause, for singles and newer-outside; "
                                 "default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, metavar="N",
                        help="seed of the first case, for others than the usual ones")
    parser.add_argument("--magnets", nargs="+", choices=tuple(MAGNETS), default=tuple(MAGNETS),
                        help="kinds of magnets (default: all)")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="seeds of cases")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "diagnosis", run, options))
