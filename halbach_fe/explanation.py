"""From a field map to the magnet that was measured, in as many steps as it needs.

`follow` is the order of the steps, for the command line too. `explain` takes them with objects in
memory.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import xarray as xr

from halbach_fe.api import diagnose
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.core.progress import Say, quiet
from halbach_fe.diagnosis.gross_error_correction import blocks_of
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_result import Registration
from halbach_fe.inference.registration import register
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import is_total_field, taking_arrays
from halbach_fe.measurement.map_check import MapCheck, check_map, oriented
from halbach_fe.measurement.suspect_rows import check_total
from halbach_fe.report import diagnosis_answer, inference_answer, registration_page
from halbach_fe.report.answer import Answer
from halbach_fe.report.map_check_page import answer as answer_of_check
from halbach_fe.report.map_check_page import are_in_order, corrected
from halbach_fe.solver.session import NOT_KEPT, Session, alone


class Steps(Protocol):
    """The steps from a map to the magnet; those that return a bool tell whether it is explained."""

    def check(self) -> None:
        """Check the map by itself, and go on with the map in the right axes if it is not."""

    def infer(self, name: str) -> bool:
        """Update the magnet."""

    def register(self) -> bool:
        """Find where the map lies."""

    def diagnose(self) -> bool:
        """Find what the study lacks; False if nothing was found that can be added to it."""


def follow(steps: Steps) -> None:
    """Take the steps, each as far as the one before it has not explained the map."""
    steps.check()
    if not (steps.infer("inferred") or (steps.register() and steps.infer("updated"))
            ) and steps.diagnose():
        steps.infer("explained")


@dataclass(frozen=True, repr=False)
class Explanation:
    """What a map says of a magnet.

    Attributes
    ----------
    magnet : Magnet
        The magnet of the last update, with what was found before it.
    inference : InferenceResult
        That update by the map.
    sound : bool
        Whether it may be used.
    answers : dict of str to Answer
        What each step says (``said``), how far to trust it (``trust``) and what to do next
        (``next``), by the name of the step.
    check : MapCheck or None
        None if a map cannot be checked by itself.
    poses : list of Registration
        Where the map lies, the likeliest first; empty if that was not asked.
    diagnosis : Diagnosis or None
        What the magnet lacks; None if that was not asked.
    """

    magnet: Magnet
    inference: InferenceResult
    sound: bool
    answers: dict[str, Answer]
    check: MapCheck | None = None
    poses: list[Registration] = field(default_factory=list)
    diagnosis: Diagnosis | None = None

    def __repr__(self) -> str:
        """Return the steps and what the last one says."""
        last = list(self.answers.values())[-1]
        return f"Explanation({', '.join(self.answers)}: {last.said} {last.trust})"


@taking_arrays
@alone
def explain(
    magnet: Magnet, data: xr.Dataset, session: Session = NOT_KEPT,
    blocks: BlockTable | None = None, say: Say = quiet,
) -> Explanation:
    """Check a map, update the magnet by it, and find what is missing where that is not enough.

    Parameters
    ----------
    magnet : Magnet
    data : Dataset
        The map, see `halbach_fe.read_map`; or positions (n, 3) in m, then readings (n, 3) in T, and
        ``sigma_T=``, see `halbach_fe.field_map`.
    session : Session, optional
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    say : callable, optional
        Called with a line of text about each step.

    Returns
    -------
    Explanation

    Raises
    ------
    HalbachError
        As of the functions of the single steps.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> found = hf.explain(magnet, hf.read_map("map.csv"))  # of a plane, which has no check alone
    >>> found.sound, list(found.answers)
    (True, ['inferred'])
    """
    steps = _InMemory(magnet, data, session, blocks, say)
    follow(steps)
    assert steps.result is not None  # every way begins with an update
    return Explanation(steps.updated, steps.result, steps.sound, steps.answers, steps.checked,
                       steps.poses, steps.diagnosis)


@dataclass
class _InMemory:
    """The steps of `explain`, and what they have found so far."""

    magnet: Magnet
    data: xr.Dataset
    session: Session
    blocks: BlockTable | None
    say: Say
    answers: dict[str, Answer] = field(default_factory=dict)
    checked: MapCheck | None = None
    result: InferenceResult | None = None
    poses: list[Registration] = field(default_factory=list)
    diagnosis: Diagnosis | None = None
    sound: bool = False
    updated: Magnet = field(init=False)

    def __post_init__(self) -> None:
        self.updated = self.magnet

    def _answered(self, name: str, answer: Answer) -> bool:
        self.answers[name] = answer
        self.say(f"{name}: {answer.said} {answer.trust}")
        return answer.sound

    def check(self) -> None:
        if is_total_field(self.data):  # which has no Maxwell's equations, but broken rows
            self.data = self.data.isel(point=np.flatnonzero(~check_total(self.data).excluded))
            return
        try:
            self.checked = check_map(self.data, self.say)
        except MeasurementError as error:
            self.say(f"The map cannot be checked by itself: {error}")
            return
        said = answer_of_check(self.checked, are_in_order(self.data))
        self._answered("check", said)
        if "corrected_map" in said.command:
            self.data = corrected(self.checked)
        elif self.checked.is_reoriented or self.checked.excluded.any():
            self.data = oriented(self.checked)

    def infer(self, name: str) -> bool:
        self.result = infer(self.magnet, self.data, self.session.within(name), self.blocks,
                            say=self.say)
        self.updated = self.magnet
        self.sound = self._answered(name, inference_answer.answer(self.result))
        return self.sound

    def register(self) -> bool:
        try:
            self.poses = register(self.magnet, self.data, self.session.within("registered"),
                                  say=self.say)
        except (MeasurementError, StudyError) as error:  # of a plane; or diagnose knows why
            self.say(f"The map cannot be registered: {error}")
            return False
        best = self.poses[0]
        answer = registration_page.answer(self.poses, assumed=self.magnet.study.instrument)
        if registration_page.STUDY_FILE in answer.command:
            self.magnet = build_magnet(best.study)
        return self._answered("registered", answer)

    def diagnose(self) -> bool:
        self.diagnosis = diagnose(self.magnet, self.data, self.session.within("diagnosed"),
                                  self.blocks, say=self.say)
        answer = diagnosis_answer.answer(self.diagnosis)
        if answer.changes_study:
            self.blocks = blocks_of(self.blocks, self.magnet.study, self.diagnosis.study)
            self.magnet = build_magnet(self.diagnosis.study)
        return self._answered("diagnosed", answer) and answer.changes_study
