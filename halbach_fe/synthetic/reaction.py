"""The field that materials add to that of bodies in vacuum: choice of the method."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.pace import Progress
from halbach_fe.synthetic import ngsolve_reaction
from halbach_fe.synthetic.magpylib_field import no_progress
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.separate_reaction import separate_reaction
from halbach_fe.synthetic.shapes import PrismBody
from halbach_fe.synthetic.true_magnet import TrueMagnet

MOST_IN_IRON = 400
"""Largest number of separate blocks that are meshed together with iron, in three dimensions. Each
has some 1000 elements of order 3, which is some 3 GB for all."""


def reaction_field(
    magnet: TrueMagnet, points: Floats, elements: Elements | None = None,
    progress: Progress = no_progress,
) -> Floats:
    """Return the part of B (n, 3) in T, at points (n, 3) in m in air, that the materials add.

    It is the difference between the field with their response and that of `vacuum_field`.

    Raises
    ------
    StudyError
        If the magnet has iron and more separate blocks than can be meshed with it.
    """
    if magnet.is_vacuum:
        return np.zeros((len(points), 3))
    if by_elements(magnet):
        return ngsolve_reaction.reaction_field(magnet, points, elements)
    return separate_reaction(magnet, points, progress)


def by_elements(magnet: TrueMagnet) -> bool:
    """Tell whether NGSolve computes the reaction, or `separate_reaction` does.

    NGSolve meshes cross-sections, rings of sectors and trapezoids, and all magnets with iron.
    Cuboids and free blocks in three dimensions, whose gaps need many elements, are meshed only with
    iron.

    Raises
    ------
    StudyError
        If the magnet has iron and more separate blocks than can be meshed with it.
    """
    bodies = magnet.all_bodies
    separate = sum(bool(body.name) or (isinstance(body.shape, PrismBody) and body.shape.is_cuboid)
                   for body in bodies)
    if magnet.dimension == 2 or not separate:
        return True
    if magnet.iron is None:
        return False
    if separate > MOST_IN_IRON:
        raise StudyError(must_be(
            "`array` with iron", "the study", f"of at most {MOST_IN_IRON} cuboids and free blocks "
            "for a simulated measurement in 3D", str(separate),
            "Leave the iron out, or use fewer blocks."))
    return True
