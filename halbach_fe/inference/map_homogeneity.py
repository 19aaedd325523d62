"""Homogeneity of a measured map itself: a harmonic fit of its readings, without any magnet.

In the sphere about the region's centre that sources leave free, the field is a sum of
gradients of solid harmonics. Their amplitudes have a normal prior, of the same width on that sphere
for all, which the evidence of the readings chooses; the uniform field is as good as free. With the
covariance that the noise of the readings leaves they give the field in a region within the map.
Terms of the instruments of which the study states a standard deviation, and uncertain amplitudes of
instruments, are parameters beside them: a map by itself does not tell a probe's gain from the
field. Beside the field of the nominal and of the updated magnet that of the map shows how much the
update explains.

Of a map that lacks components the uniform field along these is unknown, and with it |B|. If the
main field is along components that it has, the size of these is |B| to first order, and is what is
told; otherwise nothing is. A map of |B| alone, as of an NMR probe, tells B along the nominal field
at every point, which is |B| but for the square of what lies across. Neither is what the readings
leave open for the most part, nor a held-out part that contradicts the whole map or tells much less
than it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag, solve_triangular

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.numbers import decimals
from halbach_fe.geometry.blocks import distance_from_blocks, present_blocks
from halbach_fe.geometry.coils import distance_in_magnet
from halbach_fe.geometry.magnet import Magnet, neighbour_blocks
from halbach_fe.inference.campaign_readings import (
    Readings,
    read_campaign,
    unit_vectors,
    warn_of_another_gain,
)
from halbach_fe.inference.relinearization import open_columns
from halbach_fe.inference.result import HELD_OUT
from halbach_fe.measurement.campaign_maps import Map, maps_of
from halbach_fe.measurement.source_free_field import (
    UNIFORM,
    HarmonicFit,
    fit_readings,
    solid_harmonic_fields,
)
from halbach_fe.response.homogeneity import DRAWS, PPM, Homogeneity, HomogeneityModel
from halbach_fe.response.region import Region
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

WITHIN = 0.75
"""Radius up to which readings are used, relative to that of the free sphere: at its surface the
series has no end."""

POOR = 1.15
"""Noise that a fit finds, relative to the stated one, above which it is not to be relied on: the
readings are too far apart for the field between them, or noisier than stated."""

OPEN = 0.2
"""Deviation of |B| that readings leave open, relative to the one that they show, above which they
do not carry it: how much of it is left then depends on the prior of the amplitudes."""

SEEN = 0.1
"""Part of the readings' sensitivity from which the field along a direction is measured: above the
crosstalk of a probe, below a component of its own."""

ALONG = 0.1
"""Largest part of the main field that is across what was measured, relative to the whole: |B| then
differs by 0.5 % at most from the size of the rest."""

MAP, HELD_OUT_PART = "map", "map, held-out part"
"""Names of what is fitted: all readings, or those that do not update the magnet."""


def map_homogeneity(
    magnet: Magnet, data: xr.Dataset | Mapping[str, xr.Dataset], model: HomogeneityModel
) -> tuple[dict[str, Homogeneity], float, tuple[str, ...]]:
    """Return the homogeneity that a map has by itself, in the region of a model, and the misfit.

    It has the name `MAP`; if the study holds readings out, that of these alone is beside it. The
    misfit is the noise that the fit of all readings finds, relative to the stated one, see `POOR`.
    What the readings do not tell is left out, and sentences, the third value, say so.

    Parameters
    ----------
    magnet : Magnet
        Its study states where the map lies, the instrument and the noise.
    data : Dataset or dict of str to Dataset
        The map, or all maps that the study lists.
    model : HomogeneityModel
        Of the region.

    Raises
    ------
    MeasurementError
        If the map does not fit the study, or the region reaches beyond it.
    """
    maps = maps_of(magnet.study, data)
    readings = read_campaign(magnet, maps)
    warn_of_another_gain(maps)
    _check_within(readings, model)
    held_out = np.array(readings.parts) == HELD_OUT
    free = _free_radius(magnet, np.array(model.region.centre_m))
    points = readings.observation.points
    near = points[_is_near(points, model.region, free)]
    # a fit tells what is within a mean distance of readings around them
    if len(near) and (ends := _ends_before(near, model, len(near)**(-1 / 3))):
        return {}, np.nan, (
            f"Of the map, a fit can use the readings within {1e3 * WITHIN * free:.3g} mm of the "
            f"region's centre, as far as blocks and iron leave room, and there {ends}, less far "
            "than the region: it does not tell how homogeneous the field is. Choose a smaller "
            "region.",)
    parts = {MAP: np.ones_like(held_out)} | (
        {HELD_OUT_PART: held_out} if held_out.any() else {})
    found, noises, remarks = {}, {}, []
    for name, chosen in parts.items():
        what = "The map" if name == MAP else "Its held-out part"
        known, noises[name], remark = _fitted(
            readings, chosen, model, free, maps, magnet.study)
        if known is not None:
            found[name] = known
        if remark and (name == MAP or known is None):
            remarks.append(f"{what} {remark}")
    if far := magnet.surroundings(readings.observation.points).far_away():
        remarks.append(far)
    if MAP in found and HELD_OUT_PART in found:
        remark = not_carried(found[HELD_OUT_PART], found[MAP])
        if remark:
            del found[HELD_OUT_PART]
            remarks.append(remark)
    return found, noises[MAP], tuple(remarks)


def not_carried(part: Homogeneity, whole: Homogeneity) -> str:
    """Say why the fit of a held-out part does not count beside that of the whole map, or nothing.

    Its range either excludes what the whole map shows, or is wide where the whole map's is not.
    """
    # Width of the 95 % range of the rms deviation, relative to it, from which a held-out part does
    # not carry it if the whole map does. Of maps of cuboids a 20th of the scan lines had 1 %; a
    # 30th or 40th had 8 to 10 %, with estimates up to 5 % too low, and a 60th 38 to 42 %: that is
    # the prior of the amplitudes rather than the readings.
    wide = 0.05
    (low, _, high), (least, _, most) = part.rms_range_ppm, whole.rms_range_ppm
    has = (f"Its held-out part by itself has {part.rms_ppm:.0f} ppm rms (95 %: {low:.0f} to "
           f"{high:.0f})")
    if not low <= whole.rms_ppm <= high:
        return (f"{has}, which contradicts the {whole.rms_ppm:.0f} ppm of the whole map: its "
                "readings are too few to tell it, or differ from the others. It is left out.")
    if high - low > wide * part.rms_ppm and most - least <= wide * whole.rms_ppm:
        return (f"{has}, which its readings are too few to tell, unlike the whole map. It is left "
                "out.")
    return ""


def of_other_size(of_map: Homogeneity, of_magnet: Homogeneity) -> str:
    """Say that the mean field of a map is not that of the magnet, or nothing."""
    far = 0.1  # blocks of another grade are a few per cent off
    factor = of_map.mean_T / of_magnet.mean_T
    if abs(factor - 1) <= far + 3 * of_map.mean_sd_T / of_magnet.mean_T:
        return ""
    return (f"The mean field of the map is {decimals(factor)} times that of the magnet: is it a "
            "map of this magnet, in m and T?")


def _check_within(readings: Readings, model: HomogeneityModel) -> None:
    """Refuse a region that reaches beyond the readings, where a fit of them tells nothing."""
    beyond = 0.02  # relative to the sides of the box around the readings
    if ends := _ends_before(readings.observation.points, model, beyond):
        raise MeasurementError(must_be(
            "the region", "the map", "within its points, to compare with its own homogeneity",
            f"{model.region.text}, while {ends}", "Choose a smaller region, or leave the map out."))


def _ends_before(points: Floats, model: HomogeneityModel, beyond: float) -> str:
    """Say where readings at points (n, 3) in m end before the region does, or nothing.

    ``beyond`` is how far it may reach beyond the box around them, relative to its sides.
    """
    region, low, high = model.points[:len(model.weights)], points.min(axis=0), points.max(axis=0)
    margin = beyond * (high - low)
    outside = ((region < low - margin) | (region > high + margin)).sum(axis=0)
    axis = int(np.argmax(outside))
    return "" if not outside[axis] else (
        f"{'xyz'[axis]} of the readings goes from {1e3 * low[axis]:.4g} to "
        f"{1e3 * high[axis]:.4g} mm")


def _is_near(points: Floats, region: Region, free_m: float) -> NDArray[np.bool_]:
    """Tell which points (n, 3) in m are near enough to a region's centre for the fit."""
    away = np.linalg.norm(points - np.array(region.centre_m), axis=1)
    return np.asarray(away <= WITHIN * free_m)


def _fitted(
    readings: Readings, chosen: NDArray[np.bool_], model: HomogeneityModel, free_m: float,
    maps: Sequence[Map], study: Study,
) -> tuple[Homogeneity | None, float, str]:
    """Return the homogeneity of the fit of some readings, and its noise over the stated noise.

    The third value is the end of a sentence about what the readings do not tell; if that is the
    homogeneity, there is none, and no noise if no reading is near enough.
    """
    observation, region = readings.observation, model.region
    # a reading counts if all its sensors are near
    far = ~np.repeat(_is_near(observation.points, region, free_m), 3)
    used = np.flatnonzero(chosen & ~(abs(observation.operator) @ far.astype(float) > 0))
    within = f"within {1e3 * WITHIN * free_m:.3g} mm of the region's centre"
    if not len(used):
        return None, np.nan, (f"has no readings {within}, where blocks and iron leave room for a "
                              "fit: it does not tell how homogeneous the field is.")
    centre = np.array(region.centre_m)

    def harmonics(at: Floats) -> Floats:
        return _fields((at - centre) / free_m)

    amplitudes, noise = _amplitudes(readings, used, harmonics, maps, study)
    if amplitudes is None:
        return None, np.nan, (
            f"has {len(used)} readings {within}. A fit goes through all of them, so that it shows "
            "neither its noise nor its error: it does not tell how homogeneous the field is. "
            "Measure more points there.")
    points = model.points[:len(model.weights)]
    fields = (harmonics(points) @ amplitudes).reshape(len(points), 3, -1)
    if observation.of_total_field[used].all():
        known, fields, remark = _along_nominal(model, fields)
    else:
        known, remark = _along_measured(model, fields, _told(observation.operator.tocsr()[used]))
    if known is None:
        return None, noise, remark
    # numbers of such a fit are those of the prior of its amplitudes, and may be far from the truth
    if PPM * _open(fields[..., 1:], known.direction, model.weights) > (
            OPEN * known.rms_ppm * known.mean_T):
        return None, noise, (
            f"has {len(used)} readings {within}, too few or too noisy ones for the field in the "
            "region: it does not tell how homogeneous it is.")
    return known, noise, remark


def _amplitudes(
    readings: Readings, used: Ints, harmonics: Callable[[Floats], Floats], maps: Sequence[Map],
    study: Study,
) -> tuple[Floats | None, float]:
    """Return the fitted amplitudes of harmonics, and draws of them (amplitudes, 1 + draws), and the
    noise over the stated noise; no amplitudes if they go through all readings that are used.
    """
    operator, sd = readings.observation.operator.tocsr()[used], readings.noise.sd[used]
    seen = np.unique(operator.indices // 3)
    columns = (3 * seen[:, None] + np.arange(3)).ravel()
    design = np.asarray(operator[:, columns] @ harmonics(
        readings.observation.points[seen])) / sd[:, None]
    scaled = readings.values[used] / sd
    fit = fit_readings(design, [scaled])[0]
    # Harmonics that are determined, as a share of the readings, above which the fit goes through
    # all readings and shows no noise to take bars from: these were 10 to 90 times too short. A fit
    # whose bars were right had 0.88.
    through = 0.95
    if fit.used > through * len(scaled):
        return None, np.nan
    terms = open_columns(study, lambda at: (harmonics(at) @ fit.amplitudes).reshape(-1, 3), maps,
                         readings)[used] / sd[:, None]
    mean, noise, root = _with_terms(design, terms, scaled, fit)
    normals = np.random.default_rng(0).standard_normal((root.shape[1], DRAWS))
    return np.column_stack([mean, mean[:, None] + root @ normals]), noise


def _along_nominal(
    model: HomogeneityModel, fields: Floats
) -> tuple[Homogeneity | None, Floats, str]:
    """Return the homogeneity of |B| by the part along the nominal field of fields (n, 3, draws) in
    T, this part, and the end of a sentence on that; no homogeneity if the field turns too much.
    """
    nominal = model.field(model.response.nominal[:, None])[..., 0]
    along = unit_vectors(nominal)
    differs = _differs(np.sum(along * fields[..., 0], axis=1), np.linalg.norm(nominal, axis=1),
                       model.weights)
    if differs > ALONG:
        return None, fields, (
            f"is of |B|, which differs by up to {100 * differs:.2g} % from the nominal one in the "
            "region: the field may turn too much there for |B| to be harmonic. Measure components.")
    fields = (along[:, :, None] * along[:, None]) @ fields
    known = model.of_fields(fields[..., 0], fields[..., 1:], measured=True)
    return replace(known, components="|B|"), fields, (
        "is of |B|, fitted as B along the nominal field. "
        f"{_to_first_order(np.array([np.sqrt(2) * differs]))}")


def _along_measured(
    model: HomogeneityModel, fields: Floats, told: Floats
) -> tuple[Homogeneity | None, str]:
    """Return the homogeneity of |B| by fields (n, 3, draws) in T, which are told in the directions
    of a projector (3, 3), and the end of a sentence on what is not; none if much of B is not.
    """
    lacking, main = _lacking(told), model.nominal_mean
    if np.linalg.norm(main - told @ main) > ALONG * np.linalg.norm(main):
        return None, (f"has no {lacking}, along which much of the main field is: it does not tell "
                      "how homogeneous |B| is.")
    known = model.of_fields(fields[..., 0], fields[..., 1:], measured=True,
                            told=told if lacking else None)
    if not lacking:
        return known, ""
    has = " and ".join(f"B{name}" for name in COMPONENTS if f"B{name}" not in lacking)
    nominal = model.field(model.response.nominal[:, None])[..., 0]
    size, whole = (np.linalg.norm(each, axis=1) for each in (nominal @ told, nominal))
    across = np.sqrt(np.maximum(whole**2 / size**2 - 1, 0.0))
    differs = _differs(np.linalg.norm(fields[..., 0] @ told, axis=1), size, model.weights)
    return replace(known, components=has), (
        f"has no {lacking}. What is said of it is the size of {has} alone, as the main field is "
        f"along it. {_to_first_order(across + np.sqrt(2) * differs)}")


def _to_first_order(across: Floats) -> str:
    """Say by how much a part of B is less than |B|, by what is across it (n,) relative to it."""
    return (f"That is |B| but for some {decimals(PPM * float(np.max(across**2)) / 2)} ppm, if the "
            "field differs from the nominal one as much across it as along it: error bars are "
            "those of this part of B, and the direction of the mean of B is not told.")


def _told(operator: sparse.csr_array) -> Floats:
    """Return the projector (3, 3) to the directions along which readings measure the field."""
    rows = np.stack([np.asarray(operator[:, axis::3].sum(axis=1)).ravel() for axis in range(3)], 1)
    values, vectors = np.linalg.eigh(rows.T @ rows)
    along = vectors[:, values > SEEN**2 * values[-1]]
    return np.asarray(along @ along.T)


def _differs(size: Floats, nominal: Floats, weights: Floats) -> float:
    """Return by how much |B| (n,) differs at most from the nominal one, times a common factor."""
    return float(np.max(np.abs(size / nominal - weights @ size / (weights @ nominal))))


def _lacking(told: Floats) -> str:
    """Return the names of the components that are not measured; empty if all are."""
    return " and ".join(f"B{name}" for name, part in zip(COMPONENTS, np.diag(told), strict=True)
                        if part < 1 - SEEN)


def _open(drawn: Floats, direction: Floats, weights: Floats) -> float:
    """Return how much the deviation along a direction (3,) varies in drawn fields (n, 3, d), rms
    over the region, in T.
    """
    along = np.einsum("ncd,c->nd", drawn, direction)
    deviation = along - weights @ along
    return float(np.sqrt(weights @ np.var(deviation, axis=1)))


def _with_terms(
    design: Floats, terms: Floats, scaled: Floats, fit: HarmonicFit
) -> tuple[Floats, float, Floats]:
    """Return mean (k,) of the amplitudes, noise over the stated noise, and a root of their
    covariance (k, k + terms), with the terms of instruments beside them.

    Where there are such terms, the prior of the amplitudes is centred on the fit, and leaves its
    scale free. Otherwise it would tell how strong the field is, and so the gain.
    """
    left = scaled - design @ fit.amplitudes
    if not terms.shape[1]:
        noise = _noise(left, fit)
        values, vectors = np.linalg.eigh(design.T @ design)
        return fit.amplitudes, noise, vectors * (
            noise / np.sqrt(np.maximum(values, 0.0) + fit.penalty))
    count, whole = design.shape[1], np.hstack([design, terms])
    scale = fit.amplitudes / np.linalg.norm(fit.amplitudes)
    prior = np.sqrt(fit.penalty) * (np.eye(count) - np.outer(scale, scale))

    def solved(noise: float) -> tuple[Floats, Floats]:
        """Return the step from the fit (k + terms,), and a root over the noise."""
        rows = np.vstack([whole, block_diag(prior, noise * np.eye(terms.shape[1]))])
        size = np.linalg.norm(rows, axis=0)
        turned, triangle = np.linalg.qr(rows / size)
        root = solve_triangular(triangle, np.eye(len(triangle))) / size[:, None]
        return root @ (turned[:len(left)].T @ left), root

    step, _ = solved(1.0)
    noise = _noise(left - whole @ step, fit)
    return fit.amplitudes + step[:count], noise, noise * solved(noise)[1][:count]


def _noise(left: Floats, fit: HarmonicFit) -> float:
    """Return the noise that what is left of scaled readings shows, over the stated noise."""
    return float(np.linalg.norm(left) / np.sqrt(max(len(left) - fit.used, 1.0)))


def _fields(points: Floats) -> Floats:
    """Return B (3 n, amplitudes) at points (n, 3) in units of the free sphere's radius."""
    # highest degree of the harmonics: at `WITHIN` the next ones are 3e-4 of what they are on the
    # free sphere
    most_degrees = 28
    fields = solid_harmonic_fields(points, most_degrees).reshape(3 * len(points), -1)
    fields[:, :3] *= UNIFORM
    return fields


def _free_radius(magnet: Magnet, centre: Floats) -> float:
    """Return the radius in m of the sphere about a point that blocks, iron, coils and dipoles leave
    free.
    """
    external, here = magnet.external, centre[None]
    blocks = (*present_blocks(magnet.blocks),
              *neighbour_blocks(magnet.blocks, external.neighbours))
    return float(min([
        *distance_from_blocks(blocks, here, magnet.field_reach),
        *(body.distance(here)[0] for body in magnet.iron),
        *(distance_in_magnet(coil, here)[0] for coil in external.coils),
        *(np.linalg.norm(centre - one.position_m) for one in external.dipoles)]))
