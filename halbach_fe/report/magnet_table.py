"""The rows of a page's table that describe the magnet."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from halbach_fe.geometry.magnet import Magnet
from halbach_fe.study.model import iron_of


def magnet_rows(magnet: Magnet) -> list[tuple[str, str]]:
    """Return name and value of the properties of a magnet that its pages list."""
    array, blocks = magnet.array, magnet.blocks
    outer = f"{1e3 * magnet.array_outer_radius:.6g} mm"
    rows = [("dimension", f"{magnet.dimension}D"), ("blocks", layout(magnet)),
            ("radius of the bore, outer radius",
             f"{1e3 * magnet.free_radius:.6g} mm, {outer}") if magnet.has_bore else (
                "outer radius", f"{outer}, without a bore"),
            ("remanence", f"{_range((abs(block.remanence) for block in blocks), 4)} T"),
            ("recoil permeability along, across the easy axis",
             f"{_range((block.recoil_permeability for block in blocks), 3)}, "
             f"{_range((block.recoil_permeability_across for block in blocks), 3)}"),
            ("main multipole", str(array.multipole_order))]
    if magnet.dimension == 3:
        rows.insert(3, ("length", f"{2e3 * magnet.array_half_length:.6g} mm"))
    return [*rows, ("iron", iron_description(magnet))]


def in_one_line(magnet: Magnet) -> str:
    """Return the magnet in a line: blocks, bore, length, remanence, iron."""
    length = (f", {2e3 * magnet.array_half_length:.4g} mm long" if magnet.dimension == 3
              else ", in cross-section")
    iron = "without iron" if iron_of(magnet.study) is None else f"iron: {iron_description(magnet)}"
    bore = f"bore {2e3 * magnet.free_radius:.4g} mm" if magnet.has_bore else "no bore"
    return (f"{layout(magnet)}{length}, {bore}, "
            f"outer diameter {2e3 * magnet.array_outer_radius:.4g} mm, remanence "
            f"{_range((abs(block.remanence) for block in magnet.blocks), 3)} T, {iron}")


def layout(magnet: Magnet) -> str:
    """Return the number of rings and blocks in words, for example "3 rings of 16 sectors"."""
    most_sizes = 3  # largest number of different rings whose numbers of blocks are listed
    array = magnet.array
    count = len(array.blocks_by_ring) if array.free_blocks is None else array.rings
    texts = []
    if count:
        sizes = sorted(set(array.blocks_by_ring[:count]))
        shapes = dict.fromkeys((ring.block or array.block).shape for ring in array.ring)
        blocks = (' or '.join(map(str, sizes)) if len(sizes) <= most_sizes
                  else f"{sizes[0]} to {sizes[-1]}")
        texts.append(f"{count} ring{'s' * (count > 1)} of {blocks} "
                     f"{', '.join(f'{shape}s' for shape in shapes or [array.block.shape])}")
    if array.free_blocks is not None:
        kinds = ", ".join(dict.fromkeys(array.free_blocks.shape))
        texts.append(f"{len(array.free_blocks)} free blocks ({kinds})")
    return " and ".join(texts)


def iron_description(magnet: Magnet) -> str:
    """Return the bodies of iron and their material in words."""
    iron = iron_of(magnet.study)
    if iron is None:
        return "none"
    bodies = []
    for body in magnet.iron:
        if body.sphere or not body.in_place:
            size = "x".join(f"{1e3 * float(np.ptp(part)):.4g}" for part in body.surface)
            bodies.append(f"{'sphere' if body.sphere else 'body'} within {size} mm about "
                          f"({', '.join(f'{1e3 * part:g}' for part in body.origin_m)}) mm")
            continue
        kind = "tube" if body.outline is None else "prism"
        length = "" if np.isinf(body.z_max) else (
            f", z {1e3 * body.z_min:g} to {1e3 * body.z_max:g} mm")
        bodies.append(f"{kind}, r {1e3 * body.inner_radius:g} to "
                      f"{1e3 * body.outer_radius:g} mm{length}")
    more = f" and {len(bodies) - 4} more" if len(bodies) > 4 else ""
    if any(body.own_material for body in getattr(iron, "bodies", ())):
        material = "iron of several materials"
    elif iron.curve is None:
        material = f"relative permeability {iron.relative_permeability:g}"
    else:
        material = f"magnetization curve ({iron.curve.kind.replace('_', '–').title()})"
        if iron.curve.kind == "steel":
            material = f"steel {iron.curve.name}"
    return f"{material}; {'; '.join(bodies[:4])}{more}"


def _range(values: Iterable[float], digits: int) -> str:
    """Return the value that all have in common, or the smallest and the largest."""
    low, high = np.min(found := np.fromiter(values, float)), np.max(found)
    return f"{low:.{digits}f}" if high - low < 10.0**-digits else (
        f"{low:.{digits}f} to {high:.{digits}f}")
