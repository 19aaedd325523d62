"""Find the effects that a study lacks, and return the study with these effects added.

The diagnosis corrects gross errors of the map (units, axes, wrong magnet) before any inference, and
excludes outliers after the first one. If the solver's own error explains the misfit, it stops
there.

Otherwise it iterates. In every round all effects of the catalogue compete by their linear
signatures, which are cheap to compute. The selected effects enter the study in full, the study is
solved again, and the signatures of these effects are computed anew at that point. This is a
Gauss-Newton method in which the finite-element model takes the place of the linearized one. The
iteration has converged when a round changes neither the selection nor the amplitudes.

In every round the selected effects compete with causes of any shape, so that effects which only
add up to something outside the catalogue are not named (`halbach_fe.diagnosis.competing_causes`).
In the first round, in which the signatures of large effects are not yet exact, they are given up
only if they explain far less.

Random errors of the probe's positions are noise rather than an effect: their size is estimated in
every round, and the comparison is repeated with that noise until it no longer changes.

The answer is the round whose model predicts held-out readings best. It is the last one, unless
effects that only the training readings seemed to show made the prediction worse. If the study
without any effect predicts best, nothing in the catalogue explains the map.

Several maps of one magnet, which the study lists, are diagnosed together: effects of the magnet
must explain all of them, and those of an instrument belong to a map or to a probe.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import ColumnsError, HalbachWarning, NotConvergedError
from halbach_fe.core.progress import Pace, Say, quiet
from halbach_fe.diagnosis.effect_comparison import (
    Search,
    identify_effects,
    possible,
    score_hypotheses,
    with_further_causes,
    with_rivals,
    with_short_steps,
)
from halbach_fe.diagnosis.effect_selection import EFFECT_PRIOR_ODDS, Candidate, probabilities
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis
from halbach_fe.diagnosis.flexible_causes import Family
from halbach_fe.diagnosis.gross_error_correction import (
    beside_amplitudes,
    blocks_of,
    correct_map_errors,
    field_of_iron,
    find_poses,
    possible_positions,
)
from halbach_fe.diagnosis.linearization import (
    Linearization,
    NominalSolver,
    Signatures,
    apply_effects,
    moves_of,
)
from halbach_fe.diagnosis.marginal_evidence import (
    Marginal,
    ResidualGroup,
    loo_residuals,
    residual_groups,
)
from halbach_fe.diagnosis.random_errors import (
    Outlier,
    PositionNoise,
    estimate_position_noise,
    excluding,
    have_settled,
    outliers_of,
    with_position_noise,
)
from halbach_fe.diagnosis.result import (
    Diagnosis,
    Floor,
    FoundPose,
    IdentifiedEffect,
    Imitation,
    SolverErrorExplanation,
    Suspicion,
    UnknownCause,
    explain_by_solver_error,
)
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.diagnosis.summary import place_in_words
from halbach_fe.diagnosis.uncertain_effects import detection_limits, with_uncertain_effects
from halbach_fe.diagnosis.verdict import (
    Further,
    Judgement,
    describe_unknown,
    families_of,
    imitated,
    judge,
    named_effects,
    suspicions,
)
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign_maps import Data, check_maps
from halbach_fe.measurement.field_map import is_total_field
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study

MAX_ROUNDS = 8
"""Largest number of rounds, each of which solves the model once."""

WORSE = 3.0
"""Standard deviations of the mean square of held-out residuals by which a round must predict worse
than the best one if it is not to be the answer."""

Rivals = dict[Hypothesis, tuple[tuple[Candidate, float], ...]]
"""Alternatives of effects, with their log Bayes factors less that of the effect."""


@dataclass(frozen=True)
class _Round:
    """A round of the search, of whose model the effects in it are known."""

    number: int
    """Counted from 1."""
    update: InferenceResult
    search: Search
    judgement: Judgement
    identified: tuple[IdentifiedEffect, ...]
    """The effects in the model."""
    misfit: float
    """Mean square of the held-out residuals, in units of the noise."""

    @property
    def gives_way(self) -> bool:
        """Whether a cause of any shape takes the place of effects once these are in the model."""
        effects = {self.search.hypotheses[number] for number in self.judgement.best.effects}
        return bool(self.judgement.best.terms) and not effects.issuperset(
            effect.hypothesis for effect in self.identified)


def diagnose(
    study: Study, data: Data, session: Session, blocks: BlockTable | None = None,
    effects: Sequence[Effect] | None = None, validation_map: xr.Dataset | None = None,
    say: Say = quiet, solver: NominalSolver | None = None,
    floor_T: Floor | None = None, time_limit_s: float | None = None,
) -> Diagnosis:
    """Find which effects a study lacks to explain its maps.

    Parameters
    ----------
    data : Dataset or dict of str to Dataset
        The map, as `halbach_fe.measurement.field_map.read_map` returns it; or all maps that the
        study lists, see `halbach_fe.measurement.campaign_maps.read_maps`.
    session : Session
        Its folder receives a subfolder for each round.
    blocks : BlockTable, optional
        Measured blocks, whose prior takes the place of the study's.
    effects : sequence of Effect, optional
        The candidate effects; default the whole catalogue.
    validation_map : Dataset, optional
        Another map, which is predicted but not used for the inference.
    say : callable, optional
        Called with a line of text on each step, to report progress.
    solver : NominalSolver, optional
        Several diagnoses may share one, so that equal magnets are solved once.
    floor_T : dict, optional
        The model-free floor of the map by component, to be reported with the results; of maps that
        the study lists, by map and component.
    time_limit_s : float, optional
        Time after which the search ends with what it has so far. The step under way is finished,
        and so is one with the effects that were found; that takes one more inference.

    Returns
    -------
    Diagnosis

    Raises
    ------
    MeasurementError
        If a map or the blocks do not fit the study.
    """
    data = check_maps(study, data)
    if any(is_total_field(one) for one in (
            [data] if isinstance(data, xr.Dataset) else data.values())):
        warnings.warn(
            "Of a map of |B| no gross errors are looked for (units, axes, signs).",
            HalbachWarning, stacklevel=2)
    with session.with_cache() as cached:
        found = _Diagnosing(_Task(
            study, data, cached, blocks, catalogue() if effects is None else effects,
            validation_map, say, solver, floor_T, time_limit_s)).diagnosis()
        names = tuple(effect.name for effect in effects or ())
        return found if effects is None or {one.name for one in catalogue()} <= {
            *names} else replace(found, looked_for=names)


@dataclass(frozen=True)
class _Task:
    """The arguments of `diagnose`; the session has a cache."""

    study: Study
    data: Data
    session: Session
    blocks: BlockTable | None
    effects: Sequence[Effect]
    validation_map: xr.Dataset | None
    say: Say
    solver: NominalSolver | None
    floor_T: Floor | None
    time_limit_s: float | None


class _Diagnosing:
    """The state of a diagnosis from round to round.

    Attributes
    ----------
    corrected : Study
        The study corrected for gross errors and outliers, without any effects.
    identified : tuple of IdentifiedEffect
        The effects that are in the model, or come into it in the next round.
    in_model : tuple
        Those, and the noise of positions, that are in the model of the last update.
    unsolved : bool
        Whether the model of the last round had no solution.
    closing : bool
        Whether the time is up, so that no further signatures are computed.
    update, search, judgement
        Those of the round under way, or of the answer.
    models : list of frozenset of Hypothesis
        The effects in the models of all rounds so far.
    given_up : set of str
        Names of effects that are not selected any more, see `dropped_with_rivals`.
    first : tuple of InferenceResult and Search
        Of the first round; that of another noise of positions has none of its own.
    """

    update: InferenceResult
    search: Search
    judgement: Judgement
    in_model: tuple[tuple[IdentifiedEffect, ...], tuple[PositionNoise, ...]]

    def __init__(self, task: _Task, left: tuple[Outlier, ...] | None = None) -> None:
        """Correct gross errors. The outliers are those that an earlier run has ``left``, if any."""
        self.pace = Pace(task.say, task.session.progress, task.time_limit_s)
        self.task = task = replace(
            task, session=replace(task.session, progress=self.pace.advance))
        self.left, self.say = left, task.say
        self.pace.begin("looking for gross errors of the map")
        iron = field_of_iron(task.study, self._subsession("nominal"))
        self.gross_errors, self.corrected, starts = correct_map_errors(
            task.study, task.data, task.blocks, task.effects, iron)
        for error in self.gross_errors:
            self.say(f"gross error: {error.text}")
        self.poses: tuple[FoundPose, ...] = ()
        if not starts:  # which are places that explain the map
            self.pace.begin("looking where the map lies")
            self.poses, self.corrected = find_poses(
                self.corrected, task.data, self._subsession("pose"), self.say, iron)
        self.blocks = blocks_of(task.blocks, task.study, self.corrected)
        self.campaign = replace(
            Campaign.of(self.corrected, task.data, task.validation_map),
            blocks=beside_amplitudes(self.blocks, self.corrected))
        self.solver = task.solver or NominalSolver(
            replace(self._subsession("signatures"), progress=None))
        self.signatures: Signatures = {}
        self.moves: set[Hypothesis] = set()  # of whole blocks, in the model of the last round
        self.first: tuple[InferenceResult, Search] | None = None
        self.position_noise: tuple[PositionNoise, ...] = ()
        self.converged, self.closing = True, False
        self.outliers: tuple[Outlier, ...] = ()
        self.solver_error: SolverErrorExplanation | None = None
        self.flexible: list[Family] = []
        self.best: _Round | None = None
        self.rivals: Rivals = {}
        self.models: list[frozenset[Hypothesis]] = []
        self.given_up: set[str] = set()
        self.solved: Magnet | None = None  # the last whose single blocks were solved for
        if len(starts) > 1:
            self.say(f"comparing {len(starts)} positions of the map that may be equal by symmetry")
        self.start, self.positions = possible_positions(starts, self._updated, self.campaign)
        self.identified, self.unsolved = self.start, False

    def diagnosis(self) -> Diagnosis:
        """Go from round to round, and return the one that predicts held-out readings best."""
        rounds = next((number for number in range(1, MAX_ROUNDS + 1) if self._is_last(number)),
                      MAX_ROUNDS) - self.unsolved
        answer = self._choose_answer(rounds)
        if self._has_other_outliers():
            return _Diagnosing(replace(
                self.task, blocks=self.blocks, solver=self.solver), self.left).diagnosis()
        return self._result(rounds, answer)

    def _is_last(self, number: int) -> bool:
        """Solve the model with what was found, and compare all effects at that point.

        The iteration ends if nothing has changed, if the time is up, if the solver's own error
        explains the misfit, or if the model with what was found has no solution, as with steps
        that drive a permeability up because none of the effects is what the model lacks.
        """
        try:
            self._solve(number)
        except (ColumnsError, NotConvergedError) as error:
            if number == 1:
                raise
            self.say(f"round {number}: the model with these effects has no solution: {error}")
            self.converged, self.unsolved = False, True
            self.identified, self.position_noise = self.in_model
            return True
        self.in_model = self.identified, self.position_noise
        self._compare(number)
        if self.solver_error:
            self.say("the solver's own error explains the misfit")
            return True
        found = self._select(number)
        self.given_up |= dropped_with_rivals(self.models, self.identified, found)
        self.models.append(frozenset(effect.hypothesis for effect in self.identified))
        if self._noise_has_changed():
            self.closing = self.pace.is_over
            return False
        self.converged = _has_converged(self.identified, found)
        self._keep_if_best(number)
        if self.converged:
            # the model has the old amplitudes; their sd and evidence are those of this round
            present = {effect.hypothesis: effect.values for effect in self.identified}
            self.identified = tuple(replace(effect, values=present[effect.hypothesis])
                                    for effect in found)
            return True
        if self.closing:  # the model has the effects of the previous round
            return True
        self.converged = only_equals_took_turns(self.identified, found)
        if self.converged:
            return True
        short = with_short_steps(found, self.identified)
        # a step that ends inside material is made as a whole, which was found to be possible
        self.identified = short if possible(self.corrected, short, self.campaign) else found
        self.closing = self.pace.is_over
        if self.closing:
            self.say("the time is up: the effects so far are put into the model")
        return False

    def _solve(self, number: int) -> None:
        """Update the model with the effects so far; in the first round, look for outliers."""
        added = "; ".join(
            " ".join(filter(None, (effect.hypothesis.effect.title, place_in_words(effect.place))))
            for effect in self.identified)
        self.say(f"round {number}: the model with {added or 'no effect added'}")
        self.pace.begin(f"round {number}, solving")
        self.update = self._updated(self.identified, f"round-{number}")
        if number > 1:
            return
        self.with_all = self.corrected
        self.outliers = (outliers_of(self.update, self.campaign) if self.left is None
                         else self.left)
        if self.outliers:
            self.say(f"outliers: {len(self.outliers)} readings are excluded")
            self.corrected = excluding(self.corrected, self.outliers)
            self.update = self._updated(self.identified, "without-outliers")

    def _compare(self, number: int) -> None:
        """Compare all effects at the point of the model."""
        self.pace.begin(f"round {number}, effects")
        moves = {effect.hypothesis for effect in moves_of(self.identified)}
        if self.update.terms is not None or moves != self.moves:
            self.signatures.clear()  # they were at the poses, or of the blocks, of the last round
        self.moves = moves
        prior_mean = (self.first[0] if self.first else self.update).prior.mean
        self.search = score_hypotheses(
            Linearization(self.corrected, self.start, self.update, prior_mean, self.campaign,
                          self.solver, self.identified, self.signatures),
            self.task.effects, self.pace.advance, lambda: self.closing or self.pace.is_over
        ).without(self.given_up)
        self.first = self.first or (self.update, self.search)
        self.solver_error = None if self.identified else explain_by_solver_error(self.update)

    def _select(self, number: int) -> tuple[IdentifiedEffect, ...]:
        """Select effects, and let causes of any shape compete with them.

        In the first round effects give way only if these explain far more.
        """
        found = identify_effects(self.corrected, self.search)
        self.flexible = self.flexible or families_of(self.search, self.update)
        self.judgement = judge(self.search, self.update, found, self.flexible)
        if number > 1 or self.judgement.is_clear or _has_converged(self.identified, found):
            found = named_effects(self.corrected, self.search, self.judgement, found)
        return with_first_rivals(found, self.identified, self.rivals)

    def _noise_has_changed(self) -> bool:
        """Add the errors of positions to the noise, and tell whether they are others than so far.

        In the last round they stay.
        """
        estimate = vibration_beyond(
            self.judgement, self.update, self.campaign, self.search, self.position_noise)
        if self.closing or have_settled(self.position_noise, estimate):
            return False
        sizes = [f"{1e3 * noise.sd_m:.2g} mm{f' in map {noise.map}' if noise.map else ''}"
                 for noise in estimate]
        self.say("vibration: positions with a standard deviation of "
                 f"{' and '.join(sizes) or '0 mm'} are added to the noise")
        self.position_noise = estimate
        self.signatures.clear()  # they were whitened by the previous noise
        return True

    def _keep_if_best(self, number: int) -> None:
        """Keep the round if it predicts held-out readings as well as the best so far."""
        assert self.first is not None
        first = self.first[0]
        this = _Round(number, self.update, self.search, self.judgement, self.identified,
                      _held_out_misfit(self.update, self.search, first))
        # residuals below the error bars, of mean square 1, tell no round from another
        if not this.gives_way and (self.best is None or this.misfit <= max(
                self.best.misfit, 1.0) * _chance(first)):
            self.best = this

    def _choose_answer(self, rounds: int) -> int:
        """Return to the round that predicts best, and return its number."""
        best = self.best
        if best is None or self.solver_error or best.number == rounds:
            return rounds
        self.say(f"round {best.number} predicts the held-out readings best, and is the answer")
        self.update, self.search, self.judgement, self.identified = (
            best.update, best.search, best.judgement, best.identified)
        if not self.identified:  # what explains the map is none of the effects
            self.judgement = replace(self.judgement, best=self.judgement.without)
        return best.number

    def _has_other_outliers(self) -> bool:
        """Look for outliers once more with the effects in the model, and tell whether they differ.

        Near a block that is wrong, readings had seemed to disagree with their neighbours.
        """
        if not (self.outliers and self.identified and self.left is None
                and not self.pace.is_over):
            return False
        self.left = outliers_of(infer(
            build_magnet(with_position_noise(
                apply_effects(self.with_all, self.identified), self.position_noise)),
            self.task.data, self._subsession("all-readings"),
            beside_amplitudes(self.blocks, self.corrected),
            validation_map=self.task.validation_map), self.campaign)
        if {_place_of(one) for one in self.left} == {_place_of(one) for one in self.outliers}:
            return False
        self.say(f"outliers: with these effects in the model they are {len(self.left)} readings; "
                 "again")
        return True

    def _result(self, rounds: int, answer: int) -> Diagnosis:
        """Describe what is unknown, suspected or imitated, and put everything together."""
        assert self.first is not None
        before, first = self.first
        update, search = self.update, self.search
        unknown: UnknownCause | None = None
        suspected: tuple[Suspicion, ...] = ()
        imitation: Imitation | None = None
        further: Further | None = None
        if not self.solver_error:
            unknown = describe_unknown(self.judgement, update, search, self.identified)
            if unknown is None:
                further = Further.of(self.judgement)
                if answer == rounds:
                    suspected = suspicions(self.judgement, further, self.corrected, search)
                imitation = imitated(self.judgement, further, update, search, suspected)
        alone = unknown is not None and unknown.alone
        if alone and not self.start and not self.position_noise:
            update, search = self.first
        identified = with_rivals(search, self.identified)
        if further is not None:
            identified = with_further_causes(search, identified, further.probabilities)
        numbers = [search.hypotheses.index(effect.hypothesis) for effect in identified]
        in_model = [column for number in numbers for column in search.candidates[number].columns]
        study = with_uncertain_effects(self.corrected, identified, [
            each for one in (*suspected, imitation) if one for each in one.fitted])
        return Diagnosis(
            corrected_study=self.corrected, before=before, after=update,
            study=with_position_noise(study, self.position_noise),
            identified=identified, unknown=unknown,
            probabilities=probabilities(
                first.evidence, first.candidates,
                self.judgement.best.log_odds if alone else -np.inf),
            evidence=first.evidence, candidates=first.candidates,
            groups_before=_groups(before, first.marginal, first.training),
            groups_after=_groups(update, search.marginal, search.training),
            loo_residuals_before=loo_residuals(first.marginal, first.training),
            loo_residuals_after=loo_residuals(search.marginal, search.training), rounds=rounds,
            answer=answer, gross_errors=self.gross_errors, poses=self.poses,
            outliers=self.outliers, position_noise=self.position_noise,
            solver_error=self.solver_error, imitated=imitation,
            converged=self.converged, unsolved=self.unsolved,
            positions=self.positions,
            limits=detection_limits(update, self.campaign, search.columns[:, in_model]),
            floor_T=self.task.floor_T, suspected=suspected,
            uncompared=search.uncompared if self.closing or search.uncompared else None)

    def _updated(self, identified: Sequence[IdentifiedEffect], name: str) -> InferenceResult:
        """Infer the blocks with some effects in the model."""
        known = beside_amplitudes(self.blocks, self.corrected) if identified else self.blocks
        study = with_position_noise(
            apply_effects(self.corrected, identified), self.position_noise)
        update = infer(
            build_magnet(study), self.task.data, self._subsession(name), known,
            linearized_only=True,  # `infer` of the study as found tells whether that is enough
            validation_map=self.task.validation_map, similar=self.solved)
        self.solved = self.solved if update.response.of_similar else update.magnet
        return update

    def _subsession(self, name: str) -> Session:
        """Return a session that works in a subfolder."""
        session = self.task.session
        return replace(session, folder=session.folder / name)


def vibration_beyond(
    judgement: Judgement, update: InferenceResult, campaign: Campaign, search: Search,
    current: tuple[PositionNoise, ...],
) -> tuple[PositionNoise, ...]:
    """Return the random errors of positions beyond what effects and terms of any shape explain.

    Terms with nearly as many functions as there are points explain all errors of these. So
    vibration in place of terms is compared with them by its evidence beside the same effects.
    """
    best = judgement.best
    if not judgement.fits:
        return estimate_position_noise(
            update, campaign, search.marginal,
            np.hstack([search.columns, *judgement.whitened_terms()]), search.training, current)
    columns = [k for number in best.effects for k in search.candidates[number].columns]
    found = estimate_position_noise(update, campaign, search.marginal, search.columns[:, columns],
                                    search.training, current, smooth=False)
    gain = sum(one.over_none + np.log(EFFECT_PRIOR_ODDS) for one in found)
    terms = best.log_odds - judgement.competition.explanation(best.effects, ()).log_odds
    return found if gain > terms else current


def _place_of(outlier: Outlier) -> tuple[str | None, int, str]:
    """Return where an outlier is in the maps."""
    return outlier.map, outlier.row, outlier.component


def _held_out_misfit(update: InferenceResult, search: Search, first: InferenceResult) -> float:
    """Return the mean square of the held-out residuals, in units of the noise of the first round.

    Without held-out readings it is that of the training readings, each predicted from all others.
    """
    chosen = update.held_out
    if not chosen.any():
        return float(np.mean(loo_residuals(search.marginal, search.training)**2))
    residual = (update.readings - update.prediction_posterior.mean)[chosen]
    return float(np.mean((residual / first.errors.sd[chosen])**2))


def _chance(first: InferenceResult) -> float:
    """Return the ratio of two mean squares of held-out residuals that is still chance."""
    count = int(first.held_out.sum()) or int((~first.held_out).sum())
    return 1 + WORSE * float(np.sqrt(2 / count))


def with_first_rivals(
    found: Sequence[IdentifiedEffect], identified: Sequence[IdentifiedEffect], rivals: Rivals
) -> tuple[IdentifiedEffect, ...]:
    """Return effects with the alternatives that they had when they were found.

    All signatures are then linear. Later only that of the effect in the model is exact, and an
    equal cause whose signature is not seems to explain less.

    Parameters
    ----------
    identified : sequence of IdentifiedEffect
        The effects in the model.
    rivals : dict
        The alternatives by effect, relative to it in log Bayes factor. Those of effects that are
        not in the model yet are stored.
    """
    present = {effect.hypothesis for effect in identified}
    names = {(effect.hypothesis.effect.name, effect.hypothesis.place.name) for effect in found}
    changed = []
    for effect in found:
        own = effect.selection
        if effect.hypothesis not in present:
            rivals[effect.hypothesis] = tuple(
                (one, factor - own.log_bayes_factor) for one, factor in own.alternatives)
        known = names | {(one.effect, one.place) for one, _ in own.alternatives}
        further = tuple((one, own.log_bayes_factor + more)
                        for one, more in rivals.get(effect.hypothesis, ())
                        if (one.effect, one.place) not in known)
        changed.append(replace(effect, selection=replace(
            own, alternatives=(*own.alternatives, *further))))
    return tuple(changed)


def dropped_with_rivals(
    models: Collection[frozenset[Hypothesis]], identified: Sequence[IdentifiedEffect],
    found: Sequence[IdentifiedEffect],
) -> set[str]:
    """Return the names of the effects that took the search back to one of its earlier models.

    They were dropped in their own model, and would be found again and again. (The solver's error of
    a magnet with an iron ring may hide what that ring was to explain.) Where others explain the
    readings as well as they seemed to, the search goes on with those.
    """
    left = {effect.hypothesis for effect in found}
    if left not in models:
        return set()
    return {effect.hypothesis.effect.name for effect in identified
            if effect.hypothesis not in left and any(
                other.effect != effect.hypothesis.effect.name
                for other, _ in effect.selection.alternatives)}


def _has_converged(old: Sequence[IdentifiedEffect], new: Sequence[IdentifiedEffect]) -> bool:
    """Tell whether a round changed neither the selected effects nor their amplitudes."""
    before = {effect.hypothesis: effect for effect in old}
    return before.keys() == {effect.hypothesis for effect in new} and all(
        _same_amplitudes(before[effect.hypothesis], effect) for effect in new)


def only_equals_took_turns(
    old: Sequence[IdentifiedEffect], new: Sequence[IdentifiedEffect]
) -> bool:
    """Tell whether a round only put effects in place of others that explain the readings as well.

    Such effects would take turns in all further rounds. The amplitudes of the others must have come
    to rest.
    """
    before = {effect.hypothesis: effect for effect in old}
    fresh = [effect for effect in new if effect.hypothesis not in before]
    kept = [effect for effect in new if effect.hypothesis in before]
    gone = before.keys() - {effect.hypothesis for effect in kept}
    equals = {(other.effect, other.place) for effect in fresh
              for other, _ in effect.selection.alternatives}
    return bool(fresh) and len(fresh) == len(gone) and all(
        (hypothesis.effect.name, hypothesis.place.name) in equals for hypothesis in gone) and all(
        _same_amplitudes(before[effect.hypothesis], effect) for effect in kept)


def _same_amplitudes(old: IdentifiedEffect, new: IdentifiedEffect) -> bool:
    """Tell whether the amplitudes of an effect agree within the convergence tolerance.

    The first amplitude of an effect that is applied in full is a switch (1 if the effect is
    present), and is not compared.
    """
    if len(old.values) != len(new.values):
        return False
    # largest change of an amplitude between rounds that counts as converged, in units of the
    # amplitude's posterior standard deviation
    tolerance = 0.2
    close = np.abs(old.values - new.values) <= tolerance * new.sd
    return bool(close[old.hypothesis.effect.applied_in_full:].all())


def _groups(update: InferenceResult, marginal: Marginal, residual: Floats) -> list[ResidualGroup]:
    """Return chi-squared of the training readings grouped by map, z window, azimuth, radius and
    component.

    Kinds of groups with one member only or with more than 40 are left out. Positions are those that
    the map states; of several maps, those in the magnet.
    """
    on_axis_m = 1e-6  # distance from the axis below which a point has no azimuth
    chosen = ~update.held_out
    observation, several = update.observation, update.is_campaign
    x, y, z = (observation.places if several else observation.positions)[chosen].T
    angle, radius = np.degrees(np.arctan2(y, x)) % 360, np.hypot(x, y)
    edges = np.linspace(z.min(), z.max() + 1e-9, 13)
    window = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, 11)
    maps, labels = (np.array(each)[chosen].tolist()
                    for each in (update.maps, observation.labels))
    members = {
        "map": maps,
        "z": [f"{edges[k]:.3f} ... {edges[k + 1]:.3f} m" for k in window],
        "angle": [f"{30 * int(azimuth // 30)} ... {30 * int(azimuth // 30) + 30} deg"
                  if distance > on_axis_m else "on the axis"
                  for azimuth, distance in zip(angle, radius, strict=True)],
        "radius": [f"{distance:.4f} m" for distance in radius],
        "label": [f"{label} of {name}" if several else label
                  for name, label in zip(maps, labels, strict=True)]}
    used = {kind: names for kind, names in members.items() if 1 < len(set(names)) <= 40}
    return residual_groups(marginal, residual, used)
