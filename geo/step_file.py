"""STEP files of named parts and assemblies (AP214, in mm), from the STEP text of single solids.

Gmsh gives solids no names when it writes them, and writes every copy of a solid again. So the
products, their places and the names of both are written here: a solid that occurs a thousand times
is there once, which makes the file ten times smaller and faster to write.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeshError

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
    """A part in its place.

    Attributes
    ----------
    part : Solid or Group
    name : str
    origin : ndarray, shape (3,), in mm
        Place of the part's origin.
    axes : ndarray, shape (3, 3)
        Axes of the part as columns.
    """

    part: Solid | Group
    name: str
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    axes: Floats = field(default_factory=lambda: np.eye(3))


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
