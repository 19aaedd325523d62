"""The table of measured blocks: it reads back equal, and what cannot be one is refused by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError, OutputError
from halbach_fe.measurement.block_table import COLUMNS, BlockTable, read_blocks, write_blocks

HEADER = ",".join(COLUMNS)
ROWS = ["A1,1,1,1,300.5,-2,0.1,0.3,3.5e-4,21.5", "A2,2,1,2,1,299,0.2,0.3,,"]


def table(**changes):
    values = {
        "serial": ("A1", "B,2", "C3"), "type": ("1", "2", "2"), "ring": np.array([1, 1, 0]),
        "slot": np.array([1, 2, 0]), "moment": np.array([[1.0, 0, 0.1], [0, 1, 0], [0, 0.3, 1]]),
        "sigma": np.array([1e-3, 2e-3, 1 / 3e3]), "volume": np.array([1e-4, np.nan, 1 / 3e4]),
        "temperature": np.array([np.nan, 20.0, 21.0]), "attributes": {"coil": "no. 7"}}
    return BlockTable(**values | changes)


def written(tmp_path, *rows, header=HEADER):
    path = tmp_path / "blocks.csv"
    path.write_text("\n".join(["# coil: no. 7", header, *rows]) + "\n")
    return path


def test_lists_are_taken():
    table = BlockTable(serial=["a", "b"], type=["", ""], ring=[1, 1], slot=[1, 2],
                       moment=[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], sigma=[1e-4, 1e-4],
                       volume=[1e-6, 1e-6], temperature=[20.0, 20.0])
    assert table.places == [(1, 1), (1, 2)]
    assert table.moment.shape == (2, 3)


def test_round_trip(tmp_path):
    """Every bit, empty cells and a serial with a comma included; nothing else is left."""
    path = tmp_path / "blocks.csv"
    write_blocks(table(), path)
    found = read_blocks(path)
    for name, value in vars(table()).items():
        if name != "source":
            assert np.array_equal(getattr(found, name), value) or np.array_equal(
                getattr(found, name), value, equal_nan=True)
    assert [one.name for one in tmp_path.iterdir()] == ["blocks.csv"]
    turned = table(turn_deg=np.array([[0.0, 0, 0], [90, 0, 0], [0, 0, -180]]))
    write_blocks(turned, path)
    assert np.array_equal(read_blocks(path).turn_deg, turned.turn_deg)
    with pytest.raises(MeasurementError, match="turn_deg of block A1"):
        table(turn_deg=np.full((3, 3), np.nan))
    changed = table(moment=np.nextafter(table().moment, 2))  # the comparison sees the last bit
    write_blocks(changed, path)
    assert not np.array_equal(read_blocks(path).moment, table().moment)


@pytest.mark.parametrize(("separator", "name"), [(";", "semicolons"), ("\t", "tabs")])
def test_other_separators(tmp_path, separator, name):
    path = written(tmp_path, *(row.replace(",", separator).replace(".", ",") for row in ROWS),
                   header=HEADER.replace(",", separator))
    with pytest.raises(MeasurementError, match=f"{name} separate. Separate columns by commas, and"):
        read_blocks(path)


def test_any_order_and_optional_columns(tmp_path):
    path = written(tmp_path, "0.1,A1,5,1,2,3", header="sigma_A_m2,serial,type,mz_A_m2,my_A_m2,"
                   "mx_A_m2")
    found = read_blocks(path)
    assert found.moment.tolist() == [[3, 2, 1]]
    assert found.places == [(0, 0)]
    assert np.isnan(found.volume).all()
    assert found.attributes == {"coil": "no. 7"}
    assert read_blocks(written(tmp_path, *ROWS)).temperature[0] == 21.5


@pytest.mark.parametrize(("edit", "said"), [
    (("A1,1,1,1,300.5", "A1,1,1,1,many"), "mx_A_m2 in line 3 of block table .* finite number"),
    (("300.5", "nan"), "mx_A_m2 in line 3"), (("300.5", "inf"), "mx_A_m2 in line 3"),
    (("300.5", ""), "mx_A_m2 in line 3"),
    ((",0.3,3.5e-4", ",0,3.5e-4"), "sigma_A_m2 of block A1 .* positive; instead received 0"),
    ((",0.3,3.5e-4", ",-0.3,3.5e-4"), "sigma_A_m2 of block A1 .* positive"),
    ((",0.3,3.5e-4", ",300,3.5e-4"), None),
    ((",0.3,3.5e-4", ",301,3.5e-4"), "below the moment of 300.5"),
    (("3.5e-4", "0"), "volume_m3 of block A1 .* positive"),
    (("3.5e-4", "-1"), "volume_m3 of block A1"),
    (("3.5e-4", "big"), "volume_m3 in line 3"), (("21.5", "warm"), "temperature_C in line 3"),
    (("A2,", "A1,"), "serial of block A1 .* one block"),
    (("A2,2,1,2", "A2,2,1,1"), "place of block A2 .* ring 1, slot 1, where block A1 is"),
    (("A2,2,1,2", "A2,2,1,"), "place of block A2 .* ring and slot together"),
    (("A2,2,1,2", "A2,2,0,2"), "ring in line 4 .* whole number from 1"),
    (("A2,2,1,2", "A2,2,1.5,2"), "ring in line 4 .* whole number from 1"),
    (("A2,2,1,2", "A2,,,"), "type of block A2 .* ring and slot; instead received neither"),
    ((",0.3,3.5e-4", ",1e-300,3.5e-4"), "at least 1e-09 of the moment"),
    (("A2,2,", "A2,,"), None), (("A2,2,", ",2,"), "serial in line 4"),
    ((",21.5", ""), "line 3 .* 10 values"),
    (("sigma_A_m2,", ""), "complete with sigma_A_m2"),
    (("mx_A_m2", "mx"), "column 'mx'"), (("ring", "slot"), "without repeated columns"),
    (("\n".join(ROWS), ""), "a header alone"), ((HEADER, "#"), "without repeated columns"),
])
def test_refusals(tmp_path, edit, said):
    path = written(tmp_path, *ROWS)
    assert edit[0] in path.read_text()
    path.write_text(path.read_text().replace(*edit, 1))
    if said is None:  # the control beside its neighbour
        read_blocks(path)
        return
    with pytest.raises(MeasurementError, match=said) as refused:
        read_blocks(path)
    assert str(path) in str(refused.value)


def test_unreadable(tmp_path):
    with pytest.raises(MeasurementError, match="readable file"):
        read_blocks(tmp_path / "none.csv")
    (tmp_path / "empty.csv").write_text("\n")
    with pytest.raises(MeasurementError, match="empty file"):
        read_blocks(tmp_path / "empty.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(MeasurementError, match="UTF-8"):
        read_blocks(tmp_path / "bytes.csv")


def test_made_in_memory_is_checked_too():
    assert len(table()) == 3
    with pytest.raises(MeasurementError, match="finite numbers"):
        replace(table(), moment=np.full((3, 3), np.nan))
    with pytest.raises(MeasurementError, match="at least one block"):
        BlockTable((), (), *(np.zeros(0, int),) * 2, np.zeros((0, 3)), *(np.zeros(0),) * 3)


def test_nothing_half_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot write"):
        write_blocks(table(), tmp_path / "file" / "blocks.csv")
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("changes", [
    {"moment": table().moment[:2]}, {"moment": table().moment[:, :2]}, {"sigma": 1e-3},
    {"ring": np.array([1, 1])}, {"type": ("1", "2")}])
def test_arrays_of_another_shape(changes):
    with pytest.raises(MeasurementError, match=f"{next(iter(changes))} .* of the shape"):
        table(**changes)


def test_a_table_in_other_units_is_sent_to_import_blocks(tmp_path):
    """The command reads what the refusal sends to it, and the moments are right."""
    header = HEADER.replace("_A_m2", "_mA_m2")
    path = written(tmp_path, *ROWS, header=header)
    with pytest.raises(MeasurementError, match="`halbach-fe import-blocks`"):
        read_blocks(path)
    with pytest.raises(MeasurementError, match=r"complete with sigma_A_m2.*`halbach-fe import-b"):
        read_blocks(written(tmp_path, "A1,5,1,2,3", header="serial,type,mx_A_m2,my_A_m2,mz_A_m2"))
    path = written(tmp_path, *ROWS, header=header)
    assert main(["import-blocks", str(path), "-o", str(tmp_path / "own.csv")]) == 0
    own = read_blocks(tmp_path / "own.csv")
    same = read_blocks(written(tmp_path, *ROWS))
    np.testing.assert_allclose(own.moment, 1e-3 * same.moment)
    np.testing.assert_allclose(own.sigma, 1e-3 * same.sigma)
