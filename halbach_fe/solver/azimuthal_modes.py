"""Magnetostatics of rotationally symmetric materials, one azimuthal mode at a time.

The unknown is the scalar potential psi = mu_0 phi in T m (H = -grad phi), and div B = 0 is solved
in weak form with B = -mu_r grad psi + B_r. Where recoil permeability and iron do not depend on the
angle, the modes cos(m theta) and sin(m theta) of psi are not coupled. The 3D problem of one block
then splits into one problem per mode m in the (r, z) half-plane, on rectangles of second order:

    w int mu_r (grad psi_m . grad v + m^2/r^2 psi_m v) r dr dz = int (P . grad v + Q/r v) r dr dz,

with w = 2 pi for m = 0 and pi otherwise, and P and Q integrals of the block's remanence over its
angle; pro/azimuthal_modes.pro derives them. psi_m = 0 on the outer boundary, and on the axis for
m > 0; mode 0 has no condition on the axis.

All blocks of a ring share the solutions by rotation. This takes seconds to minutes where 3D meshes
take minutes to hours, and is more accurate.

The runs for single blocks depend on shapes and materials only, neither on how the blocks are
magnetized nor, as long as they need as many modes, on the points. A cache therefore has them when
only those have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe import pro
from halbach_fe.core.arrays import Bools, Floats, Ints, azimuths_of, radii_of, slices
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.solver.getdp import DIRECT_SOLVER_OF_PLANE, Job
from halbach_fe.solver.getdp_files import read_solutions, read_unknowns
from halbach_fe.solver.interpolation import (
    Located,
    apply_operator,
    compare_printed,
    coordinates,
    grid_operators,
    locate,
    nodal_operators,
    probes_of,
)
from halbach_fe.solver.magnetostatics import SOLUTIONS_FILE, open_mesh, render, variants_of
from halbach_fe.solver.mesh import Entities, MeshedCase
from halbach_fe.solver.session import RunSize, Session, Task, run_tasks

PROBLEM = "azimuthal_modes.pro"
OUTPUT = "gradients.txt"
NOMINAL = 0, 1
"""First and last source of the nominal array in every mode: its cosine part and its sine part."""

MODE_TOLERANCE = 1e-4
"""Modes are solved for until their decay, (r / inner radius)^m in the bore, is below this value.
The truncation error of one block's reaction, itself a few per cent of the block's field, is then
below 1e-5 of that field."""

SOLVED_NUMBERS = 2**28
"""Largest number of values in the solutions of one run. They take 2 GB on the disk until they are
read."""

SHARED_UNKNOWNS = 100_000
"""Largest number of unknowns of the nominal array's modes that share a run of GetDP. It takes 0.2 s
to start, as long as a mode of 10 000 unknowns. Large modes are runs of their own, side by side."""

AXIS_RADIUS = 1e-8
"""Points nearer to the axis than this fraction of the inner radius count as points on the axis,
where psi/r is a limit."""

NO_WAVES = [0.0, 0.0]
"""Nominal remanence of a ring in runs for single blocks, which do not use it: as few values as
GetDP's lists can have."""


def is_axisymmetric(magnet: Magnet) -> bool:
    """Tell whether the materials are rotationally symmetric.

    The magnet must be 3D, of sectors without angular gaps and of one isotropic permeability in each
    ring, with linear iron or none.
    """
    if magnet.dimension != 3 or magnet.is_nonlinear or magnet.array.free_blocks is not None:
        return False
    if not (magnet.iron_is_axisymmetric and magnet.iron_is_along_z) or not all(
            block.isotropic for block in magnet.blocks):
        return False
    shapes = [ring.block or magnet.array.block for ring in magnet.array.ring] or [
        magnet.array.block]
    if any(shape.shape != "sector" or shape.angular_gap_deg for shape in shapes):
        return False
    permeability = magnet.by_ring(np.array([b.recoil_permeability for b in magnet.blocks]))
    alike = np.nanmax(permeability, axis=1) == np.nanmin(permeability, axis=1)
    return bool(alike.all())


def few_modes_suffice(magnet: Magnet, points: Floats) -> Bools:
    """Tell at which points (n, 3) in m at most 64 modes matter, if the route applies."""
    if not is_axisymmetric(magnet):
        return np.zeros(len(points), bool)
    # highest mode up to which this route applies; points close to the blocks need more modes
    most_modes = 64
    return np.asarray(mode_decay(magnet, points) <= MODE_TOLERANCE ** (1 / most_modes))


def modes_needed(magnet: Magnet, points: Floats) -> int:
    """Return the highest mode that matters at any of the points (n, 3) in m.

    Above 4 it is a multiple of 4, so that points that move a little are served by the same runs.
    """
    worst = float(np.clip(mode_decay(magnet, points).max(), 1e-9, 1 - 1e-9))
    highest = max(1, int(np.ceil(np.log(MODE_TOLERANCE) / np.log(worst))))
    alike = 4  # modes
    return highest if highest <= alike else alike * -(-highest // alike)


def mode_decay(magnet: Magnet, points: Floats) -> Floats:
    """Return the factor (n,) by which the field at each point falls from one mode to the next.

    The potential of mode m of a charged circle of radius s, at a distance dz along the axis, is
    proportional to the Legendre function Q_(m-1/2)(x) with x = (r^2 + s^2 + dz^2) / (2 r s)
    (H. S. Cohl and J. E. Tohline, Astrophys. J. 527 (1999) 86). It falls by exp(-arcosh x) from one
    mode to the next: by r/s inside the circle in its plane. The nearest circle of each ring counts.
    """
    r = np.maximum(radii_of(points), 1e-9)
    decay = np.zeros(len(points))
    for (low, high), (inner, outer) in magnet.ring_sections:
        distance = np.maximum(np.maximum(low - points[:, 2], points[:, 2] - high), 0)
        source = np.clip(np.hypot(r, distance), inner, outer)
        x = (r**2 + source**2 + distance**2) / (2 * r * source)
        decay = np.maximum(decay, x - np.sqrt(np.maximum(x**2 - 1, 0)))
    return decay


@dataclass(frozen=True)
class _Ring:
    """Data of one ring for the template case_modes.pro.j2, which describes them."""

    recoil_permeability: float
    half_angle: float
    """Half the angle of a block. In rad."""
    rank: int
    """Number, from 1, among the rings whose blocks are sources of their own; 0 for other rings, and
    in runs for the nominal array."""
    along: list[float]
    across: list[float]
    axial: list[float]
    """Nominal remanence along the blocks' middles, across them and along z: its cosine and sine
    part in mode 0, then in mode 1, and so on (see `nominal_waves`); `NO_WAVES` in runs for single
    blocks. In T."""


@dataclass(frozen=True)
class ModesCase(MeshedCase):
    """The data that all runs for a magnet share; the mesh is that of the (r, z) half-plane."""

    weights: Floats
    """Remanence of the nominal array, see `nominal_waves`. Shape (modes, 2, rings, 3), in T."""
    solved: tuple[int, ...]
    """Numbers, from 0, of the rings that hold the blocks to solve for."""
    meridian: Floats
    """Points (r, z, 0) of the half-plane at which fields are evaluated. Shape (m, 3), in m."""

    @cached_property
    def located(self) -> Located:
        """The elements that hold the points, and the points' coordinates in them."""
        return locate(self.real_mesh, self.meridian)

    @cached_property
    def probes(self) -> tuple[Located, Floats]:
        """Probes (p, 3) in m where GetDP prints gradients, to check our own evaluation.

        They do not depend on the points, so that a run serves other points too.
        """
        return probes_of(self.real_mesh, np.flatnonzero(self.real_mesh.in_air))

    @property
    def single(self) -> tuple[int, int]:
        """First and last source of single blocks: three per solved ring."""
        return NOMINAL[1] + 1, NOMINAL[1] + 3 * len(self.solved)


SingleBlocks = Callable[[ModesCase, Session], dict[int, Floats]]
"""A function that returns, by mode, d psi/dr, psi/r and d psi/dz (3 solved rings, points, 3) in T
of single blocks: what they add to those in vacuum or, for the method ``direct``, all of it."""


def meridian_points(magnet: Magnet, points: Floats) -> Floats:
    """Return (r, z, 0) of points (n, 3) in m; those beside the axis are moved onto it."""
    r = radii_of(points)
    r[r < AXIS_RADIUS * magnet.bore_radius] = 0.0
    return np.column_stack([r, points[:, 2], 0 * r])


def solve_modes(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
    highest: int | None = None, single_blocks: SingleBlocks | None = None,
) -> Floats:
    """Return the finite-element part of B of the nominal array and of single blocks, mode by mode.

    The result has the form of `halbach_fe.solver.magnetostatics.solve_sources`. For the method
    ``direct`` it is B itself. For ``reaction`` it is the difference of two solves on one mesh, real
    materials minus vacuum, to be added to the exact field in vacuum.

    Parameters
    ----------
    magnet : Magnet
        Must satisfy `is_axisymmetric`.
    points : ndarray, shape (n, 3), in m
        In air.
    blocks : sequence of int
        Numbers, from 0, of the blocks to solve for with a remanence of 1 T along x, y and z. Since
        the blocks of a ring share their solutions, more blocks of the same ring cost nothing more.
    highest : int, optional
        The highest mode, by default `modes_needed`.
    single_blocks : callable, optional
        Computes the gradients of single blocks in another way than by a solve for each.

    Returns
    -------
    ndarray, shape (1 + 3 len(blocks), n, 3), in T
        The nominal array, then block by block, axis by axis.
    """
    meridian, where = unique_points(meridian_points(magnet, points))
    highest = modes_needed(magnet, points) if highest is None else highest
    mesh = open_mesh(magnet, points, session, "meridian")
    solved = tuple(sorted({magnet.blocks[number].ring - 1 for number in blocks}))
    weights = nominal_waves(magnet, highest)
    case = ModesCase(magnet, mesh, weights, solved, meridian)
    runs = runs_of(weights, unknowns_of(mesh.inner, mesh.axis, 1),
                   case.single if blocks and single_blocks is None else None)
    variants = variants_of(magnet)
    results = iter(run_tasks([_task(case, modes, sources, vacuum, session)
                              for modes, sources in runs for vacuum in variants], session))
    known = single_blocks(case, session) if blocks and single_blocks is not None else {}
    if session.counter is not None:
        return np.zeros((1 + 3 * len(blocks), len(points), 3))
    for m, gradient in known.items():
        _limit_on_axis(m, gradient, meridian[:, 0] == 0)
    found: dict[tuple[int, int], dict[int, Floats]] = {NOMINAL: {}, case.single: known}
    for modes, sources in runs:
        gradients = next(results)
        if len(variants) == 2:
            gradients = gradients - next(results)
        for m, gradient in zip(modes, gradients, strict=True):
            _limit_on_axis(m, gradient, meridian[:, 0] == 0)
            found[sources][m] = gradient
    return _superpose(case, found[NOMINAL], found[case.single], points, where, blocks)


def runs_of(
    weights: Floats, unknowns: int, single: tuple[int, int] | None = None
) -> list[tuple[list[int], tuple[int, int]]]:
    """Return modes, and first and last source, of every run of GetDP: those for single blocks,
    which take longest, first.

    Parameters
    ----------
    weights : ndarray, shape (modes, 2, rings, 3), in T
        Remanence of the nominal array, see `nominal_waves`.
    unknowns : int
        Of one mode. They limit the modes per run, see `SOLVED_NUMBERS` and `SHARED_UNKNOWNS`.
    single : (int, int), optional
        First and last source of single blocks, to solve for them too. They have all modes, and the
        nominal array has few.
    """
    size = np.abs(weights).max(axis=(1, 2, 3))
    # tolerance relative to the largest mode: the symmetry of the nominal array excludes modes whose
    # remanence is smaller, which are rounding errors and are not solved for
    no_remanence = 1e-12
    own = np.flatnonzero(size > no_remanence * size.max()).tolist()
    runs = []
    if single is not None:
        count = single[1] - single[0] + 1
        runs += [(modes, single) for modes in _shared_out(
            list(range(len(weights))), SOLVED_NUMBERS // (count * unknowns))]
    return runs + [(modes, NOMINAL) for modes in _shared_out(own, SHARED_UNKNOWNS // unknowns)]


def _shared_out(modes: list[int], most: int) -> list[list[int]]:
    """Return modes in parts of at most ``most``, and mode 0, if it is there, as the last part.

    Mode 0 has no boundary condition on the axis, unlike all others.
    """
    others, most = [m for m in modes if m > 0], max(1, most)
    return [others[part] for part in slices(len(others), most)] + [[m] for m in modes if m == 0]


def nominal_waves(magnet: Magnet, highest: int) -> Floats:
    """Return the nominal remanence by azimuthal mode.

    A block at angle t with remanence A along its middle, C across it and Z along z has in mode m
    the potential (A psi_along + Z psi_axial) cos(m (theta - t)) + C psi_across sin(m (theta - t)).
    The addition theorems split it into multiples of cos(m theta) and sin(m theta), which are summed
    over the blocks of each ring.

    Returns
    -------
    ndarray, shape (highest + 1, 2, rings, 3), in T
        ``[m, part, ring, component]``: part 0 belongs to cos(m theta) and part 1 to sin(m theta);
        component 0 is along the blocks' middles, 1 across them, 2 along z.
    """
    m = np.arange(highest + 1)
    waves = np.zeros((highest + 1, 2, len(magnet.blocks_by_ring), 3))
    for block in magnet.blocks:
        middle = _middle(magnet, block)
        x, y, axial = block.polarization
        along = np.cos(middle) * x + np.sin(middle) * y
        across = np.cos(middle) * y - np.sin(middle) * x
        cosine, sine = np.cos(m * middle), np.sin(m * middle)
        waves[:, 0, block.ring - 1] += np.column_stack(
            [along * cosine, -across * sine, axial * cosine])
        waves[:, 1, block.ring - 1] += np.column_stack(
            [along * sine, across * cosine, axial * sine])
    # mode 0: a purely azimuthal remanence, the same at all angles, has no divergence and so no
    # source; and the sine part vanishes, because sin(0 theta) = 0
    waves[0, 1] = 0
    waves[0, :, :, 1] = 0
    return waves


def _middle(magnet: Magnet, block: MagnetBlock) -> float:
    """Return the angle in rad of a block's middle."""
    return float(np.radians(block.angle_deg))


def _rings(case: ModesCase, sources: tuple[int, int]) -> list[_Ring]:
    """Return the data of all rings for the template of the problem, for some sources."""
    magnet = case.magnet
    blocks = [magnet.blocks[magnet.number_of(ring, 1)]
              for ring in range(1, len(magnet.blocks_by_ring) + 1)]
    numbered = () if sources == NOMINAL else case.solved
    return [_Ring(block.recoil_permeability, np.pi / magnet.blocks_by_ring[ring],
                  numbered.index(ring) + 1 if ring in numbered else 0,
                  *(case.weights[:, :, ring, component].ravel().tolist()
                    if sources == NOMINAL else NO_WAVES for component in range(3)))
            for ring, block in enumerate(blocks)]


def _task(
    case: ModesCase, modes: list[int], sources: tuple[int, int], vacuum: bool, session: Session
) -> Task:
    """Return the run of GetDP for some sources in some modes."""
    first, count = modes[0], sources[1] - sources[0] + 1

    # print a source whose field does not vanish, or the check of our evaluation would be empty: a
    # single block, or the larger part of the nominal array
    printed = sources[1] if sources == case.single else int(
        np.argmax(np.abs(case.weights[first]).max(axis=(1, 2))))

    def stage_run(folder: Path) -> Job:
        return fill_run_folder(case, folder, modes, sources, printed, vacuum,
                               session.time_limit_s)

    def read(folder: Path) -> Floats:
        return read_run(case, folder, len(modes), count, printed - sources[0])

    of = "-blocks" if sources == case.single else ""
    return Task(name=f"getdp-{'vacuum' if vacuum else 'real'}{of}-mode{first}", stage=stage_run,
                read=read, shape=(len(modes), count, len(case.meridian), 3),
                solves=len(modes) * count,
                size=RunSize("azimuthal_modes", case.mesh.elements,
                             unknowns_of(case.mesh.inner, case.mesh.axis, first),
                             len(modes) * count, matrices=len(modes)))


def fill_run_folder(
    case: ModesCase, folder: Path, modes: list[int], sources: tuple[int, int], printed: int,
    vacuum: bool, time_limit_s: float,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there.

    Parameters
    ----------
    folder : Path
        An existing folder.
    modes : list of int
        The modes to solve for, in order; mode 0 only alone.
    sources : tuple of int
        First and last source, both included; azimuthal_modes.pro numbers them.
    printed : int
        The source whose gradients GetDP prints, in the first mode.
    vacuum : bool
        Whether all materials are replaced by vacuum.
    """
    problem = resources.files(pro).joinpath(PROBLEM).read_bytes()
    (folder / PROBLEM).write_bytes(problem)
    text = render("case_modes.pro.j2", magnet=case.magnet, regions=case.real_mesh.regions,
                  points=case.probes[1].tolist(), rings=_rings(case, sources),
                  modes=modes, solved=1 if sources == NOMINAL else len(case.solved))
    (folder / "case.pro").write_text(text, encoding="utf-8")
    (folder / case.real_mesh.path.name).write_bytes(case.real_mesh.path.read_bytes())
    return Job(
        problem=PROBLEM, mesh=case.real_mesh.path.name, resolution="Modes", outputs=(OUTPUT,),
        solutions=SOLUTIONS_FILE,
        numbers={"VACUUM": vacuum, "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1],
                 "PRINTED_SOURCE": printed},
        unknowns=unknowns_of(case.mesh.inner, case.mesh.axis, modes[0]),
        options=DIRECT_SOLVER_OF_PLANE,
        solves=len(modes) * (sources[1] - sources[0] + 1), time_limit_s=time_limit_s)


def unknowns_of(inner: Entities, axis: Entities, mode: int) -> int:
    """Return the number of unknowns of a mode.

    The potential has one unknown per node, edge and face of the mesh, except on the outer boundary
    and, for m > 0, on the axis, where it is fixed to 0.

    Parameters
    ----------
    inner : Entities
        Off the outer boundary.
    axis : Entities
        Of these, those on the axis.
    """
    everywhere, fixed = (part.nodes + part.edges + part.faces for part in (inner, axis))
    return everywhere - (fixed if mode > 0 else 0)


def read_run(case: ModesCase, folder: Path, modes: int, sources: int, printed: int) -> Floats:
    """Return d psi/dr, psi/r and d psi/dz of all solutions of a run at the points.

    Returns
    -------
    ndarray, shape (modes, sources, points, 3), in T
        The values on the axis are placeholders until `_limit_on_axis` sets them.

    Raises
    ------
    GetDPError
        If the files are damaged, or if our evaluation differs from what GetDP printed for the
        source ``printed``, counted from the first source of the run.
    """
    unknowns = read_unknowns(folder / f"{Path(PROBLEM).stem}.pre", case.real_mesh.cell_type)
    solutions = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, modes * sources)

    def gradients(
        located: Located, chosen: NDArray[np.floating],
        operators: Callable[..., tuple[sparse.csr_array, list[sparse.csr_array]]],
    ) -> Floats:
        value, (along_r, along_z) = operators(case.real_mesh, located, unknowns)
        r = coordinates(case.real_mesh, located)[:, 0]
        r[r < AXIS_RADIUS * case.magnet.bore_radius] = np.inf  # see _limit_on_axis
        return np.stack([apply_operator(along_r, chosen), apply_operator(value, chosen) / r,
                         apply_operator(along_z, chosen)], axis=2)

    probes, places = case.probes
    compare_printed(gradients(probes, solutions[printed:printed + 1], nodal_operators)[0],
                    folder / OUTPUT, places)
    result = gradients(case.located, solutions, grid_operators)
    return result.reshape(modes, sources, *result.shape[1:])


def _limit_on_axis(m: int, gradient: Floats, on_axis: Bools) -> None:
    """Replace d psi/dr, psi/r, d psi/dz (..., points, 3) on the axis by their limits, in place.

    Near the axis psi_m is proportional to r^m. The functions of the elements are not, so that their
    gradients on the axis are wrong; psi/r would even be 0/0.
    """
    if m == 1:
        gradient[..., on_axis, 1] = gradient[..., on_axis, 0]
        gradient[..., on_axis, 2] = 0
    else:
        gradient[..., on_axis, :2] = 0
        if m > 1:
            gradient[..., on_axis, 2] = 0


def _superpose(
    case: ModesCase, nominal: dict[int, Floats], single: dict[int, Floats], points: Floats,
    where: Ints, blocks: Sequence[int]
) -> Floats:
    """Sum the modes into B at the points, with each block rotated into its position.

    Parameters
    ----------
    nominal, single : dict of int to ndarray, shape (sources, m, 3), in T
        d psi/dr, psi/r and d psi/dz at the points of the half-plane, by mode, of the nominal
        array and of single blocks.
    points : ndarray, shape (n, 3), in m
    where : ndarray of int, shape (n,)
        Number of each point's (r, z) among the points of the half-plane.

    Returns
    -------
    ndarray, shape (1 + 3 len(blocks), n, 3), in T
        As `solve_modes` returns it.
    """
    phi = azimuths_of(points)
    everything = case.magnet.blocks
    result = np.zeros((1 + 3 * len(blocks), len(points), 3))
    for part in NOMINAL:
        result[0] += _field({m: g[part, where] for m, g in nominal.items()}, phi, sine=part == 1)
    rings = len(case.solved)
    for number, block in enumerate(blocks):
        middle = _middle(case.magnet, everything[block])
        rank = case.solved.index(everything[block].ring - 1)
        along, across, axial = (
            _field({m: g[component * rings + rank, where] for m, g in single.items()},
                   phi - middle, sine=component == 1)
            for component in range(3))
        result[1 + 3 * number] = np.cos(middle) * along - np.sin(middle) * across
        result[2 + 3 * number] = np.sin(middle) * along + np.cos(middle) * across
        result[3 + 3 * number] = axial
    return to_cartesian(result, phi)


def _field(gradients: dict[int, Floats], theta: Floats, sine: bool) -> Floats:
    """Return B_r, B_theta, B_z (n, 3) in T of a sum of modes, B = -grad psi.

    Parameters
    ----------
    gradients : dict of int to ndarray, shape (n, 3), in T
        d psi_m/dr, psi_m/r and d psi_m/dz, by mode m.
    theta : ndarray, shape (n,), in rad
    sine : bool
        Whether the potential is the sum of psi_m sin(m theta), or of psi_m cos(m theta).
    """
    field = np.zeros((len(theta), 3))
    for m, gradient in gradients.items():
        cos, sin = np.cos(m * theta), np.sin(m * theta)
        even, derivative = (sin, m * cos) if sine else (cos, -m * sin)
        field -= gradient * np.column_stack([even, derivative, even])
    return field


def to_cartesian(field: Floats, phi: Floats) -> Floats:
    """Convert B_r, B_theta, B_z (..., n, 3) at azimuths phi (n,) in rad to B_x, B_y, B_z."""
    cosine, sine = np.cos(phi), np.sin(phi)
    radial, tangential = field[..., 0], field[..., 1]
    return np.stack([radial * cosine - tangential * sine, radial * sine + tangential * cosine,
                     field[..., 2]], axis=-1)
