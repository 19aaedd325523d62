"""What is known about a map's pose before and after its registration."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.doubted_terms import Term
from halbach_fe.measurement.map_check import DETERMINED
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.model import Study

DEGREES = ("shift along x", "shift along y", "shift along z",
           "turn about x", "turn about y", "turn about z")
"""Degrees of freedom of a pose, along and about the axes of the magnet."""

EXPLAINED = 3.0
"""Chi-squared per reading up to which the updated magnet explains a map. Unlike a wrong magnet,
noise that the study takes for 1.7 times too small does not pass it."""


@dataclass(frozen=True)
class ProbePrior:
    """Prior standard deviations of the instrument, apart from its pose."""

    crosstalk: float = 0.03
    """Of the probe's axes against those of the stage."""
    gain: float = 0.003
    offset_T: float = 1e-3
    sensor_m: float = 1e-4
    """Of a sensor's place along each axis."""

    @classmethod
    def of(cls, known: InstrumentSd) -> ProbePrior:
        """Return the prior of a probe of which a study may state that less is known."""
        return cls(max(cls.crosstalk, known.crosstalk), max(cls.gain, known.gain),
                   max(cls.offset_T, known.offset_T), max(cls.sensor_m, known.sensor_position_m))

    def opened(self, known: InstrumentSd, pose_sd: Floats, pose_prior_sd: Floats,
               total: bool) -> InstrumentSd:
        """Return what is open of an instrument in the update after its registration.

        Parameters
        ----------
        known : InstrumentSd
            What the study states. A pose that it leaves more open remains so.
        pose_sd, pose_prior_sd : ndarray, shape (6,)
            Standard deviations of the pose after the registration and before it, in m and rad.
            What the map does not determine is opened like what it does.
        total : bool
            Whether the map is of |B|, whose probe has neither axes nor several sensors.
        """
        sd = np.where(pose_sd < DETERMINED * pose_prior_sd, pose_sd, 0.0).reshape(2, 3)
        shift, turn = np.clip(WIDER * sd.max(axis=1), NARROWEST_POSE, WIDEST_POSE).tolist()
        most_m, most = WIDEST_POSE.tolist()  # of every key of `InstrumentSd`
        return known.with_(
            translation_m=max(known.translation_m, shift),
            rotation_rad=max(known.rotation_rad, turn),
            gain=min(self.gain, most), offset_T=min(self.offset_T, most),
            **({} if total else {"crosstalk": min(self.crosstalk, most),
                                 "sensor_position_m": min(self.sensor_m, most_m)}))


SEARCHED_M = 1e-3
"""Standard deviation of a shift along a stage from which the shift is found from nothing."""

NARROWEST_POSE, WIDEST_POSE = np.array([SEARCHED_M, 0.01]), np.array([0.01, 0.1])
"""Limits in m and rad of a pose's prior standard deviations in the update after its registration:
those of a pose that is roughly known, and of `InstrumentSd`."""

WIDER = 10.0
"""How many times as wide these are at least as the error bars of the registration: the readings,
which then count twice, narrow an error bar by no more than 1 in 200."""


@dataclass(frozen=True)
class StagePose:
    """Where a map lies by another map on the same stage, but for shifts along the stage's axes."""

    turn: Rotation
    """From the map's axes to those of the magnet."""
    middle_m: Floats
    """Where its middle lies without a shift. Shape (3,)."""
    axes: Floats
    """Axes of the stage in the magnet, in columns. Shape (3, 3)."""
    shift_sd_m: Floats
    """Prior standard deviations of the shifts along them. Shape (3,)."""
    middle_sd_m: Floats
    turn_sd_rad: Floats
    """What the other map leaves open, along and about the magnet's axes. Shape (3,)."""

    def sd(self, magnet: Magnet) -> Floats:
        """Return the standard deviations (6,) of shifts in m and turns in rad."""
        shift = np.where(self.shift_sd_m < SEARCHED_M, self.shift_sd_m, magnet.half_length)
        return np.append(np.sqrt(self.middle_sd_m**2 + self.axes**2 @ shift**2), self.turn_sd_rad)

    def nearest(self, pose: Floats) -> Floats:
        """Return the pose (6,) on the stage that is nearest to another one."""
        shift = self.axes.T @ (pose[:3] - self.middle_m)
        shift[self.shift_sd_m < SEARCHED_M] = 0.0
        return np.append(self.middle_m + self.axes @ shift, self.turn.as_rotvec())


@dataclass(frozen=True)
class PosePrior:
    """Prior standard deviations of the pose, which matter where the map does not determine it."""

    across_m: float | None = None
    """Of the middle of the map from the magnet's axis along x and y; by default the outer radius of
    the blocks."""
    turn_rad: float = 0.1
    """Of the turns about the magnet's axes from the nearest rotation by right angles."""
    stage: StagePose | None = None
    """What another map on the same stage says, which replaces the above."""

    def sd(self, magnet: Magnet) -> Floats:
        """Return the standard deviations (6,) of shifts in m and turns in rad.

        That along the axis is the magnet's half length, about where the search has found the map.
        """
        if self.stage is not None:
            return self.stage.sd(magnet)
        across = self.across_m if self.across_m is not None else magnet.array_outer_radius
        return np.array([across, across, magnet.half_length, *[self.turn_rad] * 3])


@dataclass(frozen=True)
class OpenKey:
    """A number of the study that a drawing leaves open, to be fitted with the pose."""

    key: str
    """Such as ``demagnetization.squareness``, or ``instrument.z_scale`` for the step of the map."""
    sd: float
    """Prior standard deviation about the value in the study."""

    def value(self, study: Study) -> float:
        """Return the number in a study.

        Raises
        ------
        StudyError
            If the key is not one number.
        """
        found: object = study
        before = ""
        for name in self.key.split("."):
            if found is None:
                raise StudyError(must_be(
                    f"`{self.key}`", f"study {study.name}", "a number that is given, to be fitted",
                    f"no `{before}` in the study"))
            before = name
            known = getattr(type(found), "model_fields", {})
            if name not in known:
                near = difflib.get_close_matches(name, known, 1, 0.5)
                raise StudyError(must_be(
                    f"`{self.key}`", f"study {study.name}", "the key of a number", f"`{name}`, "
                    "which is none", f"Did you mean `{near[0]}`?" if near else ""))
            found = getattr(found, name)
        if isinstance(found, bool) or not isinstance(found, int | float):
            raise StudyError(must_be(f"`{self.key}`", f"study {study.name}",
                                     "a number that is given, to be fitted",
                                     "nothing" if found is None else f"'{found}'"))
        return float(found)

    @property
    def of_instrument(self) -> bool:
        """Whether the number belongs to the mapper, not to the magnet."""
        return self.key.startswith("instrument.")

    def apply(self, study: Study, value: float) -> Study:
        """Return the study with another number."""
        return study.with_(**{self.key.replace(".", "__"): value})


@dataclass(frozen=True)
class Registration:
    """One pose of a map in the magnet.

    Attributes
    ----------
    study : Study
        The study for an update by the same map, with the open keys. Its instrument has the pose
        that was found, and the probe that was known before; its ``instrument_sd`` says how far both
        were open. The update finds the probe again, together with the blocks, so that no reading
        counts twice.
    instrument : Instrument
        The pose, axes, gains, offsets and sensors that were found.
    middle_m : ndarray, shape (3,)
        Where the middle of the box around the map's points lies in the magnet.
    translation_sd_m, rotation_sd_rad : ndarray, shape (3,)
        Standard deviations of that place, and of the turns about the magnet's axes.
    prior_sd : ndarray, shape (6,)
        Prior standard deviations of that place in m and of the turns in rad. Where the standard
        deviations are nearly as large, the map does not determine the pose.
    open_keys : dict of str to (float, float)
        Value and standard deviation of each open key.
    chi2 : float
        Chi-squared per reading of the readings that were fitted, by the updated blocks.
    held_out_chi2 : float
        The same of the readings that the study holds out; NaN if there are none.
    rms_T : ndarray, shape (3,)
        Rms residual of the readings along each axis that were fitted, by the updated blocks.
    nominal_rms_T : ndarray, shape (3,)
        The same of the nominal blocks.
    held_out_rms_T, held_out_nominal_rms_T : ndarray, shape (3,)
        The same of the readings that the study holds out; NaN if there are none.
    log_evidence : float
        Log probability of the readings, up to a constant that all poses share.
    at_rest : bool
        Whether the fit came to rest.
    probe : ProbePrior
        Standard deviations of the probe, rms over its terms of each kind.
    covariance : ndarray, shape (p, p)
        Of shifts in m and turns in rad, the probe's terms, of which places of sensors are from the
        mean of all, and the open keys.
    trade_offs : tuple of tuple of str
        Terms that the map hardly tells one by one, in words, see
        `halbach_fe.measurement.doubted_terms.trade_offs`.
    blocks : Gaussian
        Magnetizations in A/m, and amplitudes of variations, as this map updates them in this pose.
        They serve to register another map of the same magnet: what permeable blocks answer to a
        change of others is left out.
    doubts : tuple of Term
        Terms of pose, probe, open keys and blocks that this fit has taken far from their priors,
        see `halbach_fe.measurement.doubted_terms`.
    factor : float
        How many times the readings are what a probe without errors reads of the nominal magnet.
    likeness : float
        How alike both are (-1 to 1); where they are not, no factor relates them.
    component : str
        Which component the readings were taken for, where the map does not say it; else empty.
    total : bool
        Whether the map is of |B|, which then stands in place of x in the residuals.
    left_out : int
        Number of poses that the search found too, and that were not fitted.
    apart : tuple of Term
        By how much this pose is off, along and about axes of the stage, where overlaps with other
        maps have it without a magnet; its standard deviation is that of both.
    """

    study: Study
    instrument: Instrument
    middle_m: Floats
    translation_sd_m: Floats
    rotation_sd_rad: Floats
    prior_sd: Floats
    open_keys: dict[str, tuple[float, float]]
    chi2: float
    held_out_chi2: float
    rms_T: Floats
    nominal_rms_T: Floats
    held_out_rms_T: Floats
    held_out_nominal_rms_T: Floats
    log_evidence: float
    at_rest: bool
    probe: ProbePrior
    covariance: Floats
    trade_offs: tuple[tuple[str, ...], ...]
    blocks: Gaussian = dataclasses.field(repr=False)
    doubts: tuple[Term, ...] = ()
    factor: float = 1.0
    likeness: float = 1.0
    component: str = ""
    total: bool = False
    left_out: int = 0
    apart: tuple[Term, ...] = ()

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Shifts and turns that the map does not determine, which the prior holds."""
        sd = np.concatenate([self.translation_sd_m, self.rotation_sd_rad])
        return tuple(name for name, one, prior in zip(DEGREES, sd, self.prior_sd, strict=True)
                     if one > DETERMINED * prior)

    @property
    def explains(self) -> bool:
        """Whether the updated magnet leaves about the noise of the readings that were fitted."""
        return self.chi2 < EXPLAINED
