"""Keys of a study that describe mesh, boundary and solver."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import (
    Field,
)

from halbach_fe.study.types import MAX_LENGTH_M, MIN_LENGTH_M, Length, StudyModel


class MeshSettings(StudyModel):
    """Element sizes. In 3D the cross-section is extruded in layers along z.

    ``meridian_size_m`` is that of the (r, z) half-plane, for rotationally symmetric materials
    (default: a twelfth of the blocks' radial thickness).
    """

    block_size_m: Length
    bore_size_m: Length | None = None
    layers_per_ring: Annotated[int, Field(ge=1, le=100)] = 2
    meridian_size_m: Length | None = None
    growth: Annotated[float, Field(gt=1.0, le=4.0)] = 1.4


class OpenBoundary(StudyModel):
    """Where the field is cut off. Elements grow geometrically towards it, so far is cheap."""

    radius_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None
    half_length_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None


class SolverSettings(StudyModel):
    """``reaction``: exact field of the blocks plus the finite-element reaction of permeability
    and iron. ``direct``: the finite-element field as it is.

    ``route`` is how a 3D reaction is computed: ``azimuthal_modes``, one (r, z) problem per mode,
    for rotationally symmetric materials (sectors without gaps); ``edge_elements``, curl-curl in
    3D, for any geometry; ``scalar_potential``, its dual, of second order, for any geometry too.
    ``auto`` takes the first where it can, the scalar potential elsewhere, and edge elements for
    ``direct``. ``edge_order`` is the order of the edge elements. ``symmetry`` lets one block stand
    for those that turning and mirroring the magnet puts in its place.
    """

    method: Literal["reaction", "direct"] = "reaction"
    route: Literal["auto", "azimuthal_modes", "edge_elements", "scalar_potential"] = "auto"
    edge_order: Literal[1, 2] = 1
    symmetry: bool = True
