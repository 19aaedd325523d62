"""Readers of the files that a GetDP run leaves: its unknowns, solutions and matrix.

The ``.pre`` file lists the unknowns (degrees of freedom) by basis function and mesh entity. If
edges or faces have unknowns, it also lists the edges and faces of every element. PETSc writes
solutions and matrices in its big-endian binary format, GetDP's SaveSolution writes solutions as
text. GetDP may be built with complex PETSc: every value then has an imaginary part, which must
be 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import GetDPError

_VECTOR, _MATRIX = 1211214, 1211216  # PETSc's class identifiers

_IMAGINARY = "imaginary parts, which a static field has not"


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a system by mesh entity."""

    count: int
    """Number of unknowns."""
    functions: tuple[Ints, ...]
    """For each kind of basis function, in the order of the problem file: index of the unknown by
    entity number, or -1 if the entity has no unknown (its value is fixed, or no entity has this
    number). Nodes are numbered from 1 in the order of the mesh, edges and faces by GetDP."""
    edges: Ints
    faces: Ints
    """Numbers of the k edges or faces of every element, in the mesh's order of elements; the sign
    of an edge gives its direction. Without rows if the problem does not use edges or faces.
    Shape (elements, k)."""


# Number of edges and of faces of an element, by meshio's name of its type.
_PARTS = {"triangle6": (3, 1), "quad": (4, 1), "tetra10": (6, 4)}


def read_unknowns(path: Path, cell_type: str) -> Unknowns:
    """Read the ``.pre`` file of a run on a mesh of one type of elements.

    ``cell_type``: meshio's name of the element type: ``triangle6``, ``quad`` or ``tetra10``.

    Raises
    ------
    GetDPError
        If the file cannot be read or is damaged.
    """
    try:
        return _unknowns(path.read_text(encoding="ascii"), cell_type)
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise GetDPError(
            f"GetDP's list of unknowns {path.name} cannot be read ({error}).") from None


@lru_cache(maxsize=2)  # the runs of a mesh, one after the other, have the same list
def _unknowns(text: str, cell_type: str) -> Unknowns:
    """Return the unknowns in the text of a ``.pre`` file, see `read_unknowns`."""
    edges, faces = _PARTS[cell_type]
    rows = _section(text, "DofData", skip=5)
    if not rows:
        raise ValueError("no unknowns")
    table = np.loadtxt(rows, usecols=range(5), comments=None, ndmin=2)
    # largest entity or unknown number in a list of unknowns, relative to the number of its rows.
    # Most nodes, edges and faces have a row, so that larger numbers are a sign of a damaged file.
    # Arrays are sized by these numbers.
    most_entities = 100
    if not (np.abs(table) <= most_entities * max(1, len(table))).all():
        raise ValueError("an entity or unknown has an impossibly large number")
    table = table.astype(int)
    count = int(text.partition("$DofData")[2].split("\n")[5].split()[1])
    if count < 1:
        raise ValueError("no unknowns")
    functions = []
    solved_for = 1  # the type that GetDP gives to a degree of freedom that is solved for
    for kind in np.unique(table[:, 0]):
        of_kind = table[table[:, 0] == kind]
        index = np.full(np.abs(of_kind[:, 1]).max() + 1, -1)
        solved = of_kind[of_kind[:, 3] == solved_for]
        if not ((solved[:, 4] >= 1) & (solved[:, 4] <= count)).all():
            raise ValueError(f"the number of an unknown is not within 1 to {count}")
        index[np.abs(solved[:, 1])] = solved[:, 4] - 1
        functions.append(index)
    found = Unknowns(count, tuple(functions), _entities(text, "ElementsXEdges", edges),
                     _entities(text, "ElementsXFacets", faces))
    for shared in (*found.functions, found.edges, found.faces):
        shared.flags.writeable = False
    return found


def _section(text: str, name: str, skip: int) -> list[str]:
    """Return the lines of a section of a ``.pre`` file, without its first ``skip`` lines."""
    body = text.partition(f"${name}")[2].partition(f"$End{name}")[0]
    return body.split("\n")[skip + 1:-1]


def _entities(text: str, name: str, count: int) -> Ints:
    """Return the edges or faces (elements, count) of all elements that have ``count`` of them.

    The elements with other numbers of edges or faces are those of the boundary.
    """
    wanted = [line for line in _section(text, name, skip=1)
              if line.split(maxsplit=2)[1] == str(count)]
    if not wanted:
        return np.zeros((0, count), int)
    return np.loadtxt(wanted, int, comments=None, usecols=range(2, 2 + count), ndmin=2)


def read_solutions(path: Path, unknowns: int, solves: int, before: int = 0) -> NDArray[np.floating]:
    """Return the last ``solves`` solutions in a file of PETSc vectors.

    ``before``: number of other solutions that come first in the file, such as the steps of Newton's
    method.

    Returns
    -------
    ndarray, shape (solves, unknowns)
        Mapped from the file, not copied: the solutions of many sources may exceed the memory.

    Raises
    ------
    GetDPError
        If the file does not hold exactly ``before + solves`` solutions, or holds values that are
        not finite.
    """
    try:
        raw = np.memmap(path, np.uint8, "r")
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's solutions {path.name} cannot be read ({error}).") from None
    total = before + solves
    complex_scalars = len(raw) == total * (8 + 16 * unknowns)
    scalar = 16 if complex_scalars else 8
    size = 8 + scalar * unknowns
    if len(raw) != total * size:
        raise GetDPError(f"GetDP's file {path.name} holds {len(raw)} bytes in place of {total} "
                         f"solutions of {unknowns} unknowns; a full disk can cause this.")
    heads = raw.reshape(total, size)[:, :8].copy().view(">i4")
    if not (heads == [_VECTOR, unknowns]).all():
        raise GetDPError(f"GetDP's file {path.name} does not hold {total} PETSc vectors.")
    solutions = np.ndarray((solves, unknowns), ">f8", raw, offset=8 + before * size,
                           strides=(size, scalar))
    if not all(np.isfinite(solution).all() for solution in solutions):
        raise GetDPError(f"GetDP's file {path.name} holds values that are not finite.")
    if complex_scalars and any(
            part.any() for part in np.ndarray((solves, unknowns), ">f8", raw, strides=(size, 16),
                                              offset=16 + before * size)):
        raise GetDPError(f"GetDP's file {path.name} holds {_IMAGINARY}.")
    return solutions


def read_saved(path: Path, unknowns: int, count: int) -> Floats:
    """Return the solutions (count, unknowns) that GetDP's SaveSolution wrote into a ``.res`` file.

    Raises
    ------
    GetDPError
        If the file does not hold exactly ``count`` solutions, or holds values that are not finite.
    """
    try:
        parts = path.read_text(encoding="ascii").split("$Solution")[1:]
        # after the rest of the $Solution line and a line of numbers, every line holds one value
        solutions = np.array([
            _real_values(part.partition("$End")[0].split("\n")[2:-1], unknowns) for part in parts])
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's solutions {path.name} cannot be read ({error}).") from None
    if solutions.shape != (count, unknowns):
        raise GetDPError(f"GetDP's file {path.name} holds solutions {solutions.shape} in place of "
                         f"{count} of {unknowns} unknowns; a full disk can cause this.")
    if not np.isfinite(solutions).all():
        raise GetDPError(f"GetDP's file {path.name} holds values that are not finite.")
    return solutions


def _real_values(lines: list[str], unknowns: int) -> Floats:
    """Return the values in lines; a complex PETSc writes an imaginary part beside each, which is 0.

    Raises ValueError for other text than numbers, or if an imaginary part is not 0.
    """
    values = np.array(" ".join(lines).split(), float)
    if len(lines) == unknowns and len(values) == 2 * unknowns:
        if values[1::2].any():
            raise ValueError(_IMAGINARY)
        values = values[::2]
    return values


def read_matrix(path: Path, unknowns: int) -> sparse.csr_array:
    """Return the matrix (unknowns, unknowns) in a file of PETSc's binary format.

    Raises
    ------
    GetDPError
        If the file does not hold a matrix of this size, or holds values that are not finite.
    """
    try:
        raw = np.fromfile(path, np.uint8)
        head = raw[:16].view(">i4")
        if len(raw) < 16 or tuple(head[:3]) != (_MATRIX, unknowns, unknowns):
            raise ValueError("another header than that of a matrix of this size")
        lengths = raw[16:16 + 4 * unknowns].view(">i4").astype(np.int64)
        start, count = 16 + 4 * unknowns, int(head[3])
        columns = raw[start:start + 4 * count].view(">i4").astype(np.int64)
        scalar = 16 if len(raw) == start + 20 * count else 8
        if lengths.sum() != count or len(raw) != start + (4 + scalar) * count:
            raise ValueError("truncated")
        parts = raw[start + 4 * count:].view(">f8").astype(float).reshape(count, scalar // 8)
        if parts[:, 1:].any():
            raise ValueError(_IMAGINARY)
        values = parts[:, 0].copy()
        if (lengths < 0).any() or (columns < 0).any() or (columns >= unknowns).any():
            # scipy does not check indices, and would read and write outside its arrays
            raise ValueError("entries outside the matrix")
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's matrix {path.name} cannot be read ({error}).") from None
    if not np.isfinite(values).all():
        raise GetDPError(f"GetDP's matrix {path.name} holds values that are not finite.")
    return sparse.csr_array((values, columns, np.append(0, np.cumsum(lengths))),
                            shape=(unknowns, unknowns))


MATRIX_TOLERANCE = 1e-9
"""Largest difference between GetDP's matrix and ours, relative to its largest value. GetDP's Gauss
points have 12 digits: 2e-12 were measured. Another numbering of the unknowns makes a difference of
order 1."""


def check_difference(difference: float, tolerance: float = MATRIX_TOLERANCE) -> None:
    """Check the relative difference between GetDP's matrix and that of our Gauss points.

    Raises
    ------
    GetDPError
        If it is above the tolerance.
    """
    if not difference <= tolerance:
        raise GetDPError(
            f"GetDP's matrix differs by {difference:.1e} from that of halbach-fe: this GetDP "
            "numbers unknowns or places Gauss points in another way. Use GetDP 3.2.")


def factorize(matrix: sparse.sparray, ordered: bool = False) -> sparse_linalg.SuperLU:
    """Factorize a symmetric positive definite matrix, in an order that keeps the factors sparse.

    ``ordered`` tells that the unknowns are in such an order already.
    """
    return sparse_linalg.splu(sparse.csc_array(matrix),
                              permc_spec="NATURAL" if ordered else "MMD_AT_PLUS_A",
                              diag_pivot_thresh=0.0, options={"SymmetricMode": True})
