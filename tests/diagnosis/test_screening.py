"""Which hypotheses are compared with each other if there are too many for that."""

from __future__ import annotations

import numpy as np

from halbach_fe.diagnosis import screening
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.diagnosis.model_selection import Candidate
from halbach_fe.diagnosis.screening import FEW_PLACES, most_likely


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
        return most_likely(candidates, columns, marginal, of, in_model)

    assert chosen(residual) == list(range(2 * count + 1))  # few enough for all
    monkeypatch.setattr(screening, "MOST_COLUMNS", 60)
    monkeypatch.setattr(screening, "AT_ONCE", 70)  # in several parts
    found = chosen(residual, {5})
    assert {5, displaced, 2 * count} <= set(found)
    assert sum(columns[number].shape[1] for number in found) <= 60
    # the missing block is found by what is left once the displaced one is in the model
    assert missing in chosen(residual - 8 * columns[displaced] @ np.ones(3))
    # negative control: without its effect a candidate is among the many that are left out
    assert displaced not in chosen(columns[missing][:, 0])
