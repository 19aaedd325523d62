"""Folders of results as commands leave them, without what the commands compute."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from halbach_fe.core.files import write_text
from halbach_fe.core.result_folder import result_folder
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import save
from halbach_fe.study.model import Study
from tests.conftest import DIPOLE, changed, parse_study
from tests.support.pages import write_any_page

TINY = changed(DIPOLE, name="tiny", array__blocks_per_ring=4, array__recoil_permeability=1.0,
               observation__positions__angles=8, noise={"regions": [
                   {"name": "bore", "sigma_T": 1e-4}]})
STUDY = parse_study(TINY)
FIGURE = Figure(figsize=(0.2, 0.2))


def results(
    folder: Path, verb: str, study: Study | None = STUDY, reads: Sequence[Path] = (),
    files: Sequence[str] = (), answer: Answer | None = None,
    named: Mapping[str, Path] | None = None,
) -> Path:
    """Write files, a figure and a page with a table; return the folder."""
    said = answer or Answer(f"What of {verb}?", f"{folder.name} says so.", f"Trust in {verb}.",
                            f"Step after {verb}.", "halbach-fe solve STUDY -o DIR")
    with result_folder(folder, f"halbach-fe {verb}", study.name if study else "", reads,
                       named=named or {}):
        for name in files:
            write_text(folder / name, f"{name} of {folder.name}")
        write_any_page(folder / "page.html",
                       save({f"{verb}.png": (FIGURE, f"figure of {verb}")}, folder), study,
                       answer=said, rows=[{"order": "2", "size": f"cell of {verb}"}])
    return folder
