"""What a diagnosis leaves behind: words, numbers for machines, and the study's file, mended."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.discriminating_measurements import Separation
from halbach_fe.diagnosis.effects.base import Parameter, Place
from halbach_fe.diagnosis.gross_errors import GrossError
from halbach_fe.diagnosis.loo_residuals import ResidualGroup
from halbach_fe.diagnosis.map_conventions import MapConvention
from halbach_fe.diagnosis.model_selection import Candidate
from halbach_fe.diagnosis.result import Diagnosis, Hypothesis, IdentifiedEffect
from halbach_fe.inference.result import (
    ALL_READINGS,
    COVERAGE_Z,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
)
from halbach_fe.study.edit import edited_text
from halbach_fe.study.model import Study

STUDY_FILE, SUMMARY_FILE = "study.diagnosed.toml", "diagnosis.json"

HUMAN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "T": ("mT", 1e3), "1/T": ("%/T", 100.0),
         "1/T^2": ("%/T²", 100.0), "A m2": ("A m²", 1.0), "K": ("K", 1.0)}
"""Units for people, and how many of them."""

NOTHING = "–"
MOST_ROWS = 10
"""Of outliers, that are told; all are in the summary."""

FRACTIONS = {"gain", "loss", "gradient", "scale"}
"""Parameters without a unit that are told in percent."""


@dataclass(frozen=True)
class Score:
    """How a model meets the readings of a region; of training readings by those left out.

    Attributes
    ----------
    region, part : str
    readings : int
    chi2_per_reading : float
        By the full covariance of prediction and noise; of training readings by that of the prior.
    median_relative_error : float or None
        Of the posterior; None if all readings are 0.
    coverage95 : float
        Fraction within the 95 % band, of training readings each foretold by all others.
    """

    region: str
    part: str
    readings: int
    chi2_per_reading: float
    median_relative_error: float | None
    coverage95: float


def region_scores(update: InferenceResult, left_out: Floats) -> list[Score]:
    """Of all readings of each part, and of those that the update has not seen by region."""
    parts, regions = np.array(update.parts), np.array(update.regions)
    training = parts == TRAINING
    found = [Score(ALL_READINGS, TRAINING, int(training.sum()), update.prior_conflict,
                   _median(update, training), float(np.mean(np.abs(left_out) <= COVERAGE_Z)))]
    names = list(dict.fromkeys(update.regions))
    for part in (HELD_OUT, HELD_OUT_MAP):
        for region in [ALL_READINGS, *(names if len(names) > 1 else [])]:
            chosen = (parts == part) & ((regions == region) | (region == ALL_READINGS))
            if chosen.any():
                found.append(Score(
                    region, part, int(chosen.sum()),
                    float(np.mean(update.whitened(update.prediction_posterior, chosen) ** 2)),
                    _median(update, chosen), float(np.mean(np.abs(update.standardized(
                        update.prediction_posterior)[chosen]) <= COVERAGE_Z))))
    return found


def _median(update: InferenceResult,
            chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> float | None:
    errors = update.relative_error(update.prediction_posterior)[chosen]
    return None if np.isnan(errors).all() else float(np.nanmedian(errors))


def write_summary(
    diagnosis: Diagnosis, separations: Sequence[Separation], folder: Path
) -> None:
    """Write diagnosis.json."""
    text = json.dumps(diagnosis_summary(diagnosis, separations), indent=1, allow_nan=False)
    write_text(folder / SUMMARY_FILE, text + "\n")


def write_study(text: str, study: Study, diagnosis: Diagnosis, folder: Path) -> None:
    """Write study.diagnosed.toml, from the text of the study's file.

    Raises
    ------
    StudyError
        If the amplitudes are none that a study may have.
    """
    write_text(folder / STUDY_FILE, edited_text(text, _steps(study, diagnosis)))


def _steps(study: Study, diagnosis: Diagnosis) -> Iterator[tuple[Study, str]]:
    """Studies on the way from a file's to the diagnosed one, and what each step is for."""
    yield study, "so that this file needs no other"
    for error in diagnosis.gross:
        study = error.apply(study)
        yield study, f"gross error: {error.reading.text}"
    study = diagnosis.read
    yield study, f"outliers: {len(diagnosis.outliers)}" if diagnosis.outliers else ""
    for one in diagnosis.named:
        hypothesis = one.hypothesis
        study = hypothesis.effect.apply(study, hypothesis.place, one.values.tolist())
        yield study, note(one)
    shaken = diagnosis.vibration
    yield diagnosis.study, "" if shaken is None else (
        f"vibration: {1e3 * shaken.sd_m:.2g} mm, log Bayes factor {shaken.log_bayes_factor:.1f}")


def note(named: IdentifiedEffect) -> str:
    """A line about an effect, in the units of the study."""
    told = ", ".join(f"{parameter.name} {_rounded(value, sd)}{_spaced(parameter.unit)}"
                     for parameter, value, sd in _uncertain(named))
    candidate = named.found.candidate
    factor = f"log Bayes factor {named.found.log_bayes_factor:.1f}"
    return f"{candidate.name}: {told or 'there'}, {factor}"


def amounts(named: IdentifiedEffect) -> list[str]:
    """Amplitudes with their standard deviations, in units for people."""
    found, told = [], _uncertain(named)
    for parameter, value, sd in told:
        unit, factor = human_unit(parameter)
        alone = len(told) == 1 and parameter.name in named.hypothesis.effect.title
        name = "" if alone else f"{parameter.name} "
        text = _rounded(factor * value, factor * sd).replace("-", "−")
        found.append(f"{name}{text}{_spaced(unit)}")
    return found or ["there"]


def _uncertain(named: IdentifiedEffect) -> list[tuple[Parameter, float, float]]:
    """Amplitudes that are no yes or no."""
    return [(parameter, value, sd) for parameter, value, sd in zip(
        named.parameters, named.values.tolist(), named.sd.tolist(), strict=True) if sd > 0]


def human_unit(parameter: Parameter) -> tuple[str, float]:
    """A unit for people, and how many of it are one of the parameter's."""
    if parameter.unit == "1":
        return ("%", 100.0) if parameter.name in FRACTIONS else ("", 1.0)
    return HUMAN.get(parameter.unit, (parameter.unit, 1.0))


def _spaced(unit: str) -> str:
    return f" {unit}" if unit and unit != "1" else ""


def _rounded(value: float, sd: float) -> str:
    """Value and standard deviation, two digits of the latter."""
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
    """A place in words."""
    parts = [f"{what} {number}" for what, number in (("ring", place.ring), ("slot", place.slot))
             if number]
    return ", ".join(parts) or place.name


@dataclass(frozen=True)
class Other:
    """Something that was found and is no effect of the catalogue, as text.

    ``instead`` are standard names of what it could be as well.
    """

    name: str
    title: str
    kind: str
    amount: str
    sentence: str
    place: str = NOTHING
    factor: str = NOTHING
    instead: str = NOTHING


def others(diagnosis: Diagnosis) -> list[Other]:
    """Gross errors, outliers, the solver's error and vibration."""
    found = []
    for one in diagnosis.gross:
        instead = [" and ".join(other.names) for other in one.alternatives]
        found.append(Other(
            " and ".join(one.names), one.reading.text, "gross error",
            f"misfit {100 * one.misfit_before:.3g} % → {100 * one.misfit_after:.2g} %",
            f"Gross error: {one.reading.text}.",
            instead=", ".join(dict.fromkeys(instead)) or NOTHING))
    if diagnosis.outliers:
        rows = sorted({one.row for one in diagnosis.outliers})
        text = f"row{'s' if len(rows) > 1 else ''} " + ", ".join(
            map(str, rows[:MOST_ROWS])) + ", ..." * (len(rows) > MOST_ROWS)
        count = len(diagnosis.outliers)
        found.append(Other(
            "outliers", "readings that are off singly", "readings",
            f"{count} of {count + len(diagnosis.before.parts)}",
            f"{count} {'readings are' if count > 1 else 'reading is'} off singly and left out "
            f"({text} of the map).", place=text))
    if diagnosis.numerical:
        cause = diagnosis.numerical
        found.append(Other(
            "solver_error", "error of mesh and open boundary", "numerical",
            f"up to {1e3 * cause.largest_error_T:.2g} mT, {cause.largest_over_noise:.2g} times the "
            "noise",
            "The solver's own error explains the misfit: chi² per reading is "
            f"{cause.chi2_noise:.3g} by the noise alone and {cause.chi2_errors:.3g} with that "
            "error. Make `mesh` finer or `open_boundary` farther before anything is concluded."))
    if diagnosis.vibration:
        size = f"{1e3 * diagnosis.vibration.sd_m:.2g} mm"
        found.append(Other(
            "vibration", "positions that shake", "noise", f"{size} along each axis",
            f"The positions shake by {size}.",
            factor=f"{diagnosis.vibration.log_bayes_factor:.1f}"))
    return found


def rivals(named: IdentifiedEffect) -> list[tuple[Candidate, float]]:
    """Other effects that would do as well, each at its best place, with log Bayes factors."""
    best: dict[str, tuple[Candidate, float]] = {}
    for candidate, factor in named.found.alternatives:
        if candidate.effect != named.found.candidate.effect:
            best.setdefault(candidate.effect, (candidate, factor))
    return list(best.values())


def diagnosis_summary(diagnosis: Diagnosis, separations: Sequence[Separation] = ()) -> dict[str,
                                                                                            object]:
    """What a script wants to know of a diagnosis; the README says what everything is."""
    conflicting = diagnosis.after.prior_conflict > diagnosis.after.conflict_limit
    return {
        "study": diagnosis.before.study.name,
        "readings": {part: diagnosis.before.parts.count(part)
                     for part in (TRAINING, HELD_OUT, HELD_OUT_MAP)},
        "rounds": diagnosis.rounds, "at_rest": diagnosis.at_rest,
        "verdict": "numerical" if diagnosis.numerical else
        "unknown" if diagnosis.unknown and not diagnosis.anything else
        "unexplained" if not diagnosis.named and not diagnosis.unknown and conflicting else
        "named" if diagnosis.anything else "nothing",
        "gross": [_gross(one) for one in diagnosis.gross],
        "outliers": [asdict(one) for one in diagnosis.outliers],
        "effects": [_entry(one) for one in diagnosis.named],
        "numerical": asdict(diagnosis.numerical) if diagnosis.numerical else None,
        "vibration": asdict(diagnosis.vibration) if diagnosis.vibration else None,
        "unknown": asdict(diagnosis.unknown) if diagnosis.unknown else None,
        "probabilities": dict(sorted(diagnosis.probabilities.items(), key=lambda one: -one[1])),
        "groups": {"before": _groups(diagnosis.groups_before),
                   "after": _groups(diagnosis.groups_after)},
        "scores": {"before": [asdict(one) for one in region_scores(
                       diagnosis.before, diagnosis.left_out_before)],
                   "after": [asdict(one) for one in region_scores(
                       diagnosis.after, diagnosis.left_out_after)]},
        "next": [{"effect": _name(one.named), "rival": _name(one.rival), "gains": one.gains,
                  "recommended": one.recommended and one.recommended.name}
                 for one in separations],
    }


def _gross(found: GrossError) -> dict[str, object]:
    def told(reading: MapConvention) -> dict[str, object]:
        return {"errors": list(reading.names), "text": reading.text}

    return {**told(found.reading), "misfit_before": found.misfit_before,
            "misfit_after": found.misfit_after,
            "alternatives": [told(one) for one in found.alternatives]}


def _entry(named: IdentifiedEffect) -> dict[str, object]:
    effect, found = named.hypothesis.effect, named.found
    return {
        "effect": effect.name, "title": effect.title, "kind": effect.kind,
        "place": named.hypothesis.place.name,
        "parameters": [
            {"name": parameter.name, "unit": parameter.unit, "value": value, "sd": sd}
            for parameter, value, sd in zip(named.parameters, named.values.tolist(),
                                            named.sd.tolist(), strict=True)],
        "log_bayes_factor": found.log_bayes_factor, "log_odds": found.log_odds,
        "alternatives": [
            {"effect": candidate.effect, "place": candidate.place, "log_bayes_factor": factor}
            for candidate, factor in found.alternatives],
    }


def _groups(found: Sequence[ResidualGroup]) -> list[dict[str, object]]:
    return [asdict(one) for one in found]


def _name(hypothesis: Hypothesis) -> str:
    return f"{hypothesis.effect.name} {hypothesis.place.name}".strip()
