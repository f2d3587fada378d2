"""REN and IREN as processors of a dspeed chain, on whole blocks of waveforms.

In the chain's JSON or YAML the functions here are named with ``init_args``; what they give
back is called with each block::

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


def ren(
    run: str,
    period: Any = None,
    noise: bool = True,
    seed: int = 0,
    device: str = "cpu",
) -> GUFuncWrapper:
    """Make a processor of a trained run: simulated waveforms → measured-like windows.

    It takes a waveform, and the energy in keV if it adds electronic noise (a run of a
    readout chain with `noise` on), and gives a window of as many samples as the run's
    preparation says (800); a row that cannot be translated is NaN.

    Parameters
    ----------
    run
        Folder of a training run; in JSON or YAML in quotes within quotes.
    period
        The waveform's ``.period``, or its sampling period in ns: compared with the run's.
        None leaves that unchecked.
    noise, seed
        Add noise, drawn with this seed; what is drawn depends on the block width too.
    device
        ``"cpu"`` or ``"cuda"``.

    Raises
    ------
    CpunetError
        If the folder is no finished run, or was trained on another sampling.
    """
    return _processor(REN.load(run, device), period, noise, seed)


def iren(run: str, period: Any = None, seed: int = 0, device: str = "cpu") -> GUFuncWrapper:
    """Make a processor of a trained run: measured waveforms → simulation-like windows.

    Parameters are those of `ren`; a network draws its latent noise, a readout chain's
    inverse draws nothing.
    """
    return _processor(IREN.load(run, device), period, True, seed)


def _processor(translator: Translator, period: Any, noise: bool, seed: int) -> GUFuncWrapper:
    if period is not None:
        dt_ns = float(period.to("ns").magnitude) if hasattr(period, "to") else float(period)
        if not np.isclose(dt_ns, translator.dt_ns):
            raise CpunetError(
                f"waveforms sampled every {dt_ns:g} ns, the run was trained on "
                f"{translator.dt_ns:g} ns; resample them"
            )
    generator = translator.seeded(seed)

    def translate(
        waveforms: npt.NDArray[Any], energy_kev: npt.ArrayLike | None = None
    ) -> npt.NDArray[np.float32]:
        rows = np.atleast_2d(waveforms)
        energies = None if energy_kev is None else np.resize(np.asarray(energy_kev), len(rows))
        pulses = Pulses.of(rows, dt_ns=translator.dt_ns, energy_kev=energies)
        done = translator.translate_pulses(pulses, noise=noise, generator=generator)
        return done.pulses.waveforms.reshape(*waveforms.shape[:-1], -1)

    with_energy = noise and translator.needs_energies
    return GUFuncWrapper(
        translate,
        signature="(n),()->(m)" if with_energy else "(n)->(m)",
        types=["ff->f", "fd->f", "dd->d"] if with_energy else ["f->f", "d->d"],
        name=f"cpunet_{translator.part}",
        vectorized=True,
    )
