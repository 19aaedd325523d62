"""Assembly of blocks in other places than those for which they were drawn: as sorting put them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, vector

SAME = 1e-6
"""Difference of two moments, relative to the moment, that rounding in a table may make."""


def in_places(single: TrueMagnet, measured: BlockTable, placed: BlockTable) -> TrueMagnet:
    """Return the magnet with its blocks in the places of a table.

    A block keeps its magnetization in the axes of its shape, which is seated as the new place asks.

    Parameters
    ----------
    single : TrueMagnet
        The blocks before they are mounted, in the places for which they were drawn.
    measured : BlockTable
        The same blocks, with the same places.
    placed : BlockTable
        The blocks with their new places. Those without one are left over.

    Raises
    ------
    MeasurementError
        If the tables are not of the same blocks, a block was turned, or a place remains empty.
    """
    drawn = {body.made_for or (body.ring, body.slot): body for body in single.bodies}
    rows = {serial: row for row, serial in enumerate(measured.serial)}
    there: dict[tuple[int, int], Body] = {}
    for number, (serial, place) in enumerate(zip(placed.serial, placed.places, strict=True)):
        if serial not in rows:
            raise MeasurementError(must_be(
                f"block {serial}", placed.source, "one of the simulated blocks",
                f"another serial than {measured.serial[0]} to {measured.serial[-1]}",
                "Sort the blocks.csv of a simulation of this study with the same seed."))
        if place not in drawn:
            if place[0]:
                raise MeasurementError(must_be(
                    f"place of block {serial}", placed.source, "that of a block of the study",
                    f"ring {place[0]}, slot {place[1]}"))
            continue
        row, target = rows[serial], drawn[place]
        source = drawn[measured.places[row]]
        turn = target.carried_from(source)
        moment = turn.apply(measured.moment[row])
        difference = np.linalg.norm(placed.moment[number] - moment) / np.linalg.norm(moment)
        if difference > SAME:
            raise MeasurementError(must_be(
                f"moment of block {serial}", placed.source, "that of the simulated block, which "
                "is not turned in its slot", f"another one by {difference:.2g} of its size",
                "Sort the blocks.csv of a simulation with the same seed, without --turns."))
        there[place] = replace(
            target, remanence=vector(turn.apply(source.remanence)), parts=source.parts,
            easy_axis=vector(turn.apply(source.easy_axis)), along=source.along,
            across=source.across, factor=source.factor)
    empty = [place for place in measured.places if place not in there]
    if empty:
        raise MeasurementError(must_be(
            "places", placed.source, "complete, with a block for each slot",
            f"{len(empty)} empty ones, first ring {empty[0][0]}, slot {empty[0][1]}"))
    return replace(single, bodies=tuple(
        there.get((body.ring, body.slot), body) for body in single.bodies))
