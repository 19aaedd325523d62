"""Causes outside the catalogue are called unknown; effects of the catalogue keep their names."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from halbach_fe.diagnosis import diagnose as module
from halbach_fe.diagnosis.competing_causes import Competition, Explanation
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_comparison import possible
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis
from halbach_fe.diagnosis.flexible_causes import fit_family, instrument_families
from halbach_fe.diagnosis.linearization import NominalSolver
from halbach_fe.diagnosis.marginal_evidence import Evidence
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.verdict import are_scattered, kind_of
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects import EFFECTS
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import circle
from tests.support.unlisted import STUDY, false_names
from tests.support.unlisted_causes import families, random_function, rms, simulate_unlisted

SLOW = ("iron_ring", "iron_saturation", "neighbour_magnet")
"""Effects whose signatures take long, and which no test here needs."""

SOME = [effect for effect in catalogue() if effect.name not in SLOW]
COMPARED = f"{len(SOME)} of {len(catalogue())}"
UNLISTED = {2: ("positions", "angle", "rough"),
            3: ("readings", "field", "smooth"), 4: ("source", "loop", "smooth")}
"""Seeds, and the family of the cause."""


@pytest.fixture(scope="module")
def small():
    """The study of the benchmark on fewer points."""
    return parse_study(STUDY.model_dump() | {"observation": {
        "quantity": "flux_density", "positions": {
            "kind": "circles", "radius_m": [0.03, 0.05, 0.07], "angles": 12,
            "z_min_m": -0.15, "z_max_m": 0.15, "count": 9}}})


@pytest.fixture(scope="module")
def diagnosed(getdp, tmp_path_factory):
    """Diagnose maps; signatures of one study on the same points are the same, and solved once."""
    session = Session(getdp, tmp_path_factory.mktemp("diagnosed"), jobs=2)
    solver = NominalSolver(session)
    return lambda *given: diagnose(*given[:2], session, *given[2:], effects=SOME, solver=solver)


@pytest.mark.parametrize("seed", UNLISTED)
def test_an_unlisted_cause_is_unknown(small, diagnosed, seed):
    data, cause = simulate_unlisted(small, seed, UNLISTED[seed])
    assert cause.rms_over_noise > 1  # else there is nothing to be seen
    found = diagnosed(small, data)
    assert false_names(found) == []
    assert found.unknown is not None
    assert found.unknown.alone
    assert max(found.probabilities, key=found.probabilities.get) == "unknown"
    first = found.unknown.parts[0]
    if cause.acts_on == "source":
        assert found.unknown.kind == "field"
        assert first.acts_on == "field"
    else:
        assert found.unknown.kind != "field"
        ways = {f"{first.acts_on} {first.along}", *first.or_else}
        assert f"{cause.acts_on} {cause.varies_along}" in ways
        assert set(first.components) == {"xyz"[axis] for axis in cause.axes}
    # the posterior mean has the size of what was added; the blocks absorb a part of it
    assert first.rms_T == pytest.approx(np.sqrt(3) * cause.rms_T, rel=0.5)
    text = " ".join(answer(found).sentences)
    assert f"Something outside the effects that were compared ({COMPARED}) is missing" in text
    assert "It looks like" in text


@pytest.mark.parametrize(("are_fields", "field", "kind"), [
    ([True, False], 900.0, "either"),  # a stage that is late on its way down only
    ([True], 900.0, "field"), ([True, True], 900.0, "field"), ([True], 32.0, "either"),
    ([False, True], 20.0, "instrument"), ([False], 29.0, "either")])
def test_what_is_like_a_field_only_in_part_may_be_the_instrument(are_fields, field, kind):
    assert kind_of(are_fields, {"field": field, "instrument": 30.0}) == kind


def coordinates_of(points):
    """The coordinates that errors of the instrument may depend on."""
    found = instrument_families(points, np.linspace(0, 1, len(points)), np.ones((len(points), 3)),
                                np.ones((len(points), 3, 3)), 1e-5)
    return {family.along for family in found}, found


def test_a_map_without_times_has_an_order_of_rows():
    """It was called the time."""
    points = np.random.default_rng(2).normal(size=(30, 3))
    for timed, named, other in ((True, "time", "order"), (False, "order", "time")):
        found = {family.along for family in instrument_families(
            points, np.linspace(0, 1, 30), np.ones((30, 3)), np.ones((30, 3, 3)), 1e-5, timed)}
        assert named in found
        assert other not in found


def test_on_a_line_azimuth_and_radius_are_functions_of_z():
    z = np.linspace(-0.5, 0.5, 60)
    line = np.column_stack([0.07 + 0.001 * z, 0.03 - 0.02 * z, z])
    assert not coordinates_of(line)[0] & {"radius", "angle"}
    bent = line + np.column_stack([0.01 * np.sin(9 * z), 0 * z, 0 * z])
    assert coordinates_of(bent)[0] >= {"radius", "angle", "z"}  # the control


def test_a_map_of_one_component_has_errors_of_one_sensor():
    z = np.linspace(-0.5, 0.5, 60)
    _, found = coordinates_of(np.column_stack([0 * z, 0 * z, z]))
    family = next(one for one in found if (one.acts_on, one.along) == ("readings", "z"))
    fields = family.fields()[:, :, 0] / 1e-5  # (terms, n): what a map of Bx shows, in sigma
    error = 3 * np.cos(7 * z)
    evidence = Evidence(fields @ fields.T, fields @ error, float(error @ error), len(z),
                        np.ones(len(fields)), np.zeros((0, len(fields))))
    assert fit_family(family, evidence).axes == (0,)


def test_without_the_competition_false_names_appear(small, diagnosed, monkeypatch):
    """The control that must fail: the catalogue alone explains a cause that it does not have."""
    data, _ = simulate_unlisted(small, 3, UNLISTED[3])
    monkeypatch.setattr(module, "named_effects", lambda *given: given[3])
    monkeypatch.setattr(module, "MAX_ROUNDS", 2)  # it would not come to rest
    monkeypatch.setattr(module._Round, "gives_way", False)
    monkeypatch.setattr(module, "WORSE", np.inf)  # held-out readings are not heard either
    assert false_names(diagnosed(small, data))


@pytest.mark.parametrize("names", [("drift",), ("arm_sag", "gain_z"), ()])
def test_effects_of_the_catalogue_keep_their_names(small, diagnosed, names):
    """Whole blocks keep theirs in `test_diagnose.py`."""
    campaign = simulate_campaign(small, 5, hide=[(EFFECTS[name], None) for name in names])
    found = diagnosed(small, campaign.readings, campaign.blocks)
    named = [set(effect.selection.effects) for effect in found.identified]
    assert len(named) == len(names)
    assert all(any(name in each for each in named) for name in names)
    assert found.unknown is None


def test_a_missing_block_beside_an_unlisted_cause(small, diagnosed):
    """What nothing of any shape could replace is named beside the unknown."""
    with_block = simulate_campaign(small, 5, hide=[(EFFECTS["block_missing"], None)]).readings
    z = with_block["z_m"].values
    error = np.zeros(with_block["B_T"].shape)
    error[:, 1] = 5e-4 * np.sin(2 * np.pi * z / 0.11 + 1)
    found = diagnosed(small, with_block.assign(B_T=with_block["B_T"] + error))
    assert [effect.hypothesis.effect.name for effect in found.identified] == ["block_missing"]
    assert found.unknown is not None
    assert not found.unknown.alone
    assert f"outside the effects that were compared ({COMPARED}) remains" in " ".join(
        answer(found).sentences)


def test_scattered_sources():
    around_one = [(0.0, 0.1, 0.12), (0.05, 0.0866, 0.12), (0.0757, 0.1311, 0.12)]
    assert not are_scattered(around_one)
    assert are_scattered([*around_one, (0.0, -0.1, 0.12)])
    assert not are_scattered([(0.0, 0.1, 0.12), (0.0, -0.1, 0.12)])  # two may well be two


@pytest.mark.parametrize(("terms_alone", "named"), [(500.0, (0,)), (850.0, ())])
def test_scattered_sources_do_not_take_a_strong_effect_with_them(terms_alone, named):
    """They are left to terms of any shape, and what is beside them keeps its name if terms alone
    are much less likely.
    """
    term = "a field of any shape"

    class Judged(Competition):
        """A competition in which an effect and sources explain most, and terms nearly as much."""

        def __init__(self):
            self.candidates = [object()] * 5

        def explanation(self, effects, terms):
            return Explanation(tuple(effects), tuple(terms), {0: 0.0, 1: 800.0, 5: 1000.0}[
                len(effects)], 1.5)

        def extension(self, effects):
            there = 0 in effects
            return Explanation((0,) * there, (term,), 900.0 if there else terms_alone, 1.1)

        def with_more_effects(self, start):
            return start

        def irreplaceable_effects(self, effects):
            return []

    # terms beside the effect add 100; without it 400 are lost, or only 50
    best, without = Judged().best_explanations((0, 1, 2, 3, 4), scattered=(1, 2, 3, 4))
    assert (best.effects, best.terms, without.effects) == (named, (term,), ())
    alone, _ = Judged().best_explanations((0, 1, 2, 3, 4))  # the control: in one place
    assert (len(alone.effects), alone.terms) == (5, ())


def test_a_small_part_of_a_ring_is_no_ring(small):
    """A ring is applied in full: 2 % of it stand for something else."""
    effect = next(one for one in catalogue() if one.name == "iron_ring")
    place = effect.places(small)[0]
    for strength, is_possible in ((0.02, False), (-0.5, False), (0.5, True)):
        found = IdentifiedEffect(Hypothesis(effect, place), np.array([strength]), np.ones(1), None)
        campaign = SimpleNamespace(points_of=lambda study: np.zeros((1, 3)), blocks=None)
        assert possible(small, [found], campaign) == is_possible


def test_every_family_is_drawn_and_seen():
    assert len(families()) == 23
    drawn = [simulate_unlisted(STUDY, 7, family)[1] for family in families()]
    assert [one.family for one in drawn] == ["-".join(family) for family in families()]
    assert min(one.rms_over_noise for one in drawn) > 1


def test_random_functions(generator):
    coordinate = np.linspace(0, 1, 200)
    for smooth, low, high in ((True, 0.98, 1.0), (False, 0.5, 0.97)):
        value = random_function(coordinate, False, smooth, generator)
        assert rms(value) == pytest.approx(1)
        # neighbours 1/200 apart: smooth ones agree to (1/200/0.12)^2 / 2, rough ones to 1/200/0.04
        assert low < np.corrcoef(value[1:], value[:-1])[0, 1] <= high
    angle = np.linspace(-np.pi, np.pi, 41)
    value = random_function(angle, True, True, generator)
    assert value[0] == pytest.approx(value[-1], abs=1e-3)


def test_seeds_are_reproducible():
    first, second = (simulate_unlisted(STUDY, 9) for _ in range(2))
    assert first[0].equals(second[0])
    assert first[1] == second[1]
    assert not first[0].equals(simulate_unlisted(STUDY, 10)[0])


@pytest.mark.parametrize(("times", "amplitude_T"), [(2.0, 0.0), (5.0, 0.0), (1.0, 3e-4)])
def test_noise_that_is_larger_than_stated_is_no_unknown_cause(
    dipole, session, generator, times, amplitude_T
):
    """Terms of any shape explain a part of any few readings. The control: a rough function of the
    azimuth that both circles share.
    """
    study = dipole(
        array__recoil_permeability=1.0, noise={"regions": [{"name": "all", "sigma_T": 2e-5}]},
        observation={"quantity": "flux_density", "components": ["x", "y"], "positions": {
            "kind": "circles", "radius_m": [0.05, 0.075], "angles": 32}})
    points = np.vstack([circle(0.05, 32), circle(0.075, 32)])
    noise = times * 2e-5 * generator.standard_normal(points.shape)
    rough = amplitude_T * np.tile(generator.standard_normal((32, 3)), (2, 1))
    data = field_map(points, field_of(build_magnet(study).blocks, points) + noise + rough)
    some = [effect for effect in catalogue() if effect.name in (
        "gain_x", "offset_y", "mapper_translation")]
    found = diagnose(study, data, session, effects=some)
    assert found.identified == ()
    assert (found.unknown is not None) == bool(amplitude_T)
    said = answer(found).said
    assert ("The readings scatter as if their noise were" in said) != bool(amplitude_T)
    if not amplitude_T:  # the blocks' tolerances take a part of it
        factor = float(said.split("noise were ")[1].split()[0])
        assert 0.7 * times < factor < 1.1 * times
