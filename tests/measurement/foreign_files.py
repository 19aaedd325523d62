"""Small files in the public formats of programs and instruments, each with what it must become.

All hold the field of `FIELD` at `POINTS`, built here; none is a copy of a file.
"""

from __future__ import annotations

import codecs
from dataclasses import dataclass, field

import numpy as np

AXES = [-0.01, 0.0, 0.01], [-0.01, 0.0, 0.01], [-0.02, -0.01, 0.0, 0.01, 0.02]
POINTS = np.stack(np.meshgrid(*AXES, indexing="ij"), axis=-1).reshape(-1, 3)
"""z changes fastest; x, y and z of a point are in m."""
FIELD = np.column_stack([0.1 + 2 * POINTS[:, 1], 2 * POINTS[:, 0], 0.05 + 0 * POINTS[:, 2]])
"""B in T, another along every axis."""
LENGTH = np.linalg.norm(FIELD, axis=1)
LINE = np.column_stack([0 * LENGTH, 0 * LENGTH, 1e-3 * np.arange(len(LENGTH))])
"""Points in m of a line along z."""
BY_X = np.lexsort(POINTS.T)
"""Order of the points in which x changes fastest."""


@dataclass(frozen=True)
class Foreign:
    """A file, the options with which it is read, and what is said of it without them.

    ``stated`` are the options of `DeclaredFormat`; without any the file reads as it is. ``asked``
    are texts that the refusal without options must contain. ``points`` (n, 3) in m and ``field``
    (n, 3) in T are right, in any order.
    """

    name: str
    text: str | bytes
    stated: dict = field(default_factory=dict)
    asked: tuple[str, ...] = ()
    points: np.ndarray = field(default_factory=lambda: POINTS)
    field: np.ndarray = field(default_factory=lambda: FIELD)


def table(separator="\t", columns=None, order=None, number="{:.12g}", end=""):
    """Return rows of numbers; ``columns`` are arrays (45,)."""
    columns = mm_T() if columns is None else columns
    rows = np.column_stack(columns)
    rows = rows if order is None else rows[order]
    return "".join(separator.join(number.format(value) for value in row) + end + "\n"
                   for row in rows)


def mm_T(length=1e3, tesla=1.0):
    """Return the columns x, y, z, Bx, By, Bz in other units."""
    return [*(length * POINTS.T), *(tesla * FIELD.T)]


def spherical():
    """Return the columns r in mm, theta and phi in degrees, and B along these in T.

    The middle of the grid has no angles; 0 stands for them.
    """
    x, y, z = POINTS.T
    radius, phi = np.linalg.norm(POINTS, axis=1), np.arctan2(y, x)
    theta = np.arctan2(np.hypot(x, y), z)
    along = (np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]),
             np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]),
             np.array([-np.sin(phi), np.cos(phi), 0 * phi]))
    return [1e3 * radius, np.degrees(theta), np.degrees(phi),
            *(np.sum(FIELD.T * axis, axis=0) for axis in along)]


def comma(text):
    """Return a table with decimal commas."""
    return text.replace(".", ",")


def thousands(columns):
    """Return a CSV table with quoted numbers whose thousands are separated."""
    return "".join(",".join(f'"{value:,.3f}"' for value in row) + "\n"
                   for row in np.column_stack(columns))


def clock(n):
    """Return the time of day of reading ``n`` at intervals of 2 s."""
    return f"10:{n * 2 // 60:02d}:{n * 2 % 60:02d}"


def with_text(rows, before="{n},", after=""):
    """Return rows with cells before and after them, in which n is the number and t the time."""
    return "".join(before.format(n=n, t=clock(n)) + row + after.format(n=n, t=clock(n)) + "\n"
                   for n, row in enumerate(rows.splitlines()))


def srw(comment="#"):
    """Return a file of SRW; the third number sign is part of the format."""
    head = ["Bx [T], By [T], Bz [T] on 3D mesh: inmost loop vs X, outmost loop vs Z"]
    for axis, values in zip("XYZ", AXES, strict=True):
        head += [f"{values[0]} #initial {axis} position [m]", f"0.01 #step of {axis} [m]",
                 f"{len(values)} #number of points vs {axis}"]
    return "".join(f"{comment}{line}\n" for line in head) + table("\t", FIELD.T, BY_X)


def fluka(free=True):
    """Return cards of FLUKA with the field in T on a grid in cm."""
    def card(name, what, last=""):
        if free:
            return ", ".join([f"{name:10}", *(f"{v:.6E}" if v is not None else "" for v in what),
                              last]) + "\n"
        return f"{name:10}" + "".join(f"{v:10.3E}" if v is not None else " " * 10
                                      for v in what) + last + "\n"

    none = (None,) * 3
    text = ("FREE\n" if free else "* a comment\n") + card("MGNCREAT", (300.0, *none[:2], *none),
                                                          "MAGNET")
    text += card("MGNCREAT", (*none, 3, 3, 5), "&")
    text += card("MGNCREAT", (-1, -1, -2, 1, 1, 2), "&&")
    rows = FIELD[BY_X]
    for n in range(0, len(rows), 2):
        pair = [*rows[n], *(rows[n + 1] if n + 1 < len(rows) else none)]
        text += card("MGNDATA", pair, "&&")
    return text


def around(degrees):
    """Return points of a circle of 10 mm at z = 20 mm, and B there if Bx and By are Br and Bphi."""
    angle = np.radians(degrees)
    radial, azimuthal = FIELD[:, 0], FIELD[:, 1]
    return (np.column_stack([0.01 * np.cos(angle), 0.01 * np.sin(angle), 0.02 + 0 * angle]),
            np.column_stack([radial * np.cos(angle) - azimuthal * np.sin(angle),
                             radial * np.sin(angle) + azimuthal * np.cos(angle), np.nan * angle]))


MM_T_OPTIONS = {"length_unit": "mm", "field_unit": "T"}
SIX = ("x", "y", "z", "Bx", "By", "Bz")
BARE = ("--columns x,y,z,Bx,By,Bz", "--length-unit", "--field-unit")
UNITS = ("--length-unit", "--field-unit")
M_T = mm_T(1.0)
DASHES = "-" * 78 + "\n"
CARTESIAN = table(" ", M_T)
LVM = ("LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n"
       "Decimal_Separator\t.\nMulti_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\n"
       "***End_of_Header***\t\n\nChannels\t6\nSamples\t45\t45\t45\t45\t45\t45\n"
       "***End_of_Header***\t\t\t\t\t\t\t\n")
LVM_COLUMNS = ("-", "x[mm]", "y[mm]", "z[mm]", "Bx[T]", "By[T]", "Bz[T]", "-")
VTK = "# vtk DataFile Version 3.0\nof a magnet\nASCII\nDATASET "
POINT_DATA = "POINT_DATA 45\nVECTORS B double\n"
METER = ("Header Information\nInstrument serial number:,0001\nProbe temperature:,24.1\n\n"
         "time elapsed,date,time,magnitude,x,y,z,set point,input state\n")
METER_ROWS = "".join(f"{n},06/01/20,{clock(n)}.00,{LENGTH[n]:.9g},{b[0]:.9g},{b[1]:.9g},{b[2]:.9g},"
                     "0.0,0\n" for n, b in enumerate(FIELD))
TRIPLE = ("x[mm]", "y[mm]", "z[mm]", "Bx[T]", "By[T]", "Bz[T]")

FILES = [
    # programs of field computation
    Foreign("CST, V.s/m^2", "  x [mm]  y [mm]  z [mm]  x [V.s/m^2]  y [V.s/m^2]  z [V.s/m^2]\n"
            + DASHES + table("  ")),
    Foreign("CST, parts of complex numbers", "x [mm] y [mm] z [mm] BxRe [Vs/m^2] BxIm [Vs/m^2] "
            "ByRe [Vs/m^2] ByIm [Vs/m^2] BzRe [Vs/m^2] BzIm [Vs/m^2]\n" + DASHES + table(
                "  ", [*mm_T()[:3], FIELD[:, 0], 0 * LENGTH, FIELD[:, 1], 0 * LENGTH, FIELD[:, 2],
                       0 * LENGTH])),
    Foreign("CST, H in A/m", "x [mm]  y [mm]  z [mm]  Hx [A/m]  Hy [A/m]  Hz [A/m]\n" + table(
        "  ", mm_T(1e3, 1 / (4e-7 * np.pi)), number="{:.15g}")),
    Foreign("Ansys Maxwell .fld", "Grid Output Min: [-10mm -10mm -20mm] Max: [10mm 10mm 20mm] Grid "
            "Size: [10mm 10mm 10mm]\nX, Y, Z, Vector data \"B_Vector\"\n" + CARTESIAN,
            {"length_unit": "m", "field_unit": "T"}, UNITS),
    Foreign("Ansys Maxwell, CSV of a report", '"X [mm]","Y [mm]","Z [mm]","Bx [tesla]",'
            '"By [tesla]","Bz [tesla]"\n' + table(",")),
    Foreign("COMSOL, spreadsheet", "% Model: magnet.mph\n% Version: COMSOL 6.1\n% Dimension: 3\n"
            "% Nodes: 45\n% Expressions: 3\n% Length unit: mm\n"
            "% x y z mf.Bx (T) mf.By (T) mf.Bz (mT)\n" + table(
                " ", [*mm_T()[:5], 1e3 * FIELD[:, 2]])),
    Foreign("COMSOL, mfnc in mT with commas", "% Model,magnet.mph\n% Version,COMSOL 6.0\n"
            "% Dimension,3\n% Nodes,45\n% Expressions,3\n% Length unit,m\n"
            "% x,y,z,mfnc.Bx (mT),mfnc.By (mT),mfnc.Bz (mT)\n" + table(",", mm_T(1.0, 1e3))),
    Foreign("Opera, TABLE in cm and gauss", " 3 3 5 1\n 1 X [CM]\n 2 Y [CM]\n 3 Z [CM]\n"
            " 4 BX [GAUSS]\n 5 BY [GAUSS]\n 6 BZ [GAUSS]\n 0\n" + table(" ", mm_T(100, 1e4))),
    Foreign("TOSCA, without units", " 3 3 5 1\n 1 X [LENGU]\n 2 Y [LENGU]\n 3 Z [LENGU]\n"
            " 4 BX [FLUXU]\n 5 BY [FLUXU]\n 6 BZ [FLUXU]\n 0\n" + table(" ", mm_T(100, 1e4)),
            {"length_unit": "cm", "field_unit": "G"}, UNITS),
    Foreign("Radia, ObjGeo fields of a notebook", "x[mm] y[mm] z[mm] bx by bz\n" + table(" "),
            {"field_unit": "T"}, ("--field-unit",)),
    Foreign("Radia, brackets of a printed list", table(", ").replace("\n", ",\n"),
            {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("SRW", srw()),
    Foreign("SRW, spaces after the comments", srw("# ")),
    Foreign("FLUKA, free", fluka()),
    Foreign("FLUKA, fixed", fluka(free=False)),
    Foreign("G4beamline", "param normB=1.0\ngrid X0=-10 Y0=-10 Z0=-20 nX=3 nY=3 nZ=5 dX=10 dY=10 "
            "dZ=10\ndata\n" + table(" ")),
    Foreign("BDSIM", "xmin> -1\nxmax> 1\nnx> 3\nymin> -1\nymax> 1\nny> 3\nzmin> -2\nzmax> 2\n"
            "nz> 5\n! X Y Z Fx Fy Fz\n" + table(" ", mm_T(100), BY_X)),
    Foreign("counts above the rows", "#-----\n\t3\t3\t5\n# x\ty\tz\tBx\tBy\tBz\tpermeability\n"
            + table("\t", [*mm_T(), 0 * LENGTH + 1.26e-6]), MM_T_OPTIONS, UNITS),
    Foreign("number of points above the rows", "45\n" + table(" "),
            {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("ParaView, CSV", "B:0,B:1,B:2,Points:0,Points:1,Points:2\n" + table(
        ",", [*FIELD.T, *POINTS.T]), {"length_unit": "m", "field_unit": "T"}, UNITS),
    Foreign("OpenFOAM-like CSV", "x,y,z,B_x,B_y,B_z\n" + table(",", M_T),
            {"length_unit": "m", "field_unit": "T"}, UNITS),
    Foreign("OpenFOAM, xy of a sample line", "# z  B_x  B_y  B_z\n" + table(
        "\t", [LINE[:, 2], *FIELD.T]), {
            "length_unit": "m", "field_unit": "T", "at": {"x": 0.0, "y": 0.0}},
        ("--at x=0,y=0", *UNITS), LINE),
    Foreign("Elmer, SaveLine with indices", table(" ", [np.arange(1, 46), *M_T]),
            {"length_unit": "m", "field_unit": "T", "columns": ("-", *SIX)},
            ("its 7 columns",)),
    Foreign("FEMM, a line in mm of the plane", "x (mm),y (mm),Bx (T),By (T)\n" + table(
        ",", [1e3 * LINE[:, 2], LINE[:, 0], FIELD[:, 0], FIELD[:, 1]]), {"at": {"z": 0.0}},
        ("--at z=0",), LINE[:, [2, 1, 0]], FIELD * [1, 1, np.nan]),
    Foreign("Mathematica, numbers with *^", table(
        " ", number="{:.9e}").replace("e", "*^"),
            {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("MATLAB, writematrix", table(","), {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("MATLAB, writetable", "X_mm,Y_mm,Z_mm,Bx_T,By_T,Bz_T\n" + table(",")),
    Foreign("MATLAB, save -ascii", table("   ", number="{:.7e}"),
            {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("Origin, long names and units below", "X\tY\tZ\tBx\tBy\tBz\nmm\tmm\tmm\tmT\tmT\tmT\n"
            + table("\t", mm_T(1e3, 1e3))),
    Foreign("numpy, savetxt", "# x(mm) y(mm) z(mm) Bx(G) By(G) Bz(G)\n" + table(
        " ", mm_T(1e3, 1e4), number="{:.18e}")),
    Foreign("pandas, CSV with an index", ",x [mm],y [mm],z [mm],Bx [T],By [T],Bz [T]\n" + with_text(
        table(","))),
    Foreign("pandas, text of a frame", "   x   y   z   Bx  By  Bz\n" + with_text(
        table("  "), "{n}  "), {**MM_T_OPTIONS, "columns": ("-", *SIX)}, ("of 7 names",)),
    Foreign("Fortran, numbers with D", table(" ", number="{:.8E}").replace("E", "D"),
            {**MM_T_OPTIONS, "columns": SIX}, ("numbers",)),
    # instruments
    Foreign("Lake Shore, log without positions", METER + METER_ROWS,
            {"columns": ("-", "-", "-", "-", "Bx[T]", "By[T]", "Bz[T]", "-", "-"),
             "positions": True}, ("--positions", "Bx[T],By[T],Bz[T]")),
    Foreign("F.W. Bell, one component in kG", "Position (inch),Field (kG)\n" + table(
        ",", [LINE[:, 2] / 0.0254, 10 * FIELD[:, 0]]),
        {"columns": ("z[inch]", "Bx[kG]"), "at": {"x": 0.0, "y": 0.0}}, ("--columns",), LINE,
        FIELD * [1, np.nan, np.nan]),
    Foreign("Metrolab, probe in mG with a date", "Date,Time,X (mm),Y (mm),Z (mm),B (mG),Bx (mG),"
            "By (mG),Bz (mG),T (C)\n" + with_text(table(",", [
                *mm_T()[:3], 1e7 * LENGTH, *(1e7 * FIELD.T)]), "2024-05-31,{t},", ",24.5")),
    Foreign("Senis, mapper with a preamble", "Mapper;3MH6\nScan;plane\n\nX [mm];Y [mm];Z [mm];"
            "Bx [mT];By [mT];Bz [mT];T [°C]\n" + table(";", [*mm_T(1e3, 1e3), 24 + 0 * LENGTH])),
    Foreign("LabVIEW, lvm", LVM + "X_Value\tx\ty\tz\tHall 1\tHall 2\tHall 3\tComment\n" + with_text(
        table("\t"), "{n}.000000\t", "\t"), {"columns": LVM_COLUMNS}, ("--columns",)),
    Foreign("LabVIEW, lvm with decimal commas", LVM + "X_Value\tx\ty\tz\tHall 1\tHall 2\tHall 3\t"
            "Comment\n" + comma(with_text(table("\t"), "{n}.000000\t", "\t")),
            {"columns": LVM_COLUMNS, "decimal_comma": True}, ("--decimal-comma",)),
    Foreign("ROS bag, CSV", "%time,field.header.seq,field.position.x,field.position.y,"
            "field.position.z,field.magnetic_field.x,field.magnetic_field.y,field.magnetic_field.z"
            "\n" + with_text(table(",", M_T), "15{n:02d}000000000000000,{n},"),
            {"columns": ("-", "-", *(f"{n}[{u}]" for n, u in zip(
                SIX, ("m",) * 3 + ("T",) * 3, strict=True)))}, ("--columns",)),
    Foreign("ROS, echo of a topic", "time,.pose.position.x,.pose.position.y,.pose.position.z,"
            "magnetic_field.x,magnetic_field.y,magnetic_field.z\n" + with_text(table(",", M_T)),
            {"columns": ("t[s]", *(f"{n}[{u}]" for n, u in zip(
                SIX, ("m",) * 3 + ("T",) * 3, strict=True)))}, ("--columns",)),
    Foreign("phone app, uT and times", "Time (s),X (m),Y (m),Z (m),Magnetic Field x (uT),"
            "Magnetic Field y (uT),Magnetic Field z (uT)\n" + with_text(
                table(",", mm_T(1.0, 1e6)), "{n}.5,")),
    Foreign("stage of an open mapper", "# COSI log\n# date: 2018-01-01\n"
            "# X[mm],Y[mm],Z[mm],B0_x[mT],B0_y[mT],B0_z[mT],B0_abs[mT]\n" + table(
                ",", [*mm_T(1e3, 1e3), 1e3 * LENGTH])),
    Foreign("names with commas above tabs", "X [mm], Y [mm], Z [mm], Bx [mT], By [mT], Bz [mT]\n"
            + table("\t", mm_T(1e3, 1e3))),
    Foreign("counts of an ADC, 1e-7 T", "x[mm],y[mm],z[mm],Bx,By,Bz\n" + table(",", mm_T(1e3, 1e7)),
            {"field_unit": "1e-7 T"}, ("--field-unit",)),
    Foreign("a factor in every column", "x[mm],y[mm],z[mm],Bx,By,Bz\n" + table(
        ",", mm_T(1e3, 1e7)), {"columns": (*SIX[:3], "Bx[1e-7 T]", "By[1e-7 T]", "Bz[0.1 uT]")},
        ("--field-unit",)),
    Foreign("nT of a magnetometer", "x (cm);y (cm);z (cm);Bx (nT);By (nT);Bz (nT)\n" + table(
        ";", mm_T(100, 1e9))),
    Foreign("oersted", "x [cm] y [cm] z [cm] Hx [Oe] Hy [Oe] Hz [Oe]\n" + table(
        " ", mm_T(100, 1e4))),
    Foreign("Wb/m^2", "x (m) y (m) z (m) Bx (Wb/m^2) By (Wb/m^2) Bz (Wb/m2)\n" + table(" ", M_T)),
    # spreadsheets
    Foreign("semicolons and decimal commas", "x [mm];y [mm];z [mm];Bx [mT];By [mT];Bz [mT]\n"
            + comma(table(";", mm_T(1e3, 1e3), number="{:.3f}")), {"decimal_comma": True},
            ("--decimal-comma",)),
    Foreign("byte order mark of UTF-8", codecs.BOM_UTF8 + (
        "x [mm],y [mm],z [mm],Bx [T],By [T],Bz [T]\n" + table(",")).encode()),
    Foreign("UTF-16 of a spreadsheet", (
        "x [mm]\ty [mm]\tz [mm]\tBx [T]\tBy [T]\tBz [T]\n" + table("\t")).encode("utf-16")),
    Foreign("latin-1, µT", ("x [mm];y [mm];z [mm];Bx [µT];By [µT];Bz [µT]\n" + table(
        ";", mm_T(1e3, 1e6))).encode("latin-1"), {"encoding": "latin-1"}, ("--encoding latin-1",)),
    Foreign("line ends of DOS", ("x [mm],y [mm],z [mm],Bx [T],By [T],Bz [T]\n" + table(
        ",")).replace("\n", "\r\n")),
    Foreign("quoted cells and thousands", '"X [um]","Y [um]","Z [um]","Bx [uT]","By [uT]","Bz [uT]"'
            "\n" + thousands(mm_T(1e6, 1e6))),
    Foreign("commas at the end of all rows", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + table(
        ",", end=",")),
    Foreign("a doubled tab", "x[mm]\ty[mm]\tz[mm]\tBx[T]\tBy[T]\tBz[T]\n" + table("\t").replace(
        "\t", "\t\t", 1)),
    Foreign("header again above every scan", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n".join(
        ["", *("".join(table(",").splitlines(True)[n:n + 5]) for n in range(0, 45, 5))])),
    Foreign("blank lines between scans", "# x[mm] y[mm] z[mm] Bx[T] By[T] Bz[T]\n" + "\n\n".join(
        "".join(table(" ").splitlines(True)[n:n + 5]) for n in range(0, 45, 5))),
    Foreign("comments of C", "// map of the body\n// x[mm] y[mm] z[mm] Bx[T] By[T] Bz[T]\n"
            + table(" ")),
    Foreign("a preamble of numbers", "2024 5 31 10 24 30\n300 1 2\nx[mm] y[mm] z[mm] Bx[T] By[T] "
            "Bz[T]\n" + table(" "), {"skip_lines": 2}, ("--skip-lines",)),
    Foreign("tabs and spaces mixed", "x[mm] y[mm] z[mm] Bx[T] By[T] Bz[T]\n" + table(
        " \t ").replace(" \t ", "  ", 7)),
    Foreign("semicolons in a remark", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T],remark\n" + with_text(
        table(","), "", ",arm 2; up"), {"delimiter": "comma"}, ("--delimiter",)),
    Foreign("units that nobody knows", "x[ft],y[ft],z[ft],Bx[T],By[T],Bz[T]\n" + table(",", mm_T(
        1 / 0.3048)), {"columns": (*(f"{n}[12 inch]" for n in "xyz"), *SIX[3:])},
        ("'ft' is none of", "--columns")),
    # notations
    Foreign("Tecplot", 'VARIABLES = "x [m]", "y [m]", "z [m]", "Bx [T]", "By [T]", "Bz [T]"\n'
            "ZONE I=3 J=3 K=5\n" + CARTESIAN),
    Foreign("Superfish, units in brackets below", "   X   Y   Z   Bx   By   Bz\n  (cm)  (cm)  "
            "(cm)  (G)  (G)  (G)\n" + table("  ", mm_T(100, 1e4))),
    Foreign("MAD-X, tfs", "@ NAME %05s \"MAP\"\n* X Y Z BX BY BZ\n$ %le %le %le %le %le %le\n"
            + CARTESIAN, {"length_unit": "m", "field_unit": "T"}, UNITS),
    Foreign("ROOT, a scan of a tree", "*" * 60 + "\n*  Row * x * y * z * Bx * By * Bz *\n" + "*"
            * 60 + "\n" + with_text(table(" * "), "*  {n} * ", " *") + "*" * 60 + "\n",
            MM_T_OPTIONS, UNITS),
    Foreign("a table of Markdown", "| x [mm] | y [mm] | z [mm] | Bx [T] | By [T] | Bz [T] |\n"
            "|---|---|---|---|---|---|\n" + with_text(table(" | "), "| ", " |")),
    Foreign("lists of lists", "{" + with_text(table(", "), "{{", "}},").replace(
        "\n", " \n") + "}\n", {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("lists of points and fields", "".join(
        f"[{x:g}, {y:g}, {z:g}] [{b:.9g}, {c:.9g}, {d:.9g}]\n"
        for x, y, z, b, c, d in np.column_stack(mm_T())), {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("Fortran, columns of fixed width", "x y z Bx By Bz\n" + table(
        "", number="{:10.4f}"), MM_T_OPTIONS, UNITS),
    Foreign("JMAG", "X Coordinate[mm],Y Coordinate[mm],Z Coordinate[mm],X Component[T],"
            "Y Component[T],Z Component[T],Absolute[T]\n" + table(",", [*mm_T(), LENGTH])),
    Foreign("MagNet", "X (mm);Y (mm);Z (mm);B x-component (T);B y-component (T);B z-component (T)\n"
            + table(";")),
    Foreign("two lines of names above units", "Place\t\t\tField\t\t\nx\ty\tz\tx\ty\tz\nmm\tmm\tmm\t"
            "T\tT\tT\n" + table("\t")),
    Foreign("units after in", "x in mm;y in mm;z in mm;Bx in mT;By in mT;Bz in mT\n" + table(
        ";", mm_T(1e3, 1e3))),
    Foreign("units after blanks", "x mm;y mm;z mm;Bx mT;By mT;Bz mT\n" + table(
        ";", mm_T(1e3, 1e3))),
    Foreign("units in angle brackets", "x <mm>;y <mm>;z <mm>;Bx <T>;By <T>;Bz <T>\n" + table(";")),
    Foreign("German names", "Lage X [mm];Lage Y [mm];Lage Z [mm];Flussdichte Bx [T];Feld Y [T];"
            "Magnetfeld Bz [T]\n" + table(";")),
    Foreign("French names", "Position X (mm);Position Y (mm);Coordonnée Z (mm);Champ Bx (T);"
            "Champ By (T);Induction Bz (T)\n" + table(";")),
    Foreign("Chinese names and brackets", (
        "X坐标（mm），Y坐标（mm），Z坐标（mm），"
        "Bx（T），By（T），磁场Z（T）\n"
            + table(",")).encode("gbk"), {"encoding": "gbk"}, ("gbk",)),
    Foreign("Japanese names", "X座標[mm],Y座標[mm],Z座標[mm],Bx[T],By[T],"
            "磁束密度Bz[T]\n" + table(",")),
    Foreign("quoted decimal commas", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + "".join(
        ",".join(f'"{comma(cell)}"' for cell in row.split(",")) + "\n"
        for row in table(",").splitlines()), {"decimal_comma": True}, ("--decimal-comma",)),
    Foreign("typographic minus", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + table(",").replace(
        "-", "\u2212")),
    Foreign("thousands by apostrophes", "x[um];y[um];z[um];Bx[uT];By[uT];Bz[uT]\n" + thousands(
        mm_T(1e6, 1e6)).replace('","', ";").replace('"', "").replace(",", "'")),
    Foreign("thousands by points, decimal commas", "x[um];y[um];z[um];Bx[uT];By[uT];Bz[uT]\n"
            + thousands(mm_T(1e6, 1e6)).replace('","', ";").replace('"', "").translate(
                str.maketrans(",.", ".,")), {"decimal_comma": True}, ("--decimal-comma",)),
    Foreign("thousands by narrow blanks", "x[um];y[um];z[um];Bx[uT];By[uT];Bz[uT]\n"
            + thousands(mm_T(1e6, 1e6)).replace('","', ";").replace('"', "").translate(
                str.maketrans(",.", "\u202f,")), {"decimal_comma": True}, ("--decimal-comma",)),
    Foreign("marks at the end", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + table(",")
            + "\x1a\0\0\0"),
    Foreign("words where nothing was read", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + table(",")
            + "1,1,1,N/A,#N/A,0.1\n1,1,2,NULL,---,0.1\n1,1,3,NA,#NV,0.1\n",
            points=np.vstack([POINTS, [[1e-3, 1e-3, n * 1e-3] for n in (1, 2, 3)]]),
            field=np.vstack([FIELD, [[np.nan, np.nan, 0.1]] * 3])),
    Foreign("planes with z in a comment", "".join(
        f"# z = {1e3 * z:g} mm\n# x[mm] y[mm] Bx[T] By[T] Bz[T]\n" + table(" ", [
            column[POINTS[:, 2] == z] for column in (*mm_T()[:2], *FIELD.T)]) for z in AXES[2])),
    Foreign("half-plane of a field with symmetry", "R (cm)  Z (cm)  Br (G)  Bz (G)\n" + table(
        " ", [100 * LINE[:, 2], 0 * LENGTH, 1e4 * FIELD[:, 0], 1e4 * FIELD[:, 2]]), {
            "columns": ("x[cm]", "z[cm]", "Bx[G]", "Bz[G]"), "at": {"y": 0.0}},
        ("x for r", "--at y=0"), LINE[:, [2, 0, 1]], FIELD * [1, np.nan, 1]),
    Foreign("VTK, points in the header", VTK + "STRUCTURED_POINTS\nDIMENSIONS 3 3 5\nORIGIN -10 "
            "-10 -20\nSPACING 10 10 10\n" + POINT_DATA + table(" ", FIELD.T, BY_X), MM_T_OPTIONS,
            UNITS),
    Foreign("VTK, points before the field", VTK + "STRUCTURED_GRID\nDIMENSIONS 5 3 3\nPOINTS 45 "
            "double\n" + table(" ", mm_T()[:3]) + POINT_DATA + table(" ", FIELD.T), MM_T_OPTIONS,
            UNITS),
    Foreign("VTK, axes before the field, B in its unit", VTK + "RECTILINEAR_GRID\nDIMENSIONS 3 3 "
            "5\nX_COORDINATES 3 double\n-10 0 10\nY_COORDINATES 3 double\n-10 0 10\n"
            "Z_COORDINATES 5 double\n-20 -10 0 10 20\n" + POINT_DATA.replace(
                " B ", " B_field_mT ") + table(" ", 1e3 * FIELD.T, BY_X), {"length_unit": "mm"},
            UNITS[:1]),
    Foreign("Poisson, T7 with the grid above", "2DMagnetoStatic ZX\n-2 2 4\n0.2 1.0 14\n" + table(
        " ", FIELD[:, [2, 0]].T), {"skip_lines": 3, "columns": ("Bz[T]", "Bx[T]"),
                                  "positions": True}, ("add --skip-lines 3",),
            field=FIELD * [1, np.nan, 1]),
    Foreign("OPAL", "3DMagnetoStatic XYZ\n-1 1 2\n-1 1 2\n-2 2 4\n" + table(" ", FIELD.T), {
        "skip_lines": 4, "columns": ("Bx[T]", "By[T]", "Bz[T]"), "positions": True},
            ("--skip-lines 4",)),
    Foreign("FairRoot, limits of the grid above", "nosym\n-1 1 3\n-1 1 3\n-2 2 5\n" + table(
        " ", FIELD.T), {"skip_lines": 4, "columns": ("Bx[T]", "By[T]", "Bz[T]"), "positions": True},
            ("--skip-lines 4", "z changes fastest")),
    Foreign("limits of the grid above without a word", "-1 1 3\n-1 1 3\n-2 2 5\n" + table(
        " ", FIELD.T), {"skip_lines": 3, "columns": ("Bx[T]", "By[T]", "Bz[T]"), "positions": True},
            ("--skip-lines 3",)),
    Foreign("spherical coordinates", "r [mm],theta [deg],phi [deg],Br [T],Btheta [T],Bphi [T]\n"
            + table(",", spherical())),
    Foreign("spherical coordinates of mathematicians", "r [mm],theta [deg],phi [deg],Bx [T],By [T],"
            "Bz [T]\n" + table(",", [spherical()[one] for one in (0, 2, 1)] + [*FIELD.T]), {
                "columns": ("r[mm]", "phi[deg]", "theta[deg]", "Bx[T]", "By[T]", "Bz[T]")},
            ("exchange theta and phi",)),
    Foreign("Spanish names", "Posición x (mm);Posición y (mm);Posición z (mm);Campo Bx (G);"
            "Campo By (G);Campo Bz (G)\n" + table(";", mm_T(1e3, 1e4))),
    Foreign("French names, another word for each axis", "Abscisse x (mm);Ordonnée y (mm);"
            "Cote z (mm);Composante x (mT);Composante y (mT);Composante z (mT)\n" + table(
                ";", mm_T(1e3, 1e3))),
    Foreign("Russian names and units", "X, мм;Y, мм;Z, мм;"
            "Bx, мТл;By, мТл;Bz, мТл\n" + table(
                ";", mm_T(1e3, 1e3))),
    Foreign("marks of TeX", "$x$ [mm],$y$ [mm],$z$ [mm],$B_x$ [T],$B_{y}$ [T],$B_z$ [T]\n"
            + table(",")),
    Foreign("lowered letters", "x / mm;y / mm;z / mm;B\u2093 / T;B\u1d67 / T;B_z / T\n"
            + table(";")),
    Foreign("powers of ten", "x (10^-3 m),y (10**-3 m),z (10⁻³ m),Bx (10^-4 T),"
            "By (10^{-4} T),Bz (10⁻⁴ T)\n" + table(",", mm_T(1e3, 1e4))),
    Foreign("channels of a three-axis meter", "Pos X(mm)\tPos Y(mm)\tPos Z(mm)\tCh X (kG)\t"
            "Ch Y (kG)\tCh Z (kG)\tVector (kG)\n" + table("\t", [*mm_T(1e3, 10), 10 * LENGTH])),
    Foreign("field sampler, smoothed", "X (m)\tY (m)\tZ (m)\t|B| smoothed (T)\tB smoothed x (T)\t"
            "B smoothed y (T)\tB smoothed z (T)\n" + table("\t", [*M_T[:3], LENGTH, *FIELD.T])),
    Foreign("axes of a fluxgate, quoted decimal commas", '"Format",de-DE\n\n"Time [ms]",'
            '"X-Axis [T]","Y-Axis [T]","Z-Axis [T]"\n' + "".join(
                f"{n},{b}\n" for n, b in enumerate(",".join(
                    f'"{value:.9E}"'.replace(".", ",") for value in row) for row in FIELD)),
            {"decimal_comma": True, "positions": True}, ("--decimal-comma",)),
    Foreign("Ansys Maxwell, components of a vector", "Grid Output Min: [-10mm -10mm -20mm]\n"
            'X, Y, Z, Vector data "<Bx,By,Bz>"\n' + CARTESIAN,
            {"length_unit": "m", "field_unit": "T"}, (*UNITS, "Bx, By, Bz")),
    Foreign("MATLAB, a matrix in a script", "% x y z in mm, B in T\nB = [\n" + table(" ", end=";")
            + "];\n", {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("Fortran, exponents of three digits", "x[m] y[m] z[m] Bx[T] By[T] Bz[T]\n" + table(
        " ", M_T).replace(" 0 ", " 0.12345-103 ")),
    Foreign("columns that are no component", "x[mm],y[mm],z[mm],By[T],Bx raw[T],Bz raw[T]\n"
            + table(",", [*mm_T()[:3], *FIELD.T[[1, 0, 2]]]), {
                "columns": ("x", "y", "z", "By", "Bx", "Bz")},
            ("whether 'Bx raw[T]' and 'Bz raw[T]' are Bx and Bz",)),
    Foreign("a circle of angles", "angle (deg),Br (mT),Bt (mT)\n" + table(",", [
        8 * np.arange(45.0), 1e3 * FIELD[:, 0], 1e3 * FIELD[:, 1]]), {
            "columns": ("phi[deg]", "Br", "Bphi"), "at": {"r": 0.01, "z": 0.02}},
        ("--at r=0.01,z=0.01",), *around(8 * np.arange(45.0))),
    Foreign("the middle twice", "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n" + table(",")
            + "0,0,0,0.1,1e-6,0.05\n", points=np.vstack([POINTS, [[0, 0, 0]]]),
            field=np.vstack([FIELD, [[0.1, 1e-6, 0.05]]])),
    Foreign("a word before the names", "### Map 7\n### Coordinates: x (mm), y (mm), z (mm), "
            "Bx (T), By (T), Bz (T)\n" + table(" ")),
    Foreign("Mathematica, lists without blanks", "".join(
        f"{{{{{x:g},{y:g},{z:g}}},{{{a:.12g},{b:.12g},{c:.12g}}}}}\n"
        for x, y, z, a, b, c in np.column_stack(mm_T())), {**MM_T_OPTIONS, "columns": SIX}, BARE),
    Foreign("counts and limits above the rows", "45\n3 3 5\n-0.01 0.01\n-0.01 0.01\n-0.02 0.02\n"
            + table(" ", M_T), {"skip_lines": 5, "length_unit": "m", "field_unit": "T",
                                "columns": SIX}, ("From line 6 on", "--skip-lines 5")),
    Foreign("Ansys, complex H", 'X, Y, Z, Complex Vector data "<Hx,Hy,Hz>"\n' + table(" ", [
        *M_T[:3], *(column for of_h in FIELD.T for column in (of_h / (4e-7 * np.pi), 0 * of_h))]), {
            "columns": ("x[m]", "y[m]", "z[m]", "Hx[A/m]", "-", "Hy[A/m]", "-", "Hz[A/m]", "-")},
        ("of 9 names", "--columns")),
    Foreign("volts at a place above them", "X = 0.01 +/- 0.004 \t Y = 0.02 +/- 0.005\n\ntime [s]\t"
            "Strip_V\tXfield_V\tYfield_V\tZfield_V\n" + table("\t", [
                LINE[:, 2], LENGTH, *(10 * FIELD.T)]), {
            "columns": ("t[s]", "-", "Bx[0.1 T]", "By[0.1 T]", "Bz[0.1 T]"),
            "at": {"x": 0.01, "y": 0.02, "z": 0.0}}, ("nothing is known of 'Strip_V'", "Xfield_V"),
            0 * POINTS + [0.01, 0.02, 0.0]),
]
