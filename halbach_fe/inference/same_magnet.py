"""Whether a distribution of magnetizations is that of a magnet, or of another one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.response.block_variation import distribution_of
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study, differences, magnet_description


def check_same_magnet(
    magnet: Magnet, study: Study, nominal: Floats, what: str, where: str
) -> None:
    """Refuse results of another magnet, even if it has as many blocks.

    Parameters
    ----------
    magnet : Magnet
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

    Raises
    ------
    MeasurementError
        If they are those of another magnet.
    """
    if isinstance(posterior, InferenceResult):
        check_same_magnet(magnet, posterior.study, posterior.magnet.nominal_magnetization,
                          "posterior", f"study {posterior.study.name}")
        return {"prior": posterior.prior, "posterior": posterior.posterior}
    if not isinstance(posterior, Mapping):
        raise MeasurementError(must_be(
            "posterior", f"study {magnet.name}", "the result of hf.infer, or distributions by name",
            f"a {type(posterior).__name__}"))
    return {name: distribution_of(magnet, one, name) for name, one in posterior.items()}


def disagreement_of(posterior: Mapping[str, Gaussian] | InferenceResult | None) -> str | None:
    """Return how the update of a posterior disagrees with its map; None if that is not known.

    If it agrees, that is its reservation, which is empty if it is sound. A posterior that is read
    from a file knows it as the result of `infer` does.
    """
    if isinstance(posterior, InferenceResult):
        return posterior.disagreement or posterior.reservation
    return getattr(posterior, "disagreement", None)
