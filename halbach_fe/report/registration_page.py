"""Page of `register`: sentences, table, figure and study file of a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import block_images
from halbach_fe.inference.pose_result import Registration
from halbach_fe.inference.registration import (
    EQUAL_LOG_EVIDENCE,
    UNDECIDED_LOG_EVIDENCE,
    axes_of_map,
    moved_by_turns,
    nearest_right_angles,
    odds,
    turn_from_axes,
)
from halbach_fe.measurement.campaign_maps import Map
from halbach_fe.measurement.doubted_terms import (
    UNITS,
    UNLIKE,
    doubts_in_words,
    factor_in_words,
    known_factor,
    trade_offs_in_words,
)
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    UNDIRECTED_COLUMN,
    directed,
    is_undirected,
    points_of,
    write_map,
)
from halbach_fe.measurement.probe_law import (
    CROSSTALK,
    PROBE,
    STEADY,
    in_si_and_magnet_axes,
    probe_points,
    row_order_note,
    turn_of,
)
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    SECOND,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    legend_above,
    magnet_panels,
)
from halbach_fe.report.words import (
    by_axis,
    counted,
    decimals,
    flux_density,
    in_a_row,
    point_mm,
    with_unit,
    within_a_sentence,
)
from halbach_fe.report.words import probability as in_per_cent
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

STUDY_FILE = "study.registered.toml"

MAP_FILE = "registered_map.csv"
"""The map with the component that was found, where the map itself does not say which it is."""

NOTE = "of halbach-fe register"

EQUALLY_GOOD = 0.05
"""Odds from which a second pose is reported as a possible one."""

SAME_PLACE = 4.0
"""Distance in standard deviations up to which two poses are the same place but for a symmetry."""

AT_REST = "Yes, the map can be used in this pose."
UNDECIDED = "Only if the map was measured in this pose, as the readings do not decide on it."
DOUBTED = (
    "No. The map is explained, but only by terms that are far from what was known before: so would "
    "be many a map of something else.")
NOT_AT_REST = (
    "No, do not use the map in this pose yet. The search for the best fit has not come to rest: it "
    "ended while place and turns still changed from step to step, so that the best pose may be "
    "farther away than the error bars say.")


USE_ANY = (
    " The field that infer finds at the places of the map is the same in all of them, so that any "
    "may be used. Only the names of blocks are exchanged, which matters if you look for one block "
    "or give measured blocks (--blocks): then find out by a mark on the magnet which pose is the "
    "real one.")

MOVES_A_SECTION = (
    "The overlap needs no magnet: something is missing in the model, such as steps of the bore, "
    "lengths of rings and gaps between them, magnetization that was lost at the ends, or "
    "permeability.")

NEAR_M, NEAR_RAD = 1e-3, 1e-2
"""Shift and turn up to which `diagnose` finds a map's pose from that of the study."""

NOMINAL = "nominal magnet"
UPDATED = "magnet as the maps before have updated it"
"""What the readings are compared with before they update the blocks."""


def answer(
    found: Sequence[Registration], before: str = NOMINAL, name: str = "",
    *, assumed: Instrument | None = None,
) -> Answer:
    """Say where the map lies, how sure that is, and what to do next.

    ``name`` is that of a map that the study lists, so that no option has to say which it is.
    ``assumed`` is the instrument that the study states (default: none): to find it again changes
    nothing.
    """
    best = found[0]
    along = ", ".join(f"{own} of the map along {axis.replace('-', '−')}" for own, axis in
                      axes_of_map(best.instrument).items())
    place = point_mm(best.middle_m, best.translation_sd_m)
    said = (f"The middle of the map lies at {place} mm in the magnet, with {along} of the "
            f"magnet. On the map's stage the middle of the magnet is at {_magnet_on_stage(best)}.")
    least_bad = f" for B{best.component}" if best.component else ""
    alike = sum(_fit_alike(best, each) or is_symmetric_to(best, each) for each in rivals(found))
    if alike:
        said += (f" {counted(alike, 'other pose of the map is', 'other poses of the map are')} as "
                 "likely.")
    trust = [*_other_poses(found), *_reversed(best, assumed), _fit(best, before)]
    stated = assumed or Instrument()
    if best.explains and not best.at_rest:
        said = f"That is not found yet. The best answer so far: {within_a_sentence(said)}"
    if best.explains:
        said = _component(found) + said
        trust.insert(0, _verdict(found))
    else:
        said = (f"This magnet does not explain the map. The least bad answer{least_bad}: "
                f"{within_a_sentence(said)}")
        trust.insert(0, (
            f"No. Even in the best pose and with updated blocks chi² is {decimals(best.chi2)} per "
            "reading, where about 1 is expected: the map is of another magnet, its noise is larger "
            "than the study says, or the study lacks something. As no pose explains the map, none "
            "has odds."))
    apart = [_apart(best, name)] if best.explains and best.at_rest and best.apart else []
    trust[1:1] = [*_doubts(best), *apart]
    return Answer(
        f"Where does {'map ' + name if name else 'the map'} lie in the magnet?", said,
        " ".join(trust), *_next_step(best, name, stated), sound=is_sound(best),
        changes_study=not _is_as_assumed(best, stated), gist="" if not is_sound(best) else
        f"By the coordinates of {f'map {name}' if name else 'the map'}, the middle of the magnet "
        f"is at {_magnet_on_stage(best)}.")


def is_sound(best: Registration) -> bool:
    """Tell whether a pose may be used: it explains the map, with terms that are to be expected."""
    return best.explains and best.at_rest and not best.doubts and not best.apart


def _apart(best: Registration, name: str) -> str:
    """Say where the model of the magnet wants a map otherwise than its overlap with others."""
    said = []
    for one in best.apart:
        where, axis = one.name.split("_")
        unit, _ = UNITS[one.unit]
        said.append(f"{with_unit(one.value, one.prior_sd, unit)} {where} "
                    f"{axis} of the stage ({decimals(one.distance, 2)} standard deviations)")
    return (f"The magnet's model wants map {name} {in_a_row(said)} from where its overlap with "
            f"the other maps has it. {MOVES_A_SECTION}")


def _component(found: Sequence[Registration]) -> str:
    """Say which component a map holds that does not say it itself; nothing about others."""
    by_name: dict[str, float] = {}
    for each, value in zip(found, odds(found), strict=True):
        by_name[each.component] = by_name.get(each.component, 0.0) + float(value)
    own = found[0].component
    if not own:
        return ""
    others = [f"B{name} with {in_per_cent(value)}" for name, value in by_name.items()
              if name != own and value > EQUALLY_GOOD]
    return (f"The map is of B{own}, with a probability of {in_per_cent(by_name[own])} among Bx, By "
            f"and Bz along its axes{' (or ' + in_a_row(others) + ')' if others else ''}. ")


def _doubts(best: Registration) -> list[str]:
    """Say what lies far from its prior, and what a common factor of the readings tells."""
    if not best.doubts:
        return []
    factor = factor_in_words(best.factor, best.likeness)
    if _are_alike(best) and not _is_a_factor(best):
        factor = ""  # where no pose explains the map, a factor is that of a wrong place
    return [each for each in (doubts_in_words(best.doubts), factor) if each]


def _is_a_factor(best: Registration) -> bool:
    """Tell whether readings are those of the nominal magnet but for a factor.

    A single component under a wrong name is like some other one in some other place.
    """
    return best.explains or (_are_alike(best) and len(_measured(best)) > 1
                             and bool(known_factor(best.factor)))


def _are_alike(best: Registration) -> bool:
    """Tell whether the readings are like the nominal field, so that a factor may relate both."""
    return abs(best.likeness) >= UNLIKE


def _verdict(found: Sequence[Registration]) -> str:
    """Say in a sentence whether the first pose, which explains the map, may be used."""
    best = found[0]
    if not best.at_rest:
        return NOT_AT_REST
    if best.doubts:
        return DOUBTED
    if best.apart:
        return "No."
    decided = all(is_symmetric_to(best, each) for each in rivals(found))
    return AT_REST if decided else UNDECIDED


def _next_step(best: Registration, name: str, stated: Instrument) -> tuple[str, str]:
    """Return what to do next, and its command; ``stated`` is the instrument of the study."""
    maps = "" if name else " --measurements MAP"
    own = f" --measurements DIR/{MAP_FILE}" if best.component else maps
    if is_sound(best):
        return ("Update the blocks with the map in this pose. The update finds pose and probe "
                "again, together with the blocks.",
                f"halbach-fe infer DIR/{STUDY_FILE}{own} -o DIR")
    # doubts about what the file says of its numbers, not about the magnet
    if best.doubts and (_is_a_factor(best) or len(_measured(best)) == 1):
        return _after_doubts(best, maps)
    if best.explains and not best.apart:
        return ("Do not update the blocks in this pose. Measure lines beside this one, or the "
                "components of B that are missing, or narrow the search by what is known of the "
                "place (--across-m, --turn-rad), and register again.",
                f"halbach-fe register STUDY{maps.replace('MAP', 'NEW_MAP')} -o DIR")
    if best.doubts and not best.apart:
        return ("Look for what the model lacks, with the study as it is: as this pose does not "
                "explain the map, neither is the probe what it is in it.",
                f"halbach-fe diagnose STUDY{maps} -o DIR")
    if _is_near(best, stated) and not best.apart:
        return ("Look for what the model lacks. The map lies about where the study states it, and "
                "diagnose finds small shifts and turns by itself.",
                f"halbach-fe diagnose STUDY{maps} -o DIR")
    return "Look for what the model lacks.", f"halbach-fe diagnose DIR/{STUDY_FILE}{own} -o DIR"


def _after_doubts(best: Registration, maps: str) -> tuple[str, str]:
    """Return the next step and its command after a fit with doubts."""
    again = f"halbach-fe register STUDY{maps.replace('MAP', 'NEW_MAP')} -o DIR"
    if len(_measured(best)) == 1 and not best.component:
        return (f"Is the component really B{_measured(best)[0]}, along the map's own axes? If that "
                f"is not certain, name its column {UNDIRECTED_COLUMN} (import-map: --component "
                "unknown), and register finds which one it is.", again)
    if _are_alike(best) and factor_in_words(best.factor) and _is_a_factor(best):
        return ("Look at the unit, the sign and the factor of the readings, correct the map (or "
                "instrument.flux_density_unit_T in the study), and register it again.", again)
    return ("Look whether rows, axes, components and units of the map are what its columns say "
            "(halbach-fe check does, for maps of a volume), and state in [instrument_sd] if less "
            "is known of the probe. Then register it again.", again)


def rivals(found: Sequence[Registration]) -> list[Registration]:
    """Return the other poses between which and the first one the readings do not decide.

    If no pose explains the map, these are the poses that a symmetric magnet makes equal to the
    first: evidence of fits that do not hold says nothing.
    """
    if not found[0].explains:
        return [each for each in found[1:] if is_symmetric_to(found[0], each)]
    least = found[0].log_evidence - UNDECIDED_LOG_EVIDENCE
    return [each for each in found[1:] if each.log_evidence > least]


def stated_odds(found: Sequence[Registration]) -> Floats:
    """Return the odds (n,) of poses; the same for those that a symmetric magnet makes equal.

    Their evidence differs only by where the fits ended.
    """
    probability, others = odds(found), rivals(found)
    equal = [number for number, each in enumerate(found) if number == 0 or (
        any(each is one for one in others) and is_symmetric_to(found[0], each))]
    probability[equal] = probability[equal].mean()
    return probability


def has_odds(found: Sequence[Registration]) -> bool:
    """Tell whether poses have odds: one of them explains the map, and none was left out."""
    return found[0].explains and not found[0].left_out


def _is_near(best: Registration, assumed: Instrument) -> bool:
    """Tell whether the map lies within `NEAR_M` and `NEAR_RAD` of where the study states it."""
    (shift, turn), (old_shift, old_turn) = (
        (np.array(one.translation_m), np.array(one.rotation_rad))
        for one in (best.instrument, assumed))
    return not best.open_keys and bool(
        np.abs(shift - old_shift).max() < NEAR_M and np.abs(turn - old_turn).max() < NEAR_RAD)


def _is_as_assumed(best: Registration, assumed: Instrument) -> bool:
    """Tell whether the registration found, within its errors, the instrument that the study
    states; without [instrument] that is a probe without errors in the axes of the magnet.
    """
    # Standard deviations up to which a pose or an error of a probe counts as zero: of some 25 such
    # numbers that are zero, one is farther away in one of 15 maps.
    certain_sd = 3.0
    probe = best.probe
    sizes = [best.translation_sd_m, best.rotation_sd_rad, probe.gain, probe.offset_T,
             probe.crosstalk, probe.sensor_m]
    return not best.open_keys and (best.instrument.position_axes, best.instrument.field_axes) == (
        assumed.position_axes, assumed.field_axes) and all(
        np.all(np.abs(new - old) <= certain_sd * np.asarray(sd)) for new, old, sd in zip(
            _numbers(best.instrument), _numbers(assumed), sizes, strict=True))


def _numbers(instrument: Instrument) -> list[Floats]:
    """Return the shifts, turns, gains, offsets, crosstalk and places of sensors that a registration
    finds.
    """
    crosstalk = dict[str, float](instrument.crosstalk.items())
    return [np.array(value, float) for value in (
        instrument.translation_m, instrument.rotation_rad, instrument.gain, instrument.offset_T,
        [crosstalk.get(pair, 0.0) for pair in CROSSTALK], instrument.sensor_position_m)]


def _magnet_on_stage(best: Registration) -> str:
    """Return where the middle of the magnet is by the map's own coordinates, in mm."""
    return f"{point_mm(*magnet_on_stage(best))} mm"


def magnet_on_stage(best: Registration) -> tuple[Floats, Floats]:
    """Return where the middle of the magnet is by the map's own axes, in m, and its sd (3,) each.

    It moves with the place of the map's middle, and with the turns about that.
    """
    instrument = best.instrument
    turn = turn_of(instrument).as_matrix()
    scale = 1 + np.array([instrument.radius_scale, instrument.radius_scale, instrument.z_scale])
    sensor = np.mean(instrument.sensor_position_m, axis=0)
    middle = np.array(build_magnet(best.study).middle_m)
    centre = (turn.T @ (middle - instrument.translation_m) - sensor) / scale
    sd = np.hypot(
        best.translation_sd_m, moved_by_turns(best.middle_m - middle, best.rotation_sd_rad))
    axes = np.array([COMPONENTS.index(axis[-1]) for axis in instrument.position_axes])
    signs = np.array([-1.0 if axis.startswith("-") else 1.0 for axis in instrument.position_axes])
    return signs * centre[axes], np.sqrt(turn.T**2 @ sd**2 / scale**2)[axes]


def _other_poses(found: Sequence[Registration]) -> list[str]:
    """Say which other poses are possible, and whether it matters which of them is used."""
    probability, said = stated_odds(found), []
    alike, unlike = [], []
    if left := found[0].left_out:
        said.append(f"Of the {len(found) + left} poses that the search found, "
                    f"{counted(len(found), 'was', 'were')} fitted; the others may be as likely.")
    if not found[0].explains:
        alike = rivals(found)
    for each, value in zip(found[1:], probability[1:], strict=True):
        if value > EQUALLY_GOOD and found[0].explains:
            if _fit_alike(found[0], each) or is_symmetric_to(found[0], each):
                alike.append(each)
            else:
                unlike.append(f"{100 * value:.0f}\u00a0%")
    if alike and all(is_symmetric_to(found[0], each) for each in alike):
        said.append(
            f"{counted(len(alike), 'other pose predicts', 'other poses predict')} the same "
            "readings, because the nominal magnet is the same after the turn from one pose to the "
            "other: no reading can tell them apart." + (USE_ANY if is_sound(found[0]) else ""))
    elif alike:
        said.append(f"{counted(len(alike), 'other pose fits', 'other poses fit')} these readings "
                    "equally well: decide by how the map was measured which one is real.")
    if unlike and found[0].explains and found[0].at_rest:
        least = (", which is taken because its axes are turned least: decide by how the map was "
                 "measured" if probability[0] < probability.max() else "")
        said.append(
            f"{counted(len(unlike), 'other pose')} cannot be ruled out, with a probability of "
            f"{in_a_row(unlike)} beside {100 * probability[0]:.0f} % of this one{least}.")
    elif unlike:
        said.append(f"{counted(len(unlike), 'other pose')} cannot be ruled out. (In this one chi² "
                    f"is {decimals(found[0].chi2)} per reading, where about 1 is expected, so that "
                    "the odds of poses mean little.)")
    return said


def _fit_alike(one: Registration, other: Registration) -> bool:
    """Tell whether two poses are equally probable, and equally far from the readings."""
    # Difference of residuals, relative to them, up to which two poses are equally far from the
    # readings. The fits of a symmetric magnet's two poses ended within 1e-5 of each other.
    same_fit = 0.01
    return abs(one.log_evidence - other.log_evidence) < EQUAL_LOG_EVIDENCE and all(
        np.isclose(np.nanmean(first**2), np.nanmean(second**2), rtol=2 * same_fit)
        for first, second in ((one.rms_T, other.rms_T), (one.nominal_rms_T, other.nominal_rms_T)))


def is_symmetric_to(one: Registration, other: Registration) -> bool:
    """Tell whether the turn from one pose to another puts every nominal block onto an equal one.

    Such poses predict the same readings, before and after an update. `block_images` says which
    magnets are never symmetric.
    """
    first, second = (nearest_right_angles(each.instrument) for each in (one, other))
    turn = second @ first.T
    off = np.abs(other.middle_m - turn @ one.middle_m)
    if one.component != other.component:
        return False
    # error bars are those of readings with as much noise as the fit leaves
    wider = SAME_PLACE * np.sqrt(max(1.0, one.chi2))
    if (off > wider * np.hypot(np.abs(turn) @ one.translation_sd_m,
                               other.translation_sd_m)).any():
        return False
    return block_images(build_magnet(one.study), turn) is not None


def _reversed(best: Registration, assumed: Instrument | None) -> list[str]:
    """Name reversed signs as the rival of a turn after which the nominal field is the opposite."""
    turn = nearest_right_angles(best.instrument) @ nearest_right_angles(assumed or Instrument()).T
    if best.component or np.trace(turn) > 3 - 1e-9 or (
            block_images(build_magnet(best.study), turn, -1) is None):
        return []
    return ["A map that is not turned, but whose readings all have the other sign (a probe the "
            "other way round, say), would read the same: this magnet's field is the opposite after "
            "that turn. Decide by how the map was measured."]


def _fit(best: Registration, before: str) -> str:
    """Say how far the magnet in the best pose is from the readings."""
    fitted, updated, held_out, predicted = map(_rms_in_words, (
        best.nominal_rms_T, best.rms_T, best.held_out_nominal_rms_T, best.held_out_rms_T))
    tested = (f"; the lines that were held out are {held_out} and {predicted} off"
              if np.isfinite(best.held_out_rms_T).any() else "")
    return (f"In this pose the {before} is {fitted} off the readings that were fitted, with "
            f"updated blocks {updated}{tested}.")


def sentences(found: Sequence[Registration]) -> list[str]:
    """Return what else was found."""
    best, said = found[0], []
    if best.total:
        said.append("The map is of |B|, which is the same if the field is reversed everywhere: "
                    "poses that differ by the sign of the field are equal.")
    if best.undetermined:
        said.append(
            f"The map by itself does not determine the {', '.join(best.undetermined)}: what was "
            "known before (the prior, or another map on the same stage) holds "
            f"{'it' if len(best.undetermined) == 1 else 'them'}, with the standard deviations of "
            "the table.")
    said.append(trade_offs_in_words(best.trade_offs) if best.explains else "")
    if len(by_hypothesis(found)) > 1 and best.explains:
        said.append("Odds of what is open: " + "; ".join(
            f"{name} {100 * value:.3g} %" for name, value in by_hypothesis(found).items()) + ".")
    said.append(row_order_note(best.study) or "")
    return [*filter(None, said)] + [f"{key} is {value:.5g} ± {sd:.1g}."
                   for key, (value, sd) in best.open_keys.items()]


def hypothesis(one: Registration) -> str:
    """Return the names of the numbers that a registration has fitted."""
    return ", ".join(one.open_keys) or "nothing open"


def by_hypothesis(found: Sequence[Registration]) -> dict[str, float]:
    """Return the odds of each set of open numbers, over all of its poses, the best first."""
    total: dict[str, float] = {}
    for each, probability in zip(found, odds(found), strict=True):
        total[hypothesis(each)] = total.get(hypothesis(each), 0.0) + float(probability)
    return dict(sorted(total.items(), key=lambda item: -item[1]))


def _rms_in_words(rms: np.ndarray) -> str:
    """Return the rms over the components; nothing if it is not known."""
    if np.isnan(rms).all():
        return ""
    return f"{flux_density(float(np.sqrt(np.nanmean(rms**2))))} rms"


def pose_table(
    found: Sequence[Registration], before: str = NOMINAL
) -> Rows:
    """Return rows of text, one per pose."""
    rows = []
    for number, (each, probability) in enumerate(zip(found, stated_odds(found), strict=True), 1):
        rows.append({
            "pose": str(number),
            "odds": f"{100 * probability:.3g} %" if has_odds(found) else EMPTY_CELL,
            **({"component": f"B{each.component}"} if each.component else {}),
            **({"open": hypothesis(each)} if len(by_hypothesis(found)) > 1 else {}),
            "axes x, y, z of the map": ", ".join(axes_of_map(each.instrument).values()),
            f"{before} off by": _rms_in_words(each.nominal_rms_T),
            "updated blocks off by": _rms_in_words(each.rms_T),
            "chi²/reading": decimals(each.chi2)})
    return rows


def place_table(found: Sequence[Registration]) -> Rows:
    """Return a row of text per pose: the middle of the map in mm, and its turns in mrad."""
    return [{"pose": str(number), **by_axis("{} in mm", each.middle_m, each.translation_sd_m),
             **by_axis("about {} in mrad", turn_from_axes(each.instrument), each.rotation_sd_rad)}
            for number, each in enumerate(found, 1)]


def probe_table(best: Registration) -> Rows:
    """Return rows of text: what the fit says about the sensors of the map, with their sd."""
    sd = np.sqrt(np.diag(best.covariance))[PROBE.start:STEADY.stop]  # without open keys
    instrument = best.instrument

    def row(what: str, value: float, bar: float, unit: str) -> dict[str, str]:
        return {"of the probe": what, "value": with_unit(value, bar, unit)}

    def sensor(name: str, number: int) -> Rows:
        return [row(f"gain of {name}", instrument.gain[number], sd[6 + number], "%"),
                row(f"offset of {name}", instrument.offset_T[number], sd[9 + number], "mT")]

    if best.total:
        return sensor("|B|", 0)
    there = _measured(best)
    rows = [row(f"B{name[0]} sees B{name[1]}", value, bar, "mrad")
            for (name, value), bar in zip(instrument.crosstalk.items(), sd[:6], strict=True)
            if name[0] in there]
    for number, name in enumerate(COMPONENTS):
        if name in there:
            rows += sensor(f"B{name}", number) + [
                row(f"place of the B{name} sensor, {axis}", value, bar, "mm")
                for axis, value, bar in zip(COMPONENTS, instrument.sensor_position_m[number],
                                            sd[12:].reshape(3, 3)[number], strict=True)]
    return rows


def doubt_table(best: Registration) -> Rows:
    """Return rows of text: terms that are farther from their priors than chance takes them."""
    return [{"term": each.name, "changed by": each.size, "known before": each.known,
             "that is": f"{decimals(each.distance, 2)} standard deviations"}
            for each in best.doubts]


def _measured(best: Registration) -> list[str]:
    """Return the components that the map has."""
    return [name for name, rms in zip(COMPONENTS, best.rms_T, strict=True) if not np.isnan(rms)]


def registration_summary(found: Sequence[Registration]) -> Plain:
    """Return the poses as plain data, the content of registration.json."""
    def numbers(values: np.ndarray) -> list[float | None]:
        return [None if np.isnan(value) else float(value) for value in values]

    return {"row_order": row_order_note(found[0].study), "poses": [{
        "odds": float(probability) if has_odds(found) else None,
        "at_rest": each.at_rest, "explains": each.explains, "sound": is_sound(each),
        "doubts": [one.plain() for one in each.doubts], "factor": each.factor,
        "apart": [one.plain() for one in each.apart],
        "trade_offs": [list(names) for names in each.trade_offs],
        **({"component": each.component} if each.component else {}),
        "undetermined": list(each.undetermined), "chi2": each.chi2,
        "held_out_chi2": None if np.isnan(each.held_out_chi2) else each.held_out_chi2,
        "axes": axes_of_map(each.instrument),
        "instrument": each.instrument.model_dump(mode="json", exclude_defaults=True),
        "open_keys": {key: {"value": value, "sd": sd}
                      for key, (value, sd) in each.open_keys.items()},
        "magnet_on_stage_m": numbers(magnet_on_stage(each)[0]),
        "magnet_on_stage_sd_m": numbers(magnet_on_stage(each)[1]),
        **{name: numbers(getattr(each, name)) for name in (
            "middle_m", "translation_sd_m", "rotation_sd_rad", "rms_T", "nominal_rms_T",
            "held_out_rms_T", "held_out_nominal_rms_T")},
        "log_evidence": each.log_evidence,
    } for each, probability in zip(found, stated_odds(found), strict=True)]}


def page(
    study: Study, data: xr.Dataset, found: Sequence[Registration], before: str = NOMINAL,
    name: str = "",
) -> Page:
    """Return the page of where a map lies, with the study that says it.

    Of one of the maps that a study lists, ``name`` is the map's; its study is that of the others.
    """
    best, said, rows, places = found[0], sentences(found), pose_table(found, before), place_table(
        found)
    files = {}
    if is_undirected(data):
        data = directed(data, best.component)
        files = {MAP_FILE: partial(write_map, data)}
    updated = ", or the blocks as the maps before have updated them" if name else ""
    most_turned = 4  # poses beside each other on a page
    doubts = doubt_table(best)
    return Page(
        "register", f"where {'map ' + name if name else 'the map'} lies in the magnet", study,
        answer(found, before, name, assumed=study.instrument), registration_summary(found), [
            Section([*said, Text(
                "The search tried every rotation by right angles and every place along the axis, "
                "for a map on a line beside the axis too. Pose, probe and open "
                "numbers were then fitted together with the magnetizations of all blocks, whose "
                f"prior is that of the study{updated}; error bars include what the blocks leave "
                "open.", "small")]),
            Section([Table(rows), Text(
                "chi² per reading is that of the updated blocks; about 1 is expected. Odds compare "
                "poses that explain the map; there are none if none does, or if poses were left "
                "out.", "small")], "Poses"),
            Section([Table(doubts)], "Far from what was known before", about=doubts),
            Section(["The pose is where the middle of the map lies in the magnet, and how the map "
                     "is turned about the axes of the magnet, once its own axes were put along "
                     "those above.", Table(
                         places, "turned" if len(places) <= most_turned else "numbers")]),
            Section(["± is the standard deviation. “Bx sees By” is "
                     "the angle by which the Bx sensor is turned towards y. A sensor's place is "
                     "from the probe's own point.", Table(probe_table(best))],
                    "The probe, in pose 1")],
        {"Poses of the map": rows, "Where the map lies in the magnet": places},
        figures={"registration.png": (partial(_where, best, data), (
            "The readings along the magnet's axis and in its cross-section, where the registration "
            "puts them"))},
        files=files, stem="registration", remarks=said,
        new_study=None if name else (STUDY_FILE, lambda: [(best.study, NOTE)]))


def pages_of_maps(
    maps: Sequence[Map], found: Mapping[str, Sequence[Registration]]
) -> dict[str, Page]:
    """Return the page of each map that a study lists, by its name."""
    return {one.name: page(one.study, one.data, found[one.name],
                           UPDATED if number else NOMINAL, one.name)
            for number, one in enumerate(maps)}


def _where(best: Registration, data: xr.Dataset) -> Figure:
    """Draw the readings where the registration puts them in the magnet."""
    base = best.instrument.with_(translation_m=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0))
    read = in_si_and_magnet_axes(base, data)
    points = 1e3 * probe_points(best.instrument, points_of(read))
    figure, along, across = magnet_panels("B in mT")
    if best.total:
        along.plot(points[:, 2], 1e3 * read[TOTAL_COLUMN].values, ".", ms=2, color=POSTERIOR,
                   label="|B| of the map")
    for name, values, colour in zip(COMPONENTS, read["B_T"].values.T,
                                    (SECOND, POSTERIOR, MEASURED), strict=True):
        if not np.isfinite(values).any():
            continue
        along.plot(points[:, 2], 1e3 * values, ".", ms=2, color=colour, label=f"B{name} of the map")
    across.plot(points[:, 0], points[:, 1], ".", ms=3, color=POSTERIOR)
    legend_above(figure, along, columns=3, markerscale=4)
    return figure
