"""Readouts need no torch; networks say what they need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from synthetic import write_chain

PROGRAM = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from cpunet.cli import main
for words in sys.argv[1:]:
    sys.argv[1:] = words.split()
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""


def without_torch(*commands: str) -> subprocess.CompletedProcess[str]:
    """Run commands where torch cannot be imported."""
    words = [sys.executable, "-W", "error", "-c", PROGRAM, *commands]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def test_a_readout_is_used_without_torch(tmp_path: Path, stand):
    run, outs = write_chain(tmp_path / "run", noise_kev=2), [tmp_path / n for n in "abc"]
    done = without_torch(
        f"translate {run} {stand.sim} --seed 1 --out {outs[0]}",
        f"response {run} --out {outs[1]}",
        f"export onnx {run} {outs[2]}",
    )
    assert done.returncode == 0, done.stderr
    assert all(out.exists() for out in outs)


def test_what_networks_need_is_named(tmp_path: Path, stand):
    done = without_torch(
        f"train {' '.join(stand.inputs)} --recipe paper --out {tmp_path / 'run'}"
    )
    said = "error: networks need torch, which is not installed; pip install 'cpunet-hpge["
    assert done.stderr.splitlines()[-1] == f"{said}networks]'"
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_a_quick_demo_needs_no_torch_and_says_what_it_is(tmp_path: Path):
    done = without_torch(f"demo --quick --out {tmp_path / 'demo'}")
    assert done.returncode == 0, done.stderr
    report = tmp_path / "demo" / "report"
    drawn = {path.stem for path in report.glob("*.svg")}
    assert drawn == {"SEP_mean_pulse", "SEP_current_amplitude", "SEP_single_pulse"}
    page = (report / "report.html").read_text()
    assert "This is a quick look" in page
    assert all(peak in page for peak in ("FEP", "SEP", "DEP"))
