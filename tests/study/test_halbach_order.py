"""Which multipoles a ring of blocks can make: against the field of its sectors."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.solver.ring_harmonics_2d import ideal_sectors
from halbach_fe.study.array_keys import check_order
from tests.oracles.sectors import bore_field

INNER, OUTER, RADIUS = 1.0, 1.5, 0.1
ORDERS, NUMBERS = range(1, 13), range(4, 17)


def harmonics(order: int, blocks: int) -> np.ndarray:
    """Amplitudes in T of orders 1 to 31 on a circle near the axis, from the field of all sectors.

    B_x - i B_y is a polynomial of x + i y; order n is its power n - 1.
    """
    angle = 2 * np.pi * np.arange(64) / 64
    points = RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    field = bore_field(ideal_sectors(order, blocks, 1.0), INNER, OUTER, points, terms=40)
    return np.abs(np.fft.fft(field[:, 0] - 1j * field[:, 1]) / 64)[:31]


def accepted(order: int, blocks: int) -> bool:
    try:
        check_order(order, blocks)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("order", ORDERS)
def test_order_is_accepted_if_and_only_if_it_dominates_near_the_axis(order):
    for blocks in NUMBERS:
        found = harmonics(order, blocks)
        # Rounding of fields of 1 T is 1e-16; the weakest wanted order, 12, has r^11 = 1e-11 of it.
        dominates = found.argmax() == order - 1 and found[order - 1] > 1e-14
        assert accepted(order, blocks) == dominates, (blocks, found)


def test_only_orders_of_halbachs_rule_occur():
    """n = p + m N, and no field at all if N divides p + 1."""
    for order in ORDERS:
        for blocks in NUMBERS:
            there = np.flatnonzero(harmonics(order, blocks) > 1e-14) + 1
            assert ((there - order) % blocks == 0).all()
            assert (len(there) == 0) == ((order + 1) % blocks == 0)


def test_reasons():
    with pytest.raises(ValueError, match=r"4 blocks cannot make a multipole of order 3: .* same "
                                         r"direction; use at least 5 blocks"):
        check_order(3, 4)
    with pytest.raises(ValueError, match=r"order 2 is in .*; use at least 8 blocks"):
        check_order(6, 4)


@pytest.mark.parametrize("order", ORDERS)
def test_remedy_works(order):
    check_order(order, order + 2)
    with pytest.raises(ValueError, match="same direction"):  # of smaller numbers, only p would do
        check_order(order, order + 1)


def test_other_rules_fail():
    """Negative control: refusing N = p too, or only N that divides p + 1, contradicts fields."""
    rules = (lambda p, n: (p + 1) % n and n > p, lambda p, n: (p + 1) % n != 0)
    for rule in rules:
        assert any(bool(rule(p, n)) != (harmonics(p, n).argmax() == p - 1
                                        and harmonics(p, n)[p - 1] > 1e-14)
                   for p in ORDERS for n in NUMBERS)
