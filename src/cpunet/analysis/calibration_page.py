"""A calibration as one self-contained HTML page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from string import Template
from typing import Any

from matplotlib.figure import Figure

from cpunet.analysis.calibration_figures import (
    directions_figure,
    profiles_figure,
    pulls_figure,
)

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Calibration of $detector</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
       max-width: 70rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .75rem; border-bottom: 1px solid #ddd; text-align: right;
         white-space: nowrap; }
th.name, td.name { text-align: left; } td.long { white-space: normal; text-align: left; }
thead th { border-bottom: 2px solid #888; }
figure { margin: 1rem 0; } figcaption { color: #555; font-size: .9rem; }
img { max-width: 100%; height: auto; }
</style>
</head>
<body>
<h1>Detector and readout of $detector, calibrated together</h1>
<p>$events. Chi-square per function: <strong>$before</strong> with the chain alone and the
physics as simulated, <strong>$after</strong> with both ($moments functions, $free parameters).
</p>
<ul>
$notes
</ul>
<h2>Physics</h2>
<div class="scroll"><table>
<thead><tr><th class="name">Parameter</th><th>As simulated</th><th>Calibrated</th><th>Error</th>
<th>Error if all were free</th><th>Prior</th><th class="name">Source of the prior</th></tr>
</thead>
<tbody>
$parameters
</tbody>
</table></div>
<p>The error holds if the parameters of the next table are as simulated. The error with all free
is that of somebody who knows no more of them than their priors.</p>
$fixed
$profiles
<h2>What is compared</h2>
$pulls
<h2>What these pulses know of the physics</h2>
<p>Directions in the space of all parameters looked at, after everything that a readout chain
can stand in for is projected off. Two parameters that share a direction move pulses alike: only
the direction is known.</p>
$directions
<div class="scroll"><table>
<thead><tr><th>No.</th><th>Error / prior</th><th class="name">Direction (units of the priors)
</th></tr></thead>
<tbody>
$axes
</tbody>
</table></div>
</body>
</html>
""")


def calibration_page(content: Mapping[str, Any]) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    content
        Content of ``calibration.json``.
    """
    chi, free = content["chi_square"], content["parameters"]
    directions = content["directions"]
    events = content["events"]
    return _PAGE.substitute(
        detector=escape(content["detector"]),
        events=f"{events['sim']} simulated and {events['data']} measured pulses",
        before=f"{chi['before'] / chi['moments']:.2f}",
        after=f"{chi['after'] / chi['moments']:.2f}",
        moments=chi["moments"],
        free=len(content["covariance"]["names"]),
        notes="\n".join(f"<li>{escape(note)}</li>" for note in content["notes"]),
        parameters="\n".join(_row(name, told) for name, told in free.items()),
        fixed=_fixed(content["fixed"]),
        profiles=_picture(
            profiles_figure(content),
            "Chi-square along the valley of each parameter, everything else following; grey: "
            "the parabola of the error quoted.",
        )
        if free
        else "",
        pulls=_picture(
            pulls_figure(content),
            "Deviation of each function of the pulses from the data; grey: two standard "
            "deviations.",
        ),
        directions=_picture(
            directions_figure(directions),
            "Left: what each direction is made of. Right: how well it is known; 1 is no better "
            "than the prior.",
        )
        if directions
        else "",
        axes="\n".join(
            f"<tr><td>{i + 1}</td><td>{d['error']:.3f}</td>"
            f'<td class="long">{escape(d["words"])}</td></tr>'
            for i, d in enumerate(directions)
        ),
    )


def _row(name: str, told: Mapping[str, Any]) -> str:
    prior = told["prior"]
    return (
        f'<tr><td class="name">{escape(name)}</td><td>{told["simulated"]:.5g}</td>'
        f"<td>{told['value']:.5g}</td><td>{told['error']:.2g}</td>"
        f"<td>{told['error_all']:.2g}</td><td>{prior['value']:.4g} ± {prior['error']:.2g}</td>"
        f'<td class="long">{escape(prior["source"])}</td></tr>'
    )


def _fixed(fixed: Mapping[str, Any]) -> str:
    if not fixed:
        return ""
    rows = "\n".join(
        f'<tr><td class="name">{escape(name)}</td><td>{told["value"]:.5g}</td>'
        f"<td>{told['chi_square_would_fall_by']:.1f}</td></tr>"
        for name, told in fixed.items()
    )
    return (
        '<div class="scroll"><table><thead><tr><th class="name">As simulated</th><th>Value</th>'
        "<th>χ² would fall by</th></tr></thead>\n"
        f"<tbody>\n{rows}\n</tbody></table></div>"
    )


def _picture(figure: Figure, caption: str) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    data = base64.b64encode(stream.getvalue()).decode()
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{escape(caption, quote=True)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
