"""Materials: H(B) of iron, grades of permanent magnets by name, and the knee of these.

**Iron.** A curve is isotropic, without hysteresis, and odd in B. Tables and closed forms are both
converted to two constitutive laws: ``H = nu(B^2) B`` for the vector potential, and ``B = mu_0
mu_r(g^2) H`` with ``g = mu_0 H`` for the scalar potential. The coefficients nu and mu_r are
interpolated between points by Akima's method (J. ACM 17 (1970) 589). GetDP offers the same
interpolation, so that GetDP and halbach-fe evaluate the same law. Beyond the last point the
polarization ``J = B - mu_0 H`` is constant.

**Grades.** A data sheet promises a range of the remanence, not a value. The blocks of one delivery
come from a few melts, so that they lie together somewhere in the range: its width is the standard
deviation of an error that all blocks share (``prior.remanence_sd``), and says little about
differences between the blocks. Every row of the table names its source; what no source says is
None. No data sheet states a knee: it is at a share of the coercivity, see `Demagnetization`.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, NoReturn

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.files import workbook_in
from halbach_fe.core.numbers import MU_0 as MU_0
from halbach_fe.core.numbers import numbered_lines, parse_number
from halbach_fe.study.types import (
    RISING_PER_K,
    ReferenceTemperature,
    RemanenceCoefficient,
    StudyModel,
    Temperature,
)

COLUMNS = ("H_A_per_m", "B_T")
MIN_POINTS = 4
MAX_POINTS = 10_000
MAX_FLUX_DENSITY = 10.0
"""Largest B of a table in T. Steels are measured up to some 2.5 T; more reveals another unit."""

MAX_POLARIZATION = 2.6
"""Largest polarization of a curve in T. The largest of any iron, alloyed with cobalt, is 2.45 T."""

MAX_RELATIVE_PERMEABILITY = ((0.0, 2e6), (1.5, 2e5))
"""Pairs of a flux density in T and the largest relative permeability from there on. The purest iron
reaches 1e6, but from 1.5 T on even grain-oriented steel has less than some 1e5."""

MIN_RELATIVE_PERMEABILITY = 1.5
"""A material whose largest relative permeability is smaller is not iron."""

SUBDIVISION = 16
"""Intervals of a constitutive law between two points of the table. With 16, the law agrees with the
monotone cubic interpolation of the table within 1e-3, and so do the two laws with one another; the
difference is 3e-3 where points are as far apart as those of AISI 1010 beyond 1.7 T. It decreases
with about the square of this number."""

LEAST_START = 0.5
"""Lower limit of dH/dB at the origin, as a fraction of H / B at the first point of the table."""

_CLOSED_FORM_POINTS = 800
"""Points at which a closed form is evaluated to make a curve."""


@dataclass(frozen=True)
class ConstitutiveLaw:
    """An isotropic law ``y = c(|x|^2) x`` between two vectors.

    The coefficient c is interpolated by Akima's method; beyond the last point ``d|y|/d|x|``
    is constant.
    """

    squares: Floats
    """Values of ``|x|^2``, ascending from 0. Shape (n,), in T^2."""
    values: Floats
    """The coefficient c at ``squares``. Shape (n,)."""
    limit: float
    """``d|y|/d|x|`` beyond the last point."""

    @property
    def excess(self) -> float:
        """The value of ``|y| - limit |x|``, which is constant beyond the last point."""
        return float((self.values[-1] - self.limit) * np.sqrt(self.squares[-1]))

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        return CubicHermiteSpline(self.squares, self.values,
                                  _akima_slopes(self.squares, self.values))

    @cached_property
    def _derivative(self) -> CubicHermiteSpline:
        return self._spline.derivative()

    def coefficient(self, square: Floats) -> Floats:
        """Return c at values (...,) of ``|x|^2`` in T^2."""
        inside = self._spline(np.minimum(square, self.squares[-1]))
        if square.max(initial=0) <= self.squares[-1]:
            return inside
        beyond = self.limit + self.excess / np.sqrt(np.maximum(square, self.squares[-1]))
        return np.where(square <= self.squares[-1], inside, beyond)

    def slope(self, square: Floats) -> Floats:
        """Return ``dc / d(|x|^2)`` at values (...,) of ``|x|^2`` in T^2."""
        inside = self._derivative(np.minimum(square, self.squares[-1]))
        if square.max(initial=0) <= self.squares[-1]:
            return inside
        outside = np.maximum(square, self.squares[-1])
        beyond = -self.excess / 2 / outside / np.sqrt(outside)  # outside**1.5 could overflow
        return np.where(square <= self.squares[-1], inside, beyond)

    def differential(self, square: Floats) -> Floats:
        """Return ``d|y|/d|x| = c + 2 |x|^2 dc/d(|x|^2)`` at values (...,) of ``|x|^2`` in T^2."""
        return self.coefficient(square) + 2 * (square * self.slope(square))


def _akima_slopes(x: Floats, y: Floats) -> Floats:
    """Return the slopes of Akima's method as GetDP computes them.

    SciPy differs: it uses another threshold to recognize points on a straight line.
    """
    secant = np.diff(y) / np.diff(x)
    m = np.concatenate([[0, 0], secant, [0, 0]])
    m[1], m[-2] = 2 * m[2] - m[3], 2 * m[-3] - m[-4]
    m[0], m[-1] = 2 * m[1] - m[2], 2 * m[-2] - m[-3]
    right, left = np.abs(m[3:] - m[2:-1]), np.abs(m[1:-2] - m[:-3])
    total = right + left
    straight = total <= 1e-30
    weighted = (right * m[1:-2] + left * m[2:-1]) / np.where(straight, 1, total)
    return np.where(straight, (m[1:-2] + m[2:-1]) / 2, weighted)


@dataclass(frozen=True)
class Curve:
    """Points of a magnetization curve that are close enough for both constitutive laws."""

    H: Floats
    """Ascending from 0. Shape (n,), in A/m."""
    B: Floats
    """Ascending from 0. Shape (n,), in T."""
    initial: float
    """Relative permeability at the origin."""

    @cached_property
    def reluctivity(self) -> ConstitutiveLaw:
        """The law H = nu(B^2) B, with nu in m/H."""
        values = np.concatenate([[1 / (MU_0 * self.initial)], self.H[1:] / self.B[1:]])
        return ConstitutiveLaw(self.B**2, values, 1 / MU_0)

    @cached_property
    def permeability(self) -> ConstitutiveLaw:
        """The law B = mu_r(g^2) g with g = mu_0 H in T."""
        values = np.concatenate([[self.initial], self.B[1:] / (MU_0 * self.H[1:])])
        return ConstitutiveLaw((MU_0 * self.H) ** 2, values, 1.0)


def table_curve(field: Floats, flux_density: Floats) -> Curve:
    """Return the curve through a table of H in A/m and B in T, monotone between its points.

    Raises
    ------
    ValueError
        If the table is not that of iron, for one of the reasons that `check_table` lists.
    """
    field, flux_density = check_table(field, flux_density)
    slopes = PchipInterpolator(flux_density, field).derivative()(flux_density)
    # PCHIP sets the first slope to 0 where H rises steeply after the first point: the reluctivity
    # at the origin would vanish
    slopes[0] = max(slopes[0], LEAST_START * field[1] / flux_density[1])
    smooth = CubicHermiteSpline(flux_density, field, slopes)
    steps = np.arange(SUBDIVISION) / SUBDIVISION
    inner = flux_density[:-1, None] + np.diff(flux_density)[:, None] * steps
    nodes = np.append(inner.ravel(), flux_density[-1])
    return _checked(Curve(smooth(nodes), nodes, 1 / (MU_0 * float(slopes[0]))))


def froehlich_kennelly(initial: float, saturation: float) -> Curve:
    """Return the curve B = mu_0 H + J_s H / (H + h) of Froehlich and Kennelly.

    The formula is A. E. Kennelly's (Trans. AIEE 8 (1891) 485), after O. Froehlich, for the
    polarization; mu_0 H is added so that the slope of B tends to mu_0.

    Parameters
    ----------
    initial : float
        Relative permeability at the origin, from which h follows.
    saturation : float
        Saturation polarization J_s in T.
    """
    widest_field = 1e7  # largest H in A/m at which a closed form is evaluated
    half = saturation / (MU_0 * (initial - 1))
    field = np.concatenate([[0.0], np.geomspace(half * 1e-4, widest_field, _CLOSED_FORM_POINTS)])
    return _checked(Curve(field, MU_0 * field + saturation * field / (half + field), initial))


def brauer(k1: float, k2: float, k3: float) -> Curve:
    """Return the curve H = (k1 exp(k2 B^2) + k3) B of J. R. Brauer, IEEE Trans. Magn. 11 (1975) 81.

    The formula is used up to the B where dH/dB reaches 1/mu_0: no material exceeds that slope.

    Raises
    ------
    ValueError
        If the reluctivity at the origin, k1 + k3, is not that of iron, or if the polarization
        becomes larger than that of any iron.
    """
    def differential(b: float) -> float:
        exponent = k2 * b**2
        # an exponential that would overflow is far above the reluctivity of vacuum
        return math.inf if exponent > 500 else k1 * math.exp(exponent) * (1 + 2 * exponent) + k3

    least = 1 / (MU_0 * MAX_RELATIVE_PERMEABILITY[0][1])
    most = 1 / (MU_0 * MIN_RELATIVE_PERMEABILITY)
    if not least <= k1 + k3 <= most:
        raise ValueError(f"k1 + k3 must be a reluctivity of {least:.3g} to {most:.3g} m/H, that of "
                         f"iron; instead it is {k1 + k3:.3g}; are the units m/H?")
    low, high = 0.0, MAX_FLUX_DENSITY
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if differential(middle) * MU_0 < 1 else (low, middle)
    b = np.linspace(0, low, _CLOSED_FORM_POINTS)
    h = (k1 * np.exp(k2 * b**2) + k3) * b
    polarization = float((b - MU_0 * h).max())
    if polarization > MAX_POLARIZATION:
        raise ValueError(f"the polarization B - mu_0 H goes up to {polarization:.3g} T, which no "
                         "iron has; give a larger k2")
    return _checked(Curve(h, b, 1 / (MU_0 * (k1 + k3))))


def check_table(field: Floats, flux_density: Floats) -> tuple[Floats, Floats]:
    """Return a table of H in A/m and B in T, starting at the origin, after checking it.

    Raises
    ------
    ValueError
        If the lengths differ, there are too few or too many points, or values are not finite,
        negative, exchanged, in another unit, or not increasing. H in Oe (1/80 of its value in A/m)
        is found only if the table goes far into saturation: below, it looks like good iron.
    """
    # Smallest step of B between two points, relative to the largest B: between closer points the
    # slope is lost to rounding.
    min_step = 1e-6
    h, b = np.asarray(field, float), np.asarray(flux_density, float)
    if h.shape != b.shape or h.ndim != 1:
        raise ValueError(f"H and B must be lists of equal length, but H has {h.size} values and B "
                         f"has {b.size}; give a B for every H")
    _check_points(~(np.isfinite(h) & np.isfinite(b)), h, b, "is not finite; give numbers")
    _check_points((h < 0) | (b < 0), h, b, "is negative; give the first quadrant only")
    if len(h) and h[0] == 0 and b[0] == 0:
        h, b = h[1:], b[1:]
    if len(h) < MIN_POINTS or len(h) > MAX_POINTS:
        raise ValueError(f"a curve needs {MIN_POINTS} to {MAX_POINTS} points besides the origin, "
                         f"not {len(h)}; give {'more' if len(h) < MIN_POINTS else 'fewer'}")
    for name, values, least in (("H", h, 0.0), ("B", b, min_step * b[-1])):
        steps = np.diff(values, prepend=0.0)
        if (steps <= least).any():
            worst = int(np.argmax(steps <= least))
            before = f"{values[worst - 1]:g} before" if worst else "the origin"
            raise ValueError(f"{name} must rise from point to point, but {name} = "
                             f"{values[worst]:g}, point {worst + 1} after the origin, is not "
                             f"clearly above {before}; sort the points, and give one "
                             "branch only")
    _check_units(h, b)
    return np.append(0.0, h), np.append(0.0, b)


def _check_points(bad: Bools, h: Floats, b: Floats, problem: str) -> None:
    """Raise ValueError for the first of the points that are marked as bad."""
    if bad.any():
        first = int(np.argmax(bad))
        raise ValueError(f"point {first + 1} (H = {h[first]:g}, B = {b[first]:g}) {problem}")


def _check_units(h: Floats, b: Floats) -> None:
    """Raise ValueError if no iron has such a curve: a unit is wrong, or H and B are exchanged."""
    # Accepted fall of the polarization along a table, relative to the largest B: tables are
    # rounded.
    max_fall = 0.02
    if b[-1] > MAX_FLUX_DENSITY:
        if h[-1] < MAX_FLUX_DENSITY:
            raise ValueError(f"H and B look exchanged: B goes up to {b[-1]:g} T, and H only to "
                             f"{h[-1]:g} A/m; exchange them")
        raise ValueError(f"B goes up to {b[-1]:g}, which no iron has in tesla; is it in mT or "
                         "gauss? Give T")
    with np.errstate(over="ignore", divide="ignore"):
        permeability = b / (MU_0 * h)
    for least, most in MAX_RELATIVE_PERMEABILITY:
        too_high = (b >= least) & (permeability > most)
        if too_high.any():
            first = int(np.argmax(too_high))
            raise ValueError(f"B / (mu_0 H) is {permeability[first]:.3g} at {b[first]:g} T, which "
                             "no iron has; is H in kA/m or Oe? Give A/m")
    if permeability.max() < MIN_RELATIVE_PERMEABILITY:
        raise ValueError(f"B / (mu_0 H) goes up to {permeability.max():.3g} only, and in iron far "
                         "higher; is B in another unit than T, or H in another than A/m?")
    # the polarization of iron does not fall; a small fall is accepted because tables are rounded
    polarization = b - MU_0 * h
    fall = float((np.maximum.accumulate(np.append(0.0, polarization))[1:] - polarization).max())
    if fall > max_fall * b[-1]:
        raise ValueError(f"the polarization B - mu_0 H falls by {fall:.3g} T, and in iron it "
                         "rises; is H in another unit than A/m, or the polarization given for B?")
    if polarization.max() > MAX_POLARIZATION:
        raise ValueError(f"the polarization B - mu_0 H goes up to {polarization.max():.3g} T, which"
                         " no iron has; is H in kA/m or Oe? Give A/m")


def _checked(curve: Curve) -> Curve:
    """Return the curve, or raise ValueError if H(B) or B(H) does not rise everywhere."""
    for name, unit, scale, law in (("B", "T", 1.0, curve.reluctivity),
                                   ("H", "A/m", MU_0, curve.permeability)):
        root = np.sqrt(law.squares)
        fine = np.linspace(root[:-1], root[1:], 7, axis=1).ravel() ** 2
        differential = law.differential(fine)
        if not differential.min() > 0:
            where = float(np.sqrt(fine[np.argmin(differential)]))
            raise ValueError(f"the curve must rise between the points too, and does not near "
                             f"{name} = {where / scale:.4g} {unit}; give more points there")
    return curve


def steels() -> dict[str, Traversable]:
    """Return the files of the curves that come with halbach-fe, by name."""
    folder = resources.files("halbach_fe.study") / "steels"
    return {path.name.removesuffix(".csv"): path
            for path in sorted(folder.iterdir(), key=lambda path: path.name)
            if path.name.endswith(".csv")}


def read_table(path: Traversable) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read H in A/m and B in T from a CSV file with the header ``H_A_per_m,B_T``.

    Lines that start with ``#`` are comments. Error messages do not quote the file, because a study
    can name any file on the machine.

    Raises
    ------
    ValueError
        If the file is not text, is empty, has another header, or has a line without two numbers.
    OSError
        If the file cannot be read.
    """
    raw = path.read_bytes()
    if (workbook := workbook_in(raw)) is not None:
        raise ValueError(f"it is an {workbook} workbook; save the sheet as CSV")
    try:
        text = raw.decode("utf-8-sig")  # spreadsheets write a byte order mark
    except UnicodeDecodeError:
        raise ValueError("it must be UTF-8 text; save it as such") from None
    lines = numbered_lines(text)
    if not lines:
        raise ValueError(f"it is empty; give the line {','.join(COLUMNS)}, and a line a point")
    header = [name.strip() for name in lines[0][1].split(",")]
    if sorted(header) != sorted(COLUMNS):
        raise ValueError(f"its header must be {','.join(COLUMNS)}")
    columns: dict[str, list[float]] = {name: [] for name in header}
    for number, line in lines[1:]:
        try:
            for name, value in zip(header, line.split(","), strict=True):
                columns[name].append(parse_number(value.strip()))
        except ValueError:
            raise ValueError(f"line {number} must hold two numbers and a comma between") from None
    return tuple(columns[COLUMNS[0]]), tuple(columns[COLUMNS[1]])


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
        """Values of the grade for the keys of `Demagnetization`.

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
    >>> from halbach_fe.study.materials import grade
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

MOST_SQUARE = 0.99
"""Largest squareness for which irreversible losses are computed."""


class Demagnetization(StudyModel):
    """Resistance of the magnet material to demagnetization, and the temperature to assess it at.

    Remanence (of ``array``) and intrinsic coercivity are the data-sheet values at
    ``reference_temperature_C``; both change linearly with temperature, by the fraction
    ``..._coefficient_per_K`` per kelvin. ``temperature_C`` is the highest temperature of the
    magnet. The knee of the demagnetization curve is at ``squareness`` times the intrinsic
    coercivity, where the polarization is a tenth below the remanence (H_k of IEC 60404-8-1).

    With ``irreversible`` the blocks have lost for good what the field that they are in takes, and
    the field of the magnet is that with the losses; see `halbach_fe.solver.moments.solve`.
    The remanence is then that of blocks which have lost nothing. This needs a magnet in 3D.
    """

    FOUND_IN: ClassVar = (", from the data sheet of the material, or name a grade of which they "
                          "are known in `array.material`")

    # of AlNiCo at least 38e3 A/m; numbers of NdFeB in oersted end at 36e3
    intrinsic_coercivity_A_per_m: Annotated[float, Field(ge=3.6e4, le=5e6)]
    squareness: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    remanence_coefficient_per_K: RemanenceCoefficient
    coercivity_coefficient_per_K: Annotated[float, Field(ge=-0.02, le=0.02)]
    reference_temperature_C: ReferenceTemperature = 20.0
    temperature_C: Temperature = 20.0
    irreversible: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Demagnetization:
        # Temperature coefficient of the remanence above which a magnet is no ferrite, which has
        # -0.002/K; that of NdFeB is -0.0012/K, of SmCo -0.0004/K and of AlNiCo -0.0002/K.
        ferrite_per_k = -1.5e-3
        if self.irreversible and self.squareness > MOST_SQUARE:
            raise ValueError(f"squareness must be at most {MOST_SQUARE} for irreversible losses, "
                             f"not {self.squareness}; the polarization would jump at the knee")
        if self.coercivity_coefficient_per_K > RISING_PER_K and (
                self.remanence_coefficient_per_K > ferrite_per_k):
            raise ValueError(
                f"coercivity_coefficient_per_K ({self.coercivity_coefficient_per_K}) lets the "
                "coercivity rise with the temperature, as that of ferrite alone does, but "
                f"remanence_coefficient_per_K ({self.remanence_coefficient_per_K}) is not that of "
                "ferrite; other magnets have a negative one")
        if self.remanence_coefficient_per_K < ferrite_per_k and self.worst_when_cold and (
                self.coercivity_coefficient_per_K <= RISING_PER_K):
            raise ValueError(
                f"remanence_coefficient_per_K ({self.remanence_coefficient_per_K}) is that of "
                "ferrite, whose coercivity rises with the temperature, but "
                f"coercivity_coefficient_per_K is {self.coercivity_coefficient_per_K}; are the two "
                "exchanged?")
        for name, coefficient in (("remanence", self.remanence_coefficient_per_K),
                                  ("coercivity", self.coercivity_coefficient_per_K)):
            if 1 + coefficient * (self.temperature_C - self.reference_temperature_C) <= 0:
                raise ValueError(f"{name}_coefficient_per_K ({coefficient}) makes the {name} zero "
                                 f"or negative at {self.temperature_C:g} °C; use a fraction per "
                                 "kelvin, not per cent, and a temperature in °C, not in kelvin, "
                                 "that the linear law holds for")
        return self

    @property
    def worst_when_cold(self) -> bool:
        """Whether the coercivity falls less with the temperature than the field that opposes it.

        That field is proportional to the remanence. The coercivity of ferrite even rises.
        """
        return self.coercivity_coefficient_per_K > self.remanence_coefficient_per_K


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
