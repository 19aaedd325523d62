"""Which multipoles a ring of blocks can make."""

from __future__ import annotations


def check_order(multipole_order: int, blocks_per_ring: int) -> None:
    """Refuse a multipole that is not the lowest one in the bore of a ring of N equal blocks.

    The magnetization of block ``i`` is turned by ``(1 + p) i 360/N`` degrees. The sum over blocks
    leaves only the harmonics ``n = p + m N`` >= 1 with integer m (K. Halbach, Nucl. Instrum.
    Methods 169 (1980) 1), each with a field that grows as ``r^(n-1)`` from the axis. In a ring of
    sectors without gaps, all of them are proportional to ``sin((n + 1) pi / N)``, which up to its
    sign is ``sin((p + 1) pi / N)``. Order p is thus

    * absent if N divides p + 1: all blocks are magnetized along the same direction;
    * not the lowest one if N < p: order ``p - N`` or a lower one exceeds it near the axis.

    With N = p the blocks are magnetized alike relative to their own radius. Order p is then the
    lowest, as order 0 has no field in the bore, but weak.

    Parameters
    ----------
    multipole_order : int
        The order p >= 1; 1 is a dipole.
    blocks_per_ring : int
        The number N of blocks.

    Raises
    ------
    ValueError
        If the order is absent or not the lowest one, with the reason and a remedy.
    """
    order, blocks = multipole_order, blocks_per_ring
    if (order + 1) % blocks == 0:
        reason = ("the magnetization makes whole turns from block to block, so that all blocks are "
                  "magnetized in the same direction")
    elif blocks < order:
        lowest = order % blocks or blocks
        reason = f"order {lowest} is in their field too, and exceeds it near the axis"
    else:
        return
    raise ValueError(f"{blocks} blocks cannot make a multipole of order {order}: {reason}; use at "
                     f"least {order + 2} blocks")
