"""Sentences, tables and the HTML page of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from halbach_fe.diagnosis.discriminating_measurements import SEPARATING_GAIN, Separation
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.loo_residuals import DISCOVERIES, ResidualGroup
from halbach_fe.diagnosis.model_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
    MAX_EFFECTS,
)
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.diagnosis.summary import (
    EMPTY_CELL,
    PRESENT,
    STUDY_FILE,
    SUMMARY_FILE,
    amounts,
    limits_in_words,
    main_field_T,
    other_findings,
    place_in_words,
    position_in_words,
    region_scores,
    rivals,
)
from halbach_fe.inference.result import ALL_READINGS, TRAINING
from halbach_fe.report import diagnosis_figures as figures
from halbach_fe.report.diagnosis_figures import states
from halbach_fe.report.magnet_view_3d import view_of_inference
from halbach_fe.report.page import own_style, save, write_page
from halbach_fe.report.unknown_cause import (
    more_readings,
    suspicion_sentences,
    unknown_advice,
    unknown_sentences,
)
from halbach_fe.report.words import flux_density, fraction

UNUSUAL_AMPLITUDE = 20.0
"""Amplitude in prior standard deviations above which the page warns: far beyond the errors of a
magnet that is built with care."""

FIGURES = {
    "groups": (figures.groups, "Chi² per reading of groups of readings, each group predicted from "
               "all other readings; markers are filled if the group disagrees with the model"),
    "residuals": (figures.residuals, "Standardized leave-one-out residuals of the training "
                  "readings"),
    "probabilities": (figures.probabilities, "Left: posterior probability of each effect of the "
                      "catalogue, if at most one effect is missing and nothing else. Right: log "
                      "Bayes factors of the identified effects and of their alternatives; the "
                      "dashed line is the threshold"),
    "profile": (figures.profile, "The readings with the largest residuals before the diagnosis, "
                "the predictions of the updated models, and their residuals; the band holds 95 % "
                "of the residuals by the uncertainty of prediction and noise"),
    "magnetizations": (figures.magnetizations, "Inferred change of the magnetizations from the "
                       "prior by ring and slot, along and across the easy axis and along the "
                       "magnet")}
"""Function that draws each figure of the page, and its caption."""


def verdict(diagnosis: Diagnosis) -> list[str]:
    """Describe the result of a diagnosis in sentences."""
    titles = _catalogue_titles(diagnosis)
    before, after, unknown = diagnosis.before, diagnosis.after, diagnosis.unknown
    sentences = [finding.sentence for finding in other_findings(diagnosis)]
    if diagnosis.uncompared is not None:
        sentences.insert(0, _cut_in_words(diagnosis.uncompared, diagnosis.rounds))
    if diagnosis.solver_error:
        return sentences
    if diagnosis.identified:
        fits = diagnosis.converged and after.prior_conflict <= after.conflict_limit
        start = f"{_maps(diagnosis)} explained by" if fits else (
            "The best explanation from the catalogue is")
        sentences.append(f"{start}: " + "; ".join(
            _effect_in_words(effect, titles) for effect in diagnosis.identified) + ".")
        sentences += [
            f"{_maps(diagnosis, 'do')} not tell {_title(effect.hypothesis.effect.name, titles)} "
            f"from {_joined_by_or(_titles(effect, titles))}."
            for effect in diagnosis.identified if rivals(effect)]
        if diagnosis.positions:
            sentences.append(
                "The magnet is the same from several sides, so that the readings may be "
                "displaced by "
                f"{_joined_by_or([position_in_words(each) for each in diagnosis.positions])}; the "
                "first is used here.")
        unusual = [f"{_title(effect.hypothesis.effect.name, titles)} ({ratio:.0f} times)"
                   for effect in diagnosis.identified
                   if (ratio := _over_prior_sd(effect)) > UNUSUAL_AMPLITUDE]
        if unusual:
            sentences.append(
                "Far larger than usual (relative to the prior's standard deviation): "
                f"{', '.join(unusual)}. Unless another measurement confirms such an effect, "
                "suspect another cause.")
        if not diagnosis.converged and diagnosis.uncompared is None:
            sentences.append(
                f"The search had not converged after {diagnosis.rounds} rounds: the effects or "
                "their amplitudes still changed.")
        if len(diagnosis.identified) == MAX_EFFECTS:
            sentences.append(
                f"These are {MAX_EFFECTS} effects, the largest number that is searched for. So "
                "many effects together are a fit rather than a diagnosis, and some of them take "
                "the place of another cause.")
    elif diagnosis.suspected:
        sentences.append("Nothing can be named for certain.")
    elif unknown is None and after.prior_conflict <= after.conflict_limit:
        several = after.is_campaign
        these = "these maps" if several else "this map"
        start = ("Nothing was found so far:" if diagnosis.uncompared is not None else
                 f"Nothing else is missing that {these} can show: with that," if sentences
                 else f"Nothing is missing that {these} can show:")
        agree = "the maps agree" if several else "the map agrees"
        return [*sentences, f"{start} {agree} with the study within noise (chi² per reading "
                f"{after.prior_conflict:.3g}).", *([after.too_near] if after.too_near else []),
                *([limits_in_words(diagnosis.limits)] if diagnosis.limits else [])]
    if unknown is not None:
        sentences += unknown_sentences(unknown, bool(diagnosis.identified))
    elif not diagnosis.identified and not diagnosis.suspected:
        disagree = "The maps disagree" if after.is_campaign else "The map disagrees"
        return [*sentences, f"{disagree} with the study (chi² per reading "
                f"{after.prior_conflict:.3g}, where {after.conflict_limit:.3g} would be rare), and "
                "no effect of the catalogue explains the difference, nor does a smooth field or "
                "sensor error. Check the noise of the study."]
    for suspicion in diagnosis.suspected:
        sentences += suspicion_sentences(suspicion, titles)
    if diagnosis.identified:
        held = ["".join(f", and {fit.chi2_per_reading:.3g} for held-out readings"
                        for fit in [each for each in fits if each.part != TRAINING][:1])
                for fits in (region_scores(before, diagnosis.loo_residuals_before),
                              region_scores(after, diagnosis.loo_residuals_after))]
        added = "this effect" if len(diagnosis.identified) == 1 else "these effects"
        sentences.append(
            f"With {added} in the model, chi² per training reading is "
            f"{after.prior_conflict:.3g}{held[1]} (before: {before.prior_conflict:.3g}{held[0]}).")
        if after.prior_conflict > after.conflict_limit and unknown is None:
            sentences.append("That is still too large: another cause is missing.")
        sentences.append(f"{STUDY_FILE} is the study with {added}, for halbach-fe infer "
                         "and all that follows.")
    return sentences


def _maps(diagnosis: Diagnosis, verb: str = "are") -> str:
    """Return the map, or the maps, as the subject of a sentence with a verb."""
    if diagnosis.after.is_campaign:
        return f"The maps {verb}"
    return f"The map {'is' if verb == 'are' else 'does'}"


def _cut_in_words(uncompared: int, rounds: int) -> str:
    """Say that the time limit cut the search."""
    text = ("The time limit cut the search after "
            f"{rounds} {'rounds' if rounds > 1 else 'round'}: this is what it had so far")
    return f"{text}, with {uncompared} hypotheses not compared." if uncompared else f"{text}."


def _over_prior_sd(identified: IdentifiedEffect) -> float:
    """Return the largest ratio of an amplitude to its prior standard deviation.

    Amplitudes that only say whether an effect is present are ignored.
    """
    effect = identified.hypothesis.effect
    first = int(effect.is_binary or effect.applied_in_full)
    return max((abs(value) / parameter.sd for value, parameter in zip(
        identified.values[first:], identified.parameters[first:], strict=True)), default=0.0)


def found_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Return the rows of a table of all findings, as text."""
    found = [{"effect": finding.name, "place": finding.place, "amplitude": finding.amount,
              "log Bayes factor": finding.factor, "it could be": finding.instead}
             for finding in other_findings(diagnosis)]
    return found + [
        {"effect": effect.selection.candidate.effect,
         "place": place_in_words(effect.place),
         "amplitude": "; ".join(amounts(effect)),
         "log Bayes factor": f"{effect.selection.log_bayes_factor:.1f}",
         "it could be": ", ".join(rival.effect for rival, _ in rivals(effect)) or EMPTY_CELL}
        for effect in diagnosis.identified]


def change_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Return the rows of a table of the model's fit before and after the diagnosis, as text."""
    found = [region_scores(state.update, state.loo_residuals) for state in states(diagnosis)]
    rows = []
    for number, fit in enumerate(found[0]):
        region = "" if fit.region == ALL_READINGS else f", {fit.region}"
        rows.append({"readings": f"{fit.part}{region}", "count": str(fit.readings)} | {
            name: " → ".join(text(getattr(fits[number], key)) for fits in found)
            for name, key, text in (("chi²/reading", "chi2_per_reading", _figure),
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
    pictures = save({f"diagnosis_{name}.png": each for name, each in drawn.items()}, folder)
    titles = _catalogue_titles(diagnosis)
    write_page(
        folder / "diagnosis.html", "diagnosis.html.j2", pictures, diagnosis=diagnosis,
        study=diagnosis.before.study, verdict=verdict(diagnosis), assumptions=assumptions,
        shown=dict(zip(drawn, pictures, strict=True)), view=view_of_inference(diagnosis.after),
        found=[{"finding": finding.title, "place": finding.place, "amplitude": finding.amount,
                "log Bayes factor": finding.factor, "kind": finding.kind}
               for finding in other_findings(diagnosis)]
        + [_entry(effect, titles) for effect in diagnosis.identified],
        changes=change_table(diagnosis), residuals=residual_table(diagnosis),
        main_field=flux_density(main_field_T(diagnosis)), disagreeing="; ".join(
            f"{state.when}: {_disagreement_summary(state.groups)}" for state in states(diagnosis)),
        states=[state.when for state in states(diagnosis)],
        classes=[f"{f'Map {error.map}' if error.map else 'The map'} would be the same with "
                 f"{_joined_by_or(texts)}."
                 for error in diagnosis.gross_errors
                 if (texts := [alternative.text for alternative in error.alternatives])]
        + [_equivalence_sentence(effect, titles)
           for effect in diagnosis.identified if rivals(effect)],
        structure=figures.structure(diagnosis),
        further=[_further_measurements(effect, own, titles) for effect in diagnosis.identified
                 if (own := [pair for pair in separations
                             if pair.identified == effect.hypothesis])],
        ground={"found": DETECTION_LOG_ODDS, "alike": INDISTINGUISHABLE_LOG_EVIDENCE,
                "odds": round(1 / EFFECT_PRIOR_ODDS), "enough": SEPARATING_GAIN,
                "discoveries": DISCOVERIES},
        advice=unknown_advice(diagnosis.unknown) if diagnosis.unknown else
        " ".join(map(more_readings, diagnosis.suspected)) if diagnosis.suspected else
        "Further measurements are not compared, because the study leaves terms of instruments open "
        "(`instrument_sd`)." if diagnosis.before.terms is not None else
        "None of the candidate measurements would distinguish the effects from their alternatives."
        if any(rivals(effect) for effect in diagnosis.identified) else "",
        study_file=STUDY_FILE, summary_file=SUMMARY_FILE)


def _effect_in_words(identified: IdentifiedEffect, titles: dict[str, str]) -> str:
    """Describe an effect with its place and amplitudes."""
    effect = identified.hypothesis.effect
    parts = [_title(effect.name, titles), place_in_words(identified.place),
             "; ".join(text for text in amounts(identified) if text != PRESENT)]
    return ", ".join(part for part in parts if part)


def _catalogue_titles(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the descriptions of all effects by name."""
    return {effect.name: effect.title for effect in (
        *catalogue(), *(identified.hypothesis.effect for identified in diagnosis.identified))}


def _titles(identified: IdentifiedEffect, titles: dict[str, str]) -> list[str]:
    """Return the descriptions of an effect's rivals."""
    return [_title(candidate.effect, titles) for candidate, _ in rivals(identified)]


def _title(name: str, titles: dict[str, str]) -> str:
    """Return the description of an effect, with its name if other effects have the same
    description.
    """
    title = titles.get(name, name)
    return f"{title} ({name})" if list(titles.values()).count(title) > 1 else title


def _disagreement_summary(found: Sequence[ResidualGroup]) -> str:
    """Describe how many groups of readings disagree with the model, and which disagrees most."""
    wrong = [group for group in found if group.disagrees]
    if not wrong:
        return f"none of {len(found)}"
    worst = max(wrong, key=lambda group: group.chi2_per_reading)
    return (f"{len(wrong)} of {len(found)}, most of all {worst.name} "
            f"({worst.chi2_per_reading:.2g})")


def _equivalence_sentence(identified: IdentifiedEffect, titles: dict[str, str]) -> str:
    """Name the effects that the readings cannot distinguish from an identified effect."""
    found = [f"{title}{' ' + candidate.place if candidate.place else ''}, {factor:.1f}"
             for title, (candidate, factor) in zip(
                 _titles(identified, titles), rivals(identified), strict=True)]
    name = _title(identified.hypothesis.effect.name, titles)
    return (f"Instead of {name} (log Bayes factor {identified.selection.log_bayes_factor:.1f}), "
            f"the cause may equally well be: {'; '.join(found)}.")


def _entry(identified: IdentifiedEffect, titles: dict[str, str]) -> dict[str, str]:
    """Return the row of an effect in the page's table of findings."""
    effect = identified.hypothesis.effect
    return {"finding": _title(effect.name, titles),
            "place": place_in_words(identified.place) or EMPTY_CELL,
            "amplitude": "; ".join(text.replace(" ", "\u00a0") for text in amounts(identified)),
            "log Bayes factor": f"{identified.selection.log_bayes_factor:.1f}",
            "kind": effect.kind}


def _joined_by_or(parts: Sequence[str]) -> str:
    """Join phrases by commas and a final "or"."""
    return " or ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _further_measurements(
    identified: IdentifiedEffect, own: Sequence[Separation], titles: dict[str, str],
) -> dict[str, object]:
    """Return what the page shows on measurements that distinguish an effect from its rivals."""
    candidates = {candidate.name: candidate.title for pair in own for candidate in pair.candidates}
    return {
        "what": _title(identified.hypothesis.effect.name, titles),
        "advice": [(_title(pair.rival.effect.name, titles),
                    pair.recommended.title if pair.recommended else "") for pair in own],
        "rows": [{"measurement": title} | {
            f"against {pair.rival.effect.name}": _gain(pair.gains[name]) for pair in own}
            for name, title in candidates.items()]}


def _gain(value: float) -> str:
    """Format a gain in the log Bayes factor."""
    return f"{max(value, 0.0):.1f}" if value < 1000 else "over 1000"


def _figure(value: float) -> str:
    """Format a number with three digits."""
    return f"{value:.3g}"
