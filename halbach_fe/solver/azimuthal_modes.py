"""Fields of rotationally symmetric materials, one azimuthal mode at a time.

Where recoil permeability and iron do not depend on the angle, the 3D problem of one block splits
into one small (r, z) problem per mode m (see pro/azimuthal_modes.pro), and all blocks of a ring
share it by rotation. Seconds to minutes where 3D meshes take minutes to hours, and more exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from halbach_fe import pro
from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.files import make_folder
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.solver.dofs import read_solutions, read_unknowns
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.interpolation import (
    Located,
    apply_operator,
    compare_printed,
    coordinates,
    locate,
    nodal_operators,
    probes_of,
)
from halbach_fe.solver.magnetostatics import SOLUTIONS_FILE, check_inside, render
from halbach_fe.solver.mesh import (
    CountedMesh,
    Entities,
    VerifiedMesh,
    build_meridian,
    count_mesh,
    verify_mesh,
)
from halbach_fe.solver.runs import Task, run_tasks
from halbach_fe.solver.session import RunSize, Session

PROBLEM = "azimuthal_modes.pro"
OUTPUT = "gradients.txt"
NOMINAL_SOURCES = 2
"""Cosine and sine part of the nominal array."""

MODE_TOLERANCE = 1e-4
"""Modes fall as (r / inner radius)^m. What is left out of one block's reaction, itself a few per
cent of its field, is below 1e-5 of that field."""

SOLVED_NUMBERS = 2**28
"""In the solutions of one run, 2 GB on the disk until they are read."""

MAX_MODES = 64
AXIS_RADIUS = 1e-8
"""Points nearer to the axis than this fraction of the bore are on it, where psi/r is a limit."""

NO_REMANENCE = 1e-12
"""Of the largest mode: a mode of the nominal array below it is excluded by symmetry."""


def is_axisymmetric(magnet: Magnet, points: Floats) -> bool:
    """Tell whether materials are rotationally symmetric and the points need few modes."""
    block = magnet.array.block
    if magnet.dimension != 3 or block.shape != "sector" or block.angular_gap_deg:
        return False
    if magnet.is_nonlinear or not all(block.isotropic for block in magnet.blocks):
        return False
    permeability = np.array([b.recoil_permeability for b in magnet.blocks])
    by_ring = permeability.reshape(magnet.array.rings, -1)
    return bool((by_ring == by_ring[:, :1]).all()) and modes_needed(magnet, points) <= MAX_MODES


def modes_needed(magnet: Magnet, points: Floats) -> int:
    """Highest mode that matters at any of the points (n, 3)."""
    worst = float(np.clip(mode_decay(magnet, points).max(), 1e-9, 1 - 1e-9))
    return max(1, int(np.ceil(np.log(MODE_TOLERANCE) / np.log(worst))))


def mode_decay(magnet: Magnet, points: Floats) -> Floats:
    """Factor (n,) by which the field at each point falls from one mode to the next."""
    array = magnet.array
    r, z = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    beyond = np.maximum(z - magnet.array_half_length, 0)
    # decay per mode: r/ri in the bore, ro/r outside, and with the distance beyond the ends
    decay = np.where(r < array.inner_radius_m, r / array.inner_radius_m,
                     np.where(r > array.outer_radius_m, array.outer_radius_m / np.maximum(r, 1e-9),
                              np.exp(-beyond / array.outer_radius_m)))
    return np.asarray(decay)


@dataclass(frozen=True)
class _Ring:
    """What case_modes.pro.j2 says of a ring; see there."""

    recoil_permeability: float
    rank: int
    along: list[float]
    across: list[float]
    axial: list[float]


@dataclass(frozen=True)
class _Case:
    """What all runs of a study have in common.

    Attributes
    ----------
    weights : ndarray
        Of the nominal array, see `nominal_waves`.
    solved : tuple of int
        Rings, from 0, of the blocks that are solved for.
    meridian : ndarray, shape (m, 3), in m
        Points (r, z, 0) of the half-plane where fields are wanted.
    """

    magnet: Magnet
    mesh: VerifiedMesh | CountedMesh
    weights: Floats
    solved: tuple[int, ...]
    meridian: Floats

    @property
    def real_mesh(self) -> VerifiedMesh:
        """The mesh; one that is only counted cannot be solved on."""
        assert isinstance(self.mesh, VerifiedMesh)
        return self.mesh

    @cached_property
    def located(self) -> Located:
        """Elements of the points."""
        return locate(self.real_mesh, self.meridian)

    @cached_property
    def probes(self) -> tuple[Located, Floats]:
        """Some of the points and their places, where GetDP prints what is compared."""
        return probes_of(self.real_mesh, self.located)

    @property
    def last_source(self) -> int:
        return NOMINAL_SOURCES - 1 + 3 * len(self.solved)


def solve_modes(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session
) -> Floats:
    """Finite-element part of the field of the nominal array and of single blocks, as
    `halbach_fe.solver.magnetostatics.solve_sources` returns it: the reaction, or B itself, by the
    study's method.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks to solve for with 1 T along x, y and z. Blocks of one ring
        cost no more than one.

    Returns
    -------
    ndarray, shape (1 + 3 len(blocks), n, 3), in T
    """
    array = magnet.array
    r = np.hypot(points[:, 0], points[:, 1])
    r[r < AXIS_RADIUS * array.inner_radius_m] = 0.0
    meridian, where = unique_points(np.column_stack([r, points[:, 2], 0 * r]))
    highest = modes_needed(magnet, points)
    mesh: VerifiedMesh | CountedMesh
    if session.counter is None:
        mesh = verify_mesh(build_meridian(magnet, make_folder(session.folder)))
    else:
        mesh = count_mesh(magnet, "meridian")
    check_inside(magnet.name, mesh.radius, mesh.half_length, points)
    solved = tuple(sorted({number // array.blocks_per_ring for number in blocks}))
    weights = nominal_waves(magnet, highest)
    case = _Case(magnet, mesh, weights, solved, meridian)
    spans = spans_of(weights, bool(blocks),
                     case.last_source * unknowns_of(mesh.inner, mesh.axis, 1))
    variants = [False] if magnet.study.solver.method == "direct" else [False, True]
    tasks = [_task(case, span, vacuum, session)
             for span in reversed(spans) for vacuum in variants]
    results = run_tasks(tasks, session)
    if session.counter is not None:
        return np.zeros((1 + 3 * len(blocks), len(points), 3))
    if len(variants) == 2:
        results = [real - vacuum for real, vacuum in zip(results[::2], results[1::2], strict=True)]
    modes = dict(zip([m for span in reversed(spans) for m in range(span[0], span[1] + 1)],
                     np.concatenate(results), strict=True))
    for m, gradient in modes.items():
        _limit_on_axis(m, gradient, meridian[:, 0] == 0)
    return _superpose(case, modes, points, where, blocks)


def spans_of(weights: Floats, all_modes: bool, each: int) -> list[tuple[int, int]]:
    """First and last mode of every run, by the `nominal_waves`; all modes for single blocks, or
    only those of the nominal array. A mode's solutions are ``each`` numbers.
    """
    size = np.abs(weights).max(axis=(1, 2, 3))
    wanted = [m for m in range(len(weights)) if all_modes or size[m] > NO_REMANENCE * size.max()]
    # mode 0 has another condition on the axis, so it is a run of its own
    return [span for first in (True, False)
            for span in _runs([m for m in wanted if (m == 0) == first],
                              max(1, SOLVED_NUMBERS // each))]


def _runs(modes: Sequence[int], most: int) -> list[tuple[int, int]]:
    """Spans (first, last) of consecutive modes, at most so many in each."""
    found = []
    for _, group in groupby(enumerate(modes), lambda pair: pair[1] - pair[0]):
        span = [mode for _, mode in group]
        found += [(part[0], part[-1]) for part in (
            span[first:first + most] for first in range(0, len(span), most))]
    return found


def nominal_waves(magnet: Magnet, highest: int) -> Floats:
    """Nominal remanence as waves, (modes, 2, rings, 3) in T: by what goes into cos(m theta) and
    sin(m theta), ring, and along or across the blocks' middles, or along z.

    A block at angle t with remanence A along and C across its middle, and Z along z, has the
    potential (A psi_along + Z psi_axial) cos(m (theta - t)) + C psi_across sin(m (theta - t)).
    """
    m = np.arange(highest + 1)
    found = np.zeros((highest + 1, 2, magnet.array.rings, 3))
    for block in magnet.blocks:
        middle = _middle(magnet, block)
        x, y, axial = block.remanence * np.array(block.easy_axis)
        along = np.cos(middle) * x + np.sin(middle) * y
        across = np.cos(middle) * y - np.sin(middle) * x
        cosine, sine = np.cos(m * middle), np.sin(m * middle)
        found[:, 0, block.ring - 1] += np.column_stack(
            [along * cosine, -across * sine, axial * cosine])
        found[:, 1, block.ring - 1] += np.column_stack(
            [along * sine, across * cosine, axial * sine])
    # a remanence across the middle, the same all round, has no charges; and there is no sin(0)
    found[0, 1] = 0
    found[0, :, :, 1] = 0
    return found


def _middle(magnet: Magnet, block: MagnetBlock) -> float:
    return float(np.radians(position_angle_deg(magnet.array, block.slot)))


def _rings(case: _Case) -> list[_Ring]:
    blocks = case.magnet.blocks[::case.magnet.array.blocks_per_ring]
    return [_Ring(block.recoil_permeability,
                  case.solved.index(ring) + 1 if ring in case.solved else 0,
                  *(case.weights[:, :, ring, component].ravel().tolist()
                    for component in range(3)))
            for ring, block in enumerate(blocks)]


def _task(case: _Case, span: tuple[int, int], vacuum: bool, session: Session) -> Task:
    modes, sources = span[1] - span[0] + 1, case.last_source + 1

    # one whose field does not vanish: a block's, or the larger part of the nominal array
    printed = case.last_source if case.solved else int(
        np.argmax(np.abs(case.weights[span[0]]).max(axis=(1, 2))))

    def stage_run(folder: Path) -> Job:
        return fill_run_folder(case, folder, span, (0, case.last_source), printed, vacuum,
                     session.time_limit_s)

    def read(folder: Path) -> Floats:
        return read_run(case, folder, modes, sources, printed)

    return Task(name=f"getdp-{'vacuum' if vacuum else 'real'}-mode{span[0]}", stage=stage_run,
                read=read, shape=(modes, sources, len(case.meridian), 3), solves=modes * sources,
                size=RunSize("azimuthal_modes", case.mesh.elements,
                             unknowns_of(case.mesh.inner, case.mesh.axis, span[0]),
                             modes * sources, matrices=modes))


def fill_run_folder(
    case: _Case, folder: Path, span: tuple[int, int], sources: tuple[int, int], printed: int,
    vacuum: bool, time_limit_s: float,
) -> Job:
    """Fill a run folder, and return the job to run there.

    ``span`` and ``sources`` are the first and last mode and source, ``printed`` the source that
    GetDP prints in the first mode.
    """
    problem = resources.files(pro).joinpath(PROBLEM).read_bytes()
    (folder / PROBLEM).write_bytes(problem)
    text = render("case_modes.pro.j2", magnet=case.magnet, regions=case.real_mesh.regions,
                  points=case.probes[1].tolist(), rings=_rings(case),
                  solved=max(1, len(case.solved)))
    (folder / "case.pro").write_text(text, encoding="utf-8")
    (folder / case.real_mesh.path.name).write_bytes(case.real_mesh.path.read_bytes())
    return Job(
        problem=PROBLEM, mesh=case.real_mesh.path.name, resolution="Modes", outputs=(OUTPUT,),
        solutions=SOLUTIONS_FILE,
        numbers={"VACUUM": vacuum, "FIRST_MODE": span[0], "LAST_MODE": span[1],
                 "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1],
                 "PRINTED_SOURCE": printed},
        unknowns=unknowns_of(case.mesh.inner, case.mesh.axis, span[0]),
        solves=(span[1] - span[0] + 1) * (sources[1] - sources[0] + 1), time_limit_s=time_limit_s)


def unknowns_of(inner: Entities, axis: Entities, mode: int) -> int:
    """How many unknowns a mode has, by what the mesh has off the boundary, and on the axis."""
    everywhere, fixed = (one.nodes + one.edges + one.faces for one in (inner, axis))
    return everywhere - (fixed if mode > 0 else 0)


def read_run(case: _Case, folder: Path, modes: int, sources: int, printed: int) -> Floats:
    """d psi/dr, psi/r and d psi/dz of a run's solutions, (modes, sources, points, 3)."""
    unknowns = read_unknowns(folder / f"{Path(PROBLEM).stem}.pre", case.real_mesh.cell_type)
    solutions = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, modes * sources)

    def gradients(located: Located, chosen: NDArray[np.floating]) -> Floats:
        value, (along_r, along_z) = nodal_operators(case.real_mesh, located, unknowns)
        r = coordinates(case.real_mesh, located)[:, 0]
        r[r < AXIS_RADIUS * case.magnet.array.inner_radius_m] = np.inf  # see _limit_on_axis
        return np.stack([apply_operator(along_r, chosen), apply_operator(value, chosen) / r,
                         apply_operator(along_z, chosen)], axis=2)

    probes, places = case.probes
    compare_printed(gradients(probes, solutions[printed:printed + 1])[0], folder / OUTPUT, places)
    result = gradients(case.located, solutions)
    return result.reshape(modes, sources, *result.shape[1:])


def _limit_on_axis(m: int, gradient: Floats, on_axis: NDArray[np.bool_]) -> None:
    """Put what d psi/dr, psi/r, d psi/dz (..., points, 3) are on the axis: psi is like r^m there,
    and elements are not.
    """
    if m == 1:
        gradient[..., on_axis, 1] = gradient[..., on_axis, 0]
        gradient[..., on_axis, 2] = 0
    else:
        gradient[..., on_axis, :2] = 0
        if m > 1:
            gradient[..., on_axis, 2] = 0


def _superpose(
    case: _Case, modes: dict[int, Floats], points: Floats, where: Ints, blocks: Sequence[int]
) -> Floats:
    """Sum modes into the fields at the points, each block turned to its place."""
    phi = np.arctan2(points[:, 1], points[:, 0])
    everything = case.magnet.blocks
    result = np.zeros((1 + 3 * len(blocks), len(points), 3))
    for part in range(NOMINAL_SOURCES):
        result[0] += _field({m: g[part, where] for m, g in modes.items()}, phi, sine=part == 1)
    rings = len(case.solved)
    for number, block in enumerate(blocks):
        middle = _middle(case.magnet, everything[block])
        rank = case.solved.index(everything[block].ring - 1)
        along, across, axial = (
            _field({m: g[NOMINAL_SOURCES + component * rings + rank, where]
                    for m, g in modes.items()}, phi - middle, sine=component == 1)
            for component in range(3))
        result[1 + 3 * number] = np.cos(middle) * along - np.sin(middle) * across
        result[2 + 3 * number] = np.sin(middle) * along + np.cos(middle) * across
        result[3 + 3 * number] = axial
    return _to_cartesian(result, phi)


def _field(gradients: dict[int, Floats], theta: Floats, sine: bool) -> Floats:
    """B_r, B_theta, B_z (n, 3) of a potential in cos(m theta), or sin(m theta), from its
    gradients (n, 3) by mode.
    """
    field = np.zeros((len(theta), 3))
    for m, gradient in gradients.items():
        cos, sin = np.cos(m * theta), np.sin(m * theta)
        even, derivative = (sin, m * cos) if sine else (cos, -m * sin)
        field -= gradient * np.column_stack([even, derivative, even])  # B = -grad psi
    return field


def _to_cartesian(field: Floats, phi: Floats) -> Floats:
    """Turn (..., n, 3) from B_r, B_theta, B_z to B_x, B_y, B_z."""
    cosine, sine = np.cos(phi), np.sin(phi)
    radial, tangential = field[..., 0], field[..., 1]
    return np.stack([radial * cosine - tangential * sine, radial * sine + tangential * cosine,
                     field[..., 2]], axis=-1)
