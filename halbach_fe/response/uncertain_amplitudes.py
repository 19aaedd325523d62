"""Readings of uncertain amplitudes of a magnet, see `halbach_fe.study.uncertain.Uncertain`.

An amplitude is a parameter of the magnet after its magnetizations, in units of its prior standard
deviation. The magnetization is always that of the blocks: if an amplitude changes what blocks are
expected to have (a temperature), it is a deviation that they share in the prior, and its own column
has only what the amplitude changes at given magnetizations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sparse

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.solver.formulation_choice import finite_element_part, vacuum_part
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian, root_matrix, stacked_root
from halbach_fe.study.model import Study
from halbach_fe.study.uncertain import Uncertain, shifted

STEP = 1e-3
"""Step of the differences of exact fields and magnetizations, in standard deviations: geometry and
materials are linear to 1e-6 over it, and rounding is 1e-12 of the field."""

SOLVED_STEP = 0.1
"""Step of the differences of what permeability and iron add, in standard deviations: large enough
for differences between meshes, which a small step would magnify."""


def amplitude_names(magnet: Magnet) -> tuple[str, ...]:
    """Return the names of the uncertain amplitudes of a magnet."""
    return tuple(one.name for one in magnet.study.uncertain_of_magnet)


def shared_deviations(magnet: Magnet) -> Floats:
    """Return the change (parameters, amplitudes) in A/m of the nominal magnetizations."""
    return _changes(magnet, STEP, lambda other: other.nominal_magnetization)


def vacuum_changes(magnet: Magnet, points: Floats) -> Floats:
    """Return the change (amplitudes, n, 3) in T of the field of blocks in vacuum and of external
    sources at points (n, 3) in m, magnetizations changed as in `shared_deviations`.
    """
    return _changes(magnet, STEP, lambda other: vacuum_part(other, points)).transpose(2, 0, 1)


def field_changes(magnet: Magnet, points: Floats, session: Session) -> Floats:
    """Return `vacuum_changes` with those of what permeability and iron add."""
    def solved(other: Magnet) -> Floats:
        return finite_element_part(other, points, session.within("uncertain"), columns=False,
                                   estimate=False).nominal

    changes = vacuum_changes(magnet, points)
    if magnet.is_vacuum and magnet.study.solver.method == "reaction" and all(
            build_magnet(each).is_vacuum for one in magnet.study.uncertain_of_magnet
            for each in _either_side(magnet.study, one, SOLVED_STEP)[0]):
        return changes
    return changes + _changes(magnet, SOLVED_STEP, solved).transpose(2, 0, 1)


def with_amplitudes(prior: Gaussian, magnet: Magnet) -> Gaussian:
    """Return a prior of a magnet's other parameters (m,), and its uncertain amplitudes after them.

    They are 0 with a standard deviation of 1, and shared by the magnetizations.
    """
    count = len(magnet.study.uncertain_of_magnet)
    if not count:
        return prior
    shared = np.zeros((len(prior.mean), count))
    shared[:len(magnet.parameter_names)] = shared_deviations(magnet)
    root = sparse.bmat([[sparse.csr_array(root_matrix(prior.root)), sparse.csr_array(shared)],
                        [None, sparse.eye_array(count)]], format="csr")
    return Gaussian(np.concatenate([prior.mean, np.zeros(count)]),
                    stacked_root(sparse.csr_array(root)))


def _changes(magnet: Magnet, step: float, of: Callable[[Magnet], Floats]) -> Floats:
    """Return the derivatives (..., amplitudes), per standard deviation, of values of a magnet."""
    found = []
    for one in magnet.study.uncertain_of_magnet:
        (more, less), between = _either_side(magnet.study, one, step)
        found.append((of(build_magnet(more)) - of(build_magnet(less))) / between)
    return np.stack(found, axis=-1)


def _either_side(
    study: Study, uncertain: Uncertain, step: float
) -> tuple[tuple[Study, Study], float]:
    """Return the study with a larger and with a smaller amplitude, and how far these are apart.

    The step and that distance are in standard deviations. At the limit of a key, such as a
    permeability of 1, one of both is the study itself.
    """
    sides, between = [], 0.0
    for sign in (1, -1):
        try:
            sides.append(shifted(study, uncertain, sign * step * uncertain.sd))
            between += step
        except StudyError:
            sides.append(study)
    if not between:
        try:
            shifted(study, uncertain, step * uncertain.sd)
        except StudyError as error:
            raise StudyError(must_be(
                f"`uncertain.sd` of '{uncertain.name}'", f"study {study.name}",
                f"small enough that the study can be changed by {step:g} of it",
                f"{uncertain.sd:g} (in the unit of the key, as m and T)",
                f"Correct it. The change by that step: {error}")) from None
    return (sides[0], sides[1]), between
