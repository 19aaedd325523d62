"""Free blocks, of any shape, anywhere, at any angle: keys of a study, and their files.

Free blocks come from a table with one row per block: a CSV or HDF5 file with one column per key of
`FreeBlocks`. The study holds the table by column, so that it is complete without the file.

Error messages do not quote text of a file unless it resembles a column's name, because a study can
name any file on the machine.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import Field, ModelWrapValidatorHandler, ValidationError, model_validator

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.errors import OutputError, StudyError, must_be, not_utf8
from halbach_fe.core.files import workbook_in, workbook_sentence, write_text
from halbach_fe.core.numbers import (
    MAX_CELL,
    WITH_COMMAS,
    csv_text,
    in_a_row,
    numbered_lines,
    other_separator,
    parse_number,
)
from halbach_fe.core.untrusted_files import write_hdf5
from halbach_fe.study.materials import Material, columns_with_grades
from halbach_fe.study.types import (
    MAX_LENGTH_M,
    MIN_LENGTH_M,
    Angle,
    Coordinate,
    Length,
    Line,
    RecoilPermeability,
    Remanence,
    StudyModel,
    contradiction,
    crossing,
    did_you_mean,
    expected,
    received,
    wrong_unit,
)

Shape = Literal["cuboid", "sector", "trapezoid", "cylinder", "polygon", "prism"]

SIZES: dict[Shape, tuple[str, ...]] = {
    "cuboid": ("size_x_m", "size_y_m"),
    "sector": ("inner_radius_m", "outer_radius_m", "angle_deg"),
    "trapezoid": ("size_x_m", "inner_width_m", "outer_width_m"),
    "cylinder": ("radius_m",),
    "polygon": ("sides", "radius_m"),
    "prism": ("outline_m",),
}
"""Columns that give the size of each shape across its own z axis; ``size_z_m`` is along it."""

REMANENCE_VECTOR = ("remanence_x_T", "remanence_y_T", "remanence_z_T")
"""Components of the remanence along x, y and z of the magnet."""

NEEDED = ("name", "shape", "x_m", "y_m", "z_m")
NEEDED_BY_ALL = f"every block needs {in_a_row(NEEDED)}"

MAX_BLOCKS = 1_000_000

MAX_CORNERS = 100
MAX_PATH = 4000

LEVEL_M = 1e-6
"""Blocks whose heights differ by less than this, in m, form a ring."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$")]
Corner = tuple[Coordinate, Coordinate]
Signed = Annotated[float, Field(ge=-2.0, le=2.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=MAX_BLOCKS)]


class RowError(ValueError):
    """A block of the table is not consistent; ``number`` is that of its row, from 0."""

    def __init__(self, sentence: str, number: int) -> None:
        super().__init__(sentence)
        self.number = number


class FreeBlocks(StudyModel):
    """Blocks from a table, one row per block; ``file`` is a CSV or HDF5 file in the study's folder.

    When a study is read, the columns of the file replace its name. A column may be missing where no
    block needs it, and a cell may be empty (null) where its block does not.

    ``name`` names a block (letters, digits, ``-`` and ``_``) and is unique; ``type`` is the type of
    block. ``shape`` is one of

    * ``cuboid``: ``size_x_m``, ``size_y_m`` and ``size_z_m`` along its own axes;
    * ``sector``: ``inner_radius_m``, ``outer_radius_m`` and ``angle_deg`` about its own z axis, its
      middle on its own x axis;
    * ``trapezoid``: ``size_x_m`` along its own x axis, with flat parallel faces of
      ``inner_width_m`` (at negative x) and ``outer_width_m`` (at positive x) along y;
    * ``cylinder``, also a thin rod: ``radius_m`` about its own z axis;
    * ``polygon``: a regular polygon of ``sides`` corners at ``radius_m``, the first on its own x
      axis;
    * ``prism``: any polygon, with the corners ``outline_m`` in its own (x, y) plane.

    All are prisms, ``size_z_m`` long along their own z axis and centred at its origin. The origin
    lies at ``x_m``, ``y_m``, ``z_m`` in the magnet: the middle of a block, except for a sector (a
    point on the axis of its arcs) and a prism (where its corners are counted from). The rotation
    vector ``rotation_x_deg``, ``rotation_y_deg``, ``rotation_z_deg`` turns the magnet's axes into
    the block's own (default: no rotation).

    The strength is ``remanence_T`` along the block's own x axis, or the remanence vector
    ``remanence_x_T``, ``remanence_y_T``, ``remanence_z_T`` along the axes of the magnet.
    ``material`` names a grade of magnet, whose remanence is along the block's own x axis.
    ``recoil_permeability`` holds along the remanence, ``recoil_permeability_across`` perpendicular
    to it. ``magnetization_gradient`` and ``inner_corner_loss`` are those of
    `halbach_fe.study.array_keys.BlockException`, for shapes of four edges.

    ``ring`` and ``slot`` number the blocks for exceptions, priors and pictures. Without them,
    blocks of the same height z form a ring, and slots are counted by their angle about the z axis.
    """

    file: Annotated[Line, Field(min_length=1, max_length=MAX_PATH)] | None = None
    name: tuple[Name, ...] = ()
    type: tuple[Line | None, ...] = ()
    shape: tuple[Shape, ...] = ()
    ring: tuple[Count, ...] = ()
    slot: tuple[Count, ...] = ()
    x_m: tuple[Coordinate, ...] = ()
    y_m: tuple[Coordinate, ...] = ()
    z_m: tuple[Coordinate, ...] = ()
    rotation_x_deg: tuple[Angle | None, ...] = ()
    rotation_y_deg: tuple[Angle | None, ...] = ()
    rotation_z_deg: tuple[Angle | None, ...] = ()
    size_x_m: tuple[Length | None, ...] = ()
    size_y_m: tuple[Length | None, ...] = ()
    size_z_m: tuple[Length | None, ...] = ()
    inner_radius_m: tuple[Length | None, ...] = ()
    outer_radius_m: tuple[Length | None, ...] = ()
    angle_deg: tuple[Annotated[float, Field(gt=0.0, le=360.0)] | None, ...] = ()
    inner_width_m: tuple[Length | None, ...] = ()
    outer_width_m: tuple[Length | None, ...] = ()
    radius_m: tuple[Length | None, ...] = ()
    sides: tuple[Annotated[int, Field(ge=3, le=MAX_CORNERS)] | None, ...] = ()
    outline_m: tuple[Annotated[tuple[Corner, ...], Field(min_length=3, max_length=MAX_CORNERS)]
                     | None, ...] = ()
    material: tuple[Material | None, ...] = ()
    remanence_T: tuple[Remanence | None, ...] = ()
    remanence_x_T: tuple[Signed | None, ...] = ()
    remanence_y_T: tuple[Signed | None, ...] = ()
    remanence_z_T: tuple[Signed | None, ...] = ()
    recoil_permeability: tuple[RecoilPermeability | None, ...] = ()
    recoil_permeability_across: tuple[RecoilPermeability | None, ...] = ()
    magnetization_gradient: tuple[Annotated[float, Field(ge=-1.0, le=1.0)] | None, ...] = ()
    inner_corner_loss: tuple[Annotated[float, Field(ge=0.0, le=1.0)] | None, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _with_grades(cls, given: Any) -> Any:
        """Fill in what the grades say, and leave out columns without any value."""
        if not isinstance(given, dict):
            return given
        empty = [column for column, values in given.items() if isinstance(values, list | tuple)
                 and values and all(value is None for value in values)]
        if needed := [column for column in NEEDED if column in empty]:
            raise ValueError(f"column {needed[0]} has no value: give it, as {NEEDED_BY_ALL}")
        return columns_with_grades({
            column: values for column, values in given.items() if column not in empty and (
                not isinstance(values, list | tuple) or values)})

    @model_validator(mode="after")
    def _consistent(self) -> FreeBlocks:
        # Largest number of rings times slots, and the same per block of a large table: results by
        # ring and slot are stored for all places.
        max_places, max_places_per_block = 1_000_000, 100
        if self.file is not None:
            raise ValueError("the file has not been read; use read_study, which reads it")
        if not any(getattr(self, column) for column in COLUMNS):
            raise ValueError("there is no block; give a file, or columns")
        for column in COLUMNS:
            values = getattr(self, column)
            if column in NEEDED and not values:
                raise ValueError(f"there is no column {column}: add it, as {NEEDED_BY_ALL}")
            if len(values) != len(self) and values:
                raise ValueError(f"column {column} has {len(values)} rows, and there are "
                                 f"{len(self)} names of blocks")
        if bool(self.ring) != bool(self.slot):
            raise ValueError("give ring and slot together, or neither")
        _check_unique(self.name, "name")
        _check_unique(list(zip(self.ring, self.slot, strict=True)), "ring and slot")
        if self.ring and (places := max(self.ring) * max(self.slot)) > max(
                max_places, max_places_per_block * len(self)):
            raise ValueError(f"the numbers of ring and slot make {places} places, of which most "
                             "would be empty; count from 1")
        self._check_sizes()
        self._check_strengths()
        return self

    @model_validator(mode="wrap")
    @classmethod
    def _once(cls, given: Any, handler: ModelWrapValidatorHandler[FreeBlocks]) -> FreeBlocks:
        """Accept a validated table as it is: large ones take seconds, and studies change often."""
        return given if isinstance(given, cls) else handler(given)

    def with_(self, **changes: Any) -> Self:
        """Return a copy with other values; rows of another grade have what that says."""
        filled = columns_with_grades({"material": self.material}) if "material" in changes else {}
        for key in filled.keys() - changes.keys():
            own = getattr(self, key)
            if len(changes["material"] or ()) == len(own):  # else the table itself is refused
                changes[key] = tuple(
                    None if new and value == old else value for value, old, new in zip(
                        own, filled[key], changes["material"], strict=True))
        return super().with_(**changes)

    def _check_sizes(self) -> None:
        # Arcs of this angle or more are cut in two, so that their sector has more than four edges.
        half_turn_deg = 0.99 * 180.0
        shapes = np.array(self.shape)
        for column in dict.fromkeys(column for sizes in SIZES.values() for column in sizes):
            given = self.given(column)
            for shape, sizes in SIZES.items():
                self._refuse((shapes == shape) & (given != (column in sizes)), (
                    f"a {shape}, needs {column}" if column in sizes
                    else f"a {shape}, has no {column}; leave the cell empty" + (
                        ", and give a direction of the magnetization as a rotation"
                        if column == "angle_deg" else "")))
        self._refuse(np.hypot(self.numbers("x_m", 0.0), self.numbers("y_m", 0.0)) >= MAX_LENGTH_M,
                     f"is {MAX_LENGTH_M:g} m or more from the z axis; are x_m and y_m in mm? "
                     "Then write 0.01 for 10 mm")
        inner, outer = (self.numbers(f"{side}_radius_m", np.nan) for side in ("inner", "outer"))
        self._refuse(outer <= inner, "a sector, has an outer_radius_m that is not larger than its "
                     "inner_radius_m")
        corners = np.array([len(outline or ()) for outline in self.outline_m or [()] * len(self)])
        for count in set(corners.tolist()) - {0}:
            members = np.flatnonzero(corners == count)
            wrong = np.zeros(len(self), bool)
            wrong[members] = crossing(np.array([self.outline_m[n] for n in members]))
            self._refuse(wrong, "a prism, has an outline_m whose edges cross, or that has no "
                         "area, or goes round a part of it twice")
            sizes = np.ptp(np.array([self.outline_m[n] for n in members]), axis=1)
            wrong[members] = ((sizes < MIN_LENGTH_M) | (sizes >= MAX_LENGTH_M)).any(axis=1)
            self._refuse(wrong, f"a prism, has an outline_m that is not {MIN_LENGTH_M:g} m to "
                         f"{MAX_LENGTH_M:g} m wide; is it in mm? Then write 0.01 for 10 mm")
        has_four = (np.isin(shapes, ("cuboid", "trapezoid")) | (corners == 4)
                    | (self.numbers("sides", 0) == 4)
                    | (self.numbers("angle_deg", 360.0) < half_turn_deg))
        for column in ("magnetization_gradient", "inner_corner_loss"):
            self._refuse((self.numbers(column, 0.0) != 0) & ~has_four, "which has not four edges, "
                         f"has no {column}; leave the cell empty")

    def _check_strengths(self) -> None:
        components = np.sum([self.given(column) for column in REMANENCE_VECTOR], axis=0)
        self._refuse(self.given("remanence_T") == (components > 0),
                     f"needs either remanence_T or {', '.join(REMANENCE_VECTOR)}")
        self._refuse((components > 0) & (components < len(REMANENCE_VECTOR)),
                     f"needs all of {', '.join(REMANENCE_VECTOR)}")

    def given(self, column: str) -> Bools:
        """Tell which blocks have a value in a column, (n,)."""
        values = getattr(self, column) or (None,) * len(self)
        return np.array([value is not None for value in values])

    def _refuse(self, wrong: Bools, reason: str) -> None:
        """Raise RowError for the first block that is wrong, with the reason why."""
        if wrong.any():
            number = int(np.argmax(wrong))
            comma = "," if reason.startswith(("a ", "which ")) else ""
            raise RowError(f"block {self.name[number]} in row {number + 1}{comma} {reason}", number)

    def __len__(self) -> int:
        return len(self.name)

    def value(self, column: str, number: int) -> float | int | str | tuple[Corner, ...] | None:
        """Return the value of a column for a block (from 0), None where it has none."""
        values: Sequence[float | None] = getattr(self, column)
        return values[number] if values else None

    def numbers(self, column: str, default: float) -> Floats:
        """Return a column as an array (n,), with a default value for empty cells."""
        values = getattr(self, column)
        if not values:
            return np.full(len(self), default)
        return np.array([default if value is None else value for value in values], float)

    @property
    def origins_m(self) -> Floats:
        """Origins of the blocks' own axes in the magnet, (n, 3) in m."""
        return np.column_stack([self.x_m, self.y_m, self.z_m])

    @property
    def rotations_rad(self) -> Floats:
        """Rotation vectors of the blocks, (n, 3) in rad."""
        return np.radians(np.column_stack([
            self.numbers(f"rotation_{axis}_deg", 0.0) for axis in "xyz"]))

    @cached_property
    def places(self) -> tuple[tuple[int, int], ...]:
        """Ring and slot of every block, counted from 1 within the free blocks."""
        if self.ring:
            return tuple(zip(self.ring, self.slot, strict=True))
        level = np.round(np.array(self.z_m) / LEVEL_M).astype(int)
        heights, ring = np.unique(level, return_inverse=True)
        if 2 * len(heights) > len(self):  # hardly two blocks at one height: no rings
            ring = np.zeros(len(self), int)
        angle = np.arctan2(self.y_m, self.x_m) % (2 * np.pi)
        angle[angle > 2 * np.pi - 1e-9] = 0.0
        slot = np.empty(len(self), int)
        order = np.lexsort((np.hypot(self.x_m, self.y_m), np.round(angle, 9), ring))
        starts = np.searchsorted(ring[order], np.arange(ring.max() + 1))
        slot[order] = np.arange(len(self)) - starts[ring[order]]
        return tuple(zip((ring + 1).tolist(), (slot + 1).tolist(), strict=True))

    @cached_property
    def blocks_by_ring(self) -> tuple[int, ...]:
        """Largest slot of every ring of free blocks."""
        sizes = np.zeros(max(ring for ring, _ in self.places), int)
        np.maximum.at(sizes, np.array(self.places)[:, 0] - 1, np.array(self.places)[:, 1])
        return tuple(sizes.tolist())

    @property
    def radii_m(self) -> tuple[float, float]:
        """Rough inner and outer radius in m of the space about the z axis that the blocks fill."""
        half = [self.numbers(column, 0.0) / 2
                for column in ("size_x_m", "size_y_m", "inner_width_m", "outer_width_m")]
        corners = np.array([max((math.hypot(*corner) for corner in outline or ()), default=0.0)
                            for outline in self.outline_m or [()] * len(self)])
        reach = np.max([*half, self.numbers("radius_m", 0.0), corners], axis=0)
        radius = self.numbers("outer_radius_m", 0.0)  # of sectors
        centre = np.hypot(self.x_m, self.y_m)
        inner = np.where(radius > 0, self.numbers("inner_radius_m", 0.0) - centre,
                         centre - reach).min()
        outer = (centre + np.maximum(reach, radius)).max()
        inner = float(np.clip(inner, MIN_LENGTH_M, MAX_LENGTH_M / 2))
        return inner, float(np.clip(outer, 1.01 * inner, 0.999 * MAX_LENGTH_M))


COLUMNS = tuple(name for name in FreeBlocks.model_fields if name != "file")
"""All columns of a table of free blocks."""


def _check_unique(values: Sequence[Hashable], name: str) -> None:
    """Raise RowError if a value occurs twice."""
    if len(set(values)) == len(values):
        return
    seen: set[Hashable] = set()
    for number, value in enumerate(values):
        if value in seen:
            raise RowError(f"{name} must be unique to a block, but {value} occurs twice", number)
        seen.add(value)


Cell = float | int | str | tuple[tuple[float, ...], ...] | None

TEXTS = ("name", "type", "shape", "material")
WHOLE = ("ring", "slot", "sides")
HDF5 = (".h5", ".hdf5", ".nc")
"""Suffixes of HDF5 files; any other suffix is read as CSV."""

MAX_BYTES = 500_000_000
"""Size of the largest file that is read: `MAX_BLOCKS` rows of all columns in full."""

NUMERIC, OUTLINE = frozenset("0123456789+-.eE"), frozenset("0123456789+-.eE ;")
"""Of these characters, `float` accepts the same as `parse_number`, but for infinity."""


@dataclass(frozen=True)
class _Content:
    """Cells of a file by column; ``rows`` name the rows in messages, by number from 0."""

    cells: dict[str, list[Any]]
    rows: Callable[[int], str]


def read_free_blocks(path: str | Path) -> dict[str, list[Cell]]:
    """Read the columns of a table of free blocks; None stands for empty cells.

    ``path``: a CSV file with a header of names from `halbach_fe.study.free_blocks.COLUMNS` in any
    order, in UTF-8; lines that begin with ``#`` are comments. Or an HDF5 file (suffix .h5, .hdf5 or
    .nc) with a dataset (n,) per column; NaN and empty text stand for empty cells. A cell of
    ``outline_m`` lists corners: ``0 0; 0.01 0; 0 0.02``.

    Raises
    ------
    StudyError
        If the file cannot be read, or a cell holds something else than its column says. The message
        names the file and the line.

    Examples
    --------
    >>> write_free_blocks({
    ...     "name": ["rod"], "shape": ["cylinder"], "x_m": [0.1], "y_m": [0.0], "z_m": [0.0],
    ...     "radius_m": [0.005], "remanence_T": [1.3]}, "rods.csv")
    >>> read_free_blocks("rods.csv")["radius_m"]
    [0.005]
    """
    where = f"table of free blocks {path}"
    return _read(Path(path), where).cells


def free_blocks_of_file(path: Path, where: str = "") -> FreeBlocks:
    """Read and validate a table of free blocks; ``where`` is added to its name in messages.

    Raises
    ------
    StudyError
        As of `read_free_blocks`, or if a block is not possible.
    """
    where = f"table of free blocks {path}{where}"
    content = _read(path, where)
    return _validated(content.cells, where, content.rows)


def write_free_blocks(blocks: FreeBlocks | Mapping[str, Sequence[Any]], path: str | Path) -> None:
    """Write a table that `read_free_blocks` reads to the last bit; the suffix gives its format.

    The file is written atomically: it is either complete, or not there.

    Parameters
    ----------
    blocks : FreeBlocks or mapping of sequence
        The table, or its columns by name. Columns without any value are left out.
    path : str or Path
        A file whose suffix is .csv, .h5, .hdf5 or .nc.

    Raises
    ------
    OutputError
        If the suffix is another one, or the file cannot be written.
    StudyError
        If the columns do not make a table of free blocks.
    """
    path = Path(path)
    where = f"table of free blocks {path}"
    if path.suffix not in (".csv", *HDF5):
        raise OutputError(must_be("suffix", where, f".csv, {', '.join(HDF5)}",
                                  f"'{path.suffix}'"))
    table = validated_blocks(blocks, where)
    columns: dict[str, Sequence[Any]] = {
        column: getattr(table, column) for column in COLUMNS if table.given(column).any()}
    if "outline_m" in columns:
        columns["outline_m"] = [_outline_text(outline) for outline in columns["outline_m"]]
    if path.suffix in HDF5:
        write_hdf5(xr.Dataset({column: ("block", _array(column, values))
                               for column, values in columns.items()}), path)
    else:
        write_text(path, csv_text({column: ["" if value is None else str(value)
                                            for value in values]
                                   for column, values in columns.items()}))


def validated_blocks(columns: FreeBlocks | Mapping[str, Sequence[Any]], where: str) -> FreeBlocks:
    """Return columns, by name, as a table of free blocks; raise StudyError if they are none."""
    return _validated(columns, where, lambda number: f"row {number + 1}")


def _validated(given: object, where: str, rows: Callable[[int], str]) -> FreeBlocks:
    try:
        return FreeBlocks.model_validate(given)
    except ValidationError as error:
        raise StudyError(_sentence(error, rows, where)) from None


def _array(column: str, values: Sequence[Any]) -> NDArray[Any]:
    if column in TEXTS or column == "outline_m":
        return np.array([value or "" for value in values], object)
    if None in values:
        return np.array([np.nan if value is None else value for value in values])
    return np.array(values)


def _read(path: Path, where: str) -> _Content:
    try:
        if not path.is_file() and path.exists() and not path.is_dir():
            raise StudyError(must_be("path", where, "a file", "a device"))  # it might never end
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise StudyError(must_be("size", where, f"at most {MAX_BYTES:.2g} bytes", size))
        content = _hdf5(path, where) if path.suffix in HDF5 else _csv(path.read_bytes(), where)
    except OSError as error:
        raise StudyError(must_be("path", where, "a readable file",
                                 f"'{error.strerror or 'no HDF5 file'}'",
                                 "Give its path from the study's folder.")) from None
    for column, cells in content.cells.items():
        content.cells[column] = _parsed(column, cells, content.rows, where)
    return content


def _csv(raw: bytes, where: str) -> _Content:
    """Return the cells of a CSV file as text, "" where they are empty."""
    if workbook_in(raw) is not None:
        raise StudyError(workbook_sentence(where, raw))
    try:
        text = raw.decode("utf-8-sig")  # spreadsheets write a byte order mark
    except UnicodeDecodeError as error:
        raise StudyError(not_utf8(where, error)) from None
    lines = numbered_lines(text)
    _check_count(len(lines) - 1, where)
    if (separator := other_separator(lines[0][1])) is not None:
        raise StudyError(must_be("header", where, "names that commas separate",
                                 f"names that {separator} separate", WITH_COMMAS))
    numbers = [number for number, _ in lines[1:]]
    rows: list[list[str]] = []
    reader = csv.reader((line for _, line in lines), strict=True)
    try:
        for row in reader:
            rows.append(row)
            if reader.line_num != len(rows):  # a cell that goes on in the next line
                raise csv.Error
    except csv.Error:
        raise StudyError(must_be(f"line {lines[min(len(rows), len(lines) - 1)][0]}", where,
                                 "comma-separated values", "an open quotation mark, or too long a "
                                 "cell")) from None
    header = [name.strip() for name in rows.pop(0)]
    _check_columns(header, where)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != len(header):
            raise StudyError(must_be(f"line {number}", where, f"of {len(header)} cells, as the "
                                     "header", f"{len(row)} cells"))
    cells = {name: [cell.strip() for cell in column]
             for name, column in zip(header, zip(*rows, strict=True), strict=True)}
    return _Content(cells, lambda number: f"line {numbers[number]}")


def _hdf5(path: Path, where: str) -> _Content:
    """Return the cells of an HDF5 file, numbers or text, "" or NaN where they are empty."""
    try:
        data = untrusted_files.read_dataset(path)
    except ValueError as error:
        raise StudyError(must_be("content", where, "an HDF5 file of numbers and text",
                                 f"'{error}'")) from None
    _check_columns([str(name) for name in data.variables], where)
    cells, count = {}, next(iter(data.sizes.values()), 0)
    for name, variable in data.variables.items():
        if variable.shape != (count,) or variable.dtype.kind not in "biufOSUT":
            raise StudyError(must_be(f"`{name}`", where, f"{count} numbers or texts",
                                     f"an array {variable.shape} of {variable.dtype}"))
        cells[str(name)] = variable.values.tolist()
    _check_count(count, where)
    return _Content(cells, lambda number: f"row {number + 1}")


def _check_columns(header: Sequence[str], where: str) -> None:
    """Refuse unknown and repeated columns, and tables of something else."""
    if "serial" in header and "mx_A_m2" in header:
        raise StudyError(must_be(
            "header", where, "that of where blocks are", "a table of measured moments",
            "Give it to halbach-fe prior, infer or sort, beside the study of the magnet; "
            "halbach-fe export STUDY --format blocks writes a table of where its blocks are."))
    for number, name in enumerate(header, start=1):
        if name in COLUMNS:
            if header.index(name) < number - 1:
                raise StudyError(must_be("header", where, "without repeated columns", f"'{name}'"))
            continue
        begun = [column for column in COLUMNS if name and column.startswith(f"{name}_")]
        near = did_you_mean(name, begun[:1], 0.0) or did_you_mean(name, COLUMNS, 0.6)
        raise StudyError(must_be(
            f"column {number}", where, "a known column", f"'{name}'" if near else "another name",
            near or f"Known columns: {', '.join(COLUMNS)}."))


def _check_count(count: int, where: str) -> None:
    if not 1 <= count <= MAX_BLOCKS:
        raise StudyError(must_be("content", where, f"a header, and 1 to {MAX_BLOCKS} blocks",
                                 max(0, count)))


def _parsed(column: str, cells: list[Any], rows: Callable[[int], str], where: str) -> list[Cell]:
    """Return the values of a column, None where a cell is empty or NaN (not equal to itself)."""
    kind: Callable[[object], Cell] = _text
    expected = "printable text"
    quick: list[Cell] | None = None
    if column == "outline_m":
        kind, expected = outline_of, "corners as `x y; x y; x y`"
    elif column in WHOLE:
        kind, expected = _whole, "a whole number"
    elif column not in TEXTS:
        quick, kind, expected = _numbers(cells), _number, "a finite number"
    elif isinstance(cells[0], str) and "".join(cells).isprintable():
        quick = [cell or None for cell in cells]
    if quick is not None:
        return quick
    found: list[Cell] = []
    for number, cell in enumerate(cells):
        try:
            found.append(None if cell in ("", b"") or cell != cell else kind(cell))
        except ValueError:
            raise StudyError(must_be(f"`{column}` in {rows(number)}", where, expected,
                                     "something else")) from None
    return found


def _numbers(cells: list[Any]) -> list[Cell] | None:
    """Return numbers if all cells are plain ones or empty, else None: ten times faster."""
    try:
        if not isinstance(cells[0], str):
            return None if np.isinf(cells).any() else [
                None if cell != cell else float(cell) for cell in cells]
        if not (NUMERIC.issuperset("".join(cells)) and max(map(len, cells)) <= MAX_CELL):
            return None
        values: list[Cell] = [float(cell) if cell else None for cell in cells]
    except (TypeError, ValueError):
        return None
    return values if np.isfinite([value or 0.0 for value in values]).all() else None


def _number(cell: object) -> float:
    if isinstance(cell, str):
        return parse_number(cell)
    if not isinstance(cell, int | float) or not np.isfinite(cell):
        raise ValueError
    return float(cell)


def _whole(cell: object) -> int:
    value = _number(cell)
    if value != int(value):
        raise ValueError
    return int(value)


def _text(cell: object) -> str:
    text = cell.decode() if isinstance(cell, bytes) else cell
    if not isinstance(text, str) or not text.isprintable():
        raise ValueError
    return text


def outline_of(cell: object) -> tuple[tuple[float, ...], ...]:
    """Return the corners in m that a text lists, `x y; x y; x y`; else raise ValueError."""
    text = _text(cell)
    number = float if OUTLINE.issuperset(text) else parse_number
    corners = tuple(tuple(map(number, corner.split())) for corner in text.split(";"))
    if any(len(corner) != 2 for corner in corners):
        raise ValueError
    return corners


def _outline_text(outline: Iterable[Iterable[float]] | None) -> str | None:
    if outline is None:
        return None
    return "; ".join(" ".join(repr(float(value)) for value in corner) for corner in outline)


def _sentence(error: ValidationError, rows: Callable[[int], str], where: str) -> str:
    """Return one sentence about the first of pydantic's errors."""
    first = error.errors(include_url=False)[0]
    given, ours = first.get("input"), contradiction(first)
    cause = first.get("ctx", {}).get("error")
    column, place = ([*first["loc"], None, None])[:2]
    what = "content" if column is None else f"`{column}`"
    if isinstance(cause, RowError):
        what = rows(cause.number)
    elif isinstance(place, int):
        what += f" in {rows(place)}"
    if ours is not None:
        return f"Input {what} of {where} must be consistent: {ours}."
    if given is None:
        return must_be(what, where, "given", "nothing")
    if not isinstance(given, int | float):
        return must_be(what, where, expected(first), received(given))
    return must_be(what, where, expected(first), f"{given:g}",
                   wrong_unit(str(column), given, first.get("ctx", {})))
