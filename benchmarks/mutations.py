"""Damage valid files by one random change of bytes, arrays, groups or text values.

Used by ``fuzz.py`` and by the tests of readers.  A change is drawn from a generator, so that
the same seed makes the same file.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from safetensors.numpy import load_file, save_file

Rng = np.random.Generator
Change = Callable[[Path, Rng], str]

# Values that a faulty script or a typing error may leave in place of a number or a text.
NASTY: list[Any] = [
    None, True, False, 0, -1, 1, 2, 3.5, -0.0, 1e-300, 1e300, -1e300, 1e9, 10**12, 10**30,
    float("nan"), float("inf"), float("-inf"), "", "x", "16", "nan", "1e400", [], [1], [[]],
    [None], {}, {"a": 1}, "a" * 5000, "\u0000", "../../etc/passwd", "2020-99-99", [1, 2, 3],
]  # fmt: skip
NASTY_TEXTS = [
    "0x", "!!int abc", "2020-99-99", "1" * 5000, "[" * 1000, "&a [*a]", ".inf", "-.inf", ".nan",
    "!!python/object:os.system x", "{", "\t", "'", '"', "#", "---", "? [1]", "1e400", "~",
]  # fmt: skip


def pick(rng: Rng, items: list[Any]) -> Any:
    """Pick an item of a list, without converting its type."""
    return items[int(rng.integers(len(items)))]


def change_bytes(path: Path, rng: Rng) -> str:
    """Flip, overwrite, remove, repeat or append bytes."""
    content = bytearray(path.read_bytes())
    size = max(len(content), 1)
    kind = pick(
        rng, ["flip", "flip", "flip", "ones", "zeros", "cut", "remove", "repeat", "add"]
    )
    at, n = int(rng.integers(size)), int(2 ** rng.uniform(0, 8))
    if rng.random() < 0.5:  # headers are where the structure is
        at = min(at, int(rng.integers(min(size, 4096))))
    if kind == "flip":
        for _ in range(pick(rng, [1, 1, 2, 8, 64])):
            place = int(rng.integers(size)) if rng.random() < 0.5 else min(at, size - 1)
            if content:
                content[place] ^= 1 << int(rng.integers(8))
            at = int(rng.integers(size))
    elif kind in ("ones", "zeros"):
        content[at : at + n] = (b"\xff" if kind == "ones" else b"\0") * n
    elif kind == "cut":
        del content[at:]
    elif kind == "remove":
        del content[at : at + n]
    elif kind == "repeat":
        content[at:at] = content[at : at + n]
    else:
        content += bytes(rng.integers(0, 256, n, np.uint8))
    path.write_bytes(content)
    return f"{kind} at {at}"


def nasty_array(values: Any, rng: Rng) -> Any:
    """An array of another type, shape or range."""
    values = np.asarray(values)
    shape = values.shape
    kinds = [
        "text",
        "nan",
        "inf",
        "huge",
        "zeros",
        "negative",
        "int",
        "float",
        "bool",
        "complex",
    ]
    kinds += ["short", "long", "flat", "deep", "scalar", "empty", "one", "unsigned", "half"]
    kind = pick(rng, kinds)
    numbers = values.astype(float) if values.dtype.kind in "iufb" else np.zeros(shape)
    if kind in ("nan", "inf", "huge"):
        number = {"nan": np.nan, "inf": np.inf, "huge": 1e300}[kind]
        if numbers.ndim == 0 or rng.random() < 0.3:
            return np.full(shape, number)
        numbers = numbers.copy()
        numbers.reshape(-1)[
            rng.integers(max(numbers.size, 1)) if numbers.size else slice(0)
        ] = number
        return numbers
    with np.errstate(all="ignore"):
        return {
            "text": lambda: np.full(shape, b"text"),
            "zeros": lambda: np.zeros_like(numbers),
            "negative": lambda: -np.abs(numbers) - 1,
            "int": lambda: numbers.astype(np.int64) * 2**40,
            "float": lambda: numbers + 0.5,
            "bool": lambda: numbers > 0,
            "complex": lambda: numbers * 1j,
            "short": lambda: numbers[:-1] if numbers.ndim else numbers,
            "long": lambda: np.concatenate([numbers, numbers]) if numbers.ndim else numbers,
            "flat": lambda: numbers.reshape(-1),
            "deep": lambda: numbers[..., None],
            "scalar": lambda: np.float64(numbers.reshape(-1)[0] if numbers.size else 0),
            "empty": lambda: numbers[:0] if numbers.ndim else np.zeros(0),
            "one": lambda: numbers[:1] if numbers.ndim else numbers,
            "unsigned": lambda: numbers.astype(np.int64).astype(np.uint64) + np.uint64(2**63),
            "half": lambda: numbers.astype(np.float16),
        }[kind]()


def change_hdf5(path: Path, rng: Rng) -> str:
    """Change one dataset, group or attribute of an HDF5 file."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = pick(rng, sorted(names))
        item, attributes = file[name], dict(file[name].attrs)
        kinds = ["attribute", "remove", "link", "circle", "group"]
        kinds += ["array"] * 5 + ["claim"] if isinstance(item, h5py.Dataset) else []
        kind = pick(rng, kinds)
        if kind == "attribute":
            key = pick(rng, sorted(attributes)) if attributes else "units"
            value = pick(
                rng, ["", "x", 3.0, "array<1>{real}", "table{}", b"\xff", [1, 2], None]
            )
            if value is None:
                item.attrs.pop(key, None)
            else:
                item.attrs[key] = value
            return f"{kind} {name} {key} {value!r}"
        values = item[()] if isinstance(item, h5py.Dataset) else None
        del file[name]
        if kind == "link":
            file[name] = h5py.SoftLink("/nowhere")
        elif kind == "circle":
            file[name] = file["/"]
        elif kind == "group":
            file.create_group(name).attrs.update(attributes)
        elif kind == "claim":
            shape = np.shape(values)
            shape = (10**9, *shape[1:]) if shape else (10**9,)
            chunks = (1000, *(min(n, 100) for n in shape[1:]))
            file.create_dataset(name, shape, "f8", chunks=chunks).attrs.update(attributes)
        elif kind == "array":
            if values.dtype.kind in "OSUV":
                values = np.zeros(np.shape(values))
            made = nasty_array(values, rng)
            file.create_dataset(name, data=made).attrs.update(attributes)
    return f"{kind} {name}"


def change_npz(path: Path, rng: Rng) -> str:
    """Change one array of an archive."""
    with np.load(path) as archive:
        arrays = dict(archive)
    name = pick(rng, sorted(arrays))
    kind = pick(rng, ["array", "array", "array", "remove", "rename", "claim", "objects"])
    if kind == "array":
        arrays[name] = nasty_array(arrays[name], rng)
    elif kind in ("remove", "rename"):
        values = arrays.pop(name)
        if kind == "rename":
            arrays[f"{name}_"] = values
    elif kind == "objects":
        arrays[name] = np.array([{}] * 3)
    np.savez(path, allow_pickle=True, **arrays)
    if kind == "claim":
        buffer = io.BytesIO()
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**3)}
        np.lib.format.write_array_header_1_0(buffer, header)
        with zipfile.ZipFile(path, "a") as archive_:
            archive_.writestr(f"{name}2.npy", buffer.getvalue() + bytes(800))
    return f"{kind} {name}"


def leaves(tree: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places of all values in nested mappings and lists, inner ones included."""
    if place:
        yield place
    items = tree.items() if isinstance(tree, dict) else ()
    items = enumerate(tree) if isinstance(tree, list) else items
    for key, value in items:
        yield from leaves(value, (*place, key))


def change_tree(tree: Any, rng: Rng) -> tuple[Any, str]:
    """Replace, remove or add one value of nested mappings."""
    places = list(leaves(tree))
    place = pick(rng, places)
    node = tree
    for key in place[:-1]:
        node = node[key]
    kind = pick(rng, ["replace"] * 6 + ["remove", "add", "whole"])
    value = pick(rng, NASTY)
    if kind == "replace":
        node[place[-1]] = value
    elif kind == "remove":
        del node[place[-1]]
    elif kind == "add" and isinstance(node, dict):
        node["unheard_of"] = value
    else:
        tree = value
    return tree, f"{kind} {'.'.join(map(str, place))} {str(value)[:40]!r}"


def change_json(path: Path, rng: Rng) -> str:
    """Change one value of a JSON file, or its text."""
    if rng.random() < 0.25:
        return change_text(path, rng)
    tree, told = change_tree(json.loads(path.read_text("utf-8")), rng)
    path.write_text(json.dumps(tree), encoding="utf-8")
    return told


def change_yaml(path: Path, rng: Rng) -> str:
    """Change one value of a YAML file, or its text."""
    if rng.random() < 0.4:
        return change_text(path, rng)
    tree, told = change_tree(yaml.safe_load(path.read_text("utf-8")), rng)
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return told


def change_text(path: Path, rng: Rng) -> str:
    """Put a trap of YAML or JSON behind a colon, or change bytes."""
    if rng.random() < 0.3:
        return change_bytes(path, rng)
    lines = path.read_text("utf-8", "replace").splitlines()
    at = int(rng.integers(max(len(lines), 1)))
    trap = pick(rng, NASTY_TEXTS)
    if lines:
        key, colon, _ = lines[at].partition(":")
        lines[at] = f"{key}{colon} {trap}"
    path.write_text("\n".join(lines), encoding="utf-8")
    return f"line {at}: {trap[:30]!r}"


def change_safetensors(path: Path, rng: Rng) -> str:
    """Change one tensor, or bytes."""
    if rng.random() < 0.4:
        return change_bytes(path, rng)
    tensors = load_file(path)
    name = pick(rng, sorted(tensors))
    kind = pick(rng, ["array", "array", "remove", "scale", "zero"])
    if kind == "array":
        made = nasty_array(tensors[name], rng)
        if made.dtype.kind not in "iufb":
            made = np.zeros(2, np.float32)
        tensors[name] = np.array(made, ndmin=1, order="C")
    elif kind == "remove":
        del tensors[name]
    elif kind == "scale":
        with np.errstate(all="ignore"):
            factor = pick(rng, [1e30, -1.0, 1e-30])
            tensors = {key: (t * factor).astype(t.dtype) for key, t in tensors.items()}
    else:
        tensors[name] = np.zeros_like(tensors[name])
    save_file({key: np.array(t, order="C") for key, t in tensors.items()}, path)
    return f"{kind} {name}"


CHANGES: dict[str, Change] = {
    ".lh5": change_hdf5,
    ".h5": change_hdf5,
    ".npz": change_npz,
    ".json": change_json,
    ".yaml": change_yaml,
    ".safetensors": change_safetensors,
}


def mutate(path: Path, rng: Rng) -> str:
    """Change a file's content by its suffix, or its bytes; return a description."""
    structured = CHANGES.get(path.suffix)
    share = 0.2 if path.suffix in (".json", ".yaml") else 0.5
    if structured is None or rng.random() < share:
        return change_bytes(path, rng)
    whole = path.read_bytes()
    try:
        return structured(path, rng)
    except Exception as error:  # a change that the library refuses to write
        path.write_bytes(whole)
        return f"{change_bytes(path, rng)} (no {type(error).__name__})"
