"""The functions of the package and what they give, from files to scores; the demonstration."""

from __future__ import annotations

import io
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas
import pytest
import yaml
from matplotlib import pyplot

import cpunet
from cpunet import demo
from cpunet.pulses import loading
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.tables import with_std
from cpunet.translation.translator import BATCH, RejectionWarning
from synthetic import FACTS, KEV, write_run, write_sides

SHORT = {"training.steps": 20, "training.start_factors": [1], "scores.bootstraps": 20}
N = 260
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-\d+)?")


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Simulated pulses, one of which has no energy, and measured ones."""
    folder, kev = tmp_path_factory.mktemp("calls"), np.full(N, KEV[0])
    kev[3] = np.nan
    write_sides(folder, kev)
    return folder


@pytest.fixture(scope="module")
def opens() -> Iterator[Counter[str]]:
    """How often each HDF5 file was opened; under "rows", how many of them were prepared."""
    counts, opened = Counter[str](), h5py.File.__init__

    def count_file(self: h5py.File, name: object, *args: object, **options: object) -> None:
        if isinstance(name, str | Path):  # else a file that is open
            counts[str(name)] += 1
        opened(self, name, *args, **options)

    def count_rows(pulses: Pulses, *args: Any) -> object:
        counts["rows"] += len(pulses)
        return prepare(pulses, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(h5py.File, "__init__", count_file)
        patch.setattr(loading, "prepare", count_rows)
        yield counts


@pytest.fixture(scope="module")
def run(home, opens) -> cpunet.Run:
    sides = home / "sim.lh5", str(home / "raw.lh5")
    opens.clear()
    run = cpunet.train(*sides, home / "run", settings=SHORT, seed=2, device="cpu")
    # one pulse of the simulation has no energy; those of the data have baselines all the same
    assert opens == {str(side): 1 for side in sides} | {"rows": 2 * N - 1}
    return run


def test_a_file_is_opened_once(home, run, opens, tmp_path):
    for name in ("sim.lh5", "raw.lh5"):
        opens.clear()
        assert str(N) in str(cpunet.info(home / name))
        assert opens == {str(home / name): 1}
        cpunet.translate(run, home / name, tmp_path / name, inverse=name == "raw.lh5")
        assert opens[str(home / name)] == 2


def test_all_is_there():
    for name in cpunet.__all__:
        assert getattr(cpunet, name) is not None
    assert dir(cpunet) == sorted(cpunet.__all__)
    with pytest.raises(AttributeError, match="no attribute 'tran'"):
        _ = cpunet.tran


def test_a_run(home, run):
    assert run.folder == home / "run"
    assert (run.seed, run.dt_ns) == (2, 16)
    assert run.fit.chi_square_per_moment > 0
    assert list(run.losses) == ["iteration", "rate", "chi_square"]
    assert run.parameters["decay_us"] > 0
    again = cpunet.Run.load(str(run.folder))
    assert again.model_dump() == run.model_dump()
    assert str(again).startswith("run")
    assert repr(run).startswith(f"<Run {run.folder}: fast, FEP, chi-square per moment ")
    html = run._repr_html_()
    assert "data:image/png;base64," in html
    assert run.fit.verdict in html
    assert run.plot().axes
    covariance = run.covariance
    assert list(covariance) == list(covariance.index) == list(run.fit.errors)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(errors, list(run.fit.errors.values()))
    values = cpunet.compare(run, run).values
    assert values.shape[1] == 2  # of the same name
    assert (values == run.parameters["decay_us"]).any().all()
    with pytest.raises(cpunet.CpunetError, match="runs and reports are not compared"):
        cpunet.compare(run, run.folder)


def test_printed_numbers_agree(run, tmp_path):
    """Run, response and its tables give the same number with the same digits."""
    summary, response = dict(run.summary()), cpunet.response(run, out=tmp_path / "response")
    cells = [line.split("  ") for line in str(response).splitlines()]
    rows = {row[0]: row[-1].strip() for row in cells}
    stored = yaml.safe_load((tmp_path / "response" / "response.yaml").read_text())[run.name]
    table = pandas.read_csv(tmp_path / "response" / "response.csv").iloc[0]
    assert summary["noise"].startswith(f"{rows['noise RMS [keV]']} keV")
    chain = response.runs[0]
    assert run.parameters == chain.values
    for name, value in chain.values.items():
        assert stored["numbers"][name]["value"] == table[name] == pytest.approx(value)
        if error := chain.errors.get(name):
            assert stored["numbers"][name]["error"] == pytest.approx(error)
    for name, label in {
        "rise_10_90_ns": "rise 10–90 % [ns]",
        "decay_us": "main decay [µs]",
    }.items():
        assert rows[label] == with_std(chain.values[name], chain.errors.get(name))
    report = chain.values["chi_square_per_moment"]
    assert report == run.fit.chi_square_per_moment
    assert f"chi-square per moment {report:.2f}" in repr(run)


def test_a_run_of_a_network(tmp_path):
    from games import untrained

    tiny = ("generator.width=2", "discriminator.embedding_dim=2", "discriminator.hidden=2")
    recipe = load_recipe("published", tiny).at(16)
    write_run(tmp_path, untrained(recipe), recipe, FACTS)
    run = cpunet.Run.load(tmp_path)
    assert repr(run) == f"<Run {tmp_path}: published, FEP>"
    assert "<img" not in run._repr_html_()
    with pytest.raises(cpunet.CpunetError, match="which has no response in closed form"):
        _ = run.parameters
    with pytest.raises(cpunet.CpunetError, match="there are no losses to draw"):
        run.plot()


def test_a_seed_gives_the_same_pulses_in_memory_in_a_file_and_of_arrays(home, run, tmp_path):
    """Of more pulses than have a common seed of the noise."""
    sim = Pulses.concatenate([cpunet.open_pulses(home / "sim.lh5").read()] * 4)
    assert len(sim) == 4 * N > 2 * BATCH
    kept = run.translate(sim, seed=4)
    stored = cpunet.translate(run.folder, sim, tmp_path / "t.lh5", seed=4)
    assert np.array_equal(kept.waveforms, stored.waveforms, equal_nan=True)
    assert (kept.codes.tolist(), kept.counts) == (stored.codes.tolist(), stored.counts)
    assert kept.rejections == {"energy_unknown": 4}
    assert np.flatnonzero(~kept.valid).tolist() == [3, N + 3, 2 * N + 3, 3 * N + 3]
    assert stored.path == tmp_path / "t.lh5"
    assert repr(kept) == f"<Translation in memory: {4 * N - 4} of {4 * N} pulses>"
    with pytest.warns(RejectionWarning):
        of_ren = run.ren.translate(sim.waveforms, energy_kev=sim.energy_kev, seed=4)
    assert np.array_equal(kept.waveforms, of_ren, equal_nan=True)


def test_the_times_of_pulses_in_memory_are_carried_through(home, run):
    sim = cpunet.open_pulses(home / "sim.lh5").read()[:3]
    later = replace(sim, t0_ns=sim.t0_ns + 700.0)
    before, after = (run.translate(of, noise=False).pulses.t0_ns for of in (sim, later))
    np.testing.assert_allclose(after - before, 700.0)


def test_histograms_and_figures_of_translated_pulses(home, run):
    made = run.translate(home / "sim.lh5", noise=False)
    histogram = made.hist("drift_time")
    assert histogram.axes[0].name == "drift_time"
    assert histogram.axes[0].label.endswith("[ns]")
    finite = np.isfinite(made.parameters["drift_time"])
    assert histogram.sum(flow=True) == finite.sum() == N  # without noise none needs an energy
    with pytest.raises(cpunet.CpunetError, match="no parameter 'drift'; there are current"):
        made.hist("drift")
    with pytest.raises(cpunet.CpunetError, match="raw traces in ADC have no parameters"):
        run.translate(home / "sim.lh5", adc=True).hist()
    axes = made.plot()  # for pyplot, unless one says where
    assert axes.figure is pyplot.gcf()
    assert made.hist("drift_time", bins=50).plot(ax=axes) is axes
    assert len(made.hist("drift_time", bins=50).values()) == 50
    counted = made.hist("drift_time").plot(color="red")
    assert counted.figure is pyplot.gcf()
    assert counted is not axes
    pyplot.close("all")
    with pytest.raises(cpunet.CpunetError, match="`bins` is 0"):
        made.hist(bins=0)


def test_what_is_wrong_is_one_line(home, run):
    new, nothing, strange = home / "new", np.zeros((3, 900)), {"training.steps": {1}}
    damaged, sides = home / "damaged", (home / "sim.lh5", home / "raw.lh5")
    shutil.copytree(run.folder, damaged)
    (damaged / "calibration.json").write_text("[1]")
    for words, call, *given in (
        ("ndarray: are no pulses; give a path", cpunet.train, nothing, sides[1], new),
        ("memory holds no pulses", run.translate, Pulses.of(nothing[:0], dt_ns=16)),
        (r"none of 3 pulses can .* \(3 ", run.translate, Pulses.of(nothing, dt_ns=16)),
        ("give the folder of a report", cpunet.Report.load, run.folder),
        ("no calibrated run", cpunet.Calibration.load, run.folder),
        (r"calibration.json: damaged \(no mapping\)", cpunet.Calibration.load, damaged),
        (r"steps: .*\(\{1\}\)", partial(cpunet.train, settings=strange), *sides, new),
    ):
        with pytest.raises(cpunet.CpunetError, match=words):
            call(*given)
    assert not new.exists()


def test_a_recipe_and_settings_are_not_both_given():
    recipe = load_recipe("fast")
    assert load_recipe(recipe, None) is recipe
    with pytest.raises(cpunet.CpunetError, match="leave settings out"):
        load_recipe(recipe, {"training.steps": 1})


def require_alike(printed: str, shown: str) -> None:
    """The same words; numbers as near as those of another processor."""
    words = [
        " ".join(re.sub(r"[+−-]?#", "#", NUMBER.sub("#", t)).split()) for t in (printed, shown)
    ]
    assert words[0] == words[1]
    numbers = [[float(n) for n in NUMBER.findall(text)] for text in (printed, shown)]
    np.testing.assert_allclose(*numbers, rtol=0.05, atol=0.02)


@pytest.mark.slow
def test_the_page_runs_on_a_stand(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cpunet.make_stand("stand", seed=1, events="FEP=2000,SEP=400,DEP=400")
    page = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text()
    names: dict[str, object] = {}
    blocks = re.findall(r"^```(python|text)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    printed = ""
    for kind, text in blocks:
        if kind == "text":
            require_alike(printed, text)
            continue
        out = io.StringIO()
        with redirect_stdout(out):
            exec(compile(text, "python.md", "exec"), names)
        printed = out.getvalue()
    assert Path("report/report.html").is_file()
    assert names["calibrated"].physics is not None


@pytest.mark.thorough
def test_pulses_in_memory_do_what_files_do(home, tmp_path):
    """From files to runs, nothing written unless one saves it."""
    sim, data = (cpunet.open_pulses(home / f"{side}.lh5").read() for side in ("sim", "raw"))
    assert (len(sim), len(sim[:7]), len(sim[sim.energy_kev > 0])) == (N, 7, N - 1)
    assert repr(data).startswith(f"<{N} pulses of 1200 samples, 16 ns each")
    assert list(sim.to_dataframe()) == ["event_number", "energy_kev", "peak"]
    file = cpunet.load(sim.save(tmp_path / "sim.lh5"))
    assert (file.waveforms.shape, file.energy_kev.shape) == (sim.waveforms.shape, (N,))
    assert repr(file) == f"<PulseFile {tmp_path / 'sim.lh5'}>"
    assert sum(map(len, file)) == N
    for rows in (slice(3, 9), slice(-2, None), slice(None, None, -50), slice(9, 3)):
        np.testing.assert_array_equal(file[rows].waveforms, sim[rows].waveforms)
        np.testing.assert_array_equal(file[rows].event_number, sim[rows].event_number)
    assert "fast" in cpunet.list_recipes()

    assert cpunet.check(sim, data).ok
    run = cpunet.train(sim, data, recipe=load_recipe("fast", SHORT), device="cpu")
    assert run.folder is None
    saved = run.save(tmp_path / "run")
    assert cpunet.load(tmp_path / "run").fit == saved.fit

    two = run.ren.translate(sim.waveforms[:2], noise=False)
    assert two.shape == (2, 800)
    as_set = run.ren.translate(sim[:2], noise=False)
    np.testing.assert_array_equal(as_set.waveforms, two)
    np.testing.assert_array_equal(as_set.energy_kev, sim.energy_kev[:2])
    assert run.iren.translate(data.waveforms[:2]).shape == (2, 800)


@pytest.mark.parametrize("part", ["stand", "run", "report"])
def test_an_existing_part_is_refused_before_any_work(tmp_path: Path, part: str) -> None:
    (tmp_path / part).mkdir()
    (tmp_path / part / "mine.txt").touch()
    with pytest.raises(cpunet.CpunetError, match=f"{part}: exists already"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == [part, "mine.txt"]
