"""The computational domain of a mesh: its outer boundary, and the tags of its regions.

The region file, which relates the physical tags of a mesh to the parts of the magnet, is written
beside the mesh; the solver reads it and refuses a mesh that does not match.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from halbach_fe.core.errors import MeshError, StudyError
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import Magnet

AIR_TAG = 1
IRON_TAG = 2
SHELL_TAG = 3
OUTER_BOUNDARY_TAG = 10
AXIS_TAG = 11
FIRST_BLOCK_TAG = 1001

Tag = Annotated[int, Field(ge=1, lt=2**31)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,100}$")]
"""A name that is safe to write into GetDP's input files."""


class BlockRegion(BaseModel):
    """The physical tag of a block, or of a whole ring of blocks (slot 0) in a half-plane mesh."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: Name
    ring: int
    slot: int
    tag: Tag


class Regions(BaseModel):
    """Names and tags of every physical group of a mesh."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    study: Name
    dimension: Literal[2, 3]
    air: Tag
    iron: Tag | None
    outer_boundary: Tag
    axis: Tag | None = None
    shell: Tag | None = None
    blocks: tuple[BlockRegion, ...]

    @property
    def volume_tags(self) -> tuple[int, ...]:
        """Tags of all regions with elements of the mesh's dimension (surfaces in 2D)."""
        some = (tag for tag in (self.iron, self.shell) if tag is not None)
        return (self.air, *some, *(block.tag for block in self.blocks))

    @property
    def names(self) -> dict[int, str]:
        """Names of the regions by tag, for messages."""
        names = {self.air: "air", self.outer_boundary: "outer boundary"}
        if self.iron is not None:
            names[self.iron] = "iron ring"
        if self.shell is not None:
            names[self.shell] = "shell to infinity"
        return names | {block.tag: f"block {block.name}" for block in self.blocks}

    def write(self, path: Path) -> None:
        """Write the region file as JSON; raise OutputError on failure."""
        write_text(path, self.model_dump_json(indent=1) + "\n")

    @classmethod
    def read(cls, path: Path) -> Regions:
        """Read a file that `write` wrote; raise MeshError if that fails."""
        try:
            return cls.model_validate_json(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, ValidationError) as error:
            raise MeshError(
                f"Input region file {path} must be one written beside a mesh; instead reading it "
                f"failed with '{str(error).splitlines()[0]}'. Mesh the study again."
            ) from None


BOUNDARY_RATIO = {"cross_section": 30.0, "extruded": 10.0, "meridian": 20.0}
"""Ratio of the boundary's radius to the magnet's radius, by kind of mesh. The far field of a block
falls as 1/r^2 in 2D and 1/r^3 in 3D, and so does the relative error that the boundary causes: 1e-3
at these ratios. Elements grow towards the boundary, so that distance is cheap, and cheapest in the
(r, z) half-plane, where the boundary is therefore farther than in the extruded mesh."""


def boundary_radius(magnet: Magnet, mesh: str) -> float:
    """Return the radius in m of the outer boundary of a kind of mesh (a key of BOUNDARY_RATIO).

    Raises
    ------
    StudyError
        If the study puts the boundary too close to the magnet.
    """
    inside = magnet.radius
    default = BOUNDARY_RATIO[mesh] * inside
    radius = magnet.study.open_boundary.radius_m or default
    if radius <= 1.2 * inside:
        raise StudyError(
            f"Input `open_boundary.radius_m` of study must be well beyond the magnet "
            f"({inside:g} m); instead received {radius:g}. Leave it out for {default:g}."
        )
    return radius


def boundary_half_length(magnet: Magnet, mesh: str) -> float:
    """Return half the length in m of a kind of mesh (a key of BOUNDARY_RATIO).

    Raises
    ------
    StudyError
        If the study puts the boundary too close to the magnet.
    """
    end, radius = magnet.half_length, magnet.radius
    default = end + BOUNDARY_RATIO[mesh] * radius
    half = magnet.study.open_boundary.half_length_m or default
    if half <= end + 0.2 * radius:
        raise StudyError(
            f"Input `open_boundary.half_length_m` of study must be well beyond the magnet's end "
            f"({end:g} m); instead received {half:g}. Leave it out for {default:g}."
        )
    return half
