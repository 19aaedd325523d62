"""List what is kept of GetDP's answers, or clear it.

Every answer of GetDP is kept, by all that it depends on, and the next run that asks the same takes
it from there. The folder is --cache, or $HALBACH_FE_CACHE, or ~/.cache/halbach-fe; it grows to
$HALBACH_FE_CACHE_LIMIT_GIB (20 GiB; 0 keeps nothing), and then loses what was not used for longest.
"""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.solver.getdp_cache import default_cache

ROWS = 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("what", choices=("ls", "clear"), help="list it, or remove everything")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="another folder")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """List or clear."""
    cache = default_cache(arguments.cache)
    if cache is None:
        common.say("No cache is kept: its limit is 0, or there is no home.")
        if arguments.json:
            common.print_json({"folder": None, "limit_bytes": 0, "bytes": 0, "entries": []})
        return 0
    entries = cache.entries()
    if arguments.what == "clear":
        cache.clear()
        common.say(f"Removed {len(entries)} entries from {cache.folder}.")
        return 0
    total = sum(one.bytes for one in entries)
    if arguments.json:
        common.print_json({
            "folder": str(cache.folder), "limit_bytes": int(cache.limit_bytes), "bytes": total,
            "entries": [{
                "name": one.folder.name, "bytes": one.bytes,
                "used": datetime.fromtimestamp(one.used).isoformat(timespec="seconds"),
                **({} if (found := one.manifest) is None else found.model_dump(exclude={"files"})),
            } for one in entries]})
        return 0
    common.print_table([{
        "used": datetime.fromtimestamp(one.used).isoformat(" ", "seconds"),
        "problem": found.problem if (found := one.manifest) else "damaged",
        "unknowns": str(found.unknowns or "") if found else "",
        "solves": str(found.solves) if found else "",
        "MiB": f"{one.bytes / 2**20:.1f}"} for one in entries[:ROWS]], "Used last")
    common.say(f"{len(entries)} entries, {total / 2**30:.2f} of {cache.limit_bytes / 2**30:g} GiB, "
               f"in {cache.folder}")
    return 0
