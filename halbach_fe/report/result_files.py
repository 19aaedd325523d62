"""The files of a result: its tables, and its HTML page with all figures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from operator import attrgetter
from pathlib import Path

from halbach_fe.api import HomogeneityResult, MultipoleTables
from halbach_fe.core.arguments import typed
from halbach_fe.core.result_folder import result_folder
from halbach_fe.core.versions import version
from halbach_fe.diagnosis.discriminating_measurements import Separation
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.summary import write_study, write_summary
from halbach_fe.inference.result import InferenceResult
from halbach_fe.inference.storage import write_inference
from halbach_fe.report import shim_tray, shimming, sorting, tolerance  # noqa: F401 each registers its page
from halbach_fe.report.campaign import write_campaign_page
from halbach_fe.report.diagnosis import write_diagnosis_report
from halbach_fe.report.homogeneity import write_homogeneity
from halbach_fe.report.inference import write_inference_report
from halbach_fe.report.multipoles import write_multipoles
from halbach_fe.report.page import page_of, write_files
from halbach_fe.report.solution import write_solution_report
from halbach_fe.report.verification import write_verification
from halbach_fe.response.discretization_error import Verification
from halbach_fe.response.solution import Solution, write_solution
from halbach_fe.study.edit_file import study_text
from halbach_fe.study.model import Study
from halbach_fe.synthetic.simulate import SimulatedCampaign, write_campaign

OWNERS: dict[type, tuple[str, str]] = {
    Solution: ("solve", "magnet.study"), InferenceResult: ("infer", "study"),
    Diagnosis: ("diagnose", "corrected_study"), Verification: ("verify", "magnet.study"),
    MultipoleTables: ("multipoles", "magnet.study"),
    HomogeneityResult: ("homogeneity", "magnet.study"),
    SimulatedCampaign: ("simulate-measurement", "study")}
"""The command that writes each result too, and where the result has its study."""


def provenance(getdp: str | None = None) -> dict[str, str]:
    """Return the versions of the programs, which are shown at the end of a page."""
    versions = {"halbach-fe": version("halbach-fe")}
    return versions if getdp is None else versions | {"GetDP": getdp}


@typed
def write_report(result: object, folder: str | Path) -> Path:
    """Write the files of a result into a folder: its tables, and its HTML page with all figures.

    Parameters
    ----------
    result : Solution, InferenceResult, Diagnosis, Verification, MultipoleTables, \
HomogeneityResult, Forces, MeasurementPlan, FilledTray, Shim, SortedBlocks, Assembly, \
Tolerance, HomogeneityTolerance, DemagnetizationMap or SimulatedCampaign
        The result of a function of `halbach_fe`.
    folder : str or Path
        Folder for the files; it is made if it does not exist. As on the command line, it belongs to
        one command and one study: results that it holds of these are replaced.

    Returns
    -------
    Path
        Path of the page, which needs no network and no other file.

    Raises
    ------
    OutputError
        If a file cannot be written, another run is using the folder, or it holds results of
        another command or study.
    TypeError
        If ``result`` is of any other type.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> solution = hf.solve(magnet, hf.Session.open("results"))
    >>> hf.write_report(solution, "field").name
    'report.html'
    """
    owner = next((OWNERS[kind] for kind in type(result).__mro__ if kind in OWNERS), None)
    if owner is None:
        page = page_of(result)
        with result_folder(Path(folder), f"halbach-fe {page.command}", page.study.name):
            return write_files(page, Path(folder))
    command, study = owner
    with result_folder(Path(folder), f"halbach-fe {command}", attrgetter(study)(result).name):
        return _write(result, folder)


@singledispatch
def _write(result: object, folder: str | Path) -> Path:
    """Write the files of a result of any type; return the path of the page."""
    raise TypeError(f"there is no report for a {type(result).__name__}")


@_write.register
def _(result: Solution, folder: str | Path) -> Path:
    write_solution(result, Path(folder))
    write_solution_report(result, Path(folder), provenance(result.getdp))
    return Path(folder) / "report.html"


@_write.register
def _(result: InferenceResult, folder: str | Path) -> Path:
    write_inference(result, Path(folder))
    write_inference_report(result, Path(folder), provenance=provenance())
    return Path(folder) / "report.html"


@_write.register
def _(result: Diagnosis, folder: str | Path) -> Path:
    study = result.corrected_study
    text = study_text(study)
    return write_diagnosis(result, (), study, text, Path(folder))


@_write.register
def _(result: Verification, folder: str | Path) -> Path:
    write_verification(result.magnet, result, Path(folder), provenance())
    return Path(folder) / "verification.html"


@_write.register
def _(result: MultipoleTables, folder: str | Path) -> Path:
    write_multipoles(result.magnet.study, result.tables, None, Path(folder), provenance(),
                     result.disagreement, result.left_out)
    return Path(folder) / "multipoles.html"


@_write.register
def _(result: HomogeneityResult, folder: str | Path) -> Path:
    write_homogeneity(result, Path(folder), provenance())
    return Path(folder) / "homogeneity.html"


@_write.register
def _(result: SimulatedCampaign, folder: str | Path) -> Path:
    written = write_campaign(result, Path(folder))
    write_campaign_page(result.study, result.readings, result.held_out, result.blocks,
                        Path(folder), [path.name for path in written])
    return Path(folder) / "campaign.html"


def write_diagnosis(
    diagnosis: Diagnosis, separations: Sequence[Separation], study: Study, text: str, folder: Path,
    assumptions: Sequence[str] = (), origin: Path | None = None,
) -> Path:
    """Write summary and page of a diagnosis, and the study with the identified effects added.

    Parameters
    ----------
    diagnosis : Diagnosis
    separations : sequence of Separation
        Further measurements that would distinguish rival effects.
    study : Study
        The study before the diagnosis.
    text : str
        Text of the study's file, whose comments are kept in study.diagnosed.toml.
    folder : Path
    assumptions : sequence of str
        Sentences that are shown at the top of the page.
    origin : Path, optional
        Folder of the study's file, from which paths of maps start.

    Returns
    -------
    Path
        Path of the page.
    """
    write_summary(diagnosis, separations, folder)
    write_diagnosis_report(diagnosis, separations, folder, assumptions)
    write_study(text, study, diagnosis, folder, origin)
    return folder / "diagnosis.html"
