"""The files of a result: its tables, and its page with all figures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from importlib import metadata
from pathlib import Path

import tomlkit

from halbach_fe.api import MultipoleTables
from halbach_fe.design.demagnetization import DemagnetizationMap
from halbach_fe.design.measurement_plan import MeasurementPlan
from halbach_fe.design.shimming import Shim
from halbach_fe.design.sorting import SortedBlocks
from halbach_fe.design.tolerance import Tolerance
from halbach_fe.diagnosis.discriminating_measurements import Separation
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.summary import write_study, write_summary
from halbach_fe.inference.result import InferenceResult
from halbach_fe.inference.storage import write_inference
from halbach_fe.report.campaign import write_campaign_page
from halbach_fe.report.demagnetization import write_demagnetization
from halbach_fe.report.diagnosis import write_diagnosis_report
from halbach_fe.report.inference import write_inference_report
from halbach_fe.report.multipoles import write_multipoles
from halbach_fe.report.plan import write_plan
from halbach_fe.report.shimming import write_shim
from halbach_fe.report.solution import write_solution_report
from halbach_fe.report.sorting import write_sorted
from halbach_fe.report.tolerance import write_tolerance
from halbach_fe.report.verification import write_verification
from halbach_fe.response.mesh_convergence import Verification
from halbach_fe.response.solution import Solution, write_solution
from halbach_fe.study.model import Study
from halbach_fe.synthetic.simulate import SimulatedCampaign, write_campaign


def provenance(getdp: str | None = None) -> dict[str, str]:
    """Versions of the programs, as a page ends with."""
    found = {"halbach-fe": metadata.version("halbach-fe")}
    return found if getdp is None else found | {"GetDP": getdp}


@singledispatch
def write_report(result: object, folder: str | Path) -> Path:
    """Write a result's files into a folder: its tables, and its page with all figures.

    Parameters
    ----------
    result : Solution, InferenceResult, Diagnosis, Verification, MultipoleTables, MeasurementPlan, \
Shim, SortedBlocks, Tolerance, DemagnetizationMap or SimulatedCampaign
    folder : str or Path
        Made if it does not exist.

    Returns
    -------
    Path
        Of the page, which needs no network and no other file.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> solution = hf.solve(magnet, hf.Session.open("results"))
    >>> hf.write_report(solution, "results").name
    'report.html'
    """
    raise TypeError(f"no report can be written of a {type(result).__name__}")


@write_report.register
def _(result: Solution, folder: str | Path) -> Path:

    write_solution(result, Path(folder))
    write_solution_report(result, Path(folder), provenance(result.getdp))
    return Path(folder) / "report.html"


@write_report.register
def _(result: InferenceResult, folder: str | Path) -> Path:
    write_inference(result, Path(folder))
    write_inference_report(result, Path(folder), provenance=provenance())
    return Path(folder) / "report.html"


@write_report.register
def _(result: Diagnosis, folder: str | Path) -> Path:
    study = result.before.study
    text = tomlkit.dumps(study.model_dump(mode="json", exclude_defaults=True))
    return write_diagnosis(result, (), study, text, Path(folder))


@write_report.register
def _(result: Verification, folder: str | Path) -> Path:
    write_verification(result.magnet, result, Path(folder), provenance())
    return Path(folder) / "verification.html"


@write_report.register
def _(result: MultipoleTables, folder: str | Path) -> Path:
    write_multipoles(result.magnet.study, result.tables, None, Path(folder), provenance())
    return Path(folder) / "multipoles.html"


@write_report.register
def _(result: MeasurementPlan, folder: str | Path) -> Path:
    write_plan(result.magnet, result, Path(folder))
    return Path(folder) / "plan.html"


@write_report.register
def _(result: Shim, folder: str | Path) -> Path:
    text = tomlkit.dumps(result.study.model_dump(mode="json", exclude_defaults=True))
    write_shim(result, result.result, text, Path(folder))
    return Path(folder) / "shim.html"


@write_report.register
def _(result: SortedBlocks, folder: str | Path) -> Path:
    write_sorted(result, None, Path(folder))
    return Path(folder) / "sort.html"


@write_report.register
def _(result: Tolerance, folder: str | Path) -> Path:
    write_tolerance(result, Path(folder))
    return Path(folder) / "tolerance.html"


@write_report.register
def _(result: DemagnetizationMap, folder: str | Path) -> Path:
    write_demagnetization(result, Path(folder))
    return Path(folder) / "demagnetization.html"


@write_report.register
def _(result: SimulatedCampaign, folder: str | Path) -> Path:
    written = write_campaign(result, Path(folder))
    write_campaign_page(result.study, result.readings, result.held_out, result.blocks,
                        Path(folder), [path.name for path in written])
    return Path(folder) / "campaign.html"


def write_diagnosis(
    found: Diagnosis, separations: Sequence[Separation], study: Study, text: str, folder: Path,
    assumptions: Sequence[str] = (),
) -> Path:
    """Write summary and page of a diagnosis, and the study with what it lacked.

    Parameters
    ----------
    separations : sequence of Separation
        Which further measurements would tell rival effects apart.
    study : Study
        As it was given.
    text : str
        Of its file, whose comments are kept in study.diagnosed.toml.
    assumptions : sequence of str
        Said at the top of the page.
    """
    write_summary(found, separations, folder)
    write_diagnosis_report(found, separations, folder, assumptions)
    write_study(text, study, found, folder)
    return folder / "diagnosis.html"
