"""Error bars of readings from changes of the mesh, the boundary or the formulation.

All errors are those of the full nominal array, because the errors of the blocks add up. Those of
`verify` are at the study's own positions, and relative to the largest field there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import ceil

import numpy as np

from halbach_fe.core.arrays import Floats, of_length
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.progress import Say, quiet
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation_operator import Observation, fourier_analysis
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import noise_regions
from halbach_fe.solver.azimuthal_modes import modes_needed, solve_modes
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.routes import (
    ElementFields,
    Route,
    choose_route,
    finite_element_part,
    solve_nominal,
)
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.study.measurement_keys import FourierCoefficients
from halbach_fe.study.model import CELLS_PER_SIDE

REFINEMENT = 1.5
"""Factor between the element sizes, and between the distances of the boundary, of two solves."""

MORE_MODES = 1.5
"""Factor by which the highest azimuthal mode of the coarser mesh is larger. Modes fall
geometrically: those above the highest mode, at 1e-4, are in the error bar down to 1e-6."""

IRON_SERIES = 1 / (REFINEMENT ** (4 / 3) - 1)
"""Error of a half-plane's mesh with iron, over the change by the coarser mesh: 1.4.

Near the axis, far from all elements that resolve the field badly, the error comes from the corners
of the iron. The potential is of order (distance)^(2/3) there, and the error elsewhere of order
(element size)^(4/3), whatever the order of the elements (G. Strang and G. J. Fix, An Analysis of
the Finite Element Method, chapter 8). Without iron the materials differ by some per cent, so that
the order is above 2 and the change itself is larger than the error."""

BOUNDARY_SERIES = {dimension: 1 / (1 - REFINEMENT**-dimension) for dimension in (2, 3)}
"""Error of an outer boundary over the change by the farther boundary: 1.8 in 2D and 1.4 in 3D. The
field that the boundary reflects is that of a dipole at most, and falls with the square of its
distance in 2D, with the cube in 3D."""


def refined(magnet: Magnet, factor: float) -> Magnet:
    """Return the magnet with all elements smaller by a factor (larger if it is below 1).

    The new study is not validated. The limits of a study file exist to catch wrong units; a mesh
    that is coarser than these limits allow may still serve to estimate an error bar.
    """
    mesh = magnet.study.mesh
    bore = mesh.bore_size_m or mesh.block_size_m
    return magnet.with_study(magnet.study.model_copy(update={"mesh": mesh.model_copy(update={
        "block_size_m": mesh.block_size_m / factor, "bore_size_m": bore / factor,
        "meridian_size_m": meridian_size(magnet) / factor,
        "cells_per_side": _cells(mesh.cells_per_side or CELLS_PER_SIDE, factor),
        "layers_per_ring": max(1, round(mesh.layers_per_ring * factor)),
        "growth": 1 + (mesh.growth - 1) / factor})}))


def _cells(cells: int, factor: float) -> int:
    """Return a number of cells that is larger by about a factor, but by one at least."""
    finer = max(cells + 1, round(cells * factor))
    return finer if factor > 1 else max(1, min(cells - 1, round(cells * factor)))


def farther(magnet: Magnet, mesh: str, factor: float) -> Magnet:
    """Return the magnet with the boundary farther away by a factor.

    ``mesh`` is the kind of mesh, see `halbach_fe.solver.routes.Route.mesh`.
    """
    end = magnet.half_length
    update = {"radius_m": factor * boundary_radius(magnet, mesh)}
    if magnet.dimension == 3:
        update["half_length_m"] = end + factor * (boundary_half_length(magnet, mesh) - end)
    return magnet.with_(open_boundary=magnet.study.open_boundary.with_(**update))


def reading_errors(
    magnet: Magnet, observation: Observation, parts: ElementFields, session: Session
) -> Floats:
    """Return the error bar (readings,) in T of every reading, see `discretization_changes`."""
    return error_bars(observation, parts, discretization_changes(
        magnet, observation.points, parts, session))


def error_bars(observation: Observation, parts: ElementFields, changes: Floats) -> Floats:
    """Return the error bars (readings,) in T: the sums of the magnitudes of changes (k, n, 3)."""
    if parts.error is not None:
        return observation.largest(np.linalg.norm(changes, axis=2).sum(axis=0))
    return sum((observation.magnitude(change) for change in changes), np.zeros(len(observation)))


def discretization_changes(
    magnet: Magnet, points: Floats, parts: ElementFields, session: Session
) -> Floats:
    """Return the signed changes (k, n, 3) in T of the field that other discretizations make.

    Each is as large as the error that it stands for, at all points together. On a 3D mesh the other
    discretization is the dual formulation on the same mesh: the energies of the two formulations
    bracket the exact energy, and the two err in opposite directions at the boundary. For the other
    routes a second mesh is cheap. Their changes are those by a coarser mesh and by a farther
    boundary, which is extrapolated (`BOUNDARY_SERIES`). For azimuthal modes the coarser mesh also
    has more modes, so that its change contains the modes that were left out, and is extrapolated
    too (`IRON_SERIES`).

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    parts : ElementFields
        The finite-element part of the field at the points.
    session : Session
        The additional solves have a subfolder of its folder.
    """
    nominal, known = parts.nominal, parts.error
    if known is not None:
        unknown = np.isnan(known).any(axis=1)
        if unknown.any():  # these points were solved for by another route, see `ElementFields`
            by_modes = _changes_of_modes(magnet, points[unknown], nominal[unknown], session)
            known = known.copy()
            known[unknown] = of_length(
                np.sum(by_modes, axis=0), np.linalg.norm(np.abs(by_modes).sum(axis=0), axis=1))
        return known[None]
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return np.zeros((0, *points.shape))  # the field is exact: finite elements add nothing
    route = choose_route(magnet, points)
    if route is Route.AZIMUTHAL_MODES:
        return np.array(_changes_of_modes(magnet, points, nominal, session))

    def change(variant: Magnet, purpose: str) -> Floats:
        return finite_element_part(variant, points, _error_bars(session, purpose), columns=False,
                                   anywhere=parts.anywhere).nominal - nominal

    if route.dual is not None:
        return change(magnet.with_(solver__route=route.dual.value), "dual route")[None]
    coarser = change(refined(magnet, 1 / REFINEMENT), "coarser mesh")
    return coarser[None] if route.mesh is None else np.array([
        coarser, BOUNDARY_SERIES[magnet.dimension] * change(
            farther(magnet, route.mesh, REFINEMENT), "farther boundary")])


def _error_bars(session: Session, purpose: str) -> Session:
    """Return the session in a subfolder, so that the study's runs are kept, with a purpose."""
    return replace(session.within("error-bar"), purpose=f"error bars, {purpose}")


def _changes_of_modes(
    magnet: Magnet, points: Floats, nominal: Floats, session: Session
) -> tuple[Floats, Floats]:
    """Return the errors (n, 3) in T by mesh and modes, and by the boundary, of azimuthal modes.

    They are the extrapolated changes of the finite-element part ``nominal``, with their signs.
    """
    modes = modes_needed(magnet, points)
    coarser, = solve_modes(refined(magnet, 1 / REFINEMENT), points, (), _error_bars(
        session, "coarser mesh"), ceil(MORE_MODES * modes))
    distant, = solve_modes(farther(magnet, "meridian", REFINEMENT), points, (), _error_bars(
        session, "farther boundary"), modes)
    series = IRON_SERIES if magnet.iron else 1.0
    return series * (coarser - nominal), BOUNDARY_SERIES[3] * (distant - nominal)


EXACT = "exact field"
OWN, COARSEST, COARSER, FINER, FARTHER = (
    "the study's mesh", "a much coarser mesh", "a coarser mesh", "a finer mesh",
    "a farther boundary")

BOUNDARY = "boundary farther away"
"""Description of the change of the field by that boundary."""

STEPS = 3
"""Number of changes by successive refinements, which come first among the differences."""

FLATTEST, STEEPEST = 0.5, 4.0
"""Limits of the observed order of convergence, see `observed_order`."""


@dataclass(frozen=True)
class Difference:
    """Largest differences between two solves, relative to the largest field."""

    what: str
    """Description of the two solves that are compared."""
    pointwise: float
    """Largest |difference of B| at any point."""
    fourier: float | None
    """Largest difference of the Fourier coefficients of B_r; None if the study's positions are not
    circles."""
    by_region: dict[str, float]
    """Largest |difference of B| at any point of each noise region."""


@dataclass(frozen=True)
class Verification(ShownInNotebook):
    """The error estimate of a solved field, from comparisons of several solves.

    Attributes
    ----------
    magnet : Magnet
    route : str
        Formulation by which the field is solved, see
        `halbach_fe.solver.routes.choose_route`.
    differences : tuple of Difference
        Between the much coarser and the coarser mesh, the coarser and the study's, the study's and
        the finer mesh, and the nearer and the farther boundary; then to the dual formulation if the
        route has one, and to the exact field if it is known (method ``direct``, all permeabilities
        1, no iron).
    order : float
        Observed order of convergence in the element size, between 0.5 and 4.
    error_pointwise : float
        Error of B at any point, relative to the largest field. It is the difference to the exact
        field if that is known. Otherwise it is the sum of the geometric series of all further
        refinements of the study's mesh, plus the change that the farther boundary makes.
    error_fourier : float or None
        The same for the Fourier coefficients of B_r; None if the study's positions are not circles.
    main_field_T : float
        Largest |B| at the points, the scale of the relative errors.
    element_size_m : float
        Element size of the study's own mesh at the magnet.
    points : ndarray, shape (n, 3), in m
        The study's positions.
    field : ndarray, shape (n, 3), in T
        B at the points, solved on the study's own mesh.
    changes : ndarray, shape (differences, n), in T
        |difference of B| at every point, for each of ``differences``.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> verification = hf.verify(magnet, hf.Session.open("results"))
    >>> verification.differences[1].what
    "coarser mesh to the study's"
    """

    magnet: Magnet
    route: str
    differences: tuple[Difference, ...]
    order: float
    error_pointwise: float
    error_fourier: float | None
    main_field_T: float
    element_size_m: float
    points: Floats
    field: Floats
    changes: Floats

    def plain(self) -> dict[str, object]:
        """Return the results as plain data for JSON, without the arrays over points."""
        by_point = ("magnet", "points", "field", "changes")
        return {name: getattr(self, name) for name in self.__dataclass_fields__
                if name not in by_point} | {
            "differences": [asdict(difference) for difference in self.differences]}


@alone
def verify(
    magnet: Magnet, session: Session = NOT_KEPT, say: Say = quiet
) -> Verification:
    """Estimate the error of the solved field of the nominal magnet.

    The field is solved on two coarser meshes, the study's own and a finer one, with the boundary
    farther away, and by the dual formulation if the route has one.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the runs of GetDP.
    say : callable, optional
        Called with a description of each solve before it starts, to report progress.

    Returns
    -------
    Verification

    Raises
    ------
    StudyError
        If a position is not in air.
    GetDPError
        If GetDP fails, or its answer does not pass verification.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> hf.verify(magnet, hf.Session.open("results")).error_pointwise < 1e-3
    True
    """
    points = points_from(magnet.study.observation.positions)
    route = choose_route(magnet, points)

    fields = {}
    for purpose, variant in variants_to_compare(magnet, points).items():
        say(purpose)
        fields[purpose] = solve_nominal(variant, points, session)
    base, coarse, fine = (fields[purpose] for purpose in (OWN, COARSER, FINER))
    compare = _Comparison(magnet, points, base)
    pairs = {"much coarser mesh to the coarser": (fields[COARSEST], coarse),
             "coarser mesh to the study's": (coarse, base),
             "the study's mesh to a finer": (base, fine)}
    pairs |= {description: (base, fields[purpose]) for purpose, description in (
        (FARTHER, BOUNDARY), (f"the dual route, {route.dual}", f"dual route, {route.dual}"))
        if purpose in fields}
    if magnet.study.solver.method == "direct" and magnet.is_vacuum:
        pairs[EXACT] = base, field_of(magnet.blocks, points)
    steps = [compare(description, *pair) for description, pair in pairs.items()]
    order = observed_order(*(step.pointwise for step in steps[:STEPS]))
    last = steps[STEPS - 1]
    if EXACT in pairs:
        error, fourier = steps[-1].pointwise, steps[-1].fourier
    else:
        series = 1 / (1 - REFINEMENT**-order)
        boundary = steps[STEPS:STEPS + 1] if FARTHER in fields else []
        error = series * last.pointwise + sum(step.pointwise for step in boundary)
        fourier = None if last.fourier is None else series * last.fourier + sum(
            step.fourier or 0.0 for step in boundary)
    return Verification(
        magnet=magnet, route=route, differences=tuple(steps), order=order, error_pointwise=error,
        error_fourier=fourier, main_field_T=compare.scale,
        element_size_m=route.element_size_m(magnet),
        points=points, field=base, changes=np.array(
            [np.linalg.norm(first - second, axis=1) for first, second in pairs.values()]))


def variants_to_compare(magnet: Magnet, points: Floats) -> dict[str, Magnet]:
    """Return the magnets that `verify` solves at the points (n, 3) in m, by a description.

    They are the magnet with the study's mesh, with two coarser ones and a finer one, with a farther
    boundary if there is one, and with the dual formulation if the route has one.
    """
    route = choose_route(magnet, points)
    coarser = refined(magnet, 1 / REFINEMENT)
    variants = {OWN: magnet, COARSEST: refined(coarser, 1 / REFINEMENT), COARSER: coarser,
                FINER: refined(magnet, REFINEMENT)}
    if route.mesh is not None:
        variants[FARTHER] = farther(magnet, route.mesh, REFINEMENT)
    if route.dual is not None:
        variants[f"the dual route, {route.dual}"] = magnet.with_(
            solver__route=route.dual.value)
    return variants


def observed_order(*changes: float) -> float:
    """Return the order of convergence from successive changes, limited to 0.5 ... 4.

    It is the slope of the straight line through all changes, on logarithmic scales, or that between
    the last two if it is smaller: coarse meshes may converge fast where the study's own no longer
    does. Leading changes of 0, by meshes that cannot be made any coarser, are left out.

    The lower limit makes the error estimate of a solve that does not converge large (5.4 times the
    last change) but finite. The upper limit keeps a last change that is small by chance from
    passing for an exact result.
    """
    if changes[-1] <= 0:
        return STEEPEST
    first = next(number for number, change in enumerate(changes) if change > 0)
    seen = np.log(np.maximum(changes[first:], np.finfo(float).tiny))
    if len(seen) < 2:
        return FLATTEST
    slope = np.polyfit(np.arange(len(seen)), seen, 1)[0]
    drop = -max(slope, seen[-1] - seen[-2])
    return float(np.clip(drop / np.log(REFINEMENT), FLATTEST, STEEPEST))


class _Comparison:
    """Compares fields at a study's points with each other, relative to the largest field."""

    def __init__(self, magnet: Magnet, points: Floats, field: Floats) -> None:
        self.scale = float(np.linalg.norm(field, axis=1).max())
        self._circles = None
        positions = magnet.study.observation.positions
        # number of harmonics that are compared if the study does not state a number
        default_harmonics = 8
        if positions.kind == "circles" and positions.angles > 2:
            harmonics = getattr(magnet.study.observation, "harmonics", default_harmonics)
            self._circles, *_ = fourier_analysis(points, FourierCoefficients(
                quantity="fourier_coefficients", positions=positions,
                harmonics=min(harmonics, (positions.angles - 1) // 2)))
        self._regions = {"all": np.ones(len(points), bool)}
        if magnet.study.noise is not None and magnet.study.noise.regions:
            names = getattr(magnet.study.observation, "components", ("",))
            index = noise_regions(magnet.study.noise, np.repeat(points[:, 2], len(names)),
                                  names * len(points)).reshape(len(points), -1)
            regions = np.array([region.name for region in magnet.study.noise.regions])[index]
            self._regions = {name: (regions == name).any(axis=1) for name in np.unique(regions)}

    def __call__(self, description: str, first: Floats, second: Floats) -> Difference:
        change = np.linalg.norm(first - second, axis=1) / self.scale
        fourier = (None if self._circles is None
                   else float(np.abs(self._circles @ (first - second).ravel()).max() / self.scale))
        return Difference(
            what=description, pointwise=float(change.max()), fourier=fourier,
            by_region={name: float(change[mask].max()) for name, mask in self._regions.items()
                       if mask.any()})
