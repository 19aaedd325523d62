"""Guided by coverage: ``python -m tests.fuzz.guided NAME SECONDS``, with atheris installed.

What is new in how a file was read makes it a seed of others. Both end up in ``build/fuzz``: files
that break a promise (``crash-...``), where it stops, and the seeds found.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from random import Random

import atheris

with atheris.instrument_imports(include=["halbach_fe", "tomllib", "tomlkit", "meshio", "h5netcdf"]):
    from tests.fuzz.contract import refusal
    from tests.fuzz.mutation import MAX_SIZE, damaged
    from tests.fuzz.readers import by_name

KEPT = Path("build", "fuzz")


def main() -> None:
    """Fuzz one reader for some seconds; does not return."""
    reader = by_name(sys.argv[1])
    corpus = KEPT / f"{reader.name} seeds".replace(" ", "-")
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(reader.seeds):
        (corpus / f"seed-{number}").write_bytes(seed)
    folder = Path(tempfile.mkdtemp(), "folder")
    folder.mkdir()

    def one(content: bytes) -> None:
        refusal(reader, content, folder)

    def changed(content: bytes, longest: int, number: int) -> bytes:
        return damaged([content or reader.seeds[0], *reader.seeds[:1]], reader.tokens,
                       Random(number))[:longest]

    atheris.Setup([sys.argv[0], f"-max_total_time={sys.argv[2]}", f"-max_len={MAX_SIZE}",
                   "-timeout=0", "-rss_limit_mb=4000", f"-artifact_prefix={KEPT}/", str(corpus)],
                  one, custom_mutator=changed)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
