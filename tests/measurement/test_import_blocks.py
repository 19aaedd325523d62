"""Tables of blocks as people have them become tables of measured or of free blocks."""

from __future__ import annotations

import re
import zipfile

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.measurement.block_table import read_blocks, write_blocks
from halbach_fe.measurement.formats.block_tables import DeclaredBlocks, import_blocks
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import import_map
from halbach_fe.study.free_blocks import FreeBlocks, read_free_blocks

MU_0 = 4e-7 * np.pi
MOMENT = np.array([[12.0, 0.1, -0.2], [-11.9, 0.3, 0.05]])
"""In A m^2, of blocks of 12 cm^3, in the axes of the block."""
VOLUME = 1.2e-5
J = MU_0 * MOMENT / VOLUME


def imported(tmp_path, text, **declared):
    path = tmp_path / "own.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return import_blocks(path, DeclaredBlocks(**declared))


def rows(values, before=("A1;1;1;", "A2;1;2;"), after=""):
    return "".join(start + ";".join(f"{value:.9g}" for value in row) + after + "\n"
                   for start, row in zip(before, values, strict=True))


@pytest.mark.parametrize(("text", "declared"), [
    ("Serial No;Ring;Slot;mx [A m^2];my [A m^2];mz [A m^2];sigma [mA m^2]\n"
     + rows(MOMENT, after=";12"), {}),
    ("id;layer;place;Jx [mT];Jy [mT];Jz [mT];Volume [cm^3];sd [%]\n"
     + rows(1e3 * J, after=";12;0.1"), {}),
    ("id;ring;slot;Mx [kA/m];My [kA/m];Mz [kA/m]\n" + rows(MOMENT / VOLUME / 1e3),
     {"fixed": {"volume": "12cm^3", "sigma": "0.1%"}}),  # no blank, as people write it
    ("# coil 7\nMagnet;Ring;Slot;Moment z (emu);Moment x (emu);Moment y (emu)\n"
     + rows(1e3 * MOMENT), {"axes": ("x", "y", "z"), "fixed": {"sigma": "0.012 A m^2"},
                            "columns": ("serial", "ring", "slot", "moment_x[emu]", "moment_y[emu]",
                                        "moment_z[emu]")}),
    ("id;ring;slot;mx [A m^2];my [A m^2];mz [A m^2]\n"
     + rows(MOMENT[:, [2, 1, 0]] * [1, -1, 1]),
     {"axes": ("z", "-y", "x"), "fixed": {"sigma": "0.1 %"}}),
    ("id;ring;slot;length [mm];width [mm];height [mm];Br_x [T];Br_y [T];Br_z [T]\n"
     + "".join(f"A{n};1;{n};20;20;30;" + ";".join(f"{v:.9g}" for v in j) + "\n"
               for n, j in enumerate(J, 1)), {"fixed": {"sigma": "0.1 %"}}),
    (("id;ring;slot;mx [A m^2];my [A m^2];mz [A m^2]\n" + rows(MOMENT)).replace(".", ","),
     {"decimal_comma": True, "fixed": {"sigma": "0.012 A m^2"}})])
def test_moments(tmp_path, text, declared):
    """Negative control: the moments in other axes."""
    found = imported(tmp_path, text, **declared)
    np.testing.assert_allclose(found.moment, MOMENT, rtol=1e-7)
    np.testing.assert_allclose(found.sigma, 0.012, rtol=0.01)  # 0.1 % of 12.0 and of 11.9
    assert found.serial == ("A1", "A2")
    assert found.places == [(1, 1), (1, 2)]
    assert not np.allclose(found.moment, MOMENT[:, ::-1], rtol=1e-7)


def test_more_blocks_than_slots(tmp_path):
    """Spare blocks have a type and no place."""
    found = imported(tmp_path, "id;ring;slot;mx [A m^2];my [A m^2];mz [A m^2];T [K]\n"
                     + rows([*MOMENT, MOMENT[0]], ("A1;1;1;", "A2;1;2;", "S3;;;"), ";293.15"),
                     fixed={"type": "1", "sigma": "0.1 %"})
    assert found.places == [(1, 1), (1, 2), (0, 0)]
    np.testing.assert_allclose(found.temperature, 20.0)


def test_all_that_is_missing_in_one_message(tmp_path):
    with pytest.raises(MeasurementError) as caught:
        imported(tmp_path, "ring;slot;Jx;Jy;Jz\n1;1;1;0;0\n")
    for asked in ("serial", "sigma", "the volume", "the unit of polarization_x"):
        assert asked in str(caught.value)
    for text in ("a;b;c\n1;2;3\n", '{"magnets": [{"shape": "cube"}]}\n'):
        with pytest.raises(MeasurementError, match=r"names two of them.*write it as CSV"):
            imported(tmp_path, text)
    with pytest.raises(MeasurementError, match="a number"):
        imported(tmp_path, "id;ring;slot;mx [A m^2];my [A m^2];mz [A m^2]\nA;1;1;x;0;0\n",
                 fixed={"sigma": "0.1 %"})
    with pytest.raises(MeasurementError, match="add --decimal-comma"):
        imported(tmp_path, "id;ring;slot;mx [A m^2];my [A m^2];mz [A m^2]\nA;1;1;0,5;0;0\n",
                 fixed={"sigma": "0.1 %"})


def test_a_table_below_its_counts_and_turns_named_after_their_axis(tmp_path):
    """It is read as the refusal advises, and asks for the unit of the turns."""
    text = "2 4\n# name, X-pos, Y-pos, Z-pos, X-rot, Y-rot, Z-rot, J\n" + "".join(
        f"m{n},{n},0,0,0,0,{90 * n},1.3\n" for n in (1, 2))
    declared = {"length_unit": "cm", "field_unit": "T", "fixed": {
        "shape": "cuboid", "size_x": "3 mm", "size_y": "3 mm", "size_z": "3 mm"}}
    with pytest.raises(MeasurementError, match="unit of rotation_x, rotation_y, rotation_z"):
        imported(tmp_path, text, **declared)
    assert imported(tmp_path, text, angle_unit="deg", **declared).rotation_z_deg == (90.0, 180.0)
    columns = ("serial", "at_x", "at_y", "at_z", "-", "-", "-", "polarization")
    bare = text.partition("# name")[0] + text.partition("J\n")[2]
    with pytest.raises(MeasurementError, match=r"line 1 .* 8 cells.* add --skip-lines 1\."):
        imported(tmp_path, bare, columns=columns, **declared)
    found = imported(tmp_path, bare, columns=columns, skip_lines=1, **declared)
    assert found.x_m == (0.01, 0.02)


CUBE = 0.02
"""Side in m of cubes of 1.3 T and of the recoil permeability 1.05."""
LONE = 1.3 * CUBE**3 / MU_0 / (1 + 0.05 / 3)
"""Moment in A m^2 of a lone one: its demagnetizing factor is 1/3, by symmetry."""


QUADRATURE = 3e-5
"""Of the demagnetizing factor 6e-4 may be wrong (tests/inference/test_block_prior.py), of 0.05."""


def test_remanences_and_moments_of_lone_blocks_are_one_prior(tmp_path):
    """B_r counted as the polarization of a lone block: a magnet of cubes was 1.7 % too strong, with
    a bar of 0.08 %. Control: the polarization that a lone block has.
    """
    magnet = hf.magnet_of_blocks({
        "shape": ["cuboid"], "x_m": [0.05], "y_m": [0.0], "z_m": [0.0], "remanence_T": [1.3],
        "recoil_permeability": [1.05], **{f"size_{axis}_m": [CUBE] for axis in "xyz"}})
    for name, unit, strength, ratio in (
            ("Br_{}", "T", 1.3, 1.0), ("remanence_{}", "T", 1.3, 1.0), ("m{}", "A m^2", LONE, 1.0),
            ("J{}", "T", 1.3, 1 + 0.05 / 3)):
        header = ";".join(f"{name.format(axis)} [{unit}]" for axis in "xyz")
        table = imported(tmp_path, f"id;ring;slot;{header}\nA1;1;1;{strength:.12g};0;0\n",
                         fixed={"sigma": "0.1 %", "volume": "8 cm^3"})
        write_blocks(table, tmp_path / "blocks.csv")
        found = hf.prior_from_blocks(magnet, hf.read_blocks(tmp_path / "blocks.csv")).gaussian
        np.testing.assert_allclose(found.mean, ratio * magnet.nominal_magnetization,
                                   rtol=QUADRATURE, atol=1e-6)


@pytest.mark.parametrize("columns", ["mx [A m^2];my [A m^2];mz [A m^2]", "moment [A m^2]"])
def test_the_moment_of_a_free_block_is_that_of_it_alone(tmp_path, columns):
    """Its far field is the dipole's of its moment. It counted as B_r: 1.2787 T of 1.3 T, and a far
    field of 0.984 of the dipole's.
    """
    text = (f"x [mm];y [mm];z [mm];dx [mm];dy [mm];dz [mm];mu;{columns}\n0;0;0;20;20;20;1.05;"
            f"{LONE:.12g}{';0;0' * (columns.count(';') // 2)}\n")
    shape = {"shape": "cuboid"}
    with pytest.raises(MeasurementError, match=r"the recoil permeability, without which a moment"):
        imported(tmp_path, text, fixed=shape)
    table = imported(tmp_path, text.replace("mu;", "recoil_permeability;"), fixed=shape)
    magnet = hf.magnet_of_blocks(table)
    np.testing.assert_allclose(magnet.blocks[0].polarization, [1.3, 0, 0], atol=1.3 * QUADRATURE)
    away = 0.1  # m, ten half sides: what a cube has besides its dipole falls by their fourth power
    assert magnet.field_T([away, 0, 0])[0] == pytest.approx(2e-7 * LONE / away**3, rel=1e-3)


def test_what_is_missing_is_asked_for_in_one_option(tmp_path):
    table = "no,mx [Am^2],my [Am^2],mz [Am^2],V [cm^3]\n1,1.0,0,0,1\n"
    with pytest.raises(MeasurementError, match="one --fixed NAME=VALUE,NAME=VALUE"):
        imported(tmp_path, table)
    assert imported(tmp_path, table, fixed={"sigma": "0.2 %", "type": "1"}).serial == ("1",)


FREE = ("Name;Shape;xc [mm];yc [mm];zc [mm];Rot x (deg);Rot y (deg);Rot z (deg);dx [mm];dy [mm];"
        "dz [mm];")


@pytest.mark.parametrize(("header", "values", "declared"), [
    ("Jx [mT];Jy [mT];Jz [mT]", (0.0, 1300.0, 0.0), {}),
    ("Mx [A/m];My [A/m];Mz [A/m]", (0.0, 1.3 / MU_0, 0.0), {}),
    ("mx [A m^2];my [A m^2];mz [A m^2]", (0.0, 1.3 * 6e-6 / MU_0, 0.0),
     {"fixed": {"recoil_permeability": "1"}}),
    ("Jx [T];Jy [T];Jz [T]", (1.3, 0.0, 0.0), {"along_block": True}),
    ("Jx [T];Jy [T];Jz [T]", (1.3, 0.0, 0.0), {"axes": ("y", "-x", "z")}),
    ("Br [mT]", (1300.0,), {})])
def test_free_blocks(tmp_path, header, values, declared):
    """A cuboid that is turned by 90° about z, magnetized along y of the magnet."""
    table = imported(tmp_path, FREE + header + "\nb 1;cuboid;10;-20;5;0;0;90;10;20;30;"
                     + ";".join(f"{value:.12g}" for value in values) + "\n", **declared)
    assert (table.name, table.x_m, table.y_m, table.z_m) == (
        ("b-1",), (0.01,), (-0.02,), (0.005,))
    assert (table.size_x_m, table.size_y_m, table.size_z_m) == ((0.01,), (0.02,), (0.03,))
    assert table.rotation_z_deg == (90.0,)
    if len(values) == 1:  # along its own x axis
        assert table.remanence_T == (1.3,)
    else:
        np.testing.assert_allclose([table.remanence_x_T, table.remanence_y_T, table.remanence_z_T],
                                   [[0], [1.3], [0]], atol=1e-9)


@pytest.mark.parametrize(("text", "declared", "said"), [
    ("id;type;mx [A m^2];my [A m^2];mz [A m^2]\nA;1;12;0;0\n", {"length_unit": "mm"},
     "--length-unit"),
    ("id;type;mx [A m^2];my [A m^2];mz [A m^2]\nA;1;12;0;0\n", {"along_block": True},
     "--along-block"),
    (FREE + "Br [mT]\nb;cuboid;0;0;0;0;0;0;1;2;3;1300\n", {"axes": ("z", "x", "y")},
     "--axes and --along-block"),
    (FREE + "Br [mT]\nb;cuboid;0;0;0;0;0;0;1;2;3;1300\n", {"length_unit": "cm"},
     "--length-unit"),
    (FREE + "Br [mT]\nb;cuboid;0;0;0;0;0;0;1;2;3;1300\n", {"fixed": {"shape": "cylinder"}},
     "--fixed shape"),
    (FREE + "Br\nb;cuboid;0;0;0;0;0;0;1;2;3;1300\n", {"field_unit": "mT"}, "")])  # the control
def test_an_option_that_would_have_no_effect_is_refused(tmp_path, text, declared, said):
    declared = {"fixed": {"sigma": "0.1 %"} if "type" in text else {}} | declared
    if not said:
        assert len(imported(tmp_path, text, **declared)) == 1
        return
    with pytest.raises(MeasurementError, match=f"Input {said} of table of blocks"):
        imported(tmp_path, text, **declared)


LYING = {"rotation vector": ("Rot x (deg);Rot y (deg);Rot z (deg)", "30;40;50",
                             ("rotation_x", "rotation_y", "rotation_z")),
         "turned by 'phi": ("phi (deg);n;m", "50;1;1", ("rotation_z", "-", "-")),
         "turned by 'Roll', 'Pitch' and 'Yaw'": ("Roll;Pitch;Yaw", "0;0;50",
                                                 ("-", "-", "rotation_z[deg]")),
         "Length .mm.' and 'Width": ("Length [mm];Width [mm];Height [mm]", "10;20;30",
                                     ("size_z", "size_x", "size_y"))}


@pytest.mark.parametrize("asked", LYING)
def test_how_a_block_lies_is_not_guessed(tmp_path, asked):
    """Angles of Euler were read as a rotation vector, a lone angle was left out, and the length
    was that along x. What the refusal asks for is read as it is named.
    """
    header, cells, named = LYING[asked]
    sizes = "" if "size_z" in named else "dx [mm];dy [mm];dz [mm];"
    text = (f"x [mm];y [mm];z [mm];{sizes}Br [T];{header}\n"
            f"0;0;0;{'10;20;30;' if sizes else ''}1.3;{cells}\n")
    shape = {"fixed": {"shape": "cuboid"}}
    with pytest.raises(MeasurementError, match=asked):
        imported(tmp_path, text, **shape)
    found = imported(tmp_path, text, columns=(
        "at_x", "at_y", "at_z", *(("size_x", "size_y", "size_z") if sizes else ()),
        "polarization", *named), **shape)
    if not sizes:
        assert (found.size_x_m, found.size_y_m, found.size_z_m) == ((0.02,), (0.03,), (0.01,))
    else:
        assert found.rotation_z_deg == (50.0,)


@pytest.mark.parametrize(("name", "cell", "turns"), [
    ("rotor", "A7", False), ("turns", "12", False), ("rolled by", "Ann", False),
    ("pitch [mm]", "10", False), ("phi [mm]", "3", False), ("turn", "30", True),
    ("tilt", "3", True), ("angle about z", "30", True), ("rot_z2", "3", True),
    ("orientation", "up", True), ("Yaw angle", "3", True), ("phiz", "3", True),
    ("RotationZDeg", "3", True), ("tiltAngleX", "3", True), ("PhiM", "3", True)])
def test_words_that_only_begin_like_a_turn(tmp_path, name, cell, turns):
    """A rotor or the turns of a coil stopped the table; what says how a block lies still does."""
    text = (f"x [mm];y [mm];z [mm];dx [mm];dy [mm];dz [mm];Br [T];{name}\n"
            f"0;0;0;10;20;30;1.3;{cell}\n")
    with (pytest.raises(MeasurementError, match="turned by") if turns
          else pytest.warns(HalbachWarning, match="not read")):
        imported(tmp_path, text, fixed={"shape": "cuboid"})


def test_lengths_of_J_with_a_direction_and_diameters(tmp_path):
    """J was taken along x beside its direction. Negative controls: without one, and by radius."""
    text = ("x [mm];y [mm];z [mm];Diameter [mm];Height [mm];Br [T];{}\n0;0;0;30;10;1.3;0;1\n")
    shape = {"fixed": {"shape": "cylinder"}}
    with pytest.raises(MeasurementError, match="remanence_x.* 'Dir_x' and 'Dir_y'; the radius, "
                                               r"half of 'Diameter .mm.' \(radius.0.5 mm"):
        imported(tmp_path, text.format("Dir_x;Dir_y"), **shape)
    found = imported(tmp_path, text.format("n;m"), columns=(
        "at_x", "at_y", "at_z", "radius[0.5 mm]", "size_z", "polarization", "-", "-"), **shape)
    assert (found.radius_m, found.remanence_T) == ((0.015,), (1.3,))


@pytest.mark.parametrize(("header", "turn"), [
    ("Rot x (deg);Rot y (deg);Rot z (deg)", "0;0;50"),
    ("rotvec x (deg);rotvec y (deg);rotvec z (deg)", "30;40;50"),
    ("rotation_x_deg;rotation_y_deg;rotation_z_deg", "30;40;50"),
    ("Rot x (deg);Rot y (deg);Rot z (deg)", "0;0;770")])
def test_turns_that_are_rotation_vectors(tmp_path, header, turn):
    """Negative control of the above: about one axis both are the same, and a whole turn is none."""
    found = imported(tmp_path, f"x [mm];y [mm];z [mm];dx [mm];dy [mm];dz [mm];Br [T];{header}\n"
                     f"0;0;0;10;20;30;1.3;{turn}\n", fixed={"shape": "cuboid"})
    assert found.rotation_z_deg == (50.0,)


def test_free_blocks_without_names_and_with_edges_of_own_names(tmp_path):
    """The warning names the columns; the units of the header hold beside --columns."""
    text = ("x [mm],y [mm],z [mm],a [mm],b [mm],c [cm],Jx [T],Jy [T],Jz [mT]\n"
            "10,-20,5,10,20,3,0,1.3,0\n30,20,5,10,20,3,0,1.2,100\n")
    shape = {"fixed": {"shape": "cuboid"}}
    with (pytest.raises(MeasurementError, match="needs size_x_m"),
          pytest.warns(HalbachWarning, match=r"a \[mm\], b \[mm\], c \[cm\].*--columns can name")):
        imported(tmp_path, text, **shape)
    found = imported(tmp_path, text, columns=(
        "at_x", "at_y", "at_z", "size_x", "size_y", "size_z", *(
            f"polarization_{axis}" for axis in "xyz")), **shape)
    assert (found.name, found.x_m, found.size_z_m) == (("1", "2"), (0.01, 0.03), (0.03, 0.03))
    assert found.remanence_z_T == (0.0, 0.1)


MEASURED = "serial,type,moment_x{0},moment_y{0},moment_z{0},sigma{0}{1}\n{2}a,1,1,0,0,0.001,{3}\n"


@pytest.mark.parametrize(("text", "asked"), [
    (MEASURED.format("[A m^2]", ",temperature[F]", "", "68"), "the unit of temperature.* not 'F'"),
    (MEASURED.format("[A m^2]", ",temp (degF)", "", "68"), "the unit of temperature.* not 'degF'"),
    (MEASURED.format("", ",volume[cm^3]", "", "1"),
     r"the unit of moment_x, moment_y, moment_z, sigma \(one of Am\^2.* of J or M.*polarization_x"),
    ("x[mm],y[mm],z[mm],-Jx[T],Jy[T],Jz[T]\n0,0,0,1.3,0,0\n", "does not say its strength"),
    ("x,y,z,size_x,size_y,size_z,Br[T]\n0,0,0,10,10,10,1.3\n",
     r"the unit of at_x, at_y, at_z, size_x, size_y, size_z \(one of m, .*: --length-unit"),
    ("serial,type,jx[T],jy[T],jz[T],sigma[%],volume[cm^3]\na,1,1300,0,0,0.1,1\n",
     "polarization in line 2 .* below 10 T; .* 1300 T"),
    ("serial,type,mx[A m^2],my[A m^2],mz[A m^2],sigma[%],volume[mm^3]\na,1,1,0,0,0.1,1\n",
     "moment in line 2 .* below 10 T"),
    ("serial,type,mx[A m^2],my[A m^2],mz[A m^2],sigma[%],volume[mm^3]\na,1,1,0,0,0.1,0\n",
     "volume_m3 of block a .* must be positive"),
    ("serial,type,mx[A m^2],my[A m^2],mz[A m^2],sigma[%],volume[mm^3]\na,1,1,2,3,0.1,0\n",
     "volume_m3 of block a .* must be positive"),
    ("serial,ring,slot,J[T],sigma[%],volume[cm^3]\na,1,1,1.2,0.1,1\n",
     "the direction of its polarization .*columns polarization_x"),
    ("r[mm],phi[deg],z[mm],Br[T]\n9,0,0,1.3\n", r"x of each .*\(x = r cos\(phi\)"),
    ("x[m],y[m],z[m],shape,size_x[m],size_y[m],size_z[m],Br[T],angle[deg]\n"
     "0,0,0,cuboid,0.01,0.01,0.01,1.3,45\n", "direction of the magnetization as a rotation")])
def test_what_a_table_does_not_say(tmp_path, text, asked):
    """A temperature in °F was read as one in °C, and a length of J as measured along x."""
    with pytest.raises(MeasurementError, match=asked):
        imported(tmp_path, text)


def test_units_below_the_names(tmp_path):
    """As of maps. Control: the same numbers in another unit."""
    units = ",,{0},{0},{0},{0},C\n"
    for unit, moment in (("A m^2", 1.0), ("mA m^2", 1e-3)):
        found = imported(tmp_path, MEASURED.format("", ",temp", units.format(unit), "25"))
        assert found.moment.tolist() == [[pytest.approx(moment), 0, 0]]
        assert found.temperature.tolist() == [25.0]
        again = imported(tmp_path, MEASURED.format(f"[{unit}]", ",temp", units.format(unit), "25"))
        assert again.moment.tolist() == found.moment.tolist()
    for header, below, name in (
            ("[mA m^2]", units.format("A m^2"), "moment_x"),
            ("[A m^2]", units.format("mA m^2"), "moment_x"),
            ("[A m^2]", units.format("A m^2").replace("C", "K"), "temperature")):
        with pytest.raises(MeasurementError, match=rf"unit of {name} .* in the line of units"):
            imported(tmp_path, MEASURED.format(header, ",temp[C]", below, "25"))


def test_a_table_of_free_blocks_is_imported_whole(tmp_path):
    """As `halbach-fe export` writes it: its permeabilities were said to be none of free blocks, and
    for the semicolons of its outlines it had no header. Control: an outline that is none.
    """
    columns = {"name": ["cube", "prism"], "type": ["a", "b"], "shape": ["cuboid", "prism"],
               "ring": [1, 1], "slot": [1, 2], "x_m": [0.04, -0.04], "y_m": [0.0] * 2,
               "z_m": [0.0] * 2, "size_x_m": [0.02, None], "size_y_m": [0.02, None],
               "size_z_m": [0.02, 0.01], "outline_m": [
                   None, ((0.0, 0.0), (0.02, 0.0), (0.02, 0.01), (0.0, 0.0125))],
               "remanence_x_T": [1.3, 1.1], "remanence_y_T": [0.0] * 2, "remanence_z_T": [0.0] * 2,
               "recoil_permeability": [1.05, 1.2], "recoil_permeability_across": [1.1, None],
               "magnetization_gradient": [0.01, None], "inner_corner_loss": [0.1, None]}
    magnet = hf.magnet_of_blocks(columns)
    path = hf.export(magnet, tmp_path / "blocks.csv")
    text = path.read_text()
    assert imported(tmp_path, text) == FreeBlocks(**read_free_blocks(path))
    in_mm = text.replace("outline_m", "outline [mm]").replace(
        "0.0 0.0; 0.02 0.0; 0.02 0.01; 0.0 0.0125", "0 0; 20 0; 20 10; 0 12.5")
    assert in_mm.count("12.5") == 1
    assert imported(tmp_path, in_mm) == FreeBlocks(**read_free_blocks(path))
    with pytest.raises(MeasurementError, match=r"outline in line 3 .*corners as"):
        imported(tmp_path, in_mm.replace("0 12.5", "12.5"))


def test_columns_that_are_not_read_are_named(tmp_path):
    row = "Br [mT];{}\nb;cuboid;0;0;0;0;0;0;10;20;30;1300;{}\n"
    with pytest.warns(HalbachWarning, match="are not read: colour, temperature, volume. Free"):
        imported(tmp_path, FREE + row.format("colour;temp;volume [cm^3]", "red;80;3"))
    measured = "id;type;mx [A m^2];my [A m^2];mz [A m^2];temp\nA;1;12;0;0;20\n"
    for name in ("temp", "temperature_C", "temperature_degC"):  # warnings are errors
        found = imported(tmp_path, measured.replace("temp", name), fixed={"sigma": "0.1 %"})
        assert found.temperature.tolist() == [20.0]
    found = imported(tmp_path, measured.replace("temp", "temperature_K").replace("20", "293.15"),
                     fixed={"sigma": "0.1 %"})
    np.testing.assert_allclose(found.temperature, 20.0)


def test_workbooks_and_the_command(tmp_path, capsys):
    """The same sheet for blocks and for a map; a damaged workbook is refused."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["id", "ring", "slot", "mx [A m^2]", "my [A m^2]", "mz [A m^2]"])
    for number, moment in enumerate(MOMENT.tolist(), 1):
        book.active.append([f"A{number}", 1, number, *moment])
    book.save(tmp_path / "own.xlsx")
    out = tmp_path / "blocks.csv"
    assert main(["import-blocks", str(tmp_path / "own.xlsx"), "-o", str(out),
                 "--fixed", "sigma=0.1 %"]) == 0
    np.testing.assert_allclose(read_blocks(out).moment, MOMENT)
    free = tmp_path / "own.csv"
    free.write_text(FREE + "Br [mT]\nb;cuboid;10;0;0;0;0;0;10;20;30;1300\n")
    assert main(["import-blocks", str(free), "-o", str(tmp_path / "free.csv")]) == 0
    assert read_free_blocks(tmp_path / "free.csv")["remanence_T"] == [1.3]
    with pytest.raises(SystemExit, match="2"):
        main(["import-blocks", str(free), "-o", str(out), "--fixed", "type=1,type=2"])
    assert "must give type once" in capsys.readouterr().err
    book = openpyxl.Workbook()
    for row in (["x [mm]", "y [mm]", "z [mm]", "Bx [mT]"], [1, 2, 3, 100.5], [1, 2, 4, 101]):
        book.active.append(row)
    book.save(tmp_path / "map.xlsx")
    assert main(["import-map", str(tmp_path / "map.xlsx"), "-o", str(tmp_path / "map.csv")]) == 0
    assert "0.001,0.002,0.003,0.1005" in (tmp_path / "map.csv").read_text()
    assert "the sheet" not in capsys.readouterr().err
    other = book.create_sheet("other")
    for row in ([1, 2], [3, 4]):
        other.append(row)
    book.save(tmp_path / "two.xlsx")
    assert main(["import-map", str(tmp_path / "two.xlsx"), "-o", str(tmp_path / "two.csv")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "the sheet 'Sheet' is read; 'other' would have to be saved as CSV" in said
    raw = (tmp_path / "map.xlsx").read_bytes()
    (tmp_path / "map.xlsx").write_bytes(raw[:-200])
    capsys.readouterr()
    assert main(["import-map", str(tmp_path / "map.xlsx"), "-o", str(tmp_path / "no.csv")]) == 4
    assert "Save the sheet as CSV" in " ".join(capsys.readouterr().err.split())


def test_the_sheet_with_the_numbers_is_read(tmp_path):
    """A cover sheet is passed over; of two sheets with numbers the one that is read is named."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Scan of magnet", 7])
    sheet = book.create_sheet("Data")
    for row in (["Hall scan"], ["x", "y", "z", "Bx"], ["mm", "mm", "mm", "mT"], [1, 2, 3, 100.5],
                [1, 2, 4, 101]):
        sheet.append(row)
    path = tmp_path / "map.xlsx"
    book.save(path)
    found = import_map(path, DeclaredFormat()).data
    np.testing.assert_allclose(found["B_T"][:, 0], [0.1005, 0.101])
    other = book.create_sheet("Other")
    for row in ([1, 2], [3, 4]):
        other.append(row)
    book.save(path)
    with pytest.warns(HalbachWarning, match="sheet 'Data' is read; 'Other' would have to be saved"):
        assert import_map(path, DeclaredFormat()).data.equals(found)


def test_workbooks_whose_numbers_are_texts_with_decimal_commas(tmp_path):
    """The option that the refusal advises had made it no table; numbers among them stay numbers."""
    openpyxl = pytest.importorskip("openpyxl")
    book, path = openpyxl.Workbook(), tmp_path / "map.xlsx"
    for row in (["x", "y", "z", "Bx"], ["mm", "mm", "mm", "mT"], [1.5, 2, 3, "100,5"],
                [1.5, 2, 4, "101,0"]):
        book.active.append(row)
    book.save(path)
    with pytest.raises(MeasurementError, match="add --decimal-comma"):
        import_map(path, DeclaredFormat())
    found = import_map(path, DeclaredFormat(decimal_comma=True)).data
    np.testing.assert_allclose(found["B_T"][:, 0], [0.1005, 0.101])
    np.testing.assert_allclose(found["x_m"], 0.0015)


def test_a_formula_without_its_value_in_another_sheet(tmp_path):
    """It refused the workbook. The sheet is named, as what it would have held is not read."""
    openpyxl = pytest.importorskip("openpyxl")
    book, path = openpyxl.Workbook(), tmp_path / "map.xlsx"
    cover, data = book.active, book.create_sheet("Data")
    cover.append(["=Data!A2", "=Data!B2"])
    for row in (["x [mm]", "y [mm]", "z [mm]", "Bx [mT]"], [1, 2, 3, 100], [1, 2, 4, 101]):
        data.append(row)
    book.save(path)
    with pytest.warns(HalbachWarning, match="sheet 'Data' is read; 'Sheet' would have to be"):
        found = import_map(path, DeclaredFormat()).data
    np.testing.assert_allclose(found["B_T"][:, 0], [0.1, 0.101])
    data.append([1, 2, 5, "=D3+1"])
    book.save(path)
    with pytest.raises(MeasurementError, match="the formula in D4 has no value"):
        import_map(path, DeclaredFormat())


def test_a_workbook_whose_only_numbers_are_formulas_without_values(tmp_path):
    """The notes in its first sheet are not what has to be mended."""
    openpyxl = pytest.importorskip("openpyxl")
    book, path = openpyxl.Workbook(), tmp_path / "map.xlsx"
    for text in ("Measured on Monday", "by a Hall probe"):
        book.active.append([text])
    data = book.create_sheet("Map")
    for row in (["x [mm]", "y [mm]", "z [mm]", "Bx [mT]"], ["=1", "=2", "=3", "=100"]):
        data.append(row)
    book.save(path)
    with pytest.raises(MeasurementError, match="the formula in A2 has no value"):
        import_map(path, DeclaredFormat())


@pytest.mark.parametrize(("saved", "text"), [("", False), ("101", False), ("", True)])
def test_a_formula_without_its_value_is_not_left_out(tmp_path, saved, text):
    """Negative controls: one that was saved with its value, and an empty text."""
    openpyxl = pytest.importorskip("openpyxl")
    book, whole, path = openpyxl.Workbook(), tmp_path / "whole.xlsx", tmp_path / "map.xlsx"
    for row in (["x [mm]", "y [mm]", "z [mm]", "Bx [mT]"], [1, 2, 3, 100], [1, 2, 4, "=D2+1"]):
        book.active.append(row)
    book.save(whole)
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = re.sub(rb"</f><v\s*(?:/>|></v>)", b"</f><v>%s</v>" % saved.encode(),
                             old.read(name))
            new.writestr(name, content.replace(b'r="D3"', b'r="D3" t="str"') if text else content)
    if saved or text:
        found = import_map(path, DeclaredFormat()).data
        assert found.sizes["point"] == (2 if saved else 1)
        return
    with pytest.raises(MeasurementError, match=r"the formula in D3 has no value.*as CSV"):
        import_map(path, DeclaredFormat())
