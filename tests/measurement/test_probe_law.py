"""A map as the study says that it is to be read."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import field_map, points_of, read_map
from halbach_fe.measurement.probe_law import in_si_and_magnet_axes
from halbach_fe.study.measurement_keys import Instrument

HEADER = "x_m,y_m,z_m,Bx_T,By_T,Bz_T\n"


def right_map(generator):
    """Any map, of which a component was not read at one point."""
    field = generator.standard_normal((5, 3))
    field[2, 1] = np.nan
    data = field_map(generator.standard_normal((5, 3)), field, np.full((5, 3), 1e-4) * [1, 2, 3],
                     {"probe": "Hall"})
    return data.assign(time_s=("point", np.arange(5.0)))


def test_units_and_axes_are_put_right(generator):
    """Columns written in mm and mT, in another order and with other signs."""
    right = right_map(generator)
    x, y, z = points_of(right).T
    shown = right["B_T"].values
    written = field_map(
        1e3 * np.column_stack([z, x, -y]), 1e3 * np.column_stack([-shown[:, 1], shown[:, 0],
                                                                  shown[:, 2]]),
        1e3 * right["sigma_T"].values[:, [1, 0, 2]], right.attrs)
    written = written.assign(time_s=right["time_s"])
    instrument = Instrument(length_unit_m=1e-3, flux_density_unit_T=1e-3,
                            position_axes=("z", "x", "-y"), field_axes=("-y", "x", "z"))
    xr.testing.assert_allclose(in_si_and_magnet_axes(instrument, written), right, rtol=1e-14)
    # the negative control: one sign less
    wrong = instrument.with_(field_axes=("y", "x", "z"))
    with pytest.raises(AssertionError):
        xr.testing.assert_allclose(in_si_and_magnet_axes(wrong, written), right, rtol=0.5)


def test_a_right_map_stays_as_it_is(generator):
    right = right_map(generator)
    xr.testing.assert_identical(in_si_and_magnet_axes(Instrument(), right), right)


@pytest.mark.parametrize(("row", "said", "unit"), [
    ("0,0,775,1,1,1", "length_unit_m = 0.001", {"length_unit_m": 1e-3}),
    ("0,0,0,570,1,1", "flux_density_unit_T = 0.001", {"flux_density_unit_T": 1e-3}),
    ("0,0,0,5700,1,1", "flux_density_unit_T = 0.0001", {"flux_density_unit_T": 1e-4})])
def test_a_map_in_another_unit_is_refused(tmp_path, row, said, unit):
    """As long as the study does not say so."""
    path = tmp_path / "map.csv"
    path.write_text(HEADER + row + "\n", encoding="utf-8")
    data = read_map(path)
    with pytest.raises(MeasurementError, match=said) as caught:
        in_si_and_magnet_axes(Instrument(), data)
    assert str(path) in str(caught.value)
    in_si_and_magnet_axes(Instrument(**unit), data)


@pytest.mark.parametrize(("row", "right"), [("0,0,0,0.57,1,1", 1.0), ("0,0,0,570,1,1", 1e-3)])
def test_a_unit_the_wrong_way_round(tmp_path, row, right):
    """1000 for 0.001: the map in T was said to be in mT, and 0.001 would have made it nothing."""
    path = tmp_path / "map.csv"
    path.write_text(HEADER + row + "\n", encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"flux_density_unit_T.* instead received 1000, with "
                       r"which the map has .* Write 0.001, or leave it out if the map is in T"):
        in_si_and_magnet_axes(Instrument(flux_density_unit_T=1000.0), read_map(path))
    in_si_and_magnet_axes(Instrument(flux_density_unit_T=right), read_map(path))
