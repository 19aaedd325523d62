"""What a GetDP run leaves on disk: the place of every unknown, and every solution.

The ``.pre`` file lists the unknowns by basis function and mesh entity, and for edge elements
which edges and faces every element has; PETSc writes the solutions as big-endian binary vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import GetDPError

_VECTOR, _MATRIX = 1211214, 1211216  # PETSc's class identifiers
_UNKNOWN = 1  # GetDP's kind of a degree of freedom that is solved for
MOST_ENTITIES = 100
"""For each row of a list of unknowns; most nodes, edges and faces have one."""


@dataclass(frozen=True)
class Unknowns:
    """Where the unknowns of a system live.

    Attributes
    ----------
    count : int
    functions : tuple of ndarray
        For each kind of basis function, in the order of the problem file: index of the unknown by
        entity number, -1 where there is none (fixed, or no such entity). Nodes are numbered as in
        the mesh, edges and faces by GetDP.
    edges, faces : ndarray, shape (elements, edges of one) and (elements, faces of one)
        In the mesh's order; the sign of an edge tells its direction. Empty where the problem has
        none.
    """

    count: int
    functions: tuple[Ints, ...]
    edges: Ints
    faces: Ints


# Edges and faces of an element, by meshio's name of its type.
_PARTS = {"triangle6": (3, 1), "quad": (4, 1), "tetra10": (6, 4)}


def read_unknowns(path: Path, cell_type: str) -> Unknowns:
    """Read the ``.pre`` file of a mesh of one type of elements; raise GetDPError if it is none."""
    edges, faces = _PARTS[cell_type]
    try:
        text = path.read_text(encoding="ascii")
        rows = _section(text, "DofData", skip=5)
        table = np.array([line.split()[:5] for line in rows], float)
        if not (np.abs(table) <= MOST_ENTITIES * max(1, len(table))).all():
            raise ValueError("an entity or unknown beyond all others")
        table = table.astype(int)
        count = int(text.partition("$DofData")[2].split("\n")[5].split()[1])
        if count < 1:
            raise ValueError("no unknowns")
        functions = []
        for kind in np.unique(table[:, 0]):
            mine = table[table[:, 0] == kind]
            index = np.full(np.abs(mine[:, 1]).max() + 1, -1)
            solved = mine[mine[:, 3] == _UNKNOWN]
            if not ((solved[:, 4] >= 1) & (solved[:, 4] <= count)).all():
                raise ValueError(f"an unknown that is none of {count}")
            index[np.abs(solved[:, 1])] = solved[:, 4] - 1
            functions.append(index)
        return Unknowns(count, tuple(functions), _entities(text, "ElementsXEdges", edges),
                        _entities(text, "ElementsXFacets", faces))
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise GetDPError(
            f"GetDP's list of unknowns {path.name} cannot be read ({error}).") from None


def _section(text: str, name: str, skip: int) -> list[str]:
    body = text.partition(f"${name}")[2].partition(f"$End{name}")[0]
    return body.split("\n")[skip + 1:-1]


def _entities(text: str, name: str, count: int) -> Ints:
    """Entities of the elements that have ``count`` of them (others are faces of the boundary)."""
    rows = [line.split() for line in _section(text, name, skip=1)]
    wanted = [row[2:] for row in rows if row[1] == str(count)]
    return np.array(wanted, int).reshape(-1, count)


def read_solutions(path: Path, unknowns: int, solves: int, before: int = 0) -> NDArray[np.floating]:
    """The last ``solves`` solutions of a run, (solves, unknowns), mapped from the file.

    ``before`` is how many others there are.

    Raises
    ------
    GetDPError
        If the file does not hold just these solves, or values that are not finite.
    """
    size = 8 + 8 * unknowns
    try:
        raw = np.memmap(path, np.uint8, "r")
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's solutions {path.name} cannot be read ({error}).") from None
    total = before + solves
    if len(raw) != total * size:
        raise GetDPError(f"GetDP's file {path.name} holds {len(raw)} bytes in place of {total} "
                         f"solutions of {unknowns} unknowns; a full disk looks like this.")
    heads = raw.reshape(total, size)[:, :8].copy().view(">i4")
    if not (heads == [_VECTOR, unknowns]).all():
        raise GetDPError(f"GetDP's file {path.name} does not hold {total} PETSc vectors.")
    solutions = np.ndarray((solves, unknowns), ">f8", raw, offset=8 + before * size,
                           strides=(size, 8))
    if not all(np.isfinite(solution).all() for solution in solutions):
        raise GetDPError(f"GetDP's file {path.name} holds values that are not finite.")
    return solutions


def read_saved(path: Path, unknowns: int, count: int) -> Floats:
    """Solutions (count, unknowns) that GetDP's SaveSolution wrote into a ``.res`` file as text.

    Raises
    ------
    GetDPError
        If the file does not hold just these, or values that are not finite.
    """
    try:
        parts = path.read_text(encoding="ascii").split("$Solution")[1:]
        # a comment and a line of numbers, then a value a line
        solutions = np.array([np.array(part.partition("$End")[0].split("\n")[2:-1], float)
                              for part in parts])
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's solutions {path.name} cannot be read ({error}).") from None
    if solutions.shape != (count, unknowns):
        raise GetDPError(f"GetDP's file {path.name} holds solutions {solutions.shape} in place of "
                         f"{count} of {unknowns} unknowns; a full disk looks like this.")
    if not np.isfinite(solutions).all():
        raise GetDPError(f"GetDP's file {path.name} holds values that are not finite.")
    return solutions


def read_matrix(path: Path, unknowns: int) -> sparse.csr_array:
    """A matrix (unknowns, unknowns) that PETSc wrote in binary; raise GetDPError if it is none."""
    try:
        raw = np.fromfile(path, np.uint8)
        head = raw[:16].view(">i4")
        if len(raw) < 16 or tuple(head[:3]) != (_MATRIX, unknowns, unknowns):
            raise ValueError("another header")
        lengths = raw[16:16 + 4 * unknowns].view(">i4").astype(np.int64)
        start, count = 16 + 4 * unknowns, int(head[3])
        columns = raw[start:start + 4 * count].view(">i4").astype(np.int64)
        values = raw[start + 4 * count:start + 12 * count].view(">f8").astype(float)
        if lengths.sum() != count or len(values) != count or len(raw) != start + 12 * count:
            raise ValueError("truncated")
        if (lengths < 0).any() or (columns < 0).any() or (columns >= unknowns).any():
            raise ValueError("entries outside the matrix")  # scipy would follow them
    except (OSError, ValueError) as error:
        raise GetDPError(f"GetDP's matrix {path.name} cannot be read ({error}).") from None
    if not np.isfinite(values).all():
        raise GetDPError(f"GetDP's matrix {path.name} holds values that are not finite.")
    return sparse.csr_array((values, columns, np.append(0, np.cumsum(lengths))),
                            shape=(unknowns, unknowns))
