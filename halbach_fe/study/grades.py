"""Grades of permanent magnets by name, with the ranges of their data sheets.

A data sheet promises a range of the remanence, not a value. The blocks of one delivery come from a
few melts, so that they lie together somewhere in the range: its width is the standard deviation of
an error that all blocks share (``prior.remanence_sd``), and says little about differences between
the blocks. Every row of the table names its source; what no source says is None.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Annotated, Any, NoReturn

from pydantic import AfterValidator, Field

from halbach_fe.core.numbers import parse_number
from halbach_fe.study.materials import MU_0

FAMILIES = ("NdFeB", "SmCo5", "Sm2Co17", "ferrite")

LIMITS = {
    "remanence_T": (0.15, 1.55),
    "normal_coercivity_A_per_m": (1e5, 1.2e6),
    "intrinsic_coercivity_A_per_m": (1e5, 4e6),
    "energy_product_J_per_m3": (5e3, 5e5),
    "recoil_permeability": (1.0, 1.3),
    "remanence_coefficient_per_K": (-0.003, -1e-4),
    "coercivity_coefficient_per_K": (-0.01, 0.006),
    "max_temperature_C": (50.0, 400.0),
    "density_kg_per_m3": (4500.0, 8700.0),
}
"""Smallest and largest value of every quantity. Remanence and energy product of ferrite begin here,
those of NdFeB end here. The coercivity of ferrite is the only one that rises with temperature."""

ENERGY_TOLERANCE = 0.05
"""Accepted excess of the middle of (BH)_max over B_r^2 / (4 mu_0 mu_rec), which a straight B(H) has
at the middle of B_r. Sheets round B_r to 0.01 T, at most 1 % of its square, and (BH)_max to 1 MGOe,
at most 4 % of a SmCo5 of 13 MGOe."""


@dataclass(frozen=True)
class Grade:
    """A grade of magnet at room temperature, as its data sheet describes it."""

    name: str
    aliases: tuple[str, ...]
    """Other names of the same grade."""
    family: str
    """One of `FAMILIES`."""
    remanence_T: tuple[float, float]
    """Smallest and largest remanence in T."""
    normal_coercivity_A_per_m: float
    intrinsic_coercivity_A_per_m: float
    """Smallest H_cB and H_cJ."""
    energy_product_J_per_m3: tuple[float, float]
    """Smallest and largest (BH)_max."""
    recoil_permeability: float
    """Typical relative permeability along the easy axis."""
    remanence_coefficient_per_K: float | None
    coercivity_coefficient_per_K: float | None
    """Typical temperature coefficients of the remanence and of H_cJ as fractions."""
    coefficient_range_C: tuple[float, float] | None
    """Temperatures between which the coefficients hold, where the source says so."""
    max_temperature_C: float
    """Maximum working temperature; it depends on the magnet's shape, so that it is a hint only."""
    density_kg_per_m3: tuple[float, float]
    """Smallest and largest density."""
    source: str
    """Document of the magnetic ranges."""
    other_sources: tuple[str, ...] = ()
    """Documents of what the first does not give."""

    @property
    def nominal_remanence(self) -> float:
        """Middle of the range of the remanence in T, which a study takes as nominal."""
        return sum(self.remanence_T) / 2

    @property
    def remanence_sd(self) -> float:
        """Standard deviation of the remanence, as a fraction of the nominal one.

        It is that of a uniform distribution over the range: the half-width divided by sqrt(3).
        """
        low, high = self.remanence_T
        return (high - low) / 2 / math.sqrt(3) / self.nominal_remanence

    @property
    def demagnetization_defaults(self) -> dict[str, float]:
        """Values of the grade for the keys of `halbach_fe.study.magnet.Demagnetization`.

        Keys that no source gives are missing. The coercivity is the smallest that the data sheet
        promises.
        """
        reference_temperature_c = 20.0  # temperature of the values of data sheets in °C
        values = {
            "intrinsic_coercivity_A_per_m": self.intrinsic_coercivity_A_per_m,
            "remanence_coefficient_per_K": self.remanence_coefficient_per_K,
            "coercivity_coefficient_per_K": self.coercivity_coefficient_per_K,
            "reference_temperature_C": reference_temperature_c,
        }
        return {key: value for key, value in values.items() if value is not None}


@cache
def grades() -> Mapping[str, Grade]:
    """Return the grades that come with halbach-fe, by name, in the order of the table."""
    folder = resources.files("halbach_fe.study")
    return MappingProxyType(read_grades(folder / "grades.csv", folder / "grade_sources.csv"))


def grade(name: str) -> Grade:
    """Return a grade by its name, whatever its case, spaces and dashes.

    Raises
    ------
    ValueError
        If there is no such grade; the message names similar ones.

    Examples
    --------
    >>> from halbach_fe.study.grades import grade
    >>> grade("n42 sh").name
    'N42SH'
    """
    # Largest number of names that an unknown name is compared with, and their least similarity
    # (that of `difflib`).
    suggestions, similarity = 3, 0.6
    names = _by_key()
    key = _key(name)
    if key in names:
        return names[key]
    near = difflib.get_close_matches(key, names, suggestions, similarity)
    similar = list(dict.fromkeys(names[match].name for match in near))
    hint = f"similar are {', '.join(similar)}" if similar else f"there are {', '.join(grades())}"
    raise ValueError(f"no magnet grade is called '{name}'; {hint}")


@cache
def _by_key() -> Mapping[str, Grade]:
    return MappingProxyType({_key(name): found for found in grades().values()
                             for name in (found.name, *found.aliases)})


def _key(name: str) -> str:
    """Return a name without the differences that do not count."""
    return re.sub(r"[\s_-]", "", name).casefold()


def read_grades(table: Traversable, sources: Traversable) -> dict[str, Grade]:
    """Read grades by name from a CSV table, and the documents that it names from another.

    Raises
    ------
    ValueError
        If a row is incomplete, its values contradict each other or those of any magnet, or two rows
        share a name.
    """
    documents = {row["key"]: row["document"] for row in _rows(sources)}
    found: dict[str, Grade] = {}
    owners: dict[str, str] = {}
    for row in _rows(table):
        try:
            one = _grade(row, documents)
            check_grade(one)
        except KeyError as error:
            raise ValueError(f"grade {row['name']} needs {error.args[0]}") from None
        for name in (one.name, *one.aliases):
            if _key(name) in owners:
                raise ValueError(f"grade {one.name}: {owners[_key(name)]} is also called {name}")
            owners[_key(name)] = one.name
        found[one.name] = one
    return found


def _rows(path: Traversable) -> Iterator[dict[str, str]]:
    """Yield the rows of a CSV file with a header; lines that start with ``#`` are comments."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return csv.DictReader([line for line in lines if line and not line.startswith("#")])


def _grade(row: Mapping[str, str], documents: Mapping[str, str]) -> Grade:
    """Return the grade in a row; raise KeyError if a column or a document is missing."""
    def given(key: str) -> float | None:
        try:
            return parse_number(row[key]) if row[key] else None
        except ValueError:
            raise ValueError(f"grade {row['name']}: {key} must be a number") from None

    def value(key: str) -> float:
        number = given(key)
        if number is None:
            raise KeyError(key)
        return number

    first, last = given("coefficients_from_C"), given("coefficients_to_C")
    return Grade(
        name=row["name"], aliases=tuple(row["aliases"].split(";")) if row["aliases"] else (),
        family=row["family"],
        remanence_T=(value("remanence_min_T"), value("remanence_max_T")),
        normal_coercivity_A_per_m=value("normal_coercivity_A_per_m"),
        intrinsic_coercivity_A_per_m=value("intrinsic_coercivity_A_per_m"),
        energy_product_J_per_m3=(value("energy_product_min_J_per_m3"),
                                 value("energy_product_max_J_per_m3")),
        recoil_permeability=value("recoil_permeability"),
        remanence_coefficient_per_K=given("remanence_coefficient_per_K"),
        coercivity_coefficient_per_K=given("coercivity_coefficient_per_K"),
        coefficient_range_C=None if first is None or last is None else (first, last),
        max_temperature_C=value("max_temperature_C"),
        density_kg_per_m3=(value("density_min_kg_per_m3"), value("density_max_kg_per_m3")),
        source=documents[row["source"]],
        other_sources=tuple(documents[key] for key in row["other_sources"].split()))


def check_grade(one: Grade) -> None:
    """Check a grade against the limits of magnets, and its values against each other.

    Raises
    ------
    ValueError
        If a range is not in order, a value is outside of `LIMITS`, H_cB is larger than H_cJ or than
        a straight B(H) permits, (BH)_max is larger than a straight B(H) permits, the coercivity of
        another family than ferrite rises with temperature, or there is no source.
    """
    # Accepted excess of the smallest H_cB over B_r / (mu_0 mu_rec) at the largest B_r: mu_rec is
    # given to 0.05, and is 1.03 to 1.05 for rare-earth magnets.
    coercivity_tolerance = 0.02
    def refuse(reason: str) -> NoReturn:
        raise ValueError(f"grade {one.name}: {reason}")

    if not one.source.strip():
        refuse("it needs a source")
    if one.family not in FAMILIES:
        refuse(f"its family must be one of {', '.join(FAMILIES)}, not '{one.family}'")
    for key, (least, most) in LIMITS.items():
        given = getattr(one, key)
        values = given if isinstance(given, tuple) else () if given is None else (given,)
        for value in values:
            if not least <= value <= most:
                refuse(f"{key} must be {least:g} to {most:g}, not {value:g}; check the unit")
        if len(values) == 2 and values[0] > values[1]:
            refuse(f"{key} must begin with the smaller value, not be {values}")
    low, high = one.remanence_T
    if low == high:
        refuse("remanence_T must be a range, not one value")
    if one.normal_coercivity_A_per_m > one.intrinsic_coercivity_A_per_m:
        refuse("H_cB must not be larger than H_cJ")
    permeability = MU_0 * one.recoil_permeability
    if one.normal_coercivity_A_per_m > (1 + coercivity_tolerance) * high / permeability:
        refuse(f"H_cB must not be larger than B_r / (mu_0 mu_rec) = {high / permeability:.3g} A/m")
    straight = one.nominal_remanence**2 / (4 * permeability)
    if sum(one.energy_product_J_per_m3) / 2 > (1 + ENERGY_TOLERANCE) * straight:
        refuse(f"(BH)_max must not be larger than B_r^2 / (4 mu_0 mu_rec) = {straight:.3g} J/m^3")
    if one.family != "ferrite" and (one.coercivity_coefficient_per_K or 0.0) > 0:
        refuse("coercivity_coefficient_per_K must be negative, except for ferrite")


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


def without_old_grade(table: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """Return changes of a table, of which another grade replaces what it has of its own grade.

    A table keeps no note of who gave a value: what is exactly that of its grade counts as such.
    """
    old = grade_of(table)
    if old is None or grade_of(changes) is None:
        return changes
    filled = {"remanence_T": old.nominal_remanence, "recoil_permeability": old.recoil_permeability}
    return {key: None for key, value in filled.items() if getattr(table, key) == value} | changes


def doubted_strength(table: Any) -> str:
    """Return a sentence where a table's own remanence is none of its grade, else an empty text."""
    found, given = grade_of(table), getattr(table, "remanence_T", None)
    if found is None or given is None or found.remanence_T[0] <= given <= found.remanence_T[1]:
        return ""
    low, high = found.remanence_T
    return (f"remanence_T = {given:g} wins over its material, as {found.name} has {low:g} to "
            f"{high:g} T. Leave remanence_T out for that of {found.name}.")


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
