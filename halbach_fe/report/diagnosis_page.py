"""Page of `diagnose`: sentences and tables; its answer and figures are modules beside."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.diagnosis.discriminating_measurements import SEPARATING_GAIN, Separation
from halbach_fe.diagnosis.effect_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
)
from halbach_fe.diagnosis.gross_error_correction import blocks_of
from halbach_fe.diagnosis.marginal_evidence import DISCOVERIES, ResidualGroup
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.diagnosis.summary import (
    BLOCKS_FILE,
    STUDY_FILE,
    amounts,
    changed_studies,
    diagnosis_summary,
    main_field_T,
    other_findings,
    place_in_words,
    region_scores,
    rivals,
)
from halbach_fe.inference.result import ALL_READINGS
from halbach_fe.measurement.block_table import BlockTable, write_blocks
from halbach_fe.measurement.probe_law import row_order_note
from halbach_fe.report import diagnosis_figures as figures
from halbach_fe.report.diagnosis_answer import (
    answer,
    catalogue_titles,
    joined_by_or,
    more_readings,
    outside,
    title_of,
    titles_of_rivals,
    unknown_advice,
)
from halbach_fe.report.diagnosis_figures import states
from halbach_fe.report.inference_page import left_out_section, left_out_table
from halbach_fe.report.magnet_view_3d import colours_in_words, view_of_inference
from halbach_fe.report.page import Drawn, Page, Rows, Section, Table, View
from halbach_fe.report.words import (
    BAYES_FACTOR_IN_WORDS,
    bayes_factor,
    capital,
    decimals,
    flux_density,
    fraction,
)
from halbach_fe.study.model import Study

FIGURES = {
    "profile": (figures.profile, "The readings with the largest residuals before the diagnosis, "
                "the predictions of the updated models, and their residuals; the band holds 95 % "
                "of the residuals by the uncertainty of prediction and noise"),
    "groups": (figures.groups, "Chi² per reading of groups of readings, each group predicted from "
               "all other readings; markers are filled if the group disagrees with the model"),
    "residuals": (figures.residuals, "Standardized leave-one-out residuals of the training "
                  "readings"),
    "probabilities": (figures.probabilities, "Above: posterior probability of each effect of the "
                      "catalogue, if at most one effect is missing and nothing else. Below: how "
                      "many times as probable the readings are with each identified effect, or an "
                      "alternative of it, as without (Bayes factor); the dashed line is the "
                      "threshold"),
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


def found_table(diagnosis: Diagnosis) -> Rows:
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


def change_table(diagnosis: Diagnosis) -> Rows:
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


def residual_table(diagnosis: Diagnosis) -> Rows:
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


def page(
    diagnosis: Diagnosis, separations: Sequence[Separation] = (), study: Study | None = None,
    blocks: BlockTable | None = None,
) -> Page:
    """Return the page of a diagnosis, and the study with the identified effects added.

    Parameters
    ----------
    separations : sequence of Separation
        Further measurements, see `halbach_fe.diagnosis.discriminating_measurements.separations`.
    study : Study, optional
        The study before the diagnosis, if gross errors of it were corrected.
    blocks : BlockTable, optional
        The measured blocks, which are written as they fit the study with other rings.
    """
    study = study or diagnosis.before.study
    fitting = blocks_of(blocks, study, diagnosis.study)
    tables = {} if fitting is None or fitting is blocks else {
        BLOCKS_FILE: partial(write_blocks, fitting)}
    said = answer(diagnosis)
    if tables and STUDY_FILE in said.command:
        said = replace(said, command=said.command.replace(
            " -o DIR", f" --blocks DIR/{BLOCKS_FILE} -o DIR"))
    drawn = {f"diagnosis_{name}.png": (partial(draw, diagnosis), text)
             for name, (draw, text) in FIGURES.items()}
    if figures.is_scattered(diagnosis.before):
        drawn["diagnosis_profile.png"] = drawn["diagnosis_profile.png"][0], SCATTERED
    if not diagnosis.identified and diagnosis.unknown is None:
        drawn["diagnosis_probabilities.png"] = drawn["diagnosis_probabilities.png"][0], ALONE
    titles, found = catalogue_titles(diagnosis), found_table(diagnosis)
    rows = [{"finding": finding.title, "place": finding.place, "amplitude": finding.amount,
             "Bayes factor": bayes_factor(finding.log_bayes_factor), "kind": finding.kind}
            for finding in other_findings(diagnosis)] + [
        _entry(effect, titles) for effect in diagnosis.identified]
    places = {place for effect in diagnosis.identified for place in (
        (effect.place.ring, effect.place.slot), effect.place.other)}
    added = "with the findings added, each with a comment" if rows else "without changes"
    times = f"{diagnosis.rounds} {'times' if diagnosis.rounds > 1 else 'time'}"
    return Page(
        "diagnose", "what the model lacks", diagnosis.before.study, said,
        diagnosis_summary(diagnosis, separations), [
            _what_is_missing(diagnosis, rows), *_what_else(diagnosis, separations, titles, rows),
            *_grounds(diagnosis), left_out_section(diagnosis.after),
            Section([order := row_order_note(diagnosis.study)]),
            Section([View(lambda: view_of_inference(diagnosis.after, places),
                          colours_in_words(diagnosis.after))]),
            Section([f"{STUDY_FILE} beside this page is the study's file {added}; halbach-fe solve "
                     f"and infer accept it unchanged. The model was solved {times}."
                     + f" With its rings, {BLOCKS_FILE} takes the place of --blocks: where these "
                     "blocks are mounted is not known then." * bool(tables)],
                    "The study with what was missing" if rows else "The study")],
        {"Missing from the study": found,
         "The model before and after": change_table(diagnosis),
         "Rms difference of model and readings": residual_table(diagnosis),
         "Where nobody measured": left_out_table(diagnosis.after)},
        rows, drawn, files=tables, stem="diagnosis",
        remarks=[BAYES_FACTOR_IN_WORDS if found else "", order],
        new_study=(STUDY_FILE, partial(
            changed_studies, study or diagnosis.corrected_study, diagnosis)))


def _what_is_missing(diagnosis: Diagnosis, rows: Sequence[Mapping[str, str]]) -> Section:
    """Return the section of what was found."""
    if rows:
        return Section([Table(rows), (
            f"{BAYES_FACTOR_IN_WORDS} An effect is identified as missing if it is then "
            f"{math.exp(DETECTION_LOG_ODDS):.0f} times as probable as its absence. Each effect of "
            f"the catalogue has prior odds of 1\u00a0:\u00a0{1 / EFFECT_PRIOR_ODDS:.0f}, which "
            "its possible places share.")], "What is missing")
    of = "that was compared" if diagnosis.is_partial else "of the catalogue"
    return Section([
        f"No effect {of} explains the disagreement." if diagnosis.unknown is not None or (
            diagnosis.verdict == "unexplained")
        else f"No effect {of} is certain enough to be added; what is suspected is said "
        "above." if diagnosis.suspected else f"No effect {of} has to be added."],
        "What is missing")


def _what_else(
    diagnosis: Diagnosis, separations: Sequence[Separation], titles: dict[str, str],
    rows: Sequence[Mapping[str, str]],
) -> list[Section]:
    """Return the sections of other causes and what would tell them apart; none if all is well."""
    alike = [f"{f'Map {error.map}' if error.map else 'The map'} would be the same with "
             f"{joined_by_or(texts)}." for error in diagnosis.gross_errors
             if (texts := [alternative.text for alternative in error.alternatives])] + [
        _equivalence_sentence(effect, titles) for effect in diagnosis.identified if rivals(effect)]
    further = [part for effect in diagnosis.identified
               if (own := [pair for pair in separations if pair.identified == effect.hypothesis])
               for part in _further_measurements(effect, own, titles)]
    advice = (
        unknown_advice(diagnosis.unknown) if diagnosis.unknown else
        " ".join(map(more_readings, diagnosis.suspected)) if diagnosis.suspected else
        "None of the candidate measurements would distinguish the effects from their alternatives."
        if any(rivals(effect) for effect in diagnosis.identified) else "")
    if not (rows or alike or advice):
        return []
    if further:
        further.append(
            "The table shows the Bayes factor of the identified effect over the other that each "
            "measurement is expected to give if the former is present. More than "
            f"{math.exp(SEPARATING_GAIN):.0f} : 1 distinguishes the two, and the first (cheapest) "
            "measurement with that gain is recommended. The noise is that of the study; fields are "
            "those of the blocks in vacuum.")
    return [
        Section(alike or [
            "No other effect of the catalogue explains the readings equally well (odds within a "
            f"factor of {math.exp(INDISTINGUISHABLE_LOG_EVIDENCE):.0f})." if rows else
            "The diagnosis found nothing, so there are no alternatives."], "What else it could be"),
        Section(further or [advice or (
            "Nothing has to be measured for that: no other effect explains the readings as well."
            if rows else "Nothing was found that has to be told from anything else.")],
            "What would tell it from other causes")]


def _grounds(diagnosis: Diagnosis) -> list[Section]:
    """Return the folded sections on what the answer rests on."""
    shown = states(diagnosis)
    disagreeing = "; ".join(f"{state.when}: {_disagreement_summary(state.groups)}"
                            for state in shown)
    beyond = (f" Because something {outside(diagnosis)} is missing, the probabilities are not to "
              "be believed." if diagnosis.unknown and not diagnosis.unknown.ambiguous else "")
    searched = " and the search for outliers" if diagnosis.outliers else ""
    floor = ("; the model-free floor is what a field that obeys Maxwell's equations leaves on "
             "held-out lines, whatever the magnet" if diagnosis.floor_T else "")
    return [
        Section([
            "Every group of readings is predicted from all other readings, with the tolerances of "
            "the blocks taken into account: chi² per reading is 1 if the model lacks nothing "
            "there. Groups that disagree with the model (false discovery rate "
            f"{100 * DISCOVERIES:g} %): {disagreeing}.", Drawn("diagnosis_groups.png"),
            Drawn("diagnosis_residuals.png")], "Where model and map disagree", True),
        Section([
            "The magnetizations are integrated out over their prior. The probabilities refer to "
            "the study before the diagnosis, to effects as small changes of it, and assume that at "
            "most one effect is missing. The search then put effects into the model in full: what "
            "it found is in the table above, also where the probabilities said something else. The "
            "Bayes factor of each effect is that with the other identified effects in the model."
            f"{beyond}", Drawn("diagnosis_probabilities.png")], "How sure that is", True),
        Section([
            f"{' → '.join(state.when for state in shown).capitalize()}. Held-out readings were "
            f"used only for this table{searched}. The 95 % band of a training reading is that of "
            "its prediction from all other training readings.",
            Table(change_table(diagnosis), "numbers"),
            "Rms difference of the updated model and the readings. The main field is "
            f"{flux_density(main_field_T(diagnosis))}{floor}.",
            Table(residual_table(diagnosis), "numbers")], "What changed", True),
        Section([
            "If the model lacks an effect, the inferred magnetizations of the blocks absorb part "
            "of it. Changes beyond the prior's standard deviation, or a common pattern over rings "
            "or slots, are therefore not tolerances of single blocks, and a correct diagnosis "
            "removes them. A change that all blocks share may also be the calibration of the coil "
            "that measured them, if the prior has one (prior.common_mode_sd). (A map with few "
            "readings resolves only patterns over several blocks.)",
            Table(figures.structure(diagnosis), "numbers"), Drawn("diagnosis_magnetizations.png")],
            "Structure in the magnetizations", True)]


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
) -> list[str | Table]:
    """Return what the page shows on measurements that distinguish an effect from its rivals."""
    candidates = {candidate.name: candidate.title for pair in own for candidate in pair.candidates}
    what = title_of(identified.hypothesis.effect.name, titles)
    return [*(f"{capital(what)}, or {title_of(pair.rival.effect.name, titles)}? " + (
        f"**Measure next: {pair.recommended.title}.**" if pair.recommended else
        "None of the measurements below would distinguish them.") for pair in own), Table([
            {"measurement": title} | {
                f"against {pair.rival.effect.name}": bayes_factor(max(pair.gains[name], 0.0))
                for pair in own}
            for name, title in candidates.items()], "numbers")]
