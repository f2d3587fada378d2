"""The graphs of a readout and of its inverse, in the text form of ONNX.

A readout is linear.  A product with its responses to single samples gives the same records as
its Fourier transforms, which few runtimes have.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from cpunet.networks.generators import MIN_LEVEL, LinearInverse
from cpunet.networks.response_layer import END, LONGEST_US, MIN_STRETCH, ElectronicsResponse

OPSET = 18  # version of the operators


def chain_model(response: ElectronicsResponse, length: int) -> Any:
    """Windows (batch, samples) → noise-free records (batch, 200 + samples + 400).

    Parameters
    ----------
    response
        The readout.
    length
        Samples of a window.
    """
    linear = copy.copy(response)
    linear.drift = None
    constants: dict[str, Any] = {"matrix": linear(np.eye(length, dtype=np.float32))}
    lines = ["records = MatMul(windows, matrix)"]
    if response.drift is not None:
        stretch, per_us = [*response.drift.stretch.tolist(), 0.0][:2]
        constants |= {
            "axis": np.array([1]),
            "end": np.array(END, np.float32),
            "index": np.arange(length, dtype=float),
            "dt_us": np.array(1e-3 * float(response.dt_ns)),
            "zero": np.array(0.0),
            "one": np.array(1.0),
            "longest_us": np.array(LONGEST_US),
            "per_us": np.array(per_us),
            "one_and_stretch": np.array(1 + stretch),
            "least": np.array(MIN_STRETCH),
            "last": np.array(length - 1.0),
            "first_sample": np.array(0),
            "last_sample": np.array(length - 1),
        }
        lines = [
            "highest = ReduceMax <keepdims = 1> (windows, axis)",
            "level = Mul(end, highest)",
            "above = GreaterOrEqual(windows, level)",
            "risen = Cast <to = 1> (above)",
            "end_sample = ArgMax <axis = 1, keepdims = 1> (risen)",
            "end_time = Cast <to = 11> (end_sample)",
            "before = Sub(end_time, index)",
            "all_us = Mul(before, dt_us)",
            "us = Clip(all_us, zero, longest_us)",
            "change = Mul(us, per_us)",
            "factor = Add(change, one_and_stretch)",
            "positive = Max(factor, least)",
            "simulated = Div(before, positive)",
            "time = Sub(end_time, simulated)",
            "floor = Floor(time)",
            "first = Clip(floor, zero, last)",
            "after = Sub(time, first)",
            "within = Clip(after, zero, one)",
            "part = Cast <to = 1> (within)",
            "sample = Cast <to = 7> (first)",
        ]
        # cubics through four samples (Catmull-Rom), by powers of the part
        weights = [(0, -0.5, 1, -0.5), (1, 0, -2.5, 1.5), (0, 0.5, 2, -1.5), (0, 0, -0.5, 0.5)]
        for i, cubic in enumerate(weights):
            constants[f"step{i}"] = np.array(i - 1)
            lines += [
                f"near{i} = Add(sample, step{i})",
                f"place{i} = Clip(near{i}, first_sample, last_sample)",
                f"value{i} = GatherElements <axis = 1> (windows, place{i})",
            ]
            for power, weight in enumerate(cubic):
                constants[f"w{i}{power}"] = np.array(weight, np.float32)
            lines += [
                f"a{i} = Mul(part, w{i}3)",
                f"b{i} = Add(a{i}, w{i}2)",
                f"c{i} = Mul(part, b{i})",
                f"d{i} = Add(c{i}, w{i}1)",
                f"e{i} = Mul(part, d{i})",
                f"f{i} = Add(e{i}, w{i}0)",
                f"term{i} = Mul(f{i}, value{i})",
            ]
        lines += ["drifted = Sum(term0, term1, term2, term3)"]
        lines += ["records = MatMul(drifted, matrix)"]
    return _model(length, ("records", constants["matrix"].shape[1]), lines, constants)


def inverse_model(inverse: LinearInverse) -> Any:
    """Measured windows (batch, samples) → pulses within 0 … 1, as `LinearInverse`."""
    length = inverse.length
    constants = {
        "half": inverse.half_height.astype(np.float32),
        "index": np.arange(length),
        "number": np.arange(1, length + 1),
        "axis": np.array([1]),
        "zero": np.array(0),
        "one": np.array(1),
        "last": np.array(length - 1),
        "base_samples": np.arange(*inverse.baseline),
        "level_samples": np.arange(*inverse.level),
        "samples": np.arange(-inverse.before, inverse.after),
        "least": np.array(MIN_LEVEL),
        "low": np.array(0.0),
        "high": np.array(1.0),
        "mean_in": inverse.mean_in,
        "mean_out": inverse.mean_out,
        "matrix": inverse.weights.T.copy(),
        "left": np.array([0, 1, 0, 0]),
        "right": np.array([0, 0, 0, 1]),
        "start": np.arange(length) + 1 + inverse.before,
        "end": np.array(len(inverse.mean_in) + 1),
    }
    lines = [
        "highest = ArgMax <axis = 1, keepdims = 1> (windows)",
        "low_samples = Less(windows, half)",
        "early_samples = Less(index, highest)",
        "below = And(low_samples, early_samples)",
        "ones = Cast <to = 7> (below)",
        "numbers = Mul(ones, number)",
        "after = ReduceMax <keepdims = 1> (numbers, axis)",
        "before = Sub(after, one)",
        "sample = Max(before, zero)",
        "double = Cast <to = 11> (windows)",
    ]
    for name in ("base", "level", ""):
        own = f"{name}_" if name else ""
        lines += [
            f"{own}at = Add(sample, {own}samples)",
            f"{own}inside = Clip({own}at, zero, last)",
            f"{own}values = GatherElements <axis = 1> (double, {own}inside)",
        ]
    lines += [
        "base = ReduceMean <keepdims = 1> (base_values, axis)",
        "top = ReduceMean <keepdims = 1> (level_values, axis)",
        "height = Sub(top, base)",
        "scale = Max(height, least)",
        "lowered = Sub(values, base)",
        "scaled = Div(lowered, scale)",
        "centred = Sub(scaled, mean_in)",
        "product = MatMul(centred, matrix)",
        "charge = Add(product, mean_out)",
        "clipped = Clip(charge, low, high)",
        "led = Pad(clipped, left, low)",
        "padded = Pad(led, right, high)",
        "shifted = Sub(start, sample)",
        "place = Clip(shifted, zero, end)",
        "moved = GatherElements <axis = 1> (padded, place)",
        "pulses = Cast <to = 1> (moved)",
    ]
    return _model(length, ("pulses", length), lines, constants)


def _model(
    length: int, output: tuple[str, int], lines: list[str], constants: dict[str, Any]
) -> Any:
    from onnx import numpy_helper, parser

    name, samples = output
    text = "\n".join(lines)
    model = parser.parse_model(
        f"""<ir_version: 8, opset_import: ["": {OPSET}]>
        cpunet (float[batch, {length}] windows) => (float[batch, {samples}] {name})
        {{ {text} }}"""
    )
    named = (numpy_helper.from_array(np.asarray(v), key) for key, v in constants.items())
    model.graph.initializer.extend(named)
    return model
