"""Magnets made in Python, without a file: of rings, of single blocks, and of magpylib's sources.

A magnet made here has a study like one that `halbach-fe new` writes: positions to measure at, the
noise of a probe that suits its field, and the usual tolerances of blocks. `Magnet.with_` changes
any of it, and `write_study` writes it down.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import rms
from halbach_fe.core.errors import HalbachError, HalbachWarning, StudyError, must_be
from halbach_fe.core.files import as_path, write_text
from halbach_fe.core.installation import import_extra
from halbach_fe.core.interface import check_options, typed
from halbach_fe.core.numbers import check_number
from halbach_fe.core.result_folder import single_file
from halbach_fe.geometry.array_layout import beside_blocks, blocks_table, free_outline
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.outline import at_heights
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.region import Region, region_points
from halbach_fe.solver.exact_block_field import field_of, gradient_of
from halbach_fe.study.free_blocks import (
    COLUMNS,
    REMANENCE_VECTOR,
    FreeBlocks,
    outline_of,
    validated_blocks,
    write_free_blocks,
)
from halbach_fe.study.model import Study
from halbach_fe.study.writer import (
    OUTER_RADIUS,
    MagnetTemplate,
    new_study,
    parse_new_study,
    study_text,
    write_new_study,
)

WRITTEN = "# Written by halbach_fe.write_study, which replaces no other file.\n"
"""First line of the studies that `write_study` writes."""


@typed
def halbach_ring(
    order: int = 1, blocks: int = 16, *, inner_radius_m: float, outer_radius_m: float,
    length_m: float | None = None, rings: int = 1, remanence_T: float | None = None,
    recoil_permeability: float | None = None, material: str | None = None,
    shape: Literal["sector", "trapezoid", "cuboid"] = "sector", name: str = "magnet",
) -> Magnet:
    """Return a magnet of equal rings whose magnetization turns from block to block.

    Parameters
    ----------
    order : int
        1 for a dipole, 2 for a quadrupole, ...
    blocks : int
        Blocks in each ring.
    inner_radius_m, outer_radius_m : float
    length_m : float, optional
        Length of the whole magnet; without it the magnet is an infinite cross-section.
    rings : int
        Rings along the length.
    remanence_T : float, optional
        By default 1.3 T.
    recoil_permeability : float, optional
        Relative; 1 by default, for which all fields are closed forms. Blocks of NdFeB and SmCo have
        1.03 to 1.10.
    material : str, optional
        A grade such as ``N42`` in place of these two.
    shape : str
    name : str

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If there is no such magnet.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.halbach_ring(order=2, blocks=16, inner_radius_m=0.015, outer_radius_m=0.04,
    ...                          length_m=0.05, remanence_T=1.2)
    >>> magnet
    Magnet(magnet: 16 blocks in 3D)
    >>> magnet.field_T([[0.01, 0, 0], [0, 0, 0]]).round(4) + 0.0
    array([[0.9072, 0.    , 0.    ],
           [0.    , 0.    , 0.    ]])
    """
    if material is not None and (remanence_T, recoil_permeability) != (None, None):
        raise StudyError(must_be("material", "halbach_ring", "given alone, as it has a remanence "
                                 "and a recoil permeability", "both"))
    check_number("order", "halbach_ring", order, 1)
    check_number("rings", "halbach_ring", rings, 1, whole=True)
    for key, value in {"inner_radius_m": inner_radius_m, "outer_radius_m": outer_radius_m,
                       "length_m": length_m, "remanence_T": remanence_T,
                       "recoil_permeability": recoil_permeability}.items():
        if value is not None or key.endswith("radius_m"):
            check_number(key, "halbach_ring", value)
    ring_length = None if length_m is None else length_m / rings
    magnet = _without_position_noise(MagnetTemplate(
        order, blocks, rings, inner_radius_m, outer_radius_m, ring_length,
        MagnetTemplate.remanence_T if remanence_T is None else remanence_T, shape,
        material=material), name)
    if material is not None:
        return magnet
    return magnet.with_(array__recoil_permeability=1.0 if recoil_permeability is None
                        else recoil_permeability)


@typed
def magnet_of_blocks(
    table: FreeBlocks | Mapping[str, Sequence[Any]], order: int = 1, name: str = "magnet"
) -> Magnet:
    """Return a magnet of single blocks of any shape, anywhere.

    Parameters
    ----------
    table : FreeBlocks or mapping of sequence
        Columns by name, see `halbach_fe.study.free_blocks.FreeBlocks`; a DataFrame is such a
        mapping. Blocks without ``name`` are numbered.
    order : int
        The main multipole: 1 for a dipole.
    name : str

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If the columns do not describe blocks, or the blocks overlap.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.magnet_of_blocks({
    ...     "shape": ["cuboid"], "x_m": [0.04], "y_m": [0.0], "z_m": [0.0], "size_x_m": [0.02],
    ...     "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.3]})
    >>> magnet.field_T([0.0, 0.0, 0.0]).round(4) + 0.0
    array([0.0255, 0.    , 0.    ])
    """
    if not isinstance(table, FreeBlocks):
        if not hasattr(table, "keys") or any(
                np.isscalar(table[one]) or getattr(table[one], "ndim", 1) == 0 for one in table):
            raise StudyError(must_be(
                "table", "magnet_of_blocks", "columns by name, each a list with an element for "
                "every block", f"a {type(table).__name__} that is none",
                'One block is {"shape": ["cuboid"], "x_m": [0.0], ...}.'))
        columns = {column: _plain(table[column]) for column in table}
        if "outline_m" in columns:  # as in a table that was read from a file
            with suppress(ValueError):
                columns["outline_m"] = [outline_of(cell) if isinstance(cell, str) else cell
                                        for cell in columns["outline_m"]]
        count = max((len(values) for values in columns.values()), default=0)
        columns.setdefault("name", [f"b{number}" for number in range(1, count + 1)])
        table = validated_blocks(columns, f"the blocks of {name}")
    return _without_position_noise(MagnetTemplate(order), name, table)


def _without_position_noise(
    template: MagnetTemplate, name: str, table: FreeBlocks | None = None
) -> Magnet:
    """Return the magnet of a template as `new_magnet` does, but without noise of positions: no
    file shows what a template assumes of the stage, and arrays of readings state ``sigma_T`` only.
    """
    return new_magnet(template, name, table=table)[0].with_(noise__position_sd_m=None)


def _plain(column: Sequence[Any]) -> list[Any]:
    """Return the values of a column; those that are not there are None."""
    return [None if (isinstance(value, float) and np.isnan(value))
            or type(value).__name__ == "NAType" else value  # pandas.NA, without pandas
            for value in np.asarray(column, dtype=object).tolist()]


def new_magnet(
    template: MagnetTemplate, name: str, folder: Path = Path(), table: FreeBlocks | None = None
) -> tuple[Magnet, MagnetTemplate]:
    """Return the magnet of a new study, and its template with the noise that suits its field.

    ``table`` has blocks in place of those of a file in ``folder``.
    """
    def built(template: MagnetTemplate) -> Magnet:
        return build_magnet(parse_new_study(new_study(name, template, folder, table), folder,
                                            table))

    template = with_noise(template, built(template))
    return built(template), template


def with_noise(template: MagnetTemplate, magnet: Magnet) -> MagnetTemplate:
    """Return a template with the noise of readings in T and of positions in m, of one digit, that
    suit a magnet.

    A good probe reads to a ten-thousandth of the largest field, but not better than the best
    probes. A stage is so exact that its errors make about the same noise, but neither better than
    good ones nor worse than usual ones. The field is that of the blocks alone.
    """
    stages_m = (1e-5, 1e-4)  # errors in m of good and of usual stages
    least_sigma_t = 1e-6  # noise of the best probes in T
    points = points_from(magnet.study.observation.positions)
    # about so many points suffice for the size of the field
    enough = 200
    points = points[::max(1, len(points) // enough)]
    sigma = max(least_sigma_t, 1e-4 * float(np.abs(field_of(magnet.blocks, points)).max()))
    slope = rms(gradient_of(magnet.blocks, points))
    stage = float(np.clip(sigma / slope if slope else np.inf, *stages_m))
    return replace(template, sigma_T=float(f"{sigma:.1g}"), position_sd_m=float(f"{stage:.1g}"))


@typed
def write_study(magnet: Magnet | Study, path: str | Path) -> None:
    """Write the study of a magnet as a file that `halbach_fe.read_study` reads back the same.

    Parameters
    ----------
    magnet : Magnet or Study
    path : str or Path
        Free blocks are written beside it, as ``STEM.blocks.csv``.

    Returns
    -------
    None

    Raises
    ------
    OutputError
        If a file cannot be written, or is there already and was not written by this function.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03)
    >>> hf.write_study(magnet, "ring.toml")
    >>> hf.read_study("ring.toml") == magnet.study
    True
    """
    study = magnet.study if isinstance(magnet, Magnet) else magnet
    path, table = Path(path), study.array.free_blocks
    blocks = path.with_name(f"{path.stem}.blocks.csv")
    with single_file(path, "hf.write_study", *([] if table is None else [blocks])):
        if table is not None:
            write_free_blocks(table, blocks)
        write_text(path, WRITTEN + study_text(study, blocks.name))


@typed
def from_magpylib(sources: Any, order: int = 1, name: str = "magnet") -> Magnet:
    """Return the magnet of magpylib's Cuboids, Cylinders and CylinderSegments.

    Parameters
    ----------
    sources : magpylib.Collection, or a sequence of sources
        Every source stands at one place; its polarization is the remanence of a block with a recoil
        permeability of 1, as magpylib has it.
    order : int
        The main multipole: 1 for a dipole.
    name : str

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If a source is of another kind, moves along a path, or overlaps another one.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> import magpylib
    >>> cube = magpylib.magnet.Cuboid(dimension=(0.02, 0.02, 0.02), polarization=(1.3, 0, 0),
    ...                               position=(0.04, 0, 0))
    >>> hf.from_magpylib(cube)
    Magnet(magnet: 1 blocks in 3D)
    """
    listed = getattr(sources, "sources_all", None)
    if listed is None:
        listed = list(sources) if isinstance(sources, Sequence) else [sources]
    rows = [row for number, source in enumerate(listed, 1)
            for row in _rows_of(source, f"b{number}")]
    if not rows:
        raise StudyError(must_be("sources", "from_magpylib", "magnets", "none"))
    return magnet_of_blocks({column: [row.get(column) for row in rows] for column in dict.fromkeys(
        key for row in rows for key in row)}, order, name)


def _rows_of(source: Any, name: str) -> list[dict[str, Any]]:
    """Return the rows of a table of blocks that are a source of magpylib."""
    halves_deg = ((0.0, 180.0), (180.0, 360.0))  # A whole ring of magpylib is two sectors here
    kind, what = type(source).__name__, f"source {name}"
    if kind not in ("Cuboid", "Cylinder", "CylinderSegment"):
        raise StudyError(must_be(what, "from_magpylib", "a Cuboid, Cylinder or CylinderSegment",
                                 f"a {kind}", "hf.magnet_of_blocks takes prisms of any outline."))
    if np.ndim(source.position) != 1 or source.dimension is None or source.polarization is None:
        raise StudyError(must_be(what, "from_magpylib", "at one place, with dimension and "
                                 "polarization", "another one"))
    turn: Rotation = source.orientation
    remanence = turn.apply(source.polarization)
    common = dict(zip(("x_m", "y_m", "z_m"), map(float, source.position), strict=True)) | dict(
        zip(REMANENCE_VECTOR, map(float, remanence), strict=True)) | {"name": name}
    size = list(map(float, source.dimension))
    if kind == "Cuboid":
        sizes = dict(zip(("size_x_m", "size_y_m", "size_z_m"), size, strict=True))
        return [common | _turned(turn) | sizes | {"shape": "cuboid"}]
    if kind == "Cylinder":
        return [common | _turned(turn) | {
            "shape": "cylinder", "radius_m": size[0] / 2, "size_z_m": size[1]}]
    inner, outer, height, *angles = size
    parts = halves_deg if angles[1] - angles[0] == 360.0 else (tuple(angles),)
    return [common | _turned(turn * Rotation.from_euler("z", (start + stop) / 2, degrees=True)) | (
        {"shape": "sector", "inner_radius_m": inner, "outer_radius_m": outer, "size_z_m": height,
         "angle_deg": stop - start, "name": name + ("ab"[number] if len(parts) > 1 else "")})
        for number, (start, stop) in enumerate(parts)]


def _turned(turn: Rotation) -> dict[str, float]:
    """Return the columns of a block's rotation."""
    return dict(zip(("rotation_x_deg", "rotation_y_deg", "rotation_z_deg"),
                    map(float, np.degrees(turn.as_rotvec())), strict=True))


@typed
def to_magpylib(magnet: Magnet) -> Any:
    """Return a magnet's blocks as a ``magpylib.Collection``.

    Its polarizations are the remanences: magpylib's own field has no permeability and no iron, nor
    what is beside the magnet. A warning names what of this magnet is left out.

    Parameters
    ----------
    magnet : Magnet

    Returns
    -------
    magpylib.Collection

    Raises
    ------
    StudyError
        If a block is a prism that is not convex, or not magnetized uniformly, or the magnet is a
        cross-section.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> len(hf.to_magpylib(magnet)) == len(magnet.blocks)
    True
    """
    magpylib = import_extra("magpylib")
    if magnet.dimension == 2:
        raise StudyError(must_be("magnet", "to_magpylib", "of finite length", "a cross-section"))
    table = FreeBlocks.model_validate(blocks_table(magnet))
    permeable = any(block.recoil_permeability != 1 or block.recoil_permeability_across != 1
                    for block in magnet.blocks)
    left_out = ["the permeability of the blocks"] * permeable + beside_blocks(magnet)
    if left_out:
        warnings.warn(f"Sources of magpylib leave out {', '.join(left_out)} of magnet "
                      f"{magnet.name}: their field is another one.", HalbachWarning, stacklevel=2)
    return magpylib.Collection([_source(magpylib, table, number) for number in range(len(table))],
                               style_label=magnet.name)


def _source(magpylib: Any, table: FreeBlocks, number: int) -> Any:
    """Return the source of magpylib that a row of a table of blocks describes."""
    if any(table.given(column)[number] and getattr(table, column)[number]
           for column in ("magnetization_gradient", "inner_corner_loss")):
        raise StudyError(must_be(f"block {table.name[number]}", "to_magpylib",
                                 "magnetized uniformly", "one that is not"))
    row = {column: getattr(table, column)[number] for column in COLUMNS
           if table.given(column)[number]}
    turn = Rotation.from_rotvec([row.get(f"rotation_{axis}_deg") or 0.0 for axis in "xyz"],
                                degrees=True)
    remanence = [row.get(column) or 0.0 for column in REMANENCE_VECTOR]
    common = {"polarization": turn.inv().apply(remanence), "orientation": turn,
              "position": [row[column] for column in ("x_m", "y_m", "z_m")],
              "style_label": row["name"]}
    shape, length = row["shape"], row["size_z_m"]
    if shape == "cuboid":
        return magpylib.magnet.Cuboid(
            dimension=(row["size_x_m"], row["size_y_m"], length), **common)
    if shape == "cylinder":
        return magpylib.magnet.Cylinder(dimension=(2 * row["radius_m"], length), **common)
    if shape == "sector":
        half = row["angle_deg"] / 2
        return magpylib.magnet.CylinderSegment(dimension=(
            row["inner_radius_m"], row["outer_radius_m"], length, -half, half), **common)
    corners = np.array([edge.start for edge in free_outline(table, number)])
    if len(ConvexHull(corners).vertices) != len(corners):
        raise StudyError(must_be(f"block {row['name']}", "to_magpylib", "a convex prism",
                                 "one that is not"))
    return magpylib.magnet.TriangularMesh.from_ConvexHull(
        points=at_heights(corners, -length / 2, length / 2), **common)


@typed
def new(path: str | Path, **values: object) -> Magnet:
    """Write a commented study file to start from, and return its magnet.

    Parameters
    ----------
    path : str or Path
    **values
        Those of the magnet that differ from the defaults: multipole_order, blocks_per_ring, rings,
        inner_radius_m, outer_radius_m, ring_length_m, remanence_T or material, shape, iron_ring,
        steel, cube_m with radius_m, dsv_m and so on, as the options of ``halbach-fe new`` are
        named.

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If a value has another name, or makes no magnet.
    OutputError
        If the file cannot be written.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.new("quadrupole.toml", multipole_order=2, inner_radius_m=0.02).name
    'quadrupole'
    """
    check_options(values, MagnetTemplate, "hf.new", "sigma_T", "position_sd_m")
    return write_template(as_path(path), template_of(values, "hf.new"))[0]


def template_of(
    values: Mapping[str, Any], where: str, named: Callable[[str], str] = str,
    refusal: type[HalbachError] = StudyError,
) -> MagnetTemplate:
    """Return the template of some values, with what follows from them.

    Raises
    ------
    StudyError
        Or ``refusal``, if a value would be without effect beside others. ``named`` says how the
        user calls it.
    """
    given = {name: value for name, value in values.items() if value is not None}
    edge, radius, follow = given.get("cube_m"), given.get("radius_m"), (
        "Rings that follow each other along z have a length.")
    long = bool(given.keys() & {"ring_length_m", "cube_m", "free_blocks"})
    for without, beside, why in (
            ("inner_radii_m" in given and "ring_length_m" not in given, "inner_radii_m", follow),
            (given.get("rings", 1) > 1 and not long, "rings", follow),
            ("dsv_m" in given and not long, "dsv_m", "A cross-section has no volume.")):
        if without:
            raise refusal(must_be(named("ring_length_m"), where, f"given with {named(beside)}",
                                  "nothing", why))
    if (edge is None) != (radius is None):
        raise refusal(must_be(named("radius_m"), where, f"given together with {named('cube_m')}",
                              "one of them", "Cubes have their middles at this radius."))
    of_table = given.keys() - {"free_blocks", "multipole_order", "iron_ring", "steel", "dsv_m"}
    for name, others, why in (
            ("free_blocks", of_table, "The table has it."),
            ("inner_radii_m", given.keys() & {"rings", "inner_radius_m"},
             "There is a ring of each radius."),
            ("material", given.keys() & {"remanence_T"}, "The grade has it."),
            ("cube_m", given.keys() & {"shape", "inner_radius_m", "outer_radius_m", "ring_length_m",
                                       "inner_radii_m"}, "The cube has it.")):
        if name in given and others:
            raise refusal(must_be(named(min(others)), where, f"left out with {named(name)}",
                                  "both", why))
    if edge is not None and radius is not None:
        if not edge < 2 * radius:
            raise refusal(must_be(
                named("cube_m"), where, f"less than twice {named('radius_m')}, {radius:g}, at "
                "which the cubes have their middles", f"{edge:g}", "Both are in metres."))
        given |= {"shape": "cuboid", "ring_length_m": edge,
                  "inner_radius_m": round(radius - edge / 2, 9),
                  "outer_radius_m": round(radius + edge / 2, 9)}
    if "steel" in given:
        given["iron_ring"] = True
    inner = max([*given.get("inner_radii_m", ()), given.get("inner_radius_m", 0.0)])
    if inner:
        given.setdefault("outer_radius_m", round(OUTER_RADIUS * inner, 6))
    return MagnetTemplate(**given)


def write_template(path: Path, template: MagnetTemplate) -> tuple[Magnet, MagnetTemplate]:
    """Write a new study file; return its magnet, and the template with the noise of its study."""
    magnet, template = new_magnet(template, path.stem, path.parent)
    if template.dsv_m is not None:  # refuses one that is not in air
        region_points(magnet, Region.sphere(template.dsv_m / 2, magnet.middle_m))
    write_new_study(path, template)
    return magnet, template
