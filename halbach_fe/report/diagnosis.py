"""Words, tables and the HTML page of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from halbach_fe.diagnosis.discriminating_measurements import ENOUGH, Separation
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.loo_residuals import DISCOVERIES, ResidualGroup
from halbach_fe.diagnosis.model_selection import ALIKE, EFFECT_ODDS, FOUND, MOST
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.diagnosis.summary import (
    NOTHING,
    STUDY_FILE,
    SUMMARY_FILE,
    amounts,
    others,
    place_in_words,
    region_scores,
    rivals,
)
from halbach_fe.inference.result import ALL_READINGS
from halbach_fe.report import diagnosis_figures as figures
from halbach_fe.report.diagnosis_figures import states
from halbach_fe.report.page import save, write_page
from halbach_fe.report.view import of_update

UNUSUAL = 20.0
"""Prior standard deviations: what nobody would expect of a magnet that was built with care."""

FIGURES = {
    "groups": (figures.groups, "Chi² per reading of groups of readings, each foretold by all "
               "others; filled where chance is no explanation"),
    "residuals": (figures.residuals, "Standardized difference of each training reading from what "
                  "all others foretell"),
    "probabilities": (figures.probabilities, "Posterior probability of each effect of the "
                      "catalogue if at most one is missing, and nothing else; log Bayes factors of "
                      "what was found and of what would do as well, dashed: what an effect needs"),
    "profile": (figures.profile, "The readings that fitted worst, with the updated model's "
                "predictions, and what is left; the band holds 95 % of it by prediction and noise"),
    "magnetizations": (figures.magnetizations, "Inferred change of the magnetizations from the "
                       "prior by ring and slot, along and across the easy axis and along the "
                       "magnet")}
UNKNOWN_ADVICE = {
    "field": "Look for a source outside the bore, nearest to where the unexplained field is "
             "largest; readings beyond the map's end there would show more of it.",
    "instrument": "The same map with the probe turned by 180° shows which sensor it is: its errors "
                  "turn with it.",
    "either": "The same map with the probe turned by 180° tells a field from the sensors: their "
              "errors turn with them."}
UNKNOWN_KINDS = {
    "field": "a smooth field, as of a source that no effect of the catalogue is",
    "instrument": "a smooth error of the sensors that no field could be",
    "either": "something smooth, a field or an error of the sensors"}


def verdict(diagnosis: Diagnosis) -> list[str]:
    """What was found, in sentences."""
    titles = _catalogue_titles(diagnosis)
    before, after, unknown = diagnosis.before, diagnosis.after, diagnosis.unknown
    said = [one.sentence for one in others(diagnosis)]
    if diagnosis.numerical:
        return said
    if diagnosis.named:
        fits = diagnosis.at_rest and after.prior_conflict <= after.conflict_limit
        start = "The map is explained by" if fits else "The catalogue comes nearest with"
        said.append(f"{start}: " + "; ".join(
            _named(one, titles) for one in diagnosis.named) + ".")
        said += [f"It does not tell {_title(one.hypothesis.effect.name, titles)} from "
                 f"{_either(_titles(one, titles))}." for one in diagnosis.named if rivals(one)]
        unusual = [f"{_title(one.hypothesis.effect.name, titles)} ({ratio:.0f} times)"
                   for one in diagnosis.named if (ratio := _over_usual(one)) > UNUSUAL]
        if unusual:
            said.append("Far larger than is usual (the prior's standard deviation): "
                        f"{', '.join(unusual)}. Unless another measurement confirms it, take that "
                        "for a sign of something else.")
        if not diagnosis.at_rest:
            said.append(f"After {diagnosis.rounds} rounds the search had not come to rest: what "
                        "is missing, or how much of it, still changed.")
        if len(diagnosis.named) == MOST:
            said.append(f"These are {MOST} effects, as many as are looked for: so many at once are "
                        "a fit rather than a diagnosis, and some stand for something else.")
    elif unknown is None and after.prior_conflict <= after.conflict_limit:
        start = "Nothing else is missing: then" if said else "Nothing is missing:"
        return [*said, f"{start} the map agrees with the study within noise (chi² per reading "
                f"{after.prior_conflict:.3g})."]
    if unknown is not None:
        x, y, z = (f"{1e3 * one:.0f}" for one in unknown.at_m)
        start = ("As well it could be one thing outside the catalogue in place of all of them"
                 if unknown.as_well else "Something outside the catalogue "
                 + ("remains" if diagnosis.named else "is missing"))
        said.append(
            f"{start}: {UNKNOWN_KINDS[unknown.kind]}, largest at ({x}, {y}, {z}) mm with "
            f"{1e3 * unknown.largest_T:.2g} mT (log Bayes factor "
            f"{unknown.log_bayes_factor:.0f}).")
        if unknown.source_m is not None:
            x, y, z = (f"{1e3 * one:.0f}" for one in unknown.source_m)
            said.append(f"If it is a small magnetized object, then near ({x}, {y}, {z}) mm.")
    elif not diagnosis.named:
        return [*said, f"The map disagrees with the study (chi² per reading "
                f"{after.prior_conflict:.3g}, where {after.conflict_limit:.3g} would be rare), and "
                "no effect of the catalogue explains it, nor anything smooth: look at the noise."]
    if diagnosis.named:
        held = ["".join(f", of held-out ones {one.chi2_per_reading:.3g}" for one in found[1:2])
                for found in (region_scores(before, diagnosis.left_out_before),
                              region_scores(after, diagnosis.left_out_after))]
        said.append(f"With {'it' if len(diagnosis.named) == 1 else 'them'} in the model, chi² per "
                    f"reading is {after.prior_conflict:.3g}{held[1]} (before: "
                    f"{before.prior_conflict:.3g}{held[0]}).")
        if after.prior_conflict > after.conflict_limit and unknown is None:
            said.append("That is still too much: they are not all that is wrong.")
    return said


def _over_usual(named: IdentifiedEffect) -> float:
    """The largest amplitude over its prior standard deviation; of what is there or not, none."""
    first = int(named.hypothesis.effect.certain or named.hypothesis.effect.discrete)
    return max((abs(value) / parameter.sd for value, parameter in zip(
        named.values[first:], named.parameters[first:], strict=True)), default=0.0)


def found_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Rows of what a study lacks, as text."""
    found = [{"effect": one.name, "place": one.place, "amplitude": one.amount,
              "log Bayes factor": one.factor, "it could be": one.instead}
             for one in others(diagnosis)]
    return found + [
        {"effect": one.found.candidate.effect, "place": place_in_words(one.hypothesis.place),
         "amplitude": "; ".join(amounts(one)),
         "log Bayes factor": f"{one.found.log_bayes_factor:.1f}",
         "it could be": ", ".join(candidate.effect for candidate, _ in rivals(one)) or NOTHING}
        for one in diagnosis.named]


def change_table(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Rows of scores before and after, as text."""
    found = [region_scores(one.update, one.left_out) for one in states(diagnosis)]
    rows = []
    for number, one in enumerate(found[0]):
        region = "" if one.region == ALL_READINGS else f", {one.region}"
        rows.append({"readings": f"{one.part}{region}", "count": str(one.readings)} | {
            name: " → ".join(text(getattr(state[number], key)) for state in found)
            for name, key, text in (("chi²/reading", "chi2_per_reading", _figure),
                                    ("median error", "median_relative_error", _percent),
                                    ("95 % band holds", "coverage95", _fraction))})
    return rows


def write_diagnosis_report(
    diagnosis: Diagnosis, separations: Sequence[Separation], folder: Path,
    assumptions: Sequence[str] = (),
) -> None:
    """Write diagnosis.html, self-contained, and its figures as PNG into ``folder``.

    ``assumptions`` are sentences that the reader must know before the result.
    """
    drawn = {name: (draw(diagnosis), text) for name, (draw, text) in FIGURES.items()}
    pictures = save({f"diagnosis_{name}.png": one for name, one in drawn.items()}, folder)
    titles = _catalogue_titles(diagnosis)
    write_page(
        folder / "diagnosis.html", "diagnosis.html.j2", pictures, diagnosis=diagnosis,
        study=diagnosis.before.study, verdict=verdict(diagnosis), assumptions=assumptions,
        shown=dict(zip(drawn, pictures, strict=True)), view=of_update(diagnosis.after),
        found=[{"what": one.title, "where": one.place, "how much": one.amount,
                "log Bayes factor": one.factor, "kind": one.kind} for one in others(diagnosis)]
        + [_entry(one, titles) for one in diagnosis.named],
        changes=change_table(diagnosis), disagreeing="; ".join(
            f"{one.when}: {_disagreeing(one.groups)}" for one in states(diagnosis)),
        states=[one.when for one in states(diagnosis)],
        classes=[f"The map would be the same with {_either(texts)}." for error in diagnosis.gross
                 if (texts := [one.text for one in error.alternatives])]
        + [_class(one, titles) for one in diagnosis.named if rivals(one)],
        structure=figures.structure(diagnosis),
        further=[_next(one, own, titles) for one in diagnosis.named
                 if (own := [two for two in separations if two.named == one.hypothesis])],
        ground={"found": FOUND, "alike": ALIKE, "odds": round(1 / EFFECT_ODDS), "enough": ENOUGH,
                "discoveries": DISCOVERIES},
        advice=UNKNOWN_ADVICE[diagnosis.unknown.kind] if diagnosis.unknown else
        "None of the measurements that are known here would tell them apart." if any(
            rivals(one) for one in diagnosis.named) else "",
        study_file=STUDY_FILE, summary_file=SUMMARY_FILE)


def _named(one: IdentifiedEffect, titles: dict[str, str]) -> str:
    """An effect in words, with its place and amplitude."""
    effect = one.hypothesis.effect
    parts = [_title(effect.name, titles), place_in_words(one.hypothesis.place),
             "" if effect.certain else "; ".join(amounts(one))]
    return ", ".join(part for part in parts if part)


def _catalogue_titles(diagnosis: Diagnosis) -> dict[str, str]:
    """Effects in words."""
    return {effect.name: effect.title for effect in (
        *catalogue(), *(one.hypothesis.effect for one in diagnosis.named))}


def _titles(named: IdentifiedEffect, titles: dict[str, str]) -> list[str]:
    """Rivals of an effect in words."""
    return [_title(candidate.effect, titles) for candidate, _ in rivals(named)]


def _title(name: str, titles: dict[str, str]) -> str:
    """An effect in words, with its name if others have the same words."""
    title = titles.get(name, name)
    return f"{title} ({name})" if list(titles.values()).count(title) > 1 else title


def _disagreeing(found: Sequence[ResidualGroup]) -> str:
    """How many groups of readings disagree, and which most."""
    wrong = [one for one in found if one.disagrees]
    if not wrong:
        return f"none of {len(found)}"
    worst = max(wrong, key=lambda one: one.chi2_per_reading)
    return (f"{len(wrong)} of {len(found)}, most of all {worst.name} "
            f"({worst.chi2_per_reading:.2g})")


def _class(one: IdentifiedEffect, titles: dict[str, str]) -> str:
    """What cannot be told apart, in words."""
    found = [f"{title}{' ' + candidate.place if candidate.place else ''}, {factor:.1f}"
             for title, (candidate, factor) in zip(_titles(one, titles), rivals(one), strict=True)]
    return (f"What is called {_title(one.hypothesis.effect.name, titles)} here (log Bayes factor "
            f"{one.found.log_bayes_factor:.1f}) could as well be: {'; '.join(found)}.")


def _entry(one: IdentifiedEffect, titles: dict[str, str]) -> dict[str, str]:
    """Row of the page's table of effects."""
    effect = one.hypothesis.effect
    return {"what": _title(effect.name, titles),
            "where": place_in_words(one.hypothesis.place) or NOTHING,
            "how much": "; ".join(text.replace(" ", "\u00a0") for text in amounts(one)),
            "log Bayes factor": f"{one.found.log_bayes_factor:.1f}", "kind": effect.kind}


def _either(parts: Sequence[str]) -> str:
    return " or ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _next(
    named: IdentifiedEffect, own: Sequence[Separation], titles: dict[str, str],
) -> dict[str, object]:
    """What would separate an effect from its rivals, in words and numbers."""
    choices = {choice.name: choice.title for one in own for choice in one.options}
    return {
        "what": _title(named.hypothesis.effect.name, titles),
        "advice": [(_title(one.rival.effect.name, titles),
                    one.recommended.title if one.recommended else "") for one in own],
        "rows": [{"measurement": title} | {
            f"against {one.rival.effect.name}": _gain(one.gains[name]) for one in own}
            for name, title in choices.items()]}


def _gain(value: float) -> str:
    return f"{max(value, 0.0):.1f}" if value < 1000 else "over 1000"


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.2g}\u00a0%"


def _fraction(value: float) -> str:
    return f"{100 * value:.1f}\u00a0%"


def _figure(value: float) -> str:
    return f"{value:.3g}"
