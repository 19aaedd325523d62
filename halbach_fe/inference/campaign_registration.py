"""The poses of several maps in one magnet.

The first map is registered with the study's prior of the blocks, every later one with the blocks as
the maps before have updated them. A later map therefore also tells apart poses between which the
nominal magnet looks the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.pose_result import OpenKey, ProbePrior, Registration
from halbach_fe.inference.registration import register
from halbach_fe.measurement.campaign import Map
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.maps import PROBE_KEYS
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study

KNOWN = ProbePrior(crosstalk=1e-9, gain=1e-9, offset_T=1e-12, sensor_m=1e-12)
"""Prior of a probe that an earlier map has found."""


def register_maps(
    magnet: Magnet, maps: Sequence[Map], session: Session, open_keys: Sequence[OpenKey] = (),
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, list[Registration]]:
    """Find the poses of several maps in a magnet.

    Parameters
    ----------
    magnet : Magnet
    maps : sequence of Map
        In the order in which they are registered: best the one first that says most about the
        blocks. Maps of one probe have the probe that the first of them finds.
    session : Session
    open_keys : sequence of OpenKey, optional
        Numbers of the study that are fitted with the first map.
    say : callable, optional
        Called with a description of each step before it starts.

    Returns
    -------
    dict of str to list of Registration
        For each map its poses, the most probable one first, given the best poses of the maps
        before.
    """
    found: dict[str, list[Registration]] = {}
    blocks: Gaussian | None = None
    probes: dict[str, Instrument] = {}
    for one in maps:
        study = one.study
        for key, (value, _) in (found[maps[0].name][0].open_keys.items() if found else ()):
            study = OpenKey(key, 1.0).apply(study, value)
        known = probes.get(one.probe)
        if known is not None:
            study = study.with_(instrument=_with_probe(study.instrument, known))
        say(f"map {one.name}")
        found[one.name] = register(
            magnet.with_study(study), one.data, session.within(one.name),
            None if known is None else KNOWN, () if found else open_keys, say, blocks)
        blocks = found[one.name][0].blocks
        probes.setdefault(one.probe, found[one.name][0].instrument)
    return found


def registered_study(
    study: Study, maps: Sequence[Map], found: dict[str, list[Registration]]
) -> Study:
    """Return the study of a campaign with the most probable pose of each map."""
    probes: dict[str, Instrument] = {}
    listed = []
    for each, one in zip(study.maps, maps, strict=True):
        instrument = found[one.name][0].instrument
        instrument = _with_probe(instrument, probes.setdefault(one.probe, instrument))
        listed.append(each.with_(instrument=instrument))
    study = study.with_(maps=tuple(listed))
    for key, (value, _) in found[maps[0].name][0].open_keys.items():
        study = OpenKey(key, 1.0).apply(study, value)
    return study


def _with_probe(instrument: Instrument, probe: Instrument) -> Instrument:
    """Return an instrument with the probe of another."""
    return instrument.with_(**{key: getattr(probe, key) for key in PROBE_KEYS})
