"""The cases in which suspicions are counted differ in their readings only."""

from __future__ import annotations

import numpy as np

from benchmarks.suspicion import NAMES, simulated, with_readings
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.scene import Campaign
from halbach_fe.diagnosis.search import NominalSolver, score_hypotheses
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from tests.support.unlisted import STUDY


def test_other_readings_are_compared_as_if_they_were_the_first(session):
    """Everything that depends on the readings is that of the others: a comparison that kept a part
    of the first ones suspected nothing in 3 000 maps.
    """
    effects = [effect for effect in catalogue() if effect.name in NAMES[:3]]

    def compared(data):
        update = infer(build_magnet(STUDY), data, session, None)
        return update, score_hypotheses(
            STUDY, (), update, update.prior.mean, Campaign.of(STUDY, data),
            NominalSolver(session), effects, (), {})

    first, other = simulated(0)[0], simulated(5)[0]
    update, search = compared(first)
    _, expected = compared(other)
    found = with_readings(search, update, other)
    for name in ("residual", "training", "absorbed"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-8,
                                   err_msg=name)
        # control: the readings matter
        assert np.abs(getattr(search, name) - getattr(expected, name)).max() > 1e-3, name
    np.testing.assert_allclose(found.evidence.score, expected.evidence.score, rtol=1e-6, atol=1e-6)
