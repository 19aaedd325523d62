"""Magnetic centre, axis and roll in words."""

from __future__ import annotations

from halbach_fe.report.words import with_error
from halbach_fe.response.magnetic_axis import MagneticAxis

UNDEFINED = "not defined"


def axis_rows(axis: MagneticAxis | None) -> list[dict[str, str]]:
    """Return a row of text for each of centre, slope of the axis, and roll; none without axis."""
    if axis is None:
        return []
    rows = []
    if axis.centre_m is None or axis.centre_sd_m is None:
        rows.append({"of the updated magnet": "magnetic centre", "value": UNDEFINED})
    else:
        for name, value, sd in zip("xyz", axis.centre_m, axis.centre_sd_m, strict=False):
            rows.append({"of the updated magnet": f"magnetic centre, {name}",
                         "value": f"{with_error(1e3 * value, 1e3 * sd)}\u00a0mm"})
    if axis.slope_rad is not None and axis.slope_sd_rad is not None:
        for name, value, sd in zip("xy", axis.slope_rad, axis.slope_sd_rad, strict=True):
            rows.append({"of the updated magnet": f"magnetic axis, d{name}/dz",
                         "value": f"{with_error(1e3 * value, 1e3 * sd)}\u00a0mrad"})
    where = "" if axis.slope_rad is None else ", mean of the middle half"
    rows.append({"of the updated magnet": f"roll about z{where}",
                 "value": f"{with_error(1e3 * axis.roll_rad, 1e3 * axis.roll_sd_rad)}\u00a0mrad"})
    return rows


def definition(axis: MagneticAxis) -> str:
    """Return how centre, axis and roll are defined for the magnet's order, in sentences."""
    roll = ("The roll is the turn of the main multipole about z from that of the nominal magnet, "
            "right-handed; in a magnet of finite length in the mean along its middle half, "
            "weighted by the square of the field. The integral along z, whose roll shim states, "
            "has another one if rings are turned against each other. In the table of multipoles, "
            "a of the main order says the same of one circle, with the other sign.")
    if axis.order == 1:
        return ("A dipole has no axis. Its centre is the point near the middle, of a magnet of "
                "finite length, where the gradient of the main component vanishes; a homogeneous "
                f"field may have none there. {roll}")
    return (f"The centre is where the multipole of order {axis.order - 1} vanishes"
            + (", the axis the straight line through the centres along the middle half of the "
               "magnet; the centre is its point at z = 0. " if axis.slope_rad is not None
               else ". ") + roll)
