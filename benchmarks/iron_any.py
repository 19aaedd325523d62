"""Iron of any shape: against closed forms, NGSolve, and the measured plates of TEAM problem 13.

The bars are those of every reading. NGSolve meshes blocks and iron together, of symmetric magnets a
part, and shares no code with the field that it judges. Its elements are of order 4, and small
along the edges of iron: with elements of 2.1 mm throughout it was 5e-4 of the main field off
between the plates, as much as is asked of what it judges; by 1.2 and 0.6 mm along edges the field
differs by 1.4e-4. Of the undulator, whose poles saturate, they are small at the tips: with 4.2 mm,
and 2 mm along all edges, it was 1.2e-3 rms off.
"""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.iron_bodies import BAR, BodiesReaction
from halbach_fe.solver.separate_blocks import SeparateReaction, separate_columns, solve_separate
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.ngsolve_reaction import Elements, reaction_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

Truth = Callable[[Magnet, Floats], Floats]
"""What the iron and the blocks' permeability add (n, 3) in T at points (n, 3) in m."""

Case = Callable[[], tuple[dict[str, Any], Floats, Truth]]
"""A study, points (n, 3) in m, and the truth."""


def study_of(name: str, blocks: dict[str, list[Any]], iron: dict[str, Any], size_m: float,
             growth: float, **changes: Any) -> dict[str, Any]:
    """Return a study of free cuboids and bodies of iron."""
    count = len(blocks["x_m"])
    return {"name": name, "dimension": 3, "mesh": {"block_size_m": size_m, "growth": growth},
            "array": {"free_blocks": {"name": [f"b{n}" for n in range(count)],
                                      "shape": ["cuboid"] * count, **blocks}},
            "iron": iron, "observation": {"quantity": "flux_density", "positions": {
                "kind": "points", "points_m": [[0.0, 0.0, 0.5]]}}} | changes


NO_BLOCK = {"x_m": [0.4], "y_m": [0.0], "z_m": [0.0], "remanence_T": [1e-6],
            **{f"size_{axis}_m": [0.001] for axis in "xyz"}}
"""A block that does nothing, as every study has one."""


def sphere() -> tuple[dict[str, Any], Floats, Truth]:
    """A sphere of permeability 1000 in a uniform field, in closed form (J. D. Jackson, 5.11)."""
    radius, background = 0.02, np.array([0.3, -0.2, 1.0])
    study = study_of("sphere", NO_BLOCK, {"relative_permeability": 1000.0, "bodies": [
        {"kind": "sphere", "radius_m": radius}]}, 0.02, 1.2,
        external={"background_T": background.tolist()})
    generator = np.random.default_rng(1)
    directions = generator.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * (radius + generator.uniform(0.002, 0.02, 60))[:, None]

    def truth(_magnet: Magnet, points: Floats) -> Floats:
        distance = np.linalg.norm(points, axis=1)[:, None]
        dipole = 999 / 1002 * radius**3 * background
        return np.asarray((3 * (points @ dipole)[:, None] * points / distance**2 - dipole)
                          / distance**3)

    return study, points, truth


def by_ngsolve(**elements: Any) -> Truth:
    """Return the truth with some `Elements`."""
    return lambda magnet, points: reaction_field(
        magnet_of(magnet.study), points, Elements(**elements))


def finely(size_m: float, edge_m: float, *mirrored: int, tip: float | None = None) -> Truth:
    """Return the truth with elements of order 4, of what is not ``mirrored``."""
    return by_ngsolve(size=size_m, edge=edge_m, order=4, mirrored=mirrored, tip=tip)


def back_plate() -> tuple[dict[str, Any], Floats, Truth]:
    """A linear Halbach array of five cubes of 10 mm on a steel plate of 5 mm that they touch."""
    x = np.array([-0.02, -0.01, 0.0, 0.01, 0.02])
    axes = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (0, 1)])
    zero = np.zeros(5).tolist()
    blocks: dict[str, list[Any]] = {
        "x_m": x.tolist(), "y_m": zero, "z_m": zero, "recoil_permeability": [1.05] * 5,
        **{f"size_{axis}_m": [0.01] * 5 for axis in "xyz"}, "remanence_z_T": zero,
        "remanence_x_T": (1.2 * axes[:, 0]).tolist(), "remanence_y_T": (1.2 * axes[:, 1]).tolist()}
    study = study_of("back-plate", blocks, {"relative_permeability": 1000.0, "bodies": [
        {"kind": "box", "size_m": [0.06, 0.005, 0.02], "centre_m": [0.0, -0.0075, 0.0]}]},
        0.01, 1.5)
    points = np.array([[x, y, z] for x in np.linspace(-0.024, 0.024, 9) for y in (0.008, 0.012)
                       for z in (0.0, 0.004)])
    return study, points, finely(0.006, 0.001, 1, 0, 1)


def c_yoke() -> tuple[dict[str, Any], Floats, Truth]:
    """Two blocks of 20 x 20 x 8 mm that face each other 24 mm apart on the arms of a steel C."""
    outer, thick, high = 0.045, 0.012, 0.032
    outline = [(-outer, -high), (0.012, -high), (0.012, -high + thick), (-outer + thick,
               -high + thick), (-outer + thick, high - thick), (0.012, high - thick),
               (0.012, high), (-outer, high)]
    middle = high - thick - 0.004
    blocks: dict[str, list[Any]] = {
        "x_m": [0.0, 0.0], "y_m": [-middle, middle], "z_m": [0.0, 0.0],
        "size_x_m": [0.02] * 2, "size_y_m": [0.008] * 2, "size_z_m": [0.02] * 2,
        "remanence_x_T": [0.0] * 2, "remanence_y_T": [1.2] * 2, "remanence_z_T": [0.0] * 2,
        "recoil_permeability": [1.05] * 2}
    study = study_of("c-yoke", blocks, {"relative_permeability": 1000.0, "bodies": [
        {"kind": "prism", "outline_m": outline, "length_m": 0.024}]}, 0.02, 1.6)
    points = np.array([[x, y, z] for x in (-0.008, -0.003, 0.003, 0.008)
                       for y in (-0.006, 0.0, 0.006) for z in (-0.008, 0.0, 0.008)])
    return study, points, finely(0.006, 0.001, 0, -1, 1)


def cuboids(middles_m: Floats, sizes_m: Floats | list[float], remanences_T: Floats,
            permeability: float = 1.05) -> dict[str, list[Any]]:
    """Return the columns of cuboids: middles, sizes and remanences (n, 3)."""
    rows = {"": middles_m, "size_": np.broadcast_to(sizes_m, middles_m.shape),
            "remanence_": remanences_T}
    return {"recoil_permeability": [permeability] * len(middles_m),
            **{f"{name}{axis}_{'T' if name == 'remanence_' else 'm'}": values[:, number].tolist()
               for name, values in rows.items() for number, axis in enumerate("xyz")}}


def quadrupole() -> tuple[dict[str, Any], Floats, Truth]:
    """Four poles of a steel that saturates, tapered to 10.5 mm from the axis, and four cuboids."""
    quarters = np.pi / 2 * np.arange(4)
    around, zero = np.array([np.cos(quarters), np.sin(quarters), 0 * quarters]).T, np.zeros(3)
    across = np.array([around[1], around[0], -around[1], -around[0]])
    sizes = np.array([[0.024, 0.010, 0.03], [0.010, 0.024, 0.03]] * 2)
    tip, shoulder, end = (0.0105, 0.002), (0.02, 0.0115), (0.032, 0.0115)
    profile = [tip, shoulder, end, *((u, -v) for u, v in (end, shoulder, tip))]
    diagonal = [((u - v) / 2**0.5, (u + v) / 2**0.5) for u, v in profile]
    study = study_of("quadrupole", cuboids(zero + 0.026 * around, sizes, 1.3 * across), {
        "curve": {"kind": "steel", "name": "aisi_1010"}, "bodies": [
            {"kind": "prism", "outline_m": diagonal, "length_m": 0.03, "copies": 4}]}, 0.02, 1.5)
    angles = np.pi / 16 + np.pi / 8 * np.arange(16)
    points = np.array([[r * np.cos(phi), r * np.sin(phi), z] for r in (0.004, 0.008)
                       for z in (0.0, 0.01) for phi in angles])
    return study, points, finely(0.004, 0.001, -1, -1, 1)


def plates_on_cubes() -> tuple[dict[str, Any], Floats, Truth]:
    """Two columns of two cubes of 20 mm, 56 mm apart, between two plates of steel of 10 mm."""
    middles = np.array([[x, y, 0.0] for x in (-0.038, 0.038) for y in (-0.01, 0.01)])
    study = study_of("plates", cuboids(middles, [0.02] * 3, np.tile([0.0, 1.2, 0.0], (4, 1))), {
        "relative_permeability": 1000.0, "bodies": [
            {"kind": "box", "size_m": [0.1, 0.01, 0.05], "centre_m": [0.0, 0.025, 0.0],
             "mirrored": ["y"]}]}, 0.02, 1.4)
    points = np.array([[x, y, z] for x in (-0.016, -0.005, 0.005, 0.016)
                       for y in (-0.018, -0.009, 0.0, 0.009, 0.018) for z in (0.0, 0.01)])
    return study, points, finely(0.005, 0.0006, 1, -1, 1)


def undulator() -> tuple[dict[str, Any], Floats, Truth]:
    """Three periods of 40 mm: twelve poles that saturate, fourteen cuboids, a gap of 16 mm."""
    along = 0.02 * np.arange(-3, 4)
    middles = np.array([[0.0, sign * 0.021, z] for sign in (-1, 1) for z in along])
    signs = np.concatenate([(-1.0) ** np.arange(7), -(-1.0) ** np.arange(7)])
    study = study_of("undulator", cuboids(middles, [0.03, 0.024, 0.014],
                                          1.2 * signs[:, None] * np.array([0, 0, 1.0])), {
        "curve": {"kind": "steel", "name": "vacoflux_50"}, "bodies": [
            {"kind": "box", "size_m": [0.024, 0.02, 0.006], "centre_m": [0.0, 0.018, -0.05],
             "repeats": 6, "step_m": [0.0, 0.0, 0.02], "mirrored": ["y"]}]}, 0.02, 1.8)
    points = np.array([[x, y, z] for x in (0.0, 0.005) for y in (-0.004, 0.0, 0.004)
                       for z in np.linspace(-0.03, 0.03, 13)])
    return study, points, finely(0.005, 0.002, 1, -1, -1, tip=0.0008)


CASES = {"sphere": sphere, "plates": plates_on_cubes, "quadrupole": quadrupole, "c_yoke": c_yoke,
         "back_plate": back_plate}


def spent() -> float:
    """Return the seconds of processor time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def solved_with_bars(magnet: Magnet, points: Floats
                     ) -> tuple[SeparateReaction, Floats, Floats, float]:
    """Return the solution, what it adds (n, 3) and its bars (n, 1) in T, and the seconds spent."""
    began = spent()
    with tempfile.TemporaryDirectory() as folder:
        solved = solve_separate(magnet, Session(find_getdp(), Path(folder)))
        field, change = solved.field_with_errors(points)
    return solved, field, np.linalg.norm(change, axis=1, keepdims=True), spent() - began


def rms(field: Floats) -> float:
    """Return the root of the mean square of the lengths of vectors (n, 3)."""
    return float(np.sqrt(np.mean((field**2).sum(axis=1))))


def time_of_ngsolve(magnet: Magnet, points: Floats, exact: Floats, error_T: float) -> float:
    """Return the seconds that NGSolve spends on a field with an error (rms) and on its bar.

    Elements of order 3 get smaller, down to 5 mm, until the error is less. Between the last two
    sizes time goes with a power of the error. The bar takes a mesh twice as coarse.
    """
    seconds: list[float] = []
    errors: list[float] = []
    for size in (0.02, 0.0141, 0.01, 0.0071, 0.005):
        if errors and errors[-1] <= error_T:
            break
        began = spent()
        found = by_ngsolve(size=size)(magnet, points)
        seconds.append(spent() - began)
        errors.append(rms(found - exact))
        common.say(f"NGSolve: {errors[-1]:.1e} T rms off in {seconds[-1]:.0f} s of processor")
    at_error = np.exp(np.interp(np.log(error_T), np.log(errors[:-3:-1]), np.log(seconds[:-3:-1])))
    return float(at_error) + seconds[max(len(seconds) - 3, 0)]


def run(note: Note) -> None:
    """Measure and note the error and the bars of every magnet but the undulator."""
    compare(note, CASES)


def run_undulator(note: Note) -> None:
    """Measure and note the error and the bars of the undulator."""
    compare(note, {"undulator": undulator}, "_undulator")


def judged(name: str, case: Case) -> tuple[float, Floats, Floats, Floats, float]:
    """Solve a magnet: its main field in T, exact and found field (n, 3) in T, bars (n,) in T, and
    the seconds spent.
    """
    import ngsolve

    ngsolve.SetNumThreads(1)  # threads that wait would count
    document, points, truth = case()
    magnet = build_magnet(parse_study(document))
    solved, found, bars, seconds = solved_with_bars(magnet, points)
    exact = truth(magnet, points)
    main = np.linalg.norm(
        exact + field_of(magnet.blocks, points) + external_field(magnet, points), axis=1).max()
    assert isinstance(solved.iron, BodiesReaction)
    polarized = np.linalg.norm(solved.iron.polarization, axis=2).max()
    common.say(f"{name}: {len(solved.iron.total)} unknowns, main field {main:.3f} T, reaction "
               f"{np.abs(exact).max():.4f} T, iron up to {polarized:.2f} T, {seconds:.0f} s of "
               "processor")
    return float(main), exact, found, bars.max(axis=1), seconds


def compare(note: Note, cases: dict[str, Case], suffix: str = "") -> None:
    """Measure and note the error and the bars of magnets; ``suffix`` ends the names."""
    worst, ratios = {}, []
    for name, case in cases.items():
        main, exact, found, bar, _ = judged(name, case)
        error = np.linalg.norm(found - exact, axis=1)
        worst[name] = float(error.max() / main)
        ratios.append(error / bar)
        common.say(
            f"{name}: error {worst[name]:.1e} of the main field at most, "
            f"{rms(found - exact) / main:.1e} rms, {np.mean(error <= 2 * bar):.2f} within 2 bars, "
            f"bar over error {np.sqrt(np.mean(bar**2) / np.mean(error**2)):.1f}")
        note(f"iron_any.error_{name}", worst[name], "of the main field",
             f"largest at {len(error)} points; "
             + ("closed form" if name == "sphere" else "NGSolve, curved, order 4"))
    ratio = np.concatenate(ratios)
    note(f"iron_any.error{suffix}", max(worst.values()), "of the main field",
         f"largest of {', '.join(worst)}")
    note(f"iron_any.coverage{suffix}", float(np.mean(ratio <= 2)), "ratio",
         f"{len(ratio)} readings within 2 bars")


def run_times(note: Note) -> None:
    """Compare the time of four magnets with that of NGSolve.

    Of the undulator, even of elements of 20 mm, NGSolve takes minutes more.
    """
    of_ngsolve = {}
    for name, case in CASES.items():
        if name == "sphere":
            continue
        _, exact, found, _, seconds = judged(name, case)
        document, points, _ = case()
        of_ngsolve[name] = seconds / time_of_ngsolve(
            build_magnet(parse_study(document)), points, exact, rms(found - exact))
        common.say(f"{name}: {of_ngsolve[name]:.2f} of the time of NGSolve")
    note("iron_any.time_over_ngsolve", max(of_ngsolve.values()), "ratio",
         "processor time of field and bars at the error (rms) of ours, largest of "
         + ", ".join(f"{name} {value:.2g}" for name, value in of_ngsolve.items()))


def columns(note: Note) -> None:
    """Compare the time of all columns of 100 cubes on a plate with that of one field with bars."""
    places = 0.011 * (np.arange(10) - 4.5)
    middles = np.array([[x, 0.0, z] for x in places for z in places])
    study = study_of("hundred", cuboids(middles, [0.01] * 3, np.tile([0.0, 1.2, 0.0], (100, 1))), {
        "relative_permeability": 1000.0, "bodies": [
            {"kind": "box", "size_m": [0.12, 0.008, 0.12], "centre_m": [0.0, -0.009, 0.0]}]},
        0.02, 1.6)
    magnet = build_magnet(parse_study(study))
    points = middles + np.array([0.0, 0.015, 0.0])
    solved, field, _, seconds = solved_with_bars(magnet, points)
    began = spent()
    column = separate_columns(magnet, points, solved.iron)
    total = np.sum([column(number, slice(None))[..., 1] * 1.2 for number in range(100)], axis=0)
    note("iron_any.columns_time_over_field", (spent() - began) / seconds, "ratio",
         "all columns of 100 blocks, over one field with bars, processor time")
    common.say(f"the columns add up to {rms(total) / rms(field):.3f} of the field that iron and "
               f"permeability add, {rms(total - field) / rms(field):.1e} off, in "
               f"{spent() - began:.0f} s; the field takes {seconds:.0f} s")


# --- TEAM problem 13 ---------------------------------------------------------------------------

STEEL_H = (0, 16, 30, 54, 93, 143, 191, 210, 222, 233, 247, 258, 272, 289, 313, 342, 377, 433, 509,
           648, 933, 1228, 1934, 2913, 4993, 7189, 9423, 14752, 20996, 28904, 41976)
STEEL_B = (0, 0.0025, 0.005, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0,
           1.1, 1.2, 1.3, 1.4, 1.5, 1.55, 1.6, 1.65, 1.7, 1.75, 1.8, 1.9, 2.0, 2.1, 2.2)
MEASURED_T = (1.33, 1.329, 1.286, 1.225, 1.129, 0.985, 0.655, 0.259, 0.453, 0.554, 0.637, 0.698,
              0.755, 0.809, 0.901, 0.945, 0.954, 0.956, 0.96, 0.965, 0.97, 0.974, 0.981, 0.984,
              0.985)
"""H in A/m and B in T of the steel, and the measured mean of B over 25 sections of the plates at
1000 ampere turns: T. Nakata, K. Fujiwara, Summary of results for benchmark problem 13 (3-D
nonlinear magnetostatic model), COMPEL 11 (1992) 345; Compumag, TEAM workshop problem 13."""
MEASURED_IN_AIR = ((0.01, 0.0593), (0.02, 0.04), (0.03, 0.0336), (0.04, 0.0304), (0.05, 0.0283),
                   (0.06, 0.026), (0.07, 0.0231), (0.08, 0.0182), (0.09, 0.0116), (0.1, 0.0061),
                   (0.11, 0.00406))
"""x in m and measured |B| in T at y = 20 mm, z = 55 mm, at 3000 ampere turns: the same, table 7."""

THICK, TOP, INNER, OUTER = 0.0032, 0.0632, 0.0021, 0.1253


def plates(growth: float, current_A: float) -> dict[str, Any]:
    """The study of problem 13: a plate, a channel on either side of it, 0.5 mm away, and a coil."""
    channel = [(INNER, -TOP), (OUTER, -TOP), (OUTER, TOP), (INNER, TOP), (INNER, TOP - THICK),
               (OUTER - THICK, TOP - THICK), (OUTER - THICK, THICK - TOP), (INNER, THICK - TOP)]
    bodies: list[dict[str, Any]] = [{"kind": "box", "size_m": [THICK, 0.05, 2 * TOP]}]
    for sign in (1.0, -1.0):
        bodies.append({"kind": "prism", "outline_m": [(sign * x, z) for x, z in channel],
                       "length_m": 0.05, "rotation_deg": [90.0, 0.0, 0.0],
                       "centre_m": [0.0, sign * 0.04, 0.0]})
    return study_of(
        "team-13", NO_BLOCK, {"bodies": bodies, "curve": {
            "kind": "table", "H_A_per_m": STEEL_H, "B_T": STEEL_B}}, 0.02, growth,
        external={"coils": [{"kind": "racetrack", "size_m": [0.175, 0.175],
                             "corner_radius_m": 0.0375, "section_m": [0.025, 0.1],
                             "current_A": current_A}]})


SECTIONS = [(0, 2, z / 1000) for z in range(0, 61, 10)] + [
    (1, 0, x / 1000) for x in (2.1, 10, 20, 30, 40, 50, 60, 80, 100, 110, 122.1)] + [
    (1, 2, z / 1000) for z in range(60, -1, -10)]
"""Body, axis across and place in m of the sections: of the plate, of the channel's arm and back."""


def mean_flux(iron: BodiesReaction) -> Floats:
    """Return the mean of B across the sections, (25,) in T.

    The flux is the integral of B . grad w, with w = 1 at the nodes on one side of the section and 0
    at the others. It is that which leaves the steel beyond, whose divergence vanishes for all w of
    the elements. B itself is wrong in the corners of the channels, where one element lies across
    the plate: its mean over sections 18 and 19, a plate's thickness apart, was 0.850 and 0.802 T.
    """
    problem, same = iron.problem, 1e-9
    strength = problem.field(iron.total)[..., 0]
    flux = (1 + problem.law(strength)[0])[..., None] * strength
    found = []
    for body, axis, place in SECTIONS:
        x, _, z = np.moveaxis(problem.places, 2, 0)
        beyond = (z >= place - same if axis == 2 else
                  (x <= place + same) & (z >= TOP - THICK - same))
        cut = np.flatnonzero((problem.body == body) & beyond.any(axis=1) & ~beyond.all(axis=1))
        slopes = np.einsum("eqai,ea->eqi", problem.slopes[cut], beyond[cut])
        found.append(np.einsum("eqi,eqi,eq->", flux[cut], slopes, problem.weights[cut]))
    return np.abs(found) / (0.05 * THICK)


def team13(note: Note) -> None:
    """Compare the mean flux density in the steel, and the field in the air, with measured ones."""
    def solve(current_A: float) -> tuple[Magnet, BodiesReaction]:
        magnet = build_magnet(parse_study(plates(2.9, current_A)))
        with tempfile.TemporaryDirectory() as folder:
            iron = solve_separate(magnet, Session(find_getdp(), Path(folder))).iron
        assert isinstance(iron, BodiesReaction)
        return magnet, iron

    _, iron = solve(1000.0)
    assert iron.coarse is not None
    memory = sum(resource.getrusage(whose).ru_maxrss for whose in (
        resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 2**20
    note("iron_any.memory_GiB", memory, "GiB",
         f"peak of process and GetDP for {len(iron.total)} unknowns")
    found, coarse, measured = mean_flux(iron), mean_flux(iron.coarse), np.array(MEASURED_T)
    common.say(f"{len(iron.total)} and {len(iron.coarse.total)} unknowns")
    change = found - coarse  # as of readings, see `BodiesReaction.field_with_errors`
    extrapolated = found + iron.coarse.to_come * change
    for number, row in enumerate(zip(measured, extrapolated, BAR[1] * np.abs(change), found,
                                     coarse, strict=True), start=1):
        common.say("{:2d}: measured {:.3f} T, computed {:.3f} T, bar {:.3f} T, on the mesh "
                   "{:.3f} T, on the coarser one {:.3f} T".format(number, *row))
    off = np.abs(extrapolated - measured)
    note("iron_any.team13", float(np.sqrt(np.mean(off**2))), "T",
         "rms difference of the mean flux density in 25 sections from the measured one, 1000 AT")
    note("iron_any.team13_largest", float(off.max()), "T", "the largest of them")
    magnet, iron = solve(3000.0)
    points = np.array([[x, 0.020, 0.055] for x, _ in MEASURED_IN_AIR])
    field, bars = iron.field_with_errors(points)
    strength = np.linalg.norm(field + external_field(magnet, points), axis=1)
    for (x, measured_T), computed, bar in zip(
            MEASURED_IN_AIR, strength, np.linalg.norm(bars, axis=1), strict=True):
        common.say(f"x = {1e3 * x:.0f} mm: measured {1e3 * measured_T:.2f} mT, computed "
                   f"{1e3 * computed:.2f} mT, bar {1e3 * bar:.2f} mT")
    ratio = strength / np.array([measured_T for _, measured_T in MEASURED_IN_AIR])
    note("iron_any.team13_air", float(np.mean(ratio)), "ratio",
         "mean of |B| over the measured one at 11 points in the air, 3000 AT")
