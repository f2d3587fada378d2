# The configuration, checked, and what follows from it.

import re
import shlex
from glob import glob
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.utils import validate


def checked(config):
    """Validate the configuration; a defect is one line."""
    if not config:
        raise WorkflowError("no configuration; give one with --configfile")
    try:
        validate(config, "../config/schema.yaml")
    except WorkflowError as error:
        defect = error.__context__
        if not hasattr(defect, "json_path"):
            raise
        place = defect.json_path.removeprefix("$").removeprefix(".") or "top level"
        raise WorkflowError(f"configuration, {place}: {_words(defect)}") from None
    for name, detector in config["detectors"].items():
        unknown = [p for p in detector.get("periods", []) if p not in config["periods"]]
        if unknown:
            raise WorkflowError(
                f"configuration, detectors.{name}.periods: {unknown[0]} is not in periods"
            )
        if "energy" not in detector:
            for period in periods_of(config, name):
                if "energies" in config["periods"][period]:
                    raise WorkflowError(
                        f"configuration, detectors.{name}: no energy, the column in "
                        f"the files of periods.{period}.energies"
                    )
        require_geometry(config, name, detector)
    return config


def require_geometry(config, name, detector):
    """Libraries, events and calibrations take a simulation, not only its pulses."""
    wanted = [part for part in ("calibrate", "library", "events") if part in config]
    if wanted and "simulate" not in detector:
        raise WorkflowError(
            f"configuration, detectors.{name}: {wanted[0]} takes its geometry; give simulate "
            "in place of simulations"
        )
    if "calibrate" in config and detector["simulate"].get("files", 1) > 1:
        raise WorkflowError(
            f"configuration, detectors.{name}.simulate.files: calibrate takes one file, with "
            "its hits; give all events in one"
        )


def _words(defect):
    """What is wrong, without the part of the schema that says so."""
    if defect.validator == "oneOf":
        either = " or ".join(choice["required"][0] for choice in defect.validator_value)
        return f"needs either {either}"
    return defect.message


def periods_of(config, detector):
    return config["detectors"][detector].get("periods", list(config["periods"]))


def matching(pattern, place, **names):
    """Files that match a pattern, in the order of their names."""
    for name, value in names.items():
        pattern = pattern.replace(f"{{{name}}}", value)
    files = sorted(glob(pattern, recursive=True))
    if not files:
        raise WorkflowError(f"configuration, {place}: no file matches {pattern}")
    return files


def by_stem(files, place):
    """Files by name without its ending."""
    named = {Path(file).stem: file for file in files}
    if len(named) < len(files):
        raise WorkflowError(f"configuration, {place}: two files have the same name")
    return named


checked(config)
RESULTS = config["results"].rstrip("/") or "/"
DETECTORS = config["detectors"]
PAIRS = [(d, p) for d in DETECTORS for p in periods_of(config, d)]


def simulations(detector):
    """Files of simulated pulses by name, whether given or to be made."""
    entry, place = DETECTORS[detector], f"detectors.{detector}"
    if "simulations" in entry:
        files = matching(entry["simulations"], f"{place}.simulations", detector=detector)
        return by_stem(files, f"{place}.simulations")
    if "hits" in entry["simulate"]:
        names = HITS[detector]
    else:
        names = [f"part{i:03d}" for i in range(entry["simulate"].get("files", 1))]
    return {name: f"{RESULTS}/{detector}/simulated/{name}.lh5" for name in names}


HITS = {
    name: by_stem(
        matching(entry["simulate"]["hits"], f"detectors.{name}.simulate.hits", detector=name),
        f"detectors.{name}.simulate.hits",
    )
    for name, entry in DETECTORS.items()
    if "hits" in entry.get("simulate", {})
}
SIMULATIONS = {name: simulations(name) for name in DETECTORS}
DATA = {
    (d, p): matching(config["periods"][p]["data"], f"periods.{p}.data", detector=d, period=p)
    for d, p in PAIRS
}
ENERGIES = {
    (d, p): matching(
        config["periods"][p]["energies"], f"periods.{p}.energies", detector=d, period=p
    )
    for d, p in PAIRS
    if "energies" in config["periods"][p]
}
if "calibrate" in config:
    for name, files in SIMULATIONS.items():
        if len(files) > 1:
            raise WorkflowError(
                f"configuration, detectors.{name}.simulate.hits: {len(files)} files, and "
                "calibrate takes one; give all hits in one"
            )
EVENTS = {}
if "events" in config:
    if "dsp" in config["events"] and not Path(config["events"]["dsp"]).is_file():
        raise WorkflowError(
            f"configuration, events.dsp: no file {config['events']['dsp']}; give a chain of "
            "dspeed, or leave it out"
        )
    EVENTS = {
        name: by_stem(matching(config["events"]["hits"], "events.hits", detector=name), "events.hits")
        for name in DETECTORS
    }
for (d, p), files in ENERGIES.items():
    if len(files) != len(DATA[d, p]):
        raise WorkflowError(
            f"configuration, periods.{p}.energies: {len(files)} files for "
            f"{len(DATA[d, p])} of data ({d})"
        )
TRANSLATED = [
    f"{RESULTS}/{d}/{p}/translated/{name}.lh5" for d, p in PAIRS for name in SIMULATIONS[d]
]


wildcard_constraints:
    detector="|".join(map(re.escape, DETECTORS)),
    period="|".join(map(re.escape, config["periods"])),
    part="[^/]+",
    events="[^/]+",
    seed="[0-9]+",


# by itself numba takes all cores of a node
environment = 'set -euo pipefail; export NUMBA_NUM_THREADS="$OMP_NUM_THREADS"; '
if config["device"] == "cpu":  # for commands that take a GPU if there is one
    environment += "export CUDA_VISIBLE_DEVICES=; "
shell.prefix(environment)


def a_file(name):
    """What is a file is an input, and made anew if it changes; built-in names are none."""
    return name if Path(name).is_file() else []


def options(**words):
    """Options for a command line, quoted; None and False are left out."""
    line = []
    for name, value in words.items():
        if value is None or value is False:
            continue
        option = "--" + name.replace("_", "-")
        values = value if isinstance(value, list) else [value]
        for value in values:
            line.append(option if value is True else f"{option}={shlex.quote(str(value))}")
    return " ".join(line)
