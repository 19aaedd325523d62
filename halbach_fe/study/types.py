"""Types of the keys of a study, with limits that reveal a wrong unit, and what is said of values
that are of none: none of pydantic's own texts are shown.

pydantic's errors have a kind, and what belongs to it by name: limits, patterns, names of tags.
"""

from __future__ import annotations

import difflib
import math
import re
import types
from collections.abc import Iterable, Iterator, Mapping
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
from pydantic_core import ErrorDetails

from halbach_fe.core.arrays import Bools, Floats, Ints, slices
from halbach_fe.core.errors import StudyError, must_be

KEY = "[key]"
"""Last part of pydantic's location of a key, in contrast to its value."""

PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9._-]*$":
        "a name of letters (a to z), digits, '.', '_' and '-' that begins with a letter or digit",
    r"^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$":
        "a name of at most 40 letters (a to z), digits, '_' and '-' that begins with a letter or "
        "digit",
}
"""What a text must be like, by the regular expression that the models check."""

EXPECTED = {
    "missing": "given",
    "extra_forbidden": "a known key",
    "greater_than": "greater than {gt:g}",
    "greater_than_equal": "greater than or equal to {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "less than or equal to {le:g}",
    "finite_number": "a finite number",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number of fewer digits",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a text in quotation marks",
    "string_unicode": "a text in UTF-8",
    "string_too_short": "a text of {min_length} or more characters",
    "string_too_long": "a text of at most {max_length} characters",
    "literal_error": "{expected}",
    "union_tag_invalid": "one of {expected_tags}",
    "union_tag_not_found": "given",
    "model_type": "a table of keys",
    "model_attributes_type": "a table of keys",
    "dict_type": "a table of keys",
    "tuple_type": "a list",
    "too_short": "a list with {min_length} or more elements",
    "too_long": "a list with at most {max_length} elements",
}
"""What is expected, by the kind of error; the models raise no others."""

UNITS = ("m", "T", "deg", "rad", "C", "K")
"""Units at the end of names."""


def did_you_mean(given: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """Return the question for the nearest known name, empty if none is near.

    It says what becomes of values if only the unit differs, or if diameters were given.
    """
    as_radius = given[:100].replace("diameter", "radius")
    near = difflib.get_close_matches(as_radius, list(known), 1, cutoff)
    if not near:
        return ""
    stem, _, unit = near[0].rpartition("_")
    other = unit in UNITS and unit != given.rpartition("_")[2] and stem == (
        as_radius.rpartition("_")[0])
    halved = as_radius != given[:100]
    to_do = ["halve its values"] * halved + [
        f"convert {'them' if halved else 'its values'} to {unit}"] * other
    return f"Did you mean `{near[0]}`?" + (f" Then {' and '.join(to_do)}." if to_do else "")


KILOOERSTED = 1e6 / (4 * math.pi)
"""In A/m."""

WRONG_UNITS = (
    *((f"remanence{axis}_T", "kilogauss", 0.1) for axis in ("", "_x", "_y", "_z")),  # data sheets
    ("coercivity_A_per_m", "kilooersted", KILOOERSTED),
    ("_A_per_m", "kiloamperes per metre", 1e3),
    ("coercivity_A_per_m", "oersted", 1e-3 * KILOOERSTED), ("_m", "millimetres", 1e-3),
    ("_T", "millitesla", 1e-3), ("_T", "gauss", 1e-4),
    ("_A_m2", "A mm²", 1e-6), ("_rad", "degrees", math.pi / 180),
    ("coefficient_per_K", "per cent per kelvin", 1e-2),
    ("coefficient_per_K", "the other sign", -1.0),
    ("coefficient_per_K", "per cent per kelvin and with the other sign", -1e-2),
    *((key, "per cent", 1e-2) for key in (
        "squareness", "gain", "magnitude_sd", "common_mode_sd", "strength_sd", "common_sd",
        "variation_sd")),
    ("_C", "kelvin", 1.0))
"""End of a key, a unit in which its value may have been given, and what that is in the right one.
"""

DEVIATIONS_FROM_1 = ("instrument.gain", "instrument.z_scale", "instrument.radius_scale")
"""Ends of the keys of factors of which the study states the deviation from 1."""

ABSOLUTE_ZERO_C = -273.15


def wrong_unit(key: str, value: float, limits: Mapping[str, Any]) -> str:
    """Return a hint to a unit that is wrong, if the value is within the limits in the right one.

    ``limits`` are those of pydantic that the value violates, by their names: ge, gt, le or lt. The
    hint is empty if no unit fits.
    """
    # Largest temperature coefficient of any material: what is larger is in per cent.
    most_per_k = 0.02
    most_coercivity = 45.0 * KILOOERSTED  # of any magnet, in A/m: in kOe, kA/m or Oe it is less
    least_square = 0.3  # smallest squareness of a magnet
    max_wrong_unit = 1e12  # values from this size on are not explained by a wrong unit
    key = re.sub(r"(\[\d+\])+$", "", key)  # of lists in tables of a list
    if not abs(value) < max_wrong_unit:  # an integer may be beyond floats
        return ""
    if key.endswith(DEVIATIONS_FROM_1) and abs(value - 1) <= limits.get("le", 0.0):
        return (f"It is the deviation from 1: if {value:.6g} is the whole factor, write "
                f"{value - 1:.6g}; if per cent, {value / 100:.6g}.")
    for suffix, unit, factor in WRONG_UNITS:
        if suffix == "coefficient_per_K" and (abs(factor) < 1) != (abs(value) > most_per_k):
            continue
        given = value * factor + (ABSOLUTE_ZERO_C if unit == "kelvin" else 0.0)
        if key.endswith("coercivity_A_per_m") and given > most_coercivity:
            continue
        if factor < 0 and value < 0:  # no sign was lost
            continue
        if key.endswith("squareness") and given < least_square:
            continue
        if key.endswith(suffix) and not key.removesuffix(suffix).endswith("_per") and limits and (
                limits.get("ge", -math.inf) <= given <= limits.get("le", math.inf)) and (
                limits.get("gt", -math.inf) < given < limits.get("lt", math.inf)):
            word = "with" if factor == -1 else "in"
            return f"Was it meant {word} {unit}? Then write {given:.6g}."
    return ""


CURVE = ('Name a steel, { kind = "steel", name = "aisi_1010" }, or a file of pairs with the header '
         'H_A_per_m,B_T: { kind = "table", file = "steel.csv" }.')
"""What a curve of iron is, where pairs or a name stand in its place."""


def hint(key: str, error: ErrorDetails) -> str:
    """Return what to do about a value, of another type, unit or size; empty if nobody knows."""
    most_deviation = 0.5  # from 1, up to which a number is taken for a whole factor
    value, kind = error.get("input"), error["type"]
    if key.endswith(".curve"):
        return CURVE
    if key.endswith(".free_blocks") and isinstance(value, str):
        return "Write the name of the table as its key `file`: free_blocks = { file = \"...\" }."
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind != "tuple_type":
        return (wrong_unit(key, value, error.get("ctx", {})) or "Correct the value."
                if number else "")
    large = number and not abs(value) <= most_deviation  # a small one is in the right unit
    deviation = wrong_unit(key, value, {"le": most_deviation}) if large else ""
    return f"Write it in brackets, an element for each axis or part. {deviation}".strip()


def expected(error: ErrorDetails) -> str:
    """Return what a value must be."""
    given = error.get("ctx", {})
    if error["type"] == "union_tag_not_found" and not isinstance(error["input"], Mapping):
        return EXPECTED["model_type"]
    if error["type"] == "string_pattern_mismatch":
        return PATTERNS.get(given["pattern"], "a text of other characters")
    kind = error["type"]
    if kind.startswith("too_") and isinstance(error["input"], str):  # where a validator comes first
        kind = f"string_{kind}"
    return EXPECTED.get(kind, "of another kind").format(**given)


def contradiction(error: ErrorDetails) -> str | None:
    """Return the sentence of a validator of ours; None if pydantic itself found the error."""
    if error["type"] not in ("value_error", "assertion_error"):
        return None
    return str(error["ctx"]["error"])


def reason(error: ValidationError) -> str:
    """Return what is wrong first, for a sentence that names the place itself."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"] if part != KEY)
    return contradiction(first) or f"{key or 'it'} must be {expected(first)}"


def received(value: Any) -> object:
    """Return a value as a study file would write it, or what it is."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        return repr(value)
    return "nothing" if value is None else value


def sentence(error: ValidationError, where: str, root: type[BaseModel]) -> str:
    """Return one sentence about pydantic's first error, or about all keys that are missing.

    It ends with the number of the others. ``root`` is the model of the whole file.
    """
    errors = error.errors(include_url=False)
    # A list of which an element is wrong is too short besides, as pydantic counts the others.
    errors = [one for one in errors if one["type"] != "too_short" or not any(
        other is not one and other["loc"][:len(one["loc"])] == one["loc"] for other in errors)]
    # An unknown key is the likeliest cause of the others: a misspelt key is also a missing key.
    errors.sort(key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    key, model, inside = _locate(first["loc"], root)
    value, kind = first.get("input"), first["type"]
    wanted, found, advice = expected(first), received(value), ""
    if (ours := contradiction(first)) is not None:
        return (f"Input `{key or 'the whole'}` of {where} must be consistent: {ours}."
                + _more(errors))
    if kind == "extra_forbidden":
        name = str(first["loc"][-1])
        meant = did_you_mean(name, model.model_fields if model else ())
        advice = meant or (f"Known keys here: {', '.join(model.model_fields)}." if model else "")
        if not meant and len(first["loc"]) > 1 and name in root.model_fields and not isinstance(
                value, Mapping):
            advice = f"`{name}` stands at the top of the file, above the first table."
        found = f"`{name}`"
    elif kind == "missing":
        missing = [f"`{_locate(one['loc'], root)[0]}`" for one in errors
                   if one["type"] == "missing"]
        errors = [first, *(one for one in errors if one["type"] != "missing")]
        return must_be(", ".join(missing), where, wanted, "nothing",
                       f"Add the {'keys' if len(missing) > 1 else 'key'}"
                       f"{getattr(model, 'FOUND_IN', '')}.") + _more(errors)
    elif kind.startswith("union_tag"):  # pydantic locates the table, of which one key says its kind
        name = first["ctx"]["discriminator"].strip("'")
        key, found = f"{key}.{name}", received(value.get(name))
        tags = [str(tag) for one in inside for tag in get_args(one.model_fields[name].annotation)]
        near = difflib.get_close_matches(str(value.get(name)), tags, 1, 0.5)
        advice = f"Did you mean '{near[0]}'?" if near else ""
        if kind == "union_tag_not_found":
            advice = f"Add the key, as one of {', '.join(map(repr, tags))}."
    elif kind == "model_type" and isinstance(value, list) and all(
            isinstance(one, dict) for one in value):
        advice = f"Write [{key}] for [[{key}]], and all keys in that one table."
    elif kind == "tuple_type" and isinstance(value, dict) and _holds_tables(model, first["loc"]):
        advice = f"Write [[{key}]] for [{key}], and once more for each further one."
    else:
        advice = hint(key, first)
    return must_be(f"`{key}`", where, wanted, found, advice) + _more(errors)


def _holds_tables(model: type[BaseModel] | None, location: tuple[int | str, ...]) -> bool:
    """Return whether a key of a model is a list of tables."""
    field = model.model_fields.get(str(location[-1])) if model else None
    return field is not None and any(map(_models_in, get_args(field.annotation)))


def _more(errors: list[Any]) -> str:
    return f" ({len(errors) - 1} more in this file.)" if len(errors) > 1 else ""


def _locate(
    location: tuple[int | str, ...], root: type[BaseModel]
) -> tuple[str, type[BaseModel] | None, list[type[BaseModel]]]:
    """Return the dotted key of a pydantic location, the model that holds its last part, and those
    that may stand there.

    pydantic puts the tag of a discriminated union into the location. It is left out here, because
    it is no key of the file. Elements of lists count from 1, as in all that a study says.
    """
    models: list[type[BaseModel]] = [root]
    owner: type[BaseModel] | None = root
    parts: list[str] = []
    for part in location:
        if part == KEY:
            continue
        if isinstance(part, int):
            parts[-1] += f"[{part + 1}]"
            continue
        tagged = [m for m in models if len(models) > 1 and part in _tags(m)]
        if tagged:
            models, owner = tagged, tagged[0]
            continue
        owner = models[0] if models else None
        parts.append(part)
        field = owner.model_fields.get(part) if owner else None
        models = _models_in(field.annotation) if field else []
    return ".".join(parts), owner, models


def _tags(model: type[BaseModel]) -> set[str]:
    """Return the values of a model's literal keys, which tag it in a discriminated union."""
    return {
        str(value)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    }


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return all models that a type annotation mentions, in order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Union, types.UnionType, Annotated, tuple):
        return [model for arg in get_args(annotation) for model in _models_in(arg)]
    return []


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
Temperature = Annotated[float, Field(ge=ABSOLUTE_ZERO_C, le=500.0, allow_inf_nan=False)]
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
                raise StudyError(must_be(
                    "name", where, "a key of it", f"`{name}`", did_you_mean(name, values)
                    or f"Known keys here: {', '.join(values)}."))
            if nested and not isinstance(values[name], StudyModel):
                raise StudyError(must_be(
                    f"`{name}`", where, f"a table, for `{key}` to change a key of it",
                    received(values[name]),
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
            said = sentence(error, where, type(self))
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
