"""Small magnets, their maps and what is wrong with them, drawn for sealed cases of the diagnosis.

A magnet has 12 to 144 blocks and a map some 200 points, so that a diagnosis takes a minute.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.installation import import_extra
from halbach_fe.measurement.positions import motion, points_from
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects import EFFECTS
from halbach_fe.synthetic.hidden_effects.effect_types import Site, site_of
from halbach_fe.synthetic.shapes import CylinderBody, PrismBody
from halbach_fe.synthetic.true_magnet import Body
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

Generator = np.random.Generator
Keys = dict[str, Any]

NOISE = 1e-4
"""Standard deviation of a reading, relative to the field of the magnet: a Hall probe's."""

QUARTER = np.pi / 2

SAME_M = 1e-9
"""Difference of two edges in m below which they are equal."""


def _ring_array(generator: Generator, order: int, rings: tuple[int, int], blocks: int,
                shape: str, size: float) -> Keys:
    """Return the keys of equal rings with a bore of radius ``size`` in m, drawn by 10 %."""
    inner = size * generator.uniform(0.9, 1.1)
    keys: Keys = {"shape": shape}
    if shape == "cuboid":
        keys["width_m"] = 1.8 * inner * np.tan(np.pi / blocks)
    return {"multipole_order": order, "blocks_per_ring": blocks,
            "rings": int(generator.integers(rings[0], rings[1] + 1)), "inner_radius_m": inner,
            "outer_radius_m": 1.6 * inner, "ring_length_m": 0.6 * inner,
            "ring_gap_m": 0.04 * inner, "remanence_T": 1.2, "block": keys}


def _dipole(generator: Generator) -> Keys:
    return _ring_array(generator, 1, (2, 4), 12, "sector", 0.1) | {"first_block_angle_deg": 90.0}


def _quadrupole(generator: Generator) -> Keys:
    return _ring_array(generator, 2, (3, 6), 12, "cuboid", 0.05)


def _sextupole(generator: Generator) -> Keys:
    return _ring_array(generator, 3, (2, 3), 16, "trapezoid", 0.03)


def _permeable(generator: Generator) -> Keys:
    return _ring_array(generator, 2, (2, 3), 12, "cuboid", 0.04) | {"recoil_permeability": 1.05}


def _mandhala(generator: Generator) -> Keys:
    keys = _ring_array(generator, 1, (2, 3), 16, "cuboid", 0.06)
    bar = 0.25 * keys["inner_radius_m"]
    return keys | {"outer_radius_m": keys["inner_radius_m"] + bar, "ring_length_m": 3 * bar,
                   "block": {"shape": "cuboid", "width_m": bar, "orientation": "magnetization"}}


def _stepped(generator: Generator) -> Keys:
    """Three rings whose bore widens along z."""
    keys = _ring_array(generator, 1, (3, 3), 12, "trapezoid", 0.03)
    bore, length = keys["inner_radius_m"], keys["ring_length_m"]
    for key in ("rings", "inner_radius_m", "outer_radius_m"):
        del keys[key]
    return keys | {"ring_length_m": 2 * length, "ring": [
        {"inner_radius_m": step * bore, "outer_radius_m": 2.4 * bore} for step in (1, 1.3, 1.7)]}


def _layers(generator: Generator) -> Keys:
    """Two rings in each of two layers."""
    keys = _ring_array(generator, 2, (2, 2), 12, "trapezoid", 0.05)
    bore = keys["inner_radius_m"]
    for key in ("rings", "inner_radius_m", "outer_radius_m"):
        del keys[key]
    return keys | {"ring_length_m": 1.2 * bore, "ring": [
        {"count": 2, "layer": layer, "inner_radius_m": inner * bore, "outer_radius_m": outer * bore}
        for layer, inner, outer in ((1, 1, 1.4), (2, 1.45, 2))]}


def _free(generator: Generator, shape: str, rings: int, count: int, size: Keys) -> Keys:
    """Return a dipole of a table of equal blocks, each turned with its magnetization."""
    bore, step = 0.1 * generator.uniform(0.9, 1.1), size["size_z_m"] * generator.uniform(1.3, 2.0)
    place = [(slot * 2 * np.pi / count, step * (ring - (rings - 1) / 2))
             for ring in range(rings) for slot in range(count)]
    angle = np.array([one for one, _ in place])
    number = len(place)
    table: Keys = {key: [value] * number for key, value in size.items()}
    return {"free_blocks": table | {
        "name": [f"B{each + 1:03d}" for each in range(number)], "shape": [shape] * number,
        "x_m": (bore * np.cos(angle)).tolist(), "y_m": (bore * np.sin(angle)).tolist(),
        "z_m": [z for _, z in place], "rotation_z_deg": (np.degrees(2 * angle) % 360).tolist(),
        "remanence_T": [1.3] * number}}


def _cubes(generator: Generator) -> Keys:
    rings, count = int(generator.integers(4, 7)), int(generator.choice([16, 20, 24]))
    return _free(generator, "cuboid", rings, count, dict.fromkeys(
        ("size_x_m", "size_y_m", "size_z_m"), 0.014))


def _rods(generator: Generator) -> Keys:
    return _free(generator, "cylinder", 2, 12, {"radius_m": 0.012, "size_z_m": 0.06})


def _steel(generator: Generator) -> Keys:
    """A cross-section of trapezoids, for a steel tube around it."""
    keys = _ring_array(generator, 2, (1, 1), 12, "trapezoid", 0.02)
    del keys["ring_length_m"], keys["ring_gap_m"]
    return keys


MAGNETS: Mapping[str, Callable[[Generator], Keys]] = {
    "dipole": _dipole, "quadrupole": _quadrupole, "sextupole": _sextupole, "cubes": _cubes,
    "mandhala": _mandhala, "stepped": _stepped, "layers": _layers, "rods": _rods,
    "permeable": _permeable, "steel": _steel}
"""Keys of the array of each kind of magnet."""

RARE = ("permeable", "steel")
"""Magnets whose true field takes longer, which are drawn half as often."""

MAPS = ("circles", "spheres", "grid", "lines")


def drawn_magnet(generator: Generator) -> str:
    """Draw a kind of magnet."""
    weight = np.array([0.5 if name in RARE else 1.0 for name in MAGNETS])
    return str(generator.choice(list(MAGNETS), p=weight / weight.sum()))


def drawn_study(name: str, generator: Generator) -> Study:
    """Draw a magnet of a kind, and the map with which it is measured."""
    array = MAGNETS[name](generator)
    flat = name == "steel"
    document: Keys = {
        "name": name, "dimension": 2 if flat else 3, "array": array,
        "mesh": {"block_size_m": 0.01}, "noise": {"regions": [{"name": "all", "sigma_T": 1.0}]},
        "observation": {"quantity": "flux_density",
                        "positions": {"kind": "points", "points_m": [[0.0, 0.0, 0.0]]}},
        "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0, "common_mode_sd": 0.01},
        "inference": {"held_out": {"every": 4}}}
    site = site_of(parse_study(document), magnet_of(parse_study(document)))
    bore, half = site.inner, site.half_length
    document["mesh"] = {"block_size_m": (site.outer - bore) / 3}
    if flat:
        outer = array["outer_radius_m"]
        document["iron_ring"] = {"inner_radius_m": 1.1 * outer, "outer_radius_m": 1.3 * outer,
                                 "relative_permeability": 1000.0}
        half = 0.0
        document["mesh"] = {"block_size_m": (site.outer - bore) / 6}
    positions = drawn_positions(
        "circles" if flat else str(generator.choice(MAPS)), bore, half, generator)
    document["observation"] |= {"positions": positions}
    if flat:  # no z to hold out
        document["inference"] = {"held_out": {"radii_m": positions["radius_m"][1:2]}}
    if not flat and generator.random() < 0.1:
        document["observation"]["components"] = [str(generator.choice(["x", "y"]))]
    field = 0.06 if "free_blocks" in array else 0.5
    document["noise"]["regions"][0]["sigma_T"] = float(f"{NOISE * field:.1e}")
    return parse_study(document)


def drawn_positions(kind: str, bore: float, half: float, generator: Generator) -> Keys:
    """Return the positions of a map in a bore, whose radius and half length are in m.

    Lines are scanned to and fro along z, of spheres circles one after the other.
    """
    reach, end = bore * generator.uniform(0.55, 0.7), half * generator.uniform(1.0, 1.3)
    if kind == "circles":
        radii = [0.5 * reach, reach] if half else [0.4 * reach, 0.7 * reach, reach]
        line = {"z_min_m": -end, "z_max_m": end, "count": 9} if half else {}
        return {"kind": kind, "radius_m": radii, "angles": 12 if half else 32, **line}
    side = reach / np.sqrt(2)
    if kind == "grid":
        return {"kind": kind, "start_m": [-side, -side, -end], "end_m": [side, side, end],
                "count": [5, 5, 9]}
    if kind == "lines":
        z = np.linspace(-end, end, 25)
        points = [np.column_stack([0 * z + x, 0 * z + y, z[::(-1)**number]])
                  for number, (x, y) in enumerate(
                      (x, y) for x in (-side, 0.0, side) for y in (-side, 0.0, side))]
    else:
        turn = 2 * np.pi * np.arange(12) / 12
        points = [radius * np.column_stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn),
                                            np.sin(up) + 0 * turn])
                  for radius in (0.6 * reach, reach) for up in np.linspace(-1.4, 1.4, 9)]
    return {"kind": "points", "points_m": np.vstack(points).round(9).tolist()}


def _either(size: float, generator: Generator) -> float:
    return float(generator.choice([-size, size]))


USUAL: Mapping[str, Callable[[Site, Generator], tuple[float, ...]]] = {
    "mapper_translation": lambda site, generator: (0.0, 0.0, _either(1e-3, generator)),
    "mapper_tilt_x": lambda site, generator: (_either(3e-3, generator),),
    "mapper_tilt_y": lambda site, generator: (_either(3e-3, generator),),
    "slow_readings": lambda site, generator: (1.5e-3, 0.0),
    "lag": lambda site, generator: (2e-4,),
    "ring_gap": lambda site, generator: (float(generator.integers(1, site.rings)), 2e-4),
    "ring_shifted_along": lambda site, generator: (
        float(generator.integers(1, site.rings + 1)), _either(5e-4, generator))}
"""Sizes in m, rad or fractions that real faults often have; others are drawn as
`simulate-measurement` draws them."""


OF_CIRCLES = ("eccentric_circle", "radius_scale", "wrong_radius")
"""Effects of an arm that turns about the axis."""


def drawn_fault(
    name: str, study: Study, generator: Generator
) -> tuple[float, ...] | None:
    """Draw the values of an effect; None if this magnet or map cannot have it."""
    magnet = magnet_of(study)
    site, effect = site_of(study, magnet), EFFECTS[name]
    circles = study.observation.positions.kind == "circles"
    if not all(site.has(need) for need in effect.needs) or (name in OF_CIRCLES and not circles):
        return None
    if name == "block_put_in_wrongly":
        there = [(body, turn) for body in magnet.bodies for turn in _turns(body)]
        if not there:
            return None
        body, turn = there[generator.integers(len(there))]
        return float(body.ring), float(body.slot), *map(float, turn)
    return USUAL.get(name, effect.draw)(site, generator)


def _turns(body: Body) -> list[Floats]:
    """Return rotation vectors in rad along a block's own axes after which it fits its slot, and is
    magnetized otherwise.
    """
    # Cosine of the angle below which a block that was put in wrongly is magnetized otherwise.
    least_turn = 0.9
    shape, axes = body.shape, body.face_orientation.as_matrix().T
    found = [np.pi * axis for axis in axes]
    if isinstance(shape, PrismBody) and shape.is_cuboid:
        sides = np.array([shape.depth, shape.inner_width, shape.length])
        found += [sign * QUARTER * axis for number, axis in enumerate(axes) for sign in (1, -1)
                  if np.ptp(np.delete(sides, number)) < SAME_M]
    elif not isinstance(shape, CylinderBody):
        found = found[:1]  # about the radius
    easy = np.array(body.easy_axis)
    return [turn for turn in found
            if Rotation.from_rotvec(turn).apply(easy) @ easy < least_turn]


@dataclass(frozen=True)
class Scan:
    """A map without the cause outside the catalogue that acts on it.

    Attributes
    ----------
    points : ndarray, shape (n, 3), in m
        In the order of the scan.
    outer : float, in m
        Outer radius of the magnet.
    axes : tuple of int
        Components that are read.
    field, readings : ndarray, shape (n, 3), in T
        The true field there, and the readings with noise; 0 of components that are not read.
    field_at : callable
        The true field (n, 3) in T at points (n, 3) in m.
    """

    points: Floats
    outer: float
    axes: tuple[int, ...]
    field: Floats
    readings: Floats
    field_at: Callable[[Floats], Floats]

    @property
    def time(self) -> Floats:
        """Of every reading (n,), from 0 to 1."""
        return np.linspace(0.0, 1.0, len(self.points))

    def moved(self, way: Floats) -> Floats:
        """Change (n, 3) of the field, in an arbitrary unit, where the probe is off by ``way`` (n,
        3), in one as well; it is much less than a millimetre.
        """
        step_m = 1e-5
        step = step_m * way / max(float(np.abs(way).max()), np.finfo(float).tiny)
        return self.field_at(self.points + step) - self.field_at(self.points - step)


def _coil(scan: Scan, generator: Generator) -> Floats:
    """Return the field of a loop of current around the magnet."""
    magpylib = import_extra("magpylib")
    size = float(np.linalg.norm(scan.points, axis=1).max())
    loop = magpylib.current.Circle(
        current=1.0, diameter=size * generator.uniform(3, 5),
        position=(0, 0, size * generator.uniform(-1, 1)))
    return np.asarray(loop.getB(scan.points))


def _ripple(scan: Scan, generator: Generator) -> Floats:
    """Return an error of one sensor, periodic along z or, in a plane, along x."""
    error, along = np.zeros_like(scan.points), scan.points[:, _longest(scan.points)]
    error[:, generator.integers(2)] = np.sin(
        2 * np.pi * along / (np.ptp(along) * generator.uniform(0.15, 0.4))
        + generator.uniform(0, 6))
    return error


def _longest(points: Floats) -> int:
    """Return the axis z of points (n, 3), or x if they are in a plane."""
    return 2 if np.ptp(points[:, 2]) else 0


def _long_quadrupole(scan: Scan, generator: Generator) -> Floats:
    """Return the field of a long quadrupole."""
    return np.asarray(scan.points * [1, -1, 0])


def _lead_screw(scan: Scan, generator: Generator) -> Floats:
    """Return what a screw does whose thread is off periodically, by some ten turns in the map."""
    axis, way = _longest(scan.points), np.zeros_like(scan.points)
    along = scan.points[:, axis]
    way[:, axis] = np.sin(
        2 * np.pi * along / (np.ptp(along) * generator.uniform(0.06, 0.12))
        + generator.uniform(0, 6))
    return scan.moved(way)


def _warming(scan: Scan, generator: Generator) -> Floats:
    """Return a drift of the zeros with a thermal time constant."""
    return np.asarray((1 - np.exp(-scan.time / generator.uniform(0.03, 0.2)))[:, None]
                      * generator.standard_normal(3))


def _mains(scan: Scan, generator: Generator) -> Floats:
    """Return a pickup of the mains, slow as it is sampled once a row."""
    rows = np.arange(len(scan.points))
    phase = 2 * np.pi * rows * generator.uniform(0.02, 0.45) + generator.uniform(0, 6)
    return np.asarray(np.sin(phase)[:, None] * generator.standard_normal(3))


def _play(values: Floats, width: float) -> Floats:
    """Return what follows values (n,) with play, which is ``width`` to either side."""
    shown = values[:1].tolist()
    for value in values[1:].tolist():
        shown.append(min(max(shown[-1], value - width), value + width))
    return np.array(shown)


def _hysteresis(scan: Scan, generator: Generator) -> Floats:
    """Return the error of sensors that follow the field with play."""
    return np.column_stack([
        _play(values, 1e-3 * float(np.ptp(scan.field))) - values for values in scan.field.T])


def _backlash(scan: Scan, generator: Generator) -> Floats:
    """Return what a stage does that has play along one axis."""
    way, axis = np.zeros_like(scan.points), int(generator.integers(3))
    play_m = 1e-5
    way[:, axis] = _play(scan.points[:, axis], play_m) - scan.points[:, axis]
    return scan.moved(way)


def _lag_one_way(scan: Scan, generator: Generator) -> Floats:
    """Return what a stage does that is behind on its way down only."""
    way = motion(scan.points)
    return scan.moved(way * (way[:, 2:] < 0))


def _cubic_of_magnitude(scan: Scan, generator: Generator) -> Floats:
    """Return the error of a probe whose sensitivity falls with the square of |B|."""
    return np.asarray(scan.field * np.sum(scan.field**2, axis=1)[:, None])


def _planar_hall_of_another(scan: Scan, generator: Generator) -> Floats:
    """Return the error of a sensor by the product of its own component and another."""
    error, axis = np.zeros_like(scan.field), int(generator.choice(scan.axes))
    other = (axis + int(generator.integers(1, 3))) % 3
    error[:, axis] = scan.field[:, axis] * scan.field[:, other]
    return error


def _cable(scan: Scan, generator: Generator) -> Floats:
    """Return what a cable does that pulls the probe aside near one end of the map."""
    along, angle = scan.points[:, _longest(scan.points)], generator.uniform(0, 2 * np.pi)
    pull = np.exp((along - along.max()) / (np.ptp(along) * generator.uniform(0.08, 0.2)))
    return scan.moved(pull[:, None] * [np.cos(angle), np.sin(angle), 0])


def _clipped(scan: Scan, generator: Generator) -> Floats:
    """Return what readings lack beyond the range of the probe, which some of them exceed."""
    limit = float(np.quantile(np.abs(scan.readings[:, scan.axes]), generator.uniform(0.94, 0.98)))
    return np.clip(scan.readings, -limit, limit) - scan.readings


def _quantized(scan: Scan, generator: Generator) -> Floats:
    """Return what readings lack of which some hundred steps are shown."""
    step = float(np.ptp(scan.readings)) / generator.uniform(150, 500)
    return step * np.round(scan.readings / step) - scan.readings


Outside = Callable[[Scan, Generator], Floats]
"""Function of a map that returns what a cause changes (n, 3), in an arbitrary unit."""

OUTSIDE: Mapping[str, Outside] = {"coil": _coil, "ripple": _ripple, "quadrupole": _long_quadrupole}
"""Causes outside the catalogue."""

NEWER_OUTSIDE: Mapping[str, Outside] = {
    "lead_screw": _lead_screw, "warming": _warming, "mains": _mains, "hysteresis": _hysteresis,
    "cubic_of_magnitude": _cubic_of_magnitude, "planar_hall_of_another": _planar_hall_of_another,
    "backlash": _backlash, "cable": _cable, "clipped": _clipped, "quantized": _quantized,
    "lag_one_way": _lag_one_way}
"""Those of cases that come after all others, whose seeds thus stay as they were."""

OF_OWN_SIZE = ("clipped", "quantized")
"""Those whose size is that of the readings."""

TO_AND_FRO = ("backlash", "lag_one_way")
"""Those of a stage that comes back."""


def goes_both_ways(points: Floats) -> bool:
    """Tell whether many of a map's points (n, 3) were come to against the way to the nearest point
    of another line.
    """
    # number of points that show how a stage moves
    enough = 2000
    points = points[:enough]
    way = motion(points)
    moved = way.any(axis=1)
    line = np.cumsum(~moved)[moved]
    if len(np.unique(line)) < 2:
        return False
    apart = cdist(points[moved], points[moved])
    apart[line[:, None] == line] = np.inf
    other = way[moved][apart.argmin(axis=1)]
    # cosine of the angle between two ways below which they are opposite, and share of points with
    # such a neighbour that are many
    against, many = -0.5, 0.2
    return bool(np.mean(np.sum(way[moved] * other, axis=1) < against) > many)


def can_have(study: Study, outside: str) -> bool:
    """Tell whether the map of a study can show a cause outside the catalogue."""
    return outside not in TO_AND_FRO or goes_both_ways(points_from(study.observation.positions))
