"""Magnetization curves H(B) of iron: reading, checks, and conversion to constitutive laws.

A curve is isotropic, without hysteresis, and odd in B. Tables and closed forms are both converted
to two constitutive laws: ``H = nu(B^2) B`` for the vector potential, and ``B = mu_0 mu_r(g^2) H``
with ``g = mu_0 H`` for the scalar potential. The coefficients nu and mu_r are interpolated between
points by Akima's method (J. ACM 17 (1970) 589). GetDP offers the same interpolation, so that GetDP
and halbach-fe evaluate the same law. Beyond the last point the polarization ``J = B - mu_0 H`` is
constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from importlib.resources.abc import Traversable

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.files import workbook_in
from halbach_fe.core.numbers import MU_0 as MU_0
from halbach_fe.core.numbers import numbered_lines, parse_number

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
    """An isotropic law y = c(|x|^2) x between two vectors.

    The coefficient c is interpolated by Akima's method; beyond the last point d|y|/d|x| is
    constant.
    """

    squares: Floats
    """Values of |x|^2, ascending from 0. Shape (n,), in T^2."""
    values: Floats
    """The coefficient c at ``squares``. Shape (n,)."""
    limit: float
    """d|y|/d|x| beyond the last point."""

    @property
    def excess(self) -> float:
        """The value of |y| - limit |x|, which is constant beyond the last point."""
        return float((self.values[-1] - self.limit) * np.sqrt(self.squares[-1]))

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        return CubicHermiteSpline(self.squares, self.values,
                                  _akima_slopes(self.squares, self.values))

    @cached_property
    def _derivative(self) -> CubicHermiteSpline:
        return self._spline.derivative()

    def coefficient(self, square: Floats) -> Floats:
        """Return c at values (...,) of |x|^2 in T^2."""
        inside = self._spline(np.minimum(square, self.squares[-1]))
        if square.max(initial=0) <= self.squares[-1]:
            return inside
        beyond = self.limit + self.excess / np.sqrt(np.maximum(square, self.squares[-1]))
        return np.where(square <= self.squares[-1], inside, beyond)

    def slope(self, square: Floats) -> Floats:
        """Return dc / d(|x|^2) at values (...,) of |x|^2 in T^2."""
        inside = self._derivative(np.minimum(square, self.squares[-1]))
        if square.max(initial=0) <= self.squares[-1]:
            return inside
        outside = np.maximum(square, self.squares[-1])
        beyond = -self.excess / 2 / outside / np.sqrt(outside)  # outside**1.5 could overflow
        return np.where(square <= self.squares[-1], inside, beyond)

    def differential(self, square: Floats) -> Floats:
        """Return d|y| / d|x| = c + 2 |x|^2 dc/d(|x|^2) at values (...,) of |x|^2 in T^2."""
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
