"""What maps pulses: readouts, and the networks of CPU-Net, which need torch."""

from cpunet.errors import CpunetError


def require_torch() -> None:
    """Raise a `CpunetError` if torch is not installed, which networks need."""
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise CpunetError(
            "networks need torch, which is not installed", "pip install 'cpunet-hpge[networks]'"
        ) from None
