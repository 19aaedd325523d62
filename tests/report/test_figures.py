"""Figures and tables that fit what is shown: nothing is drawn where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import halbach_fe as hf
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.report.magnet_view_3d import colours_in_words, view_of_inference
from halbach_fe.report.page import begin_at_zero, write_report
from halbach_fe.report.prior_page import type_table
from halbach_fe.report.solution_page import field_figure
from halbach_fe.solver.session import Session
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import DIPOLE, changed, parse_study
from tests.report.test_answers import MAGNET

NOISE = {"regions": [{"name": "bore", "sigma_T": 1e-5}]}
PLAIN = changed(DIPOLE, array__recoil_permeability=1.0, noise=NOISE)
FOURIER = changed(PLAIN, observation__quantity="fourier_coefficients", observation__harmonics=5)


@pytest.mark.parametrize(("document", "label", "places"), [
    (FOURIER, "harmonic", {1, 2, 3, 4, 5}),
    (PLAIN, "angle in degrees", set(range(0, 360, 15)))])
def test_error_bars_are_drawn_where_the_readings_are(document, label, places, tmp_path):
    found = hf.solve(hf.build_magnet(parse_study(document)), Session.open(tmp_path))
    found = replace(found, errors=np.full(len(found.readings), 1e-6))
    top, bottom = field_figure(found).axes
    assert bottom.get_xlabel() == label
    assert set(bottom.lines[0].get_xdata().round(6)) == places
    assert ("angle in degrees" in (top.get_xlabel(), bottom.get_xlabel()))
    alone, = field_figure(replace(found, errors=0 * found.errors)).axes  # of an exact field
    assert alone.get_xlabel() == "angle in degrees"


@pytest.mark.parametrize(("document", "points"), [(FOURIER, False), (PLAIN, True)])
def test_fourier_coefficients_are_at_no_point(document, points, tmp_path):
    study = parse_study(document)
    map_ = simulate_campaign(study, 1).readings
    found = hf.infer(hf.build_magnet(study), map_, Session.open(tmp_path))
    assert ("measured points" in colours_in_words(found)) == points
    assert ('"measured points"' in view_of_inference(found)) == points


@pytest.mark.parametrize(("values", "zero"), [([1.0, 9.0], True), ([99.0, 100.0], False)])
def test_axes_begin_at_zero_unless_that_hides_the_differences(values, zero):
    axis = Figure().subplots()
    axis.plot(values, [0, 1])
    begin_at_zero(axis)
    assert (axis.get_xlim()[0] == 0) == zero
    assert axis.get_xlim()[1] > values[1]


@pytest.mark.filterwarnings("ignore:Every block of study:halbach_fe.core.errors.HalbachWarning")
@pytest.mark.parametrize(("types", "drawn"), [({}, False), ({"all": list(range(1, 9))}, True)])
def test_random_orders_are_drawn_if_there_are_any(types, drawn, tmp_path):
    study = parse_study(changed(MAGNET, array__rings=1, array__ring_gap_m=0.0, prior__types=types))
    magnet, blocks = hf.build_magnet(study), simulate_campaign(study, 2).blocks
    write_report(hf.sort(magnet, blocks, Session.open(tmp_path)), tmp_path / "sorted")
    assert (tmp_path / "sorted" / "sort_orders.png").exists() == drawn
    rows = type_table(prior_from_blocks(magnet, blocks))
    assert ("p along" in rows[0]) == drawn  # single blocks of a type have no distribution
