"""The figures of magnets for MRI: stated homogeneity, shim trays and forces beside magpylib.

The magnets are simulated by magpylib, and the reaction of their permeability by
`halbach_fe.synthetic`, which shares no code with the model that is tested::

    python -m benchmarks.run mri
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import magpylib
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.note import Note
from halbach_fe.core.arrays import Floats
from halbach_fe.design.forces import forces
from halbach_fe.design.shim_tray import shim_tray
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.homogeneity import PPM, homogeneity_model, real_harmonics
from halbach_fe.response.region import Region
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study
from halbach_fe.synthetic.simulate import draw_magnet, true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import changed
from tests.design.test_shim_tray import DOCUMENT, NOISE_T, STRENGTH_SD, cuboid, shims

STUDIES = Path(__file__).parents[1] / "studies"

MAGNETS = 20
CELLS = 1000
"""Of a cube in magpylib's integral of the force."""

MAGNITUDE_SD, DIRECTION_SD_DEG = 0.01, 1.0
DSV = Region.sphere(0.03)

TRAY = changed(DOCUMENT, shim_tray__common_sd=STRENGTH_SD)
"""48 cubes whose field in a sphere of 60 mm is shimmed by cubes of three sizes."""


def large() -> Study:
    """Return the study of 1 218 cubes: the inner layer of the MRI magnet of 4 032."""
    study = read_study(STUDIES / "mri-large" / "study.toml")
    return study.with_(array=study.array.with_(
        rings=21, ring=tuple(ring for ring in study.array.ring if ring.layer == 1)))


def homogeneity(note: Note, session: Session) -> None:
    """Note the error of the stated deviation of |B| in a magnet with errors of 1 % and 1 degree."""
    study, region = large(), Region.sphere(0.10)
    model = homogeneity_model(build_magnet(study), region, session)
    truth = draw_magnet(study, magnet_of(study), np.random.default_rng(1)).mounted
    magnetization = np.concatenate([body.magnetization for body in truth.bodies])
    own = model.field(magnetization[:, None])[..., 0]
    other = true_field(truth, model.points[:len(model.weights)])
    deviation = [PPM * (size / (model.weights @ size) - 1)
                 for size in (np.linalg.norm(field, axis=1) for field in (own, other))]
    rms = float(np.sqrt(model.weights @ (deviation[0] - deviation[1])**2))
    whole = float(np.sqrt(model.weights @ deviation[1]**2))
    note("mri.homogeneity_error_ppm", rms, "ppm",
         f"rms over a sphere of 200 mm of the difference to magpylib, with the reaction at Gauss "
         f"points; {len(truth.bodies)} cubes of permeability 1.05, {whole:.0f} ppm rms; stated "
         f"error of a component {model.solver_error_ppm:.1f} ppm")


def nominal_cuboid(block: MagnetBlock, polarization: Floats) -> magpylib.magnet.Cuboid:
    """Return magpylib's cuboid in the place of a block that is a cube."""
    side = block.z_max - block.z_min
    return cuboid((side, side, side), polarization, tuple(block.middle),
                  Rotation.from_euler("z", block.facing_deg, degrees=True))


def built(blocks: tuple[MagnetBlock, ...], generator: np.random.Generator) -> magpylib.Collection:
    """Return magpylib's magnet with errors of 1 % along and 1 degree across the easy axes."""
    sources = []
    for block in blocks:
        easy = np.array(block.easy_axis)
        aside = np.radians(DIRECTION_SD_DEG) * generator.standard_normal(3)
        along = 1 + MAGNITUDE_SD * generator.standard_normal()
        sources.append(nominal_cuboid(block, block.remanence * (
            along * easy + aside - (aside @ easy) * easy)))
    return magpylib.Collection(*sources)


def trays(note: Note, session: Session) -> None:
    """Note by how much trays reduce the deviation of simulated magnets, and the chi² foretold."""
    study = parse_study(TRAY)
    magnet, points = build_magnet(study), points_from(study.observation.positions)
    reduction, within, chi2 = [], 0, []
    for seed in range(MAGNETS):
        generator = np.random.default_rng(seed)
        truth = built(magnet.blocks, generator)
        readings = truth.getB(points) + NOISE_T * generator.standard_normal(points.shape)
        posterior = infer(magnet, field_map(points, readings), session).posterior
        found = shim_tray(magnet, session, posterior, DSV)
        model = found.model
        region = model.points[:len(model.weights)]
        bare = truth.getB(region)
        shimmed = bare + (shims(found.filled, generator).getB(region) if found.filled else 0)
        mean, rms, _ = model.deviations(np.stack([bare, shimmed], axis=2))
        reduction.append(rms[0] / rms[1])
        low, _, high = found.after.rms_range_ppm
        within += low <= rms[1] <= high
        direction = model.weights @ shimmed
        _, functions = real_harmonics(
            model.degrees, model.sampling.degree, model.sampling.inner_radius)
        true = PPM / mean[1] * functions @ (
            shimmed[:model.sampling.surface] @ (direction / np.linalg.norm(direction)))
        foretold = np.array([[one.ppm, one.sd_ppm] for one in found.after.harmonics]).T
        chi2.append(np.mean(((true - foretold[0]) / foretold[1])**2))
    note("mri.shim_reduction", float(np.median(reduction)), "ratio",
         f"rms ppm before over after, median of {MAGNETS} magnets of 48 cubes of 1 %, 1 degree; "
         f"{min(reduction):.1f} to {max(reduction):.1f}; truth by magpylib")
    note("mri.shim_chi2", float(np.mean(chi2)), "per number",
         f"harmonics of {MAGNETS} shimmed magnets about those foretold; standard error "
         f"{np.std(chi2) / np.sqrt(MAGNETS):.2f}; {within} of {MAGNETS} rms within 95 % ranges")


def all_forces(note: Note, session: Session) -> None:
    """Note the largest difference of forces and torques in an array of cubes to magpylib's."""
    magnet = build_magnet(read_study(STUDIES / "cubes" / "study.toml"))
    found = forces(magnet, session).in_place
    sources = [nominal_cuboid(block, block.remanence * np.array(block.easy_axis))
               for block in magnet.blocks]
    other = np.array([
        [np.reshape(each, (-1, 3)).sum(axis=0) for each in magpylib.getFT(
            sources[:n] + sources[n + 1:], source, meshing=CELLS)]
        for n, source in enumerate(sources)])
    difference = [float(np.abs(own - theirs).max() / np.linalg.norm(theirs, axis=1).max())
                  for own, theirs in ((found.force_N, other[:, 0]), (found.torque_Nm, other[:, 1]))]
    note("force.error", max(difference), "of the largest",
         f"magpylib's getFT with {CELLS} cells, {len(sources)} cubes; forces {difference[0]:.1e}, "
         f"torques {difference[1]:.1e}")


def run(note: Note) -> None:
    """Note all figures."""
    with TemporaryDirectory() as folder:
        for part in (homogeneity, trays, all_forces):
            part(note, Session.open(Path(folder, part.__name__)))
