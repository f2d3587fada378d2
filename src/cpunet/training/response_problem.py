"""The comparison that a fit of a response minimises, as a function of its parameters."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from cpunet.networks.response import ROOM_AFTER, ElectronicsResponse
from cpunet.training.moments import Moments

# Widths of the priors about the start: wide for times (in their logarithm), and for weights
# such that a chain may be half slow, and that a decay is mostly the main one.
TIME_WIDTH, WEIGHT_WIDTH, DECAY_WIDTH, RINGING_WIDTH = 1.0, 0.1, 0.03, 0.3
TIME_STEP, WEIGHT_STEP = 0.01, 0.002  # of the finite differences
BLOCK = 512  # pulses at a time, to bound memory


class ResponseProblem:
    """Residuals of the moments, and the priors, as functions of a vector of parameters.

    Parameters
    ----------
    response
        Its parameters are the vector, and where they are now the priors' centre.
    moments
        What is compared, drawn up from the data.
    sim
        Prepared simulated pulses, shape (pulses, samples).
    noise
        To be added to their records, shape (pulses, record), or several such sets, shape
        (sets, pulses, record): more of them make the comparison depend less on the noise
        that was drawn.
    last
        Sample of the records after all half maxima.
    """

    def __init__(
        self,
        response: ElectronicsResponse,
        moments: Moments,
        sim: Tensor,
        noise: Tensor,
        last: int,
    ) -> None:
        self.response, self.moments = response, moments
        self.sim, self.noise, self.last = sim, noise.view(-1, *noise.shape[-2:]), last
        self.clip: float | None = None
        named = [(n, p) for n, p in response.named_parameters() if p.numel()]
        self.parameters = [parameter for _, parameter in named]
        self.labels = [n for n, p in named for _ in range(p.numel())]
        self.centre = self.vector()
        widths = {
            "decay_weights": DECAY_WIDTH,
            "ringing": RINGING_WIDTH,
            "slow_weights": WEIGHT_WIDTH,
        }
        times = [label.startswith("log") for label in self.labels]
        self.widths = torch.tensor(
            [widths.get(n, TIME_WIDTH) for n in self.labels], dtype=torch.float64
        )
        self.steps = torch.where(torch.tensor(times), TIME_STEP, WEIGHT_STEP).double()
        values = moments.values
        self.wanted = values.mean(dim=0)
        covariance = torch.cov(values.T) * (1 / len(values) + 1 / len(sim))
        self.sigma = covariance.diagonal().sqrt().clamp_min(1e-12)
        correlation = covariance / self.sigma[:, None] / self.sigma
        ridge = moments.config.ridge
        self.correlation = (1 - ridge) * correlation + ridge * torch.eye(len(correlation))
        self.whiten = torch.linalg.cholesky(torch.linalg.inv(self.correlation)).T

    def allow_for_model_error(self) -> None:
        """Let the moments that physics shape, and electronics do not, count for little.

        If no response makes the sets agree, the simulated physics differ.  The shape of the
        edge would then bend the response to its liking; current amplitude, top and tail
        decide instead, see `Moments.model_errors`.
        """
        correlation = self.correlation + torch.diag(self.moments.model_errors**2)
        self.whiten = torch.linalg.cholesky(torch.linalg.inv(correlation)).T

    def of(self, response: ElectronicsResponse) -> ResponseProblem:
        """The same comparison for another response, with its priors about where it is."""
        return ResponseProblem(response, self.moments, self.sim, self.noise, self.last)

    def with_noise(self, noise: Tensor) -> None:
        """Put other noise in the place of what there is, see the class."""
        self.noise = noise.view(-1, *noise.shape[-2:])

    def vector(self) -> Tensor:
        """Parameters as one vector."""
        return torch.cat([p.detach().flatten().clone() for p in self.parameters])

    def set(self, vector: Tensor) -> None:
        """Put a vector into the response."""
        first = 0
        for parameter in self.parameters:
            stop = first + parameter.numel()
            parameter.data.copy_(vector[first:stop].view_as(parameter))
            first = stop

    @torch.no_grad()
    def pulls(self, vector: Tensor) -> Tensor:
        """Deviations of the moments in standard deviations, correlated as they are."""
        self.set(vector)
        level = self.moments.preparation.tail_level
        total, n = torch.zeros_like(self.wanted), 0
        for first in range(0, len(self.sim), BLOCK):
            rows = slice(first, first + BLOCK)
            records = self.response(self.sim[rows])
            plateau = records[:, -ROOM_AFTER : -ROOM_AFTER + 100].mean(dim=1, keepdim=True)
            records = records * (level / plateau)
            for noise in self.noise[:, rows]:
                values = self.moments.of_records(records + noise, self.last, self.clip)
                usable = torch.isfinite(values).all(dim=1)
                total, n = total + values[usable].sum(dim=0), n + int(usable.sum())
        pulls: Tensor = (total / max(n, 1) - self.wanted) / self.sigma
        return pulls

    def deviations(self, vector: Tensor) -> Tensor:
        """Deviations of the moments, uncorrelated."""
        deviations: Tensor = self.whiten @ self.pulls(vector)
        return deviations

    def residuals(self, vector: Tensor) -> Tensor:
        """Uncorrelated deviations, and those of the priors."""
        prior = (vector - self.centre) / self.widths
        return torch.cat([self.deviations(vector), prior])

    def jacobian(self, vector: Tensor, residuals: Tensor) -> Tensor:
        """Derivatives of all residuals, shape (residuals, parameters)."""
        moments = len(self.wanted)
        derivatives = self.derivatives(vector, residuals[:moments], range(len(vector)))
        return torch.cat([derivatives, torch.diag(1 / self.widths)])

    def derivatives(
        self, vector: Tensor, deviations: Tensor, parameters: Iterable[int]
    ) -> Tensor:
        """Derivatives of the deviations by finite differences, one column a parameter."""
        columns = []
        for i in parameters:
            moved = vector.clone()
            moved[i] += self.steps[i]
            columns.append((self.deviations(moved) - deviations) / self.steps[i])
        self.set(vector)
        return torch.stack(columns, dim=1)
