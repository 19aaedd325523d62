"""How far the mesh, the boundary or the formulation moves the field: error bars for readings.

All errors are those of the full nominal array, where the errors of blocks add up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.solver.field import MESHES, ElementFields, choose_route, finite_element_part
from halbach_fe.solver.mesh import meridian_size
from halbach_fe.solver.session import Session

REFINEMENT = 1.5
DUAL = {"edge_elements": "scalar_potential", "scalar_potential": "edge_elements"}


def refined(magnet: Magnet, factor: float) -> Magnet:
    """The magnet with all elements smaller by a factor.

    It is not validated: the limits of a study file catch wrong units, and a coarser mesh than
    anybody should ask for may well serve an error bar.
    """
    mesh = magnet.study.mesh
    bore = mesh.bore_size_m or mesh.block_size_m
    return magnet.with_study(magnet.study.model_copy(update={"mesh": mesh.model_copy(update={
        "block_size_m": mesh.block_size_m / factor, "bore_size_m": bore / factor,
        "meridian_size_m": meridian_size(magnet) / factor,
        "layers_per_ring": max(1, round(mesh.layers_per_ring * factor)),
        "growth": 1 + (mesh.growth - 1) / factor})}))


def farther(magnet: Magnet, mesh: str, factor: float) -> Magnet:
    """The magnet with the boundary of a kind of mesh farther by a factor."""
    end = magnet.half_length
    update = {"radius_m": factor * boundary_radius(magnet, mesh)}
    if magnet.dimension == 3:
        update["half_length_m"] = end + factor * (boundary_half_length(magnet, mesh) - end)
    return magnet.with_(open_boundary=magnet.study.open_boundary.with_(**update))


def dual(magnet: Magnet, route: str) -> Magnet:
    """The magnet solved by the other of two formulations that bracket the truth."""
    return magnet.with_(solver__route=DUAL[route])


def error_bar_session(session: Session) -> Session:
    """The session with a folder of its own for error bars: the study's run folders are kept."""
    return session.within("error-bar")


def reading_errors(
    magnet: Magnet, observation: Observation, parts: ElementFields, session: Session
) -> Floats:
    """Error bar of every reading, (readings,) in T, by what another discretization says.

    On a 3D mesh that is the dual formulation on the same mesh: the truth lies between them, as far
    as energies go, and they err in opposite directions at the boundary. Elsewhere, where a second
    mesh is cheap, it is a coarser one, and a farther boundary.

    Parameters
    ----------
    parts : ElementFields
        The finite-element part of the field at the observation's points.
    """
    nominal = parts.nominal
    if parts.error is not None:
        return observation.magnitude(parts.error)
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return np.zeros(len(observation))  # nothing is left to finite elements
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
