"""The field of the nominal magnet at the study's positions, and its readings with error bars."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.core.installation import version
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.numbers import csv_text
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.observation_operator import Observation, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.stray_field import StrayField, stray_field
from halbach_fe.solver.routes import check_points, finite_element_part, vacuum_part
from halbach_fe.solver.session import NOT_KEPT, Session, alone


@dataclass(frozen=True)
class Solution(ShownInNotebook):
    """The solved field of a nominal magnet.

    Attributes
    ----------
    magnet : Magnet
    points : ndarray, shape (n, 3), in m
        The study's positions.
    flux_density : ndarray, shape (n, 3), in T
        B at these positions.
    observation : Observation
        How the study turns B into readings.
    readings, errors : ndarray, shape (readings,), in T
        The readings, and the solver's error bar of each reading.
    getdp : str
        Version of GetDP.
    stray_field : StrayField or None
        How far outside the field is strong; None for a cross-section.
    field_map : Dataset
        B at the study's positions as a labelled map.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> solution = hf.solve(magnet, hf.Session.open("results"))
    >>> solution.readings.shape == solution.errors.shape
    True
    """

    magnet: Magnet
    points: Floats
    flux_density: Floats
    observation: Observation
    readings: Floats
    errors: Floats
    getdp: str
    stray_field: StrayField | None = None

    @property
    def field_map(self) -> xr.Dataset:
        """B at the study's positions as a labelled map, see `halbach_fe.measurement.field_map`."""
        return field_map(self.points, self.flux_density, attributes={
            "study": self.magnet.name, "halbach_fe": version("halbach-fe"),
            "getdp": self.getdp, "method": self.magnet.study.solver.method})

    def summary(self) -> dict[str, object]:
        """Return the main figures for scripts: sizes of map and field, largest error bar."""
        size = np.linalg.norm(self.flux_density, axis=1)
        strongest = int(np.argmax(size))
        return {
            "study": self.magnet.name, "points": len(self.points),
            "readings": len(self.readings), "method": self.magnet.study.solver.method,
            "max_B_T": float(size.max()), "max_B_at_m": self.points[strongest].tolist(),
            "min_B_T": float(size.min()), "largest_error_T": float(self.errors.max()),
            "mean_B_T": self.flux_density.mean(axis=0).tolist(),
            "stray_field": None if self.stray_field is None else self.stray_field.summary()}


def study_observation(magnet: Magnet) -> Observation:
    """Return the study's observation of a map with all components at the study's positions.

    Raises
    ------
    StudyError
        If a position, or the place of a sensor of a probe at that position, is not in air.

    Warns
    -----
    HalbachWarning
        If a position is on a face of magnet or iron, or so far away that it may be in mm.
    """
    return _observed(magnet)[0]


def _observed(magnet: Magnet) -> tuple[Observation, Floats]:
    """Return `study_observation`, and the places (n, 3) in m at which to evaluate the field.

    The first of them are those of the map, the last those of the sensors, and both may be the same.
    """
    points = points_from(magnet.study.observation.positions)
    observation = observe(magnet.study, points, np.ones_like(points, bool))
    displaced = not np.array_equal(observation.points, points)
    places = check_points(
        magnet, np.vstack([points, observation.points]) if displaced else points)
    return replace(observation, points=places[-len(observation.points):]), places


@alone
def solve(magnet: Magnet, session: Session = NOT_KEPT) -> Solution:
    """Solve for the field of the nominal magnet at the study's positions.

    Iron with an H(B) curve is solved by Newton's method. The run folders of GetDP are kept in the
    session's folder and can be run by hand.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the run folders.

    Returns
    -------
    Solution
        Field, readings and their error bars.

    Raises
    ------
    StudyError
        If a position, or the place of a sensor of a probe at that position, is not in air.
    MeshError
        If the magnet cannot be meshed, or positions lie outside the meshed region.
    GetDPError
        If GetDP fails, or its answer does not pass verification.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> solution = hf.solve(magnet, hf.Session.open("results"))
    >>> round(float(solution.field_map["B_T"].sel(component="x").mean()), 3)
    0.603
    """
    observation, places = _observed(magnet)
    points = observation.map_points
    parts = finite_element_part(magnet, places, session, columns=False)
    field = vacuum_part(magnet, places) + parts.nominal
    sensors = slice(-len(observation.points), None)
    errors = reading_errors(magnet, observation, replace(
        parts, nominal=parts.nominal[sensors],
        error=None if parts.error is None else parts.error[sensors]), session)
    return Solution(magnet, points, field[:len(points)], observation,
                    observation.apply(field[sensors]), errors, session.getdp.version,
                    stray_field(magnet, session))


def write_solution(solution: Solution, folder: Path) -> None:
    """Write field_map.h5, .csv and .vtu (for ParaView), and readings.csv."""
    for suffix in (".h5", ".csv", ".vtu"):
        write_map(solution.field_map, folder / f"field_map{suffix}")
    x, y, z = solution.observation.positions.T
    write_text(folder / "readings.csv", csv_text({
        "label": solution.observation.labels, "x_m": x, "y_m": y, "z_m": z,
        "value_T": solution.readings, "error_T": solution.errors}))
