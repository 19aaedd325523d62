"""Fields of rotationally symmetric materials, one azimuthal mode at a time.

Where recoil permeability and iron do not depend on the angle, the 3D problem of one block splits
into one small (r, z) problem per mode m (see pro/azimuthal_modes.pro), and all blocks of a ring
share it by rotation. Seconds to minutes where edge elements take minutes to hours, and more exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from halbach_fe import getdp as runner
from halbach_fe.blocks import (
    Floats,
    array_half_length,
    blocks_of,
    magnetization_angle_deg,
    position_angle_deg,
)
from halbach_fe.getdp import Job
from halbach_fe.mesh import VerifiedMesh, build_meridian, verify_mesh
from halbach_fe.solve import Task, Workshop, check_inside, make_folder, render, run_tasks
from halbach_fe.study import Study

PROBLEM = "azimuthal_modes.pro"
OUTPUT = "gradients.txt"
MODE_TOLERANCE = 1e-4
"""Modes fall as (r / inner radius)^m. What is left out of one block's reaction, itself a few per
cent of its field, is below 1e-5 of that field."""

MAX_MODES = 64
AXIS_RADIUS = 1e-6
"""Points nearer to the axis than this fraction of the bore are moved there: psi/r needs r > 0."""


@dataclass(frozen=True)
class ModeGradients:
    """d psi/dr, psi/r and d psi/dz of one variant of the materials, per T of remanence.

    Attributes
    ----------
    rings : ndarray, shape (modes, 3, rings, points, 3)
        By component of the remanence: along the block's middle, across it, axial.
    together : ndarray, shape (modes, 2, points, 3)
        All rings at once, along and across the middle.
    """

    rings: Floats
    together: Floats


def suits(study: Study, points: Floats) -> bool:
    """Tell whether materials are rotationally symmetric and the points need few modes."""
    block = study.array.block
    symmetric = block.shape == "sector" and block.angular_gap_deg == 0
    return study.dimension == 3 and symmetric and modes_needed(study, points) <= MAX_MODES


def modes_needed(study: Study, points: Floats) -> int:
    """Highest mode that matters at any of the points (n, 3)."""
    array = study.array
    r, z = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    beyond = np.maximum(z - array_half_length(study), 0)
    # decay per mode: r/ri in the bore, ro/r outside, and with the distance beyond the ends
    decay = np.where(r < array.inner_radius_m, r / array.inner_radius_m,
                     np.where(r > array.outer_radius_m, array.outer_radius_m / np.maximum(r, 1e-9),
                              np.exp(-beyond / array.outer_radius_m)))
    worst = float(np.clip(decay.max(), 1e-9, 1 - 1e-9))
    return max(1, int(np.ceil(np.log(MODE_TOLERANCE) / np.log(worst))))


def mode_fields(
    study: Study, points: Floats, workshop: Workshop, columns: bool = True
) -> Floats:
    """Finite-element part of the field of every source, by the study's method: the reaction (real
    materials minus vacuum), or B itself.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    columns : bool
        Whether blocks are solved one by one too, or the nominal array only.

    Returns
    -------
    ndarray, shape (1 + 3 blocks, n, 3) or (1, n, 3), in T
        Source 0 is the nominal array, solved with all rings at once; then 1 T of each block
        along x, y, z, in block order.
    """
    r = np.maximum(np.hypot(points[:, 0], points[:, 1]),
                   AXIS_RADIUS * study.array.inner_radius_m)
    meridian, where = np.unique(np.column_stack([r, points[:, 2], 0 * r]).round(12), axis=0,
                                return_inverse=True)
    highest = modes_needed(study, points)
    mesh = verify_mesh(build_meridian(study, make_folder(workshop.folder)))
    check_inside(mesh, points)
    # mode 0 has another condition on the axis, so it is a run of its own
    spans = [(0, 0), (1, highest)]
    variants = [False] if study.solver.method == "direct" else [False, True]
    tasks = [_task(study, mesh, meridian, span, vacuum, columns, workshop)
             for span in reversed(spans) for vacuum in variants]
    results = run_tasks(tasks, workshop)
    if study.solver.method == "reaction":
        results = [results[0] - results[1], results[2] - results[3]]
    upper, zero = results
    rings = study.array.rings if columns else 0
    modes = _arrange(rings, zero, upper, highest)
    return _superpose(study, modes, points, where)


def _task(
    study: Study, mesh: VerifiedMesh, meridian: Floats, span: tuple[int, int], vacuum: bool,
    columns: bool, workshop: Workshop,
) -> Task:
    rings = study.array.rings if columns else 0
    count = (1 + 2 * rings) if span == (0, 0) else (span[1] - span[0] + 1) * (2 + 3 * rings)

    def stage(folder: Path) -> Job:
        text = resources.files("halbach_fe.pro").joinpath(PROBLEM).read_bytes()
        (folder / PROBLEM).write_bytes(text)
        case = render("case_modes.pro.j2", study=study, regions=mesh.regions,
                      points=meridian.tolist())
        (folder / "case.pro").write_text(case, encoding="utf-8")
        (folder / mesh.path.name).write_bytes(mesh.path.read_bytes())
        return Job(
            problem=PROBLEM, mesh=mesh.path.name, resolution="Modes", outputs=(OUTPUT,),
            numbers={"VACUUM": vacuum, "FIRST_MODE": span[0], "LAST_MODE": span[1],
                     "COLUMNS": columns},
            unknowns=mesh.inner_nodes - (mesh.axis_nodes if span[0] > 0 else 0),
            solves=count, time_limit_s=workshop.time_limit_s)

    return Task(
        name=f"getdp-{'vacuum' if vacuum else 'real'}-mode{span[0]}", stage=stage,
        read=lambda folder: runner.read_vectors(folder / OUTPUT, meridian, count), solves=count)


def _arrange(rings: int, zero: Floats, upper: Floats, highest: int) -> ModeGradients:
    """Sort the solves of mode 0 and of the others by mode, component and ring."""
    points = zero.shape[1]
    by_ring = np.zeros((highest + 1, 3, rings, points, 3))
    together = np.zeros((highest + 1, 2, points, 3))
    together[0, 0] = zero[0]
    by_ring[0, [0, 2]] = zero[1:].reshape(2, rings, points, 3)  # nothing across the middle
    upper = upper.reshape(highest, 2 + 3 * rings, points, 3)
    together[1:] = upper[:, :2]
    by_ring[1:] = upper[:, 2:].reshape(highest, 3, rings, points, 3)
    return ModeGradients(by_ring, together)


def _superpose(
    study: Study, modes: ModeGradients, points: Floats, where: np.ndarray[tuple[int], np.dtype[
        np.intp]],
) -> Floats:
    """Sum modes, turned to every block's place, into fields at the points."""
    array, count = study.array, len(points)
    phi = np.arctan2(points[:, 1], points[:, 0])
    rings, slots = modes.rings.shape[2], array.blocks_per_ring
    result = np.zeros((1 + 3 * rings * slots, count, 3))
    columns = result[1:].reshape(rings, slots, 3, count, 3)
    remanence = blocks_of(study)[0].remanence
    for slot in range(1, slots + 1):
        middle = np.radians(position_angle_deg(array, slot))
        along, across, axial = _local_fields(modes.rings, phi - middle, where)
        together, together_across = _local_fields(modes.together, phi - middle, where)
        direction = np.radians(magnetization_angle_deg(array, slot)) - middle
        nominal = remanence * (np.cos(direction) * together
                               + np.sin(direction) * together_across)
        result[0] += _to_cartesian(nominal, phi)
        for axis, field in enumerate((np.cos(middle) * along - np.sin(middle) * across,
                                      np.sin(middle) * along + np.cos(middle) * across, axial)):
            columns[:, slot - 1, axis] = _to_cartesian(field, phi)
    return result


def _local_fields(
    gradients: Floats, theta: Floats, where: np.ndarray[tuple[int], np.dtype[np.intp]]
) -> list[Floats]:
    """B_r, B_theta, B_z of each component of the remanence, of a block at theta = 0.

    ``gradients`` is (modes, components, ..., meridian points, 3); fields are (..., points, 3).
    """
    fields = []
    for component in range(gradients.shape[1]):
        field = np.zeros((*gradients.shape[2:-2], len(theta), 3))
        for m in range(gradients.shape[0]):
            cosine, sine = np.cos(m * theta), np.sin(m * theta)
            even, derivative = (sine, m * cosine) if component == 1 else (cosine, -m * sine)
            wave = np.column_stack([even, derivative, even])
            field -= gradients[m, component][..., where, :] * wave  # B = -grad psi
        fields.append(field)
    return fields


def _to_cartesian(field: Floats, phi: Floats) -> Floats:
    """Turn (..., n, 3) from B_r, B_theta, B_z to B_x, B_y, B_z."""
    cosine, sine = np.cos(phi), np.sin(phi)
    radial, tangential = field[..., 0], field[..., 1]
    return np.stack([radial * cosine - tangential * sine, radial * sine + tangential * cosine,
                     field[..., 2]], axis=-1)

