"""Effects from outside the array: fields, other magnets, ferromagnetic objects, iron."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, added, one_and
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import coil_field, dipole_field, neighbour_field
from halbach_fe.solver.routes import choose_route
from halbach_fe.solver.separate_blocks import external_acts
from halbach_fe.study.external_keys import AnyCoil, Neighbour, PointDipole
from halbach_fe.study.iron_keys import FroehlichKennellyCurve, Iron, IronRing, IronTube, SteelCurve
from halbach_fe.study.model import Study, iron_of


class BackgroundEffect(Effect):
    """A uniform field is added to that of the magnet, such as that of the earth."""

    name = "background"
    title = "uniform background field"
    parameters = (
        Parameter("x", "T", 0.0001), Parameter("y", "T", 0.0001), Parameter("z", "T", 0.0001),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return np.tile(np.eye(3)[:, None], (1, len(nominal.points), 1))

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        total = tuple(added(study.external.background_T, values))
        return study.with_(external__background_T=total)


STEP_M = 5e-4
"""Step of finite differences with respect to places and sizes."""


class NeighbourMagnetEffect(Effect):
    """A magnet like this one stands on the same axis.

    A place is approximately how far along z its centre is from this one's, on either side. The
    refinements adjust its strength and its distance.
    """

    name = "neighbour_magnet"
    title = "neighbouring magnet"
    parameters = (Parameter("strength", "1", 1.0),)
    refinements = (Parameter("stronger", "1", 0.5), Parameter("farther", "m", 0.05))
    unique = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        # Distances between the facing ends of the two magnets, one candidate place each.
        gaps_m = (0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7)
        if study.dimension == 2:
            return []
        low, high = build_magnet(study).array_ends
        length = high - low
        return [Place(at_m=(side * (length + gap),)) for side in (-1, 1) for gap in gaps_m]

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        """See `Effect.representatives`.

        Near the ends of the magnet all neighbours on one side have similar fields: the middle one
        has a correlation of 0.7 or more with every other one.
        """
        sides = ([place for place in places if side * place.at_m[0] > 0] for side in (-1, 1))
        return [side[len(side) // 2] for side in sides if side]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return neighbour_field(nominal.magnet, Neighbour(z_m=place.at_m[0]), nominal.points)[None]

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        stronger, farther = values[1:]
        here, beyond = (neighbour_field(nominal.magnet, Neighbour(z_m=_centre(place, distance)),
                                        nominal.points)
                        for distance in (farther, farther + STEP_M))
        return np.array([here, (1 + stronger) * (beyond - here) / STEP_M])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        stronger, farther = values[1:] or (0.0, 0.0)
        neighbour = Neighbour(z_m=_centre(place, farther), factor=1 + float(stronger))
        return study.with_(external__neighbours=(*study.external.neighbours, neighbour))


def _centre(place: Place, farther: float) -> float:
    """Return the z in m of the neighbour's centre, ``farther`` m beyond its place."""
    return float(place.at_m[0] + np.sign(place.at_m[0]) * farther)


NEAREST_M = 1e-3
"""Distance in m from the object below which a reading shows nothing of it: a place of the grid may
be one where the probe was, and the field of a point dipole is infinite there."""


class FerromagneticObjectEffect(Effect):
    """A small magnetized object, modelled as a point dipole.

    The places are a coarse grid. The refinements are the displacement of the object from its place,
    by short steps: far from the object the field does not say where it is.
    """

    name = "ferromagnetic_object"
    title = "ferromagnetic object near the bore"
    is_divisible = False
    parameters = (
        Parameter("x", "A m2", 3.0), Parameter("y", "A m2", 3.0), Parameter("z", "A m2", 3.0),)
    refinements = tuple(Parameter(f"at {axis}", "m", 0.05, longest_step=0.02) for axis in "xyz")

    def places(self, study: Study) -> Sequence[Place]:
        # Distances of the candidate places from the magnet's ends.
        beyond_m = (0.03, 0.08, 0.15, 0.25)
        if study.dimension == 2:
            return []
        magnet = build_magnet(study)
        (low, high), outer = magnet.array_ends, magnet.array_outer_radius
        radii = [magnet.bore_radius, outer, 1.4 * outer]
        heights = [*(low - np.array(beyond_m)), *(high + np.array(beyond_m))]
        ends = [(r, z) for r in radii for z in heights]
        outside = [(1.2 * outer, z) for z in np.linspace(low, high, 7)]
        angles = 2 * np.pi * np.arange(12) / 12
        axis = [Place(at_m=(0.0, 0.0, float(z))) for z in heights
                if not low - 0.1 <= z <= high + 0.1]
        found = axis + [Place(at_m=(float(r * np.cos(a)), float(r * np.sin(a)), float(z)))
                        for r, z in ends + outside for a in angles]
        inside = magnet.contains(np.array([place.at_m for place in found]))
        return [place for place, within in zip(found, inside, strict=True) if not within]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        position = np.array(place.at_m)
        return np.array([_field(position, moment, nominal.points) for moment in np.eye(3)])

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: of an object in the model with what iron answers to it.

        Without that answer the search leaves an object between plates, and finds it again.
        """
        position, moment = _at(place, values), np.array(values[:3])
        if nominal.study.external.dipoles and external_acts(nominal.magnet):
            return self._derivative_beside_iron(nominal, place, values)
        slopes = [(_field(position + step, moment, nominal.points)
                   - _field(position - step, moment, nominal.points)) / (2 * STEP_M)
                  for step in STEP_M * np.eye(3)]
        fields = [_field(position, unit, nominal.points) for unit in np.eye(3)]
        return np.array([*fields, *slopes])

    def _derivative_beside_iron(
        self, nominal: NominalFields, place: Place, values: Sequence[float]
    ) -> Floats:
        """Return the derivative (6, n, 3) by solving for a moment and for a displacement more."""
        moment, away = np.array(values[:3]), np.resize([*values[3:], 0.0, 0.0, 0.0], 3)
        size = float(np.linalg.norm(moment)) or 1.0  # as large as it is, far above rounding

        def change(*objects: tuple[Floats, Floats]) -> Floats:
            study = nominal.study
            for strength, position in objects:
                study = self.apply(study, place, [*strength, *position])
            return nominal.solve(study) - nominal.finite_element_field

        steps = [-step if nominal.magnet.contains((_at(place, values) + step)[None]).any() else step
                 for step in STEP_M * np.eye(3)]
        return np.array([
            *(change((size * unit, away)) / size for unit in np.eye(3)),
            *(change((moment, away + step), (-moment, away)) / step.sum() for step in steps)])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`.

        Raises
        ------
        StudyError
            If the object is inside a block or iron, where there is no room for it: what a dipole
            there explains is an error of that block.
        """
        if build_magnet(study).contains(_at(place, values)[None]).any():
            raise StudyError(must_be(
                "the ferromagnetic object", f"study {study.name}", "outside of blocks and iron",
                f"{place.name}, inside"))
        x, y, z = map(float, values[:3])
        position_x, position_y, position_z = _at(place, values).tolist()
        dipole = PointDipole(position_m=(position_x, position_y, position_z), moment_A_m2=(x, y, z))
        return study.with_(external__dipoles=(*study.external.dipoles, dipole))

    def refined_place(self, place: Place, values: Sequence[float]) -> Place:
        return Place(at_m=tuple(_at(place, values).tolist()))

    def reported(self, place: Place, values: Floats, sd: Floats) -> tuple[Floats, Floats]:
        if len(values) == len(self.parameters):
            return values, sd
        return np.concatenate([values[:3], _at(place, values.tolist())]), sd


def _field(position: Floats, moment: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T of a dipole at points (n, 3) in m, 0 nearer than `NEAREST_M`."""
    field = np.zeros_like(points)
    far = np.linalg.norm(points - position, axis=1) >= NEAREST_M
    field[far] = dipole_field(position, moment, points[far])
    return field


def _at(place: Place, values: Sequence[float]) -> Floats:
    """Return the position (3,) in m of the object."""
    return np.array(place.at_m) + (np.array(values[3:]) if len(values) > 3 else 0.0)


WEAKEST = 0.1
"""Smallest strength, relative to the whole ring at one of the places, of what may be a ring. A ring
is applied in full: of one that is found with 2 % of its strength, for a small error that looks like
it, 98 % would be wrong in the next round. Around the magnet of studies/diagnosis, the thinnest ring
of 0.5 mm has 0.5 of the strength of one of 10 mm, one of 25 mm 1.02; a ring 0.1 m off the
blocks has 0.19, and one 0.2 m off 0.05: that one is no candidate."""

class IronRingEffect(Effect):
    """A coaxial tube of soft iron as long as the magnet surrounds it.

    A place is a pair of inner and outer radius. The refinements adjust both, the polarization at
    which the iron saturates, and its permeability at weak fields. With linear iron in place of it,
    blocks took up what that could not explain: in a tube of 4.6 mm that saturates they were up to
    31 standard deviations (1 % of a block) off.
    """

    name = "iron_ring"
    title = "iron ring around the magnet"
    is_solved = True
    parameters = (Parameter("strength", "1", 1.0, minimum=WEAKEST),)
    refinements = (Parameter("farther out by", "m", 0.01, longest_step=0.005),
                   Parameter("thicker by", "m", 0.005, longest_step=0.005),
                   Parameter("saturation above 2 T by", "T", 0.2),
                   Parameter("permeability above 1000 by", "1", 0.7, longest_step=0.5))
    unique = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        if iron_of(study) is not None or study.prior.variation_sd:  # which no study has beside iron
            return []
        magnet = build_magnet(study)
        if any(magnet.middle_m[:2]):  # a tube is about the z axis
            return []
        blocks = magnet.array_outer_radius
        return [Place(at_m=(inner := blocks + gap, outer := inner + thickness),
                      words=f"radii of {1e3 * inner:.4g} and {1e3 * outer:.4g} mm")
                for gap, thickness in ((0.004, 0.002), (0.004, 0.01), (0.004, 0.005),
                                       (0.004, 0.025), (0.02, 0.01))]

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        """See `Effect.representatives`.

        All rings shorten the fringe field, by more than ten times what a map can show. One of
        middle thickness resembles thicker and farther ones, and not a thin one that saturates.
        """
        return places[:2]

    def rough_signature(self, nominal: NominalFields, place: Place) -> Floats:
        return nominal.change_by_iron(
            self.apply(nominal.study, place, [1.0]), few_modes=True)[None]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`, followed by those of the refinements.

        Rings of all places explain some of what another one does. Without their refinements a thick
        one was taken for a thin one that saturates, and stayed where the fit is best nearby.
        """
        change = nominal.change_by_iron(self.apply(nominal.study, place, [1.0]))
        return np.concatenate([change[None],
                               self.refine(nominal, place, [1.0, *np.zeros(4).tolist()])])

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        # beside permeable blocks by the iron alone: what these answer to it is some 5 % of it
        here = nominal.change_by_iron(self.apply(nominal.study, place, values))
        steps = (STEP_M, STEP_M, *(SHARE * one.sd for one in self.refinements[2:]))
        changes = np.empty((len(steps), *here.shape))
        for number in (2, 3, 0, 1):  # first other iron in the same place, which is assembled once
            moved = np.add(values, steps[number] * np.eye(5)[1 + number]).tolist()
            changes[number] = nominal.change_by_iron(
                self.apply(nominal.study, place, moved)) - here
        return changes / np.array(steps)[:, None, None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        clearance_m = 2e-4  # smallest distance between blocks and iron
        thinnest_m = 5e-4  # smallest thickness of a ring
        inner, outer = place.at_m
        farther, thicker, higher, more = values[1:] or (0.0, 0.0, 0.0, 0.0)
        thickness = max(outer - inner + thicker, thinnest_m)
        magnet = build_magnet(study)
        inner = max(inner + farther, magnet.array_outer_radius + clearance_m)
        # mild steels have polarizations of 2.0 to 2.15 T and permeabilities of 200 to 3000 where
        # they are not saturated; cast iron has 1.6 T
        lowest_T, typical_T, highest_T = 1.2, 2.0, 2.5
        least, typical = 0.1, 1000.0
        curve = FroehlichKennellyCurve(
            kind="froehlich_kennelly", initial_relative_permeability=typical * max(1 + more, least),
            saturation_polarization_T=min(max(typical_T + higher, lowest_T), highest_T))
        (low, high), middle = magnet.array_ends, magnet.middle_z_m
        if not middle:
            return study.with_(iron_ring=IronRing(
                inner_radius_m=inner, outer_radius_m=inner + thickness, curve=curve))
        return study.with_(iron=Iron(curve=curve, bodies=(IronTube(
            kind="tube", inner_radius_m=inner, outer_radius_m=inner + thickness,
            length_m=high - low, z_m=middle),)))


STEEL = "aisi_1010"
"""Steel whose H(B) curve stands for that of structural steels."""

SOLID = "scalar_potential"
"""Solver route of iron that saturates, unless one of `BOTH` applies."""

BOTH = ("cross_section", "moments")
"""Solver routes of linear and of saturating iron."""


class IronSaturationEffect(Effect):
    """The iron follows the H(B) curve of a structural steel, not a constant permeability."""

    name = "iron_saturation"
    title = "saturation of the iron ring"
    is_solved = True
    parameters = (Parameter("strength", "1", 1.0),)
    is_binary = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        ring = study.iron_ring
        return [Place()] if ring is not None and ring.curve is None else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        study = before = nominal.study
        if choose_route(nominal.magnet, nominal.points) not in BOTH:
            # linear iron by the same route, so that both fields have the same mesh
            before = study.with_(solver__route=SOLID)
        return (nominal.solve(self.apply(before, place, [1.0])) - nominal.solve(before))[None]

    def rough_signature(self, nominal: NominalFields, place: Place) -> Floats | None:
        # Permeability of linear iron, relative to the study's, that stands for iron that saturates:
        # it conducts less flux too.
        softer_by = 0.5
        ring = nominal.study.iron_ring
        if ring is None or ring.relative_permeability is None:
            return None
        permeability = ring.relative_permeability
        if permeability == 1.0 or choose_route(nominal.magnet, nominal.points) in BOTH:
            return None  # nothing is softer than what conducts no flux
        softer = nominal.study.with_(iron_ring=ring.with_(
            relative_permeability=1 + softer_by * (permeability - 1)))
        return (nominal.solve(softer) - nominal.finite_element_field)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        ring = study.iron_ring
        if ring is None:
            return study
        return study.with_(iron_ring=IronRing(
            inner_radius_m=ring.inner_radius_m, outer_radius_m=ring.outer_radius_m,
            length_m=ring.length_m, curve=SteelCurve(kind="steel", name=STEEL)))


SHARE = 0.1
"""Step of the finite differences with respect to currents and permeabilities, relative to them."""


class CoilCurrentEffect(Effect):
    """A coil carries another current than the study says; -1 is none, -2 the reverse."""

    name = "coil_current"
    title = "current of a coil"
    parameters = (Parameter("fraction", "1", 0.05),)

    def places(self, study: Study) -> Sequence[Place]:
        return [Place(slot=number, words=f"coil {number}")
                for number, coil in enumerate(study.external.coils, start=1) if coil.current_A]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return self._change(nominal, place, _coil(nominal.study, place).current_A)

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: per unit of the current that the study says, not of its own."""
        return self._change(
            nominal, place, _coil(nominal.study, place).current_A / one_and(values[0]))

    def _change(self, nominal: NominalFields, place: Place, more_A: float) -> Floats:
        """Return the change of B (1, n, 3) in T for more current, with that of what answers it."""
        study, coil = nominal.study, _coil(nominal.study, place)
        if not external_acts(nominal.magnet):
            return coil_field(coil.with_(current_A=more_A), nominal.points, study.name)[None]
        more = nominal.solve(_with_coil(study, place, coil.current_A + SHARE * more_A))
        return ((more - nominal.finite_element_field) / SHARE)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return _with_coil(study, place, one_and(values[0]) * _coil(study, place).current_A)


def _coil(study: Study, place: Place) -> AnyCoil:
    """Return the coil at a place."""
    return study.external.coils[place.slot - 1]


def _with_coil(study: Study, place: Place, current_A: float) -> Study:
    """Return a study in which the coil at a place carries another current."""
    coils = list(study.external.coils)
    coils[place.slot - 1] = _coil(study, place).with_(current_A=current_A)
    return study.with_(external__coils=tuple(coils))


class IronPermeabilityEffect(Effect):
    """Iron of a constant permeability has another one.

    A place is a body with a material of its own, or the material of all others.
    """

    name = "iron_permeability"
    title = "permeability of iron"
    is_solved = True
    parameters = (Parameter("fraction", "1", 0.3, minimum=-0.99),)

    def places(self, study: Study) -> Sequence[Place]:
        iron = iron_of(study)
        if iron is None:
            return []
        bodies = enumerate(getattr(iron, "bodies", ()), start=1)
        own = [Place(slot=number, words=f"body {number} of iron") for number, body in bodies
               if body.relative_permeability is not None]
        return ([] if iron.relative_permeability is None else [Place(words="the iron")]) + own

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        more = nominal.solve(self.apply(nominal.study, place, [SHARE]))
        return ((more - nominal.finite_element_field) / SHARE)[None]

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: per unit of the permeability that the study says."""
        return self.signature(nominal, place) / one_and(values[0])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        key = "iron" if study.iron_ring is None else "iron_ring"
        iron = iron_of(study)
        if iron is None:
            return study
        if place.slot and study.iron is not None:
            bodies = list(study.iron.bodies)
            bodies[place.slot - 1] = _more_permeable(bodies[place.slot - 1], values[0])
            return study.with_(iron__bodies=tuple(bodies))
        return study.with_(**{key: _more_permeable(iron, values[0])})


class IronDisplacedEffect(Effect):
    """A body of iron of any shape is displaced, with all that stand in its row and its mirrors.

    A place is a body of the study. Every displacement is solved on a mesh of its own, so that the
    differences are taken over steps whose effect is larger than what meshes differ by: over 0.5 mm
    to both sides that was 2 to 4 % of the derivative beside a pole 25 mm away.
    """

    name = "iron_displaced"
    title = "body of iron displaced"
    is_solved = True
    parameters = tuple(Parameter(axis, "m", 3e-4) for axis in "xyz")

    def places(self, study: Study) -> Sequence[Place]:
        if study.iron is None or build_magnet(study).iron_is_axisymmetric:
            return []
        return [Place(slot=number, words=f"body {number} of iron")
                for number in range(1, len(study.iron.bodies) + 1)]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return np.array([self._derivative(nominal, place, axis) for axis in np.eye(3)])

    def _derivative(self, nominal: NominalFields, place: Place, axis: Floats) -> Floats:
        """Return the derivative (n, 3) in T/m, to the side that is free; 0 if there is none.

        The difference is that of displaced bodies on either side, or on one of them: a body in its
        place may have another route, whose error would be taken for the effect.
        """
        step = 5e-4
        fields: list[tuple[float, Floats]] = []
        for number in (1, -1, 2, -2):
            if len(fields) == 2 or (number == 2 and not fields):
                break
            try:
                fields.append((number * step, nominal.solve(
                    self.apply(nominal.study, place, (number * step * axis).tolist()))))
            except StudyError:  # what stands there is in the way
                continue
        if len(fields) == 1:
            fields.append((0.0, nominal.finite_element_field))
        if not fields:
            return np.zeros_like(nominal.points)
        (first, here), (last, there) = fields
        return np.asarray((here - there) / (first - last))

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        if study.iron is None:
            return study
        bodies = list(study.iron.bodies)
        body = bodies[place.slot - 1]
        bodies[place.slot - 1] = body.with_(centre_m=tuple(added(body.centre_m, values)))
        return study.with_(iron__bodies=tuple(bodies))


def _more_permeable(material: Any, fraction: float) -> Any:
    """Return iron of a permeability that is larger by a fraction, but at least 1."""
    return material.with_(relative_permeability=max(
        1.0, one_and(fraction) * material.relative_permeability))


EFFECTS = (BackgroundEffect(), NeighbourMagnetEffect(), FerromagneticObjectEffect(),
           IronRingEffect(), IronSaturationEffect(), CoilCurrentEffect(),
           IronPermeabilityEffect(), IronDisplacedEffect())
