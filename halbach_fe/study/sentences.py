"""What pydantic finds wrong, in the words of a user: none of its own texts are shown.

pydantic's errors have a kind, and what belongs to it by name: limits, patterns, names of tags.
"""

from __future__ import annotations

import difflib
import math
import re
import types
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from halbach_fe.core.errors import must_be

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


def did_you_mean(near: str, given: str) -> str:
    """Return the question for a known name that is near, and for its unit if only that differs."""
    stem, _, unit = near.rpartition("_")
    other = unit in UNITS and stem == given.rpartition("_")[0]
    return f"Did you mean `{near}`?" + (f" Then convert its values to {unit}." if other else "")


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
        near = difflib.get_close_matches(name, model.model_fields if model else [], 1, 0.5)
        advice = (did_you_mean(near[0], name) if near
                  else f"Known keys here: {', '.join(model.model_fields)}." if model else "")
        if not near and len(first["loc"]) > 1 and name in root.model_fields and not isinstance(
                value, Mapping):
            advice = f"`{name}` stands at the top of the file, above the first table."
        found = f"`{name}`"
    elif kind == "missing":
        missing = [f"`{_locate(one['loc'], root)[0]}`" for one in errors
                   if one["type"] == "missing"]
        errors = [first, *(one for one in errors if one["type"] != "missing")]
        return must_be(", ".join(missing), where, wanted, "nothing",
                       f"Add the {'keys' if len(missing) > 1 else 'key'}.") + _more(errors)
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
