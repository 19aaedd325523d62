"""The response matrix H: block magnetizations p in A/m to readings q in T, q = H p, and the offset
of fields that are not the magnet's.

With non-linear iron H is the derivative at the nominal magnetization, and q = offset + H p near it.

Each column is the field of one block magnetized by 1 A/m along one axis: its exact field in
vacuum plus the finite-element reaction, or the finite-element field alone (method ``direct``).
One more solve, of the nominal array at once, is compared with the sum of the columns.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core import untrusted
from halbach_fe.core.arrays import Floats
from halbach_fe.core.code_digest import code_digest
from halbach_fe.core.errors import GetDPError, OutputError
from halbach_fe.core.files import atomic
from halbach_fe.core.hdf5 import write_hdf5
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.response.discretization_error import error_bar_session, reading_errors
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.field import (
    SUPERPOSITION_TOLERANCE,
    ElementFields,
    check_points,
    finite_element_part,
    vacuum_part,
)
from halbach_fe.solver.session import Session
from halbach_fe.solver.vacuum_field import unit_fields
from halbach_fe.stats.linear_gaussian import row_slices
from halbach_fe.stats.noise import Rows
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import FIELD_KEYS
from halbach_fe.study.types import COMPONENTS

LOADED_BYTES = 2**30
"""A larger matrix stays on the disk, and is read in parts."""


@dataclass(frozen=True)
class StoredMatrix:
    """A matrix in a .npy file.

    Attributes
    ----------
    path : Path
    shape : tuple of int
    """

    path: Path
    shape: tuple[int, int]

    @classmethod
    def of(cls, parts: Iterable[Floats], shape: tuple[int, int], path: Path) -> StoredMatrix:
        """Write a matrix of its rows, parts (k, m)."""
        with atomic(path) as temporary, temporary.open("wb") as file:
            file.write(_npy_header(shape))
            for part in parts:
                file.write(np.ascontiguousarray(part, "<f8").data)
        return cls(path, shape)

    @classmethod
    def at(cls, path: Path, shape: tuple[int, int]) -> StoredMatrix:
        """One that was written before; ValueError if it is damaged, or another."""
        header = _npy_header(shape)
        with path.open("rb") as file:
            if file.read(len(header)) != header or (
                    path.stat().st_size != len(header) + 8 * shape[0] * shape[1]):
                raise ValueError(f"{path} is not a matrix {shape}")
        return cls(path, shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Rows) -> Floats:
        try:  # mapped anew: pages that were read are not kept
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
    """H and its labels.

    Attributes
    ----------
    matrix : ndarray or StoredMatrix, shape (readings, parameters), in T m/A
    parameters : tuple of str
        ``r01s05.Mx``: ring 1, slot 5, component x.
    nominal : ndarray, shape (parameters,), in A/m
        The study's nominal magnetization.
    offset : ndarray, shape (readings,), in T
        Fields that are not the magnet's, and what linearizing iron leaves.
    error : ndarray, shape (readings,), in T
        Error bar of the finite elements, for the nominal array; see
        `halbach_fe.response.discretization_error.reading_errors`.
    superposition_error : float
        How far the blocks' finite-element parts, summed, miss that of the whole array, see
        `verify_superposition`.
    reused : bool
        Whether it was taken from an earlier run with the same inputs.
    """

    matrix: Floats | StoredMatrix
    parameters: tuple[str, ...]
    nominal: Floats
    offset: Floats
    error: Floats
    superposition_error: float
    reused: bool = False

    @property
    def whole(self) -> Floats:
        """The matrix in memory, however large."""
        return self.matrix[np.arange(len(self.matrix))]


def parameter_names(magnet: Magnet) -> tuple[str, ...]:
    """Names of the parameters p, block by block; the cross-section has no M_z."""
    components = COMPONENTS[: magnet.dimension]
    return tuple(f"{block.name}.M{c}" for block in magnet.blocks for c in components)


def response_matrix(magnet: Magnet, observation: Observation, session: Session) -> Response:
    """Build H, or take it from the session's folder if it is there for the same inputs."""
    check_points(magnet, observation.points)
    key = _key(magnet, observation, session)
    path = session.folder / "response.h5"
    stored = _read(path, key)
    if stored is not None:
        return stored
    blocks, dimension = magnet.blocks, magnet.dimension
    parts = finite_element_part(magnet, observation.points, session)
    total, magnitude = np.zeros(len(observation)), np.zeros(len(observation))

    def rows() -> Iterator[Floats]:
        # as many at once as memory takes: they share integrals
        for some in row_slices(len(observation), dimension * len(blocks), len(observation)):
            matrix, total[some], magnitude[some] = _rows(magnet, observation, parts, some)
            yield matrix

    shape = len(observation), dimension * len(blocks)
    matrix = _whole(rows(), shape) if 8 * np.prod(shape) <= LOADED_BYTES else StoredMatrix.of(
        rows(), shape, _beside(path, key))
    nominal = np.concatenate([block.magnetization[:dimension] for block in blocks])
    direct = observation.apply(parts.along_nominal)
    error = reading_errors(magnet, observation, parts, error_bar_session(session))
    superposition = verify_superposition(total, magnitude, direct, parts.superposition_tolerance)
    # where symmetry places blocks on a mesh without it, the columns miss the nominal array a little
    offset = observation.apply(external_field(magnet, observation.points))
    if parts.linearized:
        field = vacuum_part(magnet, observation.points) + parts.nominal
        offset = observation.apply(field) - matrix @ nominal
    built = Response(matrix, magnet.parameter_names, nominal, offset,
                     np.hypot(error, total - direct), superposition)
    _write(path, key, built)
    return built


def _rows(
    magnet: Magnet, observation: Observation, parts: ElementFields, some: slice
) -> tuple[Floats, Floats, Floats]:
    """Some rows (k, parameters) of H; and of what finite elements contribute to these readings of
    the nominal array, block by block, the sum and that of magnitudes (k,), in T.
    """
    blocks, dimension = magnet.blocks, magnet.dimension
    seen, operator = observation.part(some)
    points = observation.points[seen]
    vacuum = unit_fields(blocks, points) if magnet.study.solver.method == "reaction" else None
    total, magnitude = np.zeros(operator.shape[0]), np.zeros(operator.shape[0])
    matrix = np.empty((operator.shape[0], dimension * len(blocks)))
    for number, block in enumerate(blocks):
        readings = operator @ parts.block(number, seen).reshape(-1, dimension)
        source = parts.sources[number]
        share = readings * (source.remanence * np.array(source.easy_axis[:dimension]))
        total += share.sum(axis=1)
        magnitude += np.abs(share).sum(axis=1)
        if vacuum is not None:
            readings = readings + operator @ next(vacuum)[:, :, :dimension].reshape(-1, dimension)
        # B_r = mu_0 mu_r M turns per tesla into per A/m
        matrix[:, dimension * number:dimension * (number + 1)] = readings @ (
            MU_0 * block.recoil_tensor[:dimension, :dimension])
    return matrix, total, magnitude


def _whole(parts: Iterable[Floats], shape: tuple[int, int]) -> Floats:
    """A matrix of its rows, parts (k, m)."""
    matrix, first = np.empty(shape), 0
    for part in parts:
        matrix[first:first + len(part)] = part
        first += len(part)
    return matrix


def verify_superposition(
    total: Floats, magnitude: Floats, direct: Floats, tolerance: float = SUPERPOSITION_TOLERANCE
) -> float:
    """Return the largest difference between readings of all blocks together, summed and solved
    directly, relative to the largest sum of magnitudes (readings may vanish by symmetry).

    Only what finite elements contribute is compared; the rest is exact. GetDPError if it is too
    large.
    """
    scale = magnitude.max()
    error = float(np.abs(total - direct).max() / scale) if scale > 0 else float(
        np.abs(direct).max())
    if not error <= tolerance:
        raise GetDPError(
            f"The columns of the response do not add up to the directly solved field: the largest "
            f"difference is {error:.1e} of it, where {tolerance:.0e} is allowed. "
            "A column is wrong; please report this with the study.")
    return error


def _key(magnet: Magnet, observation: Observation, session: Session) -> str:
    """Digest of all that the matrix depends on."""
    relevant = magnet.study.model_dump(mode="json", include=FIELD_KEYS)
    digest = hashlib.sha256(json.dumps(relevant, sort_keys=True).encode())
    curve = magnet.curve  # a steel's name says nothing of its numbers
    if curve is not None:
        digest.update(np.array([curve.H, curve.B]).tobytes())
    versions = [metadata.version(name) for name in ("halbach-fe", "gmsh", "meshio", "scipy")]
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
         "error": ("reading", built.error, {"units": "T"})},
        coords={"parameter": list(built.parameters)},
        attrs={"key": key, "superposition_error": built.superposition_error})
    if not isinstance(built.matrix, StoredMatrix):
        data["H"] = (("reading", "parameter"), built.matrix, {"units": "T m/A"})
    write_hdf5(data, path)
    for other in path.parent.glob("response-*.npy"):
        if "H" in data or other != _beside(path, key):
            other.unlink()  # of other inputs


def _beside(path: Path, key: str) -> Path:
    """Where a matrix is that is too large for the file of the rest."""
    return path.with_name(f"response-{key[:16]}.npy")


def _read(path: Path, key: str) -> Response | None:
    """The stored response; None if there is none, or it is of other inputs, or damaged."""
    try:
        data = untrusted.read_dataset(path)
        if data.attrs["key"] != key:
            return None
        names = tuple(map(str, data["parameter"].values))
        readings, parameters = (len(data["offset"]),), (len(names),)
        matrix = (untrusted.finite_array(data["H"], readings + parameters) if "H" in data
                  else StoredMatrix.at(_beside(path, key), readings + parameters))
        return Response(matrix, names,
                        untrusted.finite_array(data["nominal"], parameters),
                        untrusted.finite_array(data["offset"], readings),
                        untrusted.finite_array(data["error"], readings),
                        float(data.attrs["superposition_error"]), reused=True)
    except (OSError, EOFError, KeyError, ValueError, TypeError):
        return None
