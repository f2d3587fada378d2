"""The Snakemake workflow: what it would run, where jobs fail, and the whole chain."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lh5
import numpy as np
import pytest
import yaml
from lgdo import Array, Scalar, Struct, Table, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation.hit_files import read_hits
from synthetic import waveform_table, write_table

pytest.importorskip("snakemake", reason="snakemake is not installed: pip install '.[workflow]'")

WORKFLOW = Path(__file__).parents[2] / "workflow"
BIN = Path(sys.executable).parent

# stands for the command line: notes its words, and writes small outputs at once
PRETENDER = """#!{python}
import json, os, pathlib, sys
words = sys.argv[1:]
if words[0] == "compare":
    os.execv({real!r}, [{real!r}, *words])
with open({calls!r}, "a") as calls:
    calls.write(json.dumps(words) + "\\n")
out = pathlib.Path(words[words.index("--out") + 1])
if words[0] == "train" and os.path.exists({broken!r}) and "V01" in str(out):
    sys.exit("error: no such pulses")
if words[0] in ("train", "validate"):
    out.mkdir()
    iou = dict(iou=dict(ren=80.0, ceiling=85.0), iou_std=dict(ren=2.0, ceiling=2.0))
    metrics = dict(peaks=dict(SEP=dict(parameters=dict(drift_time=iou))))
    (out / "metrics.json").write_text(json.dumps(metrics))
    if words[0] == "train" and "B02" in str(out):  # its fit is bad, it is written all the same
        (out / "run.json").touch()
        sys.exit(1)
elif words[0] != "demo":
    out.write_text("pulses")
"""
ALL = ("-c2", "--show-failed-logs")
DETECTORS = ("V99000A", "B99000A")
ORIGIN_M = {"V99000A": (0.1, 0.0, -0.2), "B99000A": (0.0, -0.1, 0.3)}
SIMULATE = "detectors.V01.simulate"
DEFECTS: dict[str, dict[str, object]] = {
    "train: Additional properties are not allowed ('recipes' was": {"train.recipes": "fast"},
    "needs either simulate or simulations": {"detectors.V01.simulations": None},
    "periods.p03.data: no file matches none/*.lh5": {"periods.p03.data": "none/*.lh5"},
    "detectors.V01.periods: p05 is not in periods": {"detectors.V01.periods": ["p05"]},
    "detectors.V01: library takes its geometry; give simulate": {"library": {"grid_mm": 2}},
    "detectors.B02: no energy, the column in the files of periods.p03.energies": {
        "periods.p03.energies": "raw p03/*.lh5"
    },
}
CHAIN_DEFECTS: dict[str, dict[str, object]] = {
    f"{SIMULATE}.files: calibrate takes one file, with its hits": {
        "calibrate": {},
        f"{SIMULATE}.files": 2,
    },
    f"{SIMULATE}.hits: 2 files, and calibrate takes one": {
        "calibrate": {},
        SIMULATE: {"detector": "icpc", "hits": "stp/*.lh5"},
    },
    "events.dsp: no file none.yaml; give a chain of dspeed, or leave": {
        "events.dsp": "none.yaml"
    },
}


@dataclass(frozen=True)
class Place:
    """A folder to run the workflow in, with a command that only pretends."""

    folder: Path

    def pretend(self) -> None:
        command = self.folder / "bin" / "cpunet"
        command.parent.mkdir()
        command.write_text(
            PRETENDER.format(
                python=sys.executable,
                real=str(BIN / "cpunet"),
                calls=str(self.folder / "calls"),
                broken=str(self.folder / "broken"),
            )
        )
        command.chmod(0o755)

    def configure(self, config: dict[str, Any]) -> None:
        (self.folder / "config.yaml").write_text(yaml.safe_dump(config))

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join([str(self.folder / "bin"), str(BIN), os.environ["PATH"]])
        snakemake = [sys.executable, "-m", "snakemake", "-s", str(WORKFLOW / "Snakefile")]
        return subprocess.run(
            [*snakemake, "--configfile", "config.yaml", *words],
            cwd=self.folder,
            env=os.environ | {"PATH": path},
            # messages of a dry run go to one, those of a run to the other
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=3000,
        )

    def called(self) -> list[list[str]]:
        """What the pretender was called with since the last time."""
        calls = self.folder / "calls"
        lines = calls.read_text().splitlines() if calls.exists() else []
        calls.unlink(missing_ok=True)
        return [json.loads(line) for line in lines]


def two_detectors() -> dict[str, Any]:
    return {
        "results": "all results",
        "periods": {"p03": {"data": "raw {period}/{detector}.lh5"}},
        "detectors": {
            "V01": {"simulations": "sim/*.lh5", "table": "ch1/raw", "energy": "ch1/hit/e"},
            "B02": {
                "simulate": {"detector": "bege", "events": "FEP=3", "seed": 7},
                "kev_per_adc": 0.5,
            },
        },
        "train": {"set": ["training.start_factors=[1.0]"]},
        "validate": {"baselines": False},
    }


@pytest.fixture
def place(tmp_path: Path) -> Place:
    raw = ("raw p03/V01.lh5", "raw p03/B02.lh5", "raw p04/V01.lh5")
    for file in (*raw, "sim/of a.lh5", "stp/one.lh5", "stp/two.lh5"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("pulses")
    made = Place(tmp_path)
    made.configure(two_detectors())
    return made


def planned(place: Place, config: dict[str, Any], *words: str) -> tuple[dict[str, int], str]:
    """Number of jobs by rule of a dry run, and what it prints, in one line."""
    place.configure(config)
    done = place.run("--dry-run", *words)
    assert done.returncode == 0, done.stdout
    table = done.stdout.split("Job stats:")[1]
    jobs = {name: int(n) for name, n in re.findall(r"^(\w+) +(\d+)$", table, re.MULTILINE)}
    return jobs, " ".join(done.stdout.split())


def test_dry_run(place):
    config = two_detectors()
    config["periods"]["p04"] = {"data": "raw*/*.lh5"}
    config["detectors"]["B02"]["simulate"]["files"] = 3
    config["detectors"]["B02"]["periods"] = ["p03"]
    jobs, _ = planned(place, config, "--quiet", "rules")
    assert jobs == {
        "all": 1,
        "warm": 1,
        "fields": 1,
        "simulate": 3,
        "merge_simulation": 1,
        "merge_data": 1,  # of V01 in p04; the others have one file
        "train": 3,
        "translate": 2 + 3,
        "validate": 3,
        "summary": 1,
        "total": 20,
    }
    assert not (place.folder / "all results").exists()


def whole_chain() -> dict[str, Any]:
    """Calibration, libraries and events of two detectors, one of them in one period."""
    config: Any = two_detectors()
    simulate = {"detector": "icpc", "events": "FEP=9"}
    config["detectors"]["V01"] = {"simulate": simulate, "stp": "det001", "table": "ch1/raw"}
    config["periods"]["p04"] = {"data": "raw*/*.lh5"}
    config["detectors"]["B02"]["periods"] = ["p03"]
    config["library"] = {"grid_mm": 2, "make": ["--set=dt_ns=2"]}
    config["library"]["translate"] = ["--detector=V01"]
    config["events"] = {"hits": "stp/*.lh5", "translate": ["--length=2000"], "tau_us": 400}
    del config["train"]["set"]
    return config


@pytest.mark.thorough
def test_a_dry_run_of_libraries_events_and_seeds(place):
    config = whole_chain() | {"seeds": [0, 7]}
    jobs, printed = planned(place, config, "--printshellcmds")
    assert jobs["ideal_library"] == 2  # of the detectors, for all periods
    assert jobs["current_library"] == jobs["train"] == 3
    assert jobs["event_pulses"] == 2 * 2
    assert jobs["event_raw"] == jobs["event_parameters"] == 3 * 2
    assert "calibrate" not in jobs
    made = "'all results/V01/events/pulses/two.lh5'"
    simulated = "cpunet simulate --detector=icpc --hits stp/two.lh5 --hits-detector det001"
    assert f"{simulated} --out {made}" in printed
    assert "--adc --length=2000 --out-table V01/raw --seed 1 --out" in printed
    assert "--table V01/raw --run 'all results/V01/p03/run' --tau-us=400" in printed
    assert "library make --detector=icpc --grid-mm 2 --set=dt_ns=2 --out" in printed
    assert "'all results/V01/library/ideal.lh5' --detector=V01 --out" in printed
    assert jobs["train_seed"] == jobs["validate_seed"] == 3 * 2
    assert jobs["compare_seeds"] == 3  # one for each detector and period
    seeds = "'all results/V01/p03/seeds/"
    assert re.search(rf"--seed=7 [^|]*--out {seeds}7/run'", printed)
    assert f"cpunet validate {seeds}7/run'" in printed
    assert f"cpunet compare {seeds}0/report' {seeds}7/report' --out" in printed


@pytest.mark.thorough
def test_a_dry_run_with_calibrations(place):
    prior = ["depletion_voltage=2100±50"]
    calibrate = {"free": "temperature", "prior": prior, "events": 500}
    config = whole_chain() | {"calibrate": calibrate}
    jobs, printed = planned(place, config, "--printshellcmds")
    assert "train" not in jobs
    assert jobs["calibrate"] == jobs["ideal_library"] == 3  # physics are those of a period
    assert jobs["event_pulses"] == 3 * 2
    words = "--free=temperature '--prior=depletion_voltage=2100±50' --events=500"
    assert words in printed.replace("--prior='depletion", "'--prior=depletion")
    run = "'all results/V01/p03/run/"
    assert f"--detector={run}detector.yaml' --set={run}settings.yaml' --hits" in printed
    assert f"library make --detector={run}detector.yaml' --grid-mm 2" in printed
    assert "--data-table=ch1/raw" in printed


def words_of(calls: list[list[str]], command: str, detector: str) -> list[str]:
    (words,) = [c for c in calls if c[0] == command and f"/{detector}/" in " ".join(c)]
    return words


@pytest.mark.slow
def test_a_failure_stops_no_other_detector(place):
    place.pretend()
    (place.folder / "broken").touch()
    done = place.run("-c2", "--keep-going", "--show-failed-logs")
    assert done.returncode != 0
    assert "error: no such pulses" in done.stdout
    calls = place.called()
    commands = [call[0] for call in calls]
    assert commands[0] == "demo"
    expected = ["demo", "info", "simulate", "train", "train", "translate", "validate"]
    assert sorted(commands) == expected
    simulated = words_of(calls, "simulate", "B02")
    assert {"--detector=bege", "--events=FEP=3", "--seed=7"} <= set(simulated)
    train = words_of(calls, "train", "V01")
    assert {"--data-table=ch1/raw", "--data-energy=ch1/hit/e"} <= set(train)
    assert {"--set=training.start_factors=[1.0]", "--recipe=fast", "--peak=FEP"} <= set(train)
    assert train[train.index("--sim") + 1] == "sim/of a.lh5"
    assert train[train.index("--data") + 1] == "raw p03/V01.lh5"
    assert "--kev-per-adc=0.5" in words_of(calls, "train", "B02")
    assert "--no-baselines" in words_of(calls, "validate", "B02")
    results = place.folder / "all results"
    assert (results / "B02" / "p03" / "report" / "metrics.json").is_file()
    assert not (results / "index.html").exists()

    done = place.run("-c1", "so_far")
    assert done.returncode == 0, done.stdout
    page = (results / "so_far.html").read_text()
    assert "<strong>No report:</strong> V01." in page

    # what was done is not done again
    (place.folder / "broken").unlink()
    done = place.run("-c2")
    assert done.returncode == 0, done.stdout
    assert sorted(call[0] for call in place.called()) == ["train", "translate", "validate"]
    assert "2 of 2 reports" in (results / "index.html").read_text()
    logged = {p.name for p in (results / "V01" / "p03" / "logs").iterdir()}
    assert logged == {"train.log", "translate-of a.log", "validate.log"}
    measured = {p.name for p in (results / "V01" / "p03" / "benchmarks").iterdir()}
    assert measured == {"train.tsv", "translate-of a.tsv", "validate.tsv"}

    assert "Nothing to be done" in place.run("-c1", "--dry-run").stdout


# each starts snakemake
@pytest.mark.parametrize(
    "words",
    [
        next(iter(DEFECTS)),
        *(pytest.param(words, marks=pytest.mark.slow) for words in [*DEFECTS][1:]),
        *(pytest.param(words, marks=pytest.mark.thorough) for words in CHAIN_DEFECTS),
    ],
)
def test_a_defect_of_the_configuration_is_one_line(place, words):
    config = whole_chain() if words in CHAIN_DEFECTS else two_detectors()
    for path, value in (DEFECTS | CHAIN_DEFECTS)[words].items():
        *folders, name = path.split(".")
        entry = config
        for folder in folders:
            entry = entry[folder]
        entry[name] = value
        if value is None:
            del entry[name]
    place.configure(config)
    done = place.run("--dry-run")
    assert done.returncode == 1
    assert "Traceback" not in done.stdout
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("configuration"))
    assert words in line


def test_the_example_is_valid():
    import jsonschema

    schema = yaml.safe_load((WORKFLOW / "config" / "schema.yaml").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    example = yaml.safe_load((WORKFLOW / "config" / "example.yaml").read_text())
    jsonschema.Draft202012Validator(schema).validate(example)


def write_raw(path: Path, first: int, n: int) -> None:
    """Traces of channel 1 in an LH5 file, and energies as in a hit tier in another."""
    values = np.arange(n * 8, dtype=np.uint16).reshape(n, 8) + first
    write_table(path, "ch1/raw", waveform_table(values, samples="ADC"), event=np.arange(n))
    write_table(path.with_name(f"hit-{path.name}"), "ch1/hit", kev=first + np.arange(float(n)))


def script(name: str) -> Any:
    """What a script of the workflow defines."""
    return runpy.run_path(str(WORKFLOW / "scripts" / f"{name}.py"))


def test_files_are_merged_in_order(tmp_path):
    files = [tmp_path / "a.lh5", tmp_path / "b.lh5"]
    write_raw(files[0], 1000, 3)
    write_raw(files[1], 2000, 2)
    out = tmp_path / "merged.lh5"
    energies = [f"{file.with_name(f'hit-{file.name}')}:ch1/hit/energy" for file in files]
    made = script("merge")["merge"](out, files, "geds/raw", table="ch1/raw", energies=energies)
    assert made == 5
    merged = lh5.read("geds/raw", str(out))
    assert merged["energy"].nda.tolist() == [1000, 1001, 1002, 2000, 2001]
    assert merged["energy"].attrs["units"] == "keV"
    assert merged["waveform"].values.nda[:, 0].tolist() == [1000, 1008, 1016, 2000, 2008]
    assert set(merged["waveform"].dt.nda) == {16.0}


@pytest.mark.thorough
def test_files_that_do_not_belong_together_are_one_line(tmp_path):
    write_raw(tmp_path / "a.lh5", 0, 3)
    (tmp_path / "b.lh5").write_text("no pulses")
    script = [sys.executable, str(WORKFLOW / "scripts" / "merge.py")]
    words = [str(tmp_path / "out.lh5"), "--made-table", "geds/raw", "--files"]
    files = map(str, sorted(tmp_path.glob("?.lh5")))
    done = subprocess.run([*script, *words, *files], capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {tmp_path / 'b.lh5'}: ")
    assert not (tmp_path / "out.lh5").exists()


def write_steps(path: Path, sims: dict[str, Path], events: slice) -> dict[str, Any]:
    """Hits of simulations as remage writes steps, each detector at a place of its own."""
    by_detector: dict[str, Any] = {}
    for name, sim in sims.items():
        hits = read_hits(sim)[events]
        by_detector[name] = hits
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
    return by_detector


def configuration(metadata: Path) -> dict[str, Any]:
    return {
        "periods": {"p03": {"data": "stands/{detector}/data*.lh5"}},
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
        "library": {"grid_mm": 8},
        "events": {"hits": "stp/*.lh5"},
        "validate": {"baselines": False},
        "seeds": [1, 2],
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
    first = tmp_path / "stands" / DETECTORS[0]
    shutil.copy(first / "data.lh5", first / "data_again.lh5")
    sims = {name: tmp_path / "stands" / name / "sim.lh5" for name in DETECTORS}
    (tmp_path / "stp").mkdir()
    parts = {"one": slice(0, 30), "two": slice(30, 70)}.items()
    steps = tmp_path / "stp"
    given = {part: write_steps(steps / f"{part}.lh5", sims, events) for part, events in parts}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(configuration(metadata)))
    done = Place(tmp_path).run(*ALL)
    assert done.returncode == 0, done.stdout
    results = tmp_path / "results"
    page = (results / "index.html").read_text()
    assert "2 of 2 reports" in page
    for name in DETECTORS:
        folder = results / name / "p03"
        assert f'href="{name}/p03/report/report.html"' in page
        calibration = json.loads((folder / "run" / "calibration.json").read_text())
        assert "temperature_K" in {**calibration["parameters"], **calibration["fixed"]}
        assert not (folder / "data.lh5").exists()  # merged for the time being
        assert "median ± std" in (folder / "seeds.html").read_text()
        assert (folder / "library" / "current.lh5").is_file()
        for part, hits in given.items():
            require_parameters(folder / "events", name, part, hits[name])
    assert "Nothing to be done" in Place(tmp_path).run(*ALL).stdout
    # what was lost is made again, and nothing else
    for tier in ("raw", "dsp"):
        (results / "V99000A" / "p03" / "events" / tier / "two.lh5").unlink()
    printed = Place(tmp_path).run(*ALL, "parameters").stdout
    made = re.findall(r"^(?:local)?rule (\w+):", printed, re.MULTILINE)
    assert sorted({*made} - {"parameters"}) == ["event_parameters", "event_raw"]
    assert len(made) <= 3


def require_parameters(folder: Path, name: str, part: str, hits: Any) -> None:
    """One row for each event that gave a signal, energies in proportion to the deposits."""
    raw = lh5.read(f"{name}/raw", str(folder / "raw" / f"{part}.lh5"))
    table = lh5.read(f"{name}/dsp", str(folder / "dsp" / f"{part}.lh5"))
    numbers = table["event_number"].nda
    assert numbers.tolist() == raw["event_number"].nda.tolist()
    assert set(numbers) <= set(hits.event_number)
    assert len(numbers) > 0.7 * len(hits)
    good = (table["rejection"].nda == 0) & (table["energy"].nda > 300)
    assert good.sum() > 0.5 * len(hits)
    gain = table["trapEmax"].nda[good] / table["energy"].nda[good]
    assert np.std(gain) < 0.01 * np.mean(gain)
    assert np.isfinite(table["AoE"].nda[good]).all()
    rise = table["tp_99"].nda[good] - table["tp_01"].nda[good]
    assert (rise > 0).all()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("none.yaml", None, "none.yaml: no such file"),
        ("bad.yaml", "a: [", "bad.yaml: not YAML"),
        ("bad.yaml", "outputs: [a]", "bad.yaml: no chain of dspeed; give outputs and"),
        ("good.yaml", "outputs: []\nprocessors: {}", "or give events.tau_us"),
    ],
)
def test_what_keeps_dspeed_from_running_is_one_line(tmp_path, name, text, words):
    if text is not None:
        (tmp_path / name).write_text(text)
    given = [tmp_path / "raw.lh5", tmp_path / "out.lh5", tmp_path / name, "V01/raw"]
    with pytest.raises(CpunetError, match=words):
        script("dsp")["run_chain"](*given, tmp_path / "no run")


def test_a_chain_that_does_not_fit_the_traces(tmp_path):
    chain = yaml.safe_load((WORKFLOW / "config" / "dsp.yaml").read_text())
    # of it, what is quickly compiled
    few = {"wf_blsub": chain["processors"]["wf_blsub"] | {"args": ["waveform", "nothing"]}}
    (tmp_path / "dsp.yaml").write_text(yaml.safe_dump({"outputs": [], "processors": few}))
    given = [tmp_path / "raw.lh5", tmp_path / "out.lh5", tmp_path / "dsp.yaml", "V01/raw"]
    with pytest.raises(CpunetError, match=r"fails on V01/raw .*do its times fit the traces"):
        script("dsp")["run_chain"](*given, tmp_path / "no run", tau_us=400.0)
    assert not (tmp_path / "out.lh5").exists()
