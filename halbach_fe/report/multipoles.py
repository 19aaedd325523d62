"""What pages of multipoles share: their figure, and what they are of."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.multipoles import MultipoleModel, Multipoles
from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, SECOND

COLOURS = (PRIOR, POSTERIOR, SECOND)
MARKERS = ("o", "s", "^")
SHIFT = 0.18
"""Of points of one order beside one another."""


def reference_summary(model: MultipoleModel, limit: float | None) -> dict[str, object]:
    """Where multipoles are taken, for scripts."""
    return {"radius_m": model.radius, "z_m": model.z, "integrated_along_z": model.integrated,
            "main_order": model.main, "orders": list(model.orders),
            "axes_turned_by_rad": model.turn, "limit_units": limit,
            "nominal_main": model.nominal_main, "main_unit": model.unit}


def reference_text(model: MultipoleModel) -> str:
    """Where multipoles are taken, for people."""
    where = ("of the field integrated along z" if model.integrated
             else f"at z = {model.z:g} m (Fourier coefficients of B_r)" if model.z is not None
             else "of the cross-section")
    return (f"Multipoles {where}, at the reference radius of {1e3 * model.radius:.4g} mm, in units "
            f"of 1e-4 of the main one (order {model.main}); b normal, a skew, along axes in which "
            "the nominal main multipole is normal.")


def multipole_figure(magnets: Mapping[str, Multipoles], limit: float | None) -> Figure:
    """b_n and a_n of magnets by name, with error bars of two standard deviations."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    orders = next(iter(magnets.values())).orders
    place = np.arange(len(orders))
    for letter, part, axis in zip("ba", (slice(len(orders)), slice(len(orders), None)), axes,
                                  strict=True):
        for number, (name, known) in enumerate(magnets.items()):
            axis.errorbar(place + SHIFT * (number - (len(magnets) - 1) / 2), known.mean[part],
                          2 * known.sd[part], fmt=MARKERS[number], color=COLOURS[number], ms=5,
                          capsize=3, label=name)
        axis.axhline(0, color=PUBLISHED, lw=0.8)
        for sign in (-1, 1) if limit is not None else ():
            axis.axhline(sign * (limit or 0.0), color=PUBLISHED, lw=0.8, ls="--",
                         label="limit of |c_n|" if sign > 0 else None)
        axis.set_xticks(place, [f"{letter}$_{{{order}}}$" for order in orders])
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("units of 1e-4")
    axes[1].legend(fontsize="small")
    return figure
