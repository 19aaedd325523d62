"""The response matrix H: block magnetizations p in A/m to readings q in T, q = H p, and the offset
of fields that are not the magnet's.

With non-linear iron H is the derivative at the nominal magnetization, and q = offset + H p near it.

Each column is the field of one block magnetized by 1 A/m along one axis: its exact field in
vacuum plus the finite-element reaction, or the finite-element field alone (method ``direct``).
One more solve, of the nominal array at once, is compared with the sum of the columns.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib import metadata, resources
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe import foreign
from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.discretization import error_workshop, reading_errors
from halbach_fe.errors import GetDPError
from halbach_fe.exact_field import unit_fields
from halbach_fe.external import external_field
from halbach_fe.field_map import write_hdf5
from halbach_fe.observation import Observation
from halbach_fe.routes import (
    SUPERPOSITION_TOLERANCE,
    check_points,
    exact_part,
    finite_element_part,
)
from halbach_fe.solve import Workshop
from halbach_fe.study import COMPONENTS, FIELD_KEYS, MU_0, Study, curve_of


@dataclass(frozen=True)
class Response:
    """H and its labels.

    Attributes
    ----------
    matrix : ndarray, shape (readings, parameters), in T m/A
    parameters : tuple of str
        ``r01s05.Mx``: ring 1, slot 5, component x.
    nominal : ndarray, shape (parameters,), in A/m
        The study's nominal magnetization.
    offset : ndarray, shape (readings,), in T
        Fields that are not the magnet's, and what linearizing iron leaves.
    error : ndarray, shape (readings,), in T
        Error bar of the finite elements, for the nominal array; see
        `halbach_fe.discretization.reading_errors`.
    superposition_error : float
        How far the blocks' finite-element parts, summed, miss that of the whole array, see
        `verify_superposition`.
    reused : bool
        Whether it was taken from an earlier run with the same inputs.
    """

    matrix: Floats
    parameters: tuple[str, ...]
    nominal: Floats
    offset: Floats
    error: Floats
    superposition_error: float
    reused: bool = False


def parameter_names(study: Study) -> tuple[str, ...]:
    """Names of the parameters p, block by block; the cross-section has no M_z."""
    components = COMPONENTS[: study.dimension]
    return tuple(f"{block.name}.M{c}" for block in blocks_of(study) for c in components)


def response(study: Study, observation: Observation, workshop: Workshop) -> Response:
    """Build H, or take it from the workshop's folder if it is there for the same inputs."""
    check_points(study, observation.points)
    key = _key(study, observation, workshop)
    path = workshop.folder / "response.h5"
    stored = _read(path, key)
    if stored is not None:
        return stored
    blocks = blocks_of(study)
    dimension = study.dimension
    parts = finite_element_part(study, observation.points, workshop)
    exact = study.solver.method == "reaction"
    vacuum = unit_fields(blocks, observation.points)
    columns = []
    total, magnitude = np.zeros(len(observation)), np.zeros(len(observation))
    for number, block in enumerate(blocks):
        readings = observation.apply(np.moveaxis(parts.block(number), 2, 0))
        source = parts.sources[number]
        share = readings * (source.remanence * np.array(source.easy_axis[:dimension]))[:, None]
        total += share.sum(axis=0)
        magnitude += np.abs(share).sum(axis=0)
        if exact:
            readings = readings + observation.apply(
                np.moveaxis(next(vacuum)[:, :, :dimension], 2, 0))
        # B_r = mu_0 mu_r M turns per tesla into per A/m
        columns.append(readings.T @ (MU_0 * block.recoil_tensor[:dimension, :dimension]))
    matrix = np.hstack(columns)
    nominal = np.concatenate([block.magnetization[:dimension] for block in blocks])
    direct = observation.apply(parts.along_nominal)
    error = reading_errors(study, observation, parts, error_workshop(workshop))
    superposition = verify_superposition(total, magnitude, direct, parts.superposition_tolerance)
    # where symmetry places blocks on a mesh without it, the columns miss the nominal array a little
    offset = observation.apply(external_field(study, observation.points))
    if parts.linearized:
        field = exact_part(study, observation.points) + parts.nominal
        offset = observation.apply(field) - matrix @ nominal
    built = Response(matrix, parameter_names(study), nominal, offset,
                     np.hypot(error, total - direct), superposition)
    _write(path, key, built)
    return built


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


def _key(study: Study, observation: Observation, workshop: Workshop) -> str:
    """Digest of all that the matrix depends on."""
    relevant = study.model_dump(mode="json", include=FIELD_KEYS)
    digest = hashlib.sha256(json.dumps(relevant, sort_keys=True).encode())
    curve = curve_of(study)  # a steel's name says nothing of its numbers
    if curve is not None:
        digest.update(np.array([curve.H, curve.B]).tobytes())
    versions = [metadata.version(name) for name in ("halbach-fe", "gmsh", "meshio", "scipy")]
    digest.update(f"{versions} {workshop.getdp.version} {workshop.getdp.petsc}".encode())
    digest.update(code_digest())
    digest.update(np.ascontiguousarray(observation.points).tobytes())
    operator = observation.operator.tocoo()
    for part in (*operator.coords, operator.data):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def code_digest() -> bytes:
    """Digest of the program's own text: a changed formula makes what is stored another's."""
    digest = hashlib.sha256()
    for package in ("halbach_fe", "halbach_fe.inference", "halbach_fe.geo", "halbach_fe.pro"):
        for source in sorted(resources.files(package).iterdir(), key=lambda path: path.name):
            if source.name.endswith((".py", ".pro", ".j2")):
                digest.update(source.read_bytes())
    return digest.digest()


def _write(path: Path, key: str, built: Response) -> None:
    data = xr.Dataset(
        {"H": (("reading", "parameter"), built.matrix, {"units": "T m/A"}),
         "nominal": ("parameter", built.nominal, {"units": "A/m"}),
         "offset": ("reading", built.offset, {"units": "T"}),
         "error": ("reading", built.error, {"units": "T"})},
        coords={"parameter": list(built.parameters)},
        attrs={"key": key, "superposition_error": built.superposition_error})
    write_hdf5(data, path)


def _read(path: Path, key: str) -> Response | None:
    """The stored response; None if there is none, or it is of other inputs, or damaged."""
    try:
        data = foreign.dataset(path)
        if data.attrs["key"] != key:
            return None
        names = tuple(map(str, data["parameter"].values))
        readings, parameters = (len(data["offset"]),), (len(names),)
        return Response(foreign.numbers(data["H"], readings + parameters), names,
                        foreign.numbers(data["nominal"], parameters),
                        foreign.numbers(data["offset"], readings),
                        foreign.numbers(data["error"], readings),
                        float(data.attrs["superposition_error"]), reused=True)
    except (OSError, KeyError, ValueError, TypeError):
        return None
