"""List the cache of GetDP's answers, or clear it.

Every answer of GetDP is kept in the cache together with a digest of all inputs on which it depends.
A run with the same inputs reads the answer from the cache instead of solving again. The folder is
--cache, or $HALBACH_FE_CACHE, or ~/.cache/halbach-fe. It grows to $HALBACH_FE_CACHE_LIMIT_GIB
(default: 20 GiB; 0 switches the cache off); then the entries that were not used for the longest
time are removed.
"""

from __future__ import annotations

import argparse
from datetime import datetime

from halbach_fe.cli import common
from halbach_fe.solver.getdp_cache import default_cache

ROWS = 30
"""Largest number of entries that are listed as a table."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("what", choices=("ls", "clear"), metavar="{ls,clear}",
                        help="list the entries, or remove all of them")
    parser.add_argument("--cache", type=common.path, metavar="DIR",
                        help="folder of the cache (default: $HALBACH_FE_CACHE, then "
                        "~/.cache/halbach-fe)")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """List the entries of the cache, or clear it."""
    cache = default_cache(arguments.cache)
    if cache is None:
        common.say("There is no cache: its limit is 0, or there is no home folder.")
        if arguments.json:
            common.print_json({"folder": None, "limit_bytes": 0, "bytes": 0, "entries": []})
        return 0
    entries = cache.entries()
    if arguments.what == "clear":
        cache.clear()
        common.say(f"Removed {len(entries)} entries from {cache.folder}.")
        return 0
    total = sum(entry.bytes for entry in entries)
    if arguments.json:
        common.print_json({
            "folder": str(cache.folder), "limit_bytes": int(cache.limit_bytes), "bytes": total,
            "entries": [{
                "name": entry.folder.name, "bytes": entry.bytes,
                "used": datetime.fromtimestamp(entry.used).isoformat(timespec="seconds"),
                **({} if (manifest := entry.manifest) is None
                   else manifest.model_dump(exclude={"files"})),
            } for entry in entries]})
        return 0
    common.print_table([{
        "used": datetime.fromtimestamp(entry.used).isoformat(" ", "seconds"),
        "problem": manifest.problem if (manifest := entry.manifest) else "damaged",
        "unknowns": str(manifest.unknowns or "") if manifest else "",
        "solves": str(manifest.solves) if manifest else "",
        "MiB": f"{entry.bytes / 2**20:.1f}"} for entry in entries[:ROWS]], "Most recently used")
    common.say(f"{len(entries)} entries, {total / 2**30:.2f} of {cache.limit_bytes / 2**30:g} GiB, "
               f"in {cache.folder}")
    return 0
