"""Check types by mypy, under the names that the modules have once they are installed.

geo, pro and cli lie at the top of the checkout and are installed as halbach_fe.geo, .pro and .cli
(`package-dir` in pyproject.toml). mypy derives names of modules from folders; here it is given
them.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

from mypy import build, main

ROOT = Path(__file__).resolve().parent.parent
OTHERS = ("benchmarks", "tests")
"""Packages that are not installed. Of the tests only names are followed, see pyproject.toml."""
SCRIPTS = ("studies/*_page.py", "studies/*/*_page.py", "studies/calibration/truth_ranks.py",
           "studies/diagnosis/drawn_studies.py", "studies/diagnosis/stated_probabilities.py",
           "docs/paper_figures.py")
"""Modules that the studies and the documentation import, and tests by these names."""


def sources() -> list[build.BuildSource]:
    """Every module with its name."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    folders = settings["tool"]["setuptools"]["package-dir"]
    folders |= {name: name for name in OTHERS}
    found = []
    for package, folder in folders.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            name = ".".join([package, *parts]).removesuffix(".__init__")
            found.append(build.BuildSource(str(path.relative_to(ROOT)), name))
    scripts = [path.relative_to(ROOT) for pattern in SCRIPTS
               for path in sorted(ROOT.glob(pattern))]
    return found + [build.BuildSource(str(path), ".".join(path.with_suffix("").parts))
                    for path in scripts]


def check() -> int:
    """Print what mypy finds; return the exit code."""
    _, options = main.process_options(["--config-file", "pyproject.toml", "-c", "pass"])
    result = build.build(sources(), options)
    sys.stdout.write("\n".join([*result.errors, f"types: {len(result.errors)} errors\n"]))
    return 1 if result.errors else 0


if __name__ == "__main__":
    sys.exit(check())
