"""Mesh of bodies of iron alone, and of the air near them, in curved tetrahedra of second order.

Blocks do not shape it. Around the air lies a shell that GetDP maps to the rest of space.
Rings of iron about z are meshed in `magnet_meshes`, in the half-plane (r, z) or with the blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeshError, StudyError, must_be
from halbach_fe.geo.gmsh_session import gmsh_session, write_mesh
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.domain import BlockRegion, Regions
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.study.model import MeshSettings


@dataclass(frozen=True)
class Sizes:
    """Sizes of the elements of iron."""

    iron: float
    """Largest size in m."""
    thickness: float
    """Largest size relative to the ratio of a body's volume and surface, half the thickness of a
    plate."""
    whole: float
    """Largest size relative to the cube root of a body's volume."""
    curvature: float
    """Largest size relative to the radius of a round body."""
    edge: float
    """Size along the edges, where the field is singular, relative to that in the body."""
    gap: float
    """Size along edges at a narrow gap between two bodies, relative to the gap's width."""
    growth: float
    """Change of the size per unit of distance in the air."""

    @classmethod
    def of(cls, mesh: MeshSettings, coarseness: float = 1.0) -> Sizes:
        """Return those of a study; a larger ``coarseness`` is for error bars."""
        usual = 0.4  # growth - 1 for which the numbers below are
        relative = coarseness * (mesh.growth - 1) / usual
        # Of larger elements a body would have so few that a coarser mesh, for error bars, cannot be
        # twice as coarse: the change by it was a third of the error of a box or a tube, and nothing
        # for a sphere. Only sheets, whose size is many times their thickness, get larger ones.
        whole, fewest = 0.3 * coarseness, min(relative, 1.5 * coarseness)
        return cls(coarseness * mesh.block_size_m, 1.2 * relative, whole, min(0.35 * fewest, 1.0),
                   0.35, 0.3 * fewest, 0.8 * fewest**0.5)

    def of_body(self, body: IronSolid) -> float:
        """Return the size in m in a body."""
        volume, surface, _ = body.measures
        flat = body.outline or (body.triangles is not None and body.profile is None)
        round_body = np.inf if flat else self.curvature * body.outer_radius
        return min(self.iron, self.thickness * volume / surface, self.whole * volume ** (1 / 3),
                   round_body)

    def count(self, bodies: Sequence[IronSolid]) -> tuple[int, int]:
        """Estimate the numbers of elements and of unknowns of the mesh, right to a third or so.

        They are integrals of 1 / size^3 over the bodies, their edges and the air near them.
        """
        growth = min(self.growth, 0.6)  # Gmsh's elements grow no faster
        unknowns = 800 * growth**-3  # far away
        for body in bodies:
            volume, surface, edges = body.measures
            size = self.of_body(body)
            small, reach = self.edge * size, (1 - self.edge) * size / growth
            inside = volume / size**3 + edges * np.pi / 4 * reach**2 / (small * size**2)
            unknowns += 4.0 * inside + 55.0 * surface / (growth * size**2) + (
                9.4 * 0.75 * np.pi * edges / (growth**2 * small))
        return round(0.22 * unknowns), round(unknowns)


@dataclass(frozen=True)
class Shell:
    """The spherical shell that is mapped to infinity: middle and radii in m."""

    middle: tuple[float, float, float]
    inner: float
    outer: float


def mesh_iron(name: str, bodies: Sequence[IronSolid], sizes: Sizes, mesh_path: Path
              ) -> tuple[Regions, Shell]:
    """Mesh bodies of iron and the air around, write the mesh, and return regions and shell.

    Raises
    ------
    StudyError
        If bodies overlap.
    MeshError
        If Gmsh fails, or curved sides turn an element inside out.
    """
    with gmsh_session(name):
        pieces, shell = _draw(name, bodies)
        iron = {tag for part in pieces[:-2] for tag in part}
        air = set(pieces[-2]) - iron
        regions = [(tags.AIR_TAG, air), (tags.SHELL_TAG, set(pieces[-1]) - air - iron)]
        regions += [(tags.FIRST_BLOCK_TAG + number, set(part))
                    for number, part in enumerate(pieces[:-2])]
        for tag, volumes in regions:
            gmsh.model.addPhysicalGroup(3, sorted(volumes), tag)
        rim = [tag for _, tag in gmsh.model.getBoundary([(3, tag) for tag in pieces[-1]],
                                                        oriented=False)]
        far = [tag for tag in rim if np.ptp(np.array(
            gmsh.model.getBoundingBox(2, tag)).reshape(2, 3), axis=0).max() > 2 * shell.inner]
        gmsh.model.addPhysicalGroup(2, far, tags.OUTER_BOUNDARY_TAG)
        _set_sizes(bodies, pieces[:-2], sizes, shell)
        _generate(name, shell)
        write_mesh(mesh_path)
    return Regions(
        study=name, dimension=3, air=tags.AIR_TAG, iron=None, shell=tags.SHELL_TAG,
        outer_boundary=tags.OUTER_BOUNDARY_TAG,
        blocks=tuple(BlockRegion(name=f"iron{number + 1}", ring=number + 1, slot=0,
                                 tag=tags.FIRST_BLOCK_TAG + number)
                     for number in range(len(bodies)))), shell


def _generate(name: str, shell: Shell) -> None:
    """Mesh the model in curved tetrahedra of second order.

    A tetrahedron with two faces on a sphere is flat where they meet, and may be inside out there.
    Sides of such are made straighter, but for those on the inside of the shell, which GetDP maps;
    where that does not suffice all elements are a little smaller. (Gmsh's optimizer of curved
    elements finds other places every time, and sometimes none.)

    MeshError if curved sides turn an element inside out in every mesh.
    """
    shrinking, most = 0.97, 8  # of three meshes of a sphere one had such an element on the shell
    for number in range(most):
        gmsh.option.setNumber("Mesh.MeshSizeFactor", shrinking**number)
        gmsh.model.mesh.clear()
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        bent = _straightened(shell)
        if bent is None:
            return
        x, y, z = bent
    raise MeshError(
        f"Gmsh could not mesh the iron of study '{name}' near ({x:.5g}, {y:.5g}, {z:.5g}) m: "
        "its curved sides turn an element inside out. Were other units meant there? Otherwise "
        "give a smaller mesh.block_size_m, or a shape without thin slivers.")


def _straightened(shell: Shell) -> Floats | None:
    """Make sides of elements straighter whose volume is bent, and return the place (3,) in m of one
    for which that did not suffice; None if there is none.
    """
    mesh, ends = gmsh.model.mesh, [(0, 1), (1, 2), (2, 0), (3, 0), (2, 3), (1, 3)]  # of sides
    elements, nodes = mesh.getElementsByType(mesh.getElementType("tetrahedron", 2))
    tags, places, _ = mesh.getNodes()
    place, nodes = np.zeros((tags.max() + 1, 3)), nodes.reshape(-1, 4 + len(ends))
    place[tags] = places.reshape(-1, 3)
    free = ~np.isclose(np.linalg.norm(place - shell.middle, axis=1), shell.inner)
    # Least part of its largest volume that an element has anywhere, which is 0.3 and more in all
    # others of a sphere; after so many steps 1/256 is left of what curved its sides.
    least_part, steps = 0.1, 8
    for _ in range(steps):
        smallest, largest = (mesh.getElementQualities(elements, of) for of in (
            "minDetJac", "maxDetJac"))
        bent = smallest < np.maximum(least_part * largest, 0.0)
        if not bent.any():
            return None
        middles, first = np.unique(nodes[bent, 4:], return_index=True)
        straight = place[nodes[bent]][:, ends].mean(axis=2).reshape(-1, 3)[first]
        change = free[middles, None] * (straight - place[middles]) / 2
        place[middles] += change
        for tag in middles.tolist():
            mesh.setNode(tag, place[tag], [])
    return np.asarray(place[nodes[bent][0, 0]])


def check_apart(name: str, bodies: Sequence[IronSolid]) -> None:
    """Refuse bodies of iron that overlap, as `mesh_iron` does, without meshing them.

    Raises
    ------
    StudyError
    """
    with gmsh_session(name):
        _draw(name, bodies)


def _draw(name: str, bodies: Sequence[IronSolid]) -> tuple[list[list[int]], Shell]:
    """Draw bodies and the air around; return the volumes that each body, the air with them, and
    the air with the shell consist of, and the shell.
    """
    occ = gmsh.model.occ
    drawn = [_volume(body) for body in bodies]
    rounding = 0.01  # of triangles, whose corners Gmsh's points may stand beside
    for number, (body, volume) in enumerate(zip(bodies, drawn, strict=True)):
        found, expected = occ.getMass(*volume), body.measures[0]
        if not abs(found - expected) <= rounding * expected:
            raise MeshError(
                f"Gmsh draws body {number + 1} of iron of study '{name}' with {found:.4g} m^3, but "
                f"it has {expected:.4g} m^3. Please report this with the study.")
    shell = _shell(drawn)
    whole = sum(occ.getMass(*volume) for volume in drawn)
    inner, outer = (occ.addSphere(*shell.middle, radius) for radius in (shell.inner, shell.outer))
    _, parts = occ.fragment(drawn, [(3, inner), (3, outer)])
    occ.synchronize()
    pieces = [[tag for _, tag in part] for part in parts]
    iron = {tag for part in pieces[:-2] for tag in part}
    overlapping = 1e-6  # part of the iron's volume that rounding of coordinates may take
    if sum(occ.getMass(3, tag) for tag in iron) < (1 - overlapping) * whole:
        volume, tag, both = max((occ.getMass(3, tag), tag, (first + 1, second + 1))
                                for (first, one), (second, other) in combinations(
                                    enumerate(pieces[:-2]), 2) for tag in {*one} & {*other})
        x, y, z = (1e3 * np.array(occ.getCenterOfMass(3, tag))).round(3) + 0.0
        raise StudyError(must_be(
            "`iron.bodies`", f"study {name}", "bodies that do not overlap",
            f"bodies {both[0]} and {both[1]}, which share {1e9 * volume:.3g} mm^3 about "
            f"({x:g}, {y:g}, {z:g}) mm (every copy, repeat and mirror image counts as one)",
            "Move them apart, or let them touch."))
    return pieces, shell


def _shell(volumes: Sequence[tuple[int, int]]) -> Shell:
    """Return a shell around volumes."""
    boxes = np.array([gmsh.model.occ.getBoundingBox(*volume) for volume in volumes])
    low, high = boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)
    x, y, z = (low + high) / 2
    radius = 3.0 * float(np.linalg.norm(high - low)) / 2
    return Shell((x, y, z), radius, 1.3 * radius)


def _set_sizes(bodies: Sequence[IronSolid], iron: Sequence[Sequence[int]], sizes: Sizes,
               shell: Shell) -> None:
    """Set the sizes of elements: small at the edges of iron, growing away from it.

    ``iron`` has the volumes of every body.
    """
    field = gmsh.model.mesh.field
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{option}", 0)
    used = []

    def limit(kind: str, entities: list[tuple[int, int]], size: float) -> None:
        distance = field.add("Distance")
        field.setNumbers(distance, kind, sorted({tag for _, tag in entities}))
        field.setNumber(distance, "Sampling", 40)
        used.append(field.add("MathEval"))
        field.setString(used[-1], "F", f"{size:.9g}+{sizes.growth:.9g}*F{distance}")

    narrow: dict[int, set[int]] = {}
    for body, volumes in zip(bodies, iron, strict=True):
        solid = [(3, tag) for tag in volumes]
        faces = gmsh.model.getBoundary(solid, oriented=False)
        size = sizes.of_body(body)
        limit("SurfacesList", faces, size)
        edges = [one for one in gmsh.model.getBoundary(faces, combined=False, oriented=False)
                 if _is_sharp(one)]
        if edges:
            limit("CurvesList", edges, sizes.edge * size)
            others = [(3, tag) for other in iron for tag in other if tag not in volumes]
            widest = sizes.edge * size / sizes.gap
            for width, points in _narrow_gaps(edges, solid, others, widest).items():
                narrow.setdefault(width, set()).update(points)
        used.append(field.add("Constant"))
        field.setNumbers(used[-1], "VolumesList", list(volumes))
        field.setNumber(used[-1], "VIn", size)
        field.setNumber(used[-1], "VOut", shell.inner / 3)
    gmsh.model.occ.synchronize()
    for width, some in narrow.items():
        limit("PointsList", [(0, tag) for tag in some], sizes.gap * 2.0 ** width)
    least = field.add("Min")
    field.setNumbers(least, "FieldsList", used)
    field.setAsBackgroundMesh(least)


def _narrow_gaps(
    edges: Sequence[tuple[int, int]], solid: Sequence[tuple[int, int]],
    others: Sequence[tuple[int, int]], widest: float,
) -> dict[int, list[int]]:
    """Add points along edges of a solid where another one is nearer to them than ``widest`` in m.

    The points are listed by the width of the gap, as its logarithm to base 2, rounded down. Solids
    that touch have no gap, and the narrowest are as one of an eighth of ``widest``.
    """
    occ, narrowest = gmsh.model.occ, widest / 8
    boxes = [np.array(occ.getBoundingBox(*one)) for one in solid]
    near = [other for other in others if any(
        _apart(box, np.array(occ.getBoundingBox(*other))) < widest for box in boxes) and all(
        widest > occ.getDistance(*one, *other)[0] > 0 for one in solid)]
    found: dict[int, list[int]] = {}
    for edge in sorted(set(edges)):
        for other in near:
            width = occ.getDistance(*edge, *other)[0]
            if width >= widest:
                continue
            (low,), (high,) = gmsh.model.getParametrizationBounds(*edge)
            count = 2 + round(occ.getMass(*edge) / max(width, narrowest))
            places = gmsh.model.getValue(*edge, np.linspace(low, high, count))
            for place in np.reshape(places, (-1, 3)):
                point = occ.addPoint(*place)
                width = occ.getDistance(0, point, *other)[0]
                octave = int(np.floor(np.log2(max(width, narrowest))))
                if width < widest:
                    found.setdefault(octave, []).append(point)
                else:
                    occ.remove([(0, point)])
    return found


def _apart(first: Floats, second: Floats) -> float:
    """Return the distance in m of two boxes, each by its low and high corners (6,)."""
    return float(np.linalg.norm(np.maximum(np.maximum(first[:3] - second[3:],
                                                      second[:3] - first[3:]), 0.0)))


def _is_sharp(curve: tuple[int, int]) -> bool:
    """Tell whether a curve is an edge between two faces, and no seam of a round one."""
    faces, _ = gmsh.model.getAdjacencies(*curve)
    if not (len(faces) > 1 and gmsh.model.occ.getMass(*curve) > 0):
        return False
    smooth = 0.94  # cosine of 20 degrees: triangles of a round body meet at less
    normals = [gmsh.model.getNormal(face, [0.0, 0.0]) for face in faces
               if gmsh.model.getType(2, face) == "Plane"]
    return len(normals) < 2 or abs(np.dot(normals[0], normals[1])) < smooth


def _within(triangles: Floats) -> int:
    """Add the volume in a closed surface of triangles (n, 3, 3) in m to the model."""
    occ = gmsh.model.occ
    same = 1e-6 * np.ptp(triangles.reshape(-1, 3), axis=0).max()  # as `closed_surface` has it
    _, first, number = np.unique((triangles / same).round().reshape(-1, 3), axis=0,
                                 return_index=True, return_inverse=True)
    points = [occ.addPoint(*place) for place in triangles.reshape(-1, 3)[first]]
    lines: dict[tuple[int, int], int] = {}
    faces = []
    for corners in number.reshape(-1, 3).tolist():
        loop = []
        for start, end in pairwise([*corners, corners[0]]):
            if (end, start) in lines:
                loop.append(-lines[end, start])
            else:
                lines[start, end] = occ.addLine(points[start], points[end])
                loop.append(lines[start, end])
        faces.append(occ.addPlaneSurface([occ.addCurveLoop(loop)]))
    return int(occ.addVolume([occ.addSurfaceLoop(faces)]))


def _loop(places: Sequence[tuple[float, float, float]]) -> int:
    """Add a closed loop of lines through places in m to the model."""
    occ = gmsh.model.occ
    points = [occ.addPoint(*place) for place in places]
    return int(occ.addCurveLoop([occ.addLine(start, end)
                                 for start, end in pairwise([*points, points[0]])]))


def _volume(body: IronSolid) -> tuple[int, int]:
    """Add a body to the Gmsh model in its place; return its dimension and tag."""
    occ = gmsh.model.occ
    if body.sphere:
        volume = 3, occ.addSphere(0.0, 0.0, 0.0, body.outer_radius)
    elif body.profile is not None:
        face = occ.addPlaneSurface([_loop([(r, 0.0, z) for r, z in body.profile])])
        found = occ.revolve([(2, face)], 0, 0, 0, 0, 0, 1, 2 * np.pi)
        volume = next(each for each in found if each[0] == 3)
    elif body.outline is not None:
        loops = [_loop([(*edge.start, body.z_min) for edge in body.outline])]
        for rim in body.holes:
            loops.append(_loop([(x, y, body.z_min) for x, y in rim[::-1]]) if rim.ndim == 2 else (
                occ.addCurveLoop([occ.addCircle(*rim[:2], body.z_min, rim[2])])))
        face = occ.addPlaneSurface(loops)
        found = occ.extrude([(2, face)], 0, 0, body.z_max - body.z_min)
        volume = next(each for each in found if each[0] == 3)
    elif body.triangles is not None:
        volume = 3, _within(body.triangles)
    else:
        ends = 0.0, 0.0, body.z_min, 0.0, 0.0, body.z_max - body.z_min
        volume = 3, occ.addCylinder(*ends, body.outer_radius)
        if body.inner_radius:
            hole = 3, occ.addCylinder(*ends, body.inner_radius)
            (volume,), _ = occ.cut([volume], [hole])
    angle = float(np.linalg.norm(body.turn_rad))
    if angle:
        occ.rotate([volume], 0, 0, 0, *body.turn_rad, angle)
    occ.translate([volume], *body.origin_m)
    return volume
