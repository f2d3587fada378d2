"""A headless browser for tests of pages: found on the machine, or the test skips."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
ATTEMPTS = 2  # a browser may fail to start, a page that fails does so twice
PATIENCE_S = 240  # a browser's start is slow where all cores are busy


def browser() -> str:
    """Path of a Chromium; the test skips without one."""
    named = os.environ.get("CPUNET_CHROMIUM")
    found = shutil.which(named) if named else next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is there; or set CPUNET_CHROMIUM")
    return found


def run_page(page: Path, width: int = 1280, height: int = 900) -> tuple[dict[str, Any], str]:
    """Open a page, and return what it wrote into ``<pre id="selftest">``, and the log."""
    for _ in range(ATTEMPTS):
        dom, log = _opened(page, width, height)
        found = re.search(r'<pre id="selftest"[^>]*>(.*?)</pre>', dom, re.DOTALL)
        if found:
            return json.loads(html.unescape(found[1])), log
    raise AssertionError(f"the page did not report:\n{dom[-500:]}\n{log[-2000:]}")


def _opened(page: Path, width: int, height: int) -> tuple[str, str]:
    """Return the page's DOM after a while, and the browser's log."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        done = subprocess.run(
            [
                browser(),
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-dev-shm-usage",
                "--enable-logging=stderr",
                f"--user-data-dir={profile}",
                f"--window-size={width},{height}",
                "--virtual-time-budget=10000",
                "--dump-dom",
                page.resolve().as_uri(),
            ],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    return done.stdout, done.stderr
