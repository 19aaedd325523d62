"""How wrong the solved field is: refinement, a farther boundary, and the dual formulation.

Everything is judged on the full nominal array at the study's own positions, where the errors of
blocks add up, in units of the largest field there.
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
from halbach_fe.solver.field import MESHES, choose_route, solve_nominal
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.session import Session
from halbach_fe.solver.vacuum_field import field_of
from halbach_fe.study.measurement import FourierCoefficients

HARMONICS = 8

EXACT = "exact field"

FLATTEST, STEEPEST = 0.5, 4.0
"""Orders of convergence that are believed."""


@dataclass(frozen=True)
class Difference:
    """Largest difference of two solves over the largest field.

    Attributes
    ----------
    what : str
    pointwise : float
        Of B at the points.
    fourier : float or None
        Of the Fourier coefficients of B_r, where the study's positions are circles.
    by_region : dict
        Pointwise, by noise region.
    """

    what: str
    pointwise: float
    fourier: float | None
    by_region: dict[str, float]


@dataclass(frozen=True)
class Verification(ShownInNotebook):
    """What `verify` found.

    Attributes
    ----------
    magnet : Magnet
    route : str
    differences : tuple of Difference
        Coarser to study, study to finer, nearer to farther boundary, the dual route if any, and
        the exact field if there is one (method ``direct``, no permeability, no iron).
    order : float
        Observed order of convergence in the element size, between 0.5 and 4.
    error_pointwise, error_fourier : float
        Relative to the largest field: the difference to the exact field if there is one, otherwise
        estimated for the study's own mesh as the remaining series of refinements, plus what the
        boundary changes.
    main_field_T : float
    element_size_m : float
        Of the study's own mesh, at the magnet.
    points : ndarray, shape (n, 3), in m
    field : ndarray, shape (n, 3), in T
        On the study's own mesh.
    changes : ndarray, shape (differences, n), in T
        |change of B| at every point.
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
        """For scripts, without what is given by point."""
        by_point = ("magnet", "points", "field", "changes")
        return {name: getattr(self, name) for name in self.__dataclass_fields__
                if name not in by_point} | {
            "differences": [asdict(one) for one in self.differences]}


def verify(
    magnet: Magnet, session: Session, say: Callable[[str], None] = lambda _: None
) -> Verification:
    """Estimate the error of the solved field of the nominal magnet.

    The field is solved on a coarser, the study's own and a finer mesh, with the boundary farther
    away, and by the dual formulation where there is one. ``say`` receives a line before each solve.

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
    base, coarse, fine, far, *others = fields.values()
    compare = _Comparison(magnet, points, base)
    pairs = {"coarser mesh to the study's": (coarse, base),
             "the study's mesh to a finer": (base, fine), "boundary farther away": (base, far)}
    if others:
        pairs[f"dual route, {DUAL[route]}"] = base, others[0]
    if magnet.study.solver.method == "direct" and magnet.is_vacuum:
        pairs[EXACT] = base, field_of(magnet.blocks, points)
    steps = [compare(what, *pair) for what, pair in pairs.items()]
    order = observed_order(steps[0].pointwise, steps[1].pointwise)
    if EXACT in pairs:
        error, fourier = steps[-1].pointwise, steps[-1].fourier
    else:
        series = 1 / (1 - REFINEMENT**-order)
        error = series * steps[1].pointwise + steps[2].pointwise
        fourier = (None if steps[1].fourier is None or steps[2].fourier is None
                   else series * steps[1].fourier + steps[2].fourier)
    return Verification(
        magnet=magnet, route=route, differences=tuple(steps), order=order, error_pointwise=error,
        error_fourier=fourier, main_field_T=compare.scale,
        element_size_m=(meridian_size(magnet) if route == "azimuthal_modes"
                        else magnet.study.mesh.block_size_m),
        points=points, field=base, changes=np.array(
            [np.linalg.norm(one - other, axis=1) for one, other in pairs.values()]))


def variants_to_compare(magnet: Magnet, points: Floats) -> dict[str, Magnet]:
    """Return what `verify` solves at the points (n, 3) in m, by its purpose in words: the study's
    mesh, a coarser and a finer one, a farther boundary, and the dual route if there is one.
    """
    route = choose_route(magnet, points)
    found = {
        "the study's mesh": magnet, "a coarser mesh": refined(magnet, 1 / REFINEMENT),
        "a finer mesh": refined(magnet, REFINEMENT),
        "a farther boundary": farther(magnet, MESHES[route], REFINEMENT)}
    if route in DUAL:
        found[f"the dual route, {DUAL[route]}"] = dual(magnet, route)
    return found


def observed_order(first: float, second: float) -> float:
    """Order of convergence from two successive changes, kept between 0.5 and 4.

    The lower limit makes the estimate of a solve that does not converge large (5.4 times the last
    change) but finite; the upper one keeps a lucky pair from looking exact.
    """
    if first <= 0 or second <= 0:
        return STEEPEST if second <= 0 else FLATTEST
    return float(np.clip(np.log(first / second) / np.log(REFINEMENT), FLATTEST, STEEPEST))


class _Comparison:
    """Differences of fields at a study's points."""

    def __init__(self, magnet: Magnet, points: Floats, field: Floats) -> None:
        self.scale = float(np.linalg.norm(field, axis=1).max())
        self._circles = None
        positions = magnet.study.observation.positions
        if positions.kind == "circles" and positions.angles > 2:
            wanted = getattr(magnet.study.observation, "harmonics", HARMONICS)
            self._circles, *_ = fourier_analysis(points, FourierCoefficients(
                quantity="fourier_coefficients", positions=positions,
                harmonics=min(wanted, (positions.angles - 1) // 2)))
        self._regions = {"all": np.ones(len(points), bool)}
        if magnet.study.noise is not None and magnet.study.noise.regions:
            names = getattr(magnet.study.observation, "components", ("",))
            index = noise_regions(magnet.study.noise, np.repeat(points[:, 2], len(names)),
                                  names * len(points)).reshape(len(points), -1)
            regions = np.array([region.name for region in magnet.study.noise.regions])[index]
            self._regions = {name: (regions == name).any(axis=1) for name in np.unique(regions)}

    def __call__(self, what: str, one: Floats, two: Floats) -> Difference:
        change = np.linalg.norm(one - two, axis=1) / self.scale
        fourier = (None if self._circles is None
                   else float(np.abs(self._circles @ (one - two).ravel()).max() / self.scale))
        return Difference(
            what=what, pointwise=float(change.max()), fourier=fourier,
            by_region={name: float(change[mask].max()) for name, mask in self._regions.items()
                       if mask.any()})

