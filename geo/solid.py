"""Solids with openings for machining: their STEP text and the triangles of their surface.

Gmsh's OpenCASCADE makes the solids. It cuts all openings of a plate at once; a plate with 50
pockets takes seconds.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator, Sequence
from ctypes import CDLL
from pathlib import Path
from tempfile import TemporaryDirectory

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeshError, OutputError
from halbach_fe.core.files import is_full
from halbach_fe.geo.session import gmsh_session
from halbach_fe.geometry.prism import Prism

STEP_END = "END-ISO-10303-21;"
"""Last line of a STEP file."""

PER_M = 1e3
"""Units of STEP and STL files per metre: they are in mm."""


def solid(name: str, body: Prism, openings: Sequence[Prism] = ()) -> tuple[str, Floats]:
    """Make a solid: a prism without its openings.

    Parameters
    ----------
    name : str
        What it is, for error messages.
    body : Prism
    openings : sequence of Prism
        They may reach beyond the body, and overlap.

    Returns
    -------
    step : str
        A STEP file (AP214) of the solid alone, in mm.
    triangles : ndarray, shape (n, 3, 3), in mm
        Corners of the triangles of its surface, counter-clockwise as seen from outside.

    Raises
    ------
    MeshError
        If Gmsh fails, or the solid falls apart.
    """
    with gmsh_session(name):
        occ = gmsh.model.occ
        made = [(3, _prism(body))]
        if openings:
            made, _ = occ.cut(made, [(3, _prism(opening)) for opening in openings])
        occ.synchronize()
        if len(made) != 1:
            raise MeshError(f"The openings of {name} leave {len(made)} pieces of it. Reduce the "
                            "openings, or move them apart.")
        return _step_text(), _triangles()


def _prism(prism: Prism) -> int:
    """Add a prism to the Gmsh model, in mm; return its tag."""
    occ, z = gmsh.model.occ, PER_M * prism.z_min
    starts = [occ.addPoint(PER_M * x, PER_M * y, z) for (x, y), _, _ in prism.curves]
    curves = []
    for number, (_, _, centre) in enumerate(prism.curves):
        ends = starts[number], starts[(number + 1) % len(starts)]
        if centre is None:
            curves.append(occ.addLine(*ends))
            continue
        middle = occ.addPoint(PER_M * centre[0], PER_M * centre[1], z)
        curves.append(occ.addCircleArc(ends[0], middle, ends[1]))
        occ.remove([(0, middle)])
    face = occ.addPlaneSurface([occ.addCurveLoop(curves)])
    found = occ.extrude([(2, face)], 0, 0, PER_M * (prism.z_max - prism.z_min))
    return next(tag for dimension, tag in found if dimension == 3)


def _step_text() -> str:
    """Return the model as the text of a STEP file.

    Raises
    ------
    OutputError
        If the temporary file cannot be written. Gmsh itself does not notice a full disk.
    """
    gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
    with TemporaryDirectory(prefix="halbach-fe-") as folder:
        path = Path(folder, "solid.step")
        with _silent_stdout(), contextlib.suppress(Exception):  # Gmsh raises nothing else
            gmsh.write(str(path))
        text = path.read_text(encoding="ascii") if path.exists() else ""
        if not text.rstrip().endswith(STEP_END):
            reason = os.strerror(errno.ENOSPC if is_full(path.parent) else errno.EFBIG)
            raise OutputError(f"Cannot write {path}: {reason}; {len(text)} bytes could be written.")
        return text


@contextlib.contextmanager
def _silent_stdout() -> Iterator[None]:
    """Drop what C++ prints: OpenCASCADE reports every STEP file that it writes."""
    try:
        kept = os.dup(1)
    except OSError:  # standard output is closed
        yield
        return
    sys.stdout.flush()
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        CDLL(None).fflush(None)  # C keeps what is not for a terminal
        os.dup2(kept, 1)
        os.close(kept)
        os.close(null)


def _triangles() -> Floats:
    """Return the triangles of the surface of the model's only solid, in mm."""
    mesh = gmsh.model.mesh
    sagitta_mm = 0.005  # largest distance in mm of a triangle from the arc that it replaces
    for _, curve in gmsh.model.getEntities(1):
        count = 1
        if gmsh.model.getType(1, curve) == "Circle":
            (low,), (high,) = gmsh.model.getParametrizationBounds(1, curve)
            radius = gmsh.model.occ.getMass(1, curve) / (high - low)
            step = 2 * np.arccos(1 - min(sagitta_mm / radius, 0.5))
            count = max(2, int(np.ceil((high - low) / step)))
        mesh.setTransfiniteCurve(curve, count + 1)
    for _, surface in gmsh.model.getEntities(2):
        if gmsh.model.getType(2, surface) == "Cylinder":  # else triangles would cut through it
            mesh.setTransfiniteSurface(surface)
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{option}", 0)
    (_, volume), = gmsh.model.getEntities(3)
    mesh.setOutwardOrientation(volume)
    mesh.generate(2)
    tags, points, _ = mesh.getNodes()
    row = np.zeros(int(tags.max()) + 1, int)
    row[tags.astype(int)] = np.arange(len(tags))
    triangle = 2  # Gmsh's element type of triangles
    _, nodes = mesh.getElementsByType(triangle)
    return np.asarray(points.reshape(-1, 3)[row[nodes.astype(int)]].reshape(-1, 3, 3))
