"""The whole study of all keys: a magnet, its discretization (mesh, solver) and its measurement.

The names of keys end with their unit (``inner_radius_m``, ``sigma_T``). Unknown keys are errors.
The models are immutable: every result is a function of the study (and of measured data).

The magnetization M follows the same convention everywhere in halbach-fe: ``nu(|B|) B = H + M``. In
a block of remanence B_r and recoil permeability mu_r therefore ``M = B_r / (mu_0 mu_r)``. M is
neither ``B_r / mu_0`` nor the magnetization at the working point.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study import materials
from halbach_fe.study.array_keys import Array, common_material, remanence_sds
from halbach_fe.study.design_keys import Design, Holder, HomogeneityRegion, ShimTray
from halbach_fe.study.external_keys import External
from halbach_fe.study.inference_keys import (
    Inference,
    MapSettings,
    Plan,
    Prior,
    Uncertain,
    check_uncertain,
)
from halbach_fe.study.iron_keys import Iron, IronCurve, IronRing
from halbach_fe.study.materials import Curve, Demagnetization, grade, grade_of
from halbach_fe.study.measurement_keys import (
    POSE_KEYS,
    PROBE_KEYS,
    Instrument,
    InstrumentSd,
    NoiseSettings,
    ObservationSettings,
)
from halbach_fe.study.types import (
    COMPONENTS,
    MAX_LENGTH_M,
    MIN_LENGTH_M,
    Length,
    Lines,
    StudyModel,
    reason,
    sentence,
)

MAGNET_KEYS = {"dimension", "array", "iron_ring", "iron"}
"""Keys of a study that describe its magnet: blocks and iron."""

FIELD_KEYS = MAGNET_KEYS | {"external", "mesh", "open_boundary", "solver", "demagnetization"}
"""Keys of a study that its computed field depends on."""


CELLS_PER_SIDE = 2
"""Default number of cells of the method of moments along the sides of a cube."""


class MeshSettings(StudyModel):
    """Sizes of the finite elements.

    ``block_size_m`` holds in the blocks and iron; on the route ``moments`` it is the largest size
    in iron that is not rotationally symmetric. ``bore_size_m`` holds in the bore (default: the
    same). Outside the magnet, elements grow towards the boundary: across the plane by ``growth`` -
    1 per unit of distance, along z by the factor ``growth`` from layer to layer. In 3D the
    cross-section is extruded along z, in ``layers_per_ring`` layers per ring. In iron of any shape
    the elements of thin and round bodies are larger too, in proportion to ``growth`` - 1.

    ``cells_per_side`` divides separate blocks for the method of moments: the number of cells along
    the sides of a cube (default: 2).

    ``meridian_size_m`` is the size in the mesh of the (r, z) half-plane, which is used for
    rotationally symmetric materials (default: a twelfth of the blocks' radial thickness).
    """

    block_size_m: Length
    bore_size_m: Length | None = None
    layers_per_ring: Annotated[int, Field(ge=1, le=100)] = 2
    cells_per_side: Annotated[int, Field(ge=1, le=16)] | None = None
    meridian_size_m: Length | None = None
    growth: Annotated[float, Field(gt=1.0, le=4.0)] = 1.4


class OpenBoundary(StudyModel):
    """The cylinder around the magnet at which the computational domain ends.

    Elements grow towards this boundary, so that a distant boundary costs little. By default it is
    10 to 30 magnet radii away, depending on the kind of mesh.
    """

    radius_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None
    half_length_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None


class SolverSettings(StudyModel):
    """Choice of the method that computes the field.

    ``method``: ``reaction`` adds the finite-element reaction of permeability and iron to the exact
    field that the blocks have in vacuum; ``direct`` is the finite-element field alone.

    ``route`` is the formulation in 3D. ``azimuthal_modes`` solves one (r, z) problem for each mode
    of the azimuth, and needs rotationally symmetric materials (sector blocks without gaps).
    ``edge_elements`` solves the curl-curl equation of the vector potential, for any geometry;
    ``edge_order`` is the order of its elements. ``scalar_potential`` solves the dual problem with
    nodal elements of second order, for any geometry too. These two take the rings to be equal.
    ``moments`` divides the blocks into cells instead of meshing space (method of moments), and
    solves rotationally symmetric iron by azimuthal modes, and iron of any other shape by the scalar
    potential in the iron and the air near it; it is the most accurate for separate blocks, and
    takes each where it is mounted. ``auto`` takes azimuthal modes where possible and
    moments elsewhere, reading by reading, the scalar potential for equal rings with prisms of
    iron, and edge elements for ``method = "direct"``.

    With ``symmetry`` the field of only one block is computed of all those that a rotation or
    reflection of the magnet maps onto one another.
    """

    method: Literal["reaction", "direct"] = "reaction"
    route: Literal["auto", "azimuthal_modes", "moments", "edge_elements",
                   "scalar_potential"] = "auto"
    edge_order: Literal[1, 2] = 1
    symmetry: bool = True


class _OfKeys(type(StudyModel)):  # type: ignore[misc]
    """Makes ``Study(...)`` refuse wrong keys as `read_study` does."""

    def __call__(cls, *arguments: Any, **keys: Any) -> Any:
        """Return the study of keys and tables; raise StudyError if there is no such study."""
        if arguments:
            raise StudyError(must_be("arguments", "Study", "keys of a study by name", "others"))
        try:
            return super().__call__(**keys)
        except ValidationError as error:
            raise StudyError(sentence(error, "study", cls)) from None


class Study(StudyModel, metaclass=_OfKeys):
    """A magnet, its discretization, its measurement, and the prior knowledge of its blocks."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    description: Lines = ""
    dimension: Literal[2, 3] = 3
    array: Array
    iron_ring: IronRing | None = None
    iron: Iron | None = None
    external: External = External()
    instrument: Instrument = Instrument()
    instrument_sd: InstrumentSd = InstrumentSd()
    maps: tuple[MapSettings, ...] = ()
    uncertain: tuple[Uncertain, ...] = ()
    mesh: MeshSettings
    open_boundary: OpenBoundary = OpenBoundary()
    solver: SolverSettings = SolverSettings()
    observation: ObservationSettings
    noise: NoiseSettings | None = None
    prior: Prior = Prior()
    inference: Inference = Inference()
    plan: Plan = Plan()
    homogeneity: HomogeneityRegion | None = None
    demagnetization: Demagnetization | None = None
    shim_tray: ShimTray | None = None
    design: Design | None = None
    holder: Holder | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_grade(cls, given: Any) -> Any:
        """Fill in what grades say about prior, and that of the array about demagnetization."""
        array = given.get("array") if isinstance(given, dict) else None
        if isinstance(array, Array):  # of a changed study, with a new table perhaps
            material = array.material
            sds = {name: grade(name).remanence_sd
                   for name, is_of_grade in array.grades if name and is_of_grade}
        elif isinstance(array, dict):
            material, sds = common_material(array), remanence_sds(array)
        else:
            return given
        values, found, prior = dict(given), grade_of({"material": material}), given.get("prior", {})
        if sds and isinstance(prior, dict) and prior.get("common_mode_sd") is None:
            values["prior"] = {"remanence_sd": sds} | prior
        demagnetization = values.get("demagnetization")
        if found is not None and isinstance(demagnetization, dict):
            values["demagnetization"] = found.demagnetization_defaults | demagnetization
        return values

    def with_(self, **changes: Any) -> Self:
        """Return a copy with other values of some keys; see `StudyModel.with_`.

        What the grade of the array says about prior and demagnetization follows another grade.
        """
        changed = super().with_(**changes)
        tables: dict[str, Any] = {}
        known, named = self.prior.remanence_sd, {name for name, _ in self.array.grades}
        if (changed.array.grades != self.array.grades and changed.prior.remanence_sd == known
                and (known or not any(named))):  # else all strengths were stated
            tables["prior__remanence_sd"] = {
                name: known.get(name, grade(name).remanence_sd)
                for name, is_of_grade in changed.array.grades
                if name and (name in known or (is_of_grade and name not in named))}
        old, new = grade_of(self.array), grade_of(changed.array)
        if (found := changed.demagnetization) and old and new and new is not old:
            given = {key: value for key, value in dict(found).items()
                     if old.demagnetization_defaults.get(key) != value}
            tables["demagnetization"] = new.demagnetization_defaults | given
        return super(Study, changed).with_(**tables)

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if self.dimension == 3 and self.array.rings and self.array.ring_length_m is None and not (
                self.array.ring and all(ring.ring_length_m for ring in self.array.ring)):
            raise ValueError("a 3D study needs array.ring_length_m")
        if self.dimension == 2 and self.array.rings > 1 and not self.array.ring:
            raise ValueError("a 2D study is a cross-section: array.rings must be 1")
        if self.iron_ring is not None and self.iron is not None:
            raise ValueError("give either iron_ring or iron, of which a ring can be one of the "
                             "bodies")
        if self.demagnetization and self.demagnetization.irreversible and (
                self.dimension == 2 or self.solver.method == "direct"
                or self.solver.route not in ("auto", "moments")):
            raise ValueError("demagnetization.irreversible needs a 3D study, and the route moments "
                             "of the method reaction: leave solver.route and solver.method out")
        if self.external.neighbours and self.dimension == 2:
            raise ValueError("external.neighbours needs a 3D study: beside a cross-section, which "
                             "has no end, there is no other magnet on the axis")
        if self.homogeneity is not None and self.dimension == 2:
            raise ValueError("homogeneity needs a 3D study: a cross-section has no volume in which "
                             "the field could be homogeneous")
        if self.prior.variation_sd and (self.dimension == 2 or self.iron_ring or self.iron):
            raise ValueError("prior.variation_sd needs a 3D study without iron")
        check_uncertain(self)
        self._check_maps()
        held_out, regions = self.inference.held_out, self.noise.regions if self.noise else ()
        by_component = {
            "noise.regions": any(set(region.components) != set(COMPONENTS) for region in regions),
            "inference.held_out": bool(held_out and held_out.components)}
        for key, named in by_component.items():
            if named and self.observation.quantity == "fourier_coefficients":
                raise ValueError(f"{key} may name components of flux_density only; Fourier "
                                 "coefficients have none")
        slots = sorted(slot for members in self.prior.types.values() for slot in members)
        most = max(self.array.blocks_by_ring)
        if self.prior.types and slots != list(range(1, most + 1)):
            raise ValueError(f"prior.types must name every slot from 1 to {most} once, but names "
                             f"{slots}")
        for name, size in self.mesh:
            if name.endswith("size_m") and size is not None and size > self.array.outer_radius_m:
                raise ValueError(f"mesh.{name} ({size}) must not be larger than the array "
                                 f"({self.array.outer_radius_m}); is it in millimetres?")
        return self

    def _check_maps(self) -> None:
        """Check that maps of a campaign differ, and agree on the probe and stage they share."""
        for key in ("name", "file"):
            given = [getattr(one, key) for one in self.maps]
            twice = [value for value in given if given.count(value) > 1]
            if twice:
                raise ValueError(f"every map needs a {key} of its own, but two of them have "
                                 f"'{twice[0]}'")
        uncertain = [self.instrument_sd, *(one.instrument_sd for one in self.maps)]
        if self.dimension == 2 and any(sd not in (None, InstrumentSd()) for sd in uncertain):
            raise ValueError("instrument_sd needs a 3D study")
        for one, key in product(self.maps, ("probe", "stage")):
            if any(other.name == getattr(one, key) != getattr(other, key) for other in self.maps):
                raise ValueError(f"the {key} '{getattr(one, key)}' of map '{one.name}' has the "
                                 "name of a map of another one")
        first: dict[tuple[str, str], Study] = {}
        for number, one in enumerate(self.maps):
            try:
                own = self.of_map(number)
            except ValidationError as error:
                raise ValueError(f"map '{one.name}' does not fit the study: "
                                 f"{reason(error)}") from None
            for shared, name, tables, keys in (
                    ("probe", one.probe, ("instrument", "instrument_sd"), PROBE_KEYS),
                    ("stage", one.stage, ("instrument_sd",), POSE_KEYS)):
                other = own if name is None else first.setdefault((shared, name), own)
                for table, key in product(tables, keys):
                    mine, theirs = (getattr(getattr(each, table), key, None)
                                    for each in (own, other))  # not every key can be uncertain
                    if mine != theirs:
                        raise ValueError(
                            f"maps of one {shared} must state the same {table}.{key}, but those of "
                            f"{shared} '{name}' do not")

    def __repr__(self) -> str:
        """Return the name: all keys are many lines, which `halbach_fe.write_study` writes."""
        return f"Study({self.name})"

    def of_map(self, number: int) -> Study:
        """Return the study of one of the maps alone, with the map's own tables.

        Of amplitudes that change several instruments it has what they change of its own.
        """
        one = self.maps[number]
        own = {key: getattr(one, key) for key in (
            "instrument", "instrument_sd", "noise", "inference") if getattr(one, key) is not None}
        values = {name: getattr(self, name) for name in type(self).model_fields}
        mine = f"maps[{number + 1}]."

        def own_name(name: str) -> str:
            if name.startswith("maps["):
                return name.removeprefix(mine) if name.startswith(f"{mine}instrument.") else ""
            return "" if one.instrument and name.startswith("instrument.") else name

        uncertain = [each.with_(change=change) for each in self.uncertain if (change := {
            own_name(name): value for name, value in each.change.items()
            if value and own_name(name)})]
        return type(self).model_validate(values | own | {"maps": (), "uncertain": uncertain})

    @property
    def shared_sds(self) -> Floats:
        """Standard deviations (blocks, k) of k independent deviations that blocks share, relative
        to nominal: one of all blocks, or one of those of each grade.
        """
        prior, grades = self.prior, self.array.grades
        if prior.common_mode_sd is not None or not prior.remanence_sd:
            return np.full((len(grades), 1), prior.calibration_sd)
        return np.array([[sd * (own == name) for name, sd in prior.remanence_sd.items()]
                         for own, _ in grades])

    def demagnetization_of(self, material: str | None) -> Demagnetization:
        """Return what blocks of a grade withstand, by the name of the grade.

        Numbers that the table states otherwise than the grade of the array hold for all blocks.

        Raises
        ------
        StudyError
            If there is no table, or the grade lacks a number, or differs in what no table can hold.
        """
        table, of_array = self.demagnetization, grade_of(self.array)
        if table is None:
            raise StudyError(must_be("`demagnetization`", f"study {self.name}",
                                     "what the material withstands", "nothing"))
        if of_array is None or material in (None, of_array.name):
            return table
        own = grade(str(material)).demagnetization_defaults
        of_grade = [key for key, value in of_array.demagnetization_defaults.items()
                    if getattr(table, key) == value]
        if missing := [key for key in of_grade if key not in own]:
            raise StudyError(must_be(
                f"`demagnetization.{missing[0]}`", f"study {self.name}", "given otherwise than "
                f"that of {of_array.name}, to hold for all blocks", "that of this grade alone, "
                f"while others are of {material}, of which it is not known"))
        return table.with_(**{key: own[key] for key in of_grade})

    @property
    def uncertain_of_magnet(self) -> tuple[Uncertain, ...]:
        """Uncertain amplitudes of the magnet, which are parameters of its posterior."""
        return tuple(one for one in self.uncertain if not one.is_of_instrument)

    def with_tables(self, tables: Mapping[str, Mapping[str, Any]]) -> Study:
        """Return the study with other tables of some of its maps, by the names of the maps."""
        return self.with_(maps=tuple(one.with_(**tables.get(one.name, {})) for one in self.maps))


def is_nonlinear(study: Study) -> bool:
    """Tell whether the field is a non-linear function of the magnetizations (iron with a curve)."""
    iron = iron_of(study)
    return iron is not None and (iron.curve is not None or any(
        body.curve for body in getattr(iron, "bodies", ())))


def iron_of(study: Study) -> IronRing | Iron | None:
    """Return the study's iron with its material, or None if it has no iron."""
    return study.iron_ring or study.iron


def magnet_description(study: Study) -> dict[str, Any]:
    """Return the keys and values that describe a study's magnet, as plain data.

    They are those of `MAGNET_KEYS`, what irreversible losses follow from, and how magnetizations
    vary within blocks, of which the parameters follow.
    """
    keys = MAGNET_KEYS | ({"demagnetization"} if study.demagnetization is not None
                          and study.demagnetization.irreversible else set())
    found = study.model_dump(mode="json", include=keys)
    if study.prior.variation_sd:
        found["prior"] = {"variation_sd": study.prior.variation_sd,
                          "variation_length_m": study.prior.variation_length_m}
    if study.uncertain_of_magnet:  # parameters too
        found["uncertain"] = [one.model_dump(mode="json") for one in study.uncertain_of_magnet]
    return found


def curve_of(study: Study) -> Curve | None:
    """Return the magnetization curve of the iron, or None if it has none.

    Raises
    ------
    StudyError
        If the curve is in a file that has not been read (`read_study` reads it).
    """
    iron = iron_of(study)
    return None if iron is None or iron.curve is None else curve_from(iron.curve, study.name)


def curve_from(curve: IronCurve, name: str = "") -> Curve:
    """Return the magnetization curve that keys of a study describe.

    Raises
    ------
    StudyError
        As of `curve_of`.
    """
    if curve.kind == "brauer":
        return materials.brauer(curve.k1_m_per_H, curve.k2_per_T2, curve.k3_m_per_H)
    if curve.kind == "froehlich_kennelly":
        return materials.froehlich_kennelly(curve.initial_relative_permeability,
                                            curve.saturation_polarization_T)
    if curve.kind == "steel":
        table = materials.read_table(materials.steels()[curve.name])
    elif curve.file is None:
        table = curve.H_A_per_m, curve.B_T
    else:  # the folder that the path is relative to is not known here
        raise StudyError(must_be("`curve.file` of the iron", f"study {name}".rstrip(),
                                 "read together with the study's own file", f"'{curve.file}'",
                                 "Use read_study, or give H_A_per_m and B_T."))
    return materials.table_curve(np.array(table[0]), np.array(table[1]))


def differences(one: Any, other: Any, key: str = "") -> dict[str, tuple[Any, Any]]:
    """Return both values of every key in which two trees of plain data differ, by dotted key.

    Examples
    --------
    >>> differences({"array": {"rings": 1, "ring": []}}, {"array": {"rings": 2, "ring": []}})
    {'array.rings': (1, 2)}
    """
    if isinstance(one, dict) and isinstance(other, dict):
        found: dict[str, tuple[Any, Any]] = {}
        for name in one | other:
            found |= differences(one.get(name), other.get(name), f"{key}.{name}".lstrip("."))
        return found
    return {} if one == other else {key: (one, other)}
