"""The true iron: material laws, coaxial tubes and discs, and prisms along z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study import materials
from halbach_fe.study.iron import Iron, IronBox, IronMaterial, IronSphere
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.synthetic.shapes import PolygonBody, shoelace


@dataclass(frozen=True)
class FroehlichLaw:
    """The Froehlich-Kennelly law of iron, B = mu_0 H + J_s H / (H + h).

    Attributes
    ----------
    initial : float
        Initial relative permeability, from which h follows.
    saturation : float, in T
        Saturation polarization J_s.
    """

    initial: float
    saturation: float


@dataclass(frozen=True)
class TableLaw:
    """An H(B) table of iron.

    Attributes
    ----------
    field, flux_density : tuple of float
        H in A/m and B in T, rising from 0. The polarization J = B - mu_0 H is constant beyond the
        last entry.
    """

    field: tuple[float, ...]
    flux_density: tuple[float, ...]


IronLaw = float | FroehlichLaw | TableLaw
"""Material law of iron: a constant relative permeability, or a curve."""


@dataclass(frozen=True)
class Tube:
    """An iron tube about the z axis; a disc if its inner radius is 0.

    Attributes
    ----------
    inner, outer : float, in m
        Radii.
    half_length : float, in m
        Distance from the middle to each end.
    middle : float, in m
        Position of the middle along z.
    """

    inner: float
    outer: float
    half_length: float
    middle: float = 0.0

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside or on the surface."""
        radius = np.hypot(points[:, 0], points[:, 1])
        return ((radius >= self.inner) & (radius <= self.outer)
                & (np.abs(points[:, 2] - self.middle) <= self.half_length))


@dataclass(frozen=True)
class Pole:
    """A prism of iron along z.

    Attributes
    ----------
    outline : tuple of complex, in m
        Corners x + iy of its section, counter-clockwise.
    half_length : float, in m
        Distance from the middle to each end.
    middle : float, in m
        Position of the middle along z.
    """

    outline: tuple[complex, ...]
    half_length: float
    middle: float = 0.0

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside or on the surface."""
        return PolygonBody(self.outline, 2 * self.half_length).holds(points - [0, 0, self.middle])


@dataclass(frozen=True)
class TrueIron:
    """Bodies of iron, all of one material."""

    bodies: tuple[Tube | Pole, ...]
    law: IronLaw


def iron_of_study(study: Study, half_length: float) -> TrueIron | None:
    """Return the iron of a study whose nominal blocks end at z = +- ``half_length`` in m."""
    def half(length: float | None) -> float:
        if study.dimension == 2:
            return np.inf
        return half_length if length is None else length / 2

    ring, iron = study.iron_ring, study.iron
    if ring is not None:
        return TrueIron((Tube(ring.inner_radius_m, ring.outer_radius_m, half(ring.length_m)),),
                        law_of(ring))
    if iron is None:
        return None
    bodies: list[Tube | Pole] = []
    for number, body in enumerate(iron.bodies):
        if isinstance(body, IronBox | IronSphere) or any(body.centre_m + body.rotation_deg) or (
                body.own_material is not None):
            raise StudyError(must_be(
                f"`iron.bodies[{number}]`", f"study {study.name}", "a coaxial tube or a prism "
                "along z, of the material of all bodies, to simulate a campaign", "another one",
                "Leave it out; the field of the magnet can be computed with it."))
        middle = 0.0 if study.dimension == 2 else body.z_m
        if body.kind == "tube":
            bodies.append(Tube(body.inner_radius_m, body.outer_radius_m, half(body.length_m),
                               middle))
            continue
        corners = np.array([complex(x, y) for x, y in body.outline_m])
        if shoelace(corners) < 0:
            corners = corners[::-1]
        for turn in np.exp(2j * np.pi * np.arange(body.copies) / body.copies):
            bodies.append(Pole(tuple((corners * turn).tolist()), half(body.length_m), middle))
    return TrueIron(tuple(bodies), law_of(iron))


def law_of(iron: IronMaterial | Iron) -> IronLaw:
    """Return the material law of a study's iron.

    Raises
    ------
    StudyError
        If the H(B) curve is in a file that has not been read.
    """
    curve = iron.curve
    if curve is None:
        assert iron.relative_permeability is not None  # a study has the permeability or a curve
        return iron.relative_permeability
    if curve.kind == "froehlich_kennelly":
        return FroehlichLaw(curve.initial_relative_permeability, curve.saturation_polarization_T)
    if curve.kind == "brauer":
        # up to the flux density where dB/dH falls to mu_0: beyond it Brauer's law is unphysical
        b = np.linspace(0, materials.MAX_FLUX_DENSITY, 20_001)
        exponent = np.minimum(curve.k2_per_T2 * b**2, 500)
        slope = curve.k1_m_per_H * np.exp(exponent) * (1 + 2 * exponent) + curve.k3_m_per_H
        b = b[:max(2, int(np.argmax(slope * MU_0 > 1)))]
        h = (curve.k1_m_per_H * np.exp(curve.k2_per_T2 * b**2) + curve.k3_m_per_H) * b
        return TableLaw(tuple(h.tolist()), tuple(b.tolist()))
    if curve.kind == "steel":
        field, flux_density = materials.read_table(materials.steels()[curve.name])
    elif curve.file is not None:
        raise StudyError(must_be("`curve.file` of the iron", "study",
                                 "read together with the study's own file", f"'{curve.file}'",
                                 "Read the study with halbach_fe.study.reader.read_study."))
    else:
        field, flux_density = curve.H_A_per_m, curve.B_T
    start = () if field[0] == 0 else (0.0,)
    return TableLaw((*start, *field), (*start, *flux_density))
