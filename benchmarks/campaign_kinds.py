"""Sealed campaigns of the kinds that real ones have, at the sizes that they have there.

Each kind draws its own truth by magpylib: maps in the coordinates of a stage half a metre away,
probes with exchanged and reversed axes, sensors that are millimetres apart, two maps with poses of
their own, magnets whose corners have lost magnetization by a knee; and maps in which nothing is
wrong. Every case is kept in ``results/campaign-kinds``; an interrupted run goes on::

    python -m benchmarks.campaign_kinds --part 1 2 &
    python -m benchmarks.campaign_kinds --part 2 2
    python -m benchmarks.run campaign_kinds
    python -m benchmarks.run campaign_knee
"""

from __future__ import annotations

import argparse
import json
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_search import right_angles
from halbach_fe.inference.registration import odds, register
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.map_check import MapCheck, check_map
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.hidden_effects import EFFECTS
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.support.cuboids import DOCUMENT
from tests.support.short_dipole import (
    BODY,
    FRINGE,
    GRID,
    NOISE_T,
    SECTORS,
    campaign_study,
    measured,
    reading,
    sectors,
    truth,
)

FOLDER = Path(__file__).parent.parent / "results" / "campaign-kinds"

Outcome = dict[str, Any]
Generator = np.random.Generator

WITHIN = 4.0
"""Largest deviation of a term from its truth in standard deviations. A case has up to 12 of them,
and one of 12 normal deviates is beyond in one case of 1 300."""

ALMOST_ZERO = 1e-2
"""Odds of a pose below which it is no answer."""

IN_BORE_M = 0.018
"""Largest |x| and |y| of a map in the magnet, whose bore has a radius of 20 mm."""

STAGE_M, MIDDLE_M, TURN_RAD = 0.5, (0.002, 0.002, 0.012), 0.05
"""How far the origin of a stage is away, and how far a map's middle from the magnet's and its axes
from rotations by right angles."""

SENSORS_M, ROLL_RAD, GAIN, OFFSET_T = 1e-3, 0.03, 0.01, 1e-3
"""Standard deviations of the errors of a probe."""

POSES = {"body": (4e-4, 5e-3, 0.0), "fringe": (4e-4, 5e-3, 0.05)}
"""Standard deviations of shift in m and turn in rad of two maps, and stated place along z."""


def registration(generator: Generator, session: Session) -> Outcome:
    """Find the pose of a map from nothing."""
    magnet = build_magnet(parse_study(tomllib.loads(SECTORS)))
    while True:  # until the map is within the bore
        turn = (Rotation.from_rotvec(TURN_RAD * generator.uniform(-1, 1, 3) / np.sqrt(3))
                * Rotation.from_matrix(right_angles()[generator.integers(24)]))
        middle = np.array(MIDDLE_M) * generator.uniform(-1, 1, 3)
        shift = middle - turn.apply(GRID.mean(axis=0))
        if np.abs(turn.apply(GRID) + shift)[:, :2].max() < IN_BORE_M:
            break
    data = measured(
        sectors(truth(generator, generator.uniform(0.005, 0.02))), generator, turn, shift)
    stage = STAGE_M * generator.uniform(-1, 1, 3)
    found = register(magnet, field_map(GRID + stage, data["B_T"].values), session)
    angles = [(Rotation.from_rotvec(each.instrument.rotation_rad) * turn.inv()).magnitude()
              for each in found]
    number = int(np.argmin(angles))
    best = found[number]
    turned = angles[number] / float(np.linalg.norm(best.rotation_sd_rad))
    moved = float(np.linalg.norm(best.middle_m - middle) / np.linalg.norm(best.translation_sd_m))
    probability = float(odds(found)[number])
    return {"right": bool(max(turned, moved) < WITHIN and probability > ALMOST_ZERO),
            "poses": len(found), "odds": probability, "turn_in_sd": turned, "shift_in_sd": moved,
            "sd_mm": (1e3 * np.array(best.translation_sd_m)).tolist()}


def checked(
    generator: Generator, sensors: np.ndarray, roll: np.ndarray, gain: np.ndarray,
    offset: np.ndarray, columns: tuple[int, ...] = (0, 1, 2), signs: tuple[int, ...] = (1, 1, 1)
) -> MapCheck:
    """Check a map that a probe with errors makes through the bore and before it."""
    points, source = FRINGE - FRINGE.mean(axis=0), sectors(truth(generator))
    axes = Rotation.from_rotvec(roll).as_matrix().T
    field = np.column_stack([
        source.getB(points + FRINGE.mean(axis=0) + place) @ axis
        for place, axis in zip(sensors, axes, strict=True)]) * (1 + gain) + offset
    field += NOISE_T * generator.standard_normal(field.shape)
    return check_map(field_map(points, field[:, columns] * signs))


def reversed_probe(generator: Generator, session: Session) -> Outcome:
    """Find which columns of a map are exchanged and which have the wrong sign."""
    columns = tuple(generator.permutation(3).tolist())
    signs = tuple(generator.choice([-1, 1], 3).tolist())
    check = checked(generator, np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3), columns,
                    signs)
    first = signs[0]  # a common sign cannot be known
    right = tuple(f"{'-' if sign != first else ''}{COMPONENTS[column]}"
                  for column, sign in zip(columns, signs, strict=True))
    return {"right": check.orientation == right, "truth": right, "found": check.orientation,
            "alike": check.alike}


def sensors_apart(generator: Generator, session: Session) -> Outcome:
    """Find where the sensors of a probe are that is turned too, with other gains."""
    sensors = SENSORS_M * generator.standard_normal((3, 3))
    sensors -= sensors.mean(axis=0)
    check = checked(generator, sensors, ROLL_RAD * generator.standard_normal(3),
                    GAIN * generator.standard_normal(3), OFFSET_T * generator.standard_normal(3))
    true = {f"{axis} of the B{name} sensor from the mean of all": 1e3 * sensors[sensor, number]
            for sensor, name in enumerate(COMPONENTS) for number, axis in enumerate(COMPONENTS)}
    errors = {term.name: (term.value - true[term.name]) / term.sd
              for term in check.terms if term.name in true and term.determined}
    return {"right": bool(errors) and max(map(abs, errors.values())) < WITHIN,
            "errors_in_sd": errors, "floor_T": check.floor_rms_T,
            "found": sum(term.found for term in check.terms if term.name in errors)}


def two_maps(generator: Generator, session: Session) -> Outcome:
    """Find the poses of two overlapping maps by a probe of other gains."""
    source = sectors(truth(generator, generator.uniform(0.005, 0.02)))
    gain = 0.005 * generator.standard_normal(3)
    maps, right = {}, {}
    for name, points in (("body", BODY), ("fringe", FRINGE)):
        shift_sd, turn_sd, z = POSES[name]
        turn = Rotation.from_rotvec(turn_sd * generator.standard_normal(3))
        shift = shift_sd * generator.standard_normal(3) + [0.0, 0.0, z]
        maps[name] = reading(source, generator, points, (turn, shift), np.diag(1 + gain))
        stated = turn.inv().apply(points - shift)
        middle = (stated.min(axis=0) + stated.max(axis=0)) / 2
        moved = turn.apply(middle) + shift - middle - [0.0, 0.0, z]
        for number, axis in enumerate(COMPONENTS):
            right[f"{name}.translation_{axis}_m"] = moved[number]
            right[f"{name}.rotation_{axis}_rad"] = turn.as_rotvec()[number]
    study = campaign_study("hall", gain=0.01).with_(
        array=parse_study(tomllib.loads(SECTORS)).array)
    result = infer(build_magnet(study), maps, session)
    assert result.terms is not None
    errors = {name: (value - right[name]) / sd for name, value, sd in zip(
        result.terms.names, result.terms.change, result.terms.sd, strict=True) if name in right}
    agree = all(each.chi2 < each.limit for each in result.overlaps)
    return {"right": bool(result.terms.at_rest and agree and not result.disagreement
                          and len(errors) == len(right)
                          and max(map(abs, errors.values())) < WITHIN),
            "errors_in_sd": errors, "overlaps": [each.chi2 for each in result.overlaps],
            "disagreement": result.disagreement}


def knee(generator: Generator, session: Session) -> Outcome:
    """Name the knee of blocks whose corners are demagnetized, with the whole catalogue, and find
    its coercivity and squareness.
    """
    study = parse_study(DOCUMENT).with_(array__rings=1)
    campaign = simulate_campaign(study, int(generator.integers(2**31)),
                                 hide=[(EFFECTS["knee"], None)])
    found = diagnose(study, campaign.readings, session, campaign.blocks)
    named = [one.hypothesis.effect.name for one in found.identified]
    effects: Any = campaign.truth["effects"]
    true = {each["name"]: each["value"] for each in effects[0]["parameters"]}
    errors: dict[str, float] = {}
    for one in found.identified:
        if one.hypothesis.effect.name == "knee":
            for name, value, sd in zip(("coercivity", "squareness"), one.reported[0][1:],
                                       one.reported[1][1:], strict=True):
                errors[name] = (value - true[name]) / sd
    return {"right": named == ["knee"] and max(map(abs, errors.values())) < WITHIN,
            "named": named, "truth": true, "errors_in_sd": errors,
            "unknown": found.unknown and found.unknown.kind,
            "found": [[list(row) for row in one.reported] for one in found.identified]}


def clean(generator: Generator, session: Session) -> Outcome:
    """Find nothing in the map of a probe without errors."""
    check = checked(generator, np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3))
    found = [f"{term.name}: {term.value:.3g} ± {term.sd:.2g}" for term in check.terms
             if term.found]
    return {"right": not (found or check.is_reoriented or check.broken), "found": found,
            "broken": check.broken}


KINDS: dict[str, tuple[Callable[[Generator, Session], Outcome], int]] = {
    "registration": (registration, 20), "reversed_probe": (reversed_probe, 10),
    "sensors_apart": (sensors_apart, 10), "two_maps": (two_maps, 20), "knee": (knee, 5),
    "clean": (clean, 10)}
"""Each kind and its number of cases."""


def run_cases(part: int = 1, parts: int = 1, folder: Path = FOLDER,
              kinds: Sequence[str] = tuple(KINDS)) -> None:
    """Run the cases of a part that are not there yet."""
    chosen = [(kind, number) for kind in kinds for number in range(KINDS[kind][1])]
    for kind, number in chosen[part - 1::parts]:
        path = folder / f"{kind}-{number:02d}.json"
        if path.exists():
            continue
        generator = np.random.default_rng([number, list(KINDS).index(kind), 20])
        with TemporaryDirectory(prefix="halbach-fe-") as temporary:
            found = KINDS[kind][0](generator, Session(find_getdp(None), Path(temporary)))
        write_text(path, json.dumps(found, indent=1, default=float) + "\n")
        common.say(f"{kind} {number}: {found}")


def run(note: Note, folder: Path = FOLDER, kinds: Sequence[str] = tuple(KINDS)) -> None:
    """Note the rate of each kind, and how far the parameters of a knee are from the truth."""
    run_cases(folder=folder, kinds=kinds)
    for kind in kinds:
        count = KINDS[kind][1]
        found = [json.loads((folder / f"{kind}-{number:02d}.json").read_text(encoding="utf-8"))
                 for number in range(count)]
        note(f"diagnosis.kind_{kind}_rate", float(np.mean([one["right"] for one in found])),
             "ratio", f"{count} sealed campaigns of this kind")
        if kind == "knee":
            errors = [each for one in found for each in one["errors_in_sd"].values()]
            note("diagnosis.kind_knee_z_rms", float(np.sqrt(np.mean(np.square(errors)))), "sd",
                 f"{len(errors)} errors of coercivities and squarenesses; 1 if the bars are right")


def run_knee(note: Note) -> None:
    """Note the figures of the knee alone."""
    run(note, kinds=("knee",))


def main() -> None:
    """Run a part of the cases."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", type=int, nargs=2, default=(1, 1), metavar=("K", "N"))
    run_cases(*parser.parse_args().part)


if __name__ == "__main__":
    main()
