"""Write ``requirements.lock``: the packages of ``make install``, with digests of their files.

Run with ``make lock`` after a change of ``constraints.txt``.  The digests are of the files for
this Python and this system; ``make install-locked`` installs only these files.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

HEAD = """\
# What make install brings, by version and SHA-256, for {python} on {system}.
# Written by make lock, of constraints.txt; installed by make install-locked.  The digests are
# those of the registry that it was written with; torch for CPUs has an index of its own
# (--extra-index-url https://download.pytorch.org/whl/cpu).
"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        words = ["install", "--quiet", "--dry-run", "--ignore-installed", "--report", report]
        words += ["-c", "constraints.txt", "."]
        subprocess.run([sys.executable, "-m", "pip", *map(str, words)], check=True)
        packages = json.loads(report.read_text())["install"]
    lines = []
    for item in packages:
        digest = item["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        if digest is not None:  # this package itself has none
            name, version = item["metadata"]["name"], item["metadata"]["version"]
            lines.append(f"{name.lower()}=={version} --hash=sha256:{digest}\n")
    python = (
        f"{platform.python_implementation()} {'.'.join(platform.python_version_tuple()[:2])}"
    )
    system = f"{platform.system()} {platform.machine()}"
    head = HEAD.format(python=python, system=system)
    Path("requirements.lock").write_text(head + "".join(sorted(lines)))


if __name__ == "__main__":
    main()
