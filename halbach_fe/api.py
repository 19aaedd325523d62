"""Functions of the Python interface that bring several rooms together.

`halbach_fe` hands them on; a user writes ``import halbach_fe as hf`` and ``hf.multipoles(...)``.
Each takes a `Magnet` (from `halbach_fe.build_magnet`) and a `Session`, and returns a result with
labelled arrays. The command line calls the same functions.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.design import demagnetization as demagnetization_room
from halbach_fe.design.demagnetization import DemagnetizationMap
from halbach_fe.design.measurement_plan import MeasurementPlan, plan_measurement
from halbach_fe.design.shimming import Kind, Shim
from halbach_fe.design.shimming import shim as choose_moves
from halbach_fe.design.sorting import SortedBlocks, sort_blocks
from halbach_fe.design.tolerance import Tolerance, assembled_prior, predict_tolerance
from halbach_fe.diagnosis import diagnose as diagnosis_room
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.search import Say
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.multipoles import (
    MultipoleModel,
    MultipoleReference,
    Multipoles,
    multipole_model,
    multipole_models,
)
from halbach_fe.solver.session import Progress, Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study
from halbach_fe.synthetic.hidden_effects import parse_hidden_effect
from halbach_fe.synthetic.simulate import SimulatedCampaign, simulate_campaign


@dataclass(frozen=True)
class MultipoleTables(ShownInNotebook):
    """Multipoles of a magnet: integrated along z, and on one circle.

    Attributes
    ----------
    magnet : Magnet
    tables : sequence of (MultipoleModel, mapping)
        For each reference the linear model, and the multipoles by name of the distribution of
        magnetizations: ``prior``, or ``prior`` and ``posterior``.
    """

    magnet: Magnet
    tables: Sequence[tuple[MultipoleModel, Mapping[str, Multipoles]]]


def diagnose(
    magnet: Magnet, data: xr.Dataset, session: Session, blocks: BlockTable | None = None,
    effects: Sequence[str] | None = None, validation_map: xr.Dataset | None = None,
    say: Say = lambda text: None,
) -> Diagnosis:
    """Find which effects the study lacks to explain a measured map, and add them to the model.

    Parameters
    ----------
    magnet : Magnet
    data : Dataset
        The measured map, see `halbach_fe.read_map`.
    session : Session
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    effects : sequence of str, optional
        Names of the effects that may be missing; by default the whole catalogue.
    validation_map : Dataset, optional
        Another map, which is only predicted.
    say : callable
        Receives a line about each step.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> found = hf.diagnose(magnet, hf.read_map("map.csv"), hf.Session.open("diagnosis"),
    ...                     effects=["gain_x", "offset_y"])
    >>> found.study.name
    'dipole'
    """
    known = {effect.name: effect for effect in catalogue()}
    for name in effects or ():
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            raise StudyError(must_be("effects", "diagnose", "names of the catalogue", f"'{name}'",
                                     f"Did you mean {near[0]}?" if near else ""))
    chosen = None if effects is None else [known[name] for name in dict.fromkeys(effects)]
    return diagnosis_room.diagnose(magnet.study, data, session, blocks, chosen, validation_map, say)


def multipoles(
    magnet: Magnet, session: Session, reference: MultipoleReference | None = None,
    posterior: Mapping[str, Gaussian] | InferenceResult | None = None,
) -> MultipoleTables:
    """Compute the multipoles of a magnet, with standard deviations.

    In 3D there are two tables: of the field integrated along z, and of the circle at
    ``reference.z_m`` (the middle by default).

    Parameters
    ----------
    magnet : Magnet
    session : Session
    reference : MultipoleReference, optional
        Radius, orders and z; by default two thirds of the bore, orders 1 to 10.
    posterior : mapping or InferenceResult, optional
        Distributions of the magnetizations by name; by default the study's prior.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> found = hf.multipoles(magnet, hf.Session.open("results"))
    >>> model, known = found.tables[0]
    >>> model.main, sorted(known)
    (1, ['prior'])
    """
    reference = reference or MultipoleReference()
    references = [reference]
    if magnet.dimension == 3:
        references = [replace(reference, z_m=None), replace(reference, z_m=reference.z_m or 0.0)]
    models = multipole_models(magnet, references, session)
    if isinstance(posterior, InferenceResult):
        posterior = {"prior": posterior.prior, "posterior": posterior.posterior}
    known = posterior or {"prior": assembled_prior(magnet, models[0].nominal)}
    return MultipoleTables(magnet, [
        (model, {name: model.of(one) for name, one in known.items()}) for model in models])


def plan(magnet: Magnet, session: Session, points: int | None = None) -> MeasurementPlan:
    """Choose the positions that tell most about the block magnetizations.

    Parameters
    ----------
    magnet : Magnet
        The study's ``plan.candidates`` are chosen from; by default its own positions.
    session : Session
    points : int, optional
        How many to choose; by default the study's ``plan.points``.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> len(hf.plan(magnet, hf.Session.open("results"), points=8).points)
    8
    """
    return plan_measurement(magnet, session, points)


def shim(
    result: InferenceResult, session: Session, reference: MultipoleReference | None = None,
    swaps: int = 8, turns: int = 8, replacements: int = 0, limit_units: float | None = None,
    stock: BlockTable | None = None, seed: int = 1,
) -> Shim:
    """Choose blocks to swap, turn or replace so that unwanted multipoles become small.

    Parameters
    ----------
    result : InferenceResult
        Of the measured magnet.
    session : Session
    reference : MultipoleReference, optional
        Radius, orders and z of the multipoles; by default two thirds of the bore, orders 1 to 10.
    swaps, turns, replacements : int
        At most so many moves of each kind.
    limit_units : float, optional
        Largest unwanted multipole that is allowed, in units of 1e-4 of the main one.
    stock : BlockTable, optional
        Measured blocks that may replace others; by default nominal ones.
    seed : int
        Of the draws that the probability of meeting the limit is estimated with.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> session = hf.Session.open("results")
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), session)
    >>> bool(hf.shim(result, session, swaps=1, turns=0).before.orders)
    True
    """
    if stock is not None and not replacements:
        raise StudyError("Input stock must go with replacements, the number of blocks that may be "
                         "replaced; instead there are none. Give replacements.")
    model = multipole_model(result.magnet, reference or MultipoleReference(),
                            session.within("multipoles"))
    budget: dict[Kind, int] = {"swap": swaps, "turn": turns, "replace": replacements}
    return choose_moves(result, model, np.random.default_rng(seed), budget, limit_units, stock)


def sort(
    magnet: Magnet, blocks: BlockTable, session: Session,
    reference: MultipoleReference | None = None, seed: int = 1, progress: Progress | None = None,
) -> SortedBlocks:
    """Assign measured blocks to slots so that unwanted multipoles become small.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> found = hf.sort(magnet, hf.read_blocks("spares.csv"), hf.Session.open("results"))
    >>> found.left_over
    2
    """
    model = multipole_model(magnet, reference or MultipoleReference(), session)
    return sort_blocks(magnet, blocks, model, np.random.default_rng(seed),
                       progress or (lambda done, total: None))


def tolerance(
    magnet: Magnet, session: Session, blocks: BlockTable | None = None,
    reference: MultipoleReference | None = None, draws: int = 10_000,
    limit_units: float | None = None, seed: int = 1,
) -> Tolerance:
    """Draw magnets from the prior: what multipoles to expect, and how many are good enough.

    Parameters
    ----------
    magnet : Magnet
    session : Session
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    reference : MultipoleReference, optional
    draws : int
        Magnets to draw.
    limit_units : float, optional
        Largest unwanted multipole that is allowed, in units of 1e-4 of the main one.
    seed : int

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> found = hf.tolerance(magnet, hf.Session.open("results"), draws=100, limit_units=1e4)
    >>> found.share
    1.0
    """
    model = multipole_model(magnet, reference or MultipoleReference(), session)
    prior = (assembled_prior(magnet, model.nominal) if blocks is None
             else prior_from_blocks(magnet, blocks).gaussian)
    return predict_tolerance(model, magnet, prior, draws, np.random.default_rng(seed), limit_units)


def demagnetization(
    magnet: Magnet, session: Session, across: int = demagnetization_room.ACROSS
) -> DemagnetizationMap:
    """Map how near the blocks are to the knee of their demagnetization curve, at temperature.

    Parameters
    ----------
    magnet : Magnet
        Its study has a table ``demagnetization``.
    session : Session
    across : int
        Cells across the thickness of a block.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hot = hf.build_magnet(hf.read_study("dipole.toml").with_(demagnetization={
    ...     "intrinsic_coercivity_A_per_m": 1.6e6, "remanence_coefficient_per_K": -0.0012,
    ...     "coercivity_coefficient_per_K": -0.006, "temperature_C": 60.0}))
    >>> hf.demagnetization(hot, hf.Session.open("results")).share_beyond_now
    0.0
    """
    return demagnetization_room.demagnetization_map(magnet, session, across)


def simulate_measurement(
    study: Study, seed: int = 1, hide: Sequence[str] = (), hide_random: int = 0,
    progress: Progress = lambda done, total: None,
) -> SimulatedCampaign:
    """Simulate the measurement of a magnet whose blocks are drawn from the study's prior.

    The field is magpylib's and NGSolve's, never halbach-fe's own, so that the inference can be
    tested with it.

    Parameters
    ----------
    study : Study
    seed : int
    hide : sequence of str
        Effects that the truth has and the study does not: ``NAME`` or ``NAME=VALUE,...``.
    hide_random : int
        How many more effects to draw at random.
    progress : callable

    Examples
    --------
    >>> import halbach_fe as hf
    >>> campaign = hf.simulate_measurement(hf.read_study("dipole.toml"), seed=7)
    >>> campaign.readings.sizes["point"]
    24
    """
    return simulate_campaign(study, seed, hide=[parse_hidden_effect(text) for text in hide],
                             hide_random=hide_random, progress=progress)
