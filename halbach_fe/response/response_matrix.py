"""The response matrix H, which maps block magnetizations p in A/m to readings q in T.

The model is ``q = offset + H p``, where the offset holds the readings of external fields. If the
iron is non-linear, H is the derivative at the nominal magnetization, and the model holds near it.

Each column of H has the readings of a single block that is magnetized by 1 A/m along one axis. Its
field is the exact field in vacuum plus the finite-element reaction of the magnet, or, with the
method ``direct``, the finite-element field alone. An additional solve of all nominal blocks at once
is compared with the sum of the columns.
"""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import ColumnsError, HalbachWarning, OutputError
from halbach_fe.core.files import atomic
from halbach_fe.core.installation import code_digest, version
from halbach_fe.core.untrusted_files import read_hdf5, with_checksum, write_hdf5
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.response.block_variation import (
    Variations,
    amplitude_names,
    field_changes,
    neighbour_columns,
    shared_deviations,
)
from halbach_fe.response.discretization_error import discretization_changes, error_bars
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.routes import (
    SUPERPOSITION_TOLERANCE,
    ElementFields,
    check_points,
    finite_element_part,
    runs_serve_other_points,
    vacuum_part,
)
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Rows
from halbach_fe.stats.posteriors import row_slices
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import FIELD_KEYS

LOADED_BYTES = 2**30
"""Size in bytes above which a matrix stays on the disk and is read in parts."""


@dataclass(frozen=True)
class StoredMatrix:
    """A matrix in a .npy file, of which only the rows in use are in memory."""

    path: Path
    shape: tuple[int, int]
    """Numbers of rows and columns."""
    sha256: str
    """SHA-256 of the file as it was written."""

    @classmethod
    def of(cls, parts: Iterable[Floats], shape: tuple[int, int], path: Path) -> StoredMatrix:
        """Write a matrix whose rows arrive in parts (k, m)."""
        digest = hashlib.sha256()
        with atomic(path) as temporary, temporary.open("wb") as file:
            for content in chain([_npy_header(shape)], (
                    np.ascontiguousarray(part, "<f8").tobytes() for part in parts)):
                digest.update(content)
                file.write(content)
        return cls(path, shape, digest.hexdigest())

    @classmethod
    def at(cls, path: Path, shape: tuple[int, int], sha256: str) -> StoredMatrix:
        """Return the matrix in a file that was written before, after reading it once.

        Raises
        ------
        ValueError
            If the file is damaged, or holds a matrix of another shape.
        """
        header = _npy_header(shape)
        with path.open("rb") as file:
            if file.read(len(header)) != header or (
                    path.stat().st_size != len(header) + 8 * shape[0] * shape[1]):
                raise ValueError(f"{path.name} is not a matrix {shape}")
            file.seek(0)
            if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                raise ValueError(f"the content of {path.name} differs from its checksum")
        return cls(path, shape, sha256)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Rows) -> Floats:
        try:  # a new memory map for each access, so that pages already read are released
            return np.array(np.memmap(self.path, "<f8", "r", len(_npy_header(self.shape)),
                                      self.shape)[rows])
        except OSError as error:
            raise OutputError(f"Cannot read {self.path} again: {error.strerror}. Give every study "
                              "an output folder of its own.") from None

    def __matmul__(self, vector: Floats) -> Floats:
        return np.concatenate([self[part] @ vector for part in row_slices(*self.shape)])


def _npy_header(shape: tuple[int, int]) -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {
        "descr": "<f8", "fortran_order": False, "shape": shape})
    return header.getvalue()


@dataclass(frozen=True)
class Response:
    """The linear model ``q = offset + H p`` from magnetizations p to readings q."""

    matrix: Floats | StoredMatrix
    """The response matrix H. Shape (readings, parameters), in T m/A."""
    parameters: tuple[str, ...]
    """Names of the parameters; ``r01s05.Mx`` is M_x of ring 1, slot 5."""
    nominal: Floats
    """The study's nominal magnetization. Shape (parameters,), in A/m."""
    offset: Floats
    """Readings of external fields, and with non-linear iron also the constant term of the
    linearization. Shape (readings,), in T."""
    error: Floats
    """Error bar of the finite elements, for the nominal array; see
    `halbach_fe.response.discretization_error.reading_errors`. Shape (readings,), in T."""
    superposition_error: float
    """Relative difference between the sum of the blocks' finite-element parts and that of the whole
    array, see `superposition_error`."""
    of_similar: bool = False
    """Whether the finite-element part of the columns is that of a similar magnet, see
    `response_matrix`."""
    reused: bool = False
    """Whether the response was read from the file of an earlier run with the same inputs."""
    shared_error: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """The changes of all readings together that `error` is made of, with their signs; see
    `halbach_fe.response.discretization_error.discretization_changes`. Shape (k, readings), in T."""
    of_neighbours: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """The readings of what the magnetizations of neighbours' blocks deviate, see
    `halbach_fe.response.block_variation.neighbour_prior`. Shape (readings, parameters of these), in
    T m/A."""

    @property
    def whole(self) -> Floats:
        """The whole matrix H in memory, even if it is stored in a file because of its size."""
        return self.matrix[np.arange(len(self.matrix))]


def response_matrix(
    magnet: Magnet, observation: Observation, session: Session, similar: Magnet | None = None
) -> Response:
    """Build H, or read it from the session's folder if it was built for the same inputs.

    ``similar``: a magnet whose shapes or materials differ slightly, and which was solved for before
    with the session's cache. What its permeability and iron add to the field of single blocks,
    which takes most of the time, serves this magnet too if it adds up to the nominal array to 5e-4.
    The nominal array and the field in vacuum are computed in any case.

    Raises
    ------
    StudyError
        If a point of the observation is not in air.
    PointsOutsideError
        If a point lies outside the meshed region.
    GetDPError
        If GetDP fails; a ColumnsError if the columns do not add up to the field of the whole array.
    """
    observation = replace(observation, points=check_points(magnet, observation.points))
    key = _key(magnet, observation, session, similar)
    path = session.folder / "response.h5"
    built = _read(path, key)
    if built is not None:
        return built
    changes = np.zeros((0, len(observation)))
    if magnet.study.uncertain_of_magnet:
        changes = observation.apply(field_changes(magnet, observation.points, session))
    if similar is not None and _serves(similar, magnet, observation.points, session):
        built = _similar_response(
            magnet, similar, observation, session, _beside(path, key), changes)
    if built is None:
        parts = finite_element_part(magnet, observation.points, session)
        error = discretization_changes(magnet, observation.points, parts, session)
        built = _assemble(magnet, observation, parts, error, _beside(path, key), changes)
        check_superposition(built.superposition_error, parts.superposition_tolerance)
    built = replace(built, of_neighbours=observation.apply(np.moveaxis(
        neighbour_columns(magnet, observation.points, session), 2, 0)).T)
    _write(path, key, built)
    return built


def _serves(similar: Magnet, magnet: Magnet, points: Floats, session: Session) -> bool:
    """Tell whether the cache has what a similar magnet's blocks add to the field at any points.

    See `halbach_fe.solver.routes.runs_serve_other_points`.
    """
    alike = [[(block.ring, block.slot, block.angle_deg) for block in each.blocks]
             for each in (similar, magnet)]
    return (session.cache is not None and session.counter is None and not magnet.is_vacuum
            and alike[0] == alike[1]
            and all(runs_serve_other_points(each, points) for each in (similar, magnet)))


def _similar_response(
    magnet: Magnet, similar: Magnet, observation: Observation, session: Session, path: Path,
    changes: Floats
) -> Response | None:
    """Return the response with columns of a similar magnet, None if they do not suffice.

    ``path`` and ``changes`` are those of `_assemble`.
    """
    own = session.within("similar")
    parts = finite_element_part(similar, observation.points, own)
    error = discretization_changes(similar, observation.points, parts, own)
    nominal = finite_element_part(magnet, observation.points, session, columns=False).nominal
    built = _assemble(magnet, observation, replace(
        parts, nominal=nominal, along_nominal=parts.along_nominal + nominal - parts.nominal,
        sources=magnet.blocks, for_deviations=True), error, path, changes)
    # tolerance of the check that columns of a similar magnet add up to the nominal array. Readings
    # of blocks that deviate by 1 % are then wrong by 2e-6 of the largest reading: measured 1.3e-7
    # at a difference of 3.6e-5, by another inner radius in an iron tube.
    similar_tolerance = 5e-4
    return replace(built, of_similar=True) if (
        built.superposition_error <= similar_tolerance) else None


def _assemble(
    magnet: Magnet, observation: Observation, parts: ElementFields, error: Floats, path: Path,
    changes: Floats
) -> Response:
    """Return the response from its finite-element part.

    ``error`` (k, n, 3) in T are the changes of the field by other discretizations. A large matrix
    is stored at ``path``. ``changes`` (amplitudes, readings) in T are those of uncertain
    amplitudes.
    """
    blocks, dimension = magnet.blocks, magnet.dimension
    total, magnitude = np.zeros(len(observation)), np.zeros(len(observation))

    variations = Variations.of(magnet)
    names = magnet.parameter_names + (variations.names if variations else ())
    names += amplitude_names(magnet)
    shared = shared_deviations(magnet) if len(changes) else np.zeros((0, 0))
    shape = len(observation), len(names)

    def rows() -> Iterator[Floats]:
        for part in row_slices(*shape, len(observation)):
            matrix, total[part], magnitude[part] = _rows(magnet, observation, parts, part)
            columns = [matrix]
            if variations is not None:
                columns.append(variations.readings(observation, part))
            if len(changes):
                columns.append(changes[:, part].T - matrix @ shared)
            yield matrix if len(columns) == 1 else np.hstack(columns)

    matrix = _whole(rows(), shape) if 8 * np.prod(shape) <= LOADED_BYTES else StoredMatrix.of(
        rows(), shape, path)
    nominal = np.zeros(shape[1])
    nominal[:dimension * len(blocks)] = magnet.nominal_magnetization
    direct = observation.apply(parts.along_nominal)
    # if columns follow from symmetry but the mesh is not quite symmetric, they add up to slightly
    # less or more than the field of the nominal array
    unequal = total - direct
    offset = observation.apply(external_field(magnet, observation.points))
    # share of the difference between the columns' sum and the nominal array's field in the error
    # bars, if columns only serve for deviations: blocks deviate by less than a tenth of their
    # magnetization
    deviation = 0.1
    if parts.for_deviations:
        unequal *= deviation
        field = vacuum_part(magnet, observation.points) + parts.nominal
        offset = observation.apply(field) - matrix @ nominal
    return Response(matrix, names, nominal, offset,
                    np.hypot(error_bars(observation, parts, error), unequal),
                    superposition_error(total, magnitude, direct),
                    shared_error=observation.apply(error))


def _rows(
    magnet: Magnet, observation: Observation, parts: ElementFields, rows: slice
) -> tuple[Floats, Floats, Floats]:
    """Return some rows (k, parameters) of H, and two sums over the blocks of the nominal array.

    Both sums are (k,) in T: of the blocks' finite-element contributions to these readings, and of
    the magnitudes of these contributions. They serve `superposition_error`.
    """
    blocks, dimension = magnet.blocks, magnet.dimension
    seen, operator = observation.part(rows)
    points = observation.points[seen]
    vacuum = unit_fields(blocks, points) if magnet.study.solver.method == "reaction" else None
    total, magnitude = np.zeros(operator.shape[0]), np.zeros(operator.shape[0])
    matrix = np.empty((operator.shape[0], dimension * len(blocks)))
    for number, block in enumerate(blocks):
        readings = operator @ parts.block(number, seen).reshape(-1, dimension)
        contribution = readings * parts.sources[number].polarization[:dimension]
        total += contribution.sum(axis=1)
        magnitude += np.abs(contribution).sum(axis=1)
        if vacuum is not None:
            readings = readings + operator @ next(vacuum)[:, :, :dimension].reshape(-1, dimension)
        # B_r = mu_0 mu_r M converts readings per tesla into readings per A/m
        matrix[:, dimension * number:dimension * (number + 1)] = readings @ (
            MU_0 * block.recoil_tensor[:dimension, :dimension])
    return matrix, total, magnitude


def _whole(parts: Iterable[Floats], shape: tuple[int, int]) -> Floats:
    """Return a matrix whose rows arrive in parts (k, m)."""
    matrix, first = np.empty(shape), 0
    for part in parts:
        matrix[first:first + len(part)] = part
        first += len(part)
    return matrix


def superposition_error(total: Floats, magnitude: Floats, direct: Floats) -> float:
    """Compare the sum of the blocks' readings with the readings of all blocks solved together.

    Only the contributions of the finite elements are compared; the remainder is exact.

    Parameters
    ----------
    total, magnitude : ndarray, shape (readings,), in T
        Sums over the blocks of their contributions, and of the magnitudes of these.
    direct : ndarray, shape (readings,), in T
        Contributions of all blocks solved together.

    Returns
    -------
    float
        Largest difference, relative to the largest sum of magnitudes, because the readings
        themselves may vanish by symmetry.
    """
    scale = magnitude.max()
    return float(np.abs(total - direct).max() / scale) if scale > 0 else float(
        np.abs(direct).max())


def check_superposition(error: float, tolerance: float = SUPERPOSITION_TOLERANCE) -> None:
    """Raise ColumnsError if a `superposition_error` is larger than the tolerance."""
    if not error <= tolerance:
        raise ColumnsError(
            f"The columns of the response do not add up to the directly solved field: the largest "
            f"difference is {error:.1e} of the blocks' contributions, where {tolerance:.0e} is "
            "allowed. A column is wrong; please report this with the study.")


def _key(
    magnet: Magnet, observation: Observation, session: Session, similar: Magnet | None = None
) -> str:
    """Return a digest of everything that the matrix depends on."""
    relevant = magnet.study.model_dump(mode="json", include=FIELD_KEYS)
    if similar is not None:
        relevant["similar"] = similar.study.model_dump(mode="json", include=FIELD_KEYS)
    if magnet.study.prior.variation_sd:
        relevant["variation"] = [magnet.study.prior.variation_sd,
                                 magnet.study.prior.variation_length_m]
    if magnet.study.uncertain_of_magnet:
        relevant["uncertain"] = [one.model_dump(mode="json")
                                 for one in magnet.study.uncertain_of_magnet]
    digest = hashlib.sha256(json.dumps(relevant, sort_keys=True).encode())
    curve = magnet.curve  # the study may only name the steel, whose data may change
    if curve is not None:
        digest.update(np.array([curve.H, curve.B]).tobytes())
    versions = [version(name) for name in ("halbach-fe", "gmsh", "meshio", "scipy")]
    digest.update(f"{versions} {session.getdp.version} {session.getdp.petsc}".encode())
    digest.update(code_digest(__name__))
    digest.update(np.ascontiguousarray(observation.points).tobytes())
    operator = observation.operator.tocoo()
    for part in (*operator.coords, operator.data):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _write(path: Path, key: str, built: Response) -> None:
    data = xr.Dataset(
        {"nominal": ("parameter", built.nominal, {"units": "A/m"}),
         "offset": ("reading", built.offset, {"units": "T"}),
         "error": ("reading", built.error, {"units": "T"}),
         "shared_error": (("change", "reading"), built.shared_error.reshape(
             -1, len(built.offset)), {"units": "T"}),
         "of_neighbours": (("reading", "neighbours_parameter"), built.of_neighbours.reshape(
             len(built.offset), -1), {"units": "T m/A"})},
        coords={"parameter": list(built.parameters)},
        attrs={"key": key, "superposition_error": built.superposition_error,
               "of_similar": int(built.of_similar)})
    if isinstance(built.matrix, StoredMatrix):
        data.attrs["matrix_sha256"] = built.matrix.sha256
    else:
        data["H"] = (("reading", "parameter"), built.matrix, {"units": "T m/A"})
    write_hdf5(with_checksum(data), path)
    for other in path.parent.glob("response-*.npy"):
        if "H" in data or other != _beside(path, key):
            other.unlink()  # it belongs to other inputs


def _beside(path: Path, key: str) -> Path:
    """Return the path of a matrix that is too large to be in the file response.h5 at ``path``."""
    return path.with_name(f"response-{key[:16]}.npy")


def _read(path: Path, key: str) -> Response | None:
    """Return the stored response; None if it is missing, damaged, or belongs to other inputs.

    A damaged one causes a warning.
    """
    try:
        data = read_hdf5(path)
        if data.attrs["key"] != key:
            return None
        names = tuple(map(str, data["parameter"].values))
        readings, parameters = (len(data["offset"]),), (len(names),)
        matrix = (untrusted_files.finite_array(data["H"], readings + parameters) if "H" in data
                  else StoredMatrix.at(_beside(path, key), readings + parameters,
                                       str(data.attrs["matrix_sha256"])))
        return Response(matrix, names,
                        untrusted_files.finite_array(data["nominal"], parameters),
                        untrusted_files.finite_array(data["offset"], readings),
                        untrusted_files.finite_array(data["error"], readings),
                        float(data.attrs["superposition_error"]),
                        of_similar=bool(data.attrs["of_similar"]), reused=True,
                        shared_error=untrusted_files.finite_array(
                            data["shared_error"], (data.sizes["change"], *readings)),
                        of_neighbours=untrusted_files.finite_array(data["of_neighbours"], (
                            *readings, data.sizes["neighbours_parameter"])))
    except FileNotFoundError:
        return None
    except (OSError, EOFError, KeyError, ValueError, TypeError) as error:
        warnings.warn(f"The stored response matrix {path} cannot be used ({error}) and is computed "
                      "again.", HalbachWarning, stacklevel=2)
        return None
