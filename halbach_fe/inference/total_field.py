"""Readings of |B|, which are linear in B about a known field only.

A probe of |B| shows the length of B. About a field B_0 it is the component along B_0, but for
``|c|^2 / 2 |B_0|`` by the deviation c across it. An update is therefore repeated about what it has
found. What is not known of c bends the readings: its mean square over 2 |B_0| counts as noise,
which makes readings of a weak field count little until an update knows the field there.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning
from halbach_fe.inference.instrument_fit import Beside
from halbach_fe.inference.readings import Readings, unit_vectors
from halbach_fe.response.matrix import Response
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.linear_gaussian import predict
from halbach_fe.stats.noise import NoiseCovariance

AT_REST = 0.1
"""Change of a reading of |B| by other directions, and of its bend, up to which they are at rest, in
units of the noise."""


@dataclass(frozen=True)
class Magnitudes:
    """The field about which readings of |B| are linear."""

    directions: dict[str, Floats] = field(default_factory=dict)
    """Unit vectors of the field at the readings of each map of |B|; empty for those of the nominal
    blocks. Shape (k, 3)."""
    turned: Floats = field(default_factory=lambda: np.zeros(0))
    """How far |B| is from its length along the directions before; 0 for components.
    Shape (readings,), in T."""
    bend: Floats = field(default_factory=lambda: np.zeros(0))
    """By what is left unknown of the field across, see the module; empty before the first update.
    Shape (readings,), in T."""

    def about(
        self, readings: Readings, vectors: Response, model: Response, prior: Gaussian
    ) -> Magnitudes:
        """Return these with the bend by a prior, unless an update has found it already."""
        if len(self.bend) or not readings.total.any():
            return self
        return replace(self.updated(readings, vectors, model, prior), directions=self.directions)

    def updated(
        self, readings: Readings, vectors: Response, model: Response, found: Gaussian
    ) -> Magnitudes:
        """Return the field of a distribution of all parameters, those of the blocks first.

        ``vectors`` is the response of `Readings.vectors`, ``model`` that of the readings.
        """
        if not readings.total.any():
            return self
        mean, sd = _predicted(vectors, found)
        along = _predicted(model, found)[1][readings.total]
        here = readings.of_components(mean)
        size = np.linalg.norm(here, axis=1)
        across = np.sqrt(np.maximum(
            np.sum(readings.of_components(sd)**2, axis=1) - along**2, 0.0))
        bend, turned = np.zeros(len(readings.total)), np.zeros(len(readings.total))
        # no length differs from that along a direction by more than the part across it
        # field below which no direction is known
        tiny_T = 1e-12
        bend[readings.total] = across * np.minimum(1.0, across / np.maximum(2 * size, tiny_T))
        turned[readings.total] = size - (readings.projection @ mean)[readings.total]
        maps = np.array(readings.maps)[readings.total]
        return Magnitudes({name: unit_vectors(here[maps == name]) for name in readings.directions},
                          turned, bend)

    def is_near(self, before: Magnitudes, noise: Floats) -> bool:
        """Tell whether an update about these finds the same, by the noise (readings,) in T."""
        return not len(self.bend) or bool((
            np.maximum(np.abs(self.turned), np.abs(self.bend - before.bend))
            <= AT_REST * noise).all())

    def with_bend(self, noise: NoiseCovariance) -> NoiseCovariance:
        """Return the noise of the readings with their bend."""
        return noise.with_independent_errors(self.bend) if len(self.bend) else noise


def bent(readings: Readings, vectors: Response, model: Response, found: Gaussian) -> Floats:
    """Return |B| less its length along the directions (readings,) in T, of the mean of a
    distribution of all parameters; 0 for components.
    """
    if not readings.total.any():
        return np.zeros(len(readings.total))
    return Magnitudes().updated(readings, vectors, model, found).turned


def warn_of_bent_readings(readings: Readings, magnitudes: Magnitudes) -> None:
    """Warn of readings of |B| that what is not known of the field across it bends noticeably."""
    if not len(magnitudes.bend):
        return
    # bend of a reading, in units of its noise, from which it is named
    bent = 0.3
    bent_ones = np.flatnonzero(magnitudes.bend > bent * readings.noise.sd)
    if len(bent_ones):
        least = bent_ones[np.argmin(readings.values[bent_ones])]
        x, y, z = (1e3 * readings.observation.positions[least]).tolist()
        warnings.warn(
            f"What is left unknown across the field bends {len(bent_ones)} of "
            f"{int(readings.total.sum())} readings of |B| by over {bent:g} of their noise, "
            f"such as {1e3 * readings.values[least]:.3g} mT at ({x:.4g}, {y:.4g}, {z:.4g}) mm. "
            "They count with more noise: components of B at some points would tell.",
            HalbachWarning, stacklevel=3)


def _predicted(model: Response, found: Gaussian) -> tuple[Floats, Floats]:
    """Return mean and sd (readings,) in T of a response by a distribution of all parameters, those
    of the blocks first.
    """
    rest = np.zeros((len(model.offset), len(found.mean) - len(model.parameters)))
    mean, sd = predict(Beside(model.matrix, rest), found)
    return model.offset + mean, sd
