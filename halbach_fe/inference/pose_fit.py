"""Least squares of a map's pose, its probe and open numbers, together with the blocks.

The magnetizations of the blocks have the study's prior and are eliminated from the normal
equations, with what the study leaves open beside them: uncertain amplitudes of the instrument, and
the blocks of neighbours. Derivatives by the pose are those in the field of the blocks that explain
the readings best. On a line, where a wrong start is bent into shape by blocks, noise is added at
first and taken away in steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, box_middle, rms, spread
from halbach_fe.core.errors import HalbachError, MeasurementError, StudyError, must_be
from halbach_fe.core.progress import Pace
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.campaign_readings import unit_vectors
from halbach_fe.inference.pose_result import OpenKey, PosePrior, ProbePrior, Registration
from halbach_fe.inference.pose_search import (
    LONGEST_M,
    LONGEST_RAD,
    NARROW,
    Field,
    line_of,
    moved_by,
    right_angles,
    share_of,
)
from halbach_fe.inference.relinearization import of_total_field, shown_less_read
from halbach_fe.measurement.doubted_terms import (
    UNITS,
    Term,
    block_doubts,
    doubts,
    factor_of,
    likeness_of,
    trade_offs,
    words_of,
)
from halbach_fe.measurement.field_map import is_total_field, points_of
from halbach_fe.measurement.observation_operator import (
    excluded_components,
    held_out_readings,
    observe,
    observe_total,
)
from halbach_fe.measurement.probe_law import (
    DIFFERENCE_M,
    NAMES,
    POSE,
    SMALL,
    STEADY,
    by_terms,
    field_at_sensors,
    in_si_and_magnet_axes,
    remove_nonlinear_part,
    seen,
    sensor_matrix,
    sensor_positions,
    sensors_apart,
    total_without_nonlinear_part,
    with_terms,
)
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.response.block_variation import (
    STEP,
    Deviations,
    neighbour_columns,
    neighbour_prior,
    study_prior,
)
from halbach_fe.solver.routes import field_function
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import CovarianceFactor, Gaussian, largest_directions, root_matrix
from halbach_fe.study.inference_keys import shifted
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study

ITERATIONS = 25
"""Largest number of steps of a fit."""

AT_REST, NO_BETTER = 0.02, 1e-3
"""A fit is at rest if no step is longer than the first, in standard deviations of a parameter, or
if a step decreases chi-squared by a smaller part than the second."""

NEARLY_AT_REST = 0.1
"""The same where no step decreases chi-squared: rounding, and changes of the derivatives within a
step, leave 0.05 to 0.07 of the FASER dipole's profile."""

NO_BETTER_ON_A_LINE = 1e-4
"""The same on a line, where place, step, length and bore stand in for each other."""

SEEN = 0.1
"""Combinations of blocks' deviations are left out whose effect on all readings together is below
this many noises of a reading. Which ones are left out changes with the pose: with an rms effect of
a tenth of the noise, 5.7 noises on 3 300 readings, chi-squared jumped by several units from step
to step, and the fit of the MRI magnet's map did not come to rest."""

LONGEST_SD = 1.0
"""Longest step of an open key, in prior standard deviations."""

BLURS = (1.0, 0.1, 0.01)
"""Noise that is added on a line while the fit is on its way, in units of what the nominal blocks
leave at first."""

DEVIATION = 0.05
"""Deviations of the blocks relative to their magnetization. Fields per block are kept as long as a
shift of the sensors changes the field of such deviations by less than the noise."""

NEAR = 0.1
"""Part of the shift that `DEVIATION` allows up to which columns are kept on a line, where single
blocks are near."""

HALVINGS = 5
"""Largest number of halvings of a step that does not improve the fit."""

PROBE = STEADY.stop - POSE.stop
"""Number of parameters of the probe: crosstalk, gains, offsets, and places of the sensors."""

GAINS = slice(6, 9)
"""Gains among the parameters of the probe."""

OFFSETS = slice(9, 12)
"""Offsets among the parameters of the probe."""

PART_OF_SD = 0.1
"""Step of the finite differences by open keys, in prior standard deviations."""


@dataclass(frozen=True)
class PoseFit:
    """What the fits of all poses share."""

    magnet: Magnet
    points: Floats
    readings: Floats
    """The map in m and T, by the study's units and axes. Shape (n, 3)."""
    data: xr.Dataset
    """The map as it was read, in these units and axes."""
    training: NDArray[np.bool_]
    held_out: NDArray[np.bool_]
    """Shape (n, 3)."""
    sigma: Floats
    """Noise of the readings, without that of positions; 1 T for those that are not used.
    Shape (n, 3), in T."""
    position_sd: Floats
    """Shape (3,), in m."""
    session: Session
    probe: ProbePrior
    base: Instrument
    """The study's instrument without its pose."""
    open: tuple[OpenKey, ...]
    pose_sd: Floats
    """Prior standard deviations of the pose in m and rad. Shape (6,)."""
    on_known_stage: bool
    """Whether these are about the pose from which a fit starts."""
    deviations: Deviations
    prior: Gaussian
    """Of all parameters of the blocks."""
    total: bool = False
    """Whether the map is of |B|, which stands in place of Bx. The probe then has one gain and one
    offset, which are those of x, and no other terms."""
    is_part: bool = False
    """Whether these are some of the map's readings only."""
    derivatives: dict[str, Floats] = dataclasses.field(default_factory=dict, repr=False)
    """Derivatives of B by the open keys at the places of the present fit, see `_by_open_keys`."""
    solved: dict[bytes, Field] = dataclasses.field(default_factory=dict, repr=False)
    """The last fields that were solved for, by the values of the open keys."""
    built: dict[bytes, Magnet] = dataclasses.field(default_factory=dict, repr=False)
    """The last magnets that were built, by the values of the open keys."""

    @classmethod
    def of(cls, magnet: Magnet, data: xr.Dataset, session: Session, probe: ProbePrior,
           open_keys: tuple[OpenKey, ...], pose: PosePrior, blocks: Gaussian | None) -> PoseFit:
        """Prepare the fit of a map, as `halbach_fe.inference.registration.register` takes it."""
        study = magnet.study
        if magnet.dimension == 2:
            raise StudyError(must_be("`dimension`", f"study {study.name}", "3, to register a map",
                                     "2"))
        _check_open_keys(magnet, open_keys)
        base = study.instrument.with_(translation_m=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0))
        data = in_si_and_magnet_axes(base, data)
        points, total = points_of(data), is_total_field(data)
        excluded = excluded_components(study, len(points))
        if total:
            readings = np.full(points.shape, np.nan)
            readings[:, 0] = total_without_nonlinear_part(base, data)
            measured = np.isfinite(readings) & ~excluded.any(axis=1, keepdims=True)
            observation = observe_total(
                study.with_(instrument=base), points, measured[:, 0],
                np.tile([1.0, 0.0, 0.0], (len(points), 1)))
        else:
            readings = remove_nonlinear_part(base, data)
            measured = np.isfinite(readings) & ~excluded
            observation = observe(study.with_(instrument=base), points, measured)
        if study.observation.quantity != "flux_density":
            raise MeasurementError(must_be(
                "observation", f"study {study.name}", "of flux_density, to register a map",
                study.observation.quantity))
        # one component of one point each
        entries = 3 * observation.map_rows if total else observation.analysis.indices
        apart = held_out_readings(study, observation)
        held_out, training = (np.zeros(measured.size, bool) for _ in range(2))
        held_out[entries[apart]], training[entries[~apart]] = True, True
        # positions make readings noisy by the gradient where the map lies, which is not known yet
        position = np.array(study.noise.position_sd_m or (0.0,)) if study.noise else np.zeros(1)
        if study.noise is not None and study.noise.regions:
            study = study.with_(noise=study.noise.with_(position_sd_m=None))
        elif "sigma_T" in data:
            study = study.with_(noise=None)
        sigma = np.ones(measured.size)
        sigma[entries] = reading_noise(magnet.with_study(study), observation, data).sd
        deviations = Deviations.of(magnet)
        if blocks is None:
            blocks = study_prior(magnet, deviations.count)
        return cls(magnet, points, np.nan_to_num(readings), data, training.reshape(-1, 3),
                   held_out.reshape(-1, 3), sigma.reshape(-1, 3), np.broadcast_to(position, 3),
                   session, probe, base, open_keys, pose.sd(magnet), pose.stage is not None,
                   deviations, blocks, total)

    @property
    def smallest_sigma(self) -> float:
        """Noise in T of the most exact reading."""
        return float(self.sigma[self.training].min())

    @cached_property
    def on_a_line(self) -> bool:
        """Whether the map lies on a line, so that it does not determine its pose."""
        return line_of(self.points, NARROW * self.magnet.bore_radius) is not None

    def prior_sd(self) -> Floats:
        """Return the prior standard deviations of the parameters after the pose."""
        probe = self.probe
        return np.concatenate([np.full(6, probe.crosstalk), np.full(3, probe.gain),
                               np.full(3, probe.offset_T), np.full(9, probe.sensor_m),
                               np.array([each.sd for each in self.open])])

    def instrument(
        self, pose: Floats, values: Floats, study: Study | None = None
    ) -> Instrument:
        """Return the instrument of a pose (6,) and of the other parameters.

        ``study`` is one of another instrument than this one.
        """
        base = self._base(values, study)
        middle = self._origin(base)
        return with_terms(base, middle, np.concatenate([
            pose[:3] - middle, pose[3:], self._of_probe(values[:PROBE]), np.zeros(3)]))

    def _of_probe(self, values: Floats) -> Floats:
        """Return the terms (21,) of the probe: of one of |B| those of x stand for all."""
        if not self.total:
            return values
        found = np.zeros(PROBE)
        found[GAINS], found[OFFSETS] = values[GAINS.start], values[OFFSETS.start]
        return found

    def _shown(self, values: Floats, along: Floats) -> Floats:
        """Return what the map shows of changes (n, 3, ...) of what three sensors would show.

        Of a map of |B| it is the part along the field, whose directions (n, 3) are ``along``.
        """
        if not self.total:
            return values
        found = np.zeros(values.shape)
        found[:, 0] = np.einsum("nc,nc...->n...", along, values)
        return found

    def _origin(self, base: Instrument) -> Floats:
        """Return the middle (3,) in m of the map, in the scale of an instrument without pose."""
        return box_middle(sensor_positions(base.with_(
            sensor_position_m=((0.0, 0.0, 0.0),) * 3), self.points)[:, 0])

    def _base(self, values: Floats, study: Study | None = None) -> Instrument:
        """Return the instrument without its pose, with the values of the open keys."""
        own = self.base if study is None else study.instrument.with_(
            translation_m=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0))
        study = self.magnet.study.with_(instrument=own)
        for each, value in zip(self.open, each_value(self, values), strict=True):
            if each.of_instrument:
                study = each.apply(study, value)
        return study.instrument

    def scaled(self, pose: Floats, values: Floats, start: Floats) -> Floats:
        """Return all parameters (p,) less their prior means, in prior standard deviations.

        The prior mean of the place across is the magnet's axis, that of the place along it is the
        one of the pose ``start``; of the turns it is the nearest rotation by right angles. On a
        known stage all of them are those of ``start``.
        """
        if self.on_known_stage:
            turned = (Rotation.from_rotvec(pose[3:])
                      * Rotation.from_rotvec(start[3:]).inv()).as_rotvec()
            return np.concatenate([np.append(pose[:3] - start[:3], turned) / self.pose_sd,
                                   values / self.prior_sd()])
        turns = [Rotation.from_matrix(matrix) for matrix in right_angles()]
        nearest = min(turns, key=lambda turn: (
            Rotation.from_rotvec(start[3:]) * turn.inv()).magnitude())
        turned = (Rotation.from_rotvec(pose[3:]) * nearest.inv()).as_rotvec()
        place = pose[:3] - [*self.magnet.middle_m[:2], start[2]]
        return np.concatenate([np.append(place, turned) / self.pose_sd, values / self.prior_sd()])

    def _study_to_update(self, pose: Floats, values: Floats, pose_sd: Floats) -> Study:
        """Return the study of a pose, open keys and the probe before, see `Registration.study`."""
        study, found = self._magnet(values).study, self.instrument(pose, values)
        return study.with_(
            instrument=self._base(values).with_(
                translation_m=found.translation_m, rotation_rad=found.rotation_rad),
            instrument_sd=self.probe.opened(
                study.instrument_sd, pose_sd, self.pose_sd, self.total))

    def refined(self, pose: Floats, pace: Pace | None = None) -> Registration:
        """Return the registration to which least squares leads from a pose (6,)."""
        start, values = pose, np.zeros(len(self.prior_sd()))
        rows = self.training.ravel()
        if self._few is not None:  # a few readings lead near the end in less time
            near, _ = self._few._come_to_rest(start, pose, values, pace)
            if self.is_possible(near.values, near.pose):
                pose, values = near.pose, near.values
        (pose, values, state, columns), at_rest = self._come_to_rest(start, pose, values, pace)
        scaled = self.scaled(pose, values, start)
        updated, log_evidence, mean, covariance = state.updated(rows, scaled)
        count, own = len(mean), columns.directions.shape[1]
        blocks = self._blocks(columns.directions, mean[:own], covariance[:own, :own])
        of_terms = covariance[count:, count:] * np.outer(state.prior_sd, state.prior_sd)
        sd = np.sqrt(np.diag(of_terms))
        sd[:3] = np.hypot(sd[:3], self._apart(pose, values))
        return Registration(
            self._study_to_update(pose, values, sd[:6]), self.instrument(pose, values),
            pose[:3], sd[:3], sd[3:6], self.pose_sd,
            {each.key: (value, error) for each, value, error in zip(
                self.open, each_value(self, values), sd[6 + PROBE:], strict=True)},
            _mean_square(updated / state.sigma, self.training),
            _mean_square(updated / state.sigma, self.held_out),
            _rms(updated, self.training), _rms(state.residual, self.training),
            _rms(updated, self.held_out), _rms(state.residual, self.held_out),
            log_evidence, at_rest, _probe_sd(self._of_probe(sd[6:6 + PROBE])),
            sensors_apart(of_terms), trade_offs(
                [name for name, _ in self._named], of_terms, state.prior_sd), blocks,
            self._doubts(scaled, blocks), *self._factor(pose, values), total=self.total)

    @cached_property
    def _few(self) -> PoseFit | None:
        """The fit of some rows throughout the map; None if they would save nothing, or on a line.

        The outermost ones are among them, so that the middle of the map is the same.
        """
        # A map of the stepped dipole with 855 points then ends 0.2 standard deviations of its pose
        # from where all readings alone led, with a log evidence that is larger by 0.3.
        few_points = 400
        if len(self.points) < 2 * few_points or self.on_a_line:
            return None
        some = spread(np.flatnonzero(self.training.any(axis=1)), few_points)
        some = np.unique(np.concatenate([some, self.points.argmin(axis=0),
                                         self.points.argmax(axis=0)]))
        chosen: dict[str, Any] = {name: getattr(self, name)[some] for name in (
            "points", "readings", "training", "held_out", "sigma")}
        return dataclasses.replace(self, **chosen, is_part=True, derivatives={})

    def _come_to_rest(
        self, start: Floats, pose: Floats, values: Floats, pace: Pace | None
    ) -> tuple[_Place, bool]:
        """Return where least squares leads from a pose (6,) and other parameters, and whether the
        fit is at rest there.

        ``start`` (6,) is the pose about which the prior is, see `scaled`.
        """
        self.derivatives.clear()  # those of another pose belong to other places
        place, at_rest = self._at(pose, values), False
        if not self.is_part:
            self._check_effects(place.state)
        for blurred in self._blur(place.state):
            place, at_rest = self._settled(place, start, blurred, pace)
        return place, at_rest

    def _at(self, pose: Floats, values: Floats) -> _Place:
        """Return a pose (6,) and other parameters with the state and the columns there."""
        columns = self._columns(pose, values)
        return _Place(pose, values, self._state(pose, values, columns), columns)

    def _settled(
        self, place: _Place, start: Floats, blurred: float, pace: Pace | None
    ) -> tuple[_Place, bool]:
        """Return where steps of Gauss and Newton lead, and whether the fit is at rest there.

        ``blurred`` is noise in T beside that of the readings, see `_blur`.
        """
        rows = self.training.ravel()
        longest = LONGEST_SD * self.prior_sd()[PROBE:]
        sigma = np.hypot(place.state.sigma, blurred) if self.on_a_line else None
        at_rest, renewed = False, False  # renewed: the derivatives are those of this very place
        for number in range(ITERATIONS):
            if pace is not None:
                pace.advance(number, ITERATIONS)
            # noise of positions grows with the gradient, and a fit would look for one: so it is
            # held, on a line always, and elsewhere while a step is tried
            held = place.state.sigma if sigma is None else sigma
            place = place._replace(state=place.state.with_noise(held))
            step, sd, chi2 = place.state.step(
                rows, self.scaled(place.pose, place.values, start), self._damping)
            if float(np.abs(step / sd).max()) < AT_REST:
                at_rest = True
                break
            step[6 + PROBE:] = np.clip(step[6 + PROBE:], -longest, longest)
            # on a line only the noise decides how far the block columns hold
            reach = 0.0 if renewed else place.state.reach * (
                NEAR * blurred / self.smallest_sigma if self.on_a_line else 1.0)
            better = self._better(place, step, held, start, chi2, reach)
            if better is not None:
                (place, now), renewed = better, False
                if chi2 - now < chi2 * (NO_BETTER_ON_A_LINE if self.on_a_line else NO_BETTER):
                    at_rest = True
                    break
            elif renewed:  # no step is better, by derivatives of this very place
                at_rest = float(np.abs(step / sd).max()) < NEARLY_AT_REST
                break
            else:  # the derivatives may be those of another place
                self.derivatives.clear()
                place, renewed = self._at(place.pose, place.values), True
        return place._replace(state=place.state.with_noise(None)), at_rest

    def _better(
        self, place: _Place, step: Floats, held: Floats, start: Floats, chi2: float, reach: float
    ) -> tuple[_Place, float] | None:
        """Return where a step, or a half of it, a quarter, ..., has no larger chi^2, and that.

        None if it is larger all along it. ``held`` is the noise, and ``reach`` how far in m from
        their places the block columns hold.
        """
        share = share_of(step)
        for _ in range(HALVINGS):
            pose, values = moved_by(place.pose, share * step[:6]), place.values + share * step[6:]
            if self.is_possible(values, pose):
                moved = self._middle(pose, values) - place.columns.places
                near = place.columns if np.abs(moved).max() < reach else (
                    self._columns(pose, values))  # whose own gradient may decide, too
                state = self._state(pose, values, near).with_noise(held)
                now = state.chi2(self.training.ravel(), self.scaled(pose, values, start))
                if now <= chi2:
                    return _Place(pose, values, state, near), now
            share /= 2
        return None

    def _doubts(self, scaled: Floats, blocks: Gaussian) -> tuple[Term, ...]:
        """Return the terms that a fit has taken far from their priors.

        ``scaled`` (p,) are its parameters less their prior means, in prior standard deviations.
        """
        sd = np.concatenate([self.pose_sd, self.prior_sd()])
        terms = [Term(*name, float(away * one), float(one))
                 for name, away, one in zip(self._named, scaled, sd, strict=True)]
        count = 3 * len(self.magnet.blocks)
        return doubts(terms, count) + block_doubts(
            self.magnet, blocks.mean, self.prior.mean, self.prior.sd)

    @cached_property
    def _named(self) -> list[tuple[str, str]]:
        """Words and unit of all parameters, see `halbach_fe.measurement.doubted_terms.Term`."""
        names = list(NAMES[STEADY])
        if self.total:
            names, _ = of_total_field(names, np.zeros(len(names)))
        named = [words_of(name) for name in names]
        for each in self.open:
            unit = each.key.rpartition("_")[2]
            named.append((f"`{each.key}`", unit if unit in UNITS else ""))
        return named

    def _factor(self, pose: Floats, values: Floats) -> tuple[float, float]:
        """Return how many times the readings are what a probe without errors reads of the magnet,
        and how alike both are, see `likeness_of`.

        A wrong unit shows in it, which gains, blocks and offsets share out among them otherwise.
        """
        exact = self.instrument(pose, np.append(np.zeros(PROBE), values[PROBE:]))
        expected = self._field(values)(self._middle(pose, values)) @ sensor_matrix(exact).T
        expected = self._shown(expected, unit_vectors(expected))
        both = self.readings[self.training], expected[self.training]
        return factor_of(*both), likeness_of(*both)

    def _check_effects(self, state: _State) -> None:
        """Raise a StudyError if an open key changes no reading that is fitted."""
        # Largest change of a reading by a standard deviation of an open key, in units of the noise,
        # that counts as none.
        no_effect = 1e-6
        for number, each in enumerate(self.open, start=6 + PROBE):
            effect = each.sd * state.by_parameter[..., number][self.training]
            if np.abs(effect).max(initial=0.0) < no_effect * self.smallest_sigma:
                raise StudyError(must_be(
                    f"`{each.key}`", f"study {self.magnet.name}",
                    "a number on which the readings depend, to be fitted", "one without effect",
                    "Leave it out of --fit and --alternative."))

    def _blocks(self, directions: Floats, mean: Floats, covariance: Floats) -> Gaussian:
        """Return the updated blocks from mean (k,) and covariance (k, k) of their combinations."""
        root = root_matrix(self.prior.root)
        variances, axes = np.linalg.eigh(covariance)
        return Gaussian(self.prior.mean + root @ (directions @ mean), CovarianceFactor(
            root, directions @ axes, np.sqrt(np.clip(variances, 0.0, 1.0))))

    @cached_property
    def _damping(self) -> Floats:
        """Inverse squares (p,) of the longest steps, which keep short what a line leaves open.

        They are added to the information of a step: only where the map says little does it matter.
        """
        damping = np.zeros(6 + len(self.prior_sd()))
        if self.on_a_line:
            damping[:6] = np.repeat([LONGEST_M, LONGEST_RAD], 3)**-2.0
        return damping

    def _blur(self, state: _State) -> Sequence[float]:
        """Return noise in T to be added to that of the readings, less and less; zero at last.

        On a line, deviations of the blocks can take up what a wrong place or scale leaves. They
        cannot as long as the noise is as large as what the nominal blocks leave.
        """
        if not self.on_a_line:
            return (0.0,)
        left = float(np.nanmax(_rms(state.residual, self.training)))
        return (*(left * part for part in BLURS), 0.0)

    def is_possible(self, values: Floats, pose: Floats | None = None) -> bool:
        """Tell whether a valid study has these values, and all readings lie in air at a pose."""
        try:
            magnet = self._magnet(values)
            if pose is None:
                return True
            sensors = sensor_positions(self.instrument(pose, values), self.points).reshape(-1, 3)
        except HalbachError:
            return False
        around = np.concatenate([sensors + sign * DIFFERENCE_M * axis
                                 for axis in np.eye(3) for sign in (1, -1)])
        return not magnet.contains(around).any()

    def _middle(self, pose: Floats, values: Floats) -> Floats:
        """Return the mean positions (n, 3) in m of the sensors."""
        return np.asarray(sensor_positions(self.instrument(pose, values), self.points).mean(axis=1))

    def _columns(self, pose: Floats, values: Floats) -> _BlockColumns:
        """Return the field of the blocks' magnetizations at a pose."""
        middle = self._middle(pose, values)
        flat, root = self.deviations.columns(middle), root_matrix(self.prior.root)
        shift = (flat @ (self.prior.mean - self._nominal)).reshape(-1, 3)
        flat = flat @ root if isinstance(root, np.ndarray) else (root.T.tocsr() @ flat.T).T
        columns = flat.reshape(len(middle), 3, -1)
        smallest = SEEN * self.smallest_sigma
        directions = largest_directions(flat, smallest)
        others = neighbour_columns(self.magnet, middle).reshape(len(flat), -1) @ neighbour_prior(
            self.magnet).root
        others = (others @ largest_directions(others, smallest)).reshape(len(middle), 3, -1)
        return _BlockColumns(
            middle, np.concatenate([columns @ directions, others], axis=2), shift, directions)

    @property
    def _nominal(self) -> Floats:
        """The nominal magnetizations in A/m, and amplitudes of variations, (parameters,)."""
        nominal = np.zeros(self.deviations.count)
        nominal[:3 * len(self.magnet.blocks)] = self.magnet.nominal_magnetization
        return nominal

    def _magnet(self, values: Floats) -> Magnet:
        """Return the magnet with the values of the open keys."""
        key = self._key(values)
        if key not in self.built:
            _make_room(self.built, len(self.open) + 2)
            magnet = self.magnet
            for each, value in zip(self.open, each_value(self, values), strict=True):
                if not each.of_instrument:
                    magnet = magnet.with_study(each.apply(magnet.study, value))
            self.built[key] = magnet
        return self.built[key]

    def _key(self, values: Floats) -> bytes:
        """Return what distinguishes the magnets of different values of the open keys."""
        return np.array([value for each, value in zip(self.open, values[PROBE:], strict=True)
                         if not each.of_instrument]).tobytes()

    def _field(self, values: Floats) -> Field:
        """Return the field of the nominal magnet with the values of the open keys."""
        key = self._key(values)
        if key not in self.solved:
            _make_room(self.solved, len(self.open) + 2)
            self.solved[key] = field_function(self._magnet(values), self.session)
        return self.solved[key]

    def _by_open_keys(self, values: Floats, middle: Floats) -> list[Floats]:
        """Return the derivatives (n, 3) of B at places (n, 3) in m by every key of the magnet."""
        # Change of an open key, in prior standard deviations, after which derivatives by open keys
        # are computed anew.
        renewed = 0.7
        scaled = values[PROBE:] / self.prior_sd()[PROBE:]
        known = self.derivatives.get("at")
        if known is None or np.abs(scaled - known).max(initial=0.0) > renewed:
            self.derivatives["at"] = scaled
            here = self._field(values)(middle) if self.open else middle
            for number, each in enumerate(self.open):
                if each.of_instrument:
                    continue
                step = each.sd * PART_OF_SD * np.eye(len(values))[PROBE + number]
                changed = values + step if self.is_possible(values + step) else values - step
                self.derivatives[each.key] = (self._field(changed)(middle) - here) / (
                    changed - values)[PROBE + number]
        return [self.derivatives[each.key] for each in self.open if not each.of_instrument]

    def _most_probable(
        self, near: _BlockColumns, residual: Floats, by_block: Floats, sigma: Floats
    ) -> Floats:
        """Return the most probable deviations (parameters,) of the blocks at a fixed pose."""
        chosen = self.training
        rows = by_block[chosen] / sigma[chosen][:, None]
        inner = rows.T @ rows
        inner[np.diag_indices(len(inner))] += 1.0
        amounts = cho_solve(cho_factor(inner, lower=True),
                            rows.T @ (residual[chosen] / sigma[chosen]))
        return np.asarray(self.prior.mean - self._nominal
                          + root_matrix(self.prior.root) @ (
                              near.directions @ amounts[:near.directions.shape[1]]))

    def _state(self, pose: Floats, values: Floats, near: _BlockColumns) -> _State:
        """Return residual and derivatives of all readings at a pose and instrument."""
        instrument = self.instrument(pose, values)
        sensors = sensor_positions(instrument, self.points)
        middle, count = sensors.mean(axis=1), len(self.points)
        matrix = sensor_matrix(instrument)
        here, gradient = field_at_sensors(self._field(values), sensors)
        nominal = seen(matrix, here) + near.shift @ matrix.T
        at_mean, stage = gradient.mean(axis=1), rotation_matrix(instrument.rotation_rad)
        of_blocks = np.einsum("ij,njk->nik", matrix, near.fields)

        def about(along: Floats) -> tuple[Floats, Floats, Floats]:
            """Return residual, derivatives by blocks and noise about directions of the field."""
            moved = self._shown(matrix @ at_mean @ stage, along)
            return (self.readings - self._shown(nominal, along) - values[OFFSETS],
                    self._shown(of_blocks, along),
                    np.sqrt(self.sigma**2 + np.sum((moved * self.position_sd)**2, axis=2)))

        along = unit_vectors(nominal)
        residual, by_block, sigma = about(along)
        # the derivatives are those in the field of the blocks that explain the readings here best
        own = field_at_sensors(partial(
            self.deviations.field, self._most_probable(near, residual, by_block, sigma)), sensors)
        here, gradient = here + own[0], gradient + own[1]
        if self.total:
            along = unit_vectors(seen(matrix, here))
            residual, by_block, sigma = about(along)
        by_term = self._shown(by_terms(
            instrument, self.points, self._origin(self._base(values)), np.zeros(count), here,
            gradient, STEADY), along)
        if self.total:
            by_gain = by_term[..., 6:][..., GAINS].sum(axis=-1)
            by_term[..., 6:] = 0.0
            by_term[..., 6 + GAINS.start], by_term[:, 0, 6 + OFFSETS.start] = by_gain, 1.0
        columns = list(np.moveaxis(by_term, -1, 0))
        magnets = iter(self._by_open_keys(values, middle))
        for number, each in enumerate(self.open, start=PROBE):
            if not each.of_instrument:
                columns.append(self._shown(next(magnets) @ matrix.T, along))
                continue
            step = SMALL * np.eye(len(values))[number]
            other = self.instrument(pose, values + step)
            moved = sensor_positions(other, self.points) - sensors
            there = here + np.einsum("nsck,nsk->nsc", gradient, moved)
            columns.append(self._shown(
                (seen(sensor_matrix(other), there) - seen(matrix, here)) / SMALL, along))
        beside = self._by_uncertain(pose, values, (sensors, here, gradient), along)
        return _State(residual, np.stack(columns, axis=-1),
                      np.concatenate([by_block, beside], axis=2), sigma,
                      np.concatenate([self.pose_sd, self.prior_sd()]),
                      self.smallest_sigma / (DEVIATION * float(np.sqrt(np.mean(np.sum(
                          at_mean**2, axis=(1, 2)))))))

    @cached_property
    def _sides(self) -> list[tuple[Study, Study]]:
        """The study with more and with less of every uncertain amplitude of its instrument."""
        study = self.magnet.study
        return [(shifted(study, one, STEP * one.sd), shifted(study, one, -STEP * one.sd))
                for one in study.uncertain if one.is_of_instrument]

    def _either(self, number: int, pose: Floats, values: Floats) -> tuple[Instrument, Instrument]:
        """Return the instruments of both `_sides`, with the middle of the map in one place."""
        more, less = self._sides[number]
        return self.instrument(pose, values, more), self.instrument(pose, values, less)

    def _by_uncertain(
        self, pose: Floats, values: Floats, at: tuple[Floats, Floats, Floats], along: Floats
    ) -> Floats:
        """Return readings (n, 3, amplitudes) in T per standard deviation of what is uncertain of
        the instrument.

        ``at`` are sensors with their field, see `shown_less_read`. A few of the rows, which lead
        near the end only, are not in the order of the scan.
        """
        found = np.zeros((0 if self.is_part else len(self._sides), *self.points.shape))
        for number in range(len(found)):
            more, less = (self._shown(shown_less_read(
                one, self.data, at, along if self.total else None), along)
                for one in self._either(number, pose, values))
            found[number] = (more - less) / (2 * STEP)
        return np.moveaxis(found, 0, -1)

    def _apart(self, pose: Floats, values: Floats) -> Floats:
        """Return the standard deviations (3,) in m by which uncertain amplitudes of the instrument
        move the middle of the map against where the study's values have it, as a scale does that
        is of a far origin.
        """
        found = [np.subtract(more.translation_m, less.translation_m) / (2 * STEP)
                 for more, less in (self._either(number, pose, values)
                                    for number in range(len(self._sides)))]
        return np.sqrt(np.sum(np.square([np.zeros(3), *found]), axis=0))


@dataclass(frozen=True)
class _BlockColumns:
    """Fields of the blocks at the places of a map."""

    places: Floats
    """Shape (n, 3), in m."""
    fields: Floats
    """B per prior standard deviation of k combinations of the magnetizations, followed by those of
    neighbours' blocks. Shape (n, 3, k + neighbours), in T."""
    shift: Floats
    """B of the prior's mean less that of the nominal magnet. Shape (n, 3), in T."""
    directions: Floats
    """The combinations. Shape (columns of the prior's root, k)."""


class _Place(NamedTuple):
    """A pose (6,) and other parameters (p,), with the readings and the block columns there."""

    pose: Floats
    values: Floats
    state: _State
    columns: _BlockColumns


@dataclass(frozen=True)
class _State:
    """Readings and their derivatives at one pose and instrument."""

    residual: Floats
    """Of the nominal blocks. Shape (n, 3), in T."""
    by_parameter: Floats
    """Derivatives by shifts, turns, and the other parameters. Shape (n, 3, p)."""
    by_block: Floats
    """Readings per prior standard deviation of the magnetizations, and of what is eliminated with
    them. Shape (n, 3, k + others), in T."""
    sigma: Floats
    """Shape (n, 3), in T."""
    prior_sd: Floats
    """Shape (p,)."""
    reach: float
    """Largest shift for which ``by_block`` holds, see `DEVIATION`. In m."""
    noise: Floats | None = None
    """Taken instead of ``sigma``, see `with_noise`. Shape (n, 3), in T."""

    def with_noise(self, noise: Floats | None) -> _State:
        """Return the state with another noise (n, 3) in T, or with its own if there is none."""
        return dataclasses.replace(self, noise=noise)

    def _whitened(self, rows: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
        """Return residual (r,), derivatives (r, p) and block columns (r, k) of some readings."""
        sigma = (self.sigma if self.noise is None else self.noise).ravel()[rows]
        return (self.residual.ravel()[rows] / sigma,
                self.by_parameter.reshape(len(rows), -1)[rows] / sigma[:, None],
                self.by_block.reshape(len(rows), -1)[rows] / sigma[:, None])

    def step(self, rows: NDArray[np.bool_], scaled: Floats, damping: Floats | None = None,
             ) -> tuple[Floats, Floats, float]:
        """Return the step (p,) to the most probable parameters, their sd (p,), and chi-squared.

        The magnetizations are integrated out. ``scaled`` are the present parameters less their
        prior means, in prior standard deviations; chi-squared is theirs. ``damping`` (p,) shortens
        the step, not the standard deviations.
        """
        residual, derivative, blocks = self._whitened(rows)
        inner = blocks.T @ blocks
        inner[np.diag_indices(len(inner))] += 1.0
        factor = cho_factor(inner, lower=True)

        def kept(values: Floats) -> Floats:
            return values - blocks @ cho_solve(factor, blocks.T @ values)

        left, projected = kept(residual), kept(derivative)
        information = derivative.T @ projected + np.diag(self.prior_sd**-2)
        inverse = np.linalg.inv(information)
        uphill = derivative.T @ left - scaled / self.prior_sd
        step = inverse @ uphill if damping is None else np.asarray(np.linalg.solve(
            information + np.diag(damping), uphill), np.float64)
        return step, np.sqrt(np.diag(inverse)), float(residual @ left + scaled @ scaled)

    def chi2(self, rows: NDArray[np.bool_], scaled: Floats) -> float:
        """Return chi-squared with the magnetizations integrated out, see `step`."""
        return self.step(rows, scaled)[2]

    def updated(
        self, rows: NDArray[np.bool_], scaled: Floats
    ) -> tuple[Floats, float, Floats, Floats]:
        """Return residual (n, 3) in T, log evidence, mean (k,) of ``by_block``, and the covariance
        (k + p, k + p) of these and the parameters, in prior standard deviations.
        """
        residual, derivative, blocks = self._whitened(rows)
        design = np.hstack([blocks, derivative * self.prior_sd])
        inner = design.T @ design
        inner[np.diag_indices(len(inner))] += 1.0
        count = blocks.shape[1]
        start = np.concatenate([np.zeros(count), scaled])
        factor = cho_factor(inner, lower=True)
        solution = cho_solve(factor, design.T @ residual - start)
        updated = self.residual - self.by_block @ solution[:count] - self.by_parameter @ (
            solution[count:] * self.prior_sd)
        left = residual - design @ solution
        chi2 = float(left @ left + np.sum((solution + start)**2))
        return updated, -chi2 / 2 - float(np.log(np.diag(factor[0])).sum()) - float(
            np.log(self.sigma.ravel()[rows]).sum()), solution[:count], cho_solve(
                factor, np.eye(len(inner)))


def _make_room(known: dict[bytes, Any], most: int) -> None:
    """Delete the oldest entries until fewer than ``most`` are left."""
    while len(known) >= most:
        del known[next(iter(known))]


def _check_open_keys(magnet: Magnet, open_keys: Sequence[OpenKey]) -> None:
    """Raise a StudyError for a key that is open twice, or that no step can change."""
    study = magnet.study
    for number, each in enumerate(open_keys):
        if any(each.key == other.key for other in open_keys[:number]):
            raise StudyError(must_be(f"`{each.key}`", f"study {study.name}", "open once", "twice"))
        value, refused = each.value(study), None
        step = SMALL if each.of_instrument else each.sd * PART_OF_SD
        for changed in (value + step, value - step):
            try:
                magnet.with_study(each.apply(study, changed))
                break
            except HalbachError as error:
                refused = error
        else:
            raise StudyError(must_be(
                f"{each.key}={each.sd:g}", "--fit or --alternative", "a number that may change by "
                f"{PART_OF_SD:g} of its standard deviation, from {value:g} to {changed:g}",
                f"'{refused}'", "A whole number cannot be fitted; otherwise make the standard "
                "deviation smaller."))


def _probe_sd(sd: Floats) -> ProbePrior:
    """Return standard deviations (21,) of a probe's terms as those of their kinds."""
    crosstalk, gain, offset, sensor = (rms(part) for part in np.split(
        sd, [6, OFFSETS.start, OFFSETS.stop]))
    return ProbePrior(crosstalk, gain, offset, sensor)


def each_value(fit: PoseFit, values: Floats) -> list[float]:
    """Return the values of the open keys among the parameters after the pose."""
    return [each.value(fit.magnet.study) + float(change)
            for each, change in zip(fit.open, values[PROBE:], strict=True)]


def _rms(residual: Floats, rows: NDArray[np.bool_]) -> Floats:
    """Return the rms (3,) of the chosen residuals of each component; NaN if there are none."""
    count = rows.sum(axis=0)
    total = np.sum(np.where(rows, residual, 0.0)**2, axis=0)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _mean_square(values: Floats, rows: NDArray[np.bool_]) -> float:
    """Return the mean square of the chosen values (n, 3); NaN if there are none."""
    return float(np.mean(values[rows]**2)) if rows.any() else float("nan")
