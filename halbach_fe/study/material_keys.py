"""The key ``material`` of a study, and the values that a grade of magnet gives to other keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from halbach_fe.study.grades import Grade, grade

Material = Annotated[str, Field(max_length=40), AfterValidator(lambda name: grade(name).name)]
"""Name of a grade of magnet, in any spelling; the study holds the table's."""

STRENGTHS = ("remanence_T", "block_moment_A_m2", "remanence_x_T", "remanence_y_T", "remanence_z_T")
"""Keys that give the strength of a block; any of them wins over the grade."""


def grade_of(values: Any) -> Grade | None:
    """Return the grade that a table names, or None if it names none, or an unknown one."""
    name = (values.get("material") if isinstance(values, Mapping)
            else getattr(values, "material", None))
    try:
        return grade(name) if isinstance(name, str) else None
    except ValueError:  # reported by the validation of the key itself
        return None


def with_grade(values: dict[str, Any]) -> dict[str, Any]:
    """Return a table with remanence and recoil permeability of its grade where it gives none."""
    found = grade_of(values)
    if found is None:
        return values
    filled = dict(values)
    if all(filled.get(key) is None for key in STRENGTHS):
        filled["remanence_T"] = found.nominal_remanence
    if filled.get("recoil_permeability") is None:
        filled["recoil_permeability"] = found.recoil_permeability
    return filled


def columns_with_grades(columns: dict[str, Any]) -> dict[str, Any]:
    """Do for every row of a table, given by column, what `with_grade` does for one."""
    materials = columns.get("material")
    if not isinstance(materials, list | tuple) or not any(materials):
        return columns
    filled = dict(columns)
    keys = ("material", "recoil_permeability", *STRENGTHS)
    given = {key: values for key in keys if isinstance(values := columns.get(key), list | tuple)
             and len(values) == len(materials)}
    rows = [with_grade({key: values[number] for key, values in given.items()})
            for number in range(len(materials))]
    for key in ("remanence_T", "recoil_permeability"):
        if key in given or not columns.get(key):
            filled[key] = tuple(row.get(key) for row in rows)
    return filled
