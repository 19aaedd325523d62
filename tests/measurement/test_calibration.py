"""A map is corrected by the calibration of its probe; what is no calibration is refused."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import field_map, read_map, with_total_field
from halbach_fe.measurement.formats.import_export import HEADER, read_calibration

ERRORS = {"x": [0.3, -0.1, 0.2], "y": [0.0, 0.05, -0.4], "z": [0.1, 0.1, 0.1]}
FIELDS = [-1.5, 0.0, 1.5]


def table(path, fields=FIELDS, axes="xyz", header=None, factor=1.0):
    names = header or ",".join(f"B{axis} (T),%err B{axis}" for axis in axes)
    rows = [",".join(f"{factor * at},{ERRORS[axis][number]}" for axis in axes)
            for number, at in enumerate(fields)]
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def shown(field):
    """What sensors with these errors show of a field (n, 3): found here by iteration."""
    found = field.copy()
    for _ in range(30):
        error = np.column_stack([np.interp(found[:, number], FIELDS, ERRORS[axis])
                                 for number, axis in enumerate("xyz")]) / 100
        found = field * (1 + error)
    return found


@pytest.mark.parametrize("unit", ["T", "mT"])
def test_readings_are_corrected(tmp_path, generator, unit):
    """Control: uncorrected, they are up to 4 mT off."""
    field = generator.uniform(-1.45, 1.45, (50, 3))
    data = field_map(generator.uniform(-0.1, 0.1, (50, 3)), shown(field))
    path = table(tmp_path / "probe.csv", factor=1.0 if unit == "T" else 1e3,
                 header=HEADER.replace("(T)", f"({unit})"))
    corrected = read_calibration(path).corrected(data, "map.csv")
    np.testing.assert_allclose(corrected["B_T"].values, field, atol=1e-12)
    assert np.abs(data["B_T"].values - field).max() > 2e-3
    assert corrected.attrs["calibrated_by"] == "probe.csv"


@pytest.mark.parametrize(("digits", "own"), [(None, True), (5, True), (5, False), (None, False)])
def test_the_length_of_the_readings_is_corrected_with_them(tmp_path, generator, digits, own):
    """A meter writes |B| of what its sensors read, also in mT with two digits. What another probe
    has read, here NMR 0.1 % off that length and right, stays as it is.
    """
    field = generator.uniform(-0.8, 0.8, (50, 3))
    read = shown(field)
    total = np.linalg.norm(read if own else field, axis=1)
    if digits is not None:
        read, total = read.round(digits), total.round(digits)
    data = with_total_field(field_map(generator.uniform(-0.1, 0.1, (50, 3)), read), total)
    corrected = read_calibration(table(tmp_path / "probe.csv")).corrected(data, "map.csv")
    np.testing.assert_allclose(corrected["Babs_T"].values, np.linalg.norm(
        corrected["B_T"].values, axis=1) if own else total, rtol=1e-12)
    assert np.abs(np.linalg.norm(read, axis=1) - np.linalg.norm(field, axis=1)).max() > 1e-3


def test_the_command_corrects_before_it_writes(tmp_path, capsys):
    (tmp_path / "stage.csv").write_text(
        "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n0,0,0,0.75,-0.75,0.0\n1,0,0,1.5,1.5,1.5\n")
    probe = table(tmp_path / "probe.csv")
    assert main(["import-map", str(tmp_path / "stage.csv"), "-o", str(tmp_path / "map.csv"),
                 "--calibration", str(probe)]) == 0
    shown_text = capsys.readouterr().out
    assert "largest_correction_T" in shown_text
    assert "1.49701" in shown_text  # 1.5 / 1.002: the largest Bx that is written
    found = read_map(tmp_path / "map.csv")["B_T"].values
    np.testing.assert_allclose(
        found[0], [0.75 / 1.0005, -0.75 / 1.00025, 0.0], rtol=1e-12)
    np.testing.assert_allclose(found[1], [1.5 / 1.002, 1.5 / 0.996, 1.5 / 1.001], rtol=1e-12)


def test_errors_that_are_not_in_per_cent(tmp_path):
    path = table(tmp_path / "probe.csv")
    path.write_text(path.read_text().replace("-1.5,0.3", "-1.5,300"))
    with pytest.raises(MeasurementError, match=r"errors of Bx of probe\.csv must be at most 50 %"):
        read_calibration(path)


def test_computed_components_and_the_table_itself_are_kept(tmp_path, capsys):
    """Br and Bphi are not what sensors along x and y have read."""
    (tmp_path / "circle.csv").write_text("r[mm],phi[deg],z[mm],Br[T],Bphi[T]\n5,0,0,1,0\n")
    (tmp_path / "stage.csv").write_text("x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n0,0,0,1,0,0\n")
    probe = table(tmp_path / "probe.csv")
    before = probe.read_bytes()
    assert main(["import-map", str(tmp_path / "circle.csv"), "-o", str(tmp_path / "map.csv"),
                 "--calibration", str(probe)]) != 0
    assert "beside Br and Bphi" in capsys.readouterr().err
    assert not (tmp_path / "map.csv").exists()
    assert main(["import-map", str(tmp_path / "stage.csv"), "-o", str(probe),
                 "--calibration", str(probe)]) != 0
    assert probe.read_bytes() == before


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"axes": "xy"}, "columns of probe.csv must be those of every sensor"),
    ({"fields": [-1.0, 0.0, 1.0]}, "fields of Bx of probe.csv must be from -1.4 to 1.4 T"),
    ({"header": "Bx (T),%err Bx,By (T),%err By,Bz (T),remark"}, "one of a header like"),
    ({"header": "Bx (T),%err By,By (T),%err Bz,Bz (T),%err Bx "}, None),
    ({"header": "Bx (lb),%err Bx,By (T),%err By,Bz (T),%err Bz"}, "one of a header like"),
    ({"header": "Bx (T),%err Bx,Bx [T],%err By,Bz (T),%err Bz"}, "one field and one error for"),
    ({"fields": [-1.5, 1.5, 1.5]}, "two or more different values"),
    ({"fields": [-1.5, "?", 1.5]}, "finite number"),
])
def test_what_is_no_calibration_is_refused(tmp_path, changes, sentence):
    data = field_map(np.outer([0.0, 0.1], np.ones(3)), np.array([[-1.4] * 3, [1.4] * 3]))
    path = tmp_path / "probe.csv"
    if "?" in changes.get("fields", ()):
        table(path)
        path.write_text(path.read_text().replace("0.0,-0.1", "?,-0.1"))
    else:
        table(path, **changes)
    if sentence is None:  # columns may have any order
        read_calibration(path).corrected(data, "map.csv")
        return
    with pytest.raises(MeasurementError, match=sentence):
        read_calibration(path).corrected(data, "map.csv")
