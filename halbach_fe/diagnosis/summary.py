"""Summarize a diagnosis: phrases for reports, diagnosis.json, and the study's file with the
changes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from halbach_fe.core.arrays import Floats, rms
from halbach_fe.core.numbers import EMPTY_CELL, decimals
from halbach_fe.diagnosis.discriminating_measurements import Separation
from halbach_fe.diagnosis.effect_selection import Candidate
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Parameter, Place
from halbach_fe.diagnosis.gross_error_correction import with_poses
from halbach_fe.diagnosis.gross_errors import GrossError
from halbach_fe.diagnosis.map_conventions import MapConvention
from halbach_fe.diagnosis.random_errors import PositionNoise
from halbach_fe.diagnosis.result import (
    DetectionLimits,
    Diagnosis,
    FoundPose,
    IdentifiedEffect,
    PossiblePosition,
    Suspicion,
    UnknownCause,
)
from halbach_fe.diagnosis.uncertain_effects import with_uncertain_effects
from halbach_fe.geometry.blocks import block_in_words
from halbach_fe.inference.result import (
    ALL_READINGS,
    COVERAGE_Z,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
)
from halbach_fe.measurement.doubted_terms import factor_in_words
from halbach_fe.measurement.probe_law import row_order_note
from halbach_fe.study.model import Study

STUDY_FILE = "study.diagnosed.toml"
BLOCKS_FILE = "blocks.csv"
"""Names of the files that a diagnosis writes."""

DISPLAY_UNITS = {
    "m": ("mm", 1e3), "rad": ("mrad", 1e3), "T": ("mT", 1e3), "1/T": ("%/T", 100.0),
    "1/T^2": ("%/T²", 100.0), "A m2": ("A m²", 1.0), "A/m": ("kA/m", 1e-3), "K": ("K", 1.0)}
"""Units that reports show for the units of parameters, and the factor to convert to them."""

PRESENT = "present"
"""Amount of an effect that is all or nothing."""

OUTWARDS = {"wrong_radius": "farther out"}
"""Direction of displacements with one amplitude."""

LOSS = "loss"
"""Parameter of effects that weaken blocks; a block that loses more than it had is reversed."""

PERCENT_PARAMETERS = {"gain", LOSS, "gradient", "scale", "permeability above 1000 by"}
"""Dimensionless parameters that reports show in percent."""


@dataclass(frozen=True)
class RegionFit:
    """How well a model agrees with the readings of a region."""

    region: str
    part: str
    readings: int
    """Number of readings."""
    chi2_per_reading: float
    """Chi-squared per reading by the full covariance of prediction and noise. The prediction is the
    prior one for training readings, and the posterior one for held-out readings."""
    rms_T: dict[str, float]
    """Rms difference of the posterior prediction from the readings, by component (``Bx``) or kind
    of Fourier coefficient."""
    coverage95: float
    """Fraction of the readings within the 95 % band of their prediction. Training readings are
    compared with their leave-one-out prediction."""


def region_scores(update: InferenceResult, loo_residuals: Floats) -> list[RegionFit]:
    """Return the fit of all readings of each part, and of held-out readings by region; of several
    maps, also that of the training readings of each.

    ``loo_residuals`` (n,) are the standardized leave-one-out residuals of the training readings.
    """
    parts, regions = np.array(update.parts), np.array(update.regions)
    training = parts == TRAINING
    found = [RegionFit(ALL_READINGS, TRAINING, int(training.sum()), update.prior_conflict,
                   _rms(update, training), float(np.mean(np.abs(loo_residuals) <= COVERAGE_Z)))]
    for name in dict.fromkeys(update.maps) if update.is_campaign else ():
        own = training & (np.array(update.maps) == name)
        if own.any():
            found.append(RegionFit(
                name, TRAINING, int(own.sum()),
                float(np.mean(update.whitened(update.prediction_prior, own) ** 2)),
                _rms(update, own), float(np.mean(np.abs(loo_residuals[own[training]])
                                                 <= COVERAGE_Z))))
    names = list(dict.fromkeys(update.regions))
    for part in (HELD_OUT, HELD_OUT_MAP):
        for region in [ALL_READINGS, *(names if len(names) > 1 else [])]:
            chosen = (parts == part) & ((regions == region) | (region == ALL_READINGS))
            if chosen.any():
                found.append(RegionFit(
                    region, part, int(chosen.sum()),
                    float(np.mean(update.whitened(update.prediction_posterior, chosen) ** 2)),
                    _rms(update, chosen), float(np.mean(np.abs(update.standardized(
                        update.prediction_posterior)[chosen]) <= COVERAGE_Z))))
    return found


def _rms(
    update: InferenceResult, chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> dict[str, float]:
    """Return the rms difference in T of prediction and readings by component."""
    residual = (update.readings - update.prediction_posterior.mean)[chosen]
    kinds = np.array(["".join(letter for letter in label if not letter.isdigit())
                      for label in update.observation.labels])[chosen]
    return {kind: rms(residual[kinds == kind])
            for kind in dict.fromkeys(kinds.tolist())}


def main_field_T(diagnosis: Diagnosis) -> float:  # noqa: N802 - a unit
    """Return the strongest component of the field of the diagnosed magnet at the map's positions,
    in T; of Fourier coefficients, the largest one that the diagnosed model predicts.
    """
    field = diagnosis.after.field
    if field.strongest is not None:
        return float(abs(field.mean[field.strongest]))
    return float(np.abs(diagnosis.after.prediction_posterior.mean).max())


def changed_studies(study: Study, diagnosis: Diagnosis) -> Iterator[tuple[Study, str]]:
    """Yield the studies from that of the file to the diagnosed one, each with a comment."""
    for error in diagnosis.gross_errors:
        study = error.apply(study)
        yield study, f"gross error: {error.text}"
    if diagnosis.poses:
        study = with_poses(study, diagnosis.poses)
        yield study, f"registered: {'; '.join(pose.text for pose in diagnosis.poses)}"
    study = diagnosis.corrected_study
    yield study, f"outliers: {len(diagnosis.outliers)}" if diagnosis.outliers else ""
    for effect in diagnosis.identified:
        study = effect.hypothesis.apply(study, effect.values.tolist())
        yield study, note(effect)
    yield (with_uncertain_effects(
        diagnosis.corrected_study, diagnosis.identified,
        [each for one in diagnosis.suspected for each in one.fitted]), "estimated with the blocks")
    yield diagnosis.study, "; ".join(
        f"vibration: {_in_map(one.map)}{1e3 * one.sd_m:.2g} mm, log Bayes factor "
        f"{one.log_bayes_factor:.1f}" for one in diagnosis.position_noise)


def note(identified: IdentifiedEffect) -> str:
    """Return a line that describes an effect, in the units of the study."""
    fitted = ", ".join(
        f"{parameter.name} {_rounded(value, sd)}{_spaced(parameter.unit)}"
        for parameter, value, sd in _uncertain(identified))
    factor = f"log Bayes factor {identified.selection.log_bayes_factor:.1f}"
    return f"{identified.name}: {fitted or 'present'}, {factor}"


def amounts(identified: IdentifiedEffect) -> list[str]:
    """Return the amplitudes of an effect with their standard deviations, in display units."""
    found, fitted = [], _uncertain(identified)
    for parameter, value, sd in fitted:
        unit, factor = human_unit(parameter)
        alone = len(fitted) == 1 and parameter.name in identified.hypothesis.effect.title
        name = "" if alone else f"{parameter.name} "
        if parameter.name == LOSS and value > 1:
            found.append(f"reversed, with {_rounded(factor * (value - 1), factor * sd)} % of its "
                         "strength")
            continue
        text = _rounded(factor * value, factor * sd).replace("-", "−")
        found.append(f"{name}{text}{_spaced(unit)}")
    return found or [PRESENT]


def _uncertain(identified: IdentifiedEffect) -> list[tuple[Parameter, float, float]]:
    """Return the parameters, values and standard deviations of amplitudes that were fitted."""
    # Amplitude in standard deviations below which the readings say nothing of a parameter, such as
    # the z of a map in a cross-section: its value is that of the prior, 0 but for rounding.
    untold = 1e-9
    values, deviations = identified.reported
    return [(parameter, value, sd) for parameter, value, sd in zip(
        identified.parameters, values.tolist(), deviations.tolist(), strict=True)
        if sd > 0 and (abs(value) > untold * sd or np.abs(values).max() == 0)]


def human_unit(parameter: Parameter) -> tuple[str, float]:
    """Return the display unit of a parameter, and the factor to convert a value to it."""
    if parameter.unit == "1":
        return ("%", 100.0) if parameter.name in PERCENT_PARAMETERS else ("", 1.0)
    return DISPLAY_UNITS.get(parameter.unit, (parameter.unit, 1.0))


def _spaced(unit: str) -> str:
    """Return a unit after a space; nothing for a dimensionless one."""
    return f" {unit}" if unit and unit != "1" else ""


def _rounded(value: float, sd: float) -> str:
    """Format a value and its standard deviation, with two digits of the latter."""
    if not sd > 0:
        return f"{value:.6g}"
    exponent = int(np.floor(np.log10(sd)))
    if not -5 <= exponent <= 5:
        power = int(np.floor(np.log10(max(abs(value), sd))))
        digits = max(0, power - exponent + 1)
        return f"({value / 10.0**power:.{digits}f} ± {sd / 10.0**power:.{digits}f})e{power}"
    digits = max(0, 1 - exponent)
    return f"{value:.{digits}f} ± {sd:.{digits}f}"


def place_in_words(place: Place) -> str:
    """Describe a place in words; of two blocks, both."""
    if place.words:
        return label_in_words(place.name)
    numbers = [(place.ring, place.slot), *([place.other] if any(place.other) else [])]
    labels = place.labels or ("",) * len(numbers)
    blocks = [block_in_words(ring, slot, label)
              for (ring, slot), label in zip(numbers, labels, strict=True)]
    return " and ".join(filter(None, blocks)) or place.name


def label_in_words(label: str) -> str:
    """Describe a place by its label in words, as `place_in_words`: ``r01s05`` is ring 1, slot 5."""
    return re.sub(r"\br(\d+)(?:s(\d+))?\b", lambda found: block_in_words(
        int(found[1]), int(found[2] or 0)), label)


def _in_map(name: str | None) -> str:
    """Return the name of a map before what is said of it; nothing for the only one."""
    return "" if name is None else f"map {name}: "


@dataclass(frozen=True)
class OtherFinding:
    """Text on a finding of the diagnosis that is not an effect of the catalogue."""

    name: str
    title: str
    kind: str
    amount: str
    """Size of the finding."""
    sentence: str
    """The finding in a sentence."""
    place: str = EMPTY_CELL
    """Its place, if there is one."""
    log_bayes_factor: float = math.nan
    """NaN if there is none."""
    instead: str = EMPTY_CELL
    """Standard names of findings that the map does not distinguish from this one."""


def other_findings(diagnosis: Diagnosis) -> list[OtherFinding]:
    """Return gross errors, outliers, the solver's error and position noise as text."""
    found = []
    for error in diagnosis.gross_errors:
        instead = [" and ".join(other.names) if other.names != error.names else other.text
                   for other in error.alternatives]
        found.append(OtherFinding(
            " and ".join(error.names), error.convention.text, "gross error",
            f"misfit {100 * error.misfit_before:.3g} % → {100 * error.misfit_after:.2g} %",
            f"Gross error: {error.text}.{_or_a_factor(error)}",
            EMPTY_CELL if error.map is None else f"map {error.map}",
            instead=", ".join(dict.fromkeys(instead)) or EMPTY_CELL))
    for pose in diagnosis.poses:
        others = "" if not pose.others else (
            " Poses that the readings hardly tell from this one have a probability of "
            f"{', '.join(f'{100 * one:.0f}' for one in pose.others)} %.")
        found.append(OtherFinding(
            "pose", "place and axes of the map", "registration",
            f"misfit {_percent(pose.misfit_before)} → {_percent(pose.misfit_after)}",
            f"{'Map ' + pose.map if pose.map else 'The map'} is not where the study says: "
            f"{pose.text}.{others}",
            EMPTY_CELL if pose.map is None else f"map {pose.map}"))
    if diagnosis.outliers:
        text = "; ".join(
            _rows_in_words([one.row for one in diagnosis.outliers if one.map == name])
            + (" of the map" if name is None else f" of map {name}")
            for name in dict.fromkeys(one.map for one in diagnosis.outliers))
        count = len(diagnosis.outliers)
        found.append(OtherFinding(
            "outliers", "single readings that are outliers", "readings",
            f"{count} of {count + len(diagnosis.before.parts)}",
            f"{count} {'readings are outliers' if count > 1 else 'reading is an outlier'} and "
            f"excluded ({text})"
            f"{', unless what is unknown is largest there' if diagnosis.unknown else ''}.",
            place=text.removesuffix(" of the map")))
    if diagnosis.solver_error:
        cause = diagnosis.solver_error
        found.append(OtherFinding(
            "solver_error", "error of mesh and open boundary", "numerical",
            f"up to {1e3 * cause.largest_error_T:.2g} mT, {cause.largest_over_noise:.2g} times the "
            "noise",
            "The solver's own error explains the misfit: chi² per reading is "
            f"{decimals(cause.chi2_noise)} for the noise alone and "
            f"{decimals(cause.chi2_errors)} with that error."))
    for noise in diagnosis.position_noise:
        size, where = f"{1e3 * noise.sd_m:.2g} mm", f"map {noise.map}" if noise.map else ""
        found.append(OtherFinding(
            "vibration", "random errors of the probe's positions", "noise",
            f"{size} along each axis",
            f"The probe's positions{f' in {where}' if where else ''} have random errors of {size} "
            "along each axis.", where or EMPTY_CELL, noise.log_bayes_factor))
    return found


def _or_a_factor(error: GrossError) -> str:
    """Say which factor of all readings explains a map as well as points elsewhere; or nothing."""
    said = factor_in_words(error.factor) if error.factor else ""
    return said and f" Or, as well: {said[0].lower()}{said[1:]}"


def _rows_in_words(rows: Sequence[int]) -> str:
    """Name rows of a map."""
    # Largest number of outliers that a report lists. The summary has all of them.
    max_listed_rows = 10
    different = sorted(set(rows))
    return f"row{'s' if len(different) > 1 else ''} " + ", ".join(
        map(str, different[:max_listed_rows])) + ", ..." * (len(different) > max_listed_rows)


def position_in_words(position: PossiblePosition) -> str:
    """Describe a displacement of the map with its odds."""
    parts = []
    for name, values in position.amplitudes.items():
        lengths = ", ".join(f"{1e3 * value:.1f}" for value in values).replace("-", "−")
        effect, _, where = name.partition(" ")
        size = f"({lengths}) mm" if len(values) > 1 else f"{lengths} mm {OUTWARDS[effect]}"
        parts.append(f"{size} ({where})" if where else size)
    return f"{' and '.join(parts)} ({100 * position.probability:.0f} %)"


def rivals(identified: IdentifiedEffect) -> list[tuple[Candidate, float]]:
    """Return what the readings cannot distinguish: other effects, each at its best place, and the
    same one at other blocks, rings or instruments.

    A place that is fitted, as that of an object, has an error bar in place of others. The second
    item of each pair is the log Bayes factor.
    """
    effect, place = identified.hypothesis.effect, identified.place
    is_of_places = not effect.refinements and bool(effect.kind == "field" or place.instrument)
    best: dict[tuple[str, str], tuple[Candidate, float]] = {}
    for candidate, factor in identified.selection.alternatives:
        if candidate.effect != effect.name:
            best.setdefault((candidate.effect, ""), (candidate, factor))
        elif is_of_places:
            best.setdefault((candidate.effect, candidate.place), (candidate, factor))
    return list(best.values())


def diagnosis_summary(
    diagnosis: Diagnosis, separations: Sequence[Separation] = ()
) -> dict[str, object]:
    """Return the content of diagnosis.json, whose keys docs/diagnosis.md describes."""
    return {
        "study": diagnosis.before.study.name,
        "readings": {part: diagnosis.before.parts.count(part)
                     for part in (TRAINING, HELD_OUT, HELD_OUT_MAP)},
        "row_order": row_order_note(diagnosis.study),
        "rounds": diagnosis.rounds, "at_rest": diagnosis.converged,
        "answer": diagnosis.answer or diagnosis.rounds,
        "cut": None if diagnosis.uncompared is None else {"uncompared": diagnosis.uncompared},
        "compared": None if diagnosis.looked_for is None else {
            "effects": list(diagnosis.looked_for), "of": len(catalogue())},
        "verdict": diagnosis.verdict,
        "held_out_conflict": diagnosis.after.held_out_conflict or None,
        "gross": [_gross(error) for error in diagnosis.gross_errors],
        "poses": [_pose(pose) for pose in diagnosis.poses],
        "positions": [asdict(position) for position in diagnosis.positions],
        "outliers": [asdict(outlier) for outlier in diagnosis.outliers],
        "effects": [_entry(effect) for effect in diagnosis.identified],
        "limits": _limits_entry(diagnosis.limits) if diagnosis.limits else None,
        "numerical": asdict(diagnosis.solver_error) if diagnosis.solver_error else None,
        "vibration": _vibration_entry(diagnosis.position_noise),
        "suspected": [_suspicion(one) for one in diagnosis.suspected],
        "imitated": {key: getattr(diagnosis.imitated, key) for key in (
            "probability", "effects", "shares")} if diagnosis.imitated else None,
        "unknown": _unknown_entry(diagnosis.unknown) if diagnosis.unknown else None,
        "probabilities": dict(sorted(diagnosis.probabilities.items(), key=lambda item: -item[1])),
        "groups": {"before": [asdict(group) for group in diagnosis.groups_before],
                   "after": [asdict(group) for group in diagnosis.groups_after]},
        "main_field_T": main_field_T(diagnosis), "floor_T": diagnosis.floor_T,
        "scores": {"before": [asdict(fit) for fit in region_scores(
                       diagnosis.before, diagnosis.loo_residuals_before)],
                   "after": [asdict(fit) for fit in region_scores(
                       diagnosis.after, diagnosis.loo_residuals_after)]},
        "next": [{"effect": pair.identified.name, "rival": pair.rival.name,
                  "gains": pair.gains,
                  "recommended": pair.recommended and pair.recommended.name}
                 for pair in separations],
    }


def _gross(found: GrossError) -> dict[str, object]:
    """Return the JSON entry of a gross error."""
    def entry(convention: MapConvention) -> dict[str, object]:
        return {"errors": list(convention.names), "text": convention.text}

    return {**entry(found.convention), "map": found.map, "misfit_before": found.misfit_before,
            "misfit_after": found.misfit_after,
            "alternatives": [entry(convention) for convention in found.alternatives]}


def _pose(found: FoundPose) -> dict[str, object]:
    """Return the JSON entry of the place of a map."""
    best = found.best
    return {"map": found.map, "text": found.text, "middle_m": best.middle_m.tolist(),
            "translation_sd_m": best.translation_sd_m.tolist(),
            "rotation_rad": list(best.instrument.rotation_rad),
            "rotation_sd_rad": best.rotation_sd_rad.tolist(),
            "other_probabilities": list(found.others),
            "misfit_before": _finite(found.misfit_before), "misfit_after": found.misfit_after}


def _finite(value: float) -> float | None:
    """Return a number for JSON, which has no infinity."""
    return value if np.isfinite(value) else None


def _percent(misfit: float) -> str:
    """Return a misfit in words; it is infinite for points that were stated inside blocks."""
    return f"{100 * misfit:.2g} %" if np.isfinite(misfit) else "(inside blocks)"


def _vibration_entry(found: Sequence[PositionNoise]) -> object:
    """Return the JSON entry of position noise: of the only map, or by the names of the maps."""
    entries = {one.map: {"log_bayes_factor": one.log_bayes_factor, "sd_m": one.sd_m}
               for one in found}
    return entries.get(None, entries or None)


def _suspicion(one: Suspicion) -> dict[str, object]:
    """Return the JSON entry of a suspicion."""
    return {"effects": dict(zip(one.effects, one.shares, strict=True)),
            "place": one.hypothesis.place.name, "maps": list(one.hypothesis.place.maps),
            "probability": one.probability,
            "log_bayes_factor": one.log_bayes_factor, "not_named": one.reason}


def _unknown_entry(unknown: UnknownCause) -> dict[str, object]:
    """Return the JSON entry of an unknown cause; its key ``as_well`` is the field ``ambiguous``."""
    return {"as_well" if name == "ambiguous" else name: value
            for name, value in asdict(unknown).items()}


def _limits_entry(limits: DetectionLimits) -> dict[str, object]:
    """Return the JSON entry of the smallest changes of a block; null for one without a limit."""
    def entry(values: Floats) -> dict[str, object]:
        middle, largest = (float(value) if np.isfinite(value) else None
                           for value in (np.median(values), values.max()))
        return {"median": middle, "worst": largest, "worst_block": limits.worst(values)}

    return {"loss": entry(limits.loss), "displacement_m": entry(limits.displacement_m)}


def hidden_by_solver(update: InferenceResult) -> str:
    """Say that the solver's error hides what is smaller; nothing if the noise hides more.

    That error is an upper bound. Where readings are far nearer to the model than it allows, a
    finer mesh would show more.
    """
    # chi-squared per reading below which an error that exceeds the noise is stated too large, by
    # 1.4 or more; if it is right, a hundred readings leave 0.5 with a probability of 1e-5
    too_wide = 0.5
    if update.solver_over_noise < 1 or update.prior_conflict > too_wide:
        return ""
    return (f"The solver's own error is {update.solver_over_noise:.2g} times the noise and hides "
            f"what is smaller, though the readings are far nearer to the model (chi² per reading "
            f"{decimals(update.prior_conflict)}, where 1 is expected): an effect that hides there "
            "makes the blocks of an update wrong by more than their error bars. Refine `mesh`, "
            "and diagnose again.")


def limits_in_words(limits: DetectionLimits) -> str:
    """Say in a sentence which changes of a block the map would have shown."""
    # Largest displacement of a block that reports state; signatures are linear up to a few mm.
    most_displaced_mm = 10.0
    def amount(value: float, unit: str, most: float) -> str:
        return f"{value:.2g} {unit}" if value < most else f"more than {most:g} {unit}"

    parts = []
    for values, unit, most in ((100 * limits.loss, "%", 100.0),
                               (1e3 * limits.displacement_m, "mm", most_displaced_mm)):
        parts.append((amount(float(np.median(values)), unit, most),
                      amount(float(values.max()), unit, most),
                      _name_in_words(limits.worst(values))))
    (loss, most_loss, weak), (moved, most_moved, far) = parts
    return (f"It would have shown the loss of {loss} of a block's magnetization (median; "
            f"{most_loss} of {weak}, which shows least), or its displacement by {moved} in "
            f"any direction ({most_moved} of {far}).")


def _name_in_words(name: str) -> str:
    """Describe a block by its name: r03s05 is ring 3, slot 5, and others are labels of the user."""
    place = re.fullmatch(r"r(\d+)s(\d+)", name)
    return block_in_words(int(place[1]), int(place[2])) if place else f"block {name}"


def _entry(identified: IdentifiedEffect) -> dict[str, object]:
    """Return the JSON entry of an identified effect."""
    effect, selection = identified.hypothesis.effect, identified.selection
    values, deviations = identified.reported
    return {
        "effect": effect.name, "title": effect.title, "kind": effect.kind,
        "place": identified.place.name, "maps": list(identified.hypothesis.place.maps),
        "parameters": [
            {"name": parameter.name, "unit": parameter.unit, "value": value, "sd": sd}
            for parameter, value, sd in zip(identified.parameters, values.tolist(),
                                            deviations.tolist(), strict=True)],
        "log_bayes_factor": selection.log_bayes_factor, "log_odds": selection.log_odds,
        "alternatives": [
            {"effect": candidate.effect, "place": candidate.place, "log_bayes_factor": factor}
            for candidate, factor in selection.alternatives],
    }
