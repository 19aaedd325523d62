"""Maps that a new user brings, README's recipe for them, and how far its answer is from the truth.

Every magnet deviates from its study as the study's prior says, and one of its blocks is weak by
`WEAK` besides. Its field is computed by magpylib, and what permeable blocks answer by NGSolve or at
Gauss points, which share no code with the model. The mapper does not stand where the study says,
and has the noise and the stage that ``new`` takes for granted.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.posterior_files import read_posterior
from halbach_fe.stats.gaussian import by_readings_alone
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.simulate import draw_magnet, true_field
from halbach_fe.synthetic.true_magnet import TrueMagnet
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

WEAK = 0.03
"""What a weak block lacks of its magnetization: three standard deviations of the prior."""


@dataclass(frozen=True)
class Brought:
    """A map that a new user brings."""

    name: str
    new: str
    """Options of ``halbach-fe new``."""
    reach_m: tuple[float, float]
    """Largest distance of a point from the axis, and from z = 0; of a sphere from the middle."""
    units: tuple[float, float] = (1.0, 1.0)
    """Units in a metre and in a tesla of the file."""
    assumed: float = 1.0
    true: float = 1.0
    """Recoil permeability in the study, and of the blocks."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the zero of the mapper lies in the magnet, and the rotation vector of its axes."""
    seed: int = 1
    steps: int = 7
    """Of the random numbers, and how many points the grid has along x and y."""


def bring(case: Brought, folder: Path) -> None:
    """Write study and map of a case into a folder, and explain them in its folder ``out``."""
    path, map_file = _study(case, folder), folder / "map.csv"
    study, generator = read_study(path), np.random.default_rng(case.seed)
    _write_map(case, study, built(case, study, generator)[0], generator, map_file)
    assert main(["explain", str(path), str(map_file), "-o", str(folder / "out")]) == 0


def judged(case: Brought, folder: Path) -> dict[str, tuple[float, str]]:
    """Return how far what `bring` has found is from the truth."""
    path, out = folder / "study.toml", folder / "out"
    magnet, weak = built(case, read_study(path), np.random.default_rng(case.seed))
    last = next(out / one for one in ("explained", "updated", "inferred") if (out / one).exists())
    for one, written in (("diagnosed", "study.diagnosed.toml"),
                         ("registered", "study.registered.toml")):
        if (out / one / written).exists():
            path = out / one / written
            break
    summary = json.loads((last / "summary.json").read_text(encoding="utf-8"))
    own = build_magnet(read_study(path))
    stored = read_posterior(own, last / "posterior.h5")
    known, block = stored["posterior"], own.blocks[weak]
    along = np.zeros(len(known.mean))
    along[3 * weak:3 * weak + 3] = block.easy_axis
    body = magnet.bodies[weak]
    true = np.dot(body.orientation.apply(body.remanence), block.easy_axis) / (
        MU_0 * block.recoil_permeability)
    alone, alone_sd = (float(value[0]) for value in by_readings_alone(
        stored["prior"], known, along[None]))
    pose = summary["poses"]["map"]
    held_out = next(one for one in summary["scores"] if one["part"] == "held out")
    named = _named(out / "diagnosed" / "diagnosis.json")
    return {
        "weak_block": (float(alone + along @ stored["prior"].mean - true) / alone_sd, "sd"),
        "weak_block_and_prior": (float(along @ known.mean - true)
                                 / float(known.sd_of(along[None])[0]), "sd"),
        "place": (float(np.abs((np.array(pose["middle_m"]) - case.shift_m)
                               / pose["middle_sd_m"]).max()), "sd, the largest of x, y, z"),
        "coverage": (held_out["coverage95_posterior"], "of left-out readings"),
        "chi2": (held_out["chi2_posterior"], "per left-out reading"),
        "named": (len(named), f"causes{': ' if named else ''}{', '.join(named)}")}


def _study(case: Brought, folder: Path) -> Path:
    """Write the study as a user would, and return its path."""
    path = folder / "study.toml"
    assert main(["new", *case.new.split(), str(path)]) == 0
    text, count = re.subn(r"(?m)^recoil_permeability = 1\.05", "recoil_permeability = "
                          f"{case.assumed}", path.read_text(encoding="utf-8"))
    assert count == 1
    path.write_text(text, encoding="utf-8")
    return path


def built(
    case: Brought, study: Study, generator: np.random.Generator
) -> tuple[TrueMagnet, int]:
    """Return the magnet as it was built, and the number of its weak block."""
    nominal = magnet_of(study)
    nominal = replace(nominal, bodies=tuple(
        replace(body, along=case.true, across=case.true) for body in nominal.bodies))
    bodies = list(draw_magnet(study, nominal, generator).mounted.bodies)
    weak = int(generator.integers(len(bodies)))
    bodies[weak] = bodies[weak].with_magnetization((1 - WEAK) * bodies[weak].magnetization)
    return replace(nominal, bodies=tuple(bodies)), weak


def points_of(case: Brought) -> Floats:
    """Return a grid (n, 3) in m in the bore, or in a sphere."""
    across, along = case.reach_m
    sphere = across == along
    steps = np.linspace(-1, 1, case.steps)
    grid = np.stack(np.meshgrid(steps, steps, steps if sphere else np.linspace(-1, 1, 9),
                                indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.linalg.norm(grid[:, :3 if sphere else 2], axis=1) < 1 + 1e-9
    return np.round(grid[inside] * [across, across, along], 6)


def _write_map(
    case: Brought, study: Study, magnet: TrueMagnet, generator: np.random.Generator, path: Path
) -> None:
    """Write what the mapper reads, in its units and with its noise."""
    assert study.noise is not None
    assert study.noise.position_sd_m is not None
    points = points_of(case)
    turn = Rotation.from_rotvec(case.turn_deg, degrees=True)
    there = points + study.noise.position_sd_m[0] * generator.standard_normal(points.shape)
    field = turn.inv().apply(true_field(magnet, turn.apply(there) + case.shift_m))
    read = field + study.noise.regions[0].sigma_T * generator.standard_normal(field.shape)
    (length, flux), units = case.units, [("m", "mm")[case.units[0] > 1],
                                         ("T", "mT")[case.units[1] > 1]]
    names = [*(f"{axis} [{units[0]}]" for axis in "XYZ"), *(f"B{axis} [{units[1]}]"
                                                           for axis in "xyz")]
    np.savetxt(path, np.hstack([length * points, flux * read]), delimiter=",", fmt="%.9g",
               header=",".join(names), comments="")


def _named(path: Path) -> list[str]:
    """Return the names of the causes that a diagnosis adds to the study."""
    if not path.exists():
        return []
    return [one["effect"] for one in json.loads(path.read_text(encoding="utf-8"))["effects"]]
