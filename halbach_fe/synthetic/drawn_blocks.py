"""Blocks of one magnet, drawn from the study's prior, and their moments measured in a coil."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.study.model import Study
from halbach_fe.synthetic.reaction import lone_moment_matrix
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, vector


def moments(bodies: tuple[Body, ...], length: float) -> Floats:
    """Return the moments (n, 3) in A m^2 of single bodies, each in its own axes.

    Bodies of infinite length are given the finite ``length`` in m. Bodies of the same shape and
    permeability share their `lone_moment_matrix`, which is good to some 1e-4.
    """
    found = []
    for body in bodies:
        shape, seat = body.shape, body.seat_orientation.as_matrix()
        if np.isinf(shape.length):
            shape = replace(shape, length=length)
        tensor = seat.T @ body.permeability @ seat
        matrix = _known_matrix(shape, tuple((tensor.round(12) + 0.0).ravel().tolist()))
        own = body.seat_orientation.inv().apply(body.remanence) * body.mean_factor
        found.append(body.seat_orientation.apply(matrix @ own))
    return np.array(found)


@lru_cache(maxsize=4096)
def _known_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """Return `lone_moment_matrix`, cached; ``permeability`` is the tensor row by row.

    The tensor does not depend on the sign of the easy axis, so opposite blocks share a matrix.
    """
    return lone_moment_matrix(shape, np.reshape(permeability, (3, 3)))


@dataclass(frozen=True)
class DrawnMagnet:
    """A magnet whose blocks have the errors that were drawn for them."""

    single: TrueMagnet
    """The blocks before they are mounted."""
    turns: tuple[Rotation, ...]
    """Error of the mounting in each place, along the magnet's axes."""
    common: float
    """Deviation that all magnetizations have in common, relative to the nominal."""

    @property
    def mounted(self) -> TrueMagnet:
        """The blocks in the magnet, with the errors of their mounting."""
        return replace(self.single, bodies=tuple(
            body.with_magnetization(turn.apply(body.magnetization))
            for body, turn in zip(self.single.bodies, self.turns, strict=True)))


def draw_magnet(study: Study, nominal: TrueMagnet, generator: np.random.Generator) -> DrawnMagnet:
    """Draw the magnetizations of all blocks, and the errors of their mounting, from the prior."""
    prior = study.prior
    common = float(prior.common_mode_sd * generator.standard_normal())
    single, turns = [], []
    for body in nominal.bodies:
        deviation = generator.standard_normal(3) * [
            prior.magnitude_sd, *2 * [np.radians(prior.direction_sd_deg)]]
        turn = np.radians(prior.mounting_sd_deg) * generator.standard_normal(3)
        if study.dimension == 2:
            deviation[2] = turn[0] = turn[1] = 0.0
        single.append(_deviating(body, deviation + np.array([common, 0.0, 0.0])))
        turns.append(Rotation.from_rotvec(turn))
    return DrawnMagnet(replace(nominal, bodies=tuple(single)), tuple(turns), common)


def _deviating(body: Body, deviation: Floats) -> Body:
    """Return the body with another magnetization M.

    ``deviation`` (3,) is the change as fractions of M: along M, perpendicular to it in the plane of
    the ring, and perpendicular to both, which is along z unless M leaves the plane.
    """
    nominal = body.magnetization
    size = np.linalg.norm(nominal)
    if not size:  # the block is missing
        return body
    along = nominal / size
    across = np.cross([0, 0, 1], along)
    # sine of the angle to the magnet's axis below which a magnetization has no direction across
    along_z = 1e-6
    if np.linalg.norm(across) < along_z:
        across = np.cross([0, 1, 0], along)
    across /= np.linalg.norm(across)
    axes = size * np.array([along, across, np.cross(along, across)])
    return body.with_magnetization(nominal + deviation @ axes)


def coil_table(
    study: Study, nominal: TrueMagnet, single: TrueMagnet, coil_sd: float,
    generator: np.random.Generator
) -> tuple[BlockTable, float]:
    """Measure the moments of the single blocks in a Helmholtz coil before they are mounted.

    Ring and slot are those that a block was made for. Missing blocks are left out.

    Parameters
    ----------
    nominal, single : TrueMagnet
        The nominal blocks, and those that are measured before they are mounted.
    coil_sd : float
        Noise of every component, relative to the nominal moment.

    Returns
    -------
    table : BlockTable
    calibration : float
        Relative error of the coil, drawn with the standard deviation ``prior.common_mode_sd``. It
        is the same for all blocks, whose moments are measured too small if it is positive.
    """
    length = study.array.ring_length_m or study.array.outer_radius_m  # of infinite blocks
    there: dict[tuple[int, int], int] = {}
    for number, body in enumerate(nominal.bodies):
        if any(body.remanence):
            there.setdefault(body.made_for or (body.ring, body.slot), number)
    bodies = _before_mounting(nominal, there.values())
    true = moments(_before_mounting(single, there.values()), length)
    sigma = coil_sd * np.linalg.norm(moments(bodies, length), axis=1)
    calibration = float(study.prior.common_mode_sd * generator.standard_normal())
    measured = true / (1 + calibration) + sigma[:, None] * generator.standard_normal(true.shape)
    # the last digits differ from solve to solve
    digits = 10 - int(np.log10(np.abs(measured).max()))
    label = {slot: name for name, slots in study.prior.types.items() for slot in slots}
    reference = study.prior.reference_temperature_C
    shapes = [replace(body.shape, length=length) if np.isinf(body.shape.length) else body.shape
              for body in bodies]
    return BlockTable(
        serial=tuple(f"B{number + 1:04d}" for number in there.values()),
        type=tuple(label.get(slot) or body.type or ("" if body.name else str(slot))
                   for (_, slot), body in zip(there, bodies, strict=True)),
        ring=np.array([ring for ring, _ in there]), slot=np.array([slot for _, slot in there]),
        moment=measured.round(digits), sigma=sigma.round(digits),
        volume=np.array([shape.volume for shape in shapes]),
        temperature=np.full(len(bodies), np.nan if reference is None else reference),
        attributes={"source": "synthetic"}), calibration


def _before_mounting(magnet: TrueMagnet, numbers: Iterable[int]) -> tuple[Body, ...]:
    """Return some bodies, by number, without what happened to their magnetizations later."""
    return tuple(replace(body, remanence=vector(np.array(body.remanence) / body.factor))
                 for body in (magnet.bodies[number] for number in numbers))


def magnetizations(magnet: TrueMagnet) -> list[dict[str, object]]:
    """Return the magnetization of every block, in A/m, as plain data."""
    return [{"ring": body.ring, "slot": body.slot,
             "magnetization_A_per_m": list(vector(body.magnetization.round(6)))}
            for body in magnet.bodies]
