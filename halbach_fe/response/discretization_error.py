"""Error bars of readings from changes of the mesh, the boundary or the formulation.

All errors are those of the full nominal array, because the errors of the blocks add up.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.solver.azimuthal_modes import modes_needed, solve_modes
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

BOUNDARY_SERIES = 1 / (1 - REFINEMENT**-3)
"""Error of a 3D outer boundary over the change by the farther boundary: 1.4. The field that the
boundary reflects is that of a dipole at most, and falls with the cube of its distance."""

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
    made by a coarser mesh and by a farther boundary. For azimuthal modes the coarser mesh also has
    more modes, so that its change contains the modes that were left out, and both changes are
    extrapolated (`IRON_SERIES`, `BOUNDARY_SERIES`).

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
            known[unknown] = np.abs(_changes_of_modes(
                magnet, observation.points[unknown], nominal[unknown], session)).sum(axis=0)
        return observation.magnitude(known)
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return np.zeros(len(observation))  # the field is exact: finite elements add nothing
    route = choose_route(magnet, observation.points)
    if route == "azimuthal_modes":
        return sum((observation.magnitude(change) for change in _changes_of_modes(
            magnet, observation.points, nominal, session)), np.zeros(len(observation)))

    def change(variant: Magnet, purpose: str) -> Floats:
        other = finite_element_part(
            variant, observation.points, _error_bars(session, purpose), columns=False).nominal
        return observation.magnitude(other - nominal)

    if route in DUAL:
        return change(dual(magnet, route), "dual route")
    return change(refined(magnet, 1 / REFINEMENT), "coarser mesh") + change(
        farther(magnet, MESHES[route], REFINEMENT), "farther boundary")


def _error_bars(session: Session, purpose: str) -> Session:
    """Return the session with the purpose of its runs, for messages."""
    return replace(session, purpose=f"error bars, {purpose}")


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
    return series * (coarser - nominal), BOUNDARY_SERIES * (distant - nominal)
