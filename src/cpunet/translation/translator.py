"""REN and IREN: apply a trained run to pulses.

``REN`` makes simulated pulses look measured; ``IREN`` does the reverse.  Pulses are
prepared first, that is aligned and normalised as in the training, so raw simulated pulses
of any length are accepted.  Preparation leaves prepared pulses unchanged.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt

from cpunet.electronics.drawn_pile_up import Columns, InTracePileUp
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses, blocks
from cpunet.pulses.preparation import Codes, Kind, Rejection, prepare, rejections_of
from cpunet.tables import counted
from cpunet.training.run import Run
from cpunet.translation.backends import Batch, Energies, Translated, backend_of

Waveforms = TypeVar("Waveforms", npt.NDArray[np.floating], Pulses)

# Pulses translated at a time, which have a common seed of the noise: bounds memory, with little
# effect on the speed
BATCH = 512


class RejectionWarning(UserWarning):
    """Some pulses could not be translated."""


@dataclass(frozen=True, eq=False)
class TranslatedPulses:
    """Translated pulses, with the rows of the input.

    Parameters
    ----------
    pulses
        Windows or traces of shape (n, samples); rows of NaN, or of 0 in ADC, for rejected
        pulses.
    codes
        A `Rejection` for each row.
    saturated
        Number of traces that reach an end of the digitiser's range.
    truth
        What was drawn for each pulse, arrays of shape (n,) with their units: ``tails_kev``
        with pile-up tails; ``n_piled``, ``piled_kev`` and ``piled_ns`` with piled-up
        pulses, see `InTracePileUp.columns`.
    """

    pulses: Pulses
    codes: Codes
    saturated: int = 0
    truth: Columns = field(default_factory=dict)

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Mask of the translated rows."""
        return np.asarray(self.codes == Rejection.ACCEPTED)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all blocks."""
        return cls(
            Pulses.concatenate([part.pulses for part in parts]),
            np.concatenate([part.codes for part in parts]),
            sum(part.saturated for part in parts),
            {
                name: (np.concatenate([part.truth[name][0] for part in parts]), units)
                for name, (_, units) in parts[0].truth.items()
            },
        )


class Translator:
    """A trained generator with the preparation that it was trained on.

    Use `REN.of` with a run, or `REN.load` with its folder.

    Attributes
    ----------
    backend
        Network, readout chain or inverse.
    recipe, dt_ns
        Recipe of the run, and sampling period in ns.
    delay_ns
        What is taken off the times of translated pulses: half rise of the step response for a
        REN, as much with the other sign for an IREN.  How long a readout takes cannot be seen
        in unpaired pulses; so the charge of a step is at half rise.
    needs_energies
        Whether the noise depends on the energies.
    tails
        Pile-up tails as learned by the run; None if it has no information.
    """

    part: ClassVar[str]
    takes: ClassVar[Kind]

    def __init__(self, run: Run, device: str = "cpu") -> None:
        self.backend = backend_of(run, self.part, device)
        self.recipe, self.dt_ns, self.tails = run.recipe, run.dt_ns, self.backend.tails
        self.needs_energies = self.backend.noise is not None
        sign = 1 if self.takes == "simulated" else -1
        self.delay_ns = 0.0 if run.fit is None else sign * run.fit.delay_ns

    @classmethod
    def of(cls, run: Run, device: str = "cpu") -> Self:
        """Make a translator of a run.

        Raises
        ------
        CpunetError
            If the weights of the run do not match its recipe.
        """
        return cls(run, device)

    @classmethod
    def load(cls, run: str | Path, device: str = "cpu") -> Self:
        """Load a translator from the folder of a training run.

        Raises
        ------
        CpunetError
            If the folder is not a finished run, or its weights do not match its recipe.
        """
        return cls(Run.load(run), device)

    def translate(
        self,
        waveforms: Waveforms,
        *,
        energy_kev: npt.ArrayLike | None = None,
        noise: bool = True,
        seed: int | None = None,
        tails_kev: npt.ArrayLike | None = None,
    ) -> Waveforms:
        """Translate waveforms, given as an array or as `cpunet.Pulses`.

        Parameters
        ----------
        waveforms
            Waveforms of shape (n, samples), or (samples,) for a single pulse, with the
            sampling period of the training; or pulses with their energies.
        energy_kev
            Energy of each pulse in keV, for electronic noise, which scales as 1/energy; the
            latent noise of a network needs none.
        noise
            Whether to add noise; without it the result is deterministic.
        seed
            Seed of the noise, the same as of `cpunet.translate`; None for a random one.
        tails_kev
            Pile-up tails under each pulse in keV; `tails` can draw them.

        Returns
        -------
        array or Pulses
            Translated windows as they were given, float32, shape (n, window) or (window,).

        Raises
        ------
        CpunetError
            If required energies are missing, or a single pulse cannot be translated.

        Warns
        -----
        RejectionWarning
            If pulses cannot be translated, with their numbers by reason; their rows are NaN.
            `translate_pulses` returns a code for each instead.
        """
        if isinstance(waveforms, Pulses):
            pulses, ndim = waveforms, 2
            energy_kev = pulses.energy_kev if energy_kev is None else energy_kev
        else:
            pulses = Pulses.of(np.atleast_2d(waveforms), dt_ns=self.dt_ns)
            ndim = np.ndim(waveforms)
        self._by_energy(energy_kev, noise)
        kev: dict[str, Energies] = {}
        for name, values in {"energy_kev": energy_kev, "tails_kev": tails_kev}.items():
            shape = np.asarray(values).shape
            if shape not in ((), (len(pulses),)):
                raise CpunetError(
                    f"{name} has shape {shape} for {len(pulses)} pulses; give one for each, "
                    "or one for all"
                )
            if values is not None:
                kev[name] = np.broadcast_to(np.asarray(values, float), len(pulses))
        pulses = replace(pulses, energy_kev=kev.get("energy_kev", pulses.energy_kev))
        if seed is None:
            seed = int(np.random.default_rng().integers(2**63))
        done = TranslatedPulses.joined(
            [
                self.translate_pulses(
                    pulses[rows],
                    noise=noise,
                    generator=np.random.default_rng(noise_seed(seed, None, number)),
                    tails_kev=kev["tails_kev"][rows] if "tails_kev" in kev else None,
                )
                for number, rows in enumerate(blocks(max(len(pulses), 1), BATCH))
            ]
        )
        if reasons := counted(rejections_of(done.codes)):
            if ndim < 2:
                raise CpunetError(f"the pulse cannot be translated: {reasons}")
            warnings.warn(
                f"{np.count_nonzero(done.codes)} of {len(pulses)} pulses cannot be "
                f"translated and are rows of NaN: {reasons}",
                RejectionWarning,
                stacklevel=2,
            )
        if isinstance(waveforms, Pulses):
            return done.pulses
        return done.pulses.waveforms[0 if ndim < 2 else slice(None)]

    __call__ = translate

    def translate_pulses(
        self,
        pulses: Pulses,
        *,
        noise: bool = True,
        generator: np.random.Generator | None = None,
        tails_kev: Energies | None = None,
        piled: InTracePileUp | None = None,
        trace: tuple[int, int] | None = None,
    ) -> TranslatedPulses:
        """Translate a set of pulses; rejected rows stay, are NaN and have a code.

        Parameters
        ----------
        pulses
            Raw or prepared pulses of the side that this translator accepts.
        noise
            Whether to add noise; electronic noise is scaled by the energies of the pulses,
            and pulses without energy are rejected.
        generator
            Random generator of the noise.
        tails_kev
            Pile-up tails under each pulse in keV, shape ``(n,)``.
        piled, trace
            See `Batch`.

        Raises
        ------
        CpunetError
            If the sampling period is not that of the training.
        """
        self.require_sampling("pulses", pulses.dt_ns)
        prepared = prepare(pulses, self.recipe.preparation, self.takes)
        codes = prepared.codes.copy()
        if self._by_energy(pulses.energy_kev, noise):
            unknown = ~(np.isfinite(pulses.energy_kev) & (pulses.energy_kev > 0))
            codes[unknown & (codes == Rejection.ACCEPTED)] = Rejection.ENERGY_UNKNOWN
        rows = codes[prepared.index] == Rejection.ACCEPTED
        index = prepared.index[rows]
        done = self._translated(
            Batch(
                prepared.pulses.waveforms[rows],
                pulses.energy_kev[index],
                noise,
                generator or np.random.default_rng(),
                None if tails_kev is None else tails_kev[index],
                None if piled is None else piled.of_rows(index),
                trace,
            )
        )
        waveforms = np.full((len(pulses), done.windows.shape[1]), np.nan, np.float32)
        waveforms[index], codes[index] = done.windows, done.codes
        t0_ns = pulses.t0_ns.copy()
        t0_ns[index] = prepared.pulses.t0_ns[rows] + done.begin * self.dt_ns - self.delay_ns
        return TranslatedPulses(replace(pulses, waveforms=waveforms, t0_ns=t0_ns), codes)

    def apply(self, windows: FloatArray, **how: Any) -> FloatArray:
        """Translate prepared windows, shape (n, window); rejected rows are NaN.

        Parameters
        ----------
        windows
            Prepared windows.
        how
            Further fields of a `Batch`.
        """
        return self._translated(Batch(windows, **how)).windows

    def _translated(self, whole: Batch) -> Translated:
        """Translate some windows at a time."""
        self._by_energy(whole.energy_kev, whole.noise)
        others = whole.tails_kev is not None or whole.piled is not None
        if others and not (whole.noise and self.needs_energies):
            raise CpunetError(
                "other pulses are drawn with electronic noise; leave out tails_kev and piled"
            )
        if whole.tails_kev is not None and self.tails is None:
            raise CpunetError("the run does not tell of pile-up tails; leave out tails_kev")
        n, length = whole.windows.shape
        length = length if whole.trace is None else whole.trace[1]
        windows = np.empty((n, length), np.float32)
        codes, begin = np.zeros(n, np.uint8), np.zeros(n, np.int64)
        for rows in blocks(n, BATCH):
            batch = whole.of_rows(np.arange(n)[rows])
            windows[rows], codes[rows], begin[rows] = self.backend.translate(batch)
        return Translated(windows, codes, begin)

    def _by_energy(self, energy_kev: npt.ArrayLike | None, noise: bool) -> bool:
        """Whether a translation depends on the energies, which then must be given."""
        by_height = self.backend.by_height is not None
        depends = by_height or (noise and self.needs_energies)
        if depends and energy_kev is None:
            why = "electronic noise is scaled by 1/energy; give energy_kev, or noise=False"
            if by_height:
                why = (
                    "the electronics of this run act by the height of a pulse; give energy_kev"
                )
            raise CpunetError(why)
        return depends

    def require_sampling(self, what: str, dt_ns: float) -> None:
        """Raise a `CpunetError` if pulses are not sampled like those of the training."""
        if not np.isclose(dt_ns, self.dt_ns):
            raise CpunetError(
                f"{what} sampled every {dt_ns:g} ns, the run was trained on {self.dt_ns:g} ns; "
                "resample the pulses"
            )


def noise_seed(seed: int, key: str | None, block: int) -> int:
    """Seed of the noise of a block of a file.

    Parameters
    ----------
    seed
        Seed of the translation.
    key
        Name of the file or the channel; None for a single file, whose first block then has
        `seed` itself, as of arrays.
    block
        Number of the block in the file.
    """
    if key is None and block == 0:
        return int(seed)
    # names of files need not be UTF-8
    digest = hashlib.sha256((key or "").encode(errors="surrogateescape")).digest()
    words = [seed, block, 0, int.from_bytes(digest[:16])]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1))


class REN(Translator):
    """Response Emulation Network: simulated pulses → measured-like pulses."""

    part = "ren"
    takes = "simulated"


class IREN(Translator):
    """Inverse Response Emulation Network: measured pulses → simulation-like pulses."""

    part = "iren"
    takes = "measured"
