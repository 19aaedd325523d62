"""Overlaps of blocks with one another and with iron."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.array_layout import sector_outline
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.outline import closed_outline
from halbach_fe.geometry.overlaps import SQUEEZED, block_in_iron, overlapping_blocks
from tests.conftest import processor_time

INNER, OUTER = 0.104, 0.1865
LONG = (-np.inf, np.inf)
FINITE = (-0.04, 0.04)


def block(outline, limits=FINITE, **pose):
    return MagnetBlock(ring=1, slot=1, outline=outline, z_min=limits[0], z_max=limits[1],
                       easy_axis=(1.0, 0.0, 0.0), remanence=1.0, recoil_permeability=1.0,
                       recoil_permeability_across=1.0, **pose)


def rectangle(half_x, half_y):
    return closed_outline(np.array([(-half_x, -half_y), (half_x, -half_y), (half_x, half_y),
                                    (-half_x, half_y)]))


def circle(radius):
    angles = np.pi / 4 * np.array([-3, -1, 1, 3])
    return closed_outline(radius * np.column_stack([np.cos(angles), np.sin(angles)]), (0, 1, 2, 3))


def cube(half=0.5, **pose):
    return block(rectangle(half, half), (-half, half), **pose)


def outline_of(kind, count, number, first=0.0, inner=INNER, outer=OUTER):
    """An outline of one of ``count`` blocks that touch their neighbours in a ring."""
    angle = first + 2 * np.pi * number / count
    if kind == "sector":
        return sector_outline(inner, outer, angle - np.pi / count, angle + np.pi / count)
    near = inner * np.tan(np.pi / count)
    far = near if kind == "cuboid" else outer * np.tan(np.pi / count)  # inner corners touch
    corners = np.array([(inner, -near), (outer, -far), (outer, far), (inner, near)])
    return closed_outline(corners @ rotation_about_z(angle)[:2, :2].T)


def ring(kind="sector", count=16, limits=FINITE, **values):
    return [block(outline_of(kind, count, number, **values), limits) for number in range(count)]


def tube(inner, outer, limits=FINITE):
    return IronSolid(inner, outer, *limits)


@pytest.mark.parametrize("kind", ["sector", "trapezoid", "cuboid"])
@pytest.mark.parametrize("limits", [LONG, FINITE])
@settings(max_examples=15)
@given(count=st.integers(4, 100), first=st.floats(-7, 7), ratio=st.floats(1.001, 10))
def test_touching_neighbours_are_apart(kind, limits, count, first, ratio):
    blocks = ring(kind, count, limits, first=first, outer=ratio * INNER)
    assert overlapping_blocks(blocks) is None


@pytest.mark.parametrize("kind", ["sector", "trapezoid", "cuboid"])
def test_512_blocks(kind):
    """The largest ring; a block a thousandth of its width too wide overlaps its neighbour."""
    blocks = ring(kind, 512, LONG)
    assert overlapping_blocks(blocks) is None
    blocks[77] = block(outline_of(kind, 511.5, 77 / 512 * 511.5), LONG)
    assert overlapping_blocks(blocks)[:2] == (76, 77)


def test_stacked_rings_and_layers_touch():
    """Layers that share an arc, and rings that share a plane, turned against one another."""
    layers = [*ring(count=16), *ring(count=12, inner=OUTER, outer=0.25, first=0.1),
              *ring(count=16, limits=(0.04, 0.08), first=0.3),
              *ring("trapezoid", 24, inner=0.05, outer=INNER * np.cos(np.pi / 24))]
    assert overlapping_blocks(layers) is None
    deeper = [*layers[:16], *ring(count=12, inner=OUTER - 1e-5, outer=0.25)]
    first, second, depth = overlapping_blocks(deeper)
    assert first == 0
    assert second >= 16
    assert depth == pytest.approx(1e-5, rel=1e-6)


def test_turned_sector_of_a_closed_ring_overlaps():
    """Turned by 10 degrees about its middle, its corners enter both neighbours."""
    blocks = ring()
    blocks[3] = replace(blocks[3], rotation_rad=(0.0, 0.0, np.radians(10)))
    first, second, depth = overlapping_blocks(blocks)
    assert (first, second) == (2, 3)
    # half the thickness of 0.0825 turns towards the neighbour; the outer corner moves the most
    assert 0.3 * 0.0825 / 2 * np.radians(10) < depth < 0.1 * np.radians(10)


@pytest.mark.parametrize("limits", [LONG, FINITE])
def test_moved_block_overlaps(limits):
    blocks = ring("trapezoid", 16, limits)
    blocks[5] = replace(blocks[5], displacement_m=(0.09, 0.0, 0.0))
    found = overlapping_blocks(blocks)
    assert 5 in found[:2]
    assert found[2] > 0.01


@pytest.mark.parametrize("kind", ["sector", "trapezoid"])
@pytest.mark.parametrize(("shift", "expected"), [(1e-3, False), (-1e-5, True)])
def test_blocks_moved_along_the_radius(kind, shift, expected):
    """All blocks farther out are apart, also if tilted a little; all farther in overlap.

    1e-5 m is 1e-4 of their thickness and 4e-6 m sideways.
    """
    blocks = []
    for number, one in enumerate(ring(kind)):
        angle = 2 * np.pi * number / 16
        radial = shift * np.array([np.cos(angle), np.sin(angle), 0.0])
        blocks.append(replace(one, displacement_m=tuple(radial.tolist()), rotation_rad=(
            (0.0, 1e-4, 1e-4) if shift > 0 else (0.0, 0.0, 0.0))))
    assert (overlapping_blocks(blocks) is not None) == expected


def test_arc_against_displaced_arc():
    """A layer displaced into the next by 2e-5 m, 2e-4 of its width, where only arcs meet."""
    inner, outer = ring()[0], ring(inner=OUTER, outer=0.25)[0]
    assert overlapping_blocks([inner, outer]) is None
    for direction, expected in ((1.0, True), (-1.0, False)):
        moved = replace(inner, displacement_m=(direction * 2e-5, 0.0, 0.0))
        assert (overlapping_blocks([moved, outer]) is not None) == expected
        tilted = replace(moved, rotation_rad=(0.0, 0.0, 1e-7 * direction))
        assert (overlapping_blocks([tilted, outer]) is not None) == expected


# --- pairs of convex prisms against linear programming ---------------------------------------

PRISMS = {
    "cube": cube(),
    "plate": block(rectangle(1.0, 0.7), (-0.05, 0.05)),
    "rod": block(rectangle(0.05, 0.05), (-1.0, 1.0)),
    "trapezoid": block(closed_outline(np.array(
        [(-0.5, -0.3), (0.5, -0.8), (0.5, 0.8), (-0.5, 0.3)])), (-0.4, 0.4)),
    "triangle": block(closed_outline(np.array([(0.6, 0), (-0.3, 0.5), (-0.3, -0.5)])), (0, 0.8)),
    "hexagon": block(closed_outline(np.column_stack([
        np.cos(np.pi / 3 * np.arange(6)), np.sin(np.pi / 3 * np.arange(6))])), (-0.3, 0.3)),
}


def half_spaces(one):
    """Normals (n, 3) and offsets of a convex prism in the magnet: ``normals @ x <= offsets``."""
    corners = np.array([edge.start for edge in one.outline])
    along = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([along[:, 1], -along[:, 0]]) / np.hypot(*along.T)[:, None]
    local = np.vstack([np.column_stack([normals, np.zeros(len(normals))]), [[0, 0, 1], [0, 0, -1]]])
    offsets = np.concatenate([np.sum(normals * corners, axis=1), [one.z_max, -one.z_min]])
    turned = local @ one.axes.T
    return turned, offsets + turned @ one.position


def exit_distance(one, other, direction):
    """Largest distance that ``other`` can move along a direction while it still meets ``one``."""
    (a, b), (c, d) = half_spaces(one), half_spaces(other)
    rows = np.vstack([np.column_stack([a, np.zeros(len(a))]),
                      np.column_stack([c, -c @ direction])])
    solution = linprog([0, 0, 0, -1], rows, np.concatenate([b, d]), bounds=[(None, None)] * 4)
    assert solution.status == 0
    return -solution.fun


def random_pair(generator):
    """Two prisms that overlap, and the direction and distance that part them."""
    names = generator.choice(sorted(PRISMS), 2)
    shift = generator.normal(scale=0.1, size=3)
    one, other = (replace(PRISMS[name], orientation_rad=tuple(
        Rotation.random(random_state=int(generator.integers(1 << 30))).as_rotvec().tolist()))
        for name in names)
    other = replace(other, origin_m=tuple(shift.tolist()))
    direction = generator.normal(size=3)
    direction /= np.linalg.norm(direction)
    return one, other, direction, exit_distance(one, other, direction)


def moved(one, by):
    return replace(one, origin_m=tuple((np.array(one.origin_m) + by).tolist()))


def near_misses(generator, count, tolerance, apart, inside):
    """Numbers of wrong answers just before and just behind contact, for random pairs.

    HiGHS keeps constraints to 1e-7, and blocks of size 1 may penetrate by 1e-6 of it, so that
    ``apart`` is 1e-5; ``inside`` has to exceed the permitted 1e-6 along the normal of contact, to
    which a random direction may be inclined by 89 degrees, a cosine of 0.02.
    """
    wrong = [0, 0]
    for _ in range(count):
        one, other, direction, distance = random_pair(generator)
        pair = [one, moved(other, (distance + apart) * direction)]
        wrong[0] += overlapping_blocks(pair, tolerance) is not None
        pair[1] = moved(other, (distance - inside) * direction)
        wrong[1] += overlapping_blocks(pair, tolerance) is None
    return wrong


def test_convex_pairs_agree_with_linear_programming(generator):
    assert near_misses(generator, 150, 1e-6, 1e-5, 1e-4) == [0, 0]


def test_wrong_tolerance_fails(generator):
    """Negative control: with a larger tolerance overlaps are missed, with a negative one found."""
    assert near_misses(generator, 30, 3e-3, 1e-5, 1e-4)[1] > 15
    assert near_misses(generator, 30, -3e-3, 1e-5, 1e-4)[0] > 15


def test_depth_is_the_distance_that_parts(generator):
    """No direction parts convex blocks in less than the depth, and some direction nearly does."""
    for _ in range(10):
        one, other, _, _ = random_pair(generator)
        depth = overlapping_blocks([one, other])[2]
        directions = np.vstack([half_spaces(one)[0], half_spaces(other)[0],
                                np.cross(one.axes.T[:, None], other.axes.T).reshape(-1, 3)])
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        distances = [exit_distance(one, other, sign * direction)
                     for direction in directions for sign in (1, -1)]
        assert depth <= min(distances) + 1e-6  # HiGHS
        assert depth > 0.5 * min(distances)  # not all edges are among the directions


# --- any shapes against points inside both ----------------------------------------------------

L_SHAPE = closed_outline(np.array([(0, 0), (1, 0), (1, 0.3), (0.3, 0.3), (0.3, 1), (0, 1.0)]))
STAR = closed_outline(np.column_stack([
    (r := np.tile([1.0, 0.4], 5)) * np.cos(a := np.pi / 5 * np.arange(10)), r * np.sin(a)]))
SHAPES = {
    "sector": sector_outline(0.5, 1.0, -0.6, 0.6),
    "long sector": sector_outline(0.4, 0.8, -2.5, 2.5),
    "cylinder": circle(0.5),
    "L": L_SHAPE,
    "star": STAR,
    "cuboid": rectangle(0.5, 0.3),
}


def some_block(generator, plane):
    """A block of any shape, displaced and rotated in both ways that a block can be."""
    outline = SHAPES[str(generator.choice(sorted(SHAPES)))]
    vectors = generator.normal(size=(4, 3)) * np.array([0.5, 1.5, 0.3, 1.5])[:, None]
    if plane:
        vectors[::2, 2] = 0.0
        vectors[1::2, :2] = 0.0
    pose = dict(zip(("origin_m", "orientation_rad", "displacement_m", "rotation_rad"),
                    map(tuple, vectors.tolist()), strict=True))
    return block(outline, LONG if plane else (-0.3, 0.4), **pose)


@pytest.mark.parametrize("plane", [True, False])
def test_any_shapes_agree_with_points_inside_both(generator, plane):
    """Points inside both blocks must be found as an overlap, and an overlap contains points.

    A penetration of 0.1 by a corner of 30 degrees still covers 0.1^2 tan(15 deg) = 3e-3, and so
    holds 30 of 4e4 points in a square of 2 by 2.
    """
    counts = [0, 0]
    for _ in range(60):
        one, other = some_block(generator, plane), some_block(generator, plane)
        local = generator.uniform(-1, 1, (40_000, 3)) * [1, 1, 0.4]
        points = one.from_frame(local)
        shared = bool((one.contains(points) & other.contains(points)).any())
        found = overlapping_blocks([one, other])
        counts[found is not None] += 1
        if shared:
            assert found is not None
        elif plane:
            assert found is None or found[2] < 0.1
    assert min(counts) > 10  # both answers occur


def test_contact_along_edges():
    """Cubes that touch along crossing edges and along parallel and nearly parallel ones."""
    upright = cube(orientation_rad=(0.0, 0.0, np.pi / 4))  # an edge along z at x = sqrt(1/2)
    lying = cube(orientation_rad=(0.0, np.pi / 4, 0.0))  # an edge along y at x = -sqrt(1/2)
    for other in (lying, upright):
        for tilt in (0.0, 1e-15, 1e-12, 1e-9, 1e-7):
            turned = replace(other, rotation_rad=(tilt, 0.0, 0.0))
            for gap, expected in ((1e-7, False), (0.0, False), (-1e-4, True)):
                pair = [upright, moved(turned, [np.sqrt(2.0) + gap, 0.0, 0.0])]
                assert (overlapping_blocks(pair) is not None) == expected, (tilt, gap)


def test_nested_and_interlocked_blocks():
    """Hooks around one another share no point; a block within another does."""
    hook, other = block(L_SHAPE), block(L_SHAPE, origin_m=(1.3, 1.3, 0.0),
                                        orientation_rad=(0.0, 0.0, np.pi))
    assert overlapping_blocks([hook, other]) is None
    assert overlapping_blocks([hook, moved(other, [-0.01, 0.0, 0.0])]) is None
    notch = block(rectangle(0.35, 0.35), origin_m=(0.65, 0.65, 0.0))
    assert overlapping_blocks([hook, notch]) is None
    assert overlapping_blocks([hook, moved(notch, [-1e-4, 0.0, 0.0])])[2] == pytest.approx(1e-4)
    assert overlapping_blocks([cube(), cube(0.1)])[2] == pytest.approx(0.6)
    assert overlapping_blocks([cube(), cube()])[2] == pytest.approx(1.0)
    disc = block(circle(0.1), LONG)
    assert overlapping_blocks([*ring(limits=LONG), disc]) is None


def test_tilted_cylinders(generator):
    """Rods that cross at right angles touch at the sum of their radii, and rims of discs."""
    rod = block(circle(0.5), (-3.0, 3.0))
    across = block(circle(0.25), (-3.0, 3.0), orientation_rad=(np.pi / 2, 0.0, 0.0))
    for angle in generator.uniform(-1, 1, 3):
        turned = replace(across, rotation_rad=(float(angle), 0.0, 0.0))
        assert overlapping_blocks([rod, moved(turned, [0.75, 0.2, 0.3])]) is None
        assert overlapping_blocks([rod, moved(turned, [0.7498, 0.2, 0.3])]) is not None
    disc = block(circle(0.5), (-0.1, 0.1))
    upright = replace(disc, orientation_rad=(np.pi / 2, 0.0, 0.0))
    assert overlapping_blocks([disc, moved(upright, [0.0, 0.0, 0.6])]) is None
    assert overlapping_blocks([disc, moved(upright, [0.0, 0.0, 0.5998])]) is not None


def test_first_pair_by_number(generator):
    """The pair is the first of all pairs that overlap when they are compared alone."""
    for _ in range(2):
        crowd = [cube(0.5 * 10 ** generator.uniform(-1, 0), origin_m=tuple(
            generator.uniform(0, 3.5, 3).tolist()), orientation_rad=tuple(
            generator.normal(size=3).tolist())) for _ in range(25)]
        pairs = [(i, j) for i in range(25) for j in range(i + 1, 25)
                 if overlapping_blocks([crowd[i], crowd[j]])]
        assert len(pairs) > 1
        assert overlapping_blocks(crowd)[:2] == pairs[0]


def test_plate_among_many_small_cubes():
    plate = block(rectangle(1.0, 1.0), (-0.1, 0.0))
    places = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 12)] * 2, [0.01, 0.03]), -1)
    cubes = [cube(0.01, origin_m=tuple(place)) for place in places.reshape(-1, 3).tolist()]
    assert overlapping_blocks([*cubes, plate]) is None
    cubes[100] = moved(cubes[100], [0.0, 0.0, -1e-5])
    assert overlapping_blocks([*cubes, plate])[:2] == (100, len(cubes))


def test_many_cubes_take_seconds():
    """The time for touching cubes grows as their number does: eight times as many, some nine times.

    If all pairs were compared, it would be 64 times.
    """
    places = 0.01 * np.stack(np.meshgrid(*[np.arange(28)] * 3), -1).reshape(-1, 3)[:16_000]
    turn = Rotation.from_rotvec([0.3, 0.5, 0.7])
    cubes = [cube(0.005, origin_m=tuple(place), orientation_rad=(0.3, 0.5, 0.7))
             for place in turn.apply(places).tolist()]

    def apart(blocks):
        assert overlapping_blocks(blocks) is None

    apart(cubes[:100])  # what is compiled or imported once
    assert processor_time(apart, cubes) < 24 * processor_time(apart, cubes[:2000])
    cubes[-1] = moved(cubes[-1], turn.apply([0.0, -1e-6, 0.0]))
    assert overlapping_blocks(cubes)[2] == pytest.approx(1e-6, rel=1e-6)


# --- iron -------------------------------------------------------------------------------------

@pytest.mark.parametrize("kind", ["sector", "trapezoid", "cuboid"])
@pytest.mark.parametrize("limits", [LONG, FINITE])
def test_blocks_in_a_tube(kind, limits):
    """Corners that touch the tube are allowed; 1e-5 m, 1e-4 of the thickness, are not."""
    blocks = ring(kind, 16, limits)
    reach = max(edge.radius for one in blocks for edge in one.outline)
    assert block_in_iron(blocks, [tube(reach, 0.3, limits)]) is None
    assert block_in_iron(blocks, [tube(0.01, INNER * np.cos(np.pi / 16), limits)]) is None
    number, body, _ = block_in_iron(blocks, [tube(reach, 0.3, limits),
                                             tube(reach - 1e-5, 0.3, limits)])
    assert (number, body) == (0, 1)
    near = INNER if kind == "sector" else INNER + 1e-5
    assert block_in_iron(blocks, [tube(0.01, near + 1e-5, limits)]) is not None


def test_depth_in_a_tube_is_exact_for_sectors():
    depth = block_in_iron(ring(), [tube(OUTER - 1e-3, 0.3)])[2]
    assert depth == pytest.approx(1e-3, rel=1e-9)


def test_displaced_and_tilted_blocks_in_a_tube():
    for kind in ("sector", "cuboid"):
        one = ring(kind, 16)[4]  # at y > 0
        reach = max(edge.radius for edge in one.outline)
        iron = [tube(reach, 0.3, (-1.0, 1.0))]
        for shift, expected in ((-1e-5, False), (2e-5, True)):
            displaced = replace(one, displacement_m=(0.0, shift, 0.0))
            assert (block_in_iron([displaced], iron) is not None) == expected
        # tilted by 0.01 about x, half a length of 0.04 leans 4e-4 m outwards
        tilted = replace(one, rotation_rad=(0.01, 0.0, 0.0))
        assert block_in_iron([tilted], iron) is not None
        inwards = replace(tilted, displacement_m=(0.0, -5e-4, 0.0))
        assert block_in_iron([inwards], iron) is None


def test_disc_and_ends_of_tubes():
    blocks = ring()
    assert block_in_iron(blocks, [tube(0.0, 0.3, (0.04, 0.05))]) is None
    assert block_in_iron(blocks, [tube(0.0, 0.3, (0.0399, 0.05))])[2] == pytest.approx(1e-4)
    assert block_in_iron(blocks, [tube(0.0, INNER)]) is None
    rod = block(circle(0.05), origin_m=(0.1, 0.0, 0.0))
    assert block_in_iron([rod], [tube(0.0, 0.05)]) is None
    assert block_in_iron([rod], [tube(0.0, 0.0501)]) is not None


def test_blocks_and_prisms_of_iron():
    """A pole piece in the shape of an L holds a block in its notch."""
    prism = IronSolid(0.0, 1.5, -0.04, 0.04, L_SHAPE)
    notch = block(rectangle(0.35, 0.35), origin_m=(0.65, 0.65, 0.0))
    assert block_in_iron([cube(0.1, origin_m=(-1.0, 0.0, 0.0)), notch], [prism]) is None
    pushed = moved(notch, [0.0, -1e-4, 0.0])
    number, body, depth = block_in_iron([notch, pushed], [tube(3.0, 4.0), prism])
    assert (number, body) == (1, 1)
    assert depth == pytest.approx(1e-4)


# --- what cannot be compared ------------------------------------------------------------------

def test_nothing_to_compare():
    assert overlapping_blocks([]) is None
    assert overlapping_blocks([cube()]) is None
    assert block_in_iron([cube()], []) is None
    assert block_in_iron([], [tube(1.0, 2.0)]) is None


def test_tilted_infinite_block_is_refused():
    with pytest.raises(ValueError, match="may turn about z only"):
        overlapping_blocks([block(L_SHAPE, LONG, orientation_rad=(0.1, 0.0, 0.0))])


def test_crossing_edges_are_refused():
    pentagram = closed_outline(np.column_stack([
        np.cos(4 * np.pi / 5 * np.arange(5)), np.sin(4 * np.pi / 5 * np.arange(5))]))
    with pytest.raises(StudyError, match="edges do not cross"):
        overlapping_blocks([block(pentagram), block(pentagram)])


def test_sectors_that_are_deeper_in_others_than_a_squeezed_assembly():
    """18 mm of touching sectors of 80 mm, and 19 mm of a tube: the narrow pieces of their arcs
    measured less than a tenth of their size, so that studies had both fields at once. The control
    is a shift of 1 mm.
    """
    tube = IronSolid(0.1866, 0.2, *FINITE)
    for limits in (LONG, FINITE):
        first, *others = ring(count=8, limits=limits)
        for shift, is_deep in ((0.02, True), (0.001, False)):
            along, outwards = (replace(first, displacement_m=place) for place in (
                (0.0, shift, 0.0), (shift, 0.0, 0.0)))
            found = (overlapping_blocks([along, *others], SQUEEZED),
                     block_in_iron([outwards], [replace(tube, z_min=limits[0], z_max=limits[1])],
                                   SQUEEZED))
            assert [each is not None for each in found] == [is_deep, is_deep]
            if is_deep:  # normal to the side; less than the wall, beyond the gap of 0.1 mm
                assert found[0][2] == pytest.approx(0.02 * np.cos(np.pi / 8), rel=1e-3)
                assert found[1][2] == pytest.approx(0.0199, rel=0.1)
