"""Choice of the solver (the route), and the field of the nominal magnet and of single blocks.

The problem is magnetostatics without currents: curl H = 0 and div B = 0, with B = mu_0 mu_r H + B_r
in the blocks and a linear or non-linear law in the iron. Four routes solve it by finite elements:
``cross_section`` (2D, vector potential), ``azimuthal_modes`` (rotationally symmetric materials,
scalar potential), ``scalar_potential`` and ``edge_elements`` (3D, vector potential).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import no_symmetry, symmetry_of
from halbach_fe.solver.azimuthal_modes import is_axisymmetric, solve_modes
from halbach_fe.solver.exact_block_field import field_of
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

SUPERPOSITION_TOLERANCE = 1e-8
"""Relative tolerance of the check that single blocks add up to the nominal array, if a direct
solver is used. The problem is linear, so that only rounding errors of about 1e-12 remain; a wrong
or missing column makes a difference of 1e-3."""

ITERATED_TOLERANCE = 1e-7
"""The same tolerance for conjugate gradients, which stop at a relative residual of 1e-10. The
difference was measured to be 1e-9 to 6e-9 on coarse meshes."""

PLACED_TOLERANCE = 0.1
"""The same tolerance if the fields of some blocks are obtained from others by symmetry in 3D.

The mesh is not symmetric, so that its discretization error remains. On meshes of 30 to 50 mm this
error was measured to be 1 % to 8.5 % of the finite-element part for the scalar potential, and 1 %
to 4 % for edge elements of order 2. When the mirror image was left out on purpose, the difference
was 30 % and more for the scalar potential (8 % for edge elements on a coarse mesh with thin iron);
for blocks rotated the wrong way or of the wrong sign it was mostly 100 % and more. A single wrong
block among hundreds is not detected."""

PLACED_TOLERANCE_LOWEST_ORDER = 0.5
"""The same as `PLACED_TOLERANCE` for edge elements of order 1, whose error was measured to be 5 %
(20 mm) to 35 % (50 mm). Only blocks of the wrong sign or rotated the wrong way, which make a
difference of 100 % and more, are detected with certainty."""

MESHES = {"cross_section": "cross_section", "azimuthal_modes": "meridian",
          "edge_elements": "extruded", "scalar_potential": "extruded"}
"""Kind of mesh by route, a key of `halbach_fe.geometry.domain.BOUNDARY_RATIO`."""

BOUNDARY_NEAR = 0.5
"""Fraction of the way from the magnet to the outer boundary. Points farther out cause a warning,
because the condition on the boundary affects their field."""


@dataclass(frozen=True)
class ElementFields:
    """The finite-element part of B, for the nominal array and for every block.

    For the method ``reaction`` this is the reaction of permeability and iron, to be added to the
    exact field in vacuum; for ``direct`` it is B itself.

    Attributes
    ----------
    superposition_tolerance : float
        Largest accepted difference between ``along_nominal`` and the sum over the blocks, relative
        to the sum of the magnitudes of the blocks' finite-element parts.
    nominal : ndarray, shape (n, 3), in T
        The whole array, solved for at once.
    along_nominal : ndarray, shape (n, 3), in T
        The value to which the blocks must add up: ``nominal``, or with non-linear iron the
        derivative of the field along the nominal magnetization.
    sources : tuple of MagnetBlock
        The blocks of the array for which single blocks were solved. It may be a stand-in for the
        magnet, see `axisymmetric_stand_in`.
    block : callable
        Takes the number of a block, from 0, and indices (k,) of points or a slice. Returns the
        finite-element part (k, 3, D) of the block's B there in T per T of remanence along each of
        the D axes. By symmetry several blocks share one solve.
    error : ndarray, shape (n, 3), in T, or None
        Discretization error of ``nominal`` if the solve already yields it, else None.
    """

    superposition_tolerance: float
    nominal: Floats
    along_nominal: Floats
    sources: tuple[MagnetBlock, ...]
    block: Callable[[int, Ints | slice], Floats]
    error: Floats | None = None

    @property
    def linearized(self) -> bool:
        """Whether the blocks' parts are derivatives at the nominal array, with non-linear iron."""
        return self.nominal is not self.along_nominal


def solve_nominal(magnet: Magnet, points: Floats, session: Session) -> Floats:
    """Return B (n, 3) in T of the nominal array at points (n, 3) in m, by the study's method."""
    check_points(magnet, points)
    return vacuum_part(magnet, points) + finite_element_part(
        magnet, points, session, columns=False).nominal


def vacuum_part(magnet: Magnet, points: Floats) -> Floats:
    """Return the part of B (n, 3) in T of the nominal array that is known in closed form.

    That is the field of the external sources and, for the method ``reaction``, the exact field of
    the blocks in vacuum. The finite-element part adds to it.
    """
    external = external_field(magnet, points)
    if magnet.study.solver.method == "direct":
        return external
    return external + field_of(magnet.blocks, points)


def is_vacuum(magnet: Magnet) -> bool:
    """Tell whether all materials have the permeability of vacuum, so that the exact field is B."""
    return magnet.iron_ring is None and all(
        block.isotropic and block.recoil_permeability == 1.0 for block in magnet.blocks)


def finite_element_part(
    magnet: Magnet, points: Floats, session: Session, columns: bool = True
) -> ElementFields:
    """Compute the finite-element part of B by the route that `choose_route` returns.

    Parameters
    ----------
    magnet : Magnet
    points : ndarray, shape (n, 3), in m
        In air.
    session : Session
    columns : bool
        Whether to solve for single blocks too, the columns of the response matrix.
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
        return _with_axisymmetric_columns(near, magnet, points, session)
    placed = uses_symmetry(magnet)
    symmetry = symmetry_of(magnet) if placed else no_symmetry(magnet)
    places, index = symmetry.source_points(points)
    if magnet.is_nonlinear:
        nominal, fields = solve_tangent(magnet, places, symmetry.sources, session,
                                        formulation_of(magnet, route))
    else:
        fields = _solve(magnet, places, symmetry.sources, session, route)
        nominal = fields[0]
    # The first source is placed by the identity, so its source points are the points themselves.
    here = index[symmetry.sources[0]]

    def block(number: int, some: Ints | slice) -> Floats:
        placement = symmetry.images[number]
        first = 1 + size * symmetry.sources.index(placement.source)
        source_fields = np.moveaxis(fields[first:first + size, index[number][some]], 0, 2)
        return placement.from_source(source_fields)

    tangent = fields[0, here]
    return ElementFields(_superposition_tolerance(magnet, route, placed),
                         nominal[here] if magnet.is_nonlinear else tangent, tangent,
                         magnet.blocks, block)


def uses_symmetry(magnet: Magnet) -> bool:
    """Tell whether only some blocks are solved for, and the others obtained by symmetry.

    In a cross-section this would save little. Non-linear iron does not have the symmetry of the
    geometry, since its tangent depends on the field.
    """
    return magnet.study.solver.symmetry and magnet.dimension == 3 and not magnet.is_nonlinear


def axisymmetric_stand_in(magnet: Magnet, route: str, points: Floats) -> Magnet | None:
    """Return the magnet `without_gaps` if its single blocks can approximate those of the magnet.

    It must be axisymmetric although the magnet itself is not, and the route must have been chosen
    automatically. Otherwise return None. `_with_axisymmetric_columns` describes the approximation.
    """
    near = without_gaps(magnet)
    chosen = magnet.study.solver.route == "auto" and route == "scalar_potential"
    return near if chosen and is_axisymmetric(near, points) else None


def without_gaps(magnet: Magnet) -> Magnet:
    """Return the magnet with one isotropic permeability, and without gaps between sectors."""
    array = magnet.array
    exceptions = tuple(
        exception.with_(recoil_permeability=None, recoil_permeability_across=None)
        for exception in array.exceptions)
    block = array.block
    if block.shape == "sector":
        block = block.with_(angular_gap_deg=0.0)
    return magnet.with_(
        array=array.with_(block=block, exceptions=exceptions, recoil_permeability_across=None))


def _with_axisymmetric_columns(
    near: Magnet, magnet: Magnet, points: Floats, session: Session
) -> ElementFields:
    """Solve for the nominal array on a 3D mesh, and for single blocks in an axisymmetric stand-in.

    Azimuthal modes solve for the single blocks of ``near``. Single blocks only describe the
    deviations from the nominal magnetization, of the order of a per cent, and the reaction to a
    block is some per cent of its field, so that the difference between the two arrays matters
    little. The discretization error of the nominal array is taken from the stand-in, for which both
    the 3D mesh and the much more accurate azimuthal modes give a result.
    """
    base = finite_element_part(near, points, session)
    nominal, same_mesh = (
        _solve_nominal(array, points, replace(session.within(name), purpose=purpose),
                       "scalar_potential")
        for array, name, purpose in ((magnet, "as-it-is", "the magnet on a 3D mesh"),
                                   (near, "simpler", "its axisymmetric stand-in on a 3D mesh")))
    return replace(base, nominal=nominal, error=same_mesh - base.nominal)


def _superposition_tolerance(magnet: Magnet, route: str, placed: bool) -> float:
    """Return the tolerance that applies; ``placed`` tells whether symmetry places the blocks."""
    if placed and route == "edge_elements" and magnet.study.solver.edge_order == 1:
        return PLACED_TOLERANCE_LOWEST_ORDER
    if placed and route != "azimuthal_modes":  # the half-plane's mesh has the symmetry
        return PLACED_TOLERANCE
    return ITERATED_TOLERANCE if route == "scalar_potential" else SUPERPOSITION_TOLERANCE


def _not_solved(number: int, some: Ints | slice) -> Floats:
    """Take the place of `ElementFields.block` if only the nominal array was solved for."""
    raise AssertionError(f"block {number} was not solved for")


def _solve(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session, route: str
) -> Floats:
    """Solve a linear problem by a route; the result is that of `solve_sources`."""
    if route == "azimuthal_modes":
        return solve_modes(magnet, points, blocks, session)
    return solve_sources(magnet, points, blocks, session, formulation_of(magnet, route))


def _solve_nominal(magnet: Magnet, points: Floats, session: Session, route: str) -> Floats:
    """Return the finite-element part of B (n, 3) in T of the nominal array."""
    if magnet.is_nonlinear:
        return solve_samples(magnet, points, nominal_samples(magnet), session,
                             formulation_of(magnet, route))[0]
    return _solve(magnet, points, (), session, route)[0]


def formulation_of(magnet: Magnet, route: str) -> Formulation:
    """Return the finite-element formulation of a route other than ``azimuthal_modes``."""
    return {"cross_section": CROSS_SECTION, "scalar_potential": SCALAR_POTENTIAL}.get(
        route) or edge_elements(magnet.study.solver.edge_order)


def choose_route(magnet: Magnet, points: Floats) -> str:
    """Return the study's route, or for ``auto`` the fastest that applies to the magnet and points.

    Raises
    ------
    StudyError
        If the study asks for azimuthal modes and they do not apply, see `is_axisymmetric`.
    """
    if magnet.dimension == 2:
        return "cross_section"
    asked, symmetric = magnet.study.solver.route, is_axisymmetric(magnet, points)
    if asked == "azimuthal_modes" and not symmetric:
        raise StudyError(
            f"Input `solver.route` of study {magnet.name} must be another route; instead received "
            "azimuthal_modes, which needs sectors without angular gaps, of one isotropic "
            "permeability in each ring, linear iron, and points that are not too near to the "
            "blocks. Leave the key out.")
    if asked == "auto":
        if magnet.study.solver.method == "direct":
            return "edge_elements"
        return "azimuthal_modes" if symmetric else "scalar_potential"
    return asked


def check_points(
    magnet: Magnet, points: Floats, key: str = "observation.positions"
) -> None:
    """Refuse points at which the field cannot be computed well or measured by a probe.

    Parameters
    ----------
    magnet : Magnet
    points : ndarray, shape (n, 3), in m
    key : str
        Key of the study that the points come from, for the error message.

    Raises
    ------
    StudyError
        If a point lies inside magnet or iron, or if the points of a 2D study have different z.

    Warns
    -----
    HalbachWarning
        If points are so near to the outer boundary that its condition affects their field.
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
    directions = [(np.hypot(points[:, 0], points[:, 1]), magnet.radius,
             boundary_radius(magnet, mesh))]
    if magnet.dimension == 3:
        directions.append((np.abs(points[:, 2]), magnet.half_length,
                     boundary_half_length(magnet, mesh)))
    for position, end, boundary in directions:
        near = position > end + BOUNDARY_NEAR * (boundary - end)
        if near.any() and position.max() <= boundary:  # the solve refuses points beyond it
            x, y, z = points[np.argmax(near)]
            warnings.warn(
                f"{near.sum()} of {len(points)} points lie more than half-way from the magnet to "
                f"the boundary of the mesh, which affects their field, the first at ({x:g}, {y:g}, "
                f"{z:g}) m. Enlarge `open_boundary` of study {magnet.name}.", HalbachWarning,
                stacklevel=2)
