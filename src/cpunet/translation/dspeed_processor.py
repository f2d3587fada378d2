"""REN and IREN as processors of a dspeed chain, on whole blocks of waveforms.

The chain's JSON or YAML names the functions of this module with ``init_args``; the processor
that they return is called with each block::

    wf_ren:
      function: ren
      module: cpunet.translation.dspeed_processor
      init_args: ["'run'", waveform.period]
      args: [waveform, energy, "wf_ren(shape=800, period=waveform.period)"]
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from dspeed.utils import GUFuncWrapper

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.translation.translator import IREN, REN, Translator

LOW_KEV = 20.0  # below which energies that leave no pulse are likely in MeV


def ren(
    run: str, period: Any = None, noise: bool = True, seed: int = 0, device: str = "cpu"
) -> GUFuncWrapper:
    """Make a processor of a trained run: simulated waveforms → measured-like windows.

    Its inputs are a waveform and, if it adds electronic noise (a run of a readout chain with
    `noise` on), the energy in keV.  Its output is a window of the length of the run's
    preparation (800 samples); rows that cannot be translated are NaN.

    Parameters
    ----------
    run
        Folder of a training run; in JSON or YAML in quotes within quotes.
    period
        ``.period`` of the waveform, or its sampling period in ns, which is compared with
        that of the run; None skips the check.
    noise, seed
        Whether to add noise, and its seed; the draw also depends on the block width.
    device
        Torch device, ``"cpu"`` or ``"cuda"``.

    Raises
    ------
    CpunetError
        If the folder is not a finished run, or the run has another sampling period.
    """
    return _processor(REN.load(run, device), period, noise, seed)


def iren(run: str, period: Any = None, seed: int = 0, device: str = "cpu") -> GUFuncWrapper:
    """Make a processor of a trained run: measured waveforms → simulation-like windows.

    For the parameters see `ren`.  A network draws latent noise; the inverse of a readout
    chain is deterministic.
    """
    return _processor(IREN.load(run, device), period, True, seed)


def _processor(translator: Translator, period: Any, noise: bool, seed: int) -> GUFuncWrapper:
    if period is not None:
        dt_ns = float(period.to("ns").magnitude) if hasattr(period, "to") else float(period)
        translator.require_sampling("waveforms", dt_ns)
    generator = np.random.default_rng(seed)

    def translate(
        waveforms: npt.NDArray[Any], energy_kev: npt.ArrayLike | None = None
    ) -> npt.NDArray[np.float32]:
        rows = np.atleast_2d(waveforms)
        energies = None if energy_kev is None else np.resize(np.asarray(energy_kev), len(rows))
        pulses = Pulses.of(rows, dt_ns=translator.dt_ns, energy_kev=energies)
        done = translator.translate_pulses(pulses, noise=noise, generator=generator)
        if energies is not None and done.codes.all() and np.nanmax(energies) < LOW_KEV:
            raise CpunetError(
                f"energies of {np.nanmin(energies):.3g} to {np.nanmax(energies):.3g} keV: no "
                "pulse is left with the noise of so low energies",
                "energies are taken in keV; multiply those in MeV by 1000",
            )
        return done.pulses.waveforms.reshape(*waveforms.shape[:-1], -1)

    with_energy = noise and translator.needs_energies
    return GUFuncWrapper(
        translate,
        signature="(n),()->(m)" if with_energy else "(n)->(m)",
        types=["ff->f", "fd->f", "dd->d"] if with_energy else ["f->f", "d->d"],
        name=f"cpunet_{translator.part}",
        vectorized=True,
    )
