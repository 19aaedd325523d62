"""Which solver computes the field, and the field of the nominal magnet by it."""

from __future__ import annotations

import numpy as np

from halbach_fe import azimuthal
from halbach_fe.blocks import Floats, blocks_of, points_in_material
from halbach_fe.errors import StudyError
from halbach_fe.exact_field import field_of
from halbach_fe.solve import (
    CROSS_SECTION,
    EDGE_ELEMENTS,
    NOMINAL_SOURCE,
    SCALAR_POTENTIAL,
    Workshop,
    solve_sources,
)
from halbach_fe.study import Study

FORMULATIONS = {"cross_section": CROSS_SECTION, "edge_elements": EDGE_ELEMENTS,
                "scalar_potential": SCALAR_POTENTIAL}


def solve_nominal(study: Study, points: Floats, workshop: Workshop) -> Floats:
    """Field of the nominal array at points (n, 3) in m, by the study's method; (n, 3) in T."""
    check_points(study, points)
    field = finite_element_part(study, points, (NOMINAL_SOURCE, NOMINAL_SOURCE), workshop)[0]
    if study.solver.method == "direct":
        return field
    return field_of(blocks_of(study), points) + field


def finite_element_part(
    study: Study, points: Floats, sources: tuple[int, int], workshop: Workshop
) -> Floats:
    """What finite elements contribute to B for a range of sources, by the route that suits.

    For the method ``direct`` that is B itself, for ``reaction`` the reaction of permeability and
    iron, to be added to the exact field in vacuum.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    sources : (first, last)
        Both included; see `halbach_fe.solve.source_number`.

    Returns
    -------
    ndarray, shape (last - first + 1, n, 3), in T
    """
    first, last = sources
    vacuum = study.array.recoil_permeability == 1.0 and study.iron_ring is None
    if study.solver.method == "reaction" and vacuum:
        return np.zeros((last - first + 1, len(points), 3))
    route = choose_route(study, points)
    if route == "azimuthal_modes":
        fields = azimuthal.mode_fields(study, points, workshop, columns=last > NOMINAL_SOURCE)
        return fields[first:last + 1]
    return solve_sources(study, points, sources, workshop, FORMULATIONS[route])


def choose_route(study: Study, points: Floats) -> str:
    """The study's route, or for ``auto`` the fastest that can do it.

    Raises
    ------
    StudyError
        If azimuthal modes are asked for where they do not apply.
    """
    if study.dimension == 2:
        return "cross_section"
    asked, suits = study.solver.route, azimuthal.suits(study, points)
    if asked == "azimuthal_modes" and not suits:
        raise StudyError(
            f"Input `solver.route` of study {study.name} must be another than "
            "azimuthal_modes here, which needs sectors without angular gaps, and points that are "
            "not too near to the blocks. Leave it out.")
    if asked == "auto":
        if study.solver.method == "direct":
            return "edge_elements"
        return "azimuthal_modes" if suits else "edge_elements"
    return asked


def check_points(study: Study, points: Floats) -> None:
    """Refuse points inside magnet or iron, where the field is not what a probe can read."""
    if study.dimension == 2 and np.ptp(points[:, 2]) > 0:
        raise StudyError(
            f"Input `observation.positions` of study {study.name} must lie in one plane, since it "
            f"is 2D; instead z goes from {points[:, 2].min():g} to {points[:, 2].max():g} m. Use "
            "one circle, or a 3D study.")
    inside = points_in_material(study, points)
    if inside.any():
        x, y, z = points[np.argmax(inside)]
        raise StudyError(
            f"Input `observation.positions` of study {study.name} must lie in air; instead "
            f"{inside.sum()} of {len(points)} points lie inside magnet or iron, the first at "
            f"({x:g}, {y:g}, {z:g}) m. Move them into the bore or beyond the ends.")
