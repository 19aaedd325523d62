"""Peak memory of processes."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from halbach_fe.solver.getdp import GetDP


@dataclass(frozen=True)
class Weighed:
    """A GetDP whose runs tell their peak memory.

    A process that is started counts what its starter has as its own, which here would be this
    program's, and more than many a GetDP's; so a small one stands in between.
    """

    getdp: GetDP
    record: Path
    """A line of KiB for every run."""

    @classmethod
    def of(cls, getdp: GetDP, folder: Path) -> Weighed:
        """Put what stands in between into a folder."""
        wrapper, record = folder / "weighed-getdp", folder / "memory"
        wrapper.write_text(
            f"#!{sys.executable} -S\nimport resource, subprocess, sys\n"
            f"code = subprocess.call([{str(getdp.executable)!r}, *sys.argv[1:]])\n"
            "peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss\n"
            f"open({str(record)!r}, 'a').write(f'{{peak}}\\n')\nsys.exit(code)\n", encoding="utf-8")
        wrapper.chmod(0o755)
        return cls(replace(getdp, executable=wrapper), record)

    @property
    def peak(self) -> float:
        """Of the largest run so far, in GiB."""
        return max(map(int, self.record.read_text(encoding="utf-8").split())) / 2**20


def own_peak() -> float:
    """Of this process so far, in GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
