"""Files of free blocks: what is read, what is refused in which words, and what is written."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from halbach_fe.core.errors import OutputError, StudyError
from halbach_fe.study import free_blocks
from halbach_fe.study.free_blocks import (
    FreeBlocks,
    free_blocks_of_file,
    read_free_blocks,
    write_free_blocks,
)
from halbach_fe.study.reader import read_study

CSV = """# made by hand
 x_m , name,shape,y_m,z_m,size_x_m,size_y_m,size_z_m,radius_m,outline_m,remanence_T,ring,slot,type

0.1,a,cuboid,0,0,1e-2,.02,0.03,,,1.25,1,1,"N42, coated"
# another comment
-0.1,b,cylinder,0,0,,,0.03,0.01,,1.3,1,2,
0,c,prism,+0.1,-0.0,,,0.03,,0 0; 0.01 0;0 1E-2,1.3D0,1.0,3,
"""
STUDY = """
name = "free"
array = { recoil_permeability = 1.05, free_blocks = { file = "blocks.csv" } }
mesh = { block_size_m = 0.01 }
observation = { quantity = "flux_density", positions = { kind = "points", points_m = [[0, 0, 0]] } }
"""
COLUMNS = {
    "name": ["a", "b", "c"], "type": ["N42, coated", None, None],
    "shape": ["cuboid", "cylinder", "prism"], "ring": [1, 1, 1], "slot": [1, 2, 3],
    "x_m": [0.1, -0.1, 0.0], "y_m": [0.0, 0.0, 0.1], "z_m": [0.0, 0.0, -0.0],
    "size_x_m": [0.01, None, None], "size_y_m": [0.02, None, None], "size_z_m": [0.03] * 3,
    "radius_m": [None, 0.01, None],
    "outline_m": [None, None, ((0.0, 0.0), (0.01, 0.0), (0.0, 0.01))],
    "remanence_T": [1.25, 1.3, 1.3]}


@pytest.fixture
def blocks(tmp_path):
    path = tmp_path / "blocks.csv"
    path.write_text(CSV, encoding="utf-8")
    (tmp_path / "study.toml").write_text(STUDY, encoding="utf-8")
    return path


def test_csv(blocks):
    assert read_free_blocks(blocks) == COLUMNS
    blocks.write_bytes(b"\xef\xbb\xbf" + CSV.replace("\n", "\r\n").encode())
    assert read_free_blocks(blocks) == COLUMNS


def test_a_study_reads_its_table(blocks):
    """What counts is the study's folder; the columns replace the name of the file."""
    study = read_study(blocks.with_name("study.toml"))
    assert study.array.free_blocks == FreeBlocks(**COLUMNS)
    assert study.array.free_blocks.file is None
    blocks.write_text(CSV.replace("1.25", "1.24"), encoding="utf-8")
    assert read_study(blocks.with_name("study.toml")) != study


def test_hdf5_of_other_programs(tmp_path):
    """Written by h5py: fixed and variable text, integers, single precision, NaN for missing."""
    path = tmp_path / "blocks.h5"
    with h5py.File(path, "w") as file:
        file["name"] = np.array([b"a", b"b"])
        file["shape"] = ["cuboid", "cylinder"]
        file["sides"] = np.array([np.nan, np.nan])
        file["ring"], file["slot"] = np.array([1, 1], "i2"), np.array([1.0, 2.0])
        for column, values in {"x_m": [0.25, -0.25], "y_m": [0, 0], "z_m": [0, 0],
                               "size_x_m": [0.125, np.nan], "size_y_m": [0.125, np.nan],
                               "size_z_m": [0.5, 0.5], "radius_m": [np.nan, 0.125],
                               "remanence_T": [1.25, 1.5]}.items():
            file[column] = np.array(values, ">f4")
        file["outline_m"] = ["", ""]
    found = read_free_blocks(path)
    assert found["name"] == ["a", "b"]
    assert found["sides"] == found["outline_m"] == [None, None]
    assert found["radius_m"] == [None, 0.125]
    assert found["slot"] == [1, 2]
    assert free_blocks_of_file(path).size_x_m == (0.125, None)


@pytest.mark.parametrize(("old", "new", "said"), [
    (" x_m ", "x", "column 1 of .* must be a known column; .* 'x'. Did you mean `x_m`"),
    (" x_m ", "s3cret", "column 1 .* another name. Known columns: name, type"),
    (" x_m ", "y_m", "without repeated columns; .* 'y_m'"),
    ("radius_m", "diameter_m", "Did you mean `radius_m`\\? Then halve its values"),
    ("radius_m", "radius", "Did you mean `radius_m`"),
    (".02,0.03", "zwei,0.03", "`size_y_m` in line 4 of .* a finite number"),
    (".02,0.03", "nan,0.03", "`size_y_m` in line 4 of .* a finite number"),
    (".02,0.03", "1e999,0.03", "`size_y_m` in line 4 of .* a finite number"),
    (".02,0.03", "0_2,0.03", "`size_y_m` in line 4 of .* a finite number"),
    (".02,0.03", "20,0.03", "`size_y_m` in line 4 of .* less than 10; .* received 20. "
     "Was it meant in millimetres. Then write 0.02."),
    (".02,0.03", ",0.03", "line 4 of .* block a in row 1, a cuboid, needs size_y_m"),
    ("1.0,3,", "1.5,3,", "`ring` in line 7 of .* a whole number"),
    (";0 1E-2", ";0 1E-2;0", "`outline_m` in line 7 of .* corners as `x y; x y; x y`"),
    (";0 1E-2", ";0 1e999", "`outline_m` in line 7"),
    (";0 1E-2", "", "`outline_m` in line 7 of .* 3 or more"),
    ("b,cylinder", "a,cylinder", "line 6 of .* name must be unique to a block, but a occurs"),
    ("b,cylinder", "b,sphere", "`shape` in line 6 of .* 'cuboid'"),
    ("b,cylinder", ",cylinder", "`name` in line 6 of .* given"),
    ("1,2,\n", "1,2,,\n", "line 6 of .* 14 cells, as the header; .* 15 cells"),
    ('"N42, coated"', '"N42, coated', "line 4 of .* open quotation mark"),
    ('"N42, coated"', '"N42\x1b[31m"', "`type` in line 4 of .* printable"),
    (CSV, "name;shape;x_m\na;cuboid;0,1\n", "names that semicolons separate. Separate columns by"),
    (CSV, "# nothing\n", "a header, and 1 to 1000000 blocks; instead received 0"),
    (CSV, "name,shape\n", "a header, and 1 to 1000000 blocks; instead received 0"),
    (",z_m", ",rotation_x_deg", "there is no column z_m: add it")])
def test_refusals(blocks, old, new, said):
    """Also through the study, whose file the sentence names too."""
    assert old in CSV
    free_blocks_of_file(blocks)
    blocks.write_text(CSV.replace(old, new), encoding="utf-8")
    with pytest.raises(StudyError, match=said) as caught:
        free_blocks_of_file(blocks)
    assert str(blocks) in str(caught.value)
    assert "'s3cret'" not in str(caught.value)
    with pytest.raises(StudyError, match=said) as caught:
        read_study(blocks.with_name("study.toml"))
    assert all(str(path) in str(caught.value) for path in (blocks, blocks.with_name("study.toml")))


def test_files_that_are_none(blocks, tmp_path, monkeypatch):
    study = tmp_path / "study.toml"
    blocks.write_bytes(CSV.encode("utf-16"))
    with pytest.raises(StudyError, match=r"encoding .* must be UTF-8"):
        read_study(study)
    blocks.unlink()
    with pytest.raises(StudyError, match=r"No such file or directory.*from the study's folder"):
        read_study(study)
    blocks.mkdir()
    with pytest.raises(StudyError, match="Is a directory"):
        read_study(study)
    study.write_text(STUDY.replace("blocks.csv", "/dev/zero"), encoding="utf-8")
    with pytest.raises(StudyError, match="must be a file; instead received a device"):
        read_study(study)
    study.write_text(STUDY.replace('"blocks.csv"', '"blocks.csv", name = ["a"]'), encoding="utf-8")
    with pytest.raises(StudyError, match="either a file or columns; instead received both"):
        read_study(study)
    for wrong in ('"a\\u0000b"', '""', "1", f'"{"a" * 5000}"'):
        study.write_text(STUDY.replace('"blocks.csv"', wrong), encoding="utf-8")
        with pytest.raises(StudyError, match=r"array\.free_blocks"):
            read_study(study)
    monkeypatch.setattr(free_blocks, "MAX_BYTES", 100)
    blocks.rmdir()
    blocks.write_text(CSV, encoding="utf-8")
    with pytest.raises(StudyError, match="at most 1e\\+02 bytes"):
        read_free_blocks(blocks)


@pytest.mark.parametrize(("content", "said"), [
    ({"colour": np.zeros(2)}, "another name"), ({"x_m": np.zeros((2, 2))}, "`x_m`"),
    ({"x_m": np.zeros(2), "y_m": np.zeros(3)}, "numbers or texts"),
    ({"x_m": np.array([0, np.inf])}, "`x_m` in row 2"), ({"x_m": ["a", "b"]}, "`x_m` in row 1"),
    ({"name": np.zeros(2)}, "`name` in row 1"), ({"ring": np.array([1, 1.5])}, "`ring` in row 2"),
    ({"x_m": np.zeros(0)}, "instead received 0"), ({}, "instead received 0")])
def test_refusals_of_hdf5(tmp_path, content, said):
    path = tmp_path / "blocks.h5"
    with h5py.File(path, "w") as file:
        for name, values in content.items():
            file[name] = values
    with pytest.raises(StudyError, match=said) as caught:
        read_free_blocks(path)
    assert str(path) in str(caught.value)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(StudyError, match="HDF5 file of numbers and text"):
        read_free_blocks(path)


lengths = st.floats(1e-4, 10.0, exclude_max=True)
places = st.floats(-9.9, 9.9)  # a block is at most 10 m from the axis


@pytest.mark.parametrize(("suffix", "examples"), [(".csv", 50), (".h5", 3)])  # HDF5 takes longer
def test_what_is_written_is_read_to_the_last_bit(tmp_path, suffix, examples):
    path = tmp_path / f"written{suffix}"

    @settings(max_examples=examples)
    @given(place=st.tuples(places, places, places), size=st.tuples(lengths, lengths),
           turn=st.floats(-720, 720), corner=st.tuples(lengths, lengths))
    def each(place, size, turn, corner):
        columns = COLUMNS | {"x_m": list(place), "size_x_m": [size[0], None, None],
                             "radius_m": [None, size[1], None],
                             "rotation_y_deg": [None, turn, None],
                             "outline_m": [None, None, ((0.0, 0.0), (corner[0], 0.0), corner)]}
        write_free_blocks(columns, path)
        assert read_free_blocks(path) == columns
        columns["x_m"] = [np.nextafter(place[0], math.inf), *place[1:]]  # the control
        assert read_free_blocks(path) != columns

    each()
    write_free_blocks(FreeBlocks(**COLUMNS), path)
    assert read_free_blocks(path) == COLUMNS
    assert free_blocks_of_file(path) == FreeBlocks(**COLUMNS)


def test_refusals_of_writing(tmp_path):
    path = tmp_path / "blocks.xls"
    with pytest.raises(OutputError, match=r"\.csv, \.h5"):
        write_free_blocks(COLUMNS, path)
    path = tmp_path / "blocks.csv"
    with pytest.raises(StudyError, match="`radius_m` in row 2"):
        write_free_blocks(COLUMNS | {"radius_m": [None, 1e3, None]}, path)
    with pytest.raises(StudyError, match="colour"):
        write_free_blocks(COLUMNS | {"colour": ["red"] * 3}, path)
    assert not list(tmp_path.iterdir())


def test_100_000_blocks(tmp_path):
    """A change of other keys does not validate the blocks again, as reading does."""
    count = 100_000
    number = np.arange(count)
    columns = {
        "name": [f"b{n}" for n in number], "shape": ["cuboid"] * count,
        "x_m": (0.02 * (number % 50)).tolist(), "y_m": (0.02 * (number // 50 % 50)).tolist(),
        "z_m": (0.02 * (number // 2500)).tolist(), "rotation_z_deg": (number % 360 / 3).tolist(),
        **{f"size_{axis}_m": [0.01] * count for axis in "xyz"},
        **{f"remanence_{axis}_T": np.cos(number + i).tolist() for i, axis in enumerate("xyz")},
        "recoil_permeability": [1.05] * count}
    write_free_blocks(columns, tmp_path / "blocks.csv")
    (tmp_path / "study.toml").write_text(STUDY, encoding="utf-8")
    study = read_study(tmp_path / "study.toml")
    other = study.with_(mesh__growth=1.7, array__recoil_permeability=1.06)
    assert other.array.free_blocks is study.array.free_blocks  # validation makes another object
    assert study.array.free_blocks.remanence_x_T == tuple(columns["remanence_x_T"])
