"""Files of other programs and instruments read rightly, or are refused with advice that works."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.files import import_map
from tests.measurement.foreign_files import FIELD, FILES, POINTS, Foreign, mm_T, table

ROUNDED = 2e-6
"""Largest error in T: FLUKA's fixed columns and MATLAB's text hold four to eight digits, all others
nine or more."""


def ordered(points, field):
    order = np.lexsort(np.round(np.hstack([points, np.nan_to_num(field)]), 9).T)
    return points[order], field[order]


def same(data, points=POINTS, field=FIELD):
    found = points_of(data), data["B_T"].values
    return len(found[0]) == len(points) and all(
        np.allclose(one, other, rtol=0, atol=limit, equal_nan=True)
        for one, other, limit in zip(ordered(*found), ordered(points, field), (1e-8, ROUNDED),
                                     strict=True))


@pytest.mark.parametrize("case", FILES, ids=lambda case: case.name)
def test_what_people_have(tmp_path, case: Foreign):
    """Negative control: the same field with exchanged components is another."""
    path, positions = tmp_path / "file.txt", tmp_path / "positions.csv"
    path.write_bytes(case.text if isinstance(case.text, bytes) else case.text.encode())
    positions.write_text("x[mm],y[mm],z[mm]\n" + table(",", mm_T()[:3]))
    stated = dict(case.stated)
    if stated.pop("positions", False):
        stated["positions"] = positions
    if stated:
        with pytest.raises(MeasurementError) as caught:
            import_map(path, DeclaredFormat())
        for asked in case.asked:
            assert asked in str(caught.value)
    found = import_map(path, DeclaredFormat(**stated)).data
    assert same(found, case.points, case.field)
    assert not same(found, case.points, case.field[:, ::-1])


def test_number_of_files():
    assert len({case.name for case in FILES}) == len(FILES) > 60


def test_a_line_of_counts_that_does_not_count(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("3 3 4\n" + table(" "))
    with pytest.raises(MeasurementError, match="--skip-lines 1"):
        import_map(path, DeclaredFormat(columns=("x", "y", "z", "Bx", "By", "Bz"),
                                        length_unit="mm", field_unit="T"))


def test_a_centre_in_a_comment_says_how_to_use_it(tmp_path):
    path = tmp_path / "file.txt"
    lab = mm_T()
    path.write_text("# magnet center in lab: x 100.00 mm, y 200.00 mm, z -50.00 mm\n"
                    "# X[mm],Y[mm],Z[mm],B0_x[T],B0_y[T],B0_z[T]\n" + table(",", [
                        lab[0] + 100, lab[1] + 200, lab[2] - 50, *lab[3:]]))
    found = import_map(path, DeclaredFormat())
    assert "--origin-m=-0.1,-0.2,0.05," in found.imported.remarks[0]
    assert not same(found.data)
    assert same(import_map(path, DeclaredFormat(origin_m=(-0.1, -0.2, 0.05))).data)


def test_the_header_is_overridden_and_that_is_said(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("x[cm],y[cm],z[cm],By[mT],Bx[mT],Bz[mT]\n" + table(","))
    found = import_map(path, DeclaredFormat(columns=(
        "x[mm]", "y[mm]", "z[mm]", "Bx[T]", "By[T]", "Bz[T]")))
    assert same(found.data)
    assert len(found.imported.remarks) == 6
    with pytest.raises(MeasurementError, match="cm in the file and --length-unit mm"):
        import_map(path, DeclaredFormat(length_unit="mm"))


def test_positions_of_another_length(tmp_path):
    path, positions = tmp_path / "file.txt", tmp_path / "positions.csv"
    path.write_text("Bx[T],By[T],Bz[T]\n" + table(",", FIELD.T))
    for text, asked in (("x[mm],y[mm],z[mm]\n0,0,0\n", "45 rows"),
                        ("x,y,z\n0,0,0\n", "their units")):
        positions.write_text(text)
        with pytest.raises(MeasurementError, match=asked):
            import_map(path, DeclaredFormat(positions=positions))
