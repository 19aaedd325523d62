"""Sentences, tables and the HTML page of a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.diagnosis.discriminating_measurements import SEPARATING_GAIN, Separation
from halbach_fe.diagnosis.loo_residuals import DISCOVERIES, ResidualGroup
from halbach_fe.diagnosis.model_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
)
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.diagnosis.summary import (
    STUDY_FILE,
    SUMMARY_FILE,
    amounts,
    main_field_T,
    other_findings,
    place_in_words,
    region_scores,
    rivals,
)
from halbach_fe.inference.result import ALL_READINGS
from halbach_fe.report import diagnosis_figures as figures
from halbach_fe.report.diagnosis_answer import (
    answer,
    catalogue_titles,
    joined_by_or,
    title_of,
    titles_of_rivals,
)
from halbach_fe.report.diagnosis_figures import states
from halbach_fe.report.magnet_view_3d import colours_in_words, view_of_inference
from halbach_fe.report.page import own_style, save, write_page
from halbach_fe.report.unknown_cause import more_readings, unknown_advice
from halbach_fe.report.words import (
    BAYES_FACTOR_IN_WORDS,
    bayes_factor,
    decimals,
    flux_density,
    fraction,
)

FIGURES = {
    "groups": (figures.groups, "Chi² per reading of groups of readings, each group predicted from "
               "all other readings; markers are filled if the group disagrees with the model"),
    "residuals": (figures.residuals, "Standardized leave-one-out residuals of the training "
                  "readings"),
    "probabilities": (figures.probabilities, "Above: posterior probability of each effect of the "
                      "catalogue, if at most one effect is missing and nothing else. Below: how "
                      "many times as probable the readings are with each identified effect, or an "
                      "alternative of it, as without (Bayes factor); the dashed line is the "
                      "threshold"),
    "profile": (figures.profile, "The readings with the largest residuals before the diagnosis, "
                "the predictions of the updated models, and their residuals; the band holds 95 % "
                "of the residuals by the uncertainty of prediction and noise"),
    "magnetizations": (figures.magnetizations, "Inferred change of the magnetizations from the "
                       "prior by ring and slot, along and across the easy axis and along the "
                       "magnet")}
"""Function that draws each figure of the page, and its caption."""

ALONE = ("Posterior probability of each effect of the catalogue, if at most one effect is missing "
         "and nothing else")
"""Caption of the picture of probabilities if nothing was found."""

SCATTERED = ("Measured less predicted over the map, before and after the diagnosis: what remains "
             "after it should be noise, without a pattern")
"""Caption of the profile of points that lie on no line or circle."""


def found_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Return the rows of a table of all findings, as text."""
    titles = catalogue_titles(diagnosis)
    found = [{"effect": finding.title, "place": finding.place, "amplitude": finding.amount,
              "Bayes factor": bayes_factor(finding.log_bayes_factor),
              "it could be": finding.instead}
             for finding in other_findings(diagnosis)]
    return found + [
        {"effect": title_of(effect.hypothesis.effect.name, titles),
         "place": place_in_words(effect.place),
         "amplitude": "; ".join(amounts(effect)),
         "Bayes factor": bayes_factor(effect.selection.log_bayes_factor),
         "it could be": ", ".join(titles_of_rivals(effect, titles)) or EMPTY_CELL}
        for effect in diagnosis.identified]


def change_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Return the rows of a table of the model's fit before and after the diagnosis, as text."""
    found = [region_scores(state.update, state.loo_residuals) for state in states(diagnosis)]
    rows = []
    for number, fit in enumerate(found[0]):
        region = "" if fit.region == ALL_READINGS else f", {fit.region}"
        rows.append({"readings": f"{fit.part}{region}", "count": str(fit.readings)} | {
            name: " → ".join(text(getattr(fits[number], key)) for fits in found)
            for name, key, text in (("chi²/reading", "chi2_per_reading", decimals),
                                    ("95 % band holds", "coverage95", fraction))})
    return rows


def residual_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Return the rows of a table of rms differences of model and readings by component, as text.

    Training readings have been fitted, held-out readings have not.
    """
    shown, main = states(diagnosis), main_field_T(diagnosis)
    found = [region_scores(state.update, state.loo_residuals) for state in shown]
    rows = []
    for number, fit in enumerate(found[-1]):
        for component, last in fit.rms_T.items():
            sizes = {state.when: fits[number].rms_T[component]
                     for state, fits in zip(shown, found, strict=True)}
            if diagnosis.floor_T:
                sizes["model-free floor"] = _floor(diagnosis, fit.region, component)
            rows.append({"readings": fit.part + (
                "" if fit.region == ALL_READINGS else f", {fit.region}"), "component": component}
                | {name: flux_density(size) for name, size in sizes.items()}
                | {"ppm of the main field": f"{1e6 * last / main:.3g}"})
    return rows


def _floor(diagnosis: Diagnosis, region: str, component: str) -> float:
    """Return the floor in T of a component in a region; NaN if it is not known."""
    floors = diagnosis.floor_T or {}
    own = floors.get(region.partition(":")[0], floors.get(component))
    if isinstance(own, Mapping):
        own = own.get(component)
    return float("nan") if own is None else float(own)


@own_style
def write_diagnosis_report(
    diagnosis: Diagnosis, separations: Sequence[Separation], folder: Path,
    assumptions: Sequence[str] = (),
) -> None:
    """Write the self-contained page diagnosis.html, and its figures as PNG, into ``folder``.

    Parameters
    ----------
    diagnosis : Diagnosis
    separations : sequence of Separation
        Further measurements, see `halbach_fe.diagnosis.discriminating_measurements.separations`.
    folder : Path
    assumptions : sequence of str
        Sentences that the page shows before the result.
    """
    drawn = {name: (draw(diagnosis), text) for name, (draw, text) in FIGURES.items()}
    if figures.is_scattered(diagnosis.before):
        drawn["profile"] = drawn["profile"][0], SCATTERED
    if not diagnosis.identified and diagnosis.unknown is None:
        drawn["probabilities"] = drawn["probabilities"][0], ALONE
    pictures = save({f"diagnosis_{name}.png": each for name, each in drawn.items()}, folder)
    titles = catalogue_titles(diagnosis)
    write_page(
        folder / "diagnosis.html", "diagnosis.html.j2", pictures, diagnosis=diagnosis,
        study=diagnosis.before.study, answer=answer(diagnosis), assumptions=assumptions,
        shown=dict(zip(drawn, pictures, strict=True)), view=view_of_inference(
            diagnosis.after, {place for effect in diagnosis.identified for place in (
                (effect.place.ring, effect.place.slot), effect.place.other)}),
        view_colours=colours_in_words(diagnosis.after),
        rows=[{"finding": finding.title, "place": finding.place, "amplitude": finding.amount,
                "Bayes factor": bayes_factor(finding.log_bayes_factor), "kind": finding.kind}
               for finding in other_findings(diagnosis)]
        + [_entry(effect, titles) for effect in diagnosis.identified],
        changes=change_table(diagnosis), residuals=residual_table(diagnosis),
        main_field=flux_density(main_field_T(diagnosis)), disagreeing="; ".join(
            f"{state.when}: {_disagreement_summary(state.groups)}" for state in states(diagnosis)),
        states=[state.when for state in states(diagnosis)],
        classes=[f"{f'Map {error.map}' if error.map else 'The map'} would be the same with "
                 f"{joined_by_or(texts)}."
                 for error in diagnosis.gross_errors
                 if (texts := [alternative.text for alternative in error.alternatives])]
        + [_equivalence_sentence(effect, titles)
           for effect in diagnosis.identified if rivals(effect)],
        structure=figures.structure(diagnosis),
        further=[_further_measurements(effect, own, titles) for effect in diagnosis.identified
                 if (own := [pair for pair in separations
                             if pair.identified == effect.hypothesis])],
        ground={"certain": math.exp(DETECTION_LOG_ODDS),
                "alike": math.exp(INDISTINGUISHABLE_LOG_EVIDENCE),
                "odds": round(1 / EFFECT_PRIOR_ODDS), "enough": math.exp(SEPARATING_GAIN),
                "discoveries": DISCOVERIES},
        advice=unknown_advice(diagnosis.unknown) if diagnosis.unknown else
        " ".join(map(more_readings, diagnosis.suspected)) if diagnosis.suspected else
        "None of the candidate measurements would distinguish the effects from their alternatives."
        if any(rivals(effect) for effect in diagnosis.identified) else "",
        in_words=BAYES_FACTOR_IN_WORDS, study_file=STUDY_FILE, summary_file=SUMMARY_FILE)


def _disagreement_summary(found: Sequence[ResidualGroup]) -> str:
    """Describe how many groups of readings disagree with the model, and which disagrees most."""
    wrong = [group for group in found if group.disagrees]
    if not wrong:
        return f"none of {len(found)}"
    worst = max(wrong, key=lambda group: group.chi2_per_reading)
    return (f"{len(wrong)} of {len(found)}, most of all {worst.name} "
            f"({decimals(worst.chi2_per_reading, 2)})")


def _equivalence_sentence(identified: IdentifiedEffect, titles: dict[str, str]) -> str:
    """Name the effects that the readings cannot distinguish from an identified effect."""
    own_name = identified.hypothesis.effect.name
    found = [f"{title}{' ' + one.place if one.place and one.effect != own_name else ''}, "
             f"{bayes_factor(factor)}" for title, (one, factor) in zip(
                 titles_of_rivals(identified, titles), rivals(identified), strict=True)]
    name = title_of(own_name, titles)
    own = bayes_factor(identified.selection.log_bayes_factor)
    return (f"Instead of {name} (Bayes factor {own}), the cause may equally well be: "
            f"{'; '.join(found)}.")


def _entry(identified: IdentifiedEffect, titles: dict[str, str]) -> dict[str, str]:
    """Return the row of an effect in the page's table of findings."""
    effect = identified.hypothesis.effect
    return {"finding": title_of(effect.name, titles),
            "place": place_in_words(identified.place) or EMPTY_CELL,
            "amplitude": "; ".join(text.replace(" ", "\u00a0") for text in amounts(identified)),
            "Bayes factor": bayes_factor(identified.selection.log_bayes_factor),
            "kind": effect.kind}


def _further_measurements(
    identified: IdentifiedEffect, own: Sequence[Separation], titles: dict[str, str],
) -> dict[str, object]:
    """Return what the page shows on measurements that distinguish an effect from its rivals."""
    candidates = {candidate.name: candidate.title for pair in own for candidate in pair.candidates}
    return {
        "what": title_of(identified.hypothesis.effect.name, titles),
        "advice": [(title_of(pair.rival.effect.name, titles),
                    pair.recommended.title if pair.recommended else "") for pair in own],
        "rows": [{"measurement": title} | {
            f"against {pair.rival.effect.name}": _gain(pair.gains[name]) for pair in own}
            for name, title in candidates.items()]}


def _gain(value: float) -> str:
    """Format a gain in the log Bayes factor."""
    return bayes_factor(max(value, 0.0))
