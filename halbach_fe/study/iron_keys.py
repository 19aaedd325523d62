"""Keys of a study that describe iron: its shape and its magnetization curve."""

from __future__ import annotations

import re
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
import scipy.sparse as sparse
from pydantic import Field, model_validator
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Floats, Ints, face_vectors, polygon_area
from halbach_fe.study import materials
from halbach_fe.study.types import (
    COMPONENTS,
    MAX_LENGTH_M,
    Component,
    Coordinate,
    Gap,
    Length,
    Line,
    Place,
    Places,
    Point,
    Rotation,
    StudyModel,
    crossing,
)


class TableCurve(StudyModel):
    """A magnetization curve as a table of H in A/m and B in T.

    The table is either the CSV file ``file``, with the header ``H_A_per_m,B_T`` (its path is
    relative to the study's folder), or the two lists ``H_A_per_m`` and ``B_T``. When a study is
    read, the numbers of the file replace its name.
    """

    kind: Literal["table"]
    file: Annotated[Line, Field(min_length=1, max_length=4000)] | None = None
    H_A_per_m: tuple[float, ...] = ()
    B_T: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> TableCurve:
        if self.file is None:
            if not (self.H_A_per_m or self.B_T):
                raise ValueError("give a file, or H_A_per_m and B_T")
            materials.table_curve(np.array(self.H_A_per_m), np.array(self.B_T))
        elif self.H_A_per_m or self.B_T:
            raise ValueError("give either a file, or H_A_per_m and B_T, not both")
        return self


class SteelCurve(StudyModel):
    """A magnetization curve that comes with halbach-fe, by name."""

    kind: Literal["steel"]
    name: str

    @model_validator(mode="after")
    def _known(self) -> SteelCurve:
        if self.name not in materials.steels():
            raise ValueError(f"no steel is called '{self.name}'; there are "
                             f"{', '.join(materials.steels())}")
        return self


class FroehlichKennellyCurve(StudyModel):
    """The magnetization curve B = mu_0 H + J_s H / (H + h) of Froehlich and Kennelly.

    J_s is the saturation polarization; h follows from the initial relative permeability.
    """

    kind: Literal["froehlich_kennelly"]
    initial_relative_permeability: Annotated[float, Field(ge=2.0, le=1e6)]
    saturation_polarization_T: Annotated[float, Field(ge=0.01, le=materials.MAX_POLARIZATION)]

    @model_validator(mode="after")
    def _possible(self) -> FroehlichKennellyCurve:
        materials.froehlich_kennelly(self.initial_relative_permeability,
                                     self.saturation_polarization_T)
        return self


class BrauerCurve(StudyModel):
    """Brauer's magnetization curve H = (k1 exp(k2 B^2) + k3) B.

    Where dH/dB would exceed that of vacuum, the curve continues with the slope of vacuum.
    """

    kind: Literal["brauer"]
    k1_m_per_H: Annotated[float, Field(gt=0.0, le=1e6)]
    k2_per_T2: Annotated[float, Field(gt=0.0, le=100.0)]
    k3_m_per_H: Annotated[float, Field(ge=0.0, le=1e6)]

    @model_validator(mode="after")
    def _possible(self) -> BrauerCurve:
        materials.brauer(self.k1_m_per_H, self.k2_per_T2, self.k3_m_per_H)
        return self


IronCurve = Annotated[TableCurve | SteelCurve | FroehlichKennellyCurve | BrauerCurve,
                      Field(discriminator="kind")]


RelativePermeability = Annotated[float, Field(ge=1.0, le=1e6)]


class IronMaterial(StudyModel):
    """Iron with either a constant ``relative_permeability`` or a magnetization ``curve``."""

    relative_permeability: RelativePermeability | None = None
    curve: IronCurve | None = None

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        if (self.relative_permeability is None) == (self.curve is None):
            raise ValueError("give exactly one of relative_permeability and curve")
        return self


Tube = TypeVar("Tube", "IronRing", "IronTube")


def _with_a_wall(tube: Tube) -> Tube:
    """Return a tube whose radii leave iron between them."""
    if tube.outer_radius_m <= tube.inner_radius_m:
        raise ValueError(f"outer_radius_m ({tube.outer_radius_m}) must be larger than "
                         f"inner_radius_m ({tube.inner_radius_m})")
    return tube


class IronRing(IronMaterial):
    """A coaxial iron tube outside the array.

    The iron has either a constant ``relative_permeability`` or a magnetization ``curve``.
    ``length_m`` is along z, centred at z = 0 (default: as long as the array).
    """

    inner_radius_m: Length
    outer_radius_m: Length
    length_m: Length | None = None

    _consistent = model_validator(mode="after")(_with_a_wall)


class PlacedIron(StudyModel):
    """What any body of iron may have: a place, a rotation, and a material of its own.

    ``centre_m`` is where the origin of the body's own axes lies in the magnet, and the rotation
    vector ``rotation_deg`` turns the magnet's axes into them. Without them, the axes are those of
    the magnet. Either ``relative_permeability`` or ``curve`` replaces the material of all bodies.
    The body stands ``repeats`` times, each ``step_m`` beside the last one, and all of them once
    more as mirror images for each axis in ``mirrored``, in the plane across it through the origin.
    """

    centre_m: Places = (0.0, 0.0, 0.0)
    rotation_deg: Rotation = (0.0, 0.0, 0.0)
    repeats: Annotated[int, Field(ge=1, le=512)] = 1
    step_m: Places = (0.0, 0.0, 0.0)
    mirrored: Annotated[tuple[Component, ...], Field(max_length=3)] = ()
    relative_permeability: RelativePermeability | None = None
    curve: IronCurve | None = None

    @model_validator(mode="after")
    def _of_one_material(self) -> Self:
        if self.relative_permeability is not None and self.curve is not None:
            raise ValueError("give at most one of relative_permeability and curve")
        return self

    @model_validator(mode="after")
    def _of_distinct_images(self) -> Self:
        if self.repeats == 1 and any(self.step_m):
            raise ValueError("step_m stands beside repeats, the number of bodies in the row: add "
                             "repeats, 2 or more, or leave step_m out")
        images = self.images
        # shapes are compared by what mirrors change of them; all else is common to the images
        if len({repr([getattr(one, key, None) for key in (
                "centre_m", "rotation_deg", "z_m", "outline_m", "holes", "profile_m",
                "triangles_m")])
                for one in images}) < len(images):
            raise ValueError("repeats and mirrored must make bodies in different places; give "
                             "step_m, and leave out of mirrored what leads to the same place")
        return self

    @property
    def images(self) -> tuple[Self, ...]:
        """The bodies that repeats and mirrored make, each of them alone."""
        found = [self.model_copy(update={
            "repeats": 1, "step_m": (0.0, 0.0, 0.0), "mirrored": (),
            "centre_m": tuple(a + number * b for a, b in zip(
                self.centre_m, self.step_m, strict=True))}) for number in range(self.repeats)]
        for axis in self.mirrored:
            found += [one.mirror_image(COMPONENTS.index(axis)) for one in found]
        return tuple(found)

    def mirror_image(self, axis: int) -> Self:
        """Return the body mirrored in the plane across an axis, 0 for x, through the origin."""
        sign = np.where(np.arange(3) == axis, -1.0, 1.0) + 0.0
        update: dict[str, object] = {
            "centre_m": tuple((sign * self.centre_m + 0.0).tolist()),
            "rotation_deg": tuple((-sign * self.rotation_deg + 0.0).tolist())}
        if axis == 2 and hasattr(self, "z_m"):
            update["z_m"] = 0.0 - self.z_m
        if hasattr(self, "triangles_m"):
            update["triangles_m"] = tuple(
                tuple(map(tuple, corners)) for corners in
                (sign * self.triangles_m)[:, ::-1].tolist()) if self.triangles_m else ()
        if axis < 2 and hasattr(self, "outline_m"):
            update["outline_m"] = tuple(map(tuple, (sign[:2] * self.outline_m).tolist()))
        if axis < 2 and hasattr(self, "holes"):
            update["holes"] = tuple(hole.mirrored(sign[:2]) for hole in self.holes)
        if axis == 2 and hasattr(self, "profile_m"):
            update["profile_m"] = tuple((r, 0.0 - z) for r, z in self.profile_m)
        return self.model_copy(update=update)

    @property
    def own_material(self) -> IronMaterial | None:
        """Its own material, None if it is that of all bodies."""
        if self.relative_permeability is None and self.curve is None:
            return None
        return IronMaterial(relative_permeability=self.relative_permeability, curve=self.curve)


class IronTube(PlacedIron):
    """A tube or, if it is short, a disc with or without a hole (an end plate, a shield).

    It is coaxial unless ``centre_m`` or ``rotation_deg`` place it elsewhere. ``inner_radius_m = 0``
    makes a full disc. ``length_m`` is along its axis, centred at ``z_m`` (default: as long as the
    array). Tubes that touch make a stepped bore.
    """

    kind: Literal["tube"]
    inner_radius_m: Gap
    outer_radius_m: Length
    length_m: Length | None = None
    z_m: Place = 0.0

    _consistent = model_validator(mode="after")(_with_a_wall)


Polygon = Annotated[tuple[tuple[Coordinate, Coordinate], ...],
                    Field(min_length=3, max_length=1000)]


CHORDS = 48
"""Number of chords that stand for the circle of a round hole."""


class IronHole(StudyModel):
    """A hole through a prism along its z axis: a polygon ``outline_m``, or a round one.

    A round one has ``radius_m`` about ``x_m`` and ``y_m``.
    """

    outline_m: Polygon | None = None
    x_m: Coordinate = 0.0
    y_m: Coordinate = 0.0
    radius_m: Length | None = None

    @model_validator(mode="after")
    def _of_one_kind(self) -> IronHole:
        if (self.outline_m is None) == (self.radius_m is None):
            raise ValueError("give either radius_m, with x_m and y_m, or outline_m")
        if self.outline_m is not None and (self.x_m or self.y_m):
            raise ValueError("x_m and y_m are the middle of a round hole; leave them out beside "
                             "outline_m")
        if self.outline_m is not None and crossing(np.array([self.outline_m]))[0]:
            raise ValueError("outline_m must have edges that do not cross, go round it once, "
                             "and some area")
        return self

    @property
    def corners(self) -> Floats:
        """Corners (n, 2) in m, clockwise; `CHORDS` around a circle for a round hole."""
        if self.radius_m is not None:
            angle = -2 * np.pi / CHORDS * np.arange(CHORDS)
            return np.asarray(np.column_stack([self.x_m + self.radius_m * np.cos(angle),
                                               self.y_m + self.radius_m * np.sin(angle)]))
        corners = np.array(self.outline_m)
        return corners if polygon_area(corners) < 0 else corners[::-1]

    def mirrored(self, sign: Floats) -> IronHole:
        """Return the hole with its x and y times signs (2,)."""
        x, y = (sign * (self.x_m, self.y_m) + 0.0).tolist()
        return self.model_copy(update={
            "x_m": x, "y_m": y, "outline_m": None if self.outline_m is None else tuple(
                map(tuple, (sign * self.outline_m).tolist()))})


class IronPrism(PlacedIron):
    """A prism along its own z axis with the polygonal section ``outline_m``, for poles and yokes.

    ``copies`` of it stand at equal angles about that axis, with the ``holes`` of each. ``length_m``
    is along z, centred at ``z_m`` (default: as long as the array; without meaning in 2D).
    """

    kind: Literal["prism"]
    outline_m: Polygon
    holes: Annotated[tuple[IronHole, ...], Field(max_length=200)] = ()
    copies: Annotated[int, Field(ge=1, le=512)] = 1
    length_m: Length | None = None
    z_m: Place = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> IronPrism:
        if crossing(np.array([self.outline_m]))[0]:
            raise ValueError("outline_m must have edges that do not cross, go round it once, "
                             "and some area")
        if np.hypot(*np.array(self.outline_m).T).max() >= MAX_LENGTH_M:
            raise ValueError(f"outline_m must be within {MAX_LENGTH_M:g} m of the axis; is it in "
                             "mm? Then write 0.01 for 10 mm")
        _check_holes(np.array(self.outline_m), [hole.corners for hole in self.holes])
        return self


def _check_holes(outline: Floats, holes: list[Floats]) -> None:
    """Refuse holes that do not lie apart, within the outline (n, 2)."""
    for number, hole in enumerate(holes):
        others = [outline, *holes[:number]]
        if any(_edges_meet(hole, other) for other in others) or not _within(
                hole[:1], outline)[0] or any(_within(hole[:1], other)[0] or _within(
                    other[:1], hole)[0] for other in holes[:number]):
            x, y = hole.mean(axis=0).round(6) + 0.0
            raise ValueError(f"holes[{number + 1}], about ({x:g}, {y:g}) m, must lie within "
                             "outline_m, and neither touch its edges nor another hole; what "
                             "opens to a side belongs into outline_m")


def _within(points: Floats, polygon: Floats) -> Floats:
    """Tell which points (n, 2) lie within a polygon (m, 2)."""
    (x, y), (u, v) = points.T[:, :, None], polygon.T
    after, above = np.roll(polygon, -1, axis=0), v > y
    with np.errstate(divide="ignore", invalid="ignore"):
        left = x < u + (y - v) * (after[:, 0] - u) / (after[:, 1] - v)
    return np.asarray(((above != (after[:, 1] > y)) & left).sum(axis=1) % 2 == 1)


def _edges_meet(first: Floats, second: Floats) -> bool:
    """Tell whether any edges of two polygons (n, 2) and (m, 2) cross or touch."""
    a, b = first @ [1, 1j], np.roll(first, -1, axis=0) @ [1, 1j]
    c, d = second @ [1, 1j], np.roll(second, -1, axis=0) @ [1, 1j]

    def sides(start: Floats, end: Floats, points: Floats) -> Floats:
        along = (end - start)[:, None]
        return np.sign((np.conj(along) * (points[None] - start[:, None])).imag.round(15))

    of_second = sides(a, b, c) * sides(a, b, d)
    of_first = (sides(c, d, a) * sides(c, d, b)).T
    near = [(np.minimum(p, q)[:, None] <= np.maximum(r, s) + 1e-12)  # rounding of coordinates
            & (np.maximum(p, q)[:, None] >= np.minimum(r, s) - 1e-12)
            for p, q, r, s in ((a.real, b.real, c.real, d.real), (a.imag, b.imag, c.imag, d.imag))]
    # edges on one line have no sides, and meet only where their boxes do
    return bool(((of_first <= 0) & (of_second <= 0) & near[0] & near[1]).any())


class IronRevolved(PlacedIron):
    """A body of revolution about its own z axis, by its section ``profile_m``: corners r and z.

    The section is closed; it may have one side on the axis, r = 0. A tapered pole, a cap or a
    flanged tube is one body.
    """

    kind: Literal["revolved"]
    profile_m: Annotated[tuple[tuple[Gap, Coordinate], ...], Field(min_length=3, max_length=200)]

    @model_validator(mode="after")
    def _consistent(self) -> IronRevolved:
        profile = np.array(self.profile_m)
        if crossing(profile[None])[0]:
            raise ValueError("profile_m must have edges that do not cross, go round it once, "
                             "and some area; its corners are r and z")
        on_axis = profile[:, 0] == 0
        if on_axis.any() and not (on_axis.sum() == 2 and (on_axis & np.roll(on_axis, 1)).any()):
            raise ValueError("profile_m must have no corner on the axis, r = 0, or two that follow "
                             "one another")
        return self


class IronBox(PlacedIron):
    """A box, ``size_m`` wide along its own three axes, with its middle at ``centre_m``."""

    kind: Literal["box"]
    size_m: tuple[Length, Length, Length]


class IronSphere(PlacedIron):
    """A sphere of ``radius_m`` with its middle at ``centre_m``."""

    kind: Literal["sphere"]
    radius_m: Length


class IronMesh(PlacedIron):
    """A body of any shape, by the triangles of its surface: a ``file`` of the kind STL.

    Its coordinates are those of the file times ``unit_m``, along the body's own axes, and its path
    is relative to the study's folder. The triangles must close the surface. When a study is read,
    ``triangles_m`` in m replace the file's name; the field takes the body as it is, with flat
    faces.
    """

    kind: Literal["stl"]
    file: Annotated[Line, Field(min_length=1, max_length=4000)] | None = None
    unit_m: Annotated[float, Field(ge=1e-6, le=1.0)] = 1e-3
    triangles_m: Annotated[tuple[tuple[Point, Point, Point], ...], Field(max_length=5000)] = ()

    @model_validator(mode="after")
    def _consistent(self) -> IronMesh:
        if (self.file is None) == (not self.triangles_m):
            raise ValueError("give either a file or triangles_m")
        if self.triangles_m and self.unit_m != type(self).model_fields["unit_m"].default:
            raise ValueError("unit_m is that of a file; triangles_m are in m, so leave unit_m out")
        if self.triangles_m:
            closed_surface(np.array(self.triangles_m))
        return self


def closed_surface(triangles: Floats) -> Floats:
    """Return the triangles (n, 3, 3) of a closed surface, with their normals outwards.

    Raises
    ------
    ValueError
        If the surface is open, some triangles are turned over, or it is that of several bodies.
    """
    size = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if not (np.linalg.norm(face_vectors(triangles), axis=1) > 1e-12 * size**2).all():
        raise ValueError("every triangle must have an area; remove those without")
    same = 1e-6  # distance of corners that are one, relative to the size: STL has seven digits
    number = np.unique((triangles / (same * size)).round().reshape(-1, 3), axis=0,
                       return_inverse=True)[1].reshape(-1, 3)
    edges = np.vstack([number[:, [0, 1]], number[:, [1, 2]], number[:, [2, 0]]])
    found = {tuple(edge) for edge in edges.tolist()}
    if len(found) < len(edges):
        raise ValueError("an edge belongs to several triangles on the same side; the surface must "
                         "go around the body once, with all normals outwards")
    lone = [edge for edge in found if edge[::-1] not in found]
    if lone:
        x, y, z = triangles.reshape(-1, 3)[np.argmax(number.ravel() == lone[0][0])]
        raise ValueError(f"the surface must be closed, but {len(lone)} edges belong to a single "
                         f"triangle, one of them at ({x:g}, {y:g}, {z:g}) m; repair the surface, "
                         "and export it as a solid")
    pairs = sparse.coo_array((np.ones(len(edges)), edges.T))
    shell = connected_components(pairs, directed=False)[1][number[:, 0]]
    volumes = np.asarray(np.bincount(shell, np.einsum(
        "ni,ni->n", triangles[:, 0] - triangles[0, 0],
        np.cross(triangles[:, 1] - triangles[0, 0], triangles[:, 2] - triangles[0, 0]))), float)
    outer = int(np.abs(volumes).argmax())
    if volumes[outer] < 0:
        triangles, volumes = triangles[:, ::-1], -volumes
    _check_cavities(triangles, shell, volumes)
    return triangles


def _check_cavities(triangles: Floats, shell: Ints, volumes: Floats) -> None:
    """Refuse shells of triangles (n, 3, 3) but an outer one and its cavities.

    ``shell`` (n,) is that of each triangle, and ``volumes`` (shells,) have the sign of its normals.
    """
    if (volumes > 0).sum() > 1:
        raise ValueError(f"it has {(volumes > 0).sum()} closed shells with normals outwards, but a "
                         "file is one body; export every body to a file of its own, and list them "
                         "as bodies (a cavity has its normals into the cavity)")
    for other in np.flatnonzero(volumes < 0):
        if windings(triangles[shell != other], triangles[shell == other][0, :1])[0] < 0.5:
            raise ValueError("it has a closed shell with normals inwards that is no cavity, since "
                             "it does not lie inside the outer shell, or lies in another cavity; "
                             "turn its normals, and export it to a file of its own")


def windings(triangles: Floats, points: Floats) -> Floats:
    """Return how often triangles (m, 3, 3) go around points (n, 3): 1 inside, and 0 outside.

    That is the sum of their solid angles over 4 pi (A. van Oosterom, J. Strackee, IEEE Trans.
    Biomed. Eng. 30 (1983) 125), if their normals point outwards.
    """
    a, b, c = np.moveaxis(triangles[None] - points[:, None, None], 2, 0)
    far = np.stack([np.linalg.norm(each, axis=2) for each in (a, b, c)])
    rest = far.prod(axis=0) + sum(
        np.einsum("nmi,nmi->nm", one, other) * far[side] for one, other, side in (
            (a, b, 2), (b, c, 0), (c, a, 1)))
    return np.asarray(np.arctan2(np.einsum("nmi,nmi->nm", a, np.cross(b, c)), rest).sum(
        axis=1) / (2 * np.pi))


def read_stl(path: Path) -> Floats:
    """Read the triangles (n, 3, 3) of an STL file, binary or text, in its own unit.

    Raises
    ------
    ValueError
        If it is no such file.
    OSError
        If it cannot be read.
    """
    most_bytes = 5_000_000
    with path.open("rb") as file:
        raw = file.read(most_bytes + 1)
    if raw.lstrip().startswith(b"ISO-10303-21"):  # damaged ones crash the libraries that read them
        names = quote(path.name), quote(f"{path.stem}.stl")
        raise ValueError("it is a STEP file; make an STL file in mm of it by the command "
                         "gmsh -2 -clscale 20 -clcurv 800 {} -o {}".format(*names))
    if len(raw) > most_bytes:
        raise ValueError("it is too large; export it with fewer triangles")
    count = int.from_bytes(raw[80:84], "little")
    if len(raw) >= 84 and len(raw) == 84 + 50 * count:
        rows = np.frombuffer(raw, np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]),
                             count, 84)
        found = rows["c"].astype(float)
    else:
        number = rb"\s+([-+0-9.eE]{1,40})"
        corners = re.findall(rb"vertex" + 3 * number + rb"(?=\s)", raw)
        if not raw.lstrip().startswith(b"solid") or len(corners) != raw.count(b"vertex") or (
                len(corners) % 3):
            raise ValueError("it is no STL file; export the body as one")
        found = np.array([[float(part) for part in corner] for corner in corners]).reshape(-1, 3, 3)
    most = 1e9  # in any unit a body is smaller
    if not len(found) or not (np.abs(found) < most).all():
        raise ValueError("it has no triangles, or such without finite corners")
    return found


IronBody = Annotated[IronTube | IronPrism | IronBox | IronSphere | IronRevolved | IronMesh,
                     Field(discriminator="kind")]


class Iron(StudyModel):
    """Iron of any number of bodies.

    Either ``relative_permeability`` or a magnetization ``curve`` is the material of all bodies that
    do not state their own.
    """

    relative_permeability: RelativePermeability | None = None
    curve: IronCurve | None = None
    bodies: Annotated[tuple[IronBody, ...], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _of_some_material(self) -> Self:
        given = (self.relative_permeability is not None) + (self.curve is not None)
        if given > 1 or (not given and any(body.own_material is None for body in self.bodies)):
            raise ValueError("give exactly one of relative_permeability and curve, for all bodies "
                             "or for each")
        return self

    @property
    def each(self) -> tuple[IronBody, ...]:
        """The bodies one by one, with those that repeats and mirrored make."""
        return tuple(one for body in self.bodies for one in body.images)
