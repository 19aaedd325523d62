"""The long run: ``python -m tests.fuzz [--seconds S] [--reader NAME] [--seed N]``.

Every reader has a process of its own, with little memory, so that one that crashes, hangs or asks
for the whole machine is found too. What breaks a promise is kept in ``build/fuzz``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

from tests.fuzz.contract import TIME_LIMIT_S, BrokenError, Reader, refusal
from tests.fuzz.mutation import made
from tests.fuzz.readers import readers

MEMORY = 1 << 31
"""Bytes that a reader may take beside what the program itself has."""

KEPT = Path("build", "fuzz")


def numbered(reader: Reader, seed: int, number: int) -> bytes:
    """The input of a number; the same in every run with a seed."""
    return made(reader, Random(f"{reader.name} {seed} {number}"))


def work(reader: Reader, seed: int, first: int, seconds: float, tell: Connection) -> None:
    """Read one input after another; tell number and outcome of each."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above, "folder")
        folder.mkdir()
        number = first
        while time.monotonic() < end:
            tell.send((number, "begun"))
            try:
                said = refusal(reader, numbered(reader, seed, number), folder)
                tell.send((number, "refused" if said else "read"))
            except BrokenError as error:
                tell.send((number, error))
            number += 1
        tell.send((number, "end"))


def fuzz(reader: Reader, seed: int, seconds: float) -> tuple[dict[str, int], dict[str, int]]:
    """Outcomes, and defects with the first input that shows each."""
    counts = {"read": 0, "refused": 0}
    defects: dict[str, int] = {}
    first, end = 0, time.monotonic() + seconds

    def defect(kind: str, number: int, detail: str = "") -> None:
        counts[kind] = counts.get(kind, 0) + 1
        if kind not in defects:
            defects[kind] = number
            KEPT.mkdir(parents=True, exist_ok=True)
            name = f"{reader.name} {seed} {number}".replace(" ", "-")
            (KEPT / name).write_bytes(numbered(reader, seed, number))
            sys.stderr.write(f"{reader.name}, input {number}: {kind}\n{detail}\n")

    while time.monotonic() < end:
        hear, tell = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(
            target=work, args=(reader, seed, first, end - time.monotonic(), tell))
        process.start()
        tell.close()
        number, said = first, "begun"
        try:
            while said != "end":
                if not hear.poll(3 * TIME_LIMIT_S):
                    process.kill()
                    said = "hangs"
                    break
                number, said = hear.recv()
                if isinstance(said, BrokenError):
                    defect(said.kind, number, str(said))
                elif said in counts:
                    counts[said] += 1
        except EOFError:
            said = "crashes"
        process.join()
        if said != "end":
            kind = said if said == "hangs" else f"crashes ({process.exitcode})"
            defect(kind, number)
        first = number + 1
    return counts, defects


def main() -> int:
    """Fuzz all readers, or those that are named; return 1 if a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader")
    parser.add_argument("--reader", action="append", help="its name, or how it begins")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    broken = 0
    for reader in readers():
        if arguments.reader and not reader.name.startswith(tuple(arguments.reader)):
            continue
        counts, defects = fuzz(reader, arguments.seed, arguments.seconds)
        broken += len(defects)
        print(f"{reader.name}: {sum(counts.values())} inputs, {counts}", flush=True)  # noqa: T201
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
