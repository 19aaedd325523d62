"""Keys of a study that describe the mesh, the outer boundary and the solver."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from halbach_fe.study.types import MAX_LENGTH_M, MIN_LENGTH_M, Length, StudyModel

CELLS_PER_SIDE = 2
"""Default number of cells of the method of moments along the sides of a cube."""


class MeshSettings(StudyModel):
    """Sizes of the finite elements.

    ``block_size_m`` holds in the blocks and iron; on the route ``moments`` it is the largest size
    in iron that is not rotationally symmetric. ``bore_size_m`` holds in the bore (default: the
    same). Outside the magnet, elements grow towards the boundary: across the plane by ``growth`` -
    1 per unit of distance, along z by the factor ``growth`` from layer to layer. In 3D the
    cross-section is extruded along z, in ``layers_per_ring`` layers per ring. In iron of any shape
    the elements of thin and round bodies are larger too, in proportion to ``growth`` - 1.

    ``cells_per_side`` divides separate blocks for the method of moments: the number of cells along
    the sides of a cube (default: 2).

    ``meridian_size_m`` is the size in the mesh of the (r, z) half-plane, which is used for
    rotationally symmetric materials (default: a twelfth of the blocks' radial thickness).
    """

    block_size_m: Length
    bore_size_m: Length | None = None
    layers_per_ring: Annotated[int, Field(ge=1, le=100)] = 2
    cells_per_side: Annotated[int, Field(ge=1, le=16)] | None = None
    meridian_size_m: Length | None = None
    growth: Annotated[float, Field(gt=1.0, le=4.0)] = 1.4


class OpenBoundary(StudyModel):
    """The cylinder around the magnet at which the computational domain ends.

    Elements grow towards this boundary, so that a distant boundary costs little. By default it is
    10 to 30 magnet radii away, depending on the kind of mesh.
    """

    radius_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None
    half_length_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None


class SolverSettings(StudyModel):
    """Choice of the method that computes the field.

    ``method``: ``reaction`` adds the finite-element reaction of permeability and iron to the exact
    field that the blocks have in vacuum; ``direct`` is the finite-element field alone.

    ``route`` is the formulation in 3D. ``azimuthal_modes`` solves one (r, z) problem for each mode
    of the azimuth, and needs rotationally symmetric materials (sector blocks without gaps).
    ``edge_elements`` solves the curl-curl equation of the vector potential, for any geometry;
    ``edge_order`` is the order of its elements. ``scalar_potential`` solves the dual problem with
    nodal elements of second order, for any geometry too. These two take the rings to be equal.
    ``moments`` divides the blocks into cells instead of meshing space (method of moments), and
    solves rotationally symmetric iron by azimuthal modes, and iron of any other shape by the scalar
    potential in the iron and the air near it; it is the most accurate for separate blocks, and
    takes each where it is mounted. ``auto`` takes azimuthal modes where possible and
    moments elsewhere, reading by reading, the scalar potential for equal rings with prisms of
    iron, and edge elements for ``method = "direct"``.

    With ``symmetry`` the field of only one block is computed of all those that a rotation or
    reflection of the magnet maps onto one another.
    """

    method: Literal["reaction", "direct"] = "reaction"
    route: Literal["auto", "azimuthal_modes", "moments", "edge_elements",
                   "scalar_potential"] = "auto"
    edge_order: Literal[1, 2] = 1
    symmetry: bool = True
