"""The whole chain for two detectors of LEGEND's public test data, as production runs it."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import lh5
import numpy as np
import pytest
import yaml
from lgdo import Array, Scalar, Struct, Table, VectorOfVectors

from cpunet.simulation.hit_files import read_hits

pytest.importorskip("snakemake", reason="snakemake is not installed: pip install '.[workflow]'")

WORKFLOW = Path(__file__).parents[2] / "workflow"
BIN = Path(sys.executable).parent
DETECTORS = ("V99000A", "B99000A")
ORIGIN_M = {"V99000A": (0.1, 0.0, -0.2), "B99000A": (0.0, -0.1, 0.3)}


def write_steps(path: Path, sims: dict[str, Path], events: slice) -> dict[str, Any]:
    """Hits of simulations as remage writes steps, each detector at a place of its own."""
    kept: dict[str, Any] = {}
    for name, sim in sims.items():
        hits = read_hits(sim)[events]
        kept[name] = hits
        origin = ORIGIN_M[name]
        steps = {
            "xloc": (1e-3 * hits.x_mm + origin[0], "m"),
            "yloc": (1e-3 * hits.y_mm + origin[1], "m"),
            "zloc": (1e-3 * hits.z_mm + origin[2], "m"),
            "edep": (hits.edep_kev, "keV"),
        }
        table = Table({"evtid": Array(hits.event_number)})
        for column, (values, unit) in steps.items():
            vectors = VectorOfVectors(
                flattened_data=Array(values, attrs={"units": unit}),
                cumulative_length=Array(hits.offsets[1:]),
            )
            table.add_field(column, vectors)
        lh5.write(table, name, str(path), group="stp", wo_mode="append")
        places = {
            f"{axis}loc": Scalar(value, attrs={"units": "m"})
            for axis, value in zip("xyz", origin, strict=True)
        }
        lh5.write(Struct(places), name, str(path), group="detector_origins", wo_mode="append")
    return kept


def snakemake(folder: Path, *words: str) -> str:
    command = [sys.executable, "-m", "snakemake", "-s", str(WORKFLOW / "Snakefile")]
    done = subprocess.run(
        [*command, "--configfile", "config.yaml", "-c2", "--show-failed-logs", *words],
        cwd=folder,
        env=os.environ | {"PATH": os.pathsep.join([str(BIN), os.environ["PATH"]])},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=3000,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def configuration(metadata: Path) -> dict[str, Any]:
    return {
        "periods": {"p03": {"data": "stands/{detector}/data.lh5"}},
        "detectors": {
            name: {
                "simulate": {
                    "detector": str(metadata / "diodes" / f"{name}.yaml"),
                    "hits": "stands/{detector}/sim.lh5",
                    "set": ["temperature_K=90"],
                }
            }
            for name in DETECTORS
        },
        "calibrate": {"free": "temperature", "events": 300},
        "library": {
            "grid_mm": 8,
            "make": ["--angles=0,45"],
        },
        "events": {"hits": "stp/*.lh5"},
        "validate": {"baselines": False},
    }


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_two_detectors_end_to_end(reference_data, tmp_path):
    metadata = reference_data / "legend-metadata"
    for seed, name in enumerate(DETECTORS):
        words = [BIN / "cpunet", "stand", "--preset", "legend200", "--seed", seed]
        words += ["--detector", metadata / "diodes" / f"{name}.yaml", "--set"]
        words += ["temperature_K=90", "--events", "FEP=400,SEP=60,DEP=60"]
        words += ["--out", tmp_path / "stands" / name]
        subprocess.run([str(word) for word in words], check=True, capture_output=True)
    sims = {name: tmp_path / "stands" / name / "sim.lh5" for name in DETECTORS}
    (tmp_path / "stp").mkdir()
    given = {
        part: write_steps(tmp_path / "stp" / f"{part}.lh5", sims, events)
        for part, events in {"one": slice(0, 30), "two": slice(30, 70)}.items()
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(configuration(metadata)))
    snakemake(tmp_path)
    results = tmp_path / "results"
    page = (results / "index.html").read_text()
    assert "2 of 2 reports" in page
    for name in DETECTORS:
        folder = results / name / "p03"
        assert f'href="{name}/p03/report/report.html"' in page
        told = json.loads((folder / "run" / "calibration.json").read_text())
        assert "temperature_K" in {**told["parameters"], **told["fixed"]}
        require_library(folder / "library" / "current.lh5", name)
        for part, hits in given.items():
            require_parameters(folder / "events", name, part, hits[name])
    assert "Nothing to be done" in snakemake(tmp_path)
    require_resumed(tmp_path, results)


def require_library(file: Path, name: str) -> None:
    """As reboost reads it."""
    utils = pytest.importorskip("reboost.hpge.utils")
    for angle in (0, 45):
        found = utils.load_hpge_pulse_shape_library(
            str(file), name, f"waveform_{angle:03d}_deg"
        )
        there = np.isfinite(found.waveforms).all(axis=2)
        assert there.any()
        highest = found.t[found.waveforms[there].argmax(axis=1)]
        assert (highest == 0).all()  # currents, aligned


def require_parameters(folder: Path, name: str, part: str, hits: Any) -> None:
    """One row for each event that gave a signal, energies in proportion to the deposits."""
    raw = lh5.read(f"{name}/raw", str(folder / "raw" / f"{part}.lh5"))
    found = lh5.read(f"{name}/dsp", str(folder / "dsp" / f"{part}.lh5"))
    numbers = found["event_number"].nda
    assert numbers.tolist() == raw["event_number"].nda.tolist()
    assert set(numbers) <= set(hits.event_number)
    assert len(numbers) > 0.7 * hits.n_events
    good = (found["rejection"].nda == 0) & (found["energy"].nda > 300)
    assert good.sum() > 0.5 * hits.n_events
    gain = found["trapEmax"].nda[good] / found["energy"].nda[good]
    assert np.std(gain) < 0.01 * np.mean(gain)
    assert np.isfinite(found["AoE"].nda[good]).all()
    rise = found["tp_99"].nda[good] - found["tp_01"].nda[good]
    assert (rise > 0).all()


def require_resumed(folder: Path, results: Path) -> None:
    """What was lost is made again, and nothing else."""
    (results / "V99000A" / "p03" / "events" / "raw" / "two.lh5").unlink()
    (results / "V99000A" / "p03" / "events" / "dsp" / "two.lh5").unlink()
    told = snakemake(folder, "parameters")
    made = re.findall(r"^(?:local)?rule (\w+):", told, re.MULTILINE)
    assert sorted({*made} - {"parameters"}) == ["event_parameters", "event_raw"]
    assert len(made) <= 3


def dsp_script() -> Any:
    spec = importlib.util.spec_from_file_location("dsp", WORKFLOW / "scripts" / "dsp.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


DEFECTS = {
    "no file": ("none.yaml", None, "none.yaml: no such file"),
    "no YAML": ("bad.yaml", "a: [", "bad.yaml: not YAML"),
    "no chain": ("bad.yaml", "outputs: [a]", "bad.yaml: no chain of dspeed; give outputs and"),
    "no decay": ("good.yaml", "outputs: []\nprocessors: {}", "or give events.tau_us"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_what_keeps_dspeed_from_running_is_one_line(tmp_path, defect):
    name, text, words = DEFECTS[defect]
    if text is not None:
        (tmp_path / name).write_text(text)
    given = [tmp_path / "raw.lh5", tmp_path / "out.lh5", tmp_path / name, "V01/raw"]
    with pytest.raises(Exception, match=words) as error:
        dsp_script().run_chain(*given, tmp_path / "no run")
    assert "\n" not in str(error.value)


def test_a_chain_that_does_not_fit_the_traces(tmp_path):
    shutil.copy(WORKFLOW / "config" / "dsp.yaml", tmp_path / "dsp.yaml")
    chain = yaml.safe_load((tmp_path / "dsp.yaml").read_text())
    # of it, what is quickly compiled
    few = {key: chain["processors"][key] for key in ("wf_blsub",)}
    few["wf_blsub"]["args"] = ["waveform", "nothing", "wf_blsub"]
    (tmp_path / "dsp.yaml").write_text(yaml.safe_dump({"outputs": [], "processors": few}))
    given = [tmp_path / "raw.lh5", tmp_path / "out.lh5", tmp_path / "dsp.yaml", "V01/raw"]
    with pytest.raises(Exception, match=r"fails on V01/raw .*do its times fit the traces"):
        dsp_script().run_chain(*given, tmp_path / "no run", tau_us=400.0)
    assert not (tmp_path / "out.lh5").exists()
