"""What a message advises is done, word by word, and gets on: no remedy is refused by another.

Advice that needs data of its own is followed where that is tested: longer windows in
``test_check.py``, other energies of a training in ``test_mistakes.py``, impurities and voltages
that metadata lack in ``test_geometry_readers.py``, `resume` in ``test_environments.py``.
"""

from __future__ import annotations

import re
import shlex
from typing import NamedTuple

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array

from cpunet.pulses.reading import open_pulses
from cpunet.pulses.writing import PulseWriter
from synthetic import rows_of, write_chain, write_csv, write_table

SHORT = {
    "CHECK": "check --sim sim.lh5 --data data.lh5",
    "TRANSLATE": "translate run sim.lh5 --out out.lh5 --force",
    "SIMULATE": "simulate --detector ppc --out hit.lh5 --force",
    "EVENTS": "3 pulses|3 events",
}
USED = r"24 measured pulses of 90 can be used"


class Remedy(NamedTuple):
    """Words of a command, what it advises, the words that follow from it, and what comes then.

    Parts of the advice in parentheses are put into the words that follow, where braces stand.
    """

    words: str
    advice: str
    follow: str
    then: str = USED


TABLE = r"""
CHECK --data two.lh5 | tables of waveforms \((\S+), .*choose one with --table | --data-table {}
CHECK --data channels.lh5 | choose one with --table (channel=1) .*or all for each
    | --data-table {} | 12 measured pulses of 45 can be used
CHECK --data channels.lh5 | --data-table.*or (all) for each
    | --data-table {} | channel_1:\n(.*\n)+channel_2:
CHECK --data channels.lh5 | (channel=\*) takes them as one | --data-table {}
info two.lh5 | one of them: --table NAME; each in full: --table (all) | --table {} | geds:\nfile
CHECK --data mev.lh5 | if these are MeV, give (--kev-per-adc 1000) | {}
CHECK --data counts.lh5 | if these are ADC counts, give (--kev-per-adc) | {} 0.0666667
CHECK --data adc.lh5 | or give (--kev-per-adc) | {} 1
CHECK --data adc.lh5 --data-energy energy | add (--kev-per-adc) .1 if it is in keV | {} 1
CHECK --data nan.lh5 | name the column .*(--data-energy) | {} geds_hit.lh5:geds/hit/E_cal
info geds_hit.lh5 | energies are (--data-energy) FILE:COLUMN
    | & CHECK --data adc.lh5 {} geds_hit.lh5:geds/hit/E_cal
CHECK --peak 5000- | outside.* Energies there: .* (--peak \d+-) takes 90 pulses
    | {} | 90 measured pulses of 90
info plain.h5 | give (--dt-ns) | {} 16 | every 16 ns
info zero.lh5 | give (--dt-ns) | {} 16 | every 16 ns
CHECK --sim sim10.lh5 | or give (--dt-ns) if one says it wrongly | {} 16
info array.h5 | holds (\w+) .*name an array .* by (--table) .*give --dt-ns
    | {1} {0} --dt-ns 16 | 90 of 1200 samples
CHECK --data sim.lh5 | (?i)if they are measured, say so with (--insist) | {} | (ok|look|stop)[ ]
CHECK --set cuts.decay_sigmas=1e-9 | widen (cuts\.)\*_sigmas
    | --set {}decay_sigmas=5 | 2\d measured pulses of 90 can be used
CHECK --set preparation.after=9600 | did you mean (after_ns) | & CHECK --set preparation.{}=6400
translate run sim.lh5 --out data.lh5.out | or give (--force) | {} | 90 of 90
TRANSLATE --adc-per-kev 4 --baseline 100 | add (--adc) | {} | 90 of 90
TRANSLATE --adc --baseline 100 | give (--adc-per-kev) | {} 4 | 90 of 90
TRANSLATE --adc --adc-per-kev 4 | give (--baseline) | {} 100 | 90 of 90
TRANSLATE --adc --adc-per-kev 4 --baseline 9 --n-pre 900 | or a longer (--length)
    | {} 2000 | 90 of 90
SIMULATE --hits hits.h5 | holds detectors (\d), .*choose one with (--hits-detector)
    | {1} {0} | EVENTS
SIMULATE --hits plain.csv | give (--units), one of | {} mm,keV | EVENTS
SIMULATE --hits hits.npz --hits-detector V1 | leave out (--hits-detector)
    | & SIMULATE --hits hits.npz | EVENTS
SIMULATE --hits far.npz | move them with (--origin) | {} 0 0 500 | EVENTS
SIMULATE | give (--hits) of a file | {} hits.npz | EVENTS
info sim.lh5 --set bias_V=3 | leave out --set | & info sim.lh5 | 90 of 225 samples
"""
for name, words in SHORT.items():
    TABLE = TABLE.replace(name, words)


@pytest.fixture(scope="module")
def home(stand, tmp_path_factory):
    """The files that the commands are given."""
    folder = tmp_path_factory.mktemp("remedies")
    waves, kev, n = stand.data_waveforms, stand.data_kev, len(stand.data_kev)
    energies = dict.fromkeys(("data", "two", "channels", "adc", "zero"), kev)
    energies |= {"mev": kev / 1000, "counts": 15 * kev, "nan": kev * np.nan}
    for name, values in energies.items():
        stand.write(folder / f"{name}.lh5", "geds/raw", waves, values)
    sim = (stand.sim_waveforms, stand.sim_kev)
    stand.write(folder / "sim.lh5", "geds/sim", *sim, units="")
    stand.write(folder / "sim10.lh5", "geds/sim", *sim, units="", dt_ns=10)
    with h5py.File(folder / "two.lh5", "r+") as file:
        file.copy("geds", "more")
    with h5py.File(folder / "adc.lh5", "r+") as file:
        file["geds/raw/energy"].attrs["units"] = "ADC"
    with h5py.File(folder / "zero.lh5", "r+") as file:
        file["geds/raw/waveform/dt"][:] = 0
    channel = Array(np.arange(n) // (n // 2) + 1)
    lh5.write(channel, "channel", folder / "channels.lh5", group="geds/raw")
    write_table(folder / "geds_hit.lh5", "geds/hit", E_cal=kev)
    for name, array in (("plain", "waveform"), ("array", "curves")):
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file[array] = waves
    x = np.array([5.0, 6.0, 9.0])
    hits = {"x_mm": x, "y_mm": 0 * x, "z_mm": x, "edep_keV": 0 * x + 900}
    hits["offsets"] = np.arange(4)
    np.savez(folder / "hits.npz", **hits)
    np.savez(folder / "far.npz", **(hits | {"z_mm": x + 500}))
    columns = {"event": [0, 1, 2] * 2, "x": [*x, *x], "y": [0.0] * 6, "z": [*x, *x]}
    columns |= {"edep": [0.9] * 6, "volID": [1, 1, 1, 2, 2, 2]}
    with h5py.File(folder / "hits.h5", "w") as file:
        for name, values in columns.items():
            file[f"default_ntuples/g4sntuple/{name}/pages"] = values
    rows = [f"{i},{v},0,{v},900" for i, v in enumerate(x)]
    write_csv(folder / "plain.csv", ["event", "x", "y", "z", "edep"], rows)
    write_chain(folder / "run", noise_kev=1.0)
    (folder / "data.lh5.out").write_bytes((folder / "sim.lh5").read_bytes())
    return folder


def last_of_each(text: str) -> list[str]:
    """Words of a command; an option that comes again takes the place of the first."""
    words = shlex.split(text)
    for option in {word for word in words if word.startswith("--")}:
        while words.count(option) > 1:
            at = words.index(option)
            del words[at : at + 2]
    return words


@pytest.mark.parametrize("row", rows_of(TABLE))
def test_what_is_advised_is_taken(command, home, own_cache, monkeypatch, row):
    monkeypatch.chdir(home)
    remedy = Remedy(*row.split(" | "))
    first = command(*last_of_each(remedy.words))
    advice = re.search(remedy.advice, first.out + first.err)
    assert advice, first.out + first.err
    follow = remedy.follow.format(*advice.groups())
    whole = follow.removeprefix("& ") if follow[0] == "&" else f"{remedy.words} {follow}"
    again = command(*last_of_each(whole))
    said = again.out + again.err
    assert re.search(remedy.then, said), said
    assert not re.search(remedy.advice, said) or row.startswith("info two"), said


def test_traces_are_turned_round_as_advised(command, home, stand, monkeypatch):
    monkeypatch.chdir(home)
    stand.write(home / "down.lh5", "geds/raw", 60_000 - stand.data_waveforms, stand.data_kev)
    words = ["check", "--sim", "sim.lh5", "--data"]
    advice = r"invert them, as by pulses\.with_waveforms\(-pulses"
    assert re.search(advice, command(*words, "down.lh5").out)
    pulses = open_pulses(home / "down.lh5").read()
    with PulseWriter(home / "up.lh5") as writer:
        writer.append(pulses.with_waveforms(-pulses.waveforms))
    assert re.search(USED, command(*words, "up.lh5").out)
