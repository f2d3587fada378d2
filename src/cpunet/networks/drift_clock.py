r"""Simulated pulses with their drift stretched in time, by few parameters.

If the simulated charges drift faster or slower than those of the detector (temperature,
impurities, mobilities), no readout chain can make the two sides agree.  The paths are nearly
the same, only their times are not: what arrives :math:`t` before the end of the collection in
the detector arrives :math:`u` before it in the simulation,

.. math:: \frac{t}{u} = 1 + a + b\,t .

With :math:`b`, the last part of the path, near the contact, may be stretched by another factor
than earlier ones.  This is not part of the readout, and does not tell which physics are off;
for that, see `cpunet.calibration`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Fractions of the final charge at which collection begins and, as pulses are aligned, ends.
BEGIN, END = 1e-6, 0.999
LONGEST_US = 3.0  # time before the end from which the factor is constant
MIN_FACTOR = 0.2
ROUNDS = 20  # in which a duration converges


class DriftClock(nn.Module):
    r"""Stretches the drift of simulated pulses; nothing changes at the start.

    Parameters
    ----------
    terms
        1 for :math:`a` alone, 2 for :math:`a` and :math:`b` per microsecond.

    Examples
    --------
    A charge that rises over 40 samples rises over 44 if drift takes a tenth longer:

    >>> clock = DriftClock(1)
    >>> _ = clock.stretch.data.fill_(0.1)
    >>> ramp = torch.arange(-60, 20).div(40.0).add(1).clamp(0, 1)[None]
    >>> int((ramp > 0.5).sum()), int((clock(ramp, dt_ns=16.0) > 0.5).sum())
    (39, 41)
    """

    keeps_begin = False
    """Whether a pulse stays where its charge begins to move, not where its collection ends."""

    def __init__(self, terms: int) -> None:
        super().__init__()
        self.stretch = nn.Parameter(torch.zeros(terms, dtype=torch.float64))

    def forward(self, windows: Tensor, *, dt_ns: float) -> Tensor:
        """Stretch pulses in time about the end of their collection.

        Parameters
        ----------
        windows
            Charge of any height, 0 before it moves, shape (batch, samples).
        dt_ns
            Sampling period in ns.

        Returns
        -------
        Tensor
            Of the same shape and height.
        """
        highest = windows.amax(dim=1, keepdim=True)
        end = _first(windows >= END * highest)
        later = torch.zeros_like(end)
        if self.keeps_begin:
            took = end - _first(windows > BEGIN * highest) + 1
            later = self._duration(took, 1e-3 * dt_ns) - took
        before = end + later - torch.arange(windows.shape[1], device=windows.device)
        source = end - before / self._factor(before, 1e-3 * dt_ns)
        return at_times(windows, source)

    def _factor(self, before: Tensor, dt_us: float) -> Tensor:
        """Factor of the time of each sample before the end."""
        us = (dt_us * before).clamp(0.0, LONGEST_US)
        powers = torch.stack([us**i for i in range(len(self.stretch))], dim=-1)
        factor: Tensor = 1 + powers.to(self.stretch.dtype) @ self.stretch
        return factor.clamp_min(MIN_FACTOR)

    def _duration(self, took: Tensor, dt_us: float) -> Tensor:
        """Duration of a drift in samples in the detector, given the simulated one."""
        longer = took.to(self.stretch.dtype)
        for _ in range(ROUNDS):  # t = u (1 + a + b t)
            longer = took * self._factor(longer, dt_us)
        return longer

    def describe(self) -> dict[str, float]:
        """Fitted values by name, with the unit at the end of the name."""
        names = ("drift_stretch", "drift_stretch_per_us")
        return dict(zip(names, self.stretch.tolist(), strict=False))


def _first(where: Tensor) -> Tensor:
    """First sample of each row for which a condition holds, shape (batch, 1)."""
    return where.to(torch.uint8).argmax(dim=1, keepdim=True)


def at_times(windows: Tensor, times: Tensor) -> Tensor:
    """Values at times in samples, by cubics (Catmull-Rom); ends are held."""
    last = windows.shape[1] - 1
    first = times.detach().floor().clamp(0.0, float(last))
    part, first = (times - first).clamp(0.0, 1.0).to(windows.dtype), first.long()
    a, b, c, d = (windows.gather(1, (first + i).clamp(0, last)) for i in (-1, 0, 1, 2))
    rise, bend = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d
    skew = 0.5 * (d - a) + 1.5 * (b - c)
    between: Tensor = b + part * (rise + part * (bend + part * skew))
    return between
