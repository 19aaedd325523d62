"""Readings count once: copies are refused, repeated measurements are not."""

from __future__ import annotations

import tomllib
import warnings

import numpy as np
import pytest

from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.campaign_readings import read_campaign
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.study.reader import parse_study

SIGMA = 1e-5
STUDY = f"""
name = "small"
dimension = 3
array = {{ free_blocks = {{ name = ["a"], shape = ["cuboid"], x_m = [0.1], y_m = [0.0], \
z_m = [0.0], \
size_x_m = [0.02], size_y_m = [0.02], size_z_m = [0.02], remanence_T = [1.3] }}, \
recoil_permeability = 1.0 }}
mesh = {{ block_size_m = 0.02, bore_size_m = 0.03 }}
observation = {{ quantity = "flux_density", positions = {{ kind = "points", \
points_m = [[0, 0, 0]] }} }}
[[noise.regions]]
name = "all"
sigma_T = {SIGMA}
"""
GRID = np.stack(np.meshgrid(*[np.linspace(-0.02, 0.02, 8)] * 2, np.linspace(-0.03, 0.03, 10),
                            indexing="ij"), axis=-1).reshape(-1, 3)
FIELD = np.column_stack([0.1 + 2 * GRID[:, 1], 2 * GRID[:, 0], 0 * GRID[:, 0]])


def study(*names):
    maps = "".join(f'[[maps]]\nname = "{name}"\nfile = "{name}.csv"\n' for name in names)
    return parse_study(tomllib.loads(STUDY + maps))


def read(generator, digits=9, sigma=SIGMA, field=FIELD):
    return np.round(field + sigma * generator.standard_normal(field.shape), digits)


def twice(first, second, points=GRID):
    """A map of all points, and again at later times."""
    return field_map(np.vstack([points, points]), np.vstack([first, second])).assign(
        time_s=("point", np.arange(2.0 * len(points))))


def test_rows_that_come_again_with_other_times(generator):
    first = read(generator)
    maps_of(study(), twice(first, read(generator)))  # measured again
    with pytest.raises(MeasurementError, match="640 of 1280 rows that are another row again"):
        maps_of(study(), twice(first, first))
    some = read(generator)
    some[:200] = first[:200]
    with pytest.raises(MeasurementError, match="200 of 1280"):
        maps_of(study(), twice(first, some))
    few = read(generator)
    few[:3] = first[:3]
    with pytest.warns(HalbachWarning, match="3 of 1280 rows .* Until then these count twice"):
        maps_of(study(), twice(first, few))
    single = np.where([True, False, False], first, np.nan)
    with pytest.raises(MeasurementError, match="digit for digit"):
        maps_of(study(), twice(single, single))


@pytest.mark.parametrize("digits", [4, 5])
@pytest.mark.parametrize("noise", [SIGMA, SIGMA / 10])
def test_few_digits_repeat_by_chance(generator, digits, noise):
    """Steps of 10 and 1 noises of a uniform field: all rows may be alike, and are measured."""
    uniform = np.broadcast_to([0.1, 0.0, 0.02], GRID.shape)
    first, second = (read(generator, digits, noise, uniform) for _ in range(2))
    assert (first == second).all(axis=1).mean() > 0.01
    maps_of(study(), twice(first, second))


def test_a_part_of_a_map_in_another_one(generator):
    """200 of 640 rows are less than the share at which rounded copies are refused."""
    first, second = read(generator), read(generator)
    data = {"one": field_map(GRID, first), "two": field_map(GRID, second)}
    maps_of(study("one", "two"), data)
    second[:200] = first[:200]
    copied = {**data, "two": field_map(GRID, second)}
    with pytest.raises(MeasurementError, match="200 of 640 rows"):
        maps_of(study("one", "two"), copied)
    second[8:200] += 1e-6
    second[7] += 1e-6
    with pytest.warns(HalbachWarning, match="7 of 640 rows.* Until then these count twice"):
        maps_of(study("one", "two"), {**data, "two": field_map(GRID, second)})


def test_a_copy_with_another_zero(generator):
    """An offset of half its noise made a copy count twice. Control: a map that was read again, with
    the same offset; its rows differ by the noise of both.
    """
    first, offset = read(generator), np.array([5e-6, -3e-6, 0.0])
    again = read(generator) + offset
    maps_of(study("one", "two"), {"one": field_map(GRID, first), "two": field_map(GRID, again)})
    for copy in (first + offset, first[::-1][:400] + offset):
        places = GRID if len(copy) == len(GRID) else GRID[::-1][:400]
        with pytest.raises(MeasurementError, match=f"in {len(copy)} of {len(copy)} rows, but for "
                           "an offset of 5\u00a0\u00b5T"):
            maps_of(study("one", "two"), {
                "one": field_map(GRID, first), "two": field_map(places, copy)})


@pytest.mark.parametrize("digits", [9, 7])
def test_a_copy_with_another_zero_within_one_file(generator, digits):
    """After a zero was taken off, values are as they are, or rounded once more. Controls: maps that
    were read again, with the same offset; also if the noise is a tenth of what is stated, and by a
    device of so few digits that all readings of a uniform field repeat, one step higher.
    """
    first, offset = read(generator, digits), np.array([5.3e-6, -3.1e-6, 0.0])
    for second in (first + offset, np.round(first + offset, digits)):
        with pytest.raises(MeasurementError, match=r"640 of 1280 rows that are another row again, "
                           r"but for an offset of 5\.\d?\u00a0\u00b5T"):
            maps_of(study(), twice(first, second))
    both = twice(first, read(generator))  # of which both are copied
    points, values = points_of(both), both["B_T"].values
    with pytest.raises(MeasurementError, match=r"1280 of 2560 rows .* offset"):
        maps_of(study(), field_map(
            np.vstack([points, points]), np.vstack([values, values + offset])))
    for noise in (SIGMA, SIGMA / 10):
        maps_of(study(), twice(*(read(generator, digits, noise) + zero for zero in (0, offset))))
    uniform = np.broadcast_to([0.1, 0.0, 0.02], GRID.shape)
    few = read(generator, 4, SIGMA / 10, uniform)
    maps_of(study(), twice(few, few + 1e-4))
    for visits in (1, 3, 9):
        rows = np.append(np.arange(len(GRID)), np.zeros(visits, int))
        maps_of(study(), field_map(GRID[rows], read(generator, digits, field=FIELD[rows])))


def test_a_field_along_z_in_two_dimensions_is_told(generator):
    """A 2D study has no Bz: 0.3 T of it were left out without a word."""
    flat = tomllib.loads(STUDY)
    flat["dimension"] = 2
    del flat["array"]["free_blocks"]["size_z_m"]
    flat["observation"]["components"] = ["x", "y"]
    magnet = build_magnet(parse_study(flat))
    points, where = np.unique(GRID * [1, 1, 0], axis=0, return_index=True)
    along, little = FIELD[where] + np.array([[0, 0, 0.3]]), FIELD[where] + np.array([[0, 0, 3e-3]])
    with pytest.warns(HalbachWarning, match=r"Bz up to 0\.3 T.* use a 3D study"):
        read_campaign(magnet, maps_of(magnet.study, field_map(points, along)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the Bz of a probe that is turned a little is no news
        read_campaign(magnet, maps_of(magnet.study, field_map(points, little)))
