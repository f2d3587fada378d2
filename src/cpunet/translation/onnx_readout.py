"""The graphs of a readout and of its inverse, by ONNX alone.

A readout is linear.  A product with its responses to single samples gives the same records as
its Fourier transforms, which few runtimes have.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cpunet.networks.generators import MIN_LEVEL, LinearInverse
from cpunet.networks.response_layer import END, LONGEST_US, MIN_STRETCH, ElectronicsResponse

OPSET = 18  # version of the operators
FLOAT, INT64, DOUBLE = 1, 7, 11  # types of ONNX
# weights of four samples by powers of the time between the middle ones (Catmull-Rom)
CUBICS = np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]], np.float32) / 2


@dataclass
class Graph:
    """A graph in the making, with ``windows`` (batch, samples) as input.

    Parameters
    ----------
    length
        Samples of a window.
    nodes, constants
        Objects of ONNX.
    """

    length: int
    nodes: list[Any] = field(default_factory=list)
    constants: list[Any] = field(default_factory=list)

    def __call__(self, operator: str, *inputs: Any, **attributes: Any) -> str:
        """Add a node, and return the name of its output.

        Parameters
        ----------
        operator, attributes
            See the operators of ONNX.
        inputs
            Names of outputs, and constants.
        """
        from onnx import helper, numpy_helper

        names = []
        for given in inputs:
            names.append(given if isinstance(given, str) else f"constant{len(self.constants)}")
            if not isinstance(given, str):
                self.constants.append(numpy_helper.from_array(np.asarray(given), names[-1]))
        output = f"{operator}{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [output], **attributes))
        return output

    def model(self, output: str, name: str, samples: int) -> Any:
        """The model of which an output (batch, samples) is the result, under another name."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [output], [name]))
        windows = helper.make_tensor_value_info("windows", FLOAT, ["batch", self.length])
        made = helper.make_tensor_value_info(name, FLOAT, ["batch", samples])
        graph = helper.make_graph(self.nodes, "cpunet", [windows], [made], self.constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])


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
    matrix = linear(np.eye(length, dtype=np.float32))
    add, charge, last = Graph(length), "windows", length - 1
    if response.drift is not None:
        stretch, per_us = [*response.drift.stretch.tolist(), 0.0][:2]
        highest = add("ReduceMax", charge, [1], keepdims=1)
        risen = add("GreaterOrEqual", charge, add("Mul", np.float32(END), highest))
        end = add("ArgMax", add("Cast", risen, to=FLOAT), axis=1, keepdims=1)
        end = add("Cast", end, to=DOUBLE)
        before = add("Sub", end, np.arange(length, dtype=float))
        us = add("Clip", add("Mul", before, 1e-3 * float(response.dt_ns)), 0.0, LONGEST_US)
        factor = add("Max", add("Add", add("Mul", us, per_us), 1 + stretch), MIN_STRETCH)
        time = add("Sub", end, add("Div", before, factor))
        first = add("Clip", add("Floor", time), 0.0, float(last))
        part = add("Cast", add("Clip", add("Sub", time, first), 0.0, 1.0), to=FLOAT)
        sample = add("Cast", first, to=INT64)
        terms = []
        for step, (*lower, weight) in zip((-1, 0, 1, 2), CUBICS, strict=True):
            for value in reversed(lower):
                weight = add("Add", add("Mul", part, weight), value)
            place = add("Clip", add("Add", sample, step), 0, last)
            near = add("GatherElements", charge, place, axis=1)
            terms.append(add("Mul", weight, near))
        charge = add("Sum", *terms)
    return add.model(add("MatMul", charge, matrix), "records", matrix.shape[1])


def inverse_model(inverse: LinearInverse) -> Any:
    """Measured windows (batch, samples) → pulses within 0 … 1, as `LinearInverse`."""
    length = inverse.length
    add, index = Graph(length), np.arange(length)
    highest = add("ArgMax", "windows", axis=1, keepdims=1)
    low = add("Less", "windows", inverse.half_height.astype(np.float32))
    below = add("Cast", add("And", low, add("Less", index, highest)), to=INT64)
    after = add("ReduceMax", add("Mul", below, index + 1), [1], keepdims=1)
    sample = add("Max", add("Sub", after, 1), 0)
    double = add("Cast", "windows", to=DOUBLE)
    base, level, values = (
        add(
            "GatherElements",
            double,
            add("Clip", add("Add", sample, np.arange(first, stop)), 0, length - 1),
            axis=1,
        )
        for first, stop in (inverse.baseline, inverse.level, (-inverse.before, inverse.after))
    )
    base, level = (add("ReduceMean", part, [1], keepdims=1) for part in (base, level))
    height = add("Max", add("Sub", level, base), MIN_LEVEL)
    centred = add("Sub", add("Div", add("Sub", values, base), height), inverse.mean_in)
    product = add("MatMul", centred, inverse.weights.T.copy())
    charge = add("Clip", add("Add", product, inverse.mean_out), 0.0, 1.0)
    # 0 before the region and 1 after it
    padded = add("Pad", add("Pad", charge, [0, 1, 0, 0], 0.0), [0, 0, 0, 1], 1.0)
    shifted = add("Sub", index + 1 + inverse.before, sample)
    place = add("Clip", shifted, 0, len(inverse.mean_in) + 1)
    moved = add("GatherElements", padded, place, axis=1)
    return add.model(add("Cast", moved, to=FLOAT), "pulses", length)
