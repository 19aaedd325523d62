"""Study files made up from the schema: keys right and wrong, values that fit and that do not."""

from __future__ import annotations

import json
from functools import cache
from random import Random
from typing import Any

from halbach_fe.study.model import Study

RICH = b"""
name = "rich"
description = "all tables"
dimension = 3
plan = { points = 3, candidates = [{ kind = "points", points_m = [[0, 0, 0], [0, 0, 1]] }] }

[array]
multipole_order = 1
blocks_per_ring = 8
rings = 2
inner_radius_m = 0.1
outer_radius_m = 0.18
ring_length_m = 0.08
remanence_T = 1.06
recoil_permeability = 1.05
block = { shape = "trapezoid", side_gap_m = 1e-3 }

[[array.exceptions]]
ring = 1
slot = 3
mounted_from = [2, 3]
rotation_deg = [0, 180, 0]

[[array.exceptions]]
slot = 5
magnetization_factor = -1.0

[iron_ring]
inner_radius_m = 0.19
outer_radius_m = 0.21

[iron_ring.curve]
kind = "table"
H_A_per_m = [100.0, 160.0, 382.0, 758.0, 1837.0]
B_T = [0.1, 0.25, 1.0, 1.3, 1.5]

[external]
background_T = [0, 0, 5e-5]
neighbours = [{ z_m = 2.0, turn_deg = 90 }]
dipoles = [{ position_m = [1, 1, 0], moment_A_m2 = [0, 0, 10] }]
coils = [{ kind = "round", radius_m = 0.5, section_m = [0.02, 0.1], current_A = 3.0, turns = 100 }]

[instrument]
length_unit_m = 0.001
field_axes = ["y", "-x", "z"]
crosstalk = { xy = 0.01 }

[instrument_sd]
translation_m = 1e-3
gain = 0.01

[[maps]]
name = "body"
file = "body.csv"
probe = "hall"

[[maps]]
name = "end"
file = "end.csv"
noise = { position_sd_m = 1e-5 }

[mesh]
block_size_m = 0.03
growth = 2.0

[open_boundary]
radius_m = 1.0

[solver]
method = "reaction"
route = "auto"

[observation]
quantity = "flux_density"
components = ["x", "z"]
positions = { kind = "grid", start_m = [0, 0, -0.5], end_m = [0.01, 0.01, 0.5], count = [2, 2, 5] }

[noise]
position_sd_m = [1e-4, 1e-4, 2e-4]

[[noise.regions]]
name = "body"
z_min_m = -0.5
z_max_m = 0.5
sigma_T = 2e-5

[[noise.regions]]
name = "else"
sigma_T = 5e-5

[prior]
magnitude_sd = 0.01
types = { a = [1, 3, 5, 7], b = [2, 4, 6, 8] }

[inference]
excluded_readings = [12, { row = 40, components = ["z"] }]
held_out = { every = 2, z_ranges_m = [[0.4, 0.8]] }

[demagnetization]
intrinsic_coercivity_A_per_m = 955e3
remanence_coefficient_per_K = -0.0012
coercivity_coefficient_per_K = -0.006
"""

FREE = b"""
name = "free"
dimension = 3
mesh = { block_size_m = 0.03 }

[array]
inner_radius_m = 0.1
outer_radius_m = 0.18
ring_length_m = 0.08
block = { shape = "sector", angular_gap_deg = 1.0 }

[[array.ring]]
count = 2
blocks_per_ring = 8
material = "N42SH"

[[array.ring]]
layer = 2
blocks_per_ring = 12
first_block_angle_deg = 15.0
inner_radius_m = 0.2
outer_radius_m = 0.22
remanence_T = 1.1
z_m = 0.04

[array.free_blocks]
name = ["a", "b"]
shape = ["cuboid", "cuboid"]
x_m = [0.0, 0.0]
y_m = [0.0, 0.0]
z_m = [0.4, -0.4]
rotation_x_deg = [0.0, 90.0]
size_x_m = [0.02, 0.01]
size_y_m = [0.02, 0.01]
size_z_m = [0.02, 0.02]
remanence_T = [1.2, 1.3]

[iron]
relative_permeability = 100.0

[[iron.bodies]]
kind = "tube"
inner_radius_m = 0.25
outer_radius_m = 0.26
length_m = 0.3

[observation]
quantity = "flux_density"
positions = { kind = "points", points_m = [[0, 0, 0]] }
"""

HOSTILE = ("", " ", "a\nb", "}; Exit; Group {", "../../../etc/passwd", "/etc/passwd", "\x1b[31mred",
           "<script>alert(1)</script>", "</script><!--", "{{ 7*7 }}", "<< 7*7 >>", "<% raise %>",
           "$\\frac$", "[red]bold[/red]", "\x00", "\x7f", "\u202e", "\ud7ff", "日本語", "nan",
           "a" * 300, "a" * 5000, "%s%n", "=1+1", "_hidden", "`id`", "$(id)", "a\\", "\u2028",
           "\r", "0", "x")
ODD: tuple[Any, ...] = (
    0, -1, 1, 2, 10**6, 10**9, 2**63, -2**63, 10**20, 10**400, 0.0, -0.0, 1e308, -1e308, 5e-324,
    float("nan"), float("inf"), -float("inf"), True, False, "", "1", [], {}, [[]], [{}], {"a": 1},
    [1, 2, 3], ["x"], [[1, 2], [3, 4]], [0.0] * 3, [float("nan")] * 3, "1979-05-27")
DATES = ("1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "0x10", "0b1", "1_000", "1e400", "+inf",
         "1e-400", '"""a\nb"""', "'''x'''", "[" * 40 + "]" * 40)


@cache
def _schema() -> dict[str, Any]:
    return Study.model_json_schema()


def document(random: Random) -> bytes:
    """A study file, most of it right."""
    wrong = random.choice((0.0, 0.0, 0.005, 0.02, 0.1))
    made = _value(_schema(), random, wrong, 0)
    return _toml(made, random, wrong).encode("utf-8", "surrogatepass")


def _value(schema: dict[str, Any], random: Random, wrong: float, depth: int) -> Any:
    if random.random() < wrong:
        return random.choice((*ODD, *HOSTILE))
    if "$ref" in schema:
        return _value(_schema()["$defs"][schema["$ref"].rpartition("/")[2]], random, wrong, depth)
    if "const" in schema:
        return schema["const"]
    if "enum" in schema:
        return random.choice(schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            ways = [way for way in schema[key] if way.get("type") != "null"]
            return _value(random.choice(ways), random, wrong, depth)
    kind = schema.get("type")
    if kind == "object":
        return _object(schema, random, wrong, depth)
    if kind == "array":
        return _array(schema, random, wrong, depth)
    if kind == "boolean":
        return random.random() < 0.5
    if kind == "string":
        hostile = random.choice(HOSTILE)
        return random.choice((hostile, "a1", "aisi_1010"))
    low = schema.get("minimum", schema.get("exclusiveMinimum", -10))
    high = schema.get("maximum", schema.get("exclusiveMaximum", 50))
    if kind == "integer":
        return random.randint(int(low), min(int(high), int(low) + random.choice((3, 20))))
    return random.choice((low, high, low + (high - low) * random.random(),
                          low + min(high - low, 1) * random.random() ** 3))


def _object(schema: dict[str, Any], random: Random, wrong: float, depth: int) -> dict[str, Any]:
    made: dict[str, Any] = {}
    needed = set(schema.get("required", ()))
    for name, inner in schema.get("properties", {}).items():
        if random.random() < (1 - wrong if name in needed else 0.6 / (1 + depth)):
            spelt = name if random.random() >= wrong else random.choice((*HOSTILE, name + "s"))
            made[spelt] = _value(inner, random, wrong, depth + 1)
    extra = schema.get("additionalProperties")
    if isinstance(extra, dict):
        names = schema.get("propertyNames", {}).get("enum") or HOSTILE
        for _ in range(random.randrange(3)):
            made[random.choice(names)] = _value(extra, random, wrong, depth + 1)
    return made


def _array(schema: dict[str, Any], random: Random, wrong: float, depth: int) -> list[Any]:
    if "prefixItems" in schema:
        return [_value(one, random, wrong, depth + 1) for one in schema["prefixItems"]]
    count = random.randint(schema.get("minItems", 0), schema.get("maxItems", 3))
    return [_value(schema.get("items", {}), random, wrong, depth + 1) for _ in range(count)]


def _toml(value: Any, random: Random, wrong: float, top: bool = True) -> str:
    """As TOML: whole tables in line, those at the top each with its header."""
    if random.random() < wrong / 4 and not top:
        return random.choice(DATES)
    if isinstance(value, dict):
        pairs = [(json.dumps(key) if wrong or not key.isidentifier() else key, one)
                 for key, one in value.items()]
        if not top:
            inner = ", ".join(f"{k} = {_toml(v, random, wrong, False)}" for k, v in pairs)
            return f"{{ {inner} }}"
        plain = [(k, v) for k, v in pairs if not isinstance(v, dict)]
        tables = [(k, v) for k, v in pairs if isinstance(v, dict)]
        lines = [f"{k} = {_toml(v, random, wrong, False)}\n" for k, v in plain]
        for key, table in tables:
            lines.append(f"\n[{key}]\n")
            for name, one in table.items():
                lines.append(f"{json.dumps(name)} = {_toml(one, random, wrong, False)}\n")
        return "".join(lines)
    if isinstance(value, list):
        return f"[{', '.join(_toml(one, random, wrong, False) for one in value)}]"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)
