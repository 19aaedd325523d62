"""Types of the keys of a study, with limits that reveal a wrong unit."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from halbach_fe.core.arrays import Bools, Floats, Ints, slices
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study import sentences

MAX_LENGTH_M = 10.0
MIN_LENGTH_M = 1e-4
MIN_SIGMA_T, MAX_SIGMA_T = 1e-15, 1.0
"""Limits of the standard deviation of a reading in T: no probe is as exact, or as bad, and squares
of other numbers may be zero or infinite."""
MAX_POINTS = 1_000_000
USUAL_REACH_M = 0.1
"""Distance in m from the middle to which magnets of permanent blocks reach, if no study says it."""

# The limits are there to reveal a wrong unit (mm for m, mT for T); they are wider than is sensible,
# and exclude the round numbers that are meant in mm: 10 for 10 mm.
Length = Annotated[float, Field(ge=MIN_LENGTH_M, lt=MAX_LENGTH_M, allow_inf_nan=False)]
Gap = Annotated[float, Field(ge=0.0, lt=MAX_LENGTH_M, allow_inf_nan=False)]
Coordinate = Annotated[
    float, Field(ge=-10 * MAX_LENGTH_M, le=10 * MAX_LENGTH_M, allow_inf_nan=False)]
Remanence = Annotated[float, Field(gt=0.0, le=2.0, allow_inf_nan=False)]
RecoilPermeability = Annotated[float, Field(ge=1.0, le=2.0)]
Angle = Annotated[float, Field(ge=-720.0, le=720.0, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Place = Annotated[float, Field(gt=-MAX_LENGTH_M, lt=MAX_LENGTH_M, allow_inf_nan=False)]
Places = tuple[Place, Place, Place]
Offset = Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)]
Displacement = tuple[Offset, Offset, Offset]
Rotation = tuple[Angle, Angle, Angle]
Moment = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)]
Fractions = tuple[Fraction, Fraction, Fraction]
Turn = Annotated[float, Field(ge=-6.3, le=6.3, allow_inf_nan=False)]
RotationVector = tuple[Turn, Turn, Turn]
RadiusScale = Annotated[float, Field(ge=-0.9, le=2.0, allow_inf_nan=False)]
Unit = Annotated[float, Field(ge=1e-9, le=1e3, allow_inf_nan=False)]
Sigma = Annotated[float, Field(ge=MIN_SIGMA_T, le=MAX_SIGMA_T, allow_inf_nan=False)]
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
Axes = tuple[SignedAxis, SignedAxis, SignedAxis]
FluxDensityOffset = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]
FluxDensityVector = tuple[FluxDensityOffset, FluxDensityOffset, FluxDensityOffset]
GridCount = Annotated[int, Field(ge=1, le=10_000)]
PositionSd = Annotated[float, Field(ge=0.0, le=0.01, allow_inf_nan=False)]
Temperature = Annotated[float, Field(ge=sentences.ABSOLUTE_ZERO_C, le=500.0, allow_inf_nan=False)]
ReferenceTemperature = Annotated[float, Field(ge=-200.0, le=200.0, allow_inf_nan=False)]
"""Temperature in degrees Celsius at which a material was measured; room temperature in kelvin is
beyond the limit."""
RISING_PER_K = 5e-4
"""Largest temperature coefficient of magnets other than the coercivity of ferrite: remanences of
compensated SmCo are constant, and coercivities of AlNiCo rise by up to 3e-4/K."""
RemanenceCoefficient = Annotated[float, Field(ge=-0.01, le=RISING_PER_K)]
Component = Literal["x", "y", "z"]
COMPONENTS: tuple[Component, ...] = ("x", "y", "z")


def look_like_mm(points: Floats, reach_m: float = USUAL_REACH_M) -> Bools:
    """Tell of points (n, 3), read in m, which are rather in mm, for a magnet of a reach in m.

    The limit is half-way by factors between 1 m and 1 mm: beyond it, a thousandth of the distance
    is nearer to the magnet's reach than the distance is.
    """
    return np.asarray(np.linalg.norm(points, axis=1) > np.sqrt(1000.0) * reach_m)


def one_or_list(kind: Any) -> BeforeValidator:
    """Return a validator that lets a single value stand for a list of one element."""
    return BeforeValidator(lambda value: value if isinstance(value, list | tuple) else (value,),
                           json_schema_input_type=Union[kind, list[kind]])  # noqa: UP007


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("control characters are not allowed here")
    return text


def _lines(text: str) -> str:
    for line in text.split("\n"):
        _one_line(line.replace("\t", " "))
    return text


Line = Annotated[str, AfterValidator(_one_line)]
"""Text without control characters or line breaks: it is shown on terminals, in reports, in tables.
"""
Lines = Annotated[str, AfterValidator(_lines)]
"""Text of any number of lines, in which tabs are allowed too."""


def _leaves(annotation: Any) -> set[Any]:
    """Return the types of which an annotation consists."""
    inner = get_args(annotation)
    if not inner or get_origin(annotation) is Literal:
        return {annotation}
    if get_origin(annotation) is Annotated:
        inner = inner[:1]
    return set().union(*(_leaves(each) for each in inner if each is not ...))


@cache
def _numbers(model: type[BaseModel]) -> frozenset[str]:
    """Return the keys of a table whose values are numbers, or lists of numbers."""
    return frozenset(name for name, field in model.model_fields.items()
                     if _leaves(field.annotation) <= {int, float, NoneType})


def _elements(value: Any) -> Iterator[Any]:
    """Iterate over a value, or over the elements of lists of any depth."""
    if isinstance(value, list | tuple):
        for each in value:
            yield from _elements(each)
    else:
        yield value


def _as_toml(value: bool | str) -> str:
    """Return true, false or text as a study file writes it."""
    return str(value).lower() if isinstance(value, bool) else f'the text "{value}"'


def _is_number(text: str) -> bool:
    """Tell whether text reads as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


class StudyModel(BaseModel):
    """Base of all tables of a study file: unknown keys are errors, and instances are immutable.

    Examples
    --------
    >>> from halbach_fe.study.model import MeshSettings
    >>> MeshSettings(block_size_m=0.01).with_(growth=1.6).growth
    1.6
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _no_number_from_words(cls, data: Any) -> Any:
        """Refuse true, false and text for numbers, which pydantic would convert."""
        for name, value in data.items() if isinstance(data, dict) else ():
            if name in _numbers(cls):
                for each in _elements(value):
                    if isinstance(each, bool) or (isinstance(each, str) and _is_number(each)):
                        raise ValueError(f"`{name}` is a number, not {_as_toml(each)}")
        return data

    def with_(self, **changes: Any) -> Self:
        """Return a copy with other values of some keys, validated like a table from a file.

        ``mesh__growth`` changes the key ``growth`` of the table ``mesh``; ``mesh={...}`` is a new
        table, of which keys that are not given have their defaults.

        Raises
        ------
        StudyError
            If there is no such key or table, or the result is not valid.
        """
        values = {name: getattr(self, name) for name in type(self).model_fields}
        where = f"changed {type(self).__name__}"
        keys: dict[str, dict[str, Any]] = {}  # of tables; together, as they may need each other
        for key, value in changes.items():
            name, nested, rest = key.partition("__")
            if name not in values:
                near = difflib.get_close_matches(name, values, 1, 0.5)
                raise StudyError(must_be(
                    "name", where, "a key of it", f"`{name}`", sentences.did_you_mean(near[0], name)
                    if near else f"Known keys here: {', '.join(values)}."))
            if nested and not isinstance(values[name], StudyModel):
                raise StudyError(must_be(
                    f"`{name}`", where, f"a table, for `{key}` to change a key of it",
                    sentences.received(values[name]),
                    f"Give `{name}` as a whole."))
            if nested:
                keys.setdefault(name, {})[rest] = value
            else:
                values[name] = value
        for name, changed in keys.items():
            values[name] = values[name].with_(**changed)
        try:
            return type(self).model_validate(values)
        except ValidationError as error:
            said = sentences.sentence(error, where, type(self))
            whole = [name for name, value in changes.items() if isinstance(value, dict)
                     and isinstance(getattr(self, name, None), StudyModel)]
            if whole and error.errors()[0]["type"] == "missing":
                said += (f" `{whole[0]}={{...}}` is a whole new table; `{whole[0]}__KEY=...` "
                         "changes one of its keys.")
            raise StudyError(said) from None


MAX_PAIRS = 2_000_000
"""Number of pairs of edges that are compared at once."""


def crossing(polygons: Floats) -> Bools:
    """Tell which of the polygons (n, corners, 2) have edges that cross, or no area, or go round a
    part of it twice or the other way, (n,). A slit that leads to a hole is none of these.
    """
    count = polygons.shape[1]
    first, second = np.triu_indices(count, 1)
    apart = (second - first > 1) & (second - first < count - 1)  # neighbours share a corner
    first, second = first[apart], second[apart]
    found = np.zeros(len(polygons), bool)
    step = max(1, MAX_PAIRS // count**2)
    for part in slices(len(polygons), step):
        corners = polygons[part] @ [1, 1j]  # Im(conj(a) b) is the cross product
        corners = corners - corners.mean(axis=1, keepdims=True)
        ends = np.roll(corners, -1, axis=1)
        tiny = 1e-12 * np.abs(corners).max(axis=1) ** 2  # rounding of products of coordinates
        twice_area = (np.conj(corners) * ends).imag.sum(axis=1)
        rounds = _rounds_beside_edges(corners, ends)
        wrong = (np.abs(twice_area) <= tiny) | (
            (rounds != 0) & (rounds != np.sign(twice_area)[:, None])).any(axis=1)
        edges = ((corners[:, first], ends[:, first]), (corners[:, second], ends[:, second]))
        opposite = []
        for (a, b), others in (edges, edges[::-1]):
            sides = [(np.conj(b - a) * (point - a)).imag for point in others]
            opposite.append((np.minimum(*sides) < -tiny[:, None])
                            & (np.maximum(*sides) > tiny[:, None]))
        found[part] = wrong | (opposite[0] & opposite[1]).any(axis=1)
    return found


def _rounds_beside_edges(
    corners: NDArray[np.complex128], ends: NDArray[np.complex128]
) -> Ints:
    """Return how often polygons, of edges (n, corners) from corners to ends, go counter-clockwise
    round a point on either side of each edge, (n, 2 corners).

    The points are off the middle of their edge, where drawn outlines meet themselves, and by more
    than rounding beside it; edges too short for that have none.
    """
    place, beside, shortest = 0.46, 1e-9, 1e-6  # relative to the edge, and twice to the polygon
    along = ends - corners
    size = np.abs(corners).max(axis=1, keepdims=True)
    offset = np.full(along.shape, np.nan, dtype=complex)
    np.divide(1j * beside * size * along, np.abs(along), out=offset,
              where=np.abs(along) > shortest * size)
    points = (corners + place * along)[:, None] + np.stack([offset, -offset], axis=1)
    points = points.reshape(len(corners), -1, 1)
    start, end = corners[:, None], ends[:, None]
    left = (np.conj(end - start) * (points - start)).imag
    below, ends_below = start.imag <= points.imag, end.imag <= points.imag
    return np.asarray(np.sum(below & ~ends_below & (left > 0), axis=2)
                      - np.sum(~below & ends_below & (left < 0), axis=2))
