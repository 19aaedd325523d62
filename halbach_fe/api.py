"""Functions of the Python interface that combine several subpackages.

The package `halbach_fe` exports them: a user writes ``import halbach_fe as hf`` and
``hf.multipoles(...)``. Most of them take a `Magnet` (from `halbach_fe.build_magnet`) and a
`Session`, and return a result with labelled arrays. The command line calls the same functions.
"""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as value_of
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.core.files import as_path
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.core.numbers import ACROSS, DRAWS, HIGHEST_DEGREE, check_number
from halbach_fe.core.progress import Progress, Say, quiet
from halbach_fe.core.result_folder import single_file
from halbach_fe.design import demagnetization as demagnetization_room
from halbach_fe.design.demagnetization import DemagnetizationMap
from halbach_fe.design.measurement_plan import MeasurementPlan, plan_measurement
from halbach_fe.design.objective import check_objective, objective_of
from halbach_fe.design.shimming import Kind, Shim
from halbach_fe.design.shimming import shim as choose_moves
from halbach_fe.design.sorting import SortedBlocks, sort_blocks, sortable
from halbach_fe.design.tolerance import (
    HomogeneityTolerance,
    Tolerance,
    predict_homogeneity,
    predict_tolerance,
)
from halbach_fe.diagnosis import diagnose as diagnosis_room
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.geometry.array_layout import beside_blocks, blocks_table
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.inference.map_homogeneity import MAP, map_homogeneity, of_other_size
from halbach_fe.inference.posterior_files import disagreement_of, distributions_of
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import taking_arrays
from halbach_fe.measurement.formats.block_tables import DeclaredBlocks
from halbach_fe.measurement.formats.block_tables import import_blocks as read_foreign_blocks
from halbach_fe.measurement.formats.declared_format import FORMATS, DeclaredFormat
from halbach_fe.measurement.formats.import_export import WRITERS, export_map
from halbach_fe.measurement.formats.import_export import import_map as read_foreign_map
from halbach_fe.measurement.probe_law import check_total_field
from halbach_fe.response.block_variation import nominal_parameters, study_prior
from halbach_fe.response.field_on_lines import FieldOnLines, Lines, field_on_lines
from halbach_fe.response.homogeneity import Homogeneity, HomogeneityModel, homogeneity_model
from halbach_fe.response.magnetic_axis import MagneticAxis
from halbach_fe.response.magnetic_axis import magnetic_axis as axis_of
from halbach_fe.response.multipoles import (
    MultipoleModel,
    MultipoleReference,
    Multipoles,
    multipole_models,
)
from halbach_fe.response.region import SHOWN_DEGREES, Region, default_region
from halbach_fe.response.stray_field import StrayField, stray_field
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.free_blocks import FreeBlocks, write_free_blocks
from halbach_fe.study.model import Study
from halbach_fe.synthetic.hidden_effects import parse_hidden_effect
from halbach_fe.synthetic.simulate import SimulatedCampaign, simulate_campaign

prior = prior_from_blocks


@typed
def import_map(path: str | Path, format: str = "", **declared: object) -> xr.Dataset:
    r"""Read a map in another file format, in m and T.

    Parameters
    ----------
    path : str or Path
    format : str, optional
        ``columns``, ``opera`` and so on; by default it is recognized from the content.
    **declared
        What the file does not state: columns (a list), length_unit, field_unit, angle_unit,
        component, at, origin_m, decimal_comma, encoding, as the options of ``halbach-fe
        import-map`` are named.

    Returns
    -------
    Dataset
        The map, as of `halbach_fe.read_map`. What the file says and the map does not, a symmetry or
        the place of the magnet, is said in a warning.

    Raises
    ------
    StudyError
        If an option has another name, kind or value.
    MeasurementError
        If the file cannot be read as a map; the message says what to add.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> with open("mm.txt", "w") as file:
    ...     _ = file.write("x[mm],y[mm],z[mm],Bx[mT],By[mT],Bz[mT]\n1,2,3,4,5,6\n")
    >>> float(hf.import_map("mm.txt")["B_T"][0, 2])
    0.006
    """
    stated = DeclaredFormat.of(declared, "hf.import_map")
    if format not in ("", *FORMATS):
        raise MeasurementError(must_be("format", "hf.import_map", f"one of {', '.join(FORMATS)}",
                                       f"'{format}'"))
    found = read_foreign_map(as_path(path), stated, format)
    if remarks := found.remarks:
        warnings.warn(f"Of {path}: {' '.join(remarks)}", HalbachWarning, stacklevel=3)
    return found.data


@typed
def import_blocks(path: str | Path, **declared: object) -> BlockTable | FreeBlocks:
    r"""Read a table of blocks in own columns and units.

    Parameters
    ----------
    path : str or Path
        Text or a workbook (.xlsx).
    **declared
        What the table does not state: columns (a list), length_unit, field_unit, angle_unit, axes,
        fixed, and so on, as the options of ``halbach-fe import-blocks`` are named.

    Returns
    -------
    BlockTable or FreeBlocks
        Measured blocks; or, of a table with positions, the columns of ``array.free_blocks``.

    Raises
    ------
    StudyError
        If an option has another name, kind or value.
    MeasurementError
        If the table cannot be read; the message says what to add.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> with open("blocks.txt", "w") as file:
    ...     _ = file.write("name,type,moment_x[mA m^2],moment_y[mA m^2],moment_z[mA m^2]\n"
    ...                    "a,1,500,0,0\n")
    >>> table = hf.import_blocks("blocks.txt", fixed={"volume": "500 mm^3", "sigma": "0.2 %"})
    >>> float(table.moment[0, 0])
    0.5
    """
    return read_foreign_blocks(as_path(path), DeclaredBlocks.of(declared, "hf.import_blocks"))


@typed
def export(content: xr.Dataset | Magnet, path: str | Path, format: str = "csv") -> Path:
    """Write a map, or the table of a magnet's blocks, for another program.

    Parameters
    ----------
    content : Dataset or Magnet
        A map is written in a ``format``: openpmd, bdsim, geant4, csv or vtu. Of a magnet the table
        of its free blocks is written (CSV or HDF5).
    path : str or Path
    format : str, optional

    Returns
    -------
    Path

    Raises
    ------
    MeasurementError
        If the format is unknown, or needs a regular grid that the map is not.
    OutputError
        If the file cannot be written, or was there before and not written by this function.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.export(hf.build_magnet(hf.read_study("dipole.toml")), "nominal.csv").name
    'nominal.csv'
    """
    path = as_path(path)
    if isinstance(content, Magnet):
        if format not in ("csv", "blocks"):
            raise MeasurementError(must_be(
                "format", "hf.export", "left out for a magnet, of which the table of its blocks is "
                "written", f"'{format}'", "Its field is a map: hf.solve(magnet).field_map."))
    elif format not in WRITERS:
        raise MeasurementError(must_be("format", "hf.export", f"one of {', '.join(WRITERS)}",
                                       f"'{format}'"))
    with single_file(path, "halbach-fe export"):
        if isinstance(content, Magnet):
            write_free_blocks(blocks_table(content), path)
            if others := beside_blocks(content):
                warnings.warn(f"A table of blocks leaves out {', '.join(others)} of magnet "
                              f"{content.name}.", HalbachWarning, stacklevel=2)
        else:
            export_map(content, format, path)
    return path


@dataclass(frozen=True)
class MultipoleTables(ShownInNotebook):
    """The multipoles of a magnet, in one table per reference.

    Attributes
    ----------
    magnet : Magnet
    tables : sequence of (MultipoleModel, mapping of str to Multipoles)
        The linear model of each reference, and its multipoles by the name of the distribution of
        the magnetizations: ``prior``, or ``prior`` and ``posterior``. A 2D magnet has a single
        table. A 3D magnet has two: of the field integrated along z, and of one circle.
    disagreement : str or None
        Sentences if the update of the posterior disagrees with its map, empty if it agrees; None
        if that is not known.
    left_out : tuple of str
        Sentences about references without a main multipole, which have no table.
    limit : float or None
        Largest unwanted multipole that is allowed, in units of 1e-4 of the main one.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> model, multipoles = hf.multipoles(magnet, hf.Session.open("results")).tables[0]
    >>> model.unit, multipoles["prior"].orders[:3]
    ('T', (2, 3, 4))
    """

    magnet: Magnet
    tables: Sequence[tuple[MultipoleModel, Mapping[str, Multipoles]]]
    disagreement: str | None = None
    left_out: tuple[str, ...] = ()
    limit: float | None = None


@dataclass(frozen=True)
class HomogeneityResult(ShownInNotebook):
    """How homogeneous the field of a magnet is in a region.

    Attributes
    ----------
    magnet : Magnet
    model : HomogeneityModel
        The linear model of the field in the region.
    by_name : mapping of str to Homogeneity
        By the name of the distribution of the magnetizations: ``prior``, or ``prior`` and
        ``posterior``.
    distributions : mapping of str to Gaussian
        These distributions, in A/m.
    disagreement : str or None
        Sentences if the update of the posterior disagrees with its map, empty if it agrees; None
        if that is not known.
    stray_field : StrayField or None
        How far outside the field of the last of these distributions is strong.
    of_map : mapping of str to Homogeneity
        That of a measured map itself, see `halbach_fe.inference.map_homogeneity`; empty without.
    map_misfit : float
        Noise that the fit of the map finds over the stated one; about 1 if that can be relied on.
    map_remarks : tuple of str
        Sentences about what the map does not tell.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> found = hf.homogeneity(magnet, hf.Session.open("results"), hf.Region.sphere(0.005))
    >>> found.by_name["prior"].harmonics[0].name
    'Z'
    """

    magnet: Magnet
    model: HomogeneityModel
    by_name: Mapping[str, Homogeneity]
    distributions: Mapping[str, Gaussian]
    disagreement: str | None = None
    stray_field: StrayField | None = None
    of_map: Mapping[str, Homogeneity] = value_of(default_factory=dict)
    map_misfit: float = 1.0
    map_remarks: tuple[str, ...] = ()


@taking_arrays
@alone
def diagnose(
    magnet: Magnet, data: xr.Dataset | Mapping[str, xr.Dataset], session: Session = NOT_KEPT,
    blocks: BlockTable | None = None, effects: Sequence[str | Effect] | None = None,
    validation_map: xr.Dataset | None = None, say: Say = quiet,
    floor_T: Mapping[str, float] | Mapping[str, Mapping[str, float]] | None = None,
    time_limit_s: float | None = None,
) -> Diagnosis:
    """Find which effects the study lacks to explain measured maps, and add them to the model.

    Parameters
    ----------
    magnet : Magnet
        The magnet of the study that is examined.
    data : Dataset or dict of str to Dataset
        The measured map, see `halbach_fe.read_map`; or all maps that the study lists, see
        `halbach_fe.read_maps`.
    session : Session, optional
        Its folder receives a subfolder for each round of solving and searching.
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    effects : sequence of str or Effect, optional
        The candidate effects: names of the catalogue, or effects of your own; by default all of
        the catalogue.
    validation_map : Dataset, optional
        Another map, which is predicted but does not update the model.
    say : callable, optional
        Called with a line of text about each step, to report progress.
    floor_T : dict, optional
        The model-free floor of the map by component (``Bx``), see `halbach_fe.check_map`; of maps
        that the study lists, by map and component. It is shown beside the results.
    time_limit_s : float, optional
        Time after which the search ends with what it has so far.

    Returns
    -------
    Diagnosis
        The identified effects, the study with these effects added, and the inferences before and
        after.

    Raises
    ------
    StudyError
        If a name in ``effects`` is not in the catalogue.
    MeasurementError
        If a map or the blocks do not fit the study.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> diagnosis = hf.diagnose(magnet, hf.read_map("map.csv"), hf.Session.open("diagnosis"),
    ...                         effects=["gain_x", "offset_y"])
    >>> diagnosis.study.name
    'dipole'
    """
    if time_limit_s is not None:
        check_number("time_limit_s", "diagnose", time_limit_s, 0)
    effect_by_name = {effect.name: effect for effect in catalogue()}
    chosen: dict[str, Effect] = {}
    for effect in effects or ():
        if not isinstance(effect, str):  # which comes before that of the catalogue
            chosen[effect.name] = effect
        elif effect in effect_by_name:
            chosen.setdefault(effect, effect_by_name[effect])
        elif effect not in chosen:
            near = difflib.get_close_matches(effect, effect_by_name, 1, 0.5)
            raise StudyError(must_be("effects", "diagnose", "names of the catalogue", f"'{effect}'",
                                     f"Did you mean {near[0]}?" if near else ""))
    return diagnosis_room.diagnose(
        magnet.study, data, session, blocks, None if effects is None else list(chosen.values()),
        validation_map, say, floor_T=floor_T, time_limit_s=time_limit_s)


@typed
def magnetic_axis(
    magnet: Magnet, session: Session, magnetizations: Gaussian | InferenceResult
) -> MagneticAxis | None:
    """Compute magnetic centre, axis and roll for a distribution of the magnetizations.

    Parameters
    ----------
    magnet : Magnet
    session : Session
    magnetizations : Gaussian or InferenceResult
        In A/m; of the result of `halbach_fe.infer` the posterior. A result knows its magnet, while
        a Gaussian is only known to have as many parameters: that it is of this magnet is the
        caller's word.

    Returns
    -------
    MagneticAxis or None
        None if the nominal magnet has no main multipole, or the middle of the bore is not free.

    Raises
    ------
    MeasurementError
        If the result is that of another magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet, session = hf.build_magnet(hf.read_study("dipole.toml")), hf.Session.open("results")
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), session)
    >>> hf.magnetic_axis(magnet, session, result).order
    1
    """
    if isinstance(magnetizations, InferenceResult):
        magnetizations = distributions_of(magnet, magnetizations)["posterior"]
    return axis_of(magnet, session, magnetizations)


@alone
def multipoles(
    magnet: Magnet, session: Session = NOT_KEPT, reference: MultipoleReference | None = None,
    posterior: Mapping[str, Gaussian] | InferenceResult | None = None,
) -> MultipoleTables:
    """Compute the multipoles of a magnet, with standard deviations.

    A 3D magnet has two tables: of the field integrated along z, and of the circle at
    ``reference.z_m`` (the middle of the magnet by default).

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the runs of GetDP and the response matrix.
    reference : MultipoleReference, optional
        Radius, orders and z of the multipoles; by default the radius of the study's circle, or two
        thirds of the bore radius, and orders 1 to 10.
    posterior : mapping of str to Gaussian, or InferenceResult, optional
        Distributions of the magnetizations in A/m by name. By default the study's prior of an
        assembled magnet is the only distribution.

    Returns
    -------
    MultipoleTables

    Raises
    ------
    StudyError
        If the reference does not fit the study, or the nominal magnet has no main multipole.
    MeasurementError
        If the posterior is that of another magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> tables = hf.multipoles(magnet, hf.Session.open("results")).tables
    >>> model, multipoles = tables[0]
    >>> model.main, sorted(multipoles)
    (1, ['prior'])
    """
    known = None if posterior is None else distributions_of(magnet, posterior)
    reference = reference or MultipoleReference()
    references = [reference]
    if magnet.dimension == 3:
        references = [replace(reference, z_m=None), replace(
            reference, z_m=magnet.middle_z_m if reference.z_m is None else reference.z_m)]
    models, left_out = multipole_models(magnet, references, session)
    distributions = known or {"prior": study_prior(magnet, len(models[0].nominal))}
    return MultipoleTables(magnet, [
        (model, {name: model.of(distribution) for name, distribution in distributions.items()})
        for model in models], disagreement_of(posterior, magnet), left_out)


@alone
def field(
    magnet: Magnet, lines: Lines, session: Session = NOT_KEPT,
    posterior: Mapping[str, Gaussian] | InferenceResult | None = None, inside: bool = False,
) -> FieldOnLines:
    """Return B and H on parallel lines with their bars, for field integrals and kick maps.

    Parameters
    ----------
    magnet : Magnet
    lines : Lines
        From a start to an end in m, `halbach_fe.Lines`.
    session : Session, optional
    posterior : mapping of str to Gaussian, or InferenceResult, optional
        By default the bars are those of the study's prior of an assembled magnet.
    inside : bool
        Whether points may lie inside blocks and iron.

    Returns
    -------
    FieldOnLines

    Raises
    ------
    StudyError
        If a point cannot be computed.
    MeasurementError
        If the posterior is that of another magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> ring = hf.halbach_ring(order=1, blocks=8, inner_radius_m=0.02, outer_radius_m=0.04,
    ...                        length_m=0.05, remanence_T=1.2)
    >>> found = hf.field(ring, hf.Lines((0, 0, -0.2), (0, 0, 0.2), count=101))
    >>> integral, sd = found.integrals(1)  # (1, 3) in T m
    >>> bool(sd[0, 0] > 0)
    True
    """
    known = (study_prior(magnet, len(nominal_parameters(magnet))) if posterior is None
             else list(distributions_of(magnet, posterior).values())[-1])
    found = field_on_lines(magnet, lines, known, session, inside)
    most = 0.01
    if found.relative_spacing > most:
        warnings.warn(f"The {lines.count} points of a line are too far apart for its integrals: "
                      f"that makes {found.spacing_in_words}, which is in their error bars. Take "
                      "more points (--count), or shorter lines.", HalbachWarning, stacklevel=2)
    return replace(found, measured=posterior is not None,
                   disagreement=disagreement_of(posterior, magnet))


@alone
def homogeneity(
    magnet: Magnet, session: Session = NOT_KEPT, region: Region | None = None,
    posterior: Mapping[str, Gaussian] | InferenceResult | None = None,
    degrees: int = SHOWN_DEGREES, data: xr.Dataset | Mapping[str, xr.Dataset] | None = None,
) -> HomogeneityResult:
    """Compute mean field, homogeneity in ppm and spherical harmonics, with error bars.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the runs of GetDP and the response matrix.
    region : Region, optional
        By default the study's, or the sphere of half the radius of the bore about the axis in the
        middle of the magnet.
    posterior : mapping of str to Gaussian, or InferenceResult, optional
        Distributions of the magnetizations in A/m by name. By default the study's prior of an
        assembled magnet is the only distribution.
    degrees : int, optional
        Largest degree of the spherical harmonics.
    data : Dataset or dict of str to Dataset, optional
        The measured map, or all maps that the study lists, whose own homogeneity is put beside.

    Returns
    -------
    HomogeneityResult

    Raises
    ------
    StudyError
        If the study is a cross-section, or the region reaches into material.
    MeasurementError
        If the posterior is that of another magnet, or the region reaches beyond the map.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> region = hf.Region("cylinder", (0.005, 0.005, 0.01))
    >>> known = hf.homogeneity(magnet, hf.Session.open("results"), region).by_name["prior"]
    >>> known.peak_to_peak_ppm > known.rms_ppm > 0
    True
    """
    known = None if posterior is None else distributions_of(magnet, posterior)
    check_number("degrees", "homogeneity", degrees, 1, HIGHEST_DEGREE, whole=True)
    model = homogeneity_model(magnet, region or default_region(magnet), session, degrees)
    distributions = known or {"prior": study_prior(magnet, len(model.response.nominal))}
    of_map, misfit, remarks = ({}, 1.0, ()) if data is None else map_homogeneity(
        magnet, data, model)
    by_name = {name: model.of(distribution, measured=name != "prior")
               for name, distribution in distributions.items()}
    if MAP in of_map and (remark := of_other_size(of_map[MAP], list(by_name.values())[-1])):
        remarks = (*remarks, remark)
    return HomogeneityResult(
        magnet, model, by_name, distributions, disagreement_of(posterior, magnet),
        stray_field(magnet, session, list(distributions.values())[-1]),
        of_map, misfit, remarks)


@alone
def plan(magnet: Magnet, session: Session = NOT_KEPT, points: int | None = None) -> MeasurementPlan:
    """Choose the positions whose readings carry most information about the magnetizations.

    If the study has a table ``homogeneity``, they tell most about the deviation of |B| in that
    region.

    Parameters
    ----------
    magnet : Magnet
        The candidates are the positions ``plan.candidates`` of its study, or, by default, the
        positions that the study measures.
    session : Session, optional
        Its folder receives the runs of GetDP and the response matrix.
    points : int, optional
        Number of positions to choose; by default the study's ``plan.points``, else the number of
        positions that the study measures.

    Returns
    -------
    MeasurementPlan

    Raises
    ------
    StudyError
        If there are fewer candidates than positions to choose, or less than one position to
        choose, a position is not in air within the meshed region, or the study does not observe
        flux densities.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> len(hf.plan(magnet, hf.Session.open("results"), points=8).points)
    8
    """
    if points is not None:
        check_number("points", "plan", points, 1, whole=True)
    return plan_measurement(magnet, session, points)


@alone
def shim(
    result: InferenceResult, session: Session = NOT_KEPT,
    reference: MultipoleReference | None = None,
    swaps: int = 8, turns: int = 8, replacements: int = 0, limit_units: float | None = None,
    stock: BlockTable | None = None, seed: int = 1, limit_ppm: float | None = None,
    cycles: int = 0,
) -> Shim:
    """Choose blocks to swap, turn or replace so that unwanted multipoles become small.

    If the study has a table ``homogeneity``, the deviation of |B| in that region becomes small.

    Parameters
    ----------
    result : InferenceResult
        The inference of the measured magnet, whose posterior describes the blocks.
    session : Session, optional
    reference : MultipoleReference, optional
        Radius, orders and z of the multipoles; by default the radius of the study's circle, or two
        thirds of the bore radius, and orders 1 to 10.
    swaps, turns, replacements : int
        Largest number of moves of each kind.
    limit_units : float, optional
        Largest unwanted multipole that is allowed, in units of 1e-4 of the main multipole. The
        search ends when it is met.
    stock : BlockTable, optional
        Measured blocks that may replace others; by default new blocks distributed as in the
        study's prior. Needs ``replacements``.
    seed : int
        Seed of the random draws that estimate the probability of meeting the limit.
    limit_ppm : float, optional
        Largest rms deviation of |B| that is allowed, in ppm, if the study asks for homogeneity. The
        search ends when it is met.
    cycles : int
        Largest number of cyclic exchanges of three blocks.

    Returns
    -------
    Shim
        The moves in their order, and the multipoles or the field before and after.

    Raises
    ------
    StudyError
        If ``stock`` is given without ``replacements``, a number is out of its range, reference,
        limit or region do not fit the study, or it has too many blocks for this search.
    MeasurementError
        If the stock does not fit the study, or its blocks are in the magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> session = hf.Session.open("results")
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), session)
    >>> bool(hf.shim(result, session, swaps=1, turns=0).before.orders)
    True
    """
    for name, value in (("swaps", swaps), ("turns", turns), ("replacements", replacements),
                        ("seed", seed),
                        ("cycles", cycles)):
        check_number(name, "shim", value, 0, whole=True)
    if stock is not None and not replacements:
        raise StudyError("Input stock must go with replacements, the number of blocks that may be "
                         "replaced; instead replacements is 0. Give replacements.")
    distributions_of(result.magnet, result)
    check_objective(result.magnet, reference, limit_units, limit_ppm)
    model = objective_of(result.magnet, reference, session.within("objective"),
                         result.posterior.stacked.mean)
    budget: dict[Kind, int] = {"swap": swaps, "cycle": cycles, "turn": turns,
                               "replace": replacements}
    return choose_moves(result, model, np.random.default_rng(seed), budget,
                        limit_units or limit_ppm, stock)


@alone
def sort(
    magnet: Magnet, blocks: BlockTable, session: Session = NOT_KEPT,
    reference: MultipoleReference | None = None, seed: int = 1, progress: Progress | None = None,
    turns: bool = False,
) -> SortedBlocks:
    """Assign measured blocks to slots: for small multipoles, or a homogeneous field.

    If the study has a table ``homogeneity``, the deviation of |B| in that region becomes small.

    Every block goes to a slot of its own type. The table may have more blocks than there are slots.

    Parameters
    ----------
    magnet : Magnet
    blocks : BlockTable
        The measured blocks, see `halbach_fe.read_blocks`.
    session : Session, optional
        Its folder receives the runs of GetDP and the response matrix.
    reference : MultipoleReference, optional
        Radius, orders and z of the multipoles; by default the radius of the study's circle, or two
        thirds of the bore radius, and orders 1 to 10.
    seed : int
        Seed of the random orders from which the search starts.
    progress : callable, optional
        Called with the number of starts done and their total number.
    turns : bool
        Whether blocks may also be turned in their slots, as far as shape and nominal magnetization
        allow: a cube about its magnetization.

    Returns
    -------
    SortedBlocks

    Raises
    ------
    StudyError
        If reference or region do not fit the study, or a number is out of its range.
    MeasurementError
        If the table does not fit the study, or has too few blocks of a type.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> assignment = hf.sort(magnet, hf.read_blocks("spares.csv"), hf.Session.open("results"))
    >>> assignment.left_over
    2
    """
    check_number("seed", "sort", seed, 0, whole=True)
    if not isinstance(turns, bool):
        raise StudyError(must_be("turns", "sort", "True or False", turns))
    check_objective(magnet, reference, None, None)
    blocks = sortable(magnet, blocks)  # before the solves, which may take long
    model = objective_of(magnet, reference, session)
    return sort_blocks(magnet, blocks, model, np.random.default_rng(seed),
                       progress or quiet, turns)


@alone
def tolerance(
    magnet: Magnet, session: Session = NOT_KEPT, blocks: BlockTable | None = None,
    reference: MultipoleReference | None = None, draws: int = 10_000,
    limit_units: float | None = None, seed: int = 1, limit_ppm: float | None = None,
) -> Tolerance | HomogeneityTolerance:
    """Predict the multipoles, or the homogeneity, of magnets whose blocks are drawn from the prior.

    If the study has a table ``homogeneity``, it is the deviation of |B| in that region.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the runs of GetDP and the response matrix.
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    reference : MultipoleReference, optional
        Radius, orders and z of the multipoles; by default the radius of the study's circle, or two
        thirds of the bore radius, and orders 1 to 10.
    draws : int
        Number of magnets to draw.
    limit_units : float, optional
        Largest unwanted multipole that is allowed, in units of 1e-4 of the main multipole.
    seed : int
        Seed of the random draws.
    limit_ppm : float, optional
        Largest rms deviation of |B| that is allowed, in ppm, if the study asks for homogeneity.

    Returns
    -------
    Tolerance or HomogeneityTolerance
        What to expect, and with a limit the share of the magnets that meet it.

    Raises
    ------
    StudyError
        If reference, limit or region do not fit the study, or a number is out of its range.
    MeasurementError
        If the blocks do not fit the study.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> session = hf.Session.open("results")
    >>> hf.tolerance(magnet, session, draws=100, limit_units=1e4).share
    1.0
    """
    check_number("draws", "tolerance", draws, *DRAWS, whole=True)
    check_number("seed", "tolerance", seed, 0, whole=True)
    check_objective(magnet, reference, limit_units, limit_ppm)
    measured = None if blocks is None else prior_from_blocks(magnet, blocks)
    model, generator = objective_of(magnet, reference, session), np.random.default_rng(seed)
    prior = study_prior(magnet, len(model.nominal), measured.gaussian if measured else None)
    angles = magnet.study.prior.mounting_sd_deg, (
        0.0 if measured else magnet.study.prior.direction_sd_deg)
    # what a block that turns by these angles about two axes loses along its own, in the mean
    lost, most = 1 - float(np.exp(-np.sum(np.radians(angles)**2))), 0.01
    if lost > most:
        warnings.warn(
            f"Angles of {' and '.join(f'{one:g}' for one in angles if one)} degrees are not small: "
            f"blocks lose {100 * lost:.2g} % along their easy axes, of which tolerance, linear in "
            "the angles, knows nothing. Its distribution is too narrow on that side.",
            HalbachWarning, stacklevel=2)
    found = (predict_tolerance(model, magnet, prior, draws, generator, limit_units)
             if isinstance(model, MultipoleModel) else
             predict_homogeneity(model.homogeneity, magnet, prior, draws, generator, limit_ppm))
    return replace(found, table_doubts=measured.doubts if measured else None)


@alone
def demagnetization(
    magnet: Magnet, session: Session = NOT_KEPT, across: int = demagnetization_room.ACROSS,
    progress: Progress | None = None,
) -> DemagnetizationMap:
    """Map how near the blocks are to the knee of their demagnetization curve when they are hot.

    Parameters
    ----------
    magnet : Magnet
        Its study needs the table ``demagnetization`` with the material's data and temperature.
    session : Session, optional
        Its folder receives the runs of GetDP.
    across : int
        Number of cells across the radial thickness of a block.
    progress : callable, optional
        Is told how many cells are done, and how many there are.

    Returns
    -------
    DemagnetizationMap

    Raises
    ------
    StudyError
        If the study has no table ``demagnetization``, or no block is magnetized.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hot = hf.build_magnet(hf.read_study("dipole.toml").with_(demagnetization={
    ...     "intrinsic_coercivity_A_per_m": 1.6e6, "remanence_coefficient_per_K": -0.0012,
    ...     "coercivity_coefficient_per_K": -0.006, "temperature_C": 60.0}))
    >>> hf.demagnetization(hot, hf.Session.open("results")).share_beyond_now
    0.0
    """
    check_number("across", "demagnetization", across, *ACROSS, whole=True)
    return demagnetization_room.demagnetization_map(magnet, session, across, progress)


@typed
def simulate_measurement(
    study: Study, seed: int = 1, hide: Sequence[str] = (), hide_random: int = 0,
    progress: Progress = quiet, placed: BlockTable | None = None,
    magnitude: bool = False,
) -> SimulatedCampaign:
    """Simulate the measurement of a magnet whose blocks are drawn from the study's prior.

    magpylib and NGSolve compute the field, never halbach-fe's own model, so that the inference can
    be tested on the result.

    Parameters
    ----------
    study : Study
        It must state the noise of its readings.
    seed : int
        Seed of all random numbers: magnetizations, noise, and sizes of hidden effects.
    hide : sequence of str
        Effects that the simulated magnet has but the study lacks: ``NAME`` or ``NAME=VALUE,...``.
    hide_random : int
        Number of further hidden effects that are drawn at random.
    progress : callable, optional
        Called with the amount of work that magpylib has done and its total.
    placed : BlockTable, optional
        The blocks of an earlier simulation with this seed in the places in which they are to be
        assembled: the table that `sort` returns.
    magnitude : bool
        Whether the maps are of |B| alone, as of an NMR teslameter.

    Returns
    -------
    SimulatedCampaign
        Map, held-out map and block table, and the truth behind them.

    Raises
    ------
    StudyError
        If a text in ``hide`` does not describe an effect, the magnet cannot be built, or the study
        does not state the noise of its readings, measures at a point inside a material, or cannot
        have one of the effects.
    ExtraMissingError
        If magpylib or NGSolve is not installed.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> campaign = hf.simulate_measurement(hf.read_study("dipole.toml"), seed=7)
    >>> campaign.readings.sizes["point"]
    24
    """
    check_number("seed", "simulate_measurement", seed, 0, whole=True)
    check_number("hide_random", "simulate_measurement", hide_random, 0, whole=True)
    if isinstance(hide, str):
        raise StudyError(must_be("hide", "simulate_measurement", "a list of texts, one for each "
                                 "effect", f"a text, '{hide}'", "Put it into brackets."))
    build_magnet(study)  # refuses what cannot be built
    if magnitude:
        check_total_field(study.instrument)
    try:
        hidden = [parse_hidden_effect(text) for text in hide]
    except ValueError as error:
        raise StudyError(must_be("hide", "simulate_measurement", "names of effects, with their "
                                 "values", f"what is none: {error}")) from None
    return simulate_campaign(study, seed, hide=hidden, hide_random=hide_random,
                             progress=progress, placed=placed, magnitude=magnitude)
