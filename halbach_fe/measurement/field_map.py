"""Field maps: measured or computed B at labelled points, and the files that hold them.

A map is an `xarray.Dataset` with

* ``B_T`` (point, component): flux density in T, NaN where a component was not measured;
* coordinates ``x_m``, ``y_m``, ``z_m`` (point) in m and ``component`` = x, y, z;
* optionally ``sigma_T`` (point, component), ``time_s`` (point) and ``scan`` (point);
* optionally ``Babs_T`` (point), |B| in T as a probe without a direction reads it, and its noise
  ``sigma_Babs_T`` (point). A map of |B| alone has no other reading; beside components,
  |B| tests them;
* attributes: provenance, as free text by key. `DIRECTION` = `UNDIRECTED` marks a map of a single
  component of which nobody has said which it is. It stands where Bz does, and only `register`,
  which tries all three, reads it.

HDF5 and CSV files hold all of these and read back equal. VTU files, for ParaView, hold all but
scans and attributes.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import meshio
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats, plain
from halbach_fe.core.errors import (
    HalbachError,
    HalbachWarning,
    MeasurementError,
    OutputError,
    must_be,
)
from halbach_fe.core.files import as_path, atomic, file_bytes
from halbach_fe.core.interface import typed
from halbach_fe.core.numbers import decimals
from halbach_fe.core.result_folder import single_file
from halbach_fe.core.untrusted_files import hdf5_bytes
from halbach_fe.measurement.text_tables import (
    _check_printable,
    check_columns,
    csv_table,
    finite,
    look_like_clock,
    write_csv,
)
from halbach_fe.study.types import COMPONENTS, MAX_LENGTH_M, MAX_SIGMA_T, MIN_SIGMA_T, look_like_mm

POSITION_COLUMNS = ("x_m", "y_m", "z_m")
FIELD_COLUMNS = ("Bx_T", "By_T", "Bz_T")
SIGMA_COLUMNS = ("sigma_Bx_T", "sigma_By_T", "sigma_Bz_T")
TOTAL_COLUMN, TOTAL_SIGMA_COLUMN = "Babs_T", "sigma_Babs_T"
TOTAL_COLUMNS = (TOTAL_COLUMN, TOTAL_SIGMA_COLUMN)
OTHER_COLUMNS = ("sigma_T", "time_s", "scan")
UNDIRECTED_COLUMN = "B_T"
"""Column of a component of which nobody has said which it is."""

DIRECTION, UNDIRECTED = "direction", "unknown"
"""Attribute of such a map, and its value."""

FOREIGN = ("A table with other columns, other separators or no header is converted by `halbach-fe "
           "import-map`, whose options say what its columns are; `infer` takes them too.")
"""Advice for a map that is not in halbach-fe's own columns."""
MAX_FIELD_T = 10.0
"""Largest flux density in T that is accepted. No permanent magnet reaches it; a larger value is
probably in mT or G."""

PLACEHOLDERS = 0.1
"""Share of rows below which values too large may be those of single rows, as 9999 that stands for
none, and no matter of the unit."""

COPIES = 0.1
"""Share of rows from which rows that are alike in all numbers are copies, and no chance."""


@typed
def field_map(
    points_m: ArrayLike, B_T: ArrayLike, sigma_T: ArrayLike | None = None,
    attributes: Mapping[str, str] | None = None, components: Sequence[str] = COMPONENTS,
) -> xr.Dataset:
    """Return readings as a map, which all functions take that read one from a file.

    Parameters
    ----------
    points_m : array_like, shape (n, 3)
    B_T : array_like, shape (n, components)
        Readings, of one component (n,) too; NaN where there is none.
    sigma_T : array_like, optional
        Standard deviation of the noise: one number, one for each reading (n,) or each component,
        or of the shape of ``B_T``.
    attributes : dict of str to str, optional
    components : sequence of str
        Which components the columns of ``B_T`` are: ``x`` or ``Bx``, ...

    Returns
    -------
    Dataset

    Raises
    ------
    MeasurementError
        If the shapes do not fit.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> data = hf.field_map([[0, 0, 0], [0, 0, 0.01]], [[1e-3, 0.4], [0, 0.39]], 5e-5,
    ...                     components=["x", "y"])
    >>> data["B_T"].sel(component="y").values
    array([0.4 , 0.39])
    """
    components = [re.sub(r"^[bB]_?([xyz])(_T)?$", r"\1", str(name)) for name in components]
    try:
        points, given = plain(points_m), plain(B_T, components)
    except (TypeError, ValueError, OverflowError) as error:
        raise MeasurementError(must_be("points_m and B_T", "field_map", "arrays of numbers",
                                       f"what is none: {error}")) from None
    rows: list[list[Any]] = [np.asarray(index).tolist() for index in (
        getattr(each, "index", None) for each in (points_m, B_T, sigma_T))
        if index is not None and hasattr(index, "equals") and np.ndim(index) == 1]  # of pandas
    if any(rows[0] != each and set(rows[0]) == set(each) for each in rows[1:]):
        raise MeasurementError(must_be(
            "points_m, B_T and sigma_T", "field_map", "rows in the same order, as those of one "
            "table are", "tables with the same index in another order",
            "Bring them into one order, or give arrays: points.to_numpy()."))
    if given.ndim == len(components) == 1:
        given = given[:, None]
    columns = [COMPONENTS.index(name) for name in components if name in COMPONENTS]
    count = points.shape[0] if points.ndim else 0
    if points.shape != (count, 3) or given.shape != (count, len(components)) or (
            len(set(columns)) != len(components)):
        raise MeasurementError(must_be(
            "points_m and B_T", "field_map", f"of shapes (n, 3) and (n, {len(components)}), for "
            f"components out of {', '.join(COMPONENTS)}",
            f"{points.shape} and {given.shape}, for "
            + ", ".join(components),
            "State which components are given, as in components=['x', 'y']; readings of |B| come "
            "from a file with a column Babs_T."))

    def of_all(values: ArrayLike) -> Floats:
        """Return values of the components that are given (n, 3), NaN of the others."""
        found = np.full(points.shape, np.nan)
        found[:, columns] = values
        return found

    data = xr.Dataset(
        {"B_T": (("point", "component"), of_all(given))},
        coords={"component": list(COMPONENTS)} | {
            name: ("point", points[:, i], {"units": "m"})
            for i, name in enumerate(POSITION_COLUMNS)},
        attrs=dict(attributes or {}))
    data["B_T"].attrs["units"] = "T"
    if sigma_T is not None:
        try:
            sigma = plain(sigma_T, components)
        except (TypeError, ValueError, OverflowError) as error:
            raise MeasurementError(must_be("sigma_T", "field_map", "numbers in T",
                                           f"what is none: {error}")) from None
        if sigma.shape == (len(points),) == (len(components),) and np.ptp(sigma) > 0:
            raise MeasurementError(must_be(
                "sigma_T", "field_map", f"of shape {given.shape}, as there are as many readings as "
                "components", f"{sigma.shape}, of either",
                "Give sigma_T[None, :] for each component, sigma_T[:, None] for each reading."))
        if sigma.shape == (len(points),):
            sigma = sigma[:, None]
        elif sigma.shape not in ((), (len(components),), (1, len(components)), (len(points), 1),
                                 given.shape):
            raise MeasurementError(must_be(
                "sigma_T", "field_map", f"one number, or of shape ({len(points)},) or "
                f"{given.shape}", str(sigma.shape)))
        sigma = np.broadcast_to(sigma, given.shape)
        if (wrong := np.isfinite(given) & ~(np.isfinite(sigma) & (sigma > 0))).any():
            raise MeasurementError(must_be("sigma_T", "field_map", "positive numbers in T",
                                           f"{sigma[wrong][0]:g}", "Leave it out if it is not "
                                           "known: the study's [[noise.regions]] then hold."))
        data["sigma_T"] = (("point", "component"), of_all(sigma), {"units": "T"})
    return data


Function = TypeVar("Function", bound=Callable[..., Any])


def taking_arrays(function: Function) -> Function:
    """Decorate a function of a magnet and a map, which then takes arrays for the map too: positions
    (n, 3) in m, readings (n, 3) in T, ``sigma_T`` and ``components``, as `field_map` does.

    Of arrays no page says that a result is not to be used, so that a HalbachWarning does; error
    bars that are too wide mislead nobody.
    """
    @wraps(function)
    def of_map_or_arrays(*arguments: Any, **options: Any) -> Any:
        match arguments:
            case magnet, points_m, B_T, *others if not isinstance(
                    points_m, xr.Dataset | Mapping) and _is_array(B_T):  # no session
                data = field_map(points_m, B_T, options.pop("sigma_T", None),
                                 components=options.pop("components", COMPONENTS))
                _refuse_exchanged(magnet, data)
                result = function(magnet, data, *others, **options)
                said = getattr(result, "disagreement", "")
                if said and said != result.too_near:
                    warnings.warn(said, HalbachWarning, stacklevel=2)
                return result
        return function(*arguments, **options)

    return cast(Function, of_map_or_arrays)


def _is_array(value: object) -> bool:
    """Return whether an argument is an array of readings, and no session."""
    try:
        return not isinstance(value, xr.Dataset) and bool(np.ndim(cast(ArrayLike, value)))
    except ValueError:  # lists of different length
        return True


def _refuse_exchanged(magnet: Any, data: xr.Dataset) -> None:
    """Refuse positions and readings that are each other's: at the readings, taken as positions, the
    magnet's field is what was given as positions. Asked only where the field has a closed form.
    """
    near = 0.3  # part of what is given; fields of magnets that are built are closer to nominal ones
    points, values = points_of(data), data["B_T"].values
    if not getattr(magnet, "is_vacuum", False) or not np.isfinite(values).all():
        return

    def off(places: Floats, given: Floats) -> float:
        try:
            return float(np.linalg.norm(magnet.field_T(places) - given) / np.linalg.norm(given))
        except HalbachError:  # not in air
            return np.inf

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exchanged = points.any() and off(values, points) < near and not off(points, values) < near
    if exchanged:
        raise MeasurementError(must_be(
            "points_m and B_T", "the map", "given in this order",
            "positions that are the field of the magnet at the readings", "Exchange them."))


def undirected(data: xr.Dataset) -> xr.Dataset:
    """Return a map of Bz as one of a component of which nobody has said which it is."""
    return data.assign_attrs({DIRECTION: UNDIRECTED})


def is_undirected(data: xr.Dataset) -> bool:
    """Tell whether a map does not say which component it holds."""
    return data.attrs.get(DIRECTION) == UNDIRECTED


def directed(data: xr.Dataset, component: str) -> xr.Dataset:
    """Return a map of an unknown component as one of Bx, By or Bz, of ``x``, ``y`` or ``z``."""
    found = data.copy(deep=True)
    del found.attrs[DIRECTION]
    column = COMPONENTS.index(component)
    for name in ("B_T", "sigma_T"):
        if name in data:
            found[name][:] = np.nan
            found[name][:, column] = data[name].values[:, COMPONENTS.index("z")]
    return found


def refuse_undirected(data: xr.Dataset) -> None:
    """Raise MeasurementError for a map that does not say which component it holds."""
    if is_undirected(data):
        raise MeasurementError(must_be(
            f"column {UNDIRECTED_COLUMN}", f"map {data.encoding.get('source', '')}".rstrip(),
            f"named {', '.join(FIELD_COLUMNS[:2])} or {FIELD_COLUMNS[2]}",
            "a component of which nobody has said which it is", "If you do not know it either, "
            "halbach-fe register of this map alone tries all three and writes the map of the one "
            "that it finds."))


def total_field_map(
    points: Floats, magnitude: Floats, sigma: Floats | None = None,
    attributes: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Return a map of |B| (n,) in T alone at points (n, 3) in m, and its noise sigma (n,) in T."""
    data = field_map(points, np.full(points.shape, np.nan), attributes=attributes)
    return with_total_field(data, magnitude, sigma)


def with_total_field(
    data: xr.Dataset, magnitude: Floats, sigma: Floats | None = None
) -> xr.Dataset:
    """Return a map with |B| (n,) in T, and its noise sigma (n,) in T, beside what it has."""
    columns = {TOTAL_COLUMN: magnitude} | ({} if sigma is None else {TOTAL_SIGMA_COLUMN: sigma})
    return data.assign({name: ("point", plain(values), {"units": "T"})
                        for name, values in columns.items()})


def is_total_field(data: xr.Dataset) -> bool:
    """Tell whether a map holds |B| alone, without any component."""
    return TOTAL_COLUMN in data and bool(np.isnan(data["B_T"].values).all())


def refuse_total_field(data: xr.Dataset, what: str) -> None:
    """Raise a MeasurementError if a map holds |B| alone, for what needs components of B."""
    if is_total_field(data):
        raise MeasurementError(must_be(
            f"map {data.encoding.get('source', '')}".rstrip(), what,
            "of components Bx, By or Bz", f"a map of |B| alone ({TOTAL_COLUMN})",
            "`infer`, `register`, `diagnose` and `homogeneity` take such a map, and `check` "
            "tests its readings."))


def readings_sha256(data: xr.Dataset) -> str:
    """Return the SHA-256 of the points and readings of a map, in whatever format it is stored.

    Two maps have the same value if they have the same numbers in the same order.
    """
    values = np.column_stack([points_of(data), np.asarray(data["B_T"].values, dtype=float)])
    if is_total_field(data):
        values = np.column_stack([values, np.asarray(data[TOTAL_COLUMN].values, dtype=float)])
    values[np.isnan(values)] = np.nan  # NaN and zero have several binary forms
    return hashlib.sha256(np.ascontiguousarray(values + 0.0).astype("<f8").tobytes()).hexdigest()


def has_times(data: xr.Dataset) -> bool:
    """Tell whether a map says when its readings were taken; the same time of all says nothing."""
    return "time_s" in data and bool(np.ptp(data["time_s"].values) > 0)


def points_of(data: xr.Dataset) -> Floats:
    """Return the positions (n, 3) in m of a map."""
    return np.column_stack([data[name].values for name in POSITION_COLUMNS])


@typed
def write_map(data: xr.Dataset, path: str | Path) -> None:
    """Write a map in the format of the suffix: .h5, .csv or .vtu.

    The file is written atomically: it is either complete, or not there. A file that this function
    has not written as it is now is not replaced.

    Parameters
    ----------
    data : Dataset
    path : str or Path

    Returns
    -------
    None

    Raises
    ------
    MeasurementError
        If the map is not labelled as `read_map` does.
    OutputError
        If the suffix is unknown, or the file cannot be written or would be lost.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.write_map(hf.field_map([[0, 0, 0]], [[0.4, 0, 0]]), "point.csv")
    >>> hf.read_map("point.csv").sizes["point"]
    1
    """
    path = as_path(path)
    with single_file(path, "hf.write_map"):
        save_map(data, path)


def save_map(data: xr.Dataset, path: Path) -> None:
    """Write a map as `write_map` does, whatever was in the file before."""
    writers: dict[str, Callable[[xr.Dataset, Path], object]] = {
        ".h5": lambda d, p: p.write_bytes(hdf5_bytes(d)), ".csv": _write_csv, ".vtu": _write_vtu}
    if path.suffix not in writers:
        raise OutputError(must_be("suffix", f"field map {path}", ".h5, .csv or .vtu",
                                  f"'{path.suffix}'"))
    data = labelled_map(data, "map")
    with atomic(path) as temporary:
        writers[path.suffix](data, temporary)


@typed
def read_map(path: str | Path) -> xr.Dataset:
    """Read and validate a map from CSV, HDF5 (.h5, .hdf5, .nc) or VTU.

    In CSV, comments ``# key: value`` are attributes. The header names, in any order, the columns
    x_m, y_m, z_m, at least one of Bx_T, By_T, Bz_T or Babs_T (|B|), and optionally sigma_T (or
    sigma_Bx_T ...), time_s and scan. An empty field, or nan, is a component that was not measured;
    of rows without any a warning says how many are left out.

    Parameters
    ----------
    path : str or Path
        The suffix of the file states its format; any other suffix is read as CSV.

    Returns
    -------
    Dataset
        ``B_T`` (point, component) in T, NaN where a component was not measured, with the
        coordinates ``x_m``, ``y_m``, ``z_m`` (point) in m; and ``Babs_T``, ``sigma_Babs_T``,
        ``sigma_T``, ``time_s`` and ``scan`` if the file has them.

    Raises
    ------
    MeasurementError
        If the file cannot be read as a map. The message names the file and the line, and says how
        to correct it.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.read_map("map.csv")["B_T"].dims
    ('point', 'component')
    """
    path = as_path(path)
    raw = file_bytes(path, f"map {path}")
    if path.suffix in (".h5", ".hdf5", ".nc"):
        data = _read_hdf5(path)
    else:
        data = _read_vtu(raw, path) if path.suffix == ".vtu" else _read_csv(raw, path)
    data = checked_readings(data, path)
    data.encoding["source"] = str(path)
    return data


def _write_csv(data: xr.Dataset, path: Path) -> None:
    columns: dict[str, NDArray[np.generic]] = {name: data[name].values
                                               for name in POSITION_COLUMNS}
    if is_undirected(data):
        columns[UNDIRECTED_COLUMN] = data["B_T"].values[:, COMPONENTS.index("z")]
    elif not is_total_field(data):
        columns |= {name: data["B_T"].values[:, i] for i, name in enumerate(FIELD_COLUMNS)}
    columns |= {name: data[name].values for name in TOTAL_COLUMNS if name in data}
    if "sigma_T" in data and is_undirected(data):
        columns["sigma_T"] = data["sigma_T"].values[:, COMPONENTS.index("z")]
    elif "sigma_T" in data:
        columns |= {name: data["sigma_T"].values[:, i] for i, name in enumerate(SIGMA_COLUMNS)}
    columns |= {name: data[name].values for name in ("time_s", "scan") if name in data}
    write_csv(columns, data.attrs, path)


def warn_of_left_out(data: xr.Dataset, kept: Sequence[str], path: Path) -> None:
    """Warn of columns of a map for which the format of a file, known by its end, has no place."""
    if left := [name for name in (*TOTAL_COLUMNS, *OTHER_COLUMNS) if name in data
                and name not in kept]:
        warnings.warn(f"Left out, as a file {path.suffix} has no place for it: {', '.join(left)}. "
                      "Files .csv and .h5 of halbach-fe keep everything.", HalbachWarning,
                      stacklevel=4)


def _write_vtu(data: xr.Dataset, path: Path) -> None:
    refuse_undirected(data)  # the format has no attributes
    points = points_of(data)
    cells = [("vertex", np.arange(len(points))[:, None])]
    kept = ("B_T", *TOTAL_COLUMNS, "sigma_T", "time_s")
    values = {name: data[name].values for name in kept if name in data}
    warn_of_left_out(data, kept, path)
    meshio.write(path, meshio.Mesh(points, cells, point_data=values), file_format="vtu")


def _read_hdf5(path: Path) -> xr.Dataset:
    where = f"map {path}"
    try:
        data = untrusted_files.read_dataset(path)
    except (OSError, ValueError) as error:
        raise MeasurementError(must_be("content", where, "a whole HDF5 file",
                                       f"'{error}'")) from None
    if "B_T" not in data.variables and "study" in data.attrs:
        raise MeasurementError(must_be(
            "path", where, "a file of measurements", "a posterior of halbach-fe infer",
            "Give the map that was measured; a verb with --posterior takes this file there."))
    return labelled_map(data, where)


def checked_map(data: object, name: str) -> xr.Dataset:
    """Return a map that a user made or changed, after the checks that a file of it undergoes.

    Parameters
    ----------
    data : object
        It should be a Dataset, see `read_map`.
    name : str
        Name of the map in error messages, unless it was read from a file.

    Raises
    ------
    MeasurementError
        If it is none, or holds what no map does.
    """
    if not isinstance(data, xr.Dataset):
        raise MeasurementError(must_be(
            "data", f"map {name}", "a Dataset", f"a {type(data).__name__}",
            "Read the file by read_map, and the maps that a study lists by read_maps."))
    name = str(data.encoding.get("source", name))
    return checked_readings(labelled_map(data, f"map {name}"), name)


def labelled_map(data: xr.Dataset, where: str) -> xr.Dataset:
    """Return a map, with sigma_T by point and component; MeasurementError if labels are wrong."""
    for name in ("B_T", *POSITION_COLUMNS):
        if name not in data.variables:
            raise MeasurementError(must_be("variable", where, f"`{name}`", "none of that name"))
    labels = np.ravel(data["component"].values).tolist() if "component" in data.coords else []
    if data["B_T"].dims != ("point", "component") or labels != list(COMPONENTS):
        raise MeasurementError(must_be(
            "`B_T`", where, "labelled (point, component = x, y, z)",
            f"dimensions {data['B_T'].dims}, components {', '.join(map(str, labels)) or 'unnamed'}",
            "In Python, data.transpose('point', 'component').reindex(component=['x', 'y', 'z']) "
            "arranges components x, y and z, or those that there are; choose one by a list, as in "
            "data.sel(component=['x'])."))
    if "sigma_T" in data and data["sigma_T"].dims in ((), ("point",), ("component",)):
        data = data.assign(sigma_T=data["sigma_T"].broadcast_like(data["B_T"]).transpose(
            "point", "component"))
    _check_names(data, where)
    by_point: tuple[str, ...] = ("point",)
    expected = dict.fromkeys((*POSITION_COLUMNS, *TOTAL_COLUMNS, "time_s", "scan"), by_point)
    expected |= {"B_T": ("point", "component"), "sigma_T": ("point", "component")}
    for name, dims in expected.items():
        if name not in data.variables:
            continue
        numeric = name == "scan" or np.issubdtype(data[name].dtype, np.floating) or (
            np.issubdtype(data[name].dtype, np.integer))
        if name == "scan" and data[name].dtype.kind in "OST":
            data = data.assign(scan=data[name].astype(str))
        if data[name].dims != dims or not numeric:
            raise MeasurementError(must_be(f"`{name}`", where, f"numbers labelled {dims}",
                                           f"{data[name].dtype} labelled {data[name].dims}"))
    return data


def _check_names(data: xr.Dataset, where: str) -> None:
    """Raise MeasurementError for units other than m, T and s, and for noise by another name."""
    units = {"time_s": "s", **dict.fromkeys(POSITION_COLUMNS, "m"),
             **dict.fromkeys(("B_T", "sigma_T", *TOTAL_COLUMNS), "T")}
    for name, unit in units.items():
        stated = str(data[name].attrs.get("units", unit)) if name in data.variables else unit
        if stated != unit:
            raise MeasurementError(must_be(f"unit of `{name}`", where, unit, f"'{stated[:40]}'",
                                           "Convert the numbers, and the attribute `units`."))
    for name in map(str, data.variables):
        if name not in units and name.lower().startswith(("sigma", "std", "err", "noise")):
            raise MeasurementError(must_be("noise of the readings", where, "called `sigma_T`",
                                           f"`{name[:40]}`", "Rename or remove it."))


def _read_vtu(raw: bytes, path: Path) -> xr.Dataset:
    where = f"map {path}"
    try:
        with tempfile.NamedTemporaryFile(suffix=".vtu") as copy:  # meshio opens files by their name
            copy.write(raw)
            copy.flush()
            mesh = untrusted_files.read_mesh(Path(copy.name))
        data = field_map(mesh.points, mesh.point_data["B_T"], mesh.point_data.get("sigma_T"))
        _check_names(xr.Dataset(dict.fromkeys(mesh.point_data, 0.0)), where)
        for name in (*TOTAL_COLUMNS, "time_s"):
            if name in mesh.point_data:
                data[name] = ("point", mesh.point_data[name])
    except MeasurementError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise MeasurementError(must_be(
            "content", where, "a VTU file with point data `B_T` (n, 3)", f"'{error}'",
            "Files of other programs are converted by `halbach-fe import-map`.")) from None
    return data


def _read_csv(raw: bytes, path: Path) -> xr.Dataset:
    where = f"map {path}"
    attributes, header, rows = csv_table(raw, where, FOREIGN)
    if not {*POSITION_COLUMNS, *FIELD_COLUMNS, UNDIRECTED_COLUMN, TOTAL_COLUMN} & set(header):
        raise MeasurementError(must_be(
            "header", where, f"complete with {', '.join(POSITION_COLUMNS)}, and at least one of "
            f"{', '.join((*FIELD_COLUMNS, TOTAL_COLUMN))}", ",".join(header), FOREIGN))
    _check_header(header, where)
    table: dict[str, list[float]] = {name: [] for name in header}
    scans: list[str] = []
    for number, cells in rows:
        for name, cell in zip(header, cells, strict=True):
            if name == "scan":
                scans.append(cell)
            else:
                table[name].append(_number(cell, name, number, where))
    points = np.column_stack([table[name] for name in POSITION_COLUMNS])
    empty = np.full(len(points), np.nan)
    if UNDIRECTED_COLUMN in table:
        table["Bz_T"] = table[UNDIRECTED_COLUMN]
    data = field_map(points, np.column_stack([table.get(n, empty) for n in FIELD_COLUMNS]),
                     attributes=attributes)
    if UNDIRECTED_COLUMN in table:
        data = undirected(data)
    elif is_undirected(data):  # a comment does not undo what the header says
        del data.attrs[DIRECTION]
    if "sigma_T" in table:
        data["sigma_T"] = (("point", "component"), np.repeat([table["sigma_T"]], 3, 0).T)
    elif any(name in table for name in SIGMA_COLUMNS):
        data["sigma_T"] = (("point", "component"),
                           np.column_stack([table.get(n, empty) for n in SIGMA_COLUMNS]))
    if TOTAL_COLUMN in table:
        data = _with_total(data, table)
    if "time_s" in table:
        data["time_s"] = ("point", table["time_s"])
    if scans:
        data["scan"] = ("point", scans)
    return data


def _with_total(data: xr.Dataset, table: Mapping[str, list[float]]) -> xr.Dataset:
    """Return a map with |B| of a table; without components, its noise is what sigma_T says."""
    data = with_total_field(data, np.array(table[TOTAL_COLUMN]))
    sigma = table.get(TOTAL_SIGMA_COLUMN, table.get("sigma_T"))
    if sigma is not None:
        data = with_total_field(data, np.array(table[TOTAL_COLUMN]), np.array(sigma))
    return data.drop_vars("sigma_T", errors="ignore") if is_total_field(data) else data


def _check_header(header: list[str], where: str) -> None:
    check_columns(header, (*POSITION_COLUMNS, *FIELD_COLUMNS, *SIGMA_COLUMNS, *TOTAL_COLUMNS,
                           *OTHER_COLUMNS, UNDIRECTED_COLUMN), where)
    missing = [name for name in POSITION_COLUMNS if name not in header]
    if UNDIRECTED_COLUMN in header and set(header) & {*FIELD_COLUMNS, *SIGMA_COLUMNS,
                                                      *TOTAL_COLUMNS}:
        raise MeasurementError(must_be(
            "header", where, f"with {UNDIRECTED_COLUMN}, a component that is not known, or with "
            f"{', '.join((*FIELD_COLUMNS, TOTAL_COLUMN))}, not both", ",".join(header)))
    if missing or not any(name in header for name in (
            *FIELD_COLUMNS, UNDIRECTED_COLUMN, TOTAL_COLUMN)):
        expected = missing[0] if missing else "at least one of Bx_T, By_T, Bz_T, Babs_T"
        raise MeasurementError(must_be("header", where, f"complete with {expected}",
                                       ",".join(header)))
    if "sigma_T" in header and any(name in header for name in (
            *SIGMA_COLUMNS, TOTAL_SIGMA_COLUMN)):
        raise MeasurementError(must_be("header", where, "with sigma_T or sigma_Bx_T ..., not both",
                                       ",".join(header)))
    if TOTAL_SIGMA_COLUMN in header and TOTAL_COLUMN not in header:
        raise MeasurementError(must_be(
            "header", where, f"with {TOTAL_COLUMN} beside {TOTAL_SIGMA_COLUMN}", ",".join(header)))


def _number(cell: str, name: str, number: int, where: str) -> float:
    may_be_empty = name in (*FIELD_COLUMNS, *SIGMA_COLUMNS, *TOTAL_COLUMNS)
    if may_be_empty and cell.lower() in ("", "nan"):
        return np.nan
    return finite(cell, f"{name} in line {number}", where,
                  "Write seconds, or call the column time and convert the file by halbach-fe "
                  "import-map." if name == "time_s" else "Leave a missing component empty."
                  if may_be_empty else "Correct it, or remove the row.")


def checked_readings(data: xr.Dataset, path: Path | str) -> xr.Dataset:
    """Return a map without its rows that hold no reading, of which it warns; raise
    MeasurementError for the first invalid point or value.
    """
    where = f"map {path}"
    if not data.sizes["point"]:
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    points, values = points_of(data), data["B_T"].values
    if np.isinf(values).any() or not np.isfinite(points).all():
        row = int(np.argmax(np.isinf(values).any(axis=1) | ~np.isfinite(points).all(axis=1)))
        raise MeasurementError(must_be(f"reading {row + 1}", where, "finite numbers",
                                       "an infinite or missing value"))
    blank = np.isnan(values).all(axis=1)
    if TOTAL_COLUMN in data:
        blank = _without_total(data, blank, where)
    if blank.all():
        raise MeasurementError(must_be("content", where, "at least one reading",
                                       f"{len(blank)} rows without a number of the field"))
    if blank.any():
        warnings.warn(without_reading(blank, where), HalbachWarning, stacklevel=3)
        data, values = data.isel(point=~blank), values[~blank]
        points = points[~blank]
    if "sigma_T" in data:
        sigma = data["sigma_T"].values[~np.isnan(values)]
        if not (sigma > 0).all() or not np.isfinite(sigma).all():
            raise _no_noise("sigma", where, data["sigma_T"].values, ~np.isnan(values))
    if "time_s" in data and not np.isfinite(data["time_s"].values).all():
        raise MeasurementError(must_be("`time_s`", where, "finite numbers",
                                       "an infinite or missing value"))
    if "time_s" in data and look_like_clock(data["time_s"].values.astype(float)):
        first, last = data["time_s"].values[[0, -1]]
        raise MeasurementError(must_be(
            "`time_s`", where, "clearly in s", f"{first:.0f} to {last:.0f}, which may as well be "
            "times of day, HHMMSS", "Write seconds; if they are, subtract the first of them."))
    if "scan" in data:
        _check_printable(map(str, np.unique(data["scan"].values)), "scan", where)
    _check_duplicates(data, points, where)
    return data


def without_reading(blank: NDArray[np.bool_], where: str) -> str:
    """Say how many rows of a map, those of ``blank`` (n,), are left out as nothing was read."""
    return (f"Left out: {int(blank.sum())} of {len(blank)} rows of {where}, in which nothing was "
            f"read; the first is row {int(np.argmax(blank)) + 1}. Rows are counted without them.")


def _no_noise(name: str, where: str, sigma: Floats, read: NDArray[np.bool_]) -> MeasurementError:
    """Return the error of noise (n, ...) that is none, by the first such reading of ``read``."""
    wrong = (read & ~(np.isfinite(sigma) & (sigma > 0))).reshape(len(sigma), -1)
    row, column = np.argwhere(wrong)[0]
    return MeasurementError(must_be(
        f"{name} of reading {row + 1}", where, "positive",
        f"{sigma.reshape(len(sigma), -1)[row, column]:g}", "Correct it, or remove the columns of "
        "sigma: the study's [[noise.regions]] then hold."))


def _without_total(
    data: xr.Dataset, blank: NDArray[np.bool_], where: str
) -> NDArray[np.bool_]:
    """Return which rows of a map hold nothing, |B| included; ``blank`` (n,) are those without any
    component.

    MeasurementError if |B| is negative or infinite, its noise is not positive, or some rows hold
    components and others |B| alone.
    """
    total = data[TOTAL_COLUMN].values
    wrong = np.isinf(total) | (total < 0)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise MeasurementError(must_be(
            f"{TOTAL_COLUMN} of reading {row + 1}", where, "a magnitude, never negative",
            f"{total[row]:g}", "If the column is a component, name it Bx_T, By_T or Bz_T."))
    if TOTAL_SIGMA_COLUMN in data:
        sigma = data[TOTAL_SIGMA_COLUMN].values[~np.isnan(total)]
        if not (sigma > 0).all() or not np.isfinite(sigma).all():
            raise _no_noise(TOTAL_SIGMA_COLUMN, where, data[TOTAL_SIGMA_COLUMN].values,
                            ~np.isnan(total))
    if blank.all() and "sigma_T" in data:
        raise MeasurementError(must_be(
            "`sigma_T`", where, f"named {TOTAL_SIGMA_COLUMN} in a map of |B| alone", "sigma_T"))
    if not blank.all() and (blank & ~np.isnan(total)).any():
        row = int(np.argmax(blank & ~np.isnan(total)))
        raise MeasurementError(must_be(
            f"reading {row + 1}", where, "with a component of B, as other rows of it have",
            f"{TOTAL_COLUMN} alone", "Put the rows of |B| into a map of their own; a study can "
            "list both."))
    return blank & np.isnan(total)


def _check_length(data: xr.Dataset, where: str) -> None:
    """Raise MeasurementError if a map's |B| is, where it is strong, not the length of its
    components: one of both is in another unit, or is not what its name says.
    """
    # Part by which |B| may differ from the length of the components beside it where they are
    # strong: gains of two probes differ by a few per cent, units by factors of 10.
    length_off = 0.1
    times, _ = _total_beside_length(data)
    if abs(times - 1) > length_off:
        raise MeasurementError(must_be(
            TOTAL_COLUMN, where, "the length of Bx, By, Bz, in their unit",
            f"{decimals(times)} times as much", f"Correct the unit or the columns, or remove "
            f"{TOTAL_COLUMN}: beside components it only tests them."))


def is_placeholder(value: float) -> bool:
    """Tell whether a number consists of nines, as those that stand for no reading."""
    return re.fullmatch(r"9{3,}(\.9*)?", f"{abs(value):.12g}") is not None


def _total_beside_length(data: xr.Dataset) -> tuple[float, float]:
    """Return the median factor of a map's |B| from the length of its components, in the half of
    the rows where they are strong, and the standard error of that; 1 and 0 if no row has both.
    """
    length, total = np.linalg.norm(data["B_T"].values, axis=1), data[TOTAL_COLUMN].values
    known = np.isfinite(length) & np.isfinite(total) & (length > 0)
    if not known.any():
        return 1.0, 0.0
    strong = known & (length >= np.median(length[known]))
    factors = total[strong] / length[strong]
    times = float(np.median(factors))
    mad_to_sd, median_to_mean = 1.4826, np.sqrt(np.pi / 2)  # of normal numbers
    spread = mad_to_sd * float(np.median(np.abs(factors - times)))
    return times, float(median_to_mean * spread / np.sqrt(len(factors)))


def total_contradiction(data: xr.Dataset) -> str:
    """Say that a map's column of |B| is throughout not the length of its components, or nothing.

    `check_magnitudes` refuses maps in which it is far off.
    """
    if TOTAL_COLUMN not in data or is_total_field(data):
        return ""
    # Part from which it is said: the gains of probes are known to a few per mille, or calibrated
    # to less. Standard errors from which it is no noise.
    of_gains, errors = 5e-3, 5.0
    times, error = _total_beside_length(data)
    if abs(times - 1) <= max(of_gains, errors * error):
        return ""
    return (f"{TOTAL_COLUMN} is throughout {abs(100 * (times - 1)):.1f} % "
            f"{'larger' if times > 1 else 'smaller'} than the length of Bx, By, Bz: one of both "
            "probes has another gain. The components alone are used; if their gain is the wrong "
            "one, so is the strength of all blocks.")


def check_magnitudes(data: xr.Dataset) -> None:
    """Raise MeasurementError if a map's values are too large to be in m and T, or sigmas absurd.

    The study, not the map, states the units of the file; see `in_si_and_magnet_axes` in
    `halbach_fe.measurement.probe_law`.
    """
    where = f"map {data.encoding['source']}" if "source" in data.encoding else "map"
    farthest = float(np.abs(points_of(data)).max())
    if farthest > 10 * MAX_LENGTH_M:
        raise MeasurementError(must_be(
            "positions", where, f"within {10 * MAX_LENGTH_M:g} m", f"{farthest:g}",
            "Are they in millimetres? Then set instrument.length_unit_m = 0.001 in the study, or "
            "name the columns x_mm, y_mm, z_mm and convert the map by halbach-fe import-map."))
    values, sigmas = data["B_T"].values, data.get("sigma_T")
    if is_total_field(data):
        values, sigmas = data[TOTAL_COLUMN].values, data.get(TOTAL_SIGMA_COLUMN)
    by_component = np.nan_to_num(np.abs(values)).max(axis=0).reshape(-1)
    largest = float(by_component.max())
    by_row = np.nan_to_num(np.abs(values)).reshape(len(values), -1).max(axis=1)
    beyond, row = np.flatnonzero(by_row > MAX_FIELD_T), int(np.argmax(by_row)) + 1
    if len(beyond):
        known = (("gauss", "G", "0.0001"), ("millitesla", "mT", "0.001"))[:1 + (largest <= 2000)]
        unit, short, factor = (" or ".join(each) for each in zip(*known[::-1], strict=True))
        columns = " or ".join(f"Bx_{one}, By_{one}, Bz_{one}" for one in short.split(" or "))
        wrong = by_component > MAX_FIELD_T
        some = "" if (wrong | (by_component == 0)).all() else " and ".join(
            column for column, too_large in zip(FIELD_COLUMNS, wrong, strict=True) if too_large)
        units = (
            f"in {unit}? Then set instrument.flux_density_unit_T = {factor} in the "
            f"study, or name the columns {columns} and convert the map by halbach-fe import-map.")
        if is_placeholder(largest):
            raise MeasurementError(must_be(
                f"reading {row}", where, f"below {MAX_FIELD_T:g} T",
                f"{largest:g}, which looks like a placeholder, one of {len(beyond)} of "
                f"{len(values)} rows that are not",
                "Where nothing was read, leave the cell empty, or remove the row."))
        if len(beyond) < PLACEHOLDERS * len(values):
            raise MeasurementError(must_be(
                f"reading {row}", where, f"below {MAX_FIELD_T:g} T, as most are",
                f"{largest:g}, one of {len(beyond)} of {len(values)} rows that are not",
                "If the meter had no reading there, leave the cell empty, or remove the row. Or is "
                f"all of the map {units}"))
        raise MeasurementError(must_be(
            some or "flux densities", where, f"below {MAX_FIELD_T:g} T", f"{largest:g}",
            f"Are they {units}" + (
                f" If only {some} is in {unit}, multiply this column of the file by {factor}."
                if some else "")))
    if TOTAL_COLUMN in data:
        _check_length(data, where)
    if sigmas is not None:
        sigma = sigmas.values[~np.isnan(values)]
        for extreme in (sigma.max(), sigma.min()):
            if not MIN_SIGMA_T <= extreme <= MAX_SIGMA_T:
                raise MeasurementError(must_be(
                    "sigma", where, f"from {MIN_SIGMA_T:g} to {MAX_SIGMA_T:g} T", f"{extreme:g}",
                    "Correct it, or instrument.flux_density_unit_T of the study."))


TO_METRES = ("Then name the columns of the map, as CSV, x_mm, y_mm, z_mm and convert it by "
             "halbach-fe import-map")
"""What to do with a map of halbach-fe's own, whose header says m, if its points are in mm."""


def doubt_of_metres(data: xr.Dataset, unit: str = "") -> str:
    """Return a sentence if the points of a map lie where few magnets have a field, else nothing.

    ``unit`` is that which the file states.
    """
    points = points_of(data)
    if not look_like_mm(points).any():
        return ""
    distance = float(np.linalg.norm(points, axis=1).max())
    return (f"The points lie up to {distance:.3g} m from the origin, where few magnets of "
            "permanent blocks have a field. " + (
                f"Is {unit}, the unit that the file states, right?" if unit else
                "Are they in mm?"))


def warn_of_millimetres(data: xr.Dataset) -> None:
    """Warn, where no study tells how large the magnet is, of points that are rather in mm."""
    if doubt := doubt_of_metres(data):
        warnings.warn(f"{doubt} {TO_METRES}.", HalbachWarning, stacklevel=2)


def _check_duplicates(data: xr.Dataset, points: Floats, where: str) -> None:
    """Raise MeasurementError if rows are copies of others: of the same place, time and readings.

    A place that is read again, as the middle at the end of a scan, is none: its readings differ by
    their noise, but for a few that rounding makes alike.
    """
    keys = [points, np.nan_to_num(data["B_T"].values)]
    for name in ("time_s", *TOTAL_COLUMNS):
        if name in data:
            keys.append(np.nan_to_num(data[name].values)[:, None])
    if "scan" in data:
        keys.append(np.unique(data["scan"].values, return_inverse=True)[1][:, None].astype(float))
    _, first = np.unique(np.hstack(keys), axis=0, return_index=True)
    copies = np.setdiff1d(np.arange(len(points)), first)
    if not len(copies):
        return
    x, y, z = points[copies[0]]
    said = must_be(
        f"reading {copies[0] + 1}", where, "no copy of another row", f"({x:g}, {y:g}, {z:g}) m "
        f"with the same readings again, as {len(copies)} of {len(points)} rows are",
        "Remove them: what is read again differs by its noise.")
    if len(copies) > COPIES * len(points):
        raise MeasurementError(said)
    # without times, few digits make some readings of a place alike
    finest_T = 1e-8  # no probe of magnets reads finer steps twice
    read = np.nan_to_num(data[TOTAL_COLUMN if is_total_field(data) else "B_T"].values[copies])
    if "time_s" in data or (np.abs(read / finest_T - np.rint(read / finest_T)) > 1e-3).any():
        warnings.warn(f"{said} Until then these count twice.", HalbachWarning, stacklevel=2)
