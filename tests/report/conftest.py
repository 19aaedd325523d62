"""A browser for tests of pages."""

from __future__ import annotations

import shutil

import pytest

PATIENCE_MS = 300_000
"""Time for a page to be shown, on a machine that has other work too."""


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium")
    if path is None:
        pytest.skip("no chromium here")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=[
            "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader"])
        yield browser
        browser.close()
