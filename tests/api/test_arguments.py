"""Every public function refuses arguments of other kinds by a sentence, before it works."""

from __future__ import annotations

import inspect
from fractions import Fraction

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.core.interface import typed

FUNCTIONS = [name for name in hf.__all__ if not inspect.isclass(getattr(hf, name))]
WRONG = (object(), 1j, b"bytes", int, iter(["gain_x"]))
"""What no argument is, but for those of `ANYTHING`; a class is taken where a function is."""
ANYTHING = {("write_report", "result"), ("field_map", "points_m"), ("field_map", "B_T"),
            ("field_map", "sigma_T"), ("from_magpylib", "sources")}
"""Arguments that are looked at by the functions themselves."""
RING = {"order": 1, "blocks": 8, "inner_radius_m": 0.03, "outer_radius_m": 0.05}


@pytest.fixture(scope="module")
def known():
    """What the arguments of all functions are, by their names."""
    ring = hf.halbach_ring(**RING)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = 0.02 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    data = hf.field_map(points, ring.field_T(points) + 1e-5, sigma_T=1e-4)
    result = hf.infer(ring, data)
    return RING | {
        "magnet": ring, "study": ring.study, "data": data, "result": result,
        "session": hf.Session.temporary(), "magnetizations": result.posterior,
        "points_m": points, "B_T": points, "lines": hf.Lines((0, 0, 0), (0.01, 0, 0), count=3),
        "maps": {"a": data}, "content": data, "path": "file", "folder": "folder",
        "folders": ["folder"], "output": "page.html", "sources": [], "posterior": result,
        "table": {"name": ["a"]}, "blocks": hf.BlockTable(
            ("a",), ("1",), np.zeros(1, int), np.zeros(1, int), np.ones((1, 3)), np.ones(1),
            np.ones(1), np.ones(1), {}, "table")}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arguments_of_other_kinds(name, known, tmp_path, monkeypatch):
    """Unknown ones too, and missing ones."""
    monkeypatch.chdir(tmp_path)
    function = getattr(hf, name)
    named = [one for one in inspect.signature(function).parameters.values()
             if one.kind is not one.VAR_KEYWORD]
    right = {one.name: 8 if name == "halbach_ring" and one.name == "blocks" else known[one.name]
             for one in named if one.default is one.empty}
    with pytest.raises(hf.HalbachError, match="nonsense"):
        function(**right, nonsense=1)
    if right:
        with pytest.raises(hf.HalbachError, match="missing"):
            function()
    for one in named:
        for wrong in WRONG:
            if (name, one.name) in ANYTHING or (
                    callable(wrong) and one.name in ("say", "progress")):
                continue
            with pytest.raises(hf.HalbachError, match=one.name):
                function(**right | {one.name: wrong})
    assert not list(tmp_path.iterdir())


@typed
def sample(number: float = 1.0, flag: bool = False, names: tuple[str, ...] = (),
           several: list[int] | None = None) -> str:
    return "taken"


@pytest.mark.parametrize("right", [
    {"number": 2}, {"number": np.float32(2)}, {"number": np.array(2.0)}, {"flag": np.True_},
    {"names": ["a"]}, {"names": ("a", "b")}, {"names": {"a": 1}.keys()}, {"several": None},
    {"several": np.arange(3)}, {"several": range(3)}])
def test_what_is_taken(right):
    """The control: numbers of numpy, and lists of any kind."""
    assert sample(**right) == "taken"


@pytest.mark.parametrize(("wrong", "said"), [
    ({"number": "2 mm"}, "number of sample must be a number; instead received '2 mm'"),
    ({"number": True}, "instead received True"), ({"number": None}, "a NoneType"),
    ({"number": Fraction(1, 50)}, r"a number; instead received 1/50. Take float\(\) of it"),
    ({"number": 10**400}, "must be a number"), ({"number": np.ones(2)}, "a ndarray"),
    ({"flag": 1}, "must be True or False; instead received 1"),
    ({"names": [1]}, "instead received a list of int"),
    ({"names": 3}, "must be a list of text; instead received 3"),
    ({"several": {"a": 1}}, r"must be a list of numbers; .* a dict"),
    ({"several": ["a"]}, "must be a list of numbers; instead received a list of str"),
    ({"names": (one for one in "ab")}, "a generator. It can be read only once; make a list"),
    ({"several": iter([1])}, "must be a list"), ({"names": map(str, [1])}, "make a list of it")])
def test_what_is_not_taken(wrong, said):
    with pytest.raises(hf.HalbachError, match=said):
        sample(**wrong)


def test_what_the_axis_is_asked_of(known):
    """Of a result of `infer` too, which the refusal says."""
    with pytest.raises(hf.HalbachError, match=r"missing a required argument: 'session'"):
        hf.magnetic_axis(known["magnet"])
    with pytest.raises(hf.HalbachError, match=r"a Gaussian or an InferenceResult; instead .* 3"):
        hf.magnetic_axis(known["magnet"], known["session"], 3)
    assert hf.magnetic_axis(known["magnet"], known["session"], known["result"]).order == 1


@pytest.mark.parametrize("names", [("prior", "posterior"), ("posterior", "prior")])
def test_the_posterior_is_taken_by_its_name(known, names):
    """In any order. Control: that of the prior is wider."""
    lines = hf.Lines((0, 0, 0), (0.01, 0, 0), count=3)

    def spread(of):
        return hf.field(known["magnet"], lines, posterior=of).sd.max()

    both = {name: getattr(known["result"], name) for name in names}
    assert spread(both) == pytest.approx(spread(known["result"]), rel=1e-9)  # of the same numbers
    assert spread({"prior": both["prior"]}) > 2 * spread(both)


MAP_TEXT = "x,y,z,Bx,By,Bz\n1,2,3,.1,.1,.2\n2,2,3,.1,.1,.21\n"
BLOCKS_TEXT = ("name,type,moment_x[A m^2],moment_y[A m^2],moment_z[A m^2],volume[cm^3],"
               "sigma[A m^2]\na,1,5,0,0,5,0.01\n")


@pytest.mark.parametrize(("function", "wrong"), [
    *((hf.import_map, one) for one in (
        {"columns": 3}, {"columns": "x,y"}, {"columns": [1, 2]}, {"columns": iter("xyz")},
        {"length_unit": 3}, {"length_unit": "foo"}, {"field_unit": "mm"}, {"origin_m": "a"},
        {"origin_m": (1, 2)}, {"origin_m": (0, 0, np.nan)}, {"at": 3}, {"at": {"q": 1}},
        {"at": {"z": "a"}}, {"component": 3}, {"component": "q"}, {"encoding": 3},
        {"decimal_comma": "x"}, {"delimiter": 3}, {"delimiter": ","}, {"skip_lines": "a"},
        {"skip_lines": -1}, {"skip_lines": 0.5}, {"positions": 3}, {"angle_unit": "turn"})),
    *((hf.import_blocks, one) for one in (
        {"columns": 3}, {"axes": 3}, {"axes": ("x", "y")}, {"axes": ("x", "x", "z")},
        {"fixed": {"type": 3}}, {"fixed": {"foo": "3"}}, {"length_unit": 3}, {"component": "x"}))])
def test_what_is_stated_of_files(function, wrong, tmp_path):
    """Each is refused by one sentence that begins with its name."""
    path = tmp_path / "file.csv"
    path.write_text(MAP_TEXT if function is hf.import_map else BLOCKS_TEXT)
    right = {"length_unit": "mm", "field_unit": "T"} if function is hf.import_map else {}
    (name,) = wrong
    with pytest.raises(hf.HalbachError, match=f"^Input {name} of hf.{function.__name__} must be "):
        function(path, **right | wrong)


def test_what_may_be_stated_of_files(tmp_path):
    """The control: lists of any kind, numbers of numpy, paths as text, factors of units."""
    path, places = tmp_path / "file.csv", tmp_path / "places.txt"
    path.write_text(MAP_TEXT)
    found = hf.import_map(path, length_unit="mm", field_unit="0.1 T", origin_m=np.array([0, 0, 1]),
                          columns=np.array(["x", "y", "-", "Bx", "By", "Bz"]),
                          skip_lines=np.int64(1), delimiter="comma", at={"z": np.int64(2)})
    assert found["z_m"].values == pytest.approx([3, 3])
    assert found["B_T"].values[0] == pytest.approx([0.01, 0.01, 0.02])
    path.write_text("Bx,By,Bz\n.1,.1,.2\n.1,.1,.21\n")
    places.write_text("x[mm],y[mm],z[mm]\n1,2,3\n2,2,3\n")
    assert hf.import_map(path, positions=str(places), field_unit="T").sizes["point"] == 2
    path.write_text(BLOCKS_TEXT)
    assert hf.import_blocks(path, axes=["y", "-x", "z"]).moment[0] == pytest.approx([0, 5, 0])
