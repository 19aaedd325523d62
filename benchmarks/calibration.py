"""Calibration: p-values that `make verify-calibration` has found, and instruments by `check`."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import magpylib
import numpy as np
import xarray as xr
from scipy.stats import chi2

from benchmarks.note import Note
from halbach_fe.cli import main
from halbach_fe.core.errors import CheckFailedError, MeasurementError, StudyError
from halbach_fe.measurement.field_map import write_map
from halbach_fe.measurement.map_check import SIGNIFICANT, check_map
from halbach_fe.measurement.map_join import join_maps
from tests.support import cube_dipole, joined_campaigns
from tests.support.hard_maps import ERRORS, GAIN, gain_of, hard_map

RESULTS = Path(__file__).parent.parent / "results" / "calibration" / "calibration.json"
NAMES = {
    "linear, closed form": "linear", "non-linear, chains": "sampled",
    "control: position noise not stated": "control_positions",
    "control: error of a coarse mesh not stated": "control_mesh",
    "control: the paper's chain, too short": "control_short_chain"}


def run(note: Note) -> None:
    """Note the p-values; they take long, which is why nothing is run here."""
    if not RESULTS.exists():
        raise StudyError(f"There is no {RESULTS}. Run make verify-calibration first.")
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    missing = [name for name in NAMES if name not in found]
    if missing:
        raise StudyError(
            f"{RESULTS} lacks {', '.join(missing)}. Run make verify-calibration again.")
    for name, short in NAMES.items():
        note(f"calibration.{short}_p", found[name]["p_value"], "p-value",
             f"ranks of {found[name]['repeats']} truths of make verify-calibration: {name}")


MAPS = 40
"""Number of maps with a perfect instrument, and of those with an instrument that has one error."""


def instrument(note: Note) -> None:
    """Note how often `check` finds errors of a probe that are not there, and those that are."""
    false = sum(any(term.found for term in check_map(hard_map(seed)).terms)
                for seed in range(MAPS))
    found = within = visible = 0
    for seed in range(MAPS):
        error = list(ERRORS)[seed // 4 % len(ERRORS)]
        data = hard_map(seed, error)
        name, value = ERRORS[error]
        if error == "gain":
            own, share = gain_of(data["B_T"].values)
            name, value = f"gain of B{'xyz'[own]} relative to that of |B|", 100 * GAIN * (1 - share)
        (term,) = [term for term in check_map(data).terms if term.name == name]
        found += term.found
        visible += abs(value) > SIGNIFICANT * term.sd
        within += abs(term.value - value) <= 2 * term.sd
    against = f"of {MAPS} maps near blocks and coils by magpylib"
    note("check.instrument_false_rate", false / MAPS, "ratio",
         f"{against}, with a perfect probe; asked: 0.02 at most")
    note("check.instrument_found_rate", found / MAPS, "ratio",
         f"{against}, with one error of usual size, which is above {SIGNIFICANT:g} of its error "
         f"bars in {visible}; asked: 0.9 at least")
    note("check.instrument_within_2sd", within / MAPS, "ratio",
         "the same maps: share whose error is within 2 sd, found or not")


def _ring_along_z(magnet: magpylib.Collection) -> None:
    for cube in magnet.sources[12:]:
        cube.move((0.0, 0.0, 3e-4))


def _cube_outwards(magnet: magpylib.Collection) -> None:
    cube = magnet.sources[4]
    cube.move(5e-4 * np.array([*cube.position[:2], 0.0]) / np.hypot(*cube.position[:2]))


def _weak_cube(magnet: magpylib.Collection) -> None:
    magnet.sources[7].polarization = 0.9 * magnet.sources[7].polarization


def _halves_apart(magnet: magpylib.Collection) -> None:
    for cube in magnet.sources:
        cube.move((1e-4 * np.sign(cube.position[0]), 0.0, 0.0))


def _object_outside(magnet: magpylib.Collection) -> None:
    magnet.add(magpylib.misc.Dipole(moment=(0.05, 0.02, 0.03), position=(0.11, 0.05, 0.02)))


def _field_outside(magnet: magpylib.Collection) -> None:
    magnet.add(magpylib.current.Circle(diameter=4.0, current=300.0))  # some 0.1 mT


LACKING = (_ring_along_z, _cube_outwards, _weak_cube, _halves_apart, _object_outside,
           _field_outside)
"""What a magnet of two rings of twelve cubes has and its study does not, of usual sizes."""


def joined_lacking(note: Note) -> None:
    """Note how often bars of poses hold that `register --joined` says Yes to, of magnets that have
    something which the study lacks.
    """
    off, refused = [], 0
    for number in range(CAMPAIGNS):
        maps, poses, _ = joined_campaigns.campaign(
            2 * number + 1, changed=LACKING[number % len(LACKING)])
        with tempfile.TemporaryDirectory() as name:
            places = _registered(Path(name), maps, poses)
        refused += not places
        off += [place for yes, place in places if yes]
    note("joined.yes_rate_lacking", len(off) / (3 * CAMPAIGNS), "ratio",
         f"of {3 * CAMPAIGNS} maps of magnets of cubes with one of {len(LACKING)} effects that "
         f"the study lacks: share with the answer Yes; {refused} of {CAMPAIGNS} campaigns refused")
    covered, halved = (float(np.mean(np.array(off) <= part**2 * chi2.ppf(0.95, 3)))
                       for part in (1.0, 0.5))
    if halved >= 0.9:
        raise CheckFailedError("Bars of half the length would cover as well: this figure cannot "
                               "tell bars that are too short.")
    note("joined.coverage_lacking", covered, "ratio",
         "of these, where the error of the place, over its bars, is within the 95 % of three axes "
         f"together; {halved:.2g} if the bars were half as long; asked: 0.9")


def _registered(
    folder: Path, maps: dict[str, xr.Dataset], poses: list[joined_campaigns.Pose]
) -> list[tuple[bool, float]]:
    """Return of each map whether `register --joined` says Yes, and chi-squared of the three
    coordinates of the magnet's place on its stage; nothing if the campaign is refused.
    """
    for name, data in maps.items():
        write_map(data, folder / f"{name}.csv")
    (folder / "study.toml").write_text(cube_dipole.noisier(joined_campaigns.NOISE_T) + "".join(
        f'[[maps]]\nname = "{name}"\nfile = "{name}.csv"\n' for name in maps))
    joined, found = folder / "joined", folder / "registered"
    for arguments in (["check", *(folder / f"{name}.csv" for name in maps), "-o", joined],
                      ["register", folder / "study.toml", "--joined", joined / "joined.json", "-o",
                       found]):
        if main([str(each) for each in arguments]):
            return []
    told = []
    for name, (turn, shift) in zip(maps, poses, strict=True):
        best = json.loads((found / name / "registration.json").read_text(encoding="utf-8"))[
            "poses"][0]
        error = np.array(best["magnet_on_stage_m"]) - turn.inv().apply(-shift)
        told.append((best["sound"], float(np.sum((error / best["magnet_on_stage_sd_m"])**2))))
    return told


CAMPAIGNS = 30
"""Number of campaigns of three overlapping maps that are joined without a magnet."""


def joined(note: Note) -> None:
    """Note how far the poses of maps that are joined are off, in units of their bars."""
    off, refused = [], 0
    for seed in range(CAMPAIGNS):
        maps, poses, _ = joined_campaigns.campaign(seed)
        try:
            off.append(joined_campaigns.over_bars(join_maps(maps), poses))
        except MeasurementError:
            refused += 1
    note("joined.pose_z_rms", float(np.sqrt(np.mean(np.square(off)))), "ratio",
         f"errors over bars of {12 * len(off)} numbers of poses in campaigns by magpylib, a "
         f"quadrupole and a dipole of cubes; {refused} of {CAMPAIGNS} refused; asked: 0.9 to 1.1")
