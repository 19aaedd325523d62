"""The verbs on a magnet, as its study states it or as it was measured: solve, verify, field,
multipoles, homogeneity, forces, demagnetization, design, cad, plan, tolerance, sort, shim,
shim-tray.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial

import halbach_fe as hf
from halbach_fe.cli import common
from halbach_fe.cli.common import question, say
from halbach_fe.cli.shared_options import (
    BLOCKS,
    JSON,
    MAP,
    MULTIPOLES,
    OBJECTIVE,
    OUTPUT,
    POSTERIOR,
    REGION,
    SEED,
    SOLVED,
    STUDY,
    at_least,
    count,
    describes_a_format,
    dry_run,
    finite_number,
    flag,
    input_file,
    map_format,
    option,
    positive,
    positive_number,
    verb,
    whole,
    within,
)
from halbach_fe.core.errors import CommandLineError, StudyError, must_be
from halbach_fe.core.numbers import ACROSS, DENSITY, DRAWS, HIGHEST_DEGREE


@question(SOLVED, dry_run)
def solve(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Compute the field of a study's nominal magnet at the study's positions.

    Iron with an H(B) curve is solved by Newton's method. Writes field_map.h5, field_map.csv and
    field_map.vtu (for ParaView), readings.csv with the readings of the study, multipoles.csv if the
    study's positions are circles, report.html, and the run folders of GetDP, which can be run by
    hand.
    """
    from halbach_fe.core.progress import duration
    from halbach_fe.response.solution import study_observation
    from halbach_fe.solver.routes import choose_route
    from halbach_fe.solver.session import newton_history

    started = time.monotonic()
    many = len(magnet.blocks) > 10_000  # which take minutes: the command says how far it is
    if arguments.dry_run or (many and not magnet.is_vacuum):
        from halbach_fe.response.resource_estimate import TIME_FACTOR, estimate_solve

        cost = estimate_solve(magnet, study_observation(magnet), common.jobs(arguments))
        if arguments.dry_run:
            return common.print_estimate(cost, arguments.json)
        say(f"{cost.blocks} blocks that magnetize each other, or iron: about "
            f"{duration(cost.seconds)}, within a factor of {TIME_FACTOR:g}, and "
            f"{cost.memory_GiB:.2g} GiB. {cost.warning or ''}")
    elif many:
        say(f"{len(magnet.blocks)} blocks: first their field at the positions and far outside.")
    with common.session(arguments, magnet.study) as session:
        solution = hf.solve(magnet, session)
    seconds = round(time.monotonic() - started, 2)
    if many:
        say(f"Solved in {seconds} s; now its files and the page, which draws a part of the blocks.")
    from halbach_fe.report.page import page_of

    summary: dict[str, object] = {"seconds": seconds, "output": str(arguments.output)}
    if magnet.is_nonlinear and choose_route(magnet, solution.points) != "moments":
        summary["newton_residuals"] = newton_history(arguments.output)
    made = page_of(solution)
    return replace(made, summary={**made.summary, **summary},
                   provenance={**made.provenance, "solved in": f"{seconds} s"})


@question(SOLVED, dry_run)
def verify(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Estimate the error of a study's field: refinement, a farther boundary, the dual formulation.

    Solves the nominal array at the study's positions on two coarser meshes, the study's own and a
    finer one, with the boundary farther away, and by the dual formulation if the route has one.
    Writes verification.json, verification.csv (changes of the field at every point),
    verification.html and its figures.
    """
    from halbach_fe.response.resource_estimate import estimate_verify

    if arguments.dry_run:
        return common.print_estimate(estimate_verify(magnet, common.jobs(arguments)),
                                     arguments.json)
    exact = magnet.is_vacuum and magnet.study.solver.method != "direct"
    with common.session(arguments, magnet.study) as session:
        return hf.verify(magnet, session, say=lambda purpose: (
            None if exact else say(f"solving {purpose}")))


@question(
    SOLVED,
    *(option(f"--{end}-m", finite_number, ("X", "Y", "Z"),
             f"where the line goes {end}", nargs=3, required=True) for end in ("from", "to")),
    option("--count", partial(at_least, 3), "N", "number of points of a line (default: 201)",
           default=201),
    option("--across-m", within(finite_number, 0.0, 10.0), ("U", "V"),
           "half widths of a grid of parallel lines: of a line along z those along x and y",
           nargs=2, default=(0.0, 0.0)),
    option("--lines", positive, "N", "number of lines along each half width (default: 5)"),
    POSTERIOR, flag("--inside", "points may lie inside blocks and iron"))
def field(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Compute B and H on lines with error bars, their first and second integrals, and kick maps.

    The lines run from --from-m to --to-m, and beside it at the offsets of --across-m. With
    --posterior the bars are those of the measured magnet, otherwise those of the study's prior.
    With --inside points may lie inside blocks and iron. Writes field.csv, field_map.csv (B as a
    map, which halbach-fe export turns into other formats), integrals.csv, field.html and its
    figure, and for a grid of lines in air kick_map.txt in the text format of Radia, with kicks in
    T^2 m^2.
    """
    import numpy as np

    from halbach_fe.report.page import page_of

    fewest = 2  # along a half width
    if arguments.lines and (arguments.lines < fewest or not any(arguments.across_m)):
        raise StudyError(must_be("--lines", "the command line", "at least 2, beside --across-m, "
                                 "the half widths of the grid of lines", f"{arguments.lines}"
                                 + ("" if any(arguments.across_m) else " alone"),
                                 "Correct it, add --across-m U V, or leave it out."))
    offsets = [np.linspace(-half, half, arguments.lines or 5) if half else np.zeros(1)
               for half in arguments.across_m]
    lines = hf.Lines(np.array(arguments.from_m), np.array(arguments.to_m),
                     (offsets[0], offsets[1]), arguments.count)
    posterior = common.posterior_of(arguments, magnet)
    with common.session(arguments, magnet.study) as session:
        made = page_of(hf.field(magnet, lines, session, posterior, arguments.inside))
    return replace(made, summary={**made.summary, "folder": str(arguments.output)})


@question(SOLVED, POSTERIOR, MULTIPOLES)
def multipoles(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Compute the multipoles of a magnet, with their standard deviations.

    With --posterior they are those of the measured magnet, otherwise those that the study's prior
    predicts. A 3D magnet has two tables: of the field integrated along z, and of the circle at
    --at-z-m (default: the middle of the magnet). Writes multipoles.csv, multipoles.json,
    multipoles.html and its figures.
    """
    posterior = common.posterior_of(arguments, magnet)
    with common.session(arguments, magnet.study) as session:
        return replace(hf.multipoles(magnet, session, common.reference(arguments), posterior),
                       limit=arguments.limit_units)


@question(
    SOLVED, map_format("--measurements"), POSTERIOR,
    option("--measurements", input_file, "MAP",
           "measured map, whose own homogeneity is shown beside the magnet's"),
    REGION,
    option("--degrees", int, "L",
           f"largest degree of the spherical harmonics, 1 to {HIGHEST_DEGREE} (default: 6)",
           choices=range(1, HIGHEST_DEGREE + 1)))
def homogeneity(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Compute how homogeneous the field of a magnet is in a region, in ppm and with error bars.

    The region is a sphere, an ellipsoid or a cylinder: by default that of the study's table
    [homogeneity], or else the sphere about the centre of the magnet of half the radius of the bore.
    With --posterior the magnet is the measured one, otherwise those that the study's prior allows.
    With --measurements the homogeneity of the map itself is beside it, of a harmonic fit of its
    readings. Writes homogeneity.json, harmonics.csv if the region is a sphere, homogeneity.html and
    its figures.
    """
    from halbach_fe.response.region import SHOWN_DEGREES

    within_it = common.region_of(arguments, magnet)
    posterior = common.posterior_of(arguments, magnet)
    if not arguments.measurements and describes_a_format(arguments):
        raise CommandLineError(must_be(
            "options of the format", "the command line", "beside --measurements, whose map they "
            "describe", "given alone", "Add --measurements MAP, or leave them out."))
    if arguments.degrees and within_it is not None and within_it.shape != "sphere":
        raise CommandLineError(must_be(
            "--degrees", "the command line", "of a sphere, which alone has spherical harmonics",
            "beside another region", "Leave it out, or give --sphere-m."))
    data = (common.read_one(arguments, arguments.measurements, magnet.study)
            if arguments.measurements else None)
    with common.session(arguments, magnet.study) as session:
        return hf.homogeneity(magnet, session, within_it, posterior,
                              arguments.degrees or SHOWN_DEGREES, data)


def _density(text: str) -> float:
    """Parse a density in kg/m^3, or refuse one that no magnet has: 7.5 is one in g/cm^3."""
    try:
        return within(finite_number, *DENSITY)(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; 7.5 g/cm^3 are 7500 kg/m^3") from None


@question(
    SOLVED,
    option("--order", input_file, "CSV", "table whose column block names the blocks in the order "
           "in which they are inserted (default: ring by ring, slot by slot)"),
    option("--density-kg-per-m3", _density, "D",
           "density of the blocks (default: that of their grade, or 7500)"),
    option("--price-per-kg", positive_number, "P", "price of the blocks per kg, in any currency"))
def forces(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Compute forces and torques on every block, in place and while the magnet is assembled.

    Each block is looked at twice: with all others in place, and as the next one to be inserted,
    with the blocks before it in place (by default ring by ring, slot by slot). Writes forces.csv,
    forces.json, forces.html and its figure, with the mass of the magnet.
    """
    from halbach_fe.geometry.blocks import present_blocks
    from halbach_fe.measurement.block_table import read_order

    names = [block.name for block in present_blocks(magnet.blocks)]
    order = read_order(arguments.order, names) if arguments.order else None
    with common.session(arguments, magnet.study) as session:
        return hf.forces(magnet, session, order, arguments.density_kg_per_m3,
                         arguments.price_per_kg)


@question(SOLVED, option("--across", within(whole, *ACROSS), "N",
                         "cells across the thickness of a block (default: 6)"))
def demagnetization(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Map how near the blocks are to the knee of their demagnetization curve when they are hot.

    The study's table `demagnetization` states coercivity, coefficients and temperature of the
    material. Writes demagnetization.html and its figures, demagnetization.json, demagnetization.csv
    (a row per block) and demagnetization.vtu (cells, for ParaView).
    """
    with common.session(arguments, magnet.study) as session, common.progress_bar(
            "cells", told=True) as show:
        return hf.demagnetization(magnet, session, progress=show, **(
            {"across": arguments.across} if arguments.across else {}))


@verb(SOLVED, REGION, SEED)
def design(arguments: argparse.Namespace) -> int:
    """Search for the rings of a magnet whose field in a region is homogeneous.

    The rings to choose from (radii, layers, sizes of blocks), the least field and the largest mass
    are [design] of the study. Writes study.designed.toml, the study with the best rings, rings.csv,
    design.json, design.html with the designs of larger fields, and its figures.
    """
    from halbach_fe.design.ring_catalogue import about_origin

    study = hf.read_study(arguments.study)
    with common.session(arguments, study) as session:
        region = common.region_of(arguments, about_origin(study))
        found = hf.design_rings(study, session, region, arguments.seed)
    return common.finish(arguments, found)


@question(
    STUDY, OUTPUT,
    option("--blocks", input_file, "CSV", "table of measured blocks in their places, whose serial "
           "numbers name the blocks: the blocks.sorted.csv of halbach-fe sort"),
    JSON)
def cad(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Write the blocks and a holder for them as STEP and STL files, and the plan to assemble them.

    The holder consists of plates with a pocket for every block; [holder] of the study says how they
    are made. Writes blocks.step and blocks.stl, holder_NN.step and .stl for every different plate,
    magnet.step with everything in its place, assembly.csv, assembly.json and assembly.html, a sheet
    to print for every plate. Solids are in mm.
    """
    from halbach_fe.report.assembly_page import page

    blocks = common.blocks_of(arguments.blocks)
    common.own_folder(arguments, magnet.name)
    plan = hf.cad(magnet, blocks)
    with common.progress_bar("solids") as show:  # until its files are written
        return common.finish(arguments, page(plan, show))


@question(SOLVED, option("--points", positive, "N",
                         "number of positions to choose (default: the study's plan.points)"))
def plan(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Choose the positions whose readings carry most information about the block magnetizations.

    If the study has a table [homogeneity], they tell most about the deviation of |B| in its region.
    Positions are added one at a time from the study's plan.candidates (default: the positions that
    the study measures). Their information is compared with that of the study's positions. Writes
    plan.csv, plan.json, plan.html and its figures.
    """
    with common.session(arguments, magnet.study) as session:
        return hf.plan(magnet, session, arguments.points)


@question(
    SOLVED, BLOCKS, OBJECTIVE,
    option("--draws", within(whole, *DRAWS), "N",
           "number of magnets to draw (default: %(default)s)", default=10_000),
    SEED)
def tolerance(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Predict the multipoles, or the homogeneity, of magnets whose blocks are drawn from the prior.

    It is the homogeneity in the region of the study's table [homogeneity], if there is one. With a
    limit also the share of the magnets that meet it. Writes tolerance.json, tolerance.html and its
    figures.
    """
    blocks = common.blocks_of(arguments.blocks)
    with common.session(arguments, magnet.study) as session:
        return hf.tolerance(magnet, session, blocks, common.reference(arguments), arguments.draws,
                            arguments.limit_units, arguments.seed, arguments.limit_ppm)


@question(
    SOLVED,
    option("blocks", input_file, "BLOCKS",
           "table of measured blocks (CSV); ring and slot may be missing"),
    OBJECTIVE,
    flag("--turns", "turn blocks in their slots too, where shape and nominal magnetization allow "
         "it: cubes about their magnetization"),
    SEED)
def sort(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Assign measured blocks to slots: for small multipoles, or a homogeneous field.

    It is a homogeneous field if the study has a table [homogeneity] with its region.
    Blocks are sorted before the magnet is assembled. Each goes to a slot of its own type; the table
    may have more blocks than there are slots. Writes blocks.sorted.csv, sort.json, sort.html and
    its figures.
    """
    from halbach_fe.design.objective import check_objective

    table = hf.read_blocks(arguments.blocks)
    with common.session(arguments, magnet.study) as session, common.progress_bar("sorting") as show:
        check_objective(magnet, common.reference(arguments), arguments.limit_units,
                        arguments.limit_ppm)
        found = hf.sort(magnet, table, session, common.reference(arguments), arguments.seed, show,
                        arguments.turns)
    return replace(found, limit=arguments.limit_units or arguments.limit_ppm)


@question(
    SOLVED, map_format("--measurements"), MAP, BLOCKS, OBJECTIVE,
    option("--swaps", count, "N", "largest number of swaps of two blocks (default: %(default)s)",
           default=8),
    option("--cycles", count, "N",
           "largest number of cyclic exchanges of three blocks (default: %(default)s)", default=0),
    option("--turns", count, "N",
           "largest number of blocks turned in their slots (default: %(default)s)", default=8),
    option("--replace", count, "N", "largest number of blocks replaced by blocks of the stock, or "
           "without --stock by new ones (default: %(default)s)", default=0),
    option("--stock", input_file, "CSV", "table of measured blocks that may replace others: blocks "
           "that are not in the magnet, without ring and slot"),
    SEED)
def shim(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Choose blocks to swap, turn or replace: for small multipoles, or a homogeneous field.

    It is a homogeneous field if the study has a table [homogeneity] with its region. The moves are
    chosen from the posterior of the block magnetizations, which is computed as by `halbach-fe
    infer`. Writes shim.json, shim.html and its figures, and study.shimmed.toml, the study with the
    blocks in their new places.
    """
    from halbach_fe.design.objective import check_objective
    from halbach_fe.design.shimming import check_shimming, check_stock
    from halbach_fe.measurement.campaign_maps import refuse_several_maps

    if arguments.stock and not arguments.replace:
        raise StudyError("Input --stock must go with --replace N, the number of blocks that may be "
                         "replaced; instead --replace is missing. Add --replace.")
    check_shimming(magnet.study)
    refuse_several_maps(magnet.study, "shim")
    data = common.read_one(arguments, arguments.measurements, magnet.study)
    blocks, stock = map(common.blocks_of, (arguments.blocks, arguments.stock))
    # refuse before the solves, which may take long, what does not fit the study
    check_objective(magnet, common.reference(arguments), arguments.limit_units,
                    arguments.limit_ppm)
    if stock:
        check_stock(magnet, stock, blocks.serial if blocks else None)
    with common.session(arguments, magnet.study) as session:
        result = hf.infer(magnet, data, session, blocks)
        moves = hf.shim(result, session, common.reference(arguments), arguments.swaps,
                        arguments.turns, arguments.replace, arguments.limit_units, stock,
                        arguments.seed, arguments.limit_ppm, arguments.cycles)
    if result.disagreement:
        say(f"warning: Model and measurement disagree. {result.disagreement}")
    return moves


@question(
    SOLVED,
    option("--posterior", input_file, "H5",
           "posterior.h5 that halbach-fe infer wrote for this magnet", required=True),
    REGION)
def shim_tray(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Choose small magnets for the places of a shim tray so that the field becomes homogeneous.

    The tray and its inventory are [shim_tray] of the study; the magnet is the measured one, whose
    posterior halbach-fe infer wrote. Writes shim_tray.csv, the table to fill the tray from,
    shim_tray.json, shim_tray.html and its figures, and study.filled.toml, the study with the
    magnets of the tray as free blocks.
    """
    from halbach_fe.inference.posterior_files import read_posterior

    within_it = common.region_of(arguments, magnet)
    stored = read_posterior(magnet, arguments.posterior)
    with common.session(arguments, magnet.study) as session:
        return replace(hf.shim_tray(magnet, session, stored["posterior"], within_it),
                       disagreement=stored.disagreement)
