"""Error bars of readings from changes of the mesh, the boundary or the formulation.

All errors are those of the full nominal array, because the errors of the blocks add up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.solver.formulation_choice import (
    MESHES,
    ElementFields,
    choose_route,
    finite_element_part,
)
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.session import Session
from halbach_fe.study.solver import CELLS_PER_SIDE

REFINEMENT = 1.5
"""Factor between the element sizes, and between the distances of the boundary, of two solves."""

DUAL = {"edge_elements": "scalar_potential", "scalar_potential": "edge_elements"}
"""The dual formulation of each formulation that has one."""


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

    ``mesh`` is the kind of mesh, a value of `halbach_fe.solver.formulation_choice.MESHES`.
    """
    end = magnet.half_length
    update = {"radius_m": factor * boundary_radius(magnet, mesh)}
    if magnet.dimension == 3:
        update["half_length_m"] = end + factor * (boundary_half_length(magnet, mesh) - end)
    return magnet.with_(open_boundary=magnet.study.open_boundary.with_(**update))


def dual(magnet: Magnet, route: str) -> Magnet:
    """Return the magnet to be solved by the dual formulation of a route.

    The magnetic energies of the two formulations bracket the exact energy.
    """
    return magnet.with_(solver__route=DUAL[route])


def error_bar_session(session: Session) -> Session:
    """Return the session in a subfolder for error bars, so that the study's runs are kept."""
    return session.within("error-bar")


def reading_errors(
    magnet: Magnet, observation: Observation, parts: ElementFields, session: Session
) -> Floats:
    """Return the error bar of every reading: its change with another discretization.

    On a 3D mesh the other discretization is the dual formulation on the same mesh: the energies of
    the two formulations bracket the exact energy, and the two err in opposite directions at the
    boundary. For the other routes a second mesh is cheap. Their error bar is the sum of the changes
    made by a coarser mesh and by a farther boundary.

    Parameters
    ----------
    magnet : Magnet
    observation : Observation
    parts : ElementFields
        The finite-element part of the field at the observation's points.
    session : Session
        Session for the additional solves, see `error_bar_session`.

    Returns
    -------
    ndarray, shape (readings,), in T
    """
    nominal, known = parts.nominal, parts.error
    if known is not None:
        unknown = np.isnan(known).any(axis=1)
        if unknown.any():  # these points were solved for by another route, see `ElementFields`
            known = known.copy()
            known[unknown] = _change_of_modes(
                magnet, observation.points[unknown], nominal[unknown], session)
        return observation.magnitude(known)
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return np.zeros(len(observation))  # the field is exact: finite elements add nothing
    route = choose_route(magnet, observation.points)

    def change(variant: Magnet, purpose: str) -> Floats:
        other = finite_element_part(
            variant, observation.points, replace(session, purpose=f"error bars, {purpose}"),
            columns=False).nominal
        return observation.magnitude(other - nominal)

    if route in DUAL:
        return change(dual(magnet, route), "dual route")
    return change(refined(magnet, 1 / REFINEMENT), "coarser mesh") + change(
        farther(magnet, MESHES[route], REFINEMENT), "farther boundary")


def _change_of_modes(
    magnet: Magnet, points: Floats, nominal: Floats, session: Session
) -> Floats:
    """Return the change (n, 3) in T by another mesh and boundary of the route azimuthal_modes."""
    magnet, total = magnet.with_(solver__route="azimuthal_modes"), np.zeros_like(nominal)
    for variant, purpose in ((refined(magnet, 1 / REFINEMENT), "coarser mesh"),
                             (farther(magnet, "meridian", REFINEMENT), "farther boundary")):
        other = finite_element_part(variant, points, replace(
            session, purpose=f"error bars, {purpose}"), columns=False).nominal
        total += np.abs(other - nominal)
    return total
