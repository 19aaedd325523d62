"""Which hypotheses are compared with each other if there are too many for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.diagnosis import effect_selection
from halbach_fe.diagnosis.effect_selection import (
    FEW_PLACES,
    NOTICEABLE_CHI2,
    Candidate,
    is_noticeable,
    most_likely,
    near_the_likeliest,
    prior_log_odds,
    renumbered,
)
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.marginal_evidence import Marginal
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import unit_fields
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.mesh import with_rough_mesh
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed, circle

NOISE_T = 5e-5


def test_the_most_likely_are_compared(generator, monkeypatch):
    """Of 150 blocks that may be displaced and missing, two are; and a rare effect stays."""
    rows, count = 80, FEW_PLACES + 50
    columns = [generator.standard_normal((rows, size)) for size in (3, 1) for _ in range(count)]
    columns.append(generator.standard_normal((rows, 1)))
    candidates = [Candidate(effect, str(number), tuple(range(columns[0].shape[1])) if (
        effect == "displaced") else (0,), effect == "missing")
        for effect in ("displaced", "missing") for number in range(count)]
    candidates.append(Candidate("rare", "", (0,)))
    displaced, missing = 17, count + 40
    residual = (8 * columns[displaced] @ np.ones(3) + columns[missing][:, 0]
                + generator.standard_normal(rows))
    marginal = Marginal.of(generator.standard_normal((rows, 5)))

    def chosen(of, in_model=()):
        return most_likely(candidates, columns, marginal, of, in_model).numbers

    assert chosen(residual) == tuple(range(2 * count + 1))  # few enough for all
    monkeypatch.setattr(effect_selection, "MOST_COLUMNS", 60)
    monkeypatch.setattr(effect_selection, "AT_ONCE", 70)  # in several parts
    found = chosen(residual, {5})
    assert {5, displaced, 2 * count} <= set(found)
    assert sum(columns[number].shape[1] for number in found) <= 60
    # the missing block is found by what is left once the displaced one is in the model
    assert missing in chosen(residual, {displaced})
    # negative control: without its effect a candidate is among the many that are left out
    assert displaced not in chosen(columns[missing][:, 0])


def test_what_comes_near_is_computed_exactly(generator):
    """A rough signature suffices to tell that an effect is not what is missing."""
    rows = 400
    displaced, exact, other = (generator.standard_normal((rows, size)) for size in (3, 1, 1))
    rough = exact + 0.7 * generator.standard_normal((rows, 1))  # a correlation of 0.8
    mimic = exact + 0.3 * generator.standard_normal((rows, 1))
    columns = [displaced, other, mimic, rough]
    ends = np.cumsum([part.shape[1] for part in columns])
    candidates = [Candidate(name, "", tuple(range(end - part.shape[1], end)))
                  for name, part, end in zip(("displaced", "other", "mimic", "rough"), columns,
                                             ends, strict=True)]
    marginal = Marginal.of(generator.standard_normal((rows, 5)))
    noise = generator.standard_normal(rows)

    def near(missing, without=()):
        left = [k for k in range(4) if k not in without]
        evidence = marginal.evidence(np.hstack([columns[k] for k in left]), noise + missing)
        chosen = renumbered([candidates[k] for k in left])
        return near_the_likeliest(evidence, chosen, {len(left) - 1})

    assert near(0.0) == []
    assert near(displaced @ np.ones(3)) == []
    assert near(2 * other[:, 0] + displaced @ np.ones(3)) == []
    assert near(exact[:, 0]) == [3]  # the mimic is likelier than the rough signature
    assert near(exact[:, 0] + displaced @ np.ones(3), without=[2]) == [2]
    # negative control: without a rough signature nothing is computed again
    assert near_the_likeliest(marginal.evidence(np.hstack(columns), noise + exact[:, 0]),
                              candidates, set()) == []


def test_what_is_left_out_still_shares_the_prior_probability():
    few = [Candidate("missing", str(number), (number,), places=200) for number in range(2)]
    assert prior_log_odds(few) == pytest.approx(np.log(1 / 50 / 200))


def test_a_signature_is_noticed_beside_the_model(generator):
    rows = 400
    model, signature = generator.standard_normal((2, rows, 1))
    marginal = Marginal.of(generator.standard_normal((rows, 3)))
    noise = generator.standard_normal(rows)
    size = 4 * np.sqrt(NOTICEABLE_CHI2) / np.linalg.norm(signature)
    assert is_noticeable(signature, model, marginal, noise + size * signature[:, 0] + model[:, 0])
    # negative controls: noise alone, and what the model explains
    assert not is_noticeable(signature, np.zeros((rows, 0)), marginal, noise)
    assert not is_noticeable(model, signature, marginal, noise)
    assert not is_noticeable(model + 1e-2 * signature, model, marginal, noise + model[:, 0])


def dipole_fields(folder, **changes):
    """Return the fields of a dipole of two rings at 56 points, and readings of it without noise of
    their own: blocks of 1 % take from all signatures what they can explain.
    """
    study = parse_study(changed(
        DIPOLE, dimension=3, array__ring_length_m=0.083,
        **{"array__rings": 2, "array__recoil_permeability": 1.0} | changes))
    points = np.vstack([circle(0.06, 8, z, 0.1) for z in np.linspace(-0.2, 0.2, 7)])
    magnet = build_magnet(study)
    session = replace(Session.open(folder), cache=Cache(folder / "cache"))

    def solve(other):
        return solve_nominal(build_magnet(with_rough_mesh(other)), points, session)

    response = np.hstack([unit.reshape(-1, 3) * 0.01 * block.remanence / NOISE_T
                          for block, unit in zip(magnet.blocks, unit_fields(magnet.blocks, points),
                                                 strict=True)])
    return (NominalFields(study, points, np.linspace(0, 1, len(points)), solve),
            Marginal.of(response))


def information_of(marginal, signatures):
    """Return the information (k, k) of signatures (1, n, 3) in T beside the blocks."""
    columns = np.column_stack([part[0].ravel() / NOISE_T for part in signatures])
    return marginal.evidence(columns, np.zeros(len(columns))).information


@pytest.fixture(scope="module")
def with_iron(tmp_path_factory):
    """The dipole with permeability in a tube of iron."""
    iron = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
    return dipole_fields(
        tmp_path_factory.mktemp("iron"), iron_ring=iron, array__recoil_permeability=1.05,
        array__rings=1, array__blocks_per_ring=8, mesh={"block_size_m": 0.12, "growth": 1.7})


@pytest.mark.parametrize("name", ["iron_saturation", "recoil_permeability_across"])
def test_rough_signatures_resemble_the_exact_ones(name, with_iron, tmp_path):
    """So closely that `NEAR` finds an effect that is what is missing: a correlation of 0.7.
    Measured 0.98 and 0.99; a mesh that grows too fast has no iron to speak of.
    """
    nominal, marginal = with_iron
    effects = {one.name: one for one in catalogue()}
    (place,) = effects[name].places(nominal.study)
    exact, rough, other = (
        effects[name].signature(nominal, place), effects[name].rough_signature(nominal, place),
        effects["background"].signature(nominal, place))
    information = information_of(marginal, [exact, rough, other])
    sizes = np.sqrt(np.diag(information))
    alike = np.abs(information / sizes / sizes[:, None])
    assert alike[0, 1] > 0.85  # its square is more than twice `NEAR`
    assert alike[0, 2] < 0.7  # negative control
    # without iron, nothing takes long enough for a rough signature
    vacuum = dipole_fields(tmp_path / "vacuum")[0]
    assert effects[name].rough_signature(vacuum, place) is None


@pytest.mark.parametrize("name", ["iron_ring", "neighbour_magnet"])
def test_places_resemble_their_representatives(name, tmp_path):
    """So closely that a ring or magnet which a map shows at all is noticed at another place."""
    nominal, marginal = dipole_fields(tmp_path)
    (effect,) = [one for one in catalogue() if one.name == name]
    places = effect.places(nominal.study)
    chosen = effect.representatives(places)
    assert 0 < len(chosen) < len(places)
    # the whole signature of a ring has those of its refinements too, which take five times as long
    information = information_of(marginal, [
        rough if (rough := effect.rough_signature(nominal, place)) is not None
        else effect.signature(nominal, place) for place in places])
    seen = np.abs(information) / np.sqrt(np.diag(information))  # [i, j]: i as j sees it, in sd
    for number, place in enumerate(places):
        most = max(seen[number, places.index(one)] for one in chosen)
        # twice what is noticed at the least, also if chance takes three standard deviations
        assert most > 2 * np.sqrt(NOTICEABLE_CHI2) + 3, place
        assert most > 0.5 * seen[number, number], place


def test_a_block_on_the_axis_has_no_rough_meridian():
    """It is no ring; the control is the block beside the axis."""
    def study_at(x_m):
        return parse_study({"name": "cube", "mesh": {"block_size_m": 0.01}, "dimension": 3,
            "observation": {"quantity": "flux_density", "positions": {
                "kind": "points", "points_m": [[0.1, 0, 0]]}},
            "array": {"free_blocks": {
                "name": ["cube"], "shape": ["cuboid"], "x_m": [x_m], "y_m": [0.0], "z_m": [0.0],
                "size_x_m": [0.02], "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.3]}}})

    assert with_rough_mesh(study_at(0.0)) == study_at(0.0)
    assert with_rough_mesh(study_at(0.03)).mesh.meridian_size_m > 1e-3
