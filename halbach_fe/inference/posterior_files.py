"""The files of an inference: posterior.h5, prediction.csv and summary.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
import xarray as xr

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, OutputError, must_be, printable
from halbach_fe.core.files import write_text
from halbach_fe.core.numbers import csv_text
from halbach_fe.core.untrusted_files import (
    ChangedContentError,
    read_hdf5,
    with_checksum,
    write_hdf5,
)
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import PREDICTION_COLUMNS, InferenceResult, Reservation
from halbach_fe.measurement.probe_law import row_order_note
from halbach_fe.response.block_variation import distribution_of, magnetized
from halbach_fe.stats.gaussian import CovarianceFactor, Gaussian, root_matrix, stacked_root
from halbach_fe.study.measurement_keys import InstrumentSd
from halbach_fe.study.model import Study, differences, magnet_description


def check_same_magnet(
    magnet: Magnet, study: Study, nominal: Floats, what: str, where: str
) -> None:
    """Refuse results of another magnet, even if it has as many blocks.

    Parameters
    ----------
    study : Study
        The study of the results.
    nominal : ndarray, shape (parameters,), in A/m
        Its nominal magnetizations.
    what, where : str
        What the results are, and where they come from, for the message.

    Raises
    ------
    MeasurementError
        If any key that describes the magnet differs, or data behind such a key have changed.
    """
    own = magnet.nominal_magnetization
    if magnet.study.prior.variation_sd or magnet.study.uncertain_of_magnet:  # amplitudes are 0
        own = np.concatenate([own, np.zeros(max(0, len(nominal) - len(own)))])
    key = next(iter(differences(magnet_description(magnet.study), magnet_description(study))), None)
    if key is None and (own.shape != nominal.shape
                        or not np.allclose(nominal, own, rtol=1e-9, atol=1e-6)):
        key = "array"  # the data of a grade or of a table have changed
    if key is not None:
        raise MeasurementError(must_be(
            what, where, f"that of the magnet of study {magnet.name}",
            f"that of another magnet, with another `{key}`", "Use the study of that inference."))


def distributions_of(
    magnet: Magnet, posterior: Mapping[str, Gaussian] | InferenceResult
) -> dict[str, Gaussian]:
    """Return the distributions of a magnet's magnetizations in A/m, by name.

    The last is the best known: the posterior if there is one.

    Raises
    ------
    MeasurementError
        If they are those of another magnet.
    """
    if isinstance(posterior, InferenceResult):
        check_same_magnet(magnet, posterior.study, posterior.magnet.nominal_magnetization,
                          "posterior", f"study {posterior.study.name}")
        return {name: magnetized(magnet, one, name) for name, one in (
            ("prior", posterior.prior), ("posterior", posterior.posterior))}
    if not isinstance(posterior, Mapping) or not posterior:
        raise MeasurementError(must_be(
            "posterior", f"study {magnet.name}", "the result of hf.infer, or distributions by name",
            f"a {type(posterior).__name__}{' without any' if posterior == {} else ''}"))
    return {name: distribution_of(magnet, one, name) for name, one in sorted(
        posterior.items(), key=lambda item: item[0] == "posterior")}


def disagreement_of(
    posterior: Mapping[str, Gaussian] | InferenceResult | None, magnet: Magnet
) -> str | None:
    """Return how the update of a posterior disagrees with its map; None if that is not known.

    If it agrees, that is its reservation, which is empty if it is sound. A posterior that is read
    from a file knows it as the result of `infer` does.
    """
    if isinstance(posterior, InferenceResult):
        return _with_version(posterior.disagreement or posterior.reservation, magnet,
                             posterior.study)
    return getattr(posterior, "disagreement", None)


def _with_version(disagreement: str, magnet: Magnet, study: Study) -> str:
    """Return a disagreement with its map, with a word if a study's update is not the magnet's.

    An update that estimated terms of the instrument or of the surroundings is that of the study
    with what it found, too.
    """
    if disagreement and not isinstance(disagreement, Reservation):
        return disagreement
    keys = {"noise", "prior", "inference"}
    if not study.uncertain and all(one in (None, InstrumentSd()) for one in (
            study.instrument_sd, *(each.instrument_sd for each in study.maps))) and not any(
            any(each.stage_shift_sd_m) for each in study.maps):
        keys |= {"instrument", "external", "maps"}
    now, then = (one.model_dump(mode="json", include=keys) for one in (magnet.study, study))
    for each in (now, then):  # which blocks may change places is nothing that an update knows
        each["prior"].pop("types")
        for one in each.get("maps", ()):  # which is relative to the folder of a study
            one.pop("file")
    if (key := next(iter(differences(then, now)), None)) is None:
        return disagreement
    return Reservation(f"{disagreement} Only of another version of the study, with another "
                       f"`{key}`.".lstrip())


NEIGHBOURS_LEFT_OUT = (
    "Only with care. The file of this posterior is of an earlier version, which did not keep what "
    "the update found of the neighbours' blocks: they count as before the map. Run halbach-fe "
    "infer again.")
"""What is said of a posterior whose study has neighbours, and whose file does not know them."""


class StoredPosterior(dict[str, Gaussian]):
    """Distributions of the magnetizations in A/m, ``prior`` and ``posterior``, of a file."""

    disagreement: str | None = None
    """`InferenceResult.disagreement` of the update, or else its reservation; None if the file does
    not state it."""


def write_inference(update: InferenceResult, folder: Path) -> None:
    """Write posterior.h5, prediction.csv and summary.json."""
    # Largest number of parameters for which the full covariance (then 32 MB) is written too.
    written_covariance = 2000
    magnetization = update.magnetizations
    magnetization.attrs["study"] = update.study.model_dump_json()
    magnetization.attrs["disagreement"] = update.disagreement
    magnetization.attrs["reservation"] = str(update.reservation)
    distributions = {"prior": update.prior, "posterior": update.posterior}
    for name, distribution in distributions.items():
        magnetization.update(_stored_root(name, distribution, update.prior))
        if distribution.beside is not None:
            magnetization[f"{name}_neighbours_mean"] = (
                "neighbours_parameter", distribution.beside.mean, {"units": "A/m"})
        if len(update.response.parameters) <= written_covariance:
            magnetization[f"{name}_covariance"] = (
                ("parameter", "parameter_2"), distribution.covariance, {"units": "A2/m2"})
    write_hdf5(with_checksum(magnetization), folder / "posterior.h5")
    readings = update.predictions
    write_text(folder / "prediction.csv", csv_text(
        {str(name): readings[name].values for name in PREDICTION_COLUMNS}))
    text = json.dumps(inference_summary(update), indent=1, allow_nan=False)
    write_text(folder / "summary.json", text + "\n")


def read_posterior(magnet: Magnet, path: Path) -> StoredPosterior:
    """Read ``prior`` and ``posterior`` of the magnetizations in A/m from a file posterior.h5.

    Raises
    ------
    MeasurementError
        If the file cannot be read as a posterior.h5, or belongs to another magnet.
    OutputError
        If its content is not what was written.
    """
    max_sentences = 4000  # number of characters of a file's sentences that are shown
    distributions = StoredPosterior()
    try:
        data = read_hdf5(path)
        own = untrusted_files.finite_array(data["nominal"], data["nominal"].shape)
        study = Study.model_validate_json(data.attrs["study"])
        if "disagreement" in data.attrs:
            said, open_ = (printable(str(data.attrs.get(name, "")), max_sentences)
                           for name in ("disagreement", "reservation"))
            distributions.disagreement = said or Reservation(open_)
        for name in ("prior", "posterior"):
            mean = untrusted_files.finite_array(data[f"{name}_mean"], own.shape)
            if (others := data.get(f"{name}_neighbours_mean")) is not None:
                mean = np.append(mean, untrusted_files.finite_array(others, (others.size,)))
            distributions[name] = Gaussian(
                mean, _read_root(data, name, distributions.get("prior"), len(mean)))
        for name, each in distributions.items():
            distributions[name] = each.split(len(own), len(each.mean) - len(own))
    except (OSError, KeyError, ValueError, TypeError, RecursionError) as error:
        if isinstance(error, ChangedContentError) and _looks_like_a_posterior(path):
            raise OutputError(must_be(
                "--posterior", str(path), "as halbach-fe infer wrote it",
                f"a changed file: {error}", "Run halbach-fe infer again.")) from None
        reason = error.strerror if isinstance(error, OSError) else None
        raise MeasurementError(must_be(
            "--posterior", str(path), "a posterior.h5 that halbach-fe infer wrote",
            reason or "a file that cannot be read as such")) from None
    check_same_magnet(magnet, study, own, "--posterior", str(path))
    known = distributions.disagreement
    if known is not None:
        if study.external.neighbours and distributions["posterior"].beside is None and (
                not known or isinstance(known, Reservation)):
            known = Reservation(f"{known} {NEIGHBOURS_LEFT_OUT}".lstrip())
        distributions.disagreement = _with_version(known, magnet, study)
    return distributions


def _looks_like_a_posterior(path: Path) -> bool:
    """Tell whether an HDF5 file has what every posterior.h5 has, whatever its checksum is."""
    data = untrusted_files.read_dataset(path)
    return "nominal" in data and "study" in data.attrs


def _stored_root(name: str, distribution: Gaussian, prior: Gaussian) -> dict[str, Any]:
    """Return the variables of posterior.h5 that store the root of a distribution's covariance.

    The root is stored as a sparse matrix. If it is the prior's root with its standard deviations
    reduced along some directions (see `CovarianceFactor`), only the reduction is stored.
    """
    root = distribution.root
    if (isinstance(root, CovarianceFactor) and distribution is not prior
            and root.outer is root_matrix(prior.root)):
        return {f"{name}_directions": (("coordinate", "direction"), root.directions),
                f"{name}_left": ("direction", root.remaining)}
    rows = sparse.csr_array(root_matrix(distribution.stacked.root))
    return {f"{name}_root": (f"{name}_entry", rows.data, {"units": "A/m"}),
            f"{name}_root_column": (f"{name}_entry", rows.indices),
            f"{name}_root_row_start": (f"{name}_row", rows.indptr, {"columns": rows.shape[1]})}


def _read_root(
    data: xr.Dataset, name: str, prior: Gaussian | None, size: int
) -> Floats | CovarianceFactor:
    """Return the stored root with ``size`` rows.

    KeyError, ValueError or TypeError if the variables are missing or do not describe a root.
    """
    if f"{name}_left" in data and prior is not None:
        left = data[f"{name}_left"]
        return CovarianceFactor(root_matrix(prior.root), untrusted_files.finite_array(
            data[f"{name}_directions"], (prior.root.shape[1], len(left))),
            untrusted_files.finite_array(left, left.shape))
    start, values = data[f"{name}_root_row_start"], data[f"{name}_root"]
    rows = sparse.csr_array(
        (untrusted_files.finite_array(values, values.shape), _whole(data[f"{name}_root_column"]),
         _whole(start)),
        shape=(size, int(start.attrs["columns"])))
    rows.check_format()  # without it, scipy would follow indices outside of the arrays
    return stacked_root(rows)


def _whole(data: xr.DataArray) -> Ints:
    """Return stored whole numbers as integers; ValueError if they are not whole or too large."""
    values = untrusted_files.finite_array(data, data.shape)
    if (np.abs(values) > np.iinfo(np.int32).max).any() or (values % 1 != 0).any():
        raise ValueError("it must be whole numbers")
    return values.astype(np.int64)


def inference_summary(update: InferenceResult) -> dict[str, object]:
    """Return the main figures of an inference as plain data, the content of summary.json."""
    shift = update.posterior.mean - update.prior.mean
    return {
        "study": update.study.name,
        "readings": len(update.readings),
        "held_out": int(update.held_out.sum()),
        "parameters": len(update.response.parameters),
        "posterior": update.kind,
        "measured_blocks": None if update.measured_blocks is None else len(update.measured_blocks),
        "superposition_error": update.response.superposition_error,
        "largest_solver_error_T": float(update.response.error.max()),
        "largest_solver_error_over_noise": float((update.response.error / update.noise.sd).max()),
        "prior_conflict": update.prior_conflict,
        "prior_conflict_limit": update.conflict_limit,
        "disagreement": update.disagreement,
        "parameters_learnt": update.parameters_learnt,
        "log_evidence": update.log_evidence,
        "information_left_out": update.left_out,
        "strongest_field": update.field.summary(),
        "contraction_by_block": [None if np.isnan(value) else value for value in
                                 update.contraction.round(6).tolist()],
        "largest_shift_A_per_m": float(np.abs(shift).max()),
        "common_shift": float(shift @ update.prior.mean / (update.prior.mean @ update.prior.mean)),
        "instrument_terms": None if update.terms is None else update.terms.summary(),
        "uncertain": None if update.amplitudes is None else update.amplitudes.summary(),
        "poses": None if update.terms is None else {
            pose.name: {key: value for key, value in asdict(pose).items() if key != "name"}
            for pose in update.terms.poses},
        "row_order": row_order_note(update.study),
        "instrument_at_rest": None if update.terms is None else update.terms.at_rest,
        "stray_field": None if update.stray_field is None else update.stray_field.summary(),
        "magnetic_axis": (None if update.magnetic_axis is None
                          else update.magnetic_axis.summary()),
        "overlaps": [asdict(each) | {"disagreement": each.disagreement}
                     for each in update.overlaps],
        "regions_left_out": [asdict(each) | {
            "over_noise": each.over_noise, "disagreement": each.disagreement,
            "stretches": [asdict(one) | {"over_noise": one.over_noise} for one in each.stretches]}
            for each in update.regions_left_out],
        "scores": [asdict(score) for score in update.scores],
    }
