"""Every kind of error that the models can raise has a sentence of ours."""

from __future__ import annotations

import datetime
import math
from typing import get_args

import pytest
from pydantic_core import ErrorType

from halbach_fe.core.errors import StudyError
from halbach_fe.study import types
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import DIPOLE, ROOT, changed

TYPES = {
    "model": {"model_type", "model_attributes_type"},
    "model-fields": {"missing", "extra_forbidden"}, "float": {"float_type", "float_parsing"},
    "int": {"int_type", "int_parsing", "int_from_float", "int_parsing_size"},
    "bool": {"bool_type", "bool_parsing"}, "str": {"string_type", "string_unicode"},
    "literal": {"literal_error"}, "dict": {"dict_type"},
    "tuple": {"tuple_type", "missing", "too_long"},
    "tagged-union": {"union_tag_invalid", "union_tag_not_found", "model_attributes_type"},
    **{neither: set() for neither in (
        "definitions", "definition-ref", "function-after", "function-before", "function-wrap",
        "no-info", "model-field", "default", "nullable")}}
"""Kinds of errors by type of pydantic's own schema; validators of ours raise errors of ours."""

LIMITS = {
    "gt": "greater_than", "ge": "greater_than_equal", "lt": "less_than", "le": "less_than_equal",
    "allow_inf_nan": "finite_number", "pattern": "string_pattern_mismatch"}


def nodes(schema):
    """Every node of pydantic's own schema, but for what is for documents only."""
    waiting, seen = [schema], set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            if id(node) in seen:
                continue
            seen.add(id(node))
            if isinstance(node.get("type"), str):
                yield node
            waiting += [value for key, value in node.items()
                        if key not in ("metadata", "json_schema_input_schema", "serialization")]
        elif isinstance(node, list | tuple):
            waiting += node


def test_every_kind_of_error_has_a_sentence():
    kinds, patterns = set(), set()
    for node in nodes(Study.__pydantic_core_schema__):
        kinds |= TYPES[node["type"]]  # an unknown type must be looked at
        kinds |= {kind for key, kind in LIMITS.items() if key in node}
        what = "string_too" if node["type"] == "str" else "too"
        kinds |= {f"{what}_{end}" for key, end in (("min_length", "short"), ("max_length", "long"))
                  if key in node}
        patterns |= {node["pattern"]} if "pattern" in node else set()
    kinds.add("string_too_short")  # of texts that a validator of ours has seen before
    assert kinds - {"string_pattern_mismatch"} == set(types.EXPECTED)
    assert patterns == set(types.PATTERNS)
    assert kinds <= set(get_args(ErrorType))


@pytest.mark.parametrize(("changes", "said"), [
    ({"name": "a b"}, "`name` of study must be a name of letters (a to z), digits, '.', '_' and "),
    ({"name": "a" * 101}, "a text of at most 100 characters"),
    ({"name": 3}, "a text in quotation marks; instead received 3."),
    ({"observation__positions__kind": "sphere"}, "`observation.positions.kind` of study must be "
     "one of 'line', 'circles', 'grid', 'points'; instead received 'sphere'."),
    ({"observation__positions__kind": "circle"}, "Did you mean 'circles'?"),
    ({"observation__positions": {"radius_m": 0.05, "angles": 8}}, "`observation.positions.kind` of "
     "study must be given; instead received nothing. Add the key, as one of 'line', 'circles', "
     "'grid', 'points'."),
    ({"observation__positions": 3}, "`observation.positions` of study must be a table of keys"),
    ({"array__block": {}}, "Add the key, as one of 'sector', 'trapezoid', 'cuboid'."),
    ({"array__block__shape": "hexagon"}, "`array.block.shape` of study must be one of"),
    ({"iron": {"relative_permeability": 9, "bodies": [{"kind": "tub"}]}},
     "`iron.bodies[1].kind` of study must be one of 'tube', 'prism', 'box', 'sphere', "
     "'revolved', 'stl'; instead received 'tub'. "
     "Did you mean 'tube'?"),
    ({"array": {"free_blocks": "blocks.csv"}}, "free_blocks = { file ="),
    ({"array": []}, "`array` of study must be a table of keys; instead received a list of 0."),
    ({"array__blocks_per_ring": 16.5}, "a whole number; instead received 16.5."),
    ({"array__blocks_per_ring": 10**30}, "less than or equal to 512; instead"),
    ({"array__inner_radius_m": datetime.date(2020, 1, 1)}, "a number; instead received 2020-01-01"),
    ({"array__inner_radius_m": math.nan}, "a finite number; instead received nan"),
    ({"array__recoil_permeability": math.inf}, "less than or equal to 2"),
    ({"observation__components": "xy"}, "`observation.components` of study must be a list"),
    ({"observation__components": ["w"]}, "must be 'x', 'y' or 'z'; instead received 'w'."),
    ({"observation__components": []}, "a list with 1 or more elements"),
    ({"instrument": {"crosstalk": {"xx": 0.1}}}, "`instrument.crosstalk.xx` of study must be 'xy'"),
    ({"instrument": {"translation_m": [1.0, 2.0]}}, "`instrument.translation_m[3]` of study must "
     "be given"),
    ({"instrument": {"translation_m": [1.0, 2.0, 3.0, 4.0]}}, "a list with at most 3 elements"),
    ({"array__exceptions": [{"slot": 17, "magnetization_factor": 0}]},
     "an exception names slot 17 of an array of"),
    ({"array__exceptions": [{"ring": 2, "magnetization_factor": 0}]},
     "an exception names ring 2 of an array of"),
    ({"noise": {"regions": [{"name": "a", "sigma_T": 1e300}]}}, "less than or equal to 1"),
    ({"maps": {"name": "a", "file": "a.csv"}}, "`maps` of study must be a list; instead received a "
     "table. Write [[maps]] for [maps], and once more for each further one."),
    ({"instrument": {"gain": {"x": 0.1}}}, "must be a list; instead received a table. "
     "Write it in brackets, an element for each axis or part."),
    ({"instrument": {"field_axes": "y,x,z"}}, "instead received 'y,x,z'. Write it in brackets"),
    ({"iron_ring__curve": [[0, 0], [100, 1]]}, "a list of 2. Name a steel, { kind = \"steel\""),
    ({"iron_ring__curve": "aisi_1010"}, "'aisi_1010'. Name a steel, { kind = \"steel\""),
    ({"instrument": {"gain": 1.02}}, "a list; instead received 1.02. Write it in brackets, an "
     "element for each axis or part. It is the deviation from 1: if 1.02 is the whole factor, "
     "write 0.02;"),
    ({"maps": [{"name": "a", "file": ""}]}, "`maps[1].file` of study must be a text of 1 or more"),
    ({"demagnetization": {"irreversible": "maybe"}}, "`demagnetization"),
])
def test_sentences_are_ours(changes, said):
    with pytest.raises(StudyError) as caught:
        parse_study(changed(DIPOLE, **changes))
    sentence = str(caught.value)
    assert said in sentence
    for theirs in ("Input should", "pattern", "^", "tag", "valid", "None", "using", "Value error"):
        assert theirs not in sentence
    study = parse_study(DIPOLE)
    if set(changes) == {"name"}:
        with pytest.raises(StudyError) as caught:
            study.with_(**changes)
        assert sentence.partition("must be ")[2][:20] in str(caught.value)


@pytest.mark.parametrize("changes", [
    {"gain": 0.01}, {"translation_m": 0.002}, {"sensor_position_m": [0.001, 0.0, 0.0]}])
def test_a_number_for_a_list_is_not_said_to_be_in_another_unit(changes):
    """Of a gain of 0.01 per cent were asked for, "then write 0.0001"."""
    with pytest.raises(StudyError, match="an element for each axis or part") as caught:
        parse_study(changed(DIPOLE, instrument=changes))
    assert "Was it meant" not in str(caught.value)


@pytest.mark.parametrize(("changes", "said"), [
    ({"array": {"remanence_T": 1.2}}, "instead received nothing. Add the keys. `array={...}` is "
     "a whole new table; `array__KEY=...` changes one of its keys."),
    ({"array__inner_radius_mm": 100},
     "Did you mean `inner_radius_m`? Then convert its values to m."),
    ({"array__inner_diameter_m": 0.1}, "Did you mean `inner_radius_m`? Then halve its values."),
    ({"array__outer_diameter_mm": 200},
     "Did you mean `outer_radius_m`? Then halve its values and convert them to m."),
    ({"observation__positions": {"radius_m": 0.1}}, "Add the key, as one of 'line', 'circles', "),
])
def test_changes_have_the_sentences_of_a_file(changes, said):
    study = parse_study(DIPOLE)
    assert study.with_(array__remanence_T=1.2).array.remanence_T == 1.2  # the control
    with pytest.raises(StudyError) as caught:
        study.with_(**changes)
    assert said in str(caught.value)


def test_an_element_that_is_wrong_is_counted_once():
    """pydantic finds a list of tables too short besides, if its only one is wrong."""
    layer = {"radii_m": [0.1, 0.11], "blocks_per_ring": [8], "sizes_m": [0.01]}
    design = {"rings": 3, "spacing_m": 0.02, "least_field_T": 0.01, "layer": [layer]}
    with pytest.raises(StudyError, match=r"or none\.$"):
        parse_study(changed(DIPOLE, design=design))
    with pytest.raises(StudyError, match=r"\(1 more in this file\.\)$"):  # the control
        parse_study(changed(DIPOLE, design={**design, "spacing_m": 20.0}))


def test_a_byte_order_mark(tmp_path):
    """Which some editors put at the beginning of a text."""
    text = (ROOT / "studies" / "quadrupole" / "study.toml").read_bytes()
    path = tmp_path / "study.toml"
    path.write_bytes(b"\xef\xbb\xbf" + text)
    assert read_study(path) == read_study(ROOT / "studies" / "quadrupole" / "study.toml")
