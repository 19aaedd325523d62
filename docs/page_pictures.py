"""Take the pictures of result pages that the gallery shows, with Chromium.

The pages are those that `make study-quadrupole` and others write; what is not there is left out::

    python docs/page_pictures.py [RESULTS] [FOLDER]      # default: results, docs/_static/pages
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

DOCS = Path(__file__).parent

PAGES = {"quadrupole": "quadrupole/diagnosis/diagnosis.html", "faser": "faser/report.html",
         "mri": "mri/report.html", "emphatic": "emphatic/measured.html"}
"""The page of a study that says most, by the name of the study."""

SIZE_PX = 1000, 1200
"""Width and height of what is shown: the answer, and what follows it."""

COLOURS = 128
"""Number of colours of a picture, for a small file."""

BROWSERS = "chromium", "chromium-browser", "google-chrome"


def main(results: Path, folder: Path) -> None:
    """Write one PNG per page that is there."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"Pages are drawn by one of {', '.join(BROWSERS)}: install one of them.")
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        if (results / page).exists():
            target = folder / f"{name}.png"
            picture(browser, results / page, target)
            print(f"{target}: {target.stat().st_size / 1024:.0f} kB")  # noqa: T201


def picture(browser: str, page: Path, target: Path) -> None:
    """Draw the top of a page into a PNG file."""
    with TemporaryDirectory() as profile:
        drawn = Path(profile) / "page.png"
        subprocess.run([
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--disable-background-networking", f"--user-data-dir={profile}",
            f"--window-size={SIZE_PX[0]},{SIZE_PX[1]}", f"--screenshot={drawn}",
            page.resolve().as_uri()], check=True, capture_output=True, timeout=300)
        with Image.open(drawn) as image:
            image.convert("RGB").quantize(COLOURS).save(target, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3] + ["results", DOCS / "_static" / "pages"][len(sys.argv[1:3]):]))
