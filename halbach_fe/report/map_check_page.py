"""Page of `check`: sentences and figures of Maxwell's check of a map, or of joined maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.numbers import first_of
from halbach_fe.measurement.field_map import has_times, points_of, readings_sha256, write_map
from halbach_fe.measurement.map_check import (
    ENOUGH,
    SCATTERED_M,
    VIOLATED,
    InstrumentTerm,
    MapCheck,
    Reach,
    inner,
    order_of,
    oriented,
)
from halbach_fe.measurement.map_join import JoinedMaps
from halbach_fe.measurement.positions import is_sorted
from halbach_fe.measurement.suspect_rows import TotalCheck
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    SECOND,
    Items,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    chart,
    columns_by_axis,
    csv_file,
    figure_of,
    legend_above,
)
from halbach_fe.report.point_maps import draw, panels
from halbach_fe.report.words import (
    by_axis,
    capital,
    decimals,
    flux_density,
    in_a_row,
    point_mm,
    relative,
    with_error,
    with_unit,
)
from halbach_fe.study.types import COMPONENTS

TITLE = "Check of a field map"


def answer(check: MapCheck, in_order: bool = True) -> Answer:
    """Say whether the map obeys Maxwell's equations, and what to do next.

    Not ``in_order``, rows may not be in the order in which they were read.
    """
    question = "Does the map obey Maxwell's equations?"
    if check.is_too_coarse:
        return Answer(
            question, verdict(check), "No: whether the map obeys cannot be told. An update of the "
            "magnet may use it nevertheless, as a magnet's model knows how fast its field varies.",
            "Measure with a smaller spacing, or farther from the blocks, and check that map.",
            "halbach-fe check MAP -o DIR", sound=False)
    if not check.suffices:
        return Answer(
            question, verdict(check), "No: nothing on this page tests the map: too many numbers "
            "were fitted to too few readings.", "Measure in a volume, with a smaller spacing, and "
            "check that map.", "halbach-fe check MAP -o DIR", sound=False)
    better = check.is_reoriented or bool(sum(map(len, check.broken.values())))
    if not check.obeys or _impossible(check):
        _, (low, high, most) = check.uneven or (None, (0.0, 0.0, 0.0))
        worst = "" if check.uneven is None else (
            f"The most is left at {check.windows[0]} from {_range(low, high)}: "
            f"{flux_density(most, 2)}. ")
        return Answer(
            question, f"{verdict(check)} {_noise(check)}",
            f"No: nothing that the probe may plausibly be explains this map. {worst}Only if it "
            f"ends within some spacings of its points ({1e3 * check.spacing_m:.3g} mm) from blocks "
            "may it be right nevertheless: their field there is none that this fit follows. Else "
            "do not update a magnet with it.", "Look for rows, axes and units "
            "that are not what the map says, or leave out what is near to magnets and conductors, "
            "and check it again.", "halbach-fe check MAP -o DIR",
            sound=False)
    trust = _trust(check)
    used, named = ("DIR/oriented_map.csv",
                   "oriented_map.csv, which has the right axes and no broken rows") if better else (
        "MAP", "this map")
    changed = [term for term in check.terms if term.found and _is_change(term) and in_order]
    scaled = [term for term in check.terms if term.found and _is_scale(term)]
    if changed or scaled:
        what = in_a_row([*(["what changed during the scan"] if changed else []),
                         *(["the scale of the stage"] if scaled else [])])
        used, named = "DIR/corrected_map.csv", f"corrected_map.csv, without {what}: an update " + (
            "fits that only if drift_T in [instrument_sd] of the study allows it"
            if not scaled and all("offset" in term.name for term in changed) else
            "does not fit that by itself")
    said = f"{verdict(check)} {_noise(check, keys=True)}"
    if check.is_displaced:
        return Answer(question, said, trust, "Look for rows, axes and units of the positions that "
                      "are not what the map says, and check it again.",
                      "halbach-fe check MAP -o DIR", sound=False)
    if check.floor_rms_T > VIOLATED * check.size_T:
        return Answer(
            question, f"{verdict(check)} {_noise(check)}", trust,
            "Cut the map back: inner_map.csv has the readings "
            f"{_where(check, check.reach)} only. Check it alone."
            if check.reach is not None else "", "halbach-fe check DIR/inner_map.csv -o DIR2")
    if _on_a_stage(check):
        return Answer(
            question, said, trust, "Find where the map lies in the magnet, as its coordinates seem "
            f"to be those of a stage: the origin is far from all readings. Use {named}.",
            f"halbach-fe register STUDY --measurements {used} -o DIR")
    return Answer(
        question, said, trust, f"Update the magnet with {named}. If you do not know where the map "
        "lies in the magnet, let halbach-fe register find it first.",
        f"halbach-fe infer STUDY --measurements {used} -o DIR")


def _trust(check: MapCheck) -> str:
    """Say how far the answer that a map passes can be trusted."""
    trust = ("Yes: no magnet is assumed, and the lines that were held out were not fitted. More "
             f"than {100 * VIOLATED:g}\u00a0% of the largest field would fail. A model of the "
             "magnet that predicts readings worse than this fit lacks something; close to the "
             "edges of blocks, where the field varies more than the fit can follow, it can do "
             "better.")
    # correlation of neighbouring residuals from which they are no noise
    remains = 0.3
    if check.structure > remains:
        trust = ("Only nearly: what remains is no noise, as neighbouring residuals have a "
                 f"correlation of {check.structure:.2f}. Something that this check does not know, "
                 "such as a probe that moves in its holder, is still in the map.")
    elif check.is_displaced:
        trust = "No, not as it stands: the field obeys, but readings are not where the map says."
    elif check.uneven is not None:
        trust = ("Yes, that it passes: no magnet is assumed, and the lines that were held out were "
                 "not fitted. No, as a measure of the noise: what is left is not noise alone.")
    if (reach := check.reach) is not None:
        trust = (f"Only {_where(check, reach)}. " if np.isfinite(reach.limit_m) else
                 "Only roughly. ") + (
            f"{'Beyond that,' if np.isfinite(reach.limit_m) else 'Everywhere,'} held-out lines are "
            f"off by {decimals(reach.times, 2)} times what noise and scattered positions make: "
            "either the field is steeper there than the lines show, as near edges of magnets, or "
            "these readings are wrong. An update of the magnet tells which."
            + (" inner_map.csv beside this page is the map without them."
               if np.isfinite(reach.limit_m) else ""))
    return trust


def total_answer(check: TotalCheck) -> Answer:
    """Say what a map of |B| shows by itself, and what it does not."""
    if np.isfinite(check.repeatability_T):
        noise = (f"{check.repeats} places that were read again say that the noise of a reading is "
                 f"{flux_density(check.repeatability_T, 2)}.")
    elif np.isfinite(check.noise_T):
        noise = (f"The noise of a reading is at most {flux_density(check.noise_T, 2)}, which "
                 "quadratic functions through neighbours leave.")
    else:
        noise = "Too few readings, or a line of them, do not tell the noise."
    rows = sum(map(len, check.broken.values()))
    found = f"{rows} of {check.points} rows are" if rows else f"None of {check.points} rows is"
    return Answer(
        "Are the readings of |B| sound?", f"{found} zero, repeated or a spike. {noise}",
        "Only as far as that goes: Maxwell's equations are those of the components, so that they "
        "do not test |B| here. Nor does |B| show the sign of the field, axes, gain or offset of "
        "the probe; a model of the magnet does, but for the sign.",
        "Register the map, if you do not know where it lies, or update the magnet with it.",
        "halbach-fe register STUDY --measurements MAP -o DIR")


def total_sentences(check: TotalCheck) -> list[str]:
    """Return which rows of a map of |B| are broken."""
    words = BROKEN | {"zero": "|B| is zero"}
    return [f"Broken because {words[kind]}: row{'s' if len(rows) > 1 else ''} {_numbers(rows)}. "
            "Exclude them by inference.excluded_readings."
            for kind, rows in check.broken.items()]


def total_page(data: xr.Dataset, check: TotalCheck) -> Page:
    """Return the page of the check of a map of |B|."""
    maps, files = {"map": data}, {}
    if check.excluded.any():
        maps["oriented_map"] = data.isel(point=np.flatnonzero(~check.excluded))
        files = {"oriented_map.csv": partial(write_map, maps["oriented_map"])}
    found = total_sentences(check)
    return Page("check", TITLE, None, total_answer(check), check.plain() | _hashes(maps),
                [Section([Items(found)])], remarks=found, files=files)


def _on_a_stage(check: MapCheck) -> bool:
    """Tell whether the origin is farther from the map than the map is long: no user puts the
    origin of a magnet's coordinates there.
    """
    low = min((each[0] for each in check.windows[1]), default=0.0)
    high = max((each[1] for each in check.windows[1]), default=0.0)
    return max(low, -high) > high - low


def _noise(check: MapCheck, keys: bool = False) -> str:
    """Say what the noise is, with ``keys`` also where the study states it; or why it is unknown."""
    if check.uneven is not None:
        (low, high, least), (start, end, most) = check.uneven
        axis = check.windows[0]
        return (f"The fit leaves {flux_density(most, 2)} rms at {axis} from {_range(start, end)}, "
                f"and only {flux_density(least, 2)} at {axis} from {_range(low, high)}. Noise "
                "would be about the same everywhere: in the first range more than noise is left, "
                "as where the field varies more between neighbouring readings than the fit "
                "follows. This map therefore does not tell its noise. For sigma_T, read the probe "
                "repeatedly at one place.")
    noise = ("The noise of a reading is "
             f"{'at most ' if check.noise_is_limit else ''}"
             f"{flux_density(check.noise_T, 2)}")
    where = "put that into the study as sigma_T, unless you know better"
    if check.is_displaced:
        return (f"{noise}, and where the field is steep, readings are off as if their positions "
                f"were {_length(check.position_noise_m)} off, at a spacing of "
                f"{_length(check.spacing_m)}. That is no noise of positions: rows of the map are "
                "at other places than it says (columns or lines exchanged, a stage that lost "
                "steps, the unit of one axis), or the field has sources within the map. Do not put "
                "it into the study.")
    if check.position_noise_at_most and check.position_noise_m >= SCATTERED_M:
        limit = _length(check.position_noise_m)
        known = (" Put the noise into the study as sigma_T, and as position_sd_m what you know of "
                 f"the stage, at most {limit}." if keys else "")
        return (f"{noise}. Where the field is steep, more is left than noise and positions make, "
                "as the fit does not follow the field there: positions are at most "
                f"{limit} off.{known}")
    if check.position_noise_m >= SCATTERED_M:
        noise += (", and where the field is steep, readings scatter like positions that are "
                  f"{_length(check.position_noise_m, check.position_noise_sd_m)} off")
        where = "put these into the study as sigma_T and position_sd_m, unless you know better"
    return f"{noise}: {where}." if keys else f"{noise}."


def _length(size: float, sd: float = 0.0) -> str:
    """Return a length in m, and its standard deviation, in µm, or in mm from 1 mm on."""
    unit, factor = ("mm", 1e3) if size >= 1e-3 else ("µm", 1e6)
    return with_unit(size, sd, unit) if sd else f"{decimals(factor * size, 2)}\u00a0{unit}"


def _range(low: float, high: float) -> str:
    """Return the limits of a part of the map in mm."""
    return f"{1e3 * low:.0f} to {1e3 * high:.0f}\u00a0mm"


def sentences(check: MapCheck) -> list[str]:
    """Return what else the check found."""
    # Number of the instrument's parameters that are named beside the table, the most certain ones.
    terms_named = 5
    found = []
    if not check.is_whole:
        found.append(f"{NOT_WHOLE[len(check.measured) > len('Bx')].format(check.measured)}")
    if check.order == "none":
        found.append(NO_ORDER)
    if check.is_reoriented:
        found.append(f"The map obeys with other axes than it names: {_axes(check)} (or all of them "
                     "with the opposite sign, which no map can show).")
        found.append(OPEN_SIGN)
    if check.alike:
        found.append(f"{len(check.alike)} other orientations fit as well: " + "; ".join(
            ", ".join(_component(name) for name in names) for names in check.alike[:5])
            + (" ..." if len(check.alike) > 5 else "") + ".")
    for kind, rows in check.broken.items():
        found.append(f"Left out because {BROKEN[kind]}: row{'s' if len(rows) > 1 else ''} "
                     f"{_numbers(rows)}.")
    if check.contradicted:
        found.append(
            f"The map's column of |B| contradicts its components in {len(check.contradicted)} "
            f"row{'s' if len(check.contradicted) > 1 else ''}, which one of the two has wrong: "
            f"{_numbers(check.contradicted)}. They are left out.")
    terms = sorted((term for term in check.terms if term.found),
                   key=lambda term: -abs(term.value) / term.sd)
    if terms:
        said = [f"{term.name} {with_error(term.value, term.sd)}\u00a0{term.unit}"
                for term in terms[:terms_named]]
        others = len(terms) - terms_named
        found.append(f"The instrument is not what the map assumes: {'; '.join(said)}"
                     + (f"; and {others} more of the parameters in the table" if others > 0
                        else "")
                     + ".")
    if any(_is_scale(term) for term in terms):
        found.append(STRETCHED)
    found += [f"One of these is off, and the map does not tell which: {'; '.join(names)}."
              for names in dict.fromkeys(tuple(sorted((term.name, *term.rivals)))
                                         for term in check.terms if term.rivals)]
    return found


STRETCHED = (
    "A scale of −1\u00a0% says that the stage went 1\u00a0% less far along this axis than the map "
    "states. A common scale of all axes no map can show: those that are not named are taken as "
    "they are. corrected_map.csv has the field at the places that it states.")
"""What a scale of the stage is."""

NOT_WHOLE = (
    "{} by itself obeys where it is harmonic, as each component of a field without sources is. "
    "Gains, axes, turns and places of sensors need three components; a plane of one component "
    "obeys if it is smooth.",
    "{} were compared with one field without sources, of which the third component is free. "
    "Gains, axes, turns and places of sensors need three components.")
"""What a map of one component tells, and one of two."""

NO_ORDER = (
    "The map has no times, and its rows are in no order in which a stage goes: whether the "
    "readings lag, or the probe turns or drifts during the scan, cannot be judged. A column time_s "
    "tells.")
"""What rows in no order of a scan tell."""

OPEN_SIGN = (
    "The common sign of all components is open. On it depends how the map lies in the magnet, and "
    "with that which block is which: register finds poses for either sign, and each gives the same "
    "reading to other blocks. A pole that is known, by a compass, tells. Nothing else on this page "
    "depends on it.")
"""What depends on the common sign of all components."""


def _numbers(rows: Sequence[int]) -> str:
    """Return the numbers of some rows, the first ones of many."""
    rows_named = 10  # number of broken rows that are listed by number
    return first_of([*map(str, rows)], rows_named)


BROKEN = {"zero": "all components are zero",
          "repeated": "the readings are those of the row before, at another place",
          "copied": "another row at the same place again, digit for digit",
          "spike": "far off the field of all others"}


def _coarse(check: MapCheck, size: str) -> str:
    """Say why a map is too coarse to tell; ``size`` is what is left of held-out lines, in words."""
    if check.left_T <= VIOLATED * check.size_T:
        return (f"a field without sources describes all readings to {flux_density(check.left_T, 2)}"
                f", but without a scan line does not predict it ({size}): the lines are too far "
                "apart, or too few.")
    return (f"with a spacing of {decimals(1e3 * check.spacing_m)} mm the field changes more from "
            "point to point than its neighbours show: what a field without sources leaves of it "
            "changes sign from each reading to the next.")


def verdict(check: MapCheck) -> str:
    """Return the answer in a sentence, which begins with whether the map passes."""
    if check.redundancy < ENOUGH:
        return ("Neither passed nor failed. The map cannot tell: "
                f"{100 * (1 - check.redundancy):.0f}\u00a0% of its readings are needed to describe "
                "any field in its region. Measure in a volume, with a smaller spacing.")
    share = check.floor_rms_T / check.size_T
    size = (f"{flux_density(check.floor_rms_T, 2)} rms on scan lines that were held out, "
            f"{relative(share)} of the largest field ({flux_density(check.size_T)})")
    if check.is_too_coarse:
        return f"Neither passed nor failed. The map cannot tell: {_coarse(check, size)}"
    if not check.obeys:
        law = "not obey div B = 0 and curl B = 0" if check.is_whole else (
            f"not have {check.measured} of any field without sources")
        return (f"Failed. The map does {law}: it is not described by a "
                f"field without sources within its region, which leaves {size}. No instrument "
                "explains it.")
    wrong = _impossible(check)
    if wrong:
        return ("Failed. The map does not obey div B = 0 and curl B = 0 with any likely "
                f"instrument: it would take an impossible one ({wrong[0]}"
                f"{f' and {len(wrong) - 1} more' if len(wrong) > 1 else ''}), which leaves {size}.")
    law = "obeys div B = 0 and curl B = 0" if check.is_whole else (
        f"has {check.measured} of a field without sources,")
    if check.reach is not None and np.isfinite(check.reach.limit_m):
        return (f"Passed. The map {law} to "
                f"{flux_density(check.reach.inside_T, 2)} rms on scan lines that were held out "
                f"{_where(check, check.reach)}, and to "
                f"{flux_density(check.reach.beyond_T, 2)} beyond that. The largest field is "
                f"{flux_density(check.size_T)}.")
    axes = (f", once its columns are put along the axes that they show ({_axes(check)})"
            if check.is_reoriented else "")
    return f"Passed{axes}. The map then {law} to {size}." if axes else (
        f"Passed. The map {law} to {size}.")


def _where(check: MapCheck, reach: Reach) -> str:
    """Describe the region in which held-out lines are predicted."""
    limit = f"{decimals(1e3 * reach.limit_m)}\u00a0mm"
    if reach.along == "r":
        return (f"within {limit} of the line through the middle of the map along "
                f"{check.windows[0]}")
    return f"at {reach.along} of {limit} and {'less' if reach.below else 'more'}"


def _impossible(check: MapCheck) -> list[str]:
    """Return the names of the parameters of a probe that no probe has."""
    return [term.name for term in check.terms
            if term.determined and term.predictive and not term.plausible]


def _is_scale(term: InstrumentTerm) -> bool:
    """Tell whether a parameter is a scale of the stage."""
    return term.name.startswith("scale of the stage")


def _is_change(term: InstrumentTerm) -> bool:
    """Tell whether a parameter is a change of the probe during the scan."""
    return "from start" in term.name or "from the ends" in term.name


def _axes(check: MapCheck) -> str:
    """Say which component each column is that has another name."""
    return ", ".join(f"column B{column} is {_component(name)}"
                     for column, name in zip(COMPONENTS, check.orientation, strict=True)
                     if name != column)


def _component(name: str) -> str:
    """Return the name of a component with its sign, -Bz of ``-z``."""
    return f"{name[:-1].replace('-', '−')}B{name[-1]}"


def instrument_table(check: MapCheck) -> Rows:
    """Return rows of text: the parameters of the instrument that the map determines."""
    return [row | {"": "found" if term.found else ""} for term, row in zip(
        check.terms, term_table(check), strict=True) if term.determined and term.predictive]


def undetermined(check: MapCheck) -> str:
    """Say which parameters of the instrument the map does not tell, in a sentence; or nothing."""
    said = []
    terms = [term for term in check.terms
             if check.is_whole or _is_change(term) or "lag" in term.name]
    for words, predictive in (("Not stated, because parts of the map contradict each other about "
                               "it", False), ("What this map cannot tell", True)):
        names = [term.name for term in terms if term.predictive == predictive
                 and not (term.determined and predictive)]
        if names:
            said.append(f"{words}: {'; '.join(names)}.")
    return " ".join(said)


def residual_table(check: MapCheck) -> Rows:
    """Return rows of text: rms residuals of the columns in µT, and by region."""
    def row(name: str, values: Floats | tuple[float, float, float]) -> dict[str, str]:
        return {"rms residual in µT": name} | {
            f"B{column}": decimals(1e6 * value) for column, value in zip(
                COMPONENTS, values, strict=True) if np.isfinite(value)}

    axis, windows = check.windows
    return [row("the map as it is given", check.rms_as_given_T),
            row("with its axes and its instrument", check.rms_T),
            row("scan lines that were held out", check.floor_T),
            *(row(f"{axis} from {1e3 * low:.0f} to {1e3 * high:.0f} mm", values)
              for low, high, values in windows)]


def weighted_note(check: MapCheck) -> str:
    """Explain residuals that are larger with the instrument; empty if none are."""
    if not (check.rms_T > check.rms_as_given_T).any():
        return ""
    return ("With the instrument, readings count less where the field is steep, as positions that "
            "scatter a little change them much there: so plain residuals can be larger than those "
            "of the map as it is given, where every reading counts alike.")


OF_SORTED_ROWS = (
    "The map states no times that differ, and its rows are sorted by their coordinates. If that is "
    "not the order in which they were read, it does not tell whether the probe lags behind the "
    "stage, nor what changed during the scan: keep the rows as they were read, or a column time_s.")
"""What is said of a map whose rows may have lost their order."""


def doubt_of_times(data: xr.Dataset) -> str:
    """Return a sentence if the clock of a map jumped, or its times are rather not of these rows."""
    if not has_times(data):
        return ""
    times = np.asarray(data["time_s"].values, float)
    if order_of(data.isel(point=np.argsort(times, kind="stable"))) == "none":
        return ("In the order of time_s the probe went to and fro at random: if that is not so, "
                "these times are not of these rows, and say nothing of a drift or a lag, which "
                "then count as noise. Correct them, or leave time_s out.")
    steps = np.diff(times)
    if not 0 < np.sum(steps < 0) <= CLOCK_SETS * len(times):
        return ""
    row = int(np.argmax(steps < 0))
    return (f"After row {row + 1} time_s falls by {-steps[row]:.6g} s: what changes during the "
            "scan is judged in the order of time_s, not of the rows. If the clock was set back "
            "there, or passed midnight, correct the times.")


CLOCK_SETS = 0.01
"""Part of the rows after which a clock may be set back; rows that are sorted by their places have
more falling times."""


def are_in_order(data: xr.Dataset) -> bool:
    """Tell whether the rows of a map may be judged in the order in which they were read."""
    return has_times(data) or not is_sorted(points_of(data))


def page(found: MapCheck | JoinedMaps) -> Page:
    """Return the page of the check of a map, or of joined maps."""
    return joined_page(found) if isinstance(found, JoinedMaps) else check_page(found)


def check_page(check: MapCheck) -> Page:
    """Return the page of the check of a map, and the maps that are made of it."""
    data = check.data
    points, found, rows = points_of(data), sentences(check), residual_table(check)
    instrument, said = instrument_table(check), undetermined(check)
    maps = _maps_of(check)
    if (within := inner(check)) is not None:
        maps["inner_map"] = within
    left_out = ". Crosses are rows that were left out" if check.excluded.any() else ""
    even = ("Noise alone would be about as large everywhere; here it is not alone"
            if check.uneven is not None else "Noise is about as large everywhere")
    if not (in_order := are_in_order(data)):
        found.append(OF_SORTED_ROWS)
    if doubt := doubt_of_times(data):
        found.append(doubt)
    return Page(
        "check", TITLE, None, answer(check, in_order), check_summary(check), [
            Section([Items(found), Text(
                f"{check.readings} readings at {check.points} points, "
                f"{decimals(1e3 * check.spacing_m)} mm apart. No magnet is assumed: the map is "
                "compared with the field of sources outside the mapped region. A map by itself "
                "cannot show a common factor or sign of all components, a uniform offset, a shift "
                "of the whole map, or a position axis that counts backwards.", "small")]),
            Section([Table(rows, "numbers"), Text(weighted_note(check), "small")],
                    "What remains"),
            Section(["Distances of the sensors are along the axes of the stage, and turns of the "
                     "probe are against them; all belong to the components as they were found "
                     "above.", Table(instrument)] if instrument else
                    ["This map determines no error of the probe."], "The instrument"),
            Section([Text(said, "small")], "What was not asked or left out", True, said)],
        {"The instrument, by the map alone": instrument}, rows, {
            "check_maps.png": (
                partial(_maps, points, np.asarray(data["B_T"].values), check), "The map: every "
                "column as it was measured, and its residual from the field that obeys Maxwell's "
                f"equations{left_out}"),
            "check_readings.png": (
                partial(_readings, check), f"Residuals in the order of the map. {even}. A probe "
                "that moves makes steps and waves")},
        files={"check.csv": csv_file(
            columns_by_axis("{}_m", points) | columns_by_axis("residual_B{}_T", check.residual_T)
            | {"left_out": check.excluded.astype(int)}, {})} | {
                f"{name}.csv": partial(write_map, one) for name, one in maps.items()
                if name != "oriented_map" or check.is_reoriented or check.excluded.any()},
        remarks=found)


def _maps_of(check: MapCheck) -> dict[str, xr.Dataset]:
    """Return the maps in the right axes, by the names of their files."""
    return {"oriented_map": oriented(check)} | (
        {"corrected_map": corrected(check)} if check.suffices else {})


def check_summary(check: MapCheck) -> Plain:
    """Return the results as plain data, with `readings_sha256` of the maps to which they belong."""
    return check.plain() | _hashes({"map": check.data} | _maps_of(check))


def _hashes(maps: Mapping[str, xr.Dataset]) -> Plain:
    return {"maps_sha256": {name: readings_sha256(one) for name, one in maps.items()}}


def corrected(check: MapCheck) -> xr.Dataset:
    """Return the map that a probe without errors would have made, without broken rows."""
    turned = oriented(check)
    turned["B_T"] = turned["B_T"].copy(data=check.corrected_T[~check.excluded])
    return turned


def _maps(points: Floats, field: Floats, check: MapCheck) -> Figure:
    """Draw every column as it was measured, and its residual, over the points of the map."""
    zero = 1e-6  # part of the largest reading below which a column holds nothing, and is not drawn
    panel = panels(points)[0]
    out = np.flatnonzero(check.excluded[panel.points])
    largest = float(np.nanmax(np.abs(field)))
    shown = [number for number in range(3)
             if np.nanmax(np.abs(field[:, number]), initial=0.0) > zero * largest]
    figure = figure_of(0.6 + 2.4 * len(shown))
    # axes that are drawn to scale move their labels outwards
    figure.set_layout_engine("constrained", rect=(0.03, 0.0, 0.95, 1.0))
    for column, row in zip(shown, figure.subplots(len(shown), 2, sharex=True, sharey=True,
                                                  squeeze=False), strict=True):
        residual = 1e6 * np.where(check.excluded, np.nan, check.residual_T[:, column])[panel.points]
        limit = float(np.nanquantile(np.abs(residual), 0.98)) if np.isfinite(
            residual).any() else 1.0
        name = f"B{COMPONENTS[column]}"
        for axis, values, colours, words in (
                (row[0], 1e3 * field[panel.points, column], {"cmap": "cividis"}, f"{name} in mT"),
                (row[1], residual, {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit},
                 f"residual of\n{name} in µT")):
            drawn = draw(axis, panel, values, **colours)
            axis.plot(panel.first[out], panel.second[out], "x", color=MEASURED, ms=4)
            figure.colorbar(drawn, ax=axis, label=words)
            if column != shown[-1]:
                axis.set_xlabel("")
        row[1].set_ylabel("")
    figure.suptitle(panel.title)
    return figure


def _readings(check: MapCheck) -> Figure:
    """Draw the residuals of every column in the order of the map."""
    figure, axis = chart(4)
    number = np.arange(1, len(check.residual_T) + 1)
    for values, name, colour in zip(check.residual_T.T, COMPONENTS,
                                    (POSTERIOR, SECOND, MEASURED), strict=True):
        axis.plot(number[~check.excluded], 1e6 * values[~check.excluded], ".", ms=2.5,
                  color=colour, label=f"B{name}")
    axis.set(xlabel="row of the map", ylabel="residual in µT")
    legend_above(figure, axis, columns=3, markerscale=4)
    return figure


def joined_answer(joined: JoinedMaps) -> Answer:
    """Say where the maps lie to each other, and whether they agree."""
    first, *others = joined.checks
    said = "; ".join(
        f"the middle of {pose.name} is {point_mm(pose.shift_m, pose.shift_sd_m)}\u00a0mm from "
        f"where it would be if its stage were that of {first}" for pose in joined.poses)
    said = (f"{capital(said)}." if joined.agree else
            f"If they are of one field, {said}.")
    worst = max(joined.overlaps, key=lambda one: one.chi2)
    turned, undetermined = [pose.name for pose in joined.poses if pose.is_turned], _open(joined)
    trust, step = (
        (f"No: where {worst.name} overlaps other maps, the readings contradict each other, with "
         f"chi² {worst.chi2:.3g} per reading. The bars are widened by its root.",
         "Look for what changed between the maps: temperature, gain, positions of the stage, or "
         "the magnet.")
        if not joined.agree else
        (f"Only if the stage of {in_a_row(turned)} stood turned by right angles: with the axes "
         "that it states, no place fits. A smooth field is much like itself elsewhere.",
         "Look how the stage stood, or measure with a larger overlap.") if turned else
        (f"Only in part: the overlap does not determine {in_a_row(undetermined)}.",
         "Measure with a larger overlap, where the field changes along these axes.")
        if undetermined else
        (f"Yes: where {in_a_row([first, *others])} overlap, chi² is at most "
         f"{worst.chi2:.2f} per reading; no magnet is assumed.",
         f"Find where the joined map, in the frame of {first}, lies in the magnet."))
    sound = joined.agree and not (turned or undetermined)
    return Answer(
        "Where do the maps lie to each other, and are they of one field?", said, trust, step,
        "halbach-fe register STUDY --measurements DIR/joined.csv -o DIR" if sound else "", sound)


def _open(joined: JoinedMaps) -> list[str]:
    """Return the parts of poses that no overlap determines."""
    names = [f"{what} {axis}" for what in ("shift along", "turn about") for axis in COMPONENTS]
    return [f"the {name} of {pose.name}" for pose in joined.poses
            for name, known in zip(names, pose.determined, strict=True) if not known]


def joined_sentences(joined: JoinedMaps) -> list[str]:
    """Return what else was found."""
    found = [f"The readings of {pose.name} have the opposite sign of those of "
             f"{next(iter(joined.checks))}: the joined map has them reversed."
             for pose in joined.poses if pose.sign < 0]
    found += [f"{pose.name} fits only with its stage turned by right angles (rotation_rad). If it "
              "did not stand so, it does not overlap the other maps."
              for pose in joined.poses if pose.is_turned]
    found += [f"{one.name} contradicts the other maps where they overlap: chi² is {one.chi2:.3g} "
              f"per reading, rms {flux_density(one.rms_T)} by one field for all, "
              f"{flux_density(one.alone_T)} by a field of its own."
              for one in joined.overlaps if not one.agrees]
    found += [f"Where {one.name} says {one.axis} = {decimals(round(1e3 * one.place_m, 2))}\u00a0"
              f"mm, the stage was some {decimals(1e3 * one.off_m, 2)}\u00a0mm from there along "
              f"{one.axis}, by all other readings. {one.points} rows of that place were left out "
              "of the join. Leave all that the map has there out for register and infer, too, by "
              "their numbers: excluded_readings of [inference], or of [maps.inference] if the "
              "study lists maps. A stage that comes from the other side does that (backlash)."
              for one in joined.displaced]
    return found


def pose_table(joined: JoinedMaps) -> Rows:
    """Return the poses as rows of text."""
    return [{"map": pose.name, **by_axis("{} in mm", pose.shift_m, pose.shift_sd_m),
             **by_axis("about {} in mrad", pose.rotation_rad, pose.rotation_sd_rad)}
            for pose in joined.poses]


def overlap_table(joined: JoinedMaps) -> Rows:
    """Return the overlaps as rows of text."""
    return [{"map": one.name, "readings": str(one.readings), "chi² per reading": f"{one.chi2:.2f}",
             "alone, rms": flux_density(one.alone_T), "jointly, rms": flux_density(one.rms_T)}
            for one in joined.overlaps]


def term_table(found: MapCheck | JoinedMaps) -> Rows:
    """Return the terms of the instrument as rows of text."""
    return [{"parameter": term.name,
             "value": f"{with_error(term.value, term.sd)}\u00a0{term.unit}"}
            for term in found.terms]


def joined_page(joined: JoinedMaps) -> Page:
    """Return the page of joined maps, with that of the check of each map."""
    found, poses, terms = joined_sentences(joined), pose_table(joined), term_table(joined)
    maps = {name: check.data for name, check in joined.checks.items()}
    summary = joined.plain() | _hashes(maps) | {"joined_sha256": readings_sha256(joined.data)}
    return Page(
        "check", "Field maps, joined", None, joined_answer(joined), summary, [
            Section([Items(found), Text(
                "No magnet is assumed. One field of sources outside all maps was fitted to them "
                "together with their relative poses; each map was checked by itself before.",
                "small")]),
            Section(["Shift of the middle of each map, and turn about it, in the frame of the "
                     "first map. joined.json has the covariance of all of them, and translation_m "
                     "and rotation_rad as a study's [instrument] has them.", Table(poses)],
                    "Where the maps lie"),
            Section(["chi² per reading compares the readings that other maps have around them with "
                     "what those maps predict, noise included; 1 is expected. The last columns are "
                     "what the fit leaves of these readings, with a field of the map alone and "
                     "with one field for all maps:", Table(overlap_table(joined))],
                    "Where they overlap"),
            Section([Table(terms) if terms else
                     "The maps show no error of the probe, neither a common one nor one that only "
                     "a part of them has: one gain explains all."], "The instrument")],
        {"Where the maps lie in the frame of the first one": poses,
         "The instrument, by all maps together": terms},
        files={"joined.csv": partial(write_map, joined.data)}, stem="joined", remarks=found,
        folders={name: check_page(check) for name, check in joined.checks.items()})
