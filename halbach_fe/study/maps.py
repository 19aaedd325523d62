"""Keys of a study that list the maps of a campaign, and what of an instrument is uncertain."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from halbach_fe.study.inference import Inference
from halbach_fe.study.measurement import Instrument, NoiseSettings
from halbach_fe.study.types import Line, PositionSd, StudyModel

SmallSd = Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)]

PROBE_KEYS = ("crosstalk", "gain", "sensor_position_m", "planar_hall_per_T", "quadratic_per_T",
              "cubic_per_T2")
"""Keys of an instrument that belong to its probe, and may be shared by several maps. All others
belong to a map: its pose and its stage, and the offsets, which change from day to day."""


RESULTS = ("run.json", "study.registered.toml")
"""Files beside which `halbach-fe register` makes a folder for every map."""

POSE_KEYS = ("translation_m", "rotation_rad")
"""Keys of an instrument that say how a map lies in the magnet."""


class InstrumentSd(StudyModel):
    """Prior standard deviations of the terms of the instrument that are estimated with the blocks.

    A term of which 0 is stated (the default) is exactly what ``instrument`` says. The others are
    parameters of the update, like the magnetizations, and widen the error bars of these.
    ``translation_m`` is the standard deviation of the place of the map's middle along each axis of
    the magnet, ``rotation_rad`` that of the turn of the map about each axis through its middle. The
    others are those of each component of the instrument's keys of the same name. State what was
    known without the map, so that the same readings are not counted twice. `halbach-fe register`
    writes this table: of the pose that it found, at least ten of its error bars.
    """

    translation_m: PositionSd = 0.0
    rotation_rad: SmallSd = 0.0
    crosstalk: SmallSd = 0.0
    gain: SmallSd = 0.0
    offset_T: SmallSd = 0.0
    sensor_position_m: PositionSd = 0.0
    drift_T: SmallSd = 0.0


class MapSettings(StudyModel):
    """One of several maps of the magnet.

    ``file`` is its path from the folder of the study file. ``instrument``, ``instrument_sd``,
    ``noise`` and ``inference`` replace the study's tables of the same name as a whole for this map;
    where they are left out, those of the study hold. Maps that name the same ``probe`` share its
    terms (crosstalk, gain, nonlinearity and places of the sensors), which are then estimated from
    all of them together; otherwise every map has a probe of its own. Maps that name the same
    ``stage`` were made on one that was not mounted anew between them. They move and turn in the
    magnet together, but for ``stage_shift_sd_m``: the prior standard deviations of an own shift of
    this map along the three axes of the stage, whose origin was set anew. `halbach-fe register`
    finds shifts from nothing whose standard deviation is 1 mm or more.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    file: Annotated[Line, Field(min_length=1, max_length=4096)]
    probe: Annotated[Line, Field(min_length=1, max_length=100)] | None = None
    stage: Annotated[Line, Field(min_length=1, max_length=100)] | None = None
    stage_shift_sd_m: tuple[PositionSd, PositionSd, PositionSd] = (0.0, 0.0, 0.0)
    instrument: Instrument | None = None
    instrument_sd: InstrumentSd | None = None
    noise: NoiseSettings | None = None
    inference: Inference | None = None

    @model_validator(mode="after")
    def _consistent(self) -> MapSettings:
        if self.name in RESULTS:
            raise ValueError(f"the name '{self.name}' of a map is that of a file of results")
        if "\0" in self.file:
            raise ValueError("file must be a path")
        if self.stage is None and any(self.stage_shift_sd_m):
            raise ValueError("stage_shift_sd_m needs a stage that other maps share")
        return self
