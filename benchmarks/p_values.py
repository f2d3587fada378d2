"""Are p-values of a validation uniform if nothing is wrong, and how many alarms are false?

    python benchmarks/p_values.py [STANDS] [FOLDER]

Small stands, each with a training of its own; truth and REN are validated.  For each quantity:
p of a Kolmogorov–Smirnov test of its p-values against a uniform distribution, and the share
beyond 3 sigma (0.27 % expected).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from scipy.stats import kstest

import cpunet
from cpunet.validation.metrics import Metrics

STANDS, EVENTS = 40, "FEP=1000,SEP=400,DEP=400"
ALARM = 0.0027


def p_values(folder: Path, stands: int) -> dict[str, dict[str, list[float]]]:
    """P-values by method and quantity; those of finished stands are read."""
    collected: dict[str, dict[str, list[float]]] = {}
    for seed in range(stands):
        file = folder / f"{seed}.json"
        if not file.exists():
            place = folder / f"stand{seed}"
            stand = cpunet.make_stand(place, events=EVENTS, seed=seed, force=True)
            run = cpunet.train(stand.sim, stand.data)
            assert isinstance(run, cpunet.Run)
            report = cpunet.validate(
                run, stand.sim, stand.data, truth=stand.truth, baselines=False, seed=seed
            )
            assert isinstance(report, cpunet.Report)
            file.write_text(json.dumps(report.to_dict()))
        metrics = Metrics.model_validate_json(file.read_text())
        for method in ("truth", "ren"):
            for peak in metrics.peaks:
                for name, verdict in metrics.judge(peak, method).items():
                    if verdict.p is not None:
                        of_peak = f"{peak} {name.replace('_', ' ')}"
                        collected.setdefault(method, {}).setdefault(of_peak, []).append(
                            verdict.p
                        )
    return collected


def main() -> None:
    stands = int(sys.argv[1]) if len(sys.argv) > 1 else STANDS
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(mkdtemp())
    folder.mkdir(exist_ok=True)
    for method, quantities in p_values(folder, stands).items():
        for name, p in quantities.items():
            alarms = np.mean(np.array(p) < ALARM)
            print(
                f"{method:6}{name:34}{len(p):4}  KS p {kstest(p, 'uniform').pvalue:.3f}"
                f"  median {np.median(p):.2f}  beyond 3 sigma {100 * alarms:.1f} %"
            )
        held_out = [q for name, q in quantities.items() if not name.startswith("FEP")]
        every = np.concatenate(held_out)
        print(
            f"{method:6}{'SEP and DEP':34}{len(every):4}  KS p"
            f" {kstest(every, 'uniform').pvalue:.3f}"
            f"  beyond 3 sigma {100 * np.mean(every < ALARM):.2f} %"
        )


if __name__ == "__main__":
    main()
