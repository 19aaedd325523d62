"""Choice of the solver (the route), and the field of the nominal magnet and of single blocks.

The problem is magnetostatics without currents: curl H = 0 and div B = 0, with B = mu_0 mu_r H + B_r
in the blocks and a linear or non-linear law in the iron. Four routes solve it by finite elements:
``cross_section`` (2D, vector potential), ``azimuthal_modes`` (rotationally symmetric materials,
scalar potential), ``scalar_potential`` and ``edge_elements`` (3D, vector potential). The route
``moments`` divides only the blocks into cells, and solves the iron by azimuthal modes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from halbach_fe.core.arrays import Floats, Ints, plain, radii_of
from halbach_fe.core.errors import HalbachWarning, StudyError, must_be
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.surface import is_cross_section
from halbach_fe.geometry.symmetry import no_symmetry, symmetry_of
from halbach_fe.solver.azimuthal_modes import few_modes_suffice, is_axisymmetric, solve_modes
from halbach_fe.solver.exact_block_field import external_field, field_of, unit_fields
from halbach_fe.solver.iron_modes import reciprocal_gradients, saves_solves
from halbach_fe.solver.magnetostatics import (
    CROSS_SECTION,
    SCALAR_POTENTIAL,
    Formulation,
    edge_elements,
    nominal_samples,
    solve_samples,
    solve_sources,
    solve_tangent,
)
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.separate_blocks import (
    applies,
    columns_of_iron,
    external_acts,
    external_on_losses,
    field_in_vacuum,
    iron_alone,
    separate_columns,
    sizes_in_iron,
    sizes_of_iron,
    solve_separate,
)
from halbach_fe.solver.session import NOT_KEPT, Session
from halbach_fe.study.external_keys import External
from halbach_fe.study.model import CELLS_PER_SIDE

SUPERPOSITION_TOLERANCE = 1e-8
"""Relative tolerance of the check that single blocks add up to the nominal array, if a direct
solver is used. The problem is linear, so that only rounding errors of about 1e-12 remain; a wrong
or missing column makes a difference of 1e-3."""


class Route(StrEnum):
    """How a magnet is solved, by the name that studies and results have for it.

    `choose_route` chooses it once; what differs from route to route is asked of it.
    """

    CROSS_SECTION = "cross_section"
    AZIMUTHAL_MODES = "azimuthal_modes"
    EDGE_ELEMENTS = "edge_elements"
    SCALAR_POTENTIAL = "scalar_potential"
    MOMENTS = "moments"

    @property
    def mesh(self) -> str | None:
        """Kind of mesh, a key of `halbach_fe.geometry.domain.BOUNDARY_RATIO`; None without one."""
        return {Route.CROSS_SECTION: "cross_section", Route.AZIMUTHAL_MODES: "meridian",
                Route.MOMENTS: None}.get(self, "extruded")

    @property
    def dual(self) -> Route | None:
        """The route of the dual formulation on the same mesh, whose energy brackets the exact one
        from the other side; None if there is none.
        """
        return {Route.EDGE_ELEMENTS: Route.SCALAR_POTENTIAL,
                Route.SCALAR_POTENTIAL: Route.EDGE_ELEMENTS}.get(self)

    @property
    def meshed(self) -> Route:
        """The route of the mesh that holds non-linear iron; ``moments`` has none."""
        return Route.SCALAR_POTENTIAL if self is Route.MOMENTS else self

    def formulation(self, magnet: Magnet) -> Formulation:
        """Return the formulation of the mesh of all space, of other routes that of edges."""
        return {Route.CROSS_SECTION: CROSS_SECTION, Route.SCALAR_POTENTIAL: SCALAR_POTENTIAL}.get(
            self) or edge_elements(magnet.study.solver.edge_order)

    def element_size_m(self, magnet: Magnet) -> float:
        """Return the size of the elements, or for the method of moments of the cells of blocks."""
        mesh = magnet.study.mesh
        if self is Route.AZIMUTHAL_MODES:
            return meridian_size(magnet)
        if self is Route.MOMENTS:
            smallest = min(block.volume for block in magnet.blocks) ** (1 / 3)
            return float(smallest / (mesh.cells_per_side or CELLS_PER_SIDE))
        return mesh.block_size_m

    def superposition_tolerance(self, magnet: Magnet, placed: bool) -> float:
        """Return the tolerance of the check that blocks add up; ``placed`` is by symmetry."""
        if placed and self is not Route.AZIMUTHAL_MODES:  # whose mesh has the symmetry
            # A 3D mesh is not symmetric, so that its discretization error remains. On meshes of 30
            # to 50 mm it was measured to be 1 % to 8.5 % of the finite-element part for the scalar
            # potential, and 1 % to 4 % for edge elements of order 2. When the mirror image was left
            # out on purpose, the difference was 30 % and more for the scalar potential (8 % for
            # edge elements on a coarse mesh with thin iron); for blocks rotated the wrong way or of
            # the wrong sign it was mostly 100 % and more. A single wrong block among hundreds is
            # not detected. The error of edge elements of order 1 was 5 % (20 mm) to 35 % (50 mm):
            # only blocks of the wrong sign or rotated the wrong way are detected with certainty.
            lowest_order = self is Route.EDGE_ELEMENTS and magnet.study.solver.edge_order == 1
            return 0.5 if lowest_order else 0.1
        # conjugate gradients stop at a relative residual of 1e-10; the difference was measured to
        # be 1e-9 to 6e-9 on coarse meshes
        return 1e-7 if self is Route.SCALAR_POTENTIAL else SUPERPOSITION_TOLERANCE

    def solve(
        self, magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
        anywhere: bool = False
    ) -> Floats:
        """Solve a linear problem; the result is that of `solve_sources`."""
        if self is Route.AZIMUTHAL_MODES:
            reciprocal = saves_solves(magnet, points, blocks)
            return solve_modes(magnet, points, blocks, session,
                               single_blocks=reciprocal_gradients if reciprocal else None)
        return solve_sources(magnet, points, blocks, session, self.formulation(magnet), anywhere)


@dataclass(frozen=True)
class ElementFields:
    """The finite-element part of B, for the nominal array and for every block.

    For the method ``reaction`` this is the reaction of permeability and iron, to be added to the
    exact field in vacuum; for ``direct`` it is B itself.
    """

    superposition_tolerance: float
    """Largest accepted difference between ``along_nominal`` and the sum over the blocks, relative
    to the sum of the magnitudes of the blocks' finite-element parts."""
    nominal: Floats
    """The whole array, solved for at once. Shape (n, 3), in T."""
    along_nominal: Floats
    """The value to which the blocks must add up: ``nominal``; with non-linear iron the derivative
    of the field along the nominal magnetization, and where blocks have larger elements than the
    array, the array on these. Shape (n, 3), in T."""
    sources: tuple[MagnetBlock, ...]
    """The blocks of the array for which single blocks were solved."""
    block: Callable[[int, Ints | slice], Floats]
    """Takes the number of a block, from 0, and indices (k,) of points or a slice. Returns the
    finite-element part (k, 3, D) of the block's B there in T per T of remanence along each of the D
    axes. By symmetry several blocks share one solve."""
    error: Floats | None = None
    """How far finer elements would change ``nominal``, where the solve already yields it, NaN
    elsewhere; None if it is known nowhere. Its length is the error bar in any direction.
    Shape (n, 3), in T."""
    for_deviations: bool = False
    """Whether the blocks' parts only serve for deviations from ``nominal``, which is more exact
    than their sum. Derivatives at the nominal array do so too."""
    anywhere: bool = False
    """Whether points may lie in magnet and iron, of a cross-section."""


def solve_nominal(
    magnet: Magnet, points: Floats, session: Session, estimate: bool = False
) -> Floats:
    """Return B (n, 3) in T of the nominal array at points (n, 3) in m, by the study's method.

    ``estimate`` tells whether to solve for error bars too, by which iron of any shape is
    extrapolated, see `halbach_fe.solver.iron_bodies.BodiesReaction.field_with_errors`.
    """
    points = check_points(magnet, points)
    return vacuum_part(magnet, points) + finite_element_part(
        magnet, points, session, columns=False, estimate=estimate).nominal


def field_at(magnet: Magnet, points_m: ArrayLike) -> Floats:
    """Return B (..., 3) in T of the nominal array at points (..., 3) in m, see `Magnet.field_T`."""
    try:
        points = plain(points_m)
    except (TypeError, ValueError) as error:  # text, or rows of different lengths
        raise StudyError(must_be("points_m", magnet.name, "x, y, z in m: an array (..., 3)",
                                 f"a {type(points_m).__name__} that is none: {error}")) from None
    farthest = 1e30  # m; higher powers of it are still numbers, and infinity and NaN are not less
    if points.ndim == 0 or points.shape[-1] != 3 or not (np.abs(points) < farthest).all():
        missing = points.ndim and points.shape[-1] == 3
        raise StudyError(must_be("points_m", magnet.name, "finite x, y, z in m: an array (..., 3)",
                                 "values that are not finite, or above 1e30" if missing else
                                 f"one of shape {points.shape}"))
    session = NOT_KEPT if magnet.is_vacuum else Session.temporary()  # closed forms write no file
    # as `halbach_fe.solve` has it, which extrapolates iron of any shape
    estimate, flat = not magnet.iron_is_axisymmetric, points.reshape(-1, 3)
    return _field_of_nominal(magnet, flat, session, estimate).reshape(points.shape)


def _field_of_nominal(
    magnet: Magnet, points: Floats, session: Session, estimate: bool = False
) -> Floats:
    """Return `solve_nominal`, of a cross-section at points (n, 3) in m of any z."""
    if magnet.dimension == 3:
        return solve_nominal(magnet, points, session, estimate)
    plane = points * [1.0, 1.0, 0.0]
    found = solve_nominal(magnet, plane, session)
    return found + external_field(magnet, points) - external_field(magnet, plane)


def field_function(magnet: Magnet, session: Session) -> Callable[[Floats], Floats]:
    """Return a function of points (n, 3) in m that computes B (n, 3) in T of the nominal array.

    It serves points that move little by little. The blocks are solved for once where that does not
    depend on the points, and the field of many blocks is summed by expansions: 24 x 12 permeable
    cubes were up to 8e-5 of their field off in the bore, 1.5e-5 rms. That of a cross-section does
    not depend on z, but for that of external sources.
    """
    auto = magnet.study.solver.route == "auto" and not magnet.has_losses
    if magnet.is_vacuum or choose_route(magnet, np.zeros((0, 3))) is not Route.MOMENTS or (
            auto and is_axisymmetric(magnet)):
        return lambda points: _field_of_nominal(magnet, points, session)
    reaction = solve_separate(magnet, session, estimate=False)
    vacuum = field_in_vacuum(magnet.blocks)

    def field(points: Floats) -> Floats:
        points = check_points(magnet, points)
        return external_field(magnet, points) + vacuum(points) + reaction.field(points)

    return field


def iron_change(
    magnet: Magnet, points: Floats, session: Session, few_modes: bool = False
) -> Floats | None:
    """Return the change (n, 3) in T that the iron makes to B of blocks in vacuum.

    The result is None for routes on which the whole magnet is solved in the same time. For
    ``few_modes`` see `iron_alone`.
    """
    points = check_points(magnet, points)
    if choose_route(magnet, points) is not Route.MOMENTS or not magnet.iron:
        return None
    return iron_alone(magnet, points, session, few_modes)


def vacuum_part(magnet: Magnet, points: Floats) -> Floats:
    """Return the part of B (n, 3) in T of the nominal array that is known in closed form.

    That is the field of the external sources and, for the method ``reaction``, the exact field of
    the blocks in vacuum. The finite-element part adds to it.
    """
    external = external_field(magnet, points)
    if magnet.study.solver.method == "direct":
        return external
    return external + field_of(magnet.blocks, points)


def finite_element_part(
    magnet: Magnet, points: Floats, session: Session, columns: bool = True, estimate: bool = True,
    anywhere: bool = False
) -> ElementFields:
    """Compute the finite-element part of B by the route that `choose_route` returns.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        In air, or ``anywhere`` in a cross-section.
    columns : bool
        Whether to solve for single blocks too, the columns of the response matrix.
    estimate : bool
        Whether the route of moments solves once more for error bars.
    """
    size = magnet.dimension
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        zero = np.zeros((len(points), 3))
        return ElementFields(SUPERPOSITION_TOLERANCE, zero, zero, magnet.blocks,
                             lambda number, some: np.zeros((len(points[some]), 3, size)))
    route = choose_route(magnet, points)
    if route is Route.MOMENTS:
        return _moments_part(magnet, points, session, columns, estimate)
    if not columns:
        nominal = _solve_nominal(magnet, points, session, route, anywhere)
        return ElementFields(np.nan, nominal, nominal, magnet.blocks, _refuse_column)
    placed = uses_symmetry(magnet)
    symmetry = symmetry_of(magnet) if placed else no_symmetry(magnet)
    places, index = symmetry.source_points(points)
    # The first source is placed by the identity, so its source points are the points themselves.
    here = index[symmetry.sources[0]]
    coarser = (route is Route.AZIMUTHAL_MODES and not magnet.iron
               and magnet.study.solver.method == "reaction")
    if magnet.is_nonlinear:
        nominal, fields = solve_tangent(magnet, places, symmetry.sources, session,
                                        route.formulation(magnet), anywhere)
        nominal = nominal[here]
    elif coarser:
        nominal = _solve_nominal(magnet, points, session, route)
        # Columns serve deviations. For 1.5 % in 36 blocks of permeability 1.05 their error rises
        # from 2e-8 to 1.2e-7 of the main field, in half the time; twice the size makes it 3.5e-6.
        # Beside iron it would rise from 8e-8 to 5.5e-6, above the error bar of the nominal array.
        larger = 1.5
        fields = route.solve(
            magnet.with_(mesh__meridian_size_m=larger * meridian_size(magnet)), places,
            symmetry.sources, replace(session.within("blocks"), purpose="single blocks"))
    else:
        fields = route.solve(magnet, places, symmetry.sources, session, anywhere)
        nominal = fields[0, here]

    def block(number: int, some: Ints | slice) -> Floats:
        placement = symmetry.images[number]
        first = 1 + size * symmetry.sources.index(placement.source)
        source_fields = np.moveaxis(fields[first:first + size, index[number][some]], 0, 2)
        return placement.from_source(source_fields)

    return ElementFields(route.superposition_tolerance(magnet, placed), nominal, fields[0, here],
                         magnet.blocks, block, anywhere=anywhere,
                         for_deviations=coarser or magnet.is_nonlinear)


def _moments_part(
    magnet: Magnet, points: Floats, session: Session, columns: bool, estimate: bool
) -> ElementFields:
    """Return the reaction of separate blocks and rotationally symmetric iron.

    Where the materials are rotationally symmetric, azimuthal modes serve all points but those
    that would need too many modes, because they are so near to the blocks.
    """
    few = few_modes_suffice(magnet, points)
    if magnet.study.solver.route == "auto" and few.any() and not magnet.has_losses:
        parts = [(np.flatnonzero(chosen), finite_element_part(
            magnet.with_(solver__route=route), points[chosen], session.within(route), columns,
            estimate))
            for chosen, route in ((few, "azimuthal_modes"), (~few, "moments"))]
        return _join_parts(magnet, points, parts)
    if session.counter is not None:
        if sizes := sizes_of_iron(magnet, estimate):
            session.counter.batches.append((session.purpose, sizes))
        zero = np.zeros((len(points), 3))
        return ElementFields(np.nan, zero, zero, magnet.blocks, _refuse_column, zero)
    solved = solve_separate(magnet, session, estimate)
    nominal, error = solved.field_with_errors(points) if estimate else (
        solved.field(points), None)
    if not columns:
        return ElementFields(np.nan, nominal, nominal, magnet.blocks, _refuse_column, error)
    block = separate_columns(magnet, points, solved.iron, session.progress)
    along = nominal
    # the columns are derivatives there, and do not hold what answers to external fields
    if magnet.is_nonlinear or magnet.has_losses or external_acts(magnet):
        along = sum((block(number, slice(None)) @ each.polarization
                     for number, each in enumerate(magnet.blocks)), np.zeros_like(nominal))
    # the same tolerance for the route ``moments``. The columns have a single cell per block, and
    # leave out what blocks and iron answer to each other.
    moments_tolerance = 0.1
    return ElementFields(moments_tolerance, nominal, along, magnet.blocks, block, error,
                         for_deviations=True)


def _join_parts(
    magnet: Magnet, points: Floats, parts: Sequence[tuple[Ints, ElementFields]]
) -> ElementFields:
    """Return the fields at all points (n, 3) from those that several routes have at some.

    ``parts`` has the numbers of the points and the fields of each route.
    """
    nominal, along, error = (np.zeros((len(points), 3)) for _ in range(3))
    for numbers, fields in parts:
        nominal[numbers], along[numbers] = fields.nominal, fields.along_nominal
        error[numbers] = np.nan if fields.error is None else fields.error
    rank = np.empty(len(points), int)
    owner = np.empty(len(points), int)
    for number, (numbers, _) in enumerate(parts):
        rank[numbers], owner[numbers] = np.arange(len(numbers)), number

    def block(number: int, some: Ints | slice) -> Floats:
        found = np.zeros((len(points[some]), 3, 3))
        for part, (_, fields) in enumerate(parts):
            here = owner[some] == part
            found[here] = fields.block(number, rank[some][here])
        return found

    return ElementFields(max(fields.superposition_tolerance for _, fields in parts), nominal, along,
                         magnet.blocks, block, error,
                         any(fields.for_deviations for _, fields in parts))


def fields_of_others(
    magnet: Magnet, blocks: Sequence[MagnetBlock], points: Floats, session: Session
) -> Iterator[Floats]:
    """Yield B (n, 3, 3) of single blocks of other magnets at points (n, 3) in m, in T per T of
    remanence along each axis, with what iron answers where it does to external fields.
    """
    vacuum = unit_fields(blocks, points)
    if session.counter is not None or not blocks or not external_acts(magnet) or (
            choose_route(magnet, points) is not Route.MOMENTS):
        return vacuum
    iron = solve_separate(magnet, session).iron
    return vacuum if iron is None else map(np.add, vacuum, columns_of_iron(iron, blocks, points))


def runs_serve_other_points(magnet: Magnet, points: Floats) -> bool:
    """Tell whether the runs for single blocks, which the cache keeps, do not depend on the points.

    That is so by azimuthal modes, unless reciprocity solves for these points (n, 3) in m instead.
    """
    if choose_route(magnet, points) is not Route.AZIMUTHAL_MODES:
        return False
    symmetry = symmetry_of(magnet) if uses_symmetry(magnet) else no_symmetry(magnet)
    return not saves_solves(magnet, symmetry.source_points(points)[0], symmetry.sources)


def uses_symmetry(magnet: Magnet) -> bool:
    """Tell whether only some blocks are solved for, and the others obtained by symmetry.

    In a cross-section this would save little. Non-linear iron does not have the symmetry of the
    geometry, since its tangent depends on the field.
    """
    return magnet.study.solver.symmetry and magnet.dimension == 3 and not magnet.is_nonlinear


def _refuse_column(number: int, some: Ints | slice) -> Floats:
    """Take the place of `ElementFields.block` if only the nominal array was solved for."""
    raise AssertionError(f"block {number} was not solved for")


def _solve_nominal(
    magnet: Magnet, points: Floats, session: Session, route: Route, anywhere: bool = False
) -> Floats:
    """Return the finite-element part of B (n, 3) in T of the nominal array."""
    if magnet.is_nonlinear and anywhere:
        return solve_tangent(magnet, points, (), session, route.formulation(magnet), True)[0]
    if magnet.is_nonlinear:
        return solve_samples(magnet, points, nominal_samples(magnet), session,
                             route.formulation(magnet))[0]
    return route.solve(magnet, points, (), session, anywhere)[0]


def finer_in_words(magnet: Magnet, points: Floats) -> str:
    """Return the keys that lower the solver's error at points (n, 3) in m, with their values.

    They follow from the route: ``cells_per_side`` divides permeable blocks on the route
    ``moments``, ``meridian_size_m`` is of the half-plane of azimuthal modes, and ``block_size_m``
    of the rest, also of iron of any shape. There is none where only rotationally symmetric iron is
    left to the route ``moments``, whose grid of the iron is fixed.
    """
    mesh, route = magnet.study.mesh, choose_route(magnet, points)
    if route not in (Route.MOMENTS, Route.AZIMUTHAL_MODES):
        return f"a smaller mesh.block_size_m (now {1e3 * mesh.block_size_m:.3g} mm)"
    keys = []
    if route is Route.MOMENTS and (magnet.has_losses or any(
            block.is_permeable for block in magnet.blocks)):
        keys.append(f"a larger mesh.cells_per_side (now {mesh.cells_per_side or CELLS_PER_SIDE})")
    if not magnet.iron_is_axisymmetric:
        size = min(sizes_in_iron(magnet))
        keys.append(f"a smaller mesh.block_size_m (elements of iron now have {1e3 * size:.3g} mm)")
    if route is Route.AZIMUTHAL_MODES or (
            magnet.study.solver.route == "auto" and not magnet.has_losses
            and bool(few_modes_suffice(magnet, points).any())):
        keys.append(f"a smaller mesh.meridian_size_m (now {1e3 * meridian_size(magnet):.3g} mm)")
    return " and ".join(keys)


def choose_route(magnet: Magnet, points: Floats) -> Route:
    """Return the study's route, or for ``auto`` the fastest that applies to the magnet and points.

    Raises
    ------
    StudyError
        If the study asks for azimuthal modes and they do not apply, see `is_axisymmetric`.
    """
    if magnet.dimension == 2:
        return Route.CROSS_SECTION
    asked = magnet.study.solver.route
    if magnet.has_losses:  # which are not rotationally symmetric
        asked = "moments"
    symmetric = is_axisymmetric(magnet) and bool(few_modes_suffice(magnet, points).all())
    if asked == "azimuthal_modes" and not symmetric:
        raise StudyError(
            f"Input `solver.route` of study {magnet.name} must be another route; instead received "
            "azimuthal_modes, which needs sectors without angular gaps, of one isotropic "
            "permeability in each ring, linear iron, and points that are not too near to the "
            "blocks. Leave the key out.")
    if asked == "moments" and not applies(magnet):
        raise StudyError(
            f"Input `solver.route` of study {magnet.name} must be another route; instead received "
            "moments, which needs the method reaction. Leave the key out.")
    if asked == "auto":
        if magnet.study.solver.method == "direct":
            asked = "edge_elements"
        elif symmetric:
            asked = "azimuthal_modes"
        else:
            extruded = magnet.array.is_uniform and magnet.iron_is_along_z
            asked = "scalar_potential" if extruded and not magnet.iron_is_axisymmetric else (
                "moments")
    if asked in ("edge_elements", "scalar_potential") and not magnet.array.is_uniform:
        raise StudyError(
            f"Input `array` of study {magnet.name} must consist of equal rings for the route "
            f"{asked.replace('_', ' ')}; instead it has rings of their own or free blocks. Use the "
            "method reaction.")
    if asked in ("edge_elements", "scalar_potential") and not magnet.iron_is_along_z:
        raise StudyError(
            f"Input `iron` of study {magnet.name} must be of one material, of prisms along z and "
            f"coaxial tubes, for the route {asked.replace('_', ' ')}; instead a body has another "
            "shape, place or material. Leave solver.route and solver.method out.")
    return Route(asked)


def check_plane(magnet: Magnet, points: Floats, key: str) -> None:
    """Refuse points (n, 3) in m of a 2D study that do not lie in one plane.

    Raises
    ------
    StudyError
    """
    if magnet.dimension == 2 and len(points) and not is_cross_section(points):
        raise StudyError(
            f"Input `{key}` of study {magnet.name} must lie in one plane, since it "
            f"is 2D; instead z goes from {points[:, 2].min():g} to {points[:, 2].max():g} m. Use "
            "one circle, or a 3D study.")


def check_points(
    magnet: Magnet, points: Floats, key: str = "observation.positions"
) -> Floats:
    """Refuse points at which the field cannot be computed well or measured by a probe.

    The points at which to evaluate the field are returned: those on a face of magnet or iron lie
    just outside, see `halbach_fe.geometry.surface`.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    key : str
        Key of the study that the points come from, for the error message.

    Raises
    ------
    StudyError
        If a point lies inside magnet or iron, on an edge or between bodies that touch, or if the
        points of a 2D study have different z.

    Warns
    -----
    HalbachWarning
        If points are on a face, so far away that they may be in mm, or so near to the outer
        boundary that its condition affects their field; if iron does not answer to external fields,
        or losses do not count them.
    """
    check_plane(magnet, points, key)
    places = magnet.surroundings(points)
    refused = places.refusal()
    if refused is not None:
        first, count, what, hint = refused
        x, y, z = points[first]
        raise StudyError(
            f"Input `{key}` of study {magnet.name} must lie in air; instead "
            f"{count} of {len(points)} points lie {what}, the first at "
            f"({x:g}, {y:g}, {z:g}) m. {hint or 'Move them into the bore or beyond the ends.'}")
    points = places.points
    route = choose_route(magnet, points)
    # only meshes have a boundary, beyond which the solve refuses points
    mesh = None if magnet.is_vacuum and magnet.study.solver.method == "reaction" else route.mesh
    for remark in (places.on_faces(), places.far_away() if mesh is None else None,
                   _external_past_iron(magnet, points, route), _external_beside_losses(magnet)):
        if remark is not None:
            warnings.warn(remark, HalbachWarning, stacklevel=2)
    if mesh is None:
        return points
    directions = [(radii_of(points), magnet.radius,
             boundary_radius(magnet, mesh))]
    if magnet.dimension == 3:
        directions.append((np.abs(points[:, 2]), magnet.half_length,
                     boundary_half_length(magnet, mesh)))
    # fraction of the way from the magnet to the outer boundary. Points farther out cause a warning,
    # because the condition on the boundary affects their field.
    boundary_near = 0.5
    for position, end, boundary in directions:
        near = position > end + boundary_near * (boundary - end)
        if near.any() and position.max() <= boundary:  # the solve refuses points beyond it
            x, y, z = points[np.argmax(near)]
            warnings.warn(
                f"{near.sum()} of {len(points)} points lie more than half-way from the magnet to "
                f"the boundary of the mesh, which affects their field, the first at ({x:g}, {y:g}, "
                f"{z:g}) m. Enlarge `open_boundary` of study {magnet.name}.", HalbachWarning,
                stacklevel=2)
    return points


def _external_past_iron(magnet: Magnet, points: Floats, route: Route) -> str | None:
    """Return the sentence about an external field that iron does not answer to, None without."""
    if not magnet.iron or magnet.external == External() or not len(points) or (
            route is Route.MOMENTS and external_acts(magnet)):
        return None
    size = np.linalg.norm(external_field(magnet, points), axis=1).max()
    return (f"The field of `external`, up to {1e3 * size:.3g} mT at the points, is added as if the "
            f"iron of study {magnet.name} were not there. Iron may change it by as much as it is.")


def _external_beside_losses(magnet: Magnet) -> str | None:
    """Return the sentence about an external field that irreversible losses do not count, None
    without: beside iron that does not answer to it.
    """
    size = external_on_losses(magnet) if magnet.iron and not external_acts(magnet) else 0.0
    return None if not size else (
        f"The field of `external`, up to {1e3 * size:.3g} mT in the middles of the blocks, is left "
        f"out of the irreversible losses of study {magnet.name}, which may be larger or smaller. "
        "`halbach-fe demagnetization` counts it.")
