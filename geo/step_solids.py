"""Solids with openings for machining: their STEP text and the triangles of their surface.

Gmsh's OpenCASCADE makes the solids. It cuts all openings of a plate at once; a plate with 50
pockets takes seconds.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
from collections.abc import Iterator, Sequence
from ctypes import CDLL
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeshError, OutputError
from halbach_fe.core.files import is_full
from halbach_fe.geo.gmsh_session import gmsh_session
from halbach_fe.geometry.outline import Prism

STEP_END = "END-ISO-10303-21;"
"""Last line of a STEP file."""

PER_M = 1e3
"""Units of STEP and STL files per metre: they are in mm."""


def solid(name: str, body: Prism, openings: Sequence[Prism] = ()) -> tuple[str, Floats]:
    """Make a solid: a prism without its openings.

    Parameters
    ----------
    name : str
        What it is, for error messages.
    openings : sequence of Prism
        They may reach beyond the body, and overlap.

    Returns
    -------
    step : str
        A STEP file (AP214) of the solid alone, in mm.
    triangles : ndarray, shape (n, 3, 3), in mm
        Corners of the triangles of its surface, counter-clockwise as seen from outside.

    Raises
    ------
    MeshError
        If Gmsh fails, or the solid falls apart.
    """
    with gmsh_session(name):
        occ = gmsh.model.occ
        made = [(3, _prism(body))]
        if openings:
            made, _ = occ.cut(made, [(3, _prism(opening)) for opening in openings])
        occ.synchronize()
        if len(made) != 1:
            raise MeshError(f"The openings of {name} leave {len(made)} pieces of it. Reduce the "
                            "openings, or move them apart.")
        return _step_text(), _triangles()


def _prism(prism: Prism) -> int:
    """Add a prism to the Gmsh model, in mm; return its tag."""
    occ, z = gmsh.model.occ, PER_M * prism.z_min
    starts = [occ.addPoint(PER_M * x, PER_M * y, z) for (x, y), _, _ in prism.curves]
    curves = []
    for number, (_, _, centre) in enumerate(prism.curves):
        ends = starts[number], starts[(number + 1) % len(starts)]
        if centre is None:
            curves.append(occ.addLine(*ends))
            continue
        middle = occ.addPoint(PER_M * centre[0], PER_M * centre[1], z)
        curves.append(occ.addCircleArc(ends[0], middle, ends[1]))
        occ.remove([(0, middle)])
    face = occ.addPlaneSurface([occ.addCurveLoop(curves)])
    found = occ.extrude([(2, face)], 0, 0, PER_M * (prism.z_max - prism.z_min))
    return next(tag for dimension, tag in found if dimension == 3)


def _step_text() -> str:
    """Return the model as the text of a STEP file.

    OutputError if the temporary file cannot be written. Gmsh itself does not notice a full disk.
    """
    gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
    with TemporaryDirectory(prefix="halbach-fe-") as folder:
        path = Path(folder, "solid.step")
        with _silent_stdout(), contextlib.suppress(Exception):  # Gmsh raises nothing else
            gmsh.write(str(path))
        text = path.read_text(encoding="ascii") if path.exists() else ""
        if not text.rstrip().endswith(STEP_END):
            reason = os.strerror(errno.ENOSPC if is_full(path.parent) else errno.EFBIG)
            raise OutputError(f"Cannot write {path}: {reason}; {len(text)} bytes could be written.")
        return text


@contextlib.contextmanager
def _silent_stdout() -> Iterator[None]:
    """Drop what C++ prints: OpenCASCADE reports every STEP file that it writes."""
    try:
        kept = os.dup(1)
    except OSError:  # standard output is closed
        yield
        return
    sys.stdout.flush()
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        CDLL(None).fflush(None)  # C keeps what is not for a terminal
        os.dup2(kept, 1)
        os.close(kept)
        os.close(null)


def _triangles() -> Floats:
    """Return the triangles of the surface of the model's only solid, in mm."""
    mesh = gmsh.model.mesh
    sagitta_mm = 0.005  # largest distance in mm of a triangle from the arc that it replaces
    for _, curve in gmsh.model.getEntities(1):
        count = 1
        if gmsh.model.getType(1, curve) == "Circle":
            (low,), (high,) = gmsh.model.getParametrizationBounds(1, curve)
            radius = gmsh.model.occ.getMass(1, curve) / (high - low)
            step = 2 * np.arccos(1 - min(sagitta_mm / radius, 0.5))
            count = max(2, int(np.ceil((high - low) / step)))
        mesh.setTransfiniteCurve(curve, count + 1)
    for _, surface in gmsh.model.getEntities(2):
        if gmsh.model.getType(2, surface) == "Cylinder":  # else triangles would cut through it
            mesh.setTransfiniteSurface(surface)
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{option}", 0)
    (_, volume), = gmsh.model.getEntities(3)
    mesh.setOutwardOrientation(volume)
    mesh.generate(2)
    tags, points, _ = mesh.getNodes()
    row = np.zeros(int(tags.max()) + 1, int)
    row[tags.astype(int)] = np.arange(len(tags))
    triangle = 2  # Gmsh's element type of triangles
    _, nodes = mesh.getElementsByType(triangle)
    return np.asarray(points.reshape(-1, 3)[row[nodes.astype(int)]].reshape(-1, 3, 3))


HEADER = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION(({description}),'2;1');
FILE_NAME({name},'',(''),(''),'Open CASCADE','halbach-fe','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 10303 214 1 1 1 1 }}'));
ENDSEC;
DATA;
"""

CONTEXT = """{0}=APPLICATION_CONTEXT('core data for automotive mechanical design processes');
{1}=APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{0});
{2}=PRODUCT_CONTEXT('',{0},'mechanical');
{3}=PRODUCT_DEFINITION_CONTEXT('part definition',{0},'design');
{4}=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));
{5}=(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.));
{6}=(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT());
{7}=UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),{4},'distance_accuracy_value','');
{8}=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({7}))\
GLOBAL_UNIT_ASSIGNED_CONTEXT(({4},{5},{6}))REPRESENTATION_CONTEXT('',''));
"""

PRODUCT = """{0}=PRODUCT({name},{name},'',({product_context}));
{1}=PRODUCT_RELATED_PRODUCT_CATEGORY('part',$,({0}));
{2}=PRODUCT_DEFINITION_FORMATION('','',{0});
{3}=PRODUCT_DEFINITION('design','',{2},{definition_context});
{4}=PRODUCT_DEFINITION_SHAPE('','',{3});
{5}=SHAPE_DEFINITION_REPRESENTATION({4},{shape});
"""

OCCURRENCE = """{0}=NEXT_ASSEMBLY_USAGE_OCCURRENCE({id},{name},'',{parent},{child},$);
{1}=PRODUCT_DEFINITION_SHAPE('Placement','Placement of an item',{0});
{2}=ITEM_DEFINED_TRANSFORMATION('','',{own_axes},{axes});
{3}=(REPRESENTATION_RELATIONSHIP('','',{child_shape},{parent_shape})\
REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION({2})SHAPE_REPRESENTATION_RELATIONSHIP());
{4}=CONTEXT_DEPENDENT_SHAPE_REPRESENTATION({3},{1});
"""

AXES = """{0}=CARTESIAN_POINT('',({origin}));
{1}=DIRECTION('',({z}));
{2}=DIRECTION('',({x}));
{3}=AXIS2_PLACEMENT_3D('',{0},{1},{2});
"""

MANAGEMENT = ("APPLICATION_PROTOCOL_DEFINITION", "APPLICATION_CONTEXT", "PRODUCT",
              "SHAPE_DEFINITION_REPRESENTATION")
"""Beginnings of the entities of a single solid's file that are written anew."""


@dataclass(frozen=True)
class Solid:
    """A solid with a name; ``step`` is the text of a STEP file of the solid alone."""

    name: str
    step: str


@dataclass(frozen=True)
class Group:
    """A product that consists of others."""

    name: str
    members: Sequence[Occurrence]


@dataclass(frozen=True)
class Occurrence:
    """A part in its place."""

    part: Solid | Group
    name: str
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    """Place of the part's origin. Shape (3,), in mm."""
    axes: Floats = field(default_factory=lambda: np.eye(3))
    """Axes of the part as columns. Shape (3, 3)."""


class _Product(NamedTuple):
    """Numbers of the entities of a product: definition, shape, and axes of the shape."""

    definition: str
    shape: str
    axes: str


def step_text(top: Solid | Group, description: str) -> str:
    """Return the text of the STEP file of a part.

    Raises
    ------
    MeshError
        If the text of a solid is not as OpenCASCADE writes it.
    """
    return _Writer(top, description).text()


def quoted(text: str) -> str:
    """Return a text as a string of a STEP file, which is ASCII."""
    found = "".join(
        character if " " <= character <= "~" else
        f"\\X2\\{character.encode('utf-16-be').hex().upper()}\\X0\\" if ord(character) < 0x10000
        else f"\\X4\\{ord(character):08X}\\X0\\"
        for character in text.replace("\\", "\\\\").replace("'", "''"))
    return f"'{found}'"


class _Writer:
    """Collects the entities of a file; products that are used again are written once."""

    def __init__(self, top: Solid | Group, description: str) -> None:
        self.top, self.description = top, description
        self.parts: list[str] = []
        self.count = self.occurrences = 0
        self.products: dict[int, _Product] = {}
        context = self.add(CONTEXT, 9)
        self.contexts = {"product_context": context[2], "definition_context": context[3]}
        self.geometry = context[8]

    def text(self) -> str:
        """Return the whole file."""
        self.product(self.top)
        head = HEADER.format(description=quoted(self.description), name=quoted(self.top.name))
        return head + "".join(self.parts) + "ENDSEC;\nEND-ISO-10303-21;\n"

    def add(self, template: str, count: int, **values: str) -> list[str]:
        """Add entities with new numbers, which the template counts from 0; return the numbers."""
        numbers = [f"#{self.count + number}" for number in range(1, count + 1)]
        self.count += count
        self.parts.append(template.format(*numbers, **values))
        return numbers

    def axes(self, origin: Floats, axes: Floats) -> str:
        """Add a place; return its number."""
        return self.add(AXES, 4, **{name: ",".join(map(_real, values)) for name, values in (
            ("origin", origin), ("z", axes[:, 2]), ("x", axes[:, 0]))})[3]

    def product(self, part: Solid | Group) -> _Product:
        """Add a part, and what it consists of, unless it is there."""
        if id(part) in self.products:
            return self.products[id(part)]
        if isinstance(part, Solid):
            shape, own = self.solid(part)
            members = []
        else:
            members = [(one, self.product(one.part), self.axes(one.origin, one.axes))
                       for one in part.members]
            own = self.axes(np.zeros(3), np.eye(3))
            items = ",".join([own, *(axes for _, _, axes in members)])
            shape, = self.add("{0}=SHAPE_REPRESENTATION({name},({items}),{context});\n", 1,
                              name=quoted(part.name), items=items, context=self.geometry)
        definition = self.add(PRODUCT, 6, name=quoted(part.name), shape=shape, **self.contexts)[3]
        for one, product, axes in members:
            self.occurrences += 1
            self.add(OCCURRENCE, 5, id=quoted(str(self.occurrences)), name=quoted(one.name),
                     parent=definition, child=product.definition, own_axes=product.axes, axes=axes,
                     child_shape=product.shape, parent_shape=shape)
        found = self.products[id(part)] = _Product(definition, shape, own)
        return found

    def solid(self, part: Solid) -> tuple[str, str]:
        """Add the geometry of a solid; return the numbers of its shape and of the shape's axes."""
        data = part.step.partition("DATA;")[2].partition("ENDSEC;")[0]
        entities = [" ".join(one.split()) for one in data.split(";")]
        kept = [one for one in entities if (name := one.partition("= ")[2]) and
                not name.startswith(MANAGEMENT)]
        first = self.count

        def renumber(found: re.Match[str]) -> str:
            return f"#{first + int(found[1])}"

        shape = axes = ""
        for entity in kept:
            text = re.sub(r"#(\d+)", renumber, entity)
            if "= ADVANCED_BREP_SHAPE_REPRESENTATION(" in text:
                shape, axes = re.findall(r"#\d+", text)[:2]
            text = text.replace("MANIFOLD_SOLID_BREP('',",
                                f"MANIFOLD_SOLID_BREP({quoted(part.name)},")
            self.parts.append(f"{text};\n")
        if not shape:
            raise MeshError(f"Gmsh wrote no solid for {part.name}.")
        self.count += max(int(one.partition("=")[0].strip(" #")) for one in kept)
        return shape, axes


def _real(value: float) -> str:
    """Return a number as STEP writes it, with a point."""
    text = f"{value + 0.0:.12g}".upper()
    mantissa, exponent, power = text.partition("E")
    return (mantissa if "." in mantissa else f"{mantissa}.") + exponent + power
