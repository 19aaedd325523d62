"""Finite elements and Bayesian inference for permanent-magnet Halbach arrays.

Examples
--------
>>> import halbach_fe as hf
>>> magnet = hf.halbach_ring(order=2, inner_radius_m=0.015, outer_radius_m=0.04, length_m=0.05)
>>> magnet.field_T([0.01, 0.0, 0.0]).shape
(3,)
>>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
>>> result = hf.infer(magnet, hf.read_map("map.csv"), hf.Session.open("results"))
>>> result.kind
'closed form'
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # that of typing, whose import would be half of the time before `cli.main`
if TYPE_CHECKING:
    from typing import Any

    from halbach_fe.api import HomogeneityResult as HomogeneityResult
    from halbach_fe.api import MultipoleTables as MultipoleTables
    from halbach_fe.api import demagnetization as demagnetization
    from halbach_fe.api import diagnose as diagnose
    from halbach_fe.api import export as export
    from halbach_fe.api import field as field
    from halbach_fe.api import homogeneity as homogeneity
    from halbach_fe.api import import_blocks as import_blocks
    from halbach_fe.api import import_map as import_map
    from halbach_fe.api import magnetic_axis as magnetic_axis
    from halbach_fe.api import multipoles as multipoles
    from halbach_fe.api import plan as plan
    from halbach_fe.api import prior as prior
    from halbach_fe.api import shim as shim
    from halbach_fe.api import simulate_measurement as simulate_measurement
    from halbach_fe.api import sort as sort
    from halbach_fe.api import tolerance as tolerance
    from halbach_fe.core.errors import HalbachError as HalbachError
    from halbach_fe.core.errors import HalbachWarning as HalbachWarning
    from halbach_fe.design.assembly import Assembly as Assembly
    from halbach_fe.design.assembly import cad as cad
    from halbach_fe.design.demagnetization import DemagnetizationMap as DemagnetizationMap
    from halbach_fe.design.forces import Forces as Forces
    from halbach_fe.design.forces import forces as forces
    from halbach_fe.design.measurement_plan import MeasurementPlan as MeasurementPlan
    from halbach_fe.design.ring_design import Designed as Designed
    from halbach_fe.design.ring_design import design_rings as design_rings
    from halbach_fe.design.shim_tray import FilledTray as FilledTray
    from halbach_fe.design.shim_tray import shim_tray as shim_tray
    from halbach_fe.design.shimming import Shim as Shim
    from halbach_fe.design.sorting import SortedBlocks as SortedBlocks
    from halbach_fe.design.tolerance import HomogeneityTolerance as HomogeneityTolerance
    from halbach_fe.design.tolerance import Tolerance as Tolerance
    from halbach_fe.diagnosis.result import Diagnosis as Diagnosis
    from halbach_fe.explanation import Explanation as Explanation
    from halbach_fe.explanation import explain as explain
    from halbach_fe.geometry.magnet import Magnet as Magnet
    from halbach_fe.geometry.magnet import build_magnet as build_magnet
    from halbach_fe.inference.block_prior import MeasuredPrior as MeasuredPrior
    from halbach_fe.inference.block_prior import prior_from_blocks as prior_from_blocks
    from halbach_fe.inference.infer import infer as infer
    from halbach_fe.inference.pose_result import Registration as Registration
    from halbach_fe.inference.registration import register as register
    from halbach_fe.inference.result import InferenceResult as InferenceResult
    from halbach_fe.magnets import from_magpylib as from_magpylib
    from halbach_fe.magnets import halbach_ring as halbach_ring
    from halbach_fe.magnets import magnet_of_blocks as magnet_of_blocks
    from halbach_fe.magnets import new as new
    from halbach_fe.magnets import to_magpylib as to_magpylib
    from halbach_fe.magnets import write_study as write_study
    from halbach_fe.measurement.block_table import BlockTable as BlockTable
    from halbach_fe.measurement.block_table import read_blocks as read_blocks
    from halbach_fe.measurement.campaign_maps import read_maps as read_maps
    from halbach_fe.measurement.field_map import field_map as field_map
    from halbach_fe.measurement.field_map import read_map as read_map
    from halbach_fe.measurement.field_map import write_map as write_map
    from halbach_fe.measurement.map_check import MapCheck as MapCheck
    from halbach_fe.measurement.map_check import check_map as check_map
    from halbach_fe.measurement.map_join import JoinedMaps as JoinedMaps
    from halbach_fe.measurement.map_join import join_maps as join_maps
    from halbach_fe.report.joint_report import campaign_report as campaign_report
    from halbach_fe.report.page import write_report as write_report
    from halbach_fe.response.discretization_error import Verification as Verification
    from halbach_fe.response.discretization_error import verify as verify
    from halbach_fe.response.field_on_lines import FieldOnLines as FieldOnLines
    from halbach_fe.response.field_on_lines import Lines as Lines
    from halbach_fe.response.magnetic_axis import MagneticAxis as MagneticAxis
    from halbach_fe.response.multipoles import MultipoleReference as MultipoleReference
    from halbach_fe.response.region import Region as Region
    from halbach_fe.response.solution import Solution as Solution
    from halbach_fe.response.solution import solve as solve
    from halbach_fe.response.stray_field import StrayField as StrayField
    from halbach_fe.response.stray_field import stray_field as stray_field
    from halbach_fe.solver.session import Session as Session
    from halbach_fe.study.model import Study as Study
    from halbach_fe.study.reader import read_study as read_study
    from halbach_fe.synthetic.simulate import SimulatedCampaign as SimulatedCampaign

_HOME = {
    **dict.fromkeys(("halbach_ring", "magnet_of_blocks", "from_magpylib", "to_magpylib",
                     "write_study"), "magnets"),
    "new": "magnets", "explain": "explanation", "Explanation": "explanation",
    "field_map": "measurement.field_map", "write_map": "measurement.field_map",
    **dict.fromkeys(("import_map", "import_blocks", "export", "prior", "field"), "api"),
    "register": "inference.registration", "Registration": "inference.pose_result",
    "prior_from_blocks": "inference.block_prior", "MeasuredPrior": "inference.block_prior",
    "read_study": "study.reader", "build_magnet": "geometry.magnet",
    "read_map": "measurement.field_map", "read_maps": "measurement.campaign_maps",
    "read_blocks": "measurement.block_table",
    "check_map": "measurement.map_check", "join_maps": "measurement.map_join",
    "JoinedMaps": "measurement.map_join", "Session": "solver.session",
    "solve": "response.solution", "infer": "inference.infer", "diagnose": "api",
    "verify": "response.discretization_error", "multipoles": "api", "homogeneity": "api",
    "Lines": "response.field_on_lines", "FieldOnLines": "response.field_on_lines",
    "stray_field": "response.stray_field", "StrayField": "response.stray_field",
    "magnetic_axis": "api", "MagneticAxis": "response.magnetic_axis",
    "forces": "design.forces",
    "plan": "api", "shim": "api", "shim_tray": "design.shim_tray",
    "FilledTray": "design.shim_tray",
    "design_rings": "design.ring_design", "Designed": "design.ring_design",
    "cad": "design.assembly", "Assembly": "design.assembly",
    "sort": "api", "tolerance": "api", "demagnetization": "api", "simulate_measurement": "api",
    "write_report": "report.page", "campaign_report": "report.joint_report",
    "Study": "study.model", "Magnet": "geometry.magnet", "BlockTable": "measurement.block_table",
    "MapCheck": "measurement.map_check", "Solution": "response.solution",
    "InferenceResult": "inference.result", "Diagnosis": "diagnosis.result",
    "Verification": "response.discretization_error",
    "MultipoleReference": "response.multipoles", "MultipoleTables": "api",
    "Region": "response.region", "HomogeneityResult": "api",
    "Forces": "design.forces",
    "MeasurementPlan": "design.measurement_plan", "Shim": "design.shimming",
    "SortedBlocks": "design.sorting", "Tolerance": "design.tolerance",
    "HomogeneityTolerance": "design.tolerance",
    "DemagnetizationMap": "design.demagnetization", "SimulatedCampaign": "synthetic.simulate",
    "HalbachError": "core.errors", "HalbachWarning": "core.errors"}
"""Module of each name: what is not used is not imported."""

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    """Import a name of the interface when it is first used."""
    if name == "__version__":
        from halbach_fe.core.installation import version

        return version("halbach-fe")
    if name not in _HOME:
        command = {"check": "check_map", "design": "design_rings",
                   "report": "campaign_report"}.get(name)
        raise AttributeError(f"module 'halbach_fe' has no attribute '{name}'" + (
            f"; what `halbach-fe {name}` does is {command}()" if command else ""))
    value = getattr(importlib.import_module(f"halbach_fe.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Names of the interface."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
