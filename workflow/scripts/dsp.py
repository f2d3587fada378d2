"""Parameters of raw traces by dspeed, with the decay of the run for the pole zero.

Run by the workflow; the raw file is read block by block.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs
from cpunet.settings import read_values
from cpunet.training.chain_description import describe_chain
from cpunet.training.run import Run


def run_chain(
    raw: Path, out: Path, config: Path, table: str, run: Path, tau_us: float | None = None
) -> None:
    """Write the parameters of all traces of a table: ``NAME/dsp`` for ``NAME/raw``.

    Parameters
    ----------
    raw
        LH5 file of raw traces.
    out
        LH5 file to write; an old one is replaced.
    config
        Processing chain of dspeed, JSON or YAML; ``db.pz.tau`` is the decay.
    table
        Of the traces.
    run
        Folder of the training that translated them: its main decay is taken.
    tau_us
        A decay to take instead.

    Raises
    ------
    CpunetError
        If a file cannot be read, the run tells no decay, or the chain does not fit the traces.
    """
    from dspeed import build_dsp

    refuse_inputs(out, raw, config, run)
    chain = read_values(config)
    if not {"outputs", "processors"} <= chain.keys():
        raise CpunetError(f"{config}: no chain of dspeed; give outputs and processors")
    try:
        decay_us = tau_us or describe_chain(Run.load(run)).values["decay_us"]
    except CpunetError as error:
        raise CpunetError(f"{error}; or give events.tau_us") from error
    # dspeed looks a table's parameters up by the first of its names that is not raw
    names = [name for name in table.split("/") if name not in ("", "raw")][:1]
    aside = out.with_name(f".{out.name}.unfinished")
    aside.unlink(missing_ok=True)
    try:
        build_dsp(
            raw_in=str(raw),
            dsp_out=str(aside),
            dsp_config=chain,
            lh5_tables=[table],
            database={name: {"pz": {"tau": f"{float(decay_us)}*us"}} for name in names},
            write_mode="r",
        )
        aside.replace(out)
    except Exception as error:  # whatever dspeed and numba raise
        said = " ".join(str(error).split())
        raise CpunetError(
            f"{raw}: the chain {config} fails on {table} ({type(error).__name__}: "
            f"{said[:300]}); do its times fit the traces?"
        ) from error
    finally:
        aside.unlink(missing_ok=True)


def main() -> None:
    """Read the command line; bad input ends in one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("raw", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--table", required=True)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--tau-us", type=float)
    try:
        run_chain(**vars(parser.parse_args()))
    except CpunetError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
