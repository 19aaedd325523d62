"""All verbs of the command line, how one is run, and those about the installation: its cache, its
programs, the keys of studies.

Verbs on maps and tables of measurements are in `halbach_fe.cli.measurement_verbs`, those that
compute or design a magnet in `halbach_fe.cli.magnet_verbs`, those that convert files in
`halbach_fe.cli.file_verbs`.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import shtab

import halbach_fe as hf
from halbach_fe.cli import common, file_verbs, magnet_verbs, measurement_verbs
from halbach_fe.cli.process import show
from halbach_fe.cli.shared_options import CACHE_HELP, GETDP, JSON, choice, option, path, verb
from halbach_fe.cli.shared_options import VERBS as VERBS
from halbach_fe.cli.shared_options import parser as parser
from halbach_fe.core.errors import CheckFailedError, GetDPNotFoundError
from halbach_fe.core.installation import version

if TYPE_CHECKING:
    from halbach_fe.solver.getdp import GetDP

DECLARING = (magnet_verbs, measurement_verbs, file_verbs)
"""Modules that declare the other verbs."""

LISTS = ("--columns", "--origin-m", "--axes")
"""Options whose values are lists that may begin with a minus."""


def with_values(words: Sequence[str]) -> list[str]:
    """Join options whose values may begin with a minus to these values, as in ``--columns=-,x``.

    The parser would take such a value for an option.
    """
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in LISTS and word.startswith("-") and "," in word:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def run(words: Sequence[str]) -> int:
    """Run the verb of a command line; return its exit code."""
    words = with_values(words)
    arguments = parser([word for word in words if word in VERBS][:1]).parse_args(words)
    return common.with_folder(VERBS[arguments.verb].run, arguments)


PACKAGES = ("gmsh", "numpy", "scipy", "meshio", "h5py", "h5netcdf", "xarray", "pydantic", "jinja2",
            "matplotlib", "arviz", "rich")
TOLERANCE = {"direct": 5e-3, "reaction": 5e-4}
"""Largest accepted error of each method, relative to the bore field, on the coarse mesh used here.
The actual errors are 1.5e-3 and 2e-5."""

REFERENCE_BLAS = "blas"
"""Name of the folder in which Debian has the reference BLAS. Other implementations are in folders
such as openblas-pthread or blis-openmp."""


@verb(
    option("what", str, "{ls,clear}", "list the entries, or remove all of them",
           choices=("ls", "clear")),
    option("--cache", path, "DIR",
           f"folder of the cache {CACHE_HELP}"), JSON)
def cache(arguments: argparse.Namespace) -> int:
    """List the cache of GetDP's answers, or clear it.

    Every answer of GetDP is kept in the cache together with a digest of all inputs on which it
    depends. A run with the same inputs reads the answer from the cache instead of solving again.
    The folder is --cache, or $HALBACH_FE_CACHE, or ~/.cache/halbach-fe. It grows to
    $HALBACH_FE_CACHE_LIMIT_GIB (default: 20 GiB; 0 switches the cache off); then the entries that
    were not used for the longest time are removed.
    """
    from halbach_fe.solver.getdp_cache import default_cache

    most_rows = 30  # of the table, which lists the entries that were used last
    cache = default_cache(arguments.cache)
    if cache is None:
        common.say("There is no cache: its limit is 0, or there is no home folder.")
        if arguments.json:
            common.print_json({"folder": None, "limit_bytes": 0, "bytes": 0, "entries": []})
        return 0
    entries = cache.entries()
    if arguments.what == "clear":
        cache.clear()
        common.say(f"Removed {len(entries)} entries from {cache.folder}.")
        return 0
    total = sum(entry.bytes for entry in entries)
    if arguments.json:
        common.print_json({
            "folder": str(cache.folder), "limit_bytes": int(cache.limit_bytes), "bytes": total,
            "entries": [{
                "name": entry.folder.name, "bytes": entry.bytes,
                "used": datetime.fromtimestamp(entry.used).isoformat(timespec="seconds"),
                **({} if (manifest := entry.manifest) is None
                   else manifest.model_dump(exclude={"files"})),
            } for entry in entries]})
        return 0
    common.print_table([{
        "used": datetime.fromtimestamp(entry.used).isoformat(" ", "seconds"),
        "problem": manifest.problem if (manifest := entry.manifest) else "damaged",
        "unknowns": str(manifest.unknowns or "") if manifest else "",
        "solves": str(manifest.solves) if manifest else "",
        "MiB": f"{entry.bytes / 2**20:.1f}"} for entry in entries[:most_rows]],
        "Most recently used")
    common.say(f"{len(entries)} entries, {total / 2**30:.2f} of {cache.limit_bytes / 2**30:g} GiB, "
               f"in {cache.folder}")
    return 0


@verb(GETDP, JSON)
def doctor(arguments: argparse.Namespace) -> int:
    """Check this installation: versions, GetDP's build, a short solve against a closed form."""
    from halbach_fe.solver.getdp import blas_of, find_getdp

    findings: dict[str, object] = {
        "halbach-fe": version("halbach-fe"), "python": platform.python_version(),
        "system": platform.platform(), **{name: version(name) for name in PACKAGES}}
    try:
        getdp = find_getdp(arguments.getdp)
    except GetDPNotFoundError:
        _show(findings | {"getdp": "not found"}, arguments.json)
        raise
    findings |= {"getdp": f"{getdp.version} ({getdp.executable})", "petsc": getdp.petsc,
                 "getdp build": " ".join(getdp.build_options)}
    blas = blas_of(getdp)
    findings |= {} if blas is None else {"getdp blas": str(blas)}
    errors = {method: solve_error(getdp, method) for method in TOLERANCE}
    findings |= {f"2D {method} solve, error": f"{error:.1e} of the bore field"
                 for method, error in errors.items()}
    extra = {"errors": errors, "tolerances": TOLERANCE} if arguments.json else {}
    _show(findings | extra, arguments.json)
    if blas is not None and blas.parent.name == REFERENCE_BLAS:
        common.say("warning: GetDP uses the reference BLAS, with which it factorizes 3D meshes "
                   "four to five times slower than with OpenBLAS (Debian, Ubuntu: `apt-get install "
                   "libopenblas0-pthread`).")
    for method, error in errors.items():
        if not error <= TOLERANCE[method]:
            raise CheckFailedError(
                f"The {method} solve differs from the closed form by {error:.1e} of the bore "
                f"field, where {TOLERANCE[method]:.0e} is allowed. Reinstall GetDP.")
    return 0


def _show(findings: Mapping[str, object], as_json: bool) -> None:
    """Print the findings as JSON or as a table."""
    if as_json:
        common.print_json(findings)
    else:
        common.print_table([{"item": key, "value": str(value)}
                            for key, value in findings.items()])


def solve_error(getdp: GetDP, method: str) -> float:
    """Return the error of a 2D solve of a dipole with an iron ring, relative to its bore field."""
    import numpy as np

    from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
    from halbach_fe.solver.routes import solve_nominal
    from halbach_fe.study.reader import parse_study

    inner, outer, mu, iron = 0.1, 0.18, 1.05, (0.19, 0.21, 500.0)
    study = parse_study({
        "name": "doctor", "dimension": 2, "solver": {"method": method},
        "array": {"blocks_per_ring": 16, "inner_radius_m": inner, "outer_radius_m": outer,
                  "remanence_T": 1.0, "recoil_permeability": mu, "block": {"shape": "sector"}},
        "iron_ring": {"inner_radius_m": iron[0], "outer_radius_m": iron[1],
                      "relative_permeability": iron[2]},
        "mesh": {"block_size_m": 0.012},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "circles", "radius_m": 0.07, "angles": 12}}})
    angle = np.radians(7 + 30.0 * np.arange(12))  # not on the lines of symmetry of the mesh
    points = 0.07 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    exact = layered_bore_field(ideal_sectors(1, 16, 1.0), inner, outer, mu, points[:, :2], iron)
    with tempfile.TemporaryDirectory() as folder:
        field = solve_nominal(hf.build_magnet(study), points,
                              hf.Session(getdp, Path(folder)))[:, :2]
    return float(np.abs(field - exact).max() / np.abs(exact).max())


@verb()
def schema(arguments: argparse.Namespace) -> int:
    """Print the JSON schema of the study file."""
    common.print_json(hf.Study.model_json_schema())
    return 0


@verb(choice("shell", ("bash", "zsh", "tcsh"), "shell for which the script is printed"))
def completion(arguments: argparse.Namespace) -> int:
    """Print a script that completes halbach-fe's commands and options in a shell.

    For bash:

        halbach-fe completion bash > ~/.local/share/bash-completion/completions/halbach-fe
    """
    show(shtab.complete(parser(), shell=arguments.shell) + "\n")
    return 0
