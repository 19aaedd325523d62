"""Which solver computes the field, and the field of the nominal magnet by it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.domain import (
    boundary_half_length,
    boundary_radius,
)
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import no_symmetry, symmetry_of
from halbach_fe.solver.azimuthal_modes import is_axisymmetric, solve_modes
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.formulations import (
    CROSS_SECTION,
    SCALAR_POTENTIAL,
    Formulation,
    edge_elements,
)
from halbach_fe.solver.magnetostatics import (
    nominal_samples,
    solve_samples,
    solve_sources,
    solve_tangent,
)
from halbach_fe.solver.session import Session
from halbach_fe.solver.vacuum_field import field_of

SUPERPOSITION_TOLERANCE = 1e-8
"""The problem is linear and the solver direct: what remains is rounding, about 1e-12; a wrong or
missing column shows at 1e-3."""

ITERATED_TOLERANCE = 1e-7
"""Conjugate gradients stop at 1e-10 of the residual; measured 1e-9 to 6e-9, on coarse meshes."""

PLACED_TOLERANCE = 0.1
"""Blocks placed by symmetry on a 3D mesh, which is not symmetric: what remains is the error of the
mesh. Measured, of what finite elements contribute, on meshes of 30 to 50 mm: 1 % to 8.5 % by the
scalar potential, 1 % to 4 % by edge elements of order 2. Without the mirror it was 30 % and more
by the scalar potential (8 % by edge elements on a coarse mesh with thin iron), turned the wrong way
or of the wrong sign mostly 100 % and more. A single wrong block among hundreds does not show."""

PLACED_TOLERANCE_LOWEST_ORDER = 0.5
"""The same for edge elements of order 1: measured 5 % (20 mm) to 35 % (50 mm). Only blocks of the
wrong sign or turned the wrong way, 100 % and more, are sure to show."""

MESHES = {"cross_section": "cross_section", "azimuthal_modes": "meridian",
          "edge_elements": "extruded", "scalar_potential": "extruded"}
"""Kind of mesh by route."""

BOUNDARY_NEAR = 0.5
"""Of the way from the magnet to the boundary: readings beyond it are warned of."""


@dataclass(frozen=True)
class ElementFields:
    """What finite elements contribute to B, by source.

    Attributes
    ----------
    superposition_tolerance : float
        How well blocks must add up to the nominal array, relative to the sum of the magnitudes of
        what finite elements contribute to each.
    nominal : ndarray, shape (n, 3), in T
        Of the whole array, solved for at once.
    along_nominal : ndarray, shape (n, 3), in T
        What ``sources`` must add up to: the same, or with non-linear iron the derivative of the
        field along the nominal magnetization.
    sources : tuple of MagnetBlock
        The blocks of the array that was solved for.
    block : callable
        Number of a block, from 0, and indices (k,) of some points, or a slice, to its contribution
        there (k, 3, D), in T per T of remanence along each axis. By symmetry several blocks share
        one solve.
    error : ndarray, shape (n, 3), in T, or None
        Of ``nominal``, where it is known already.
    """

    superposition_tolerance: float
    nominal: Floats
    along_nominal: Floats
    sources: tuple[MagnetBlock, ...]
    block: Callable[[int, Ints | slice], Floats]
    error: Floats | None = None

    @property
    def linearized(self) -> bool:
        """Whether blocks do not add up to the nominal array, but to what they change of it."""
        return self.nominal is not self.along_nominal


def solve_nominal(magnet: Magnet, points: Floats, session: Session) -> Floats:
    """Field of the nominal array at points (n, 3) in m, by the study's method; (n, 3) in T."""
    check_points(magnet, points)
    return vacuum_part(magnet, points) + finite_element_part(
        magnet, points, session, columns=False).nominal


def vacuum_part(magnet: Magnet, points: Floats) -> Floats:
    """What is not left to finite elements of the field with the nominal array, (n, 3) in T."""
    external = external_field(magnet, points)
    if magnet.study.solver.method == "direct":
        return external
    return external + field_of(magnet.blocks, points)


def is_vacuum(magnet: Magnet) -> bool:
    """Tell whether nothing reacts: the exact field is all there is."""
    return magnet.iron_ring is None and all(
        block.isotropic and block.recoil_permeability == 1.0 for block in magnet.blocks)


def finite_element_part(
    magnet: Magnet, points: Floats, session: Session, columns: bool = True
) -> ElementFields:
    """What finite elements contribute to B, by the route that suits.

    For the method ``direct`` that is B itself, for ``reaction`` the reaction of permeability and
    iron, to be added to the exact field in vacuum.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    columns : bool
        Whether single blocks are wanted too.
    """
    size = magnet.dimension
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        zero = np.zeros((len(points), 3))
        return ElementFields(SUPERPOSITION_TOLERANCE, zero, zero, magnet.blocks,
                             lambda number, some: np.zeros((len(points[some]), 3, size)))
    route = choose_route(magnet, points)
    if not columns:
        nominal = _solve_nominal(magnet, points, session, route)
        return ElementFields(np.nan, nominal, nominal, magnet.blocks, _not_solved)
    near = axisymmetric_stand_in(magnet, route, points)
    if near is not None:
        return _about(near, magnet, points, session)
    placed = uses_symmetry(magnet)
    symmetry = symmetry_of(magnet) if placed else no_symmetry(magnet)
    places, index = symmetry.source_points(points)
    if magnet.is_nonlinear:
        nominal, fields = solve_tangent(magnet, places, symmetry.sources, session,
                                        formulation_of(magnet, route))
    else:
        fields = _solve(magnet, places, symmetry.sources, session, route)
        nominal = fields[0]
    # the identity is among the placements: the first block is its own source, where it stands
    here = index[symmetry.sources[0]]

    def block(number: int, some: Ints | slice) -> Floats:
        placement = symmetry.images[number]
        first = 1 + size * symmetry.sources.index(placement.source)
        seen = np.moveaxis(fields[first:first + size, index[number][some]], 0, 2)
        return placement.from_source(seen)

    tangent = fields[0, here]
    return ElementFields(_superposition_tolerance(magnet, route, placed),
                         nominal[here] if magnet.is_nonlinear else tangent, tangent,
                         magnet.blocks, block)


def uses_symmetry(magnet: Magnet) -> bool:
    """Whether blocks are solved for by symmetry: in a cross-section there is little to save, and
    iron saturates where the field is.
    """
    return magnet.study.solver.symmetry and magnet.dimension == 3 and not magnet.is_nonlinear


def axisymmetric_stand_in(magnet: Magnet, route: str, points: Floats) -> Magnet | None:
    """The magnet `without_gaps`, if its single blocks can stand for those of the magnet; see
    `_about`.
    """
    near = without_gaps(magnet)
    chosen = magnet.study.solver.route == "auto" and route == "scalar_potential"
    return near if chosen and is_axisymmetric(near, points) else None


def without_gaps(magnet: Magnet) -> Magnet:
    """The magnet with blocks that are alike, without gaps between them."""
    array = magnet.array
    exceptions = tuple(one.with_(recoil_permeability=None, recoil_permeability_across=None)
        for one in array.exceptions)
    block = array.block
    if block.shape == "sector":
        block = block.with_(angular_gap_deg=0.0)
    return magnet.with_(
        array=array.with_(block=block, exceptions=exceptions, recoil_permeability_across=None))


def _about(
    near: Magnet, magnet: Magnet, points: Floats, session: Session
) -> ElementFields:
    """The nominal array on a 3D mesh, and single blocks as they react in a simpler array, which
    azimuthal modes can do.

    Blocks only stand for what magnetizations deviate from nominal, a per cent or so, and their
    reaction is some per cent of their field. What such a mesh is off is known of the simpler array,
    and taken to be the same here.
    """
    base = finite_element_part(near, points, session)
    nominal, same_mesh = (
        _solve_nominal(one, points, replace(session.within(name), purpose=purpose),
                       "scalar_potential")
        for one, name, purpose in ((magnet, "as-it-is", "the magnet on a 3D mesh"),
                                   (near, "simpler", "its axisymmetric stand-in on a 3D mesh")))
    return replace(base, nominal=nominal, error=same_mesh - base.nominal)


def _superposition_tolerance(magnet: Magnet, route: str, placed: bool) -> float:
    if placed and route == "edge_elements" and magnet.study.solver.edge_order == 1:
        return PLACED_TOLERANCE_LOWEST_ORDER
    if placed and route != "azimuthal_modes":  # whose mesh is symmetric
        return PLACED_TOLERANCE
    return ITERATED_TOLERANCE if route == "scalar_potential" else SUPERPOSITION_TOLERANCE


def _not_solved(number: int, some: Ints | slice) -> Floats:
    raise AssertionError(f"block {number} was not solved for")


def _solve(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session, route: str
) -> Floats:
    if route == "azimuthal_modes":
        return solve_modes(magnet, points, blocks, session)
    return solve_sources(magnet, points, blocks, session, formulation_of(magnet, route))


def _solve_nominal(magnet: Magnet, points: Floats, session: Session, route: str) -> Floats:
    if magnet.is_nonlinear:
        return solve_samples(magnet, points, nominal_samples(magnet), session,
                             formulation_of(magnet, route))[0]
    return _solve(magnet, points, (), session, route)[0]


def formulation_of(magnet: Magnet, route: str) -> Formulation:
    """What is solved on the mesh of a route."""
    return {"cross_section": CROSS_SECTION, "scalar_potential": SCALAR_POTENTIAL}.get(
        route) or edge_elements(magnet.study.solver.edge_order)


def choose_route(magnet: Magnet, points: Floats) -> str:
    """The study's route, or for ``auto`` the fastest that can do it.

    Raises
    ------
    StudyError
        If azimuthal modes are asked for where they do not apply.
    """
    if magnet.dimension == 2:
        return "cross_section"
    asked, symmetric = magnet.study.solver.route, is_axisymmetric(magnet, points)
    if asked == "azimuthal_modes" and not symmetric:
        raise StudyError(
            f"Input `solver.route` of study {magnet.name} must be another than "
            "azimuthal_modes here, which needs sectors without angular gaps, of one isotropic "
            "permeability in each ring, linear iron, and points that are not too near to the "
            "blocks. Leave it out.")
    if asked == "auto":
        if magnet.study.solver.method == "direct":
            return "edge_elements"
        return "azimuthal_modes" if symmetric else "scalar_potential"
    return asked


def check_points(
    magnet: Magnet, points: Floats, key: str = "observation.positions"
) -> None:
    """Refuse points inside magnet or iron, where the field is not what a probe can read; warn of
    points so near to the boundary that it shapes their field.
    """
    if magnet.dimension == 2 and np.ptp(points[:, 2]) > 0:
        raise StudyError(
            f"Input `{key}` of study {magnet.name} must lie in one plane, since it "
            f"is 2D; instead z goes from {points[:, 2].min():g} to {points[:, 2].max():g} m. Use "
            "one circle, or a 3D study.")
    inside = magnet.contains(points)
    if inside.any():
        x, y, z = points[np.argmax(inside)]
        raise StudyError(
            f"Input `{key}` of study {magnet.name} must lie in air; instead "
            f"{inside.sum()} of {len(points)} points lie inside magnet or iron, the first at "
            f"({x:g}, {y:g}, {z:g}) m. Move them into the bore or beyond the ends.")
    mesh = MESHES[choose_route(magnet, points)]
    ways = [(np.hypot(points[:, 0], points[:, 1]), magnet.radius,
             boundary_radius(magnet, mesh))]
    if magnet.dimension == 3:
        ways.append((np.abs(points[:, 2]), magnet.half_length,
                     boundary_half_length(magnet, mesh)))
    for position, end, boundary in ways:
        near = position > end + BOUNDARY_NEAR * (boundary - end)
        if near.any() and position.max() <= boundary:  # those beyond are refused
            x, y, z = points[np.argmax(near)]
            warnings.warn(
                f"{near.sum()} of {len(points)} points lie more than half-way from the magnet to "
                f"the boundary of the mesh, which shapes their field, the first at ({x:g}, {y:g}, "
                f"{z:g}) m. Enlarge `open_boundary` of study {magnet.name}.", HalbachWarning,
                stacklevel=2)
