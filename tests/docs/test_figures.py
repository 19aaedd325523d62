"""Figures that README and docs quote are those of benchmarks/results.json."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
RESULTS = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))

QUOTED = {
    ("README.md", "FASER dipole with an iron tube, 576"): (
        "response.seconds", "response.memory_GiB"),
    ("README.md", "its difference to NGSolve"): ("response.error_against_ngsolve",),
    ("README.md", "its time relative to magpylib"): ("response.time_over_magpylib",),
    ("README.md", "effects hidden in magnets of ten"): (
        "diagnosis.naming_rate_single", "diagnosis.naming_rate_pairs",
        "diagnosis.false_alarm_rate"),
    ("docs/accuracy.md", "response matrix computed from scratch"): (
        "response.seconds", "response.memory_GiB"),
    ("docs/accuracy.md", "error of the full array at every point"): ("response.error_pointwise",),
    ("docs/accuracy.md", "the same error in the Fourier coefficients"): ("response.error_fourier",),
    ("docs/accuracy.md", "difference to NGSolve (curl-curl"): ("response.error_against_ngsolve",),
    ("docs/accuracy.md", "error of the matrix for block errors"): ("response.matrix_error",),
    ("docs/accuracy.md", "one GetDP process per column"): (
        "response.speedup_vs_process_per_column",),
    ("docs/accuracy.md", "time relative to magpylib for the same"): (
        "response.time_over_magpylib",),
    ("docs/accuracy.md", "time relative to NGSolve (scalar"): ("response.time_over_ngsolve",),
    ("docs/accuracy.md", "time relative to NGSolve for a single"): (
        "response.time_over_ngsolve_one_column",),
    ("docs/accuracy.md", "on a 3D mesh (2 rings of trapezoids)"): ("response.symmetry_speedup",),
    ("docs/accuracy.md", "change of the result by the symmetry"): ("response.symmetry_difference",),
    ("docs/accuracy.md", "GetDP looping in one process"): ("nonlinear.speedup_vs_getdp_loop",),
    ("docs/accuracy.md", "a fresh GetDP process per solve"): ("nonlinear.speedup_vs_process",),
    ("docs/accuracy.md", "18 000 solves to 1e-9 T"): ("nonlinear.seconds_18000",),
    ("docs/accuracy.md", "all 32 columns of the Jacobian"): ("nonlinear.jacobian_over_newton",),
    ("docs/accuracy.md", "largest difference to GetDP's Newton"): ("nonlinear.engine_error_T",),
    ("docs/accuracy.md", "sphere of permeability 1000"): ("iron_any.error_sphere",),
    ("docs/accuracy.md", "four cubes between two plates"): ("iron_any.error_plates",),
    ("docs/accuracy.md", "quadrupole of four poles"): ("iron_any.error_quadrupole",),
    ("docs/accuracy.md", "longest, for five cubes"): ("iron_any.time_over_ngsolve",),
    ("docs/accuracy.md", "five cubes on a plate"): ("iron_any.error_back_plate",),
    ("docs/accuracy.md", "two blocks on the arms of a C"): ("iron_any.error_c_yoke",),
    ("docs/accuracy.md", "hybrid undulator of three periods"): ("iron_any.error_undulator",),
    ("docs/accuracy.md", "processor time |"): ("iron_any.columns_time_over_field",),
    ("docs/accuracy.md", "memory of process and GetDP at most"): ("iron_any.memory_GiB",),
    ("docs/accuracy.md", "nominal magnet after registration"): (
        "real.nominal_mT", "real_mri.nominal_mT"),
    ("docs/accuracy.md", "chi² of the update per reading"): (
        "real.heldout_chi2", "real.second_map_heldout_chi2", "real_mri.heldout_chi2"),
}
"""Names of the results by page and beginning of a table's row, in the order of its numbers."""

NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\d)")


def wrong_figures(text: str, row: str, names: tuple[str, ...]) -> list[str]:
    """Return what is wrong with the figures in the row of a page that begins with some words.

    A figure is right if the result differs by at most half a unit of its last digit.
    """
    cells, = [line.split("|")[2:-1] for line in text.splitlines() if line.startswith(f"| {row}")]
    quoted = NUMBER.findall(re.sub(r"\[.*?\]\(.*?\)", "", "|".join(cells)))
    wrong = [] if len(quoted) == len(names) else [f"{quoted} for {names}"]
    for number, name in zip(quoted, names, strict=False):
        mantissa, _, exponent = number.partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        value = RESULTS[name]["value"]
        if not abs(value - float(number)) <= 0.5001 * unit:
            wrong.append(f"{name} is {value}, and quoted as {number}")
    return wrong


@pytest.mark.parametrize(("page", "row"), QUOTED, ids=[" ".join(key) for key in QUOTED])
def test_figures_are_the_measured_ones(page, row):
    assert not wrong_figures((ROOT / page).read_text(encoding="utf-8"), row, QUOTED[page, row])


def test_another_figure_is_seen():
    """Negative control: a figure that differs in its last digit, and one that is missing."""
    name, = names = ("response.error_pointwise",)
    value = RESULTS[name]["value"]
    assert not wrong_figures(f"| error | {value:.1e} of the field |", "error", names)
    assert wrong_figures(f"| error | {1.05 * value:.1e} |", "error", names)
    assert wrong_figures("| error | small |", "error", names)
