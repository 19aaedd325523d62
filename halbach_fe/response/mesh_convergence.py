"""Error estimates of the solved field: refinement, a farther boundary, the dual formulation.

All errors are those of the full nominal array at the study's own positions, because the errors of
the blocks add up. They are relative to the largest field at these positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import fourier_analysis
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import noise_regions
from halbach_fe.response.discretization_error import DUAL, REFINEMENT, dual, farther, refined
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.formulation_choice import MESHES, choose_route, solve_nominal
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.study.measurement import FourierCoefficients
from halbach_fe.study.solver import CELLS_PER_SIDE

HARMONICS = 8
"""Number of harmonics that are compared if the study does not state a number."""

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
    """Largest differences between two solves, relative to the largest field.

    Attributes
    ----------
    what : str
        Description of the two solves that are compared.
    pointwise : float
        Largest |difference of B| at any point.
    fourier : float or None
        Largest difference of the Fourier coefficients of B_r; None if the study's positions are not
        circles.
    by_region : dict of str to float
        Largest |difference of B| at any point of each noise region.
    """

    what: str
    pointwise: float
    fourier: float | None
    by_region: dict[str, float]


@dataclass(frozen=True)
class Verification(ShownInNotebook):
    """The error estimate of a solved field, from comparisons of several solves.

    Attributes
    ----------
    magnet : Magnet
    route : str
        Formulation by which the field is solved, see
        `halbach_fe.solver.formulation_choice.choose_route`.
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
    magnet: Magnet, session: Session = NOT_KEPT, say: Callable[[str], None] = lambda _: None
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
        (FARTHER, BOUNDARY), (f"the dual route, {DUAL.get(route)}",
                              f"dual route, {DUAL.get(route)}"))
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
        element_size_m=_element_size(magnet, route),
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
    if route != "moments":
        variants[FARTHER] = farther(magnet, MESHES[route], REFINEMENT)
    if route in DUAL:
        variants[f"the dual route, {DUAL[route]}"] = dual(magnet, route)
    return variants


def _element_size(magnet: Magnet, route: str) -> float:
    """Return the size in m of the elements, or for the method of moments of the cells of blocks."""
    if route == "azimuthal_modes":
        return meridian_size(magnet)
    if route == "moments":
        smallest = min(block.volume for block in magnet.blocks) ** (1 / 3)
        return float(smallest / (magnet.study.mesh.cells_per_side or CELLS_PER_SIDE))
    return magnet.study.mesh.block_size_m


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
        if positions.kind == "circles" and positions.angles > 2:
            harmonics = getattr(magnet.study.observation, "harmonics", HARMONICS)
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

