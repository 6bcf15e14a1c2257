"""Damaged files and options, at random but reproducibly: bytes, values, and what is built to do harm."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import struct
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np

HUGE_TEXT = "x" * 100_000
VALUES: tuple[Any, ...] = (
    None, True, False, "", "5", "1e3", HUGE_TEXT, "²", "../../x", "a\x00b", "name: [", -1, 0, 1, 2, 1.5, -0.5, 1e3, 1e-320, 1e308,
    -1e308, 10**19, 2**64, -(2**63) - 1, 10**30, 2_000_000_000, 100_000_000, float("nan"), float("inf"), float("-inf"), [], {},
    [1], [[]], ["a", "b"], {"a": 1}, {"0": 1}, [1, 2, 3], [1, 2, 3, 4], [0.5] * 3, [True] * 3, ["5"] * 3, [float("nan")] * 3,
    [1e308] * 3, [None] * 3, list(range(1000)), {str(index): index for index in range(300)},
)  # fmt: skip


def nested(depth: int, choice: random.Random) -> Any:
    value: Any = choice.choice(VALUES)
    for _ in range(depth):
        value = [value] if choice.random() < 0.5 else {"a": value}
    return value


def value(choice: random.Random) -> Any:
    return nested(choice.choice((2, 60, 300)), choice) if choice.random() < 0.05 else choice.choice(VALUES)


def paths(content: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Places of all values in nested mappings and lists."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [place, *(found for key, entry in items for found in paths(entry, (*place, key)))]


def change_value(content: Any, choice: random.Random) -> Any:
    """Replace, remove, repeat or rename something in nested mappings and lists."""
    place = choice.choice(paths(content)[1:])
    *parents, last = place
    node = content
    for key in parents:
        node = node[key]
    action = choice.random()
    if action < 0.75:
        node[last] = value(choice)
    elif action < 0.85 and isinstance(node, dict):
        del node[last]
    elif isinstance(node, list):
        node.extend([node[last]] * choice.choice((1, 1000)))
    else:
        node[choice.choice(("x", "", last + "s", HUGE_TEXT, "²"))] = node.pop(last)
    return content


def change_bytes(content: bytes, choice: random.Random) -> bytes:
    """Flip, cut, repeat or insert bytes."""
    if not content:
        return b"\x00"
    place, action = choice.randrange(len(content)), choice.randrange(7)
    if action == 0:
        return content[:place]
    if action == 1:
        return content[:place] + choice.randbytes(choice.choice((1, 8, 100))) + content[place:]
    if action == 2:
        return content[:place] + content[place + choice.choice((1, 8, 100)) :]
    if action == 3:
        return content[:place] + choice.choice((b"\xff", b"\x00")) * 8 + content[place + 8 :]
    if action == 4:
        return content[:place] + content[: choice.choice((10, 1000))] + content[place:]
    changed = bytearray(content)
    for _ in range(choice.choice((1, 3, 20))):
        # Most of what a reader goes by stands at both ends.
        near = choice.choice((64, 512, len(changed)))
        index = choice.randrange(min(near, len(changed)))
        changed[index if choice.random() < 0.6 else -1 - index] ^= 1 << choice.randrange(8)
    return bytes(changed)


def change_array(values: np.ndarray, choice: random.Random) -> np.ndarray:
    """Another type, shape or content."""
    action = choice.randrange(4)
    if action == 0:
        kinds = (
            "complex128",
            "U8",
            "S3",
            "bool",
            "float16",
            "int64",
            "uint8",
            "uint64",
            "datetime64[s]",
            "float32",
            "object",
            "V4",
        )
        kind = choice.choice(kinds)
        with contextlib.suppress(Exception):
            return values.astype(kind)
        return np.zeros(values.shape, dtype=[("a", "f8"), ("b", "i4")])
    if action == 1:
        part = values if values.ndim else values[None]
        shapes = (values.T, values.ravel(), values[None], part[:0], part[:-1], np.array(0.5))
        return np.ascontiguousarray(choice.choice((*shapes, np.concatenate([values.ravel()] * 2), np.asfortranarray(values))))
    bad = (np.nan, np.inf, -np.inf, 1e308, -1.0, -1e-3, 1e30, 2.0**40, -(2.0**40), 0.0, 5.0, 255.0)
    changed = values.astype(np.float64 if values.dtype.kind != "i" or choice.random() < 0.3 else np.int64)
    with np.errstate(all="ignore"), contextlib.suppress(OverflowError, ValueError):
        if action == 2:
            changed[...] = choice.choice(bad)
        elif changed.size:
            changed.reshape(-1)[choice.randrange(changed.size)] = choice.choice(bad)
    return changed


def fake_header(choice: random.Random) -> bytes:
    """An ``.npy`` whose header tells of more than there is, or of something else."""
    shape = choice.choice(
        ("(1000000000000, 3)", "(3, 3)", "(-1, 3)", "(2**70, 3)", "(1e9,)", "(" * 400, "(True, 3)", "(0, 1000000000000)")
    )
    kind = choice.choice(("'<f8'", "'|O'", "'<c16'", "'|V0'", "'<f8' * 9", "[('a', '<f8')]", "'<U1000000'", "'>f8'", "'<m8[s]'"))
    header = f"{{'descr': {kind}, 'fortran_order': {choice.choice(('True', 'False', '3'))}, 'shape': {shape}, }}\n".encode()
    version = choice.choice((1, 1, 2, 3, 9))
    length = choice.choice((len(header), 5, 65535, 2**32 - 1)) if version > 1 else choice.choice((len(header), 5, 65535))
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", length) + header + bytes(72)


def write_npz(path: Path, arrays: dict[str, np.ndarray], choice: random.Random) -> None:
    """A damaged ``.npz``."""
    method = choice.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))
    members = {f"{name}.npy": npy(values) for name, values in arrays.items()}
    name = choice.choice(list(members))
    action = choice.randrange(9)
    if action < 3:
        members[name] = npy(change_array(arrays[name.removesuffix(".npy")], choice))
    elif action == 3:
        members[name] = change_bytes(members[name], choice)
    elif action == 4:
        members[name] = fake_header(choice)
    elif action == 5:
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({choice.choice((10**6, 4 * 10**6))}, 3), }}\n".encode()
        members[name] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(choice.choice((10**6, 24 * 10**6)))
    elif action == 6:
        members[choice.choice((name + "x", "../x.npy", "a/b.npy", "\u00b2.npy"))] = members.pop(name)
    elif action == 7:
        members[name] = choice.choice((b"", b"text", b"\x93NUMPY", b"\x80\x04]q\x00.", bytes(1000)))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for key, content in members.items():
            archive.writestr(key, content)
    content = buffer.getvalue()
    path.write_bytes(patched_zip(content, choice) if action == 8 or choice.random() < 0.15 else content)


def patched_zip(content: bytes, choice: random.Random) -> bytes:
    """Flags, methods, sizes or the check sum of one entry in the table of contents changed."""
    table = content.find(b"PK\x01\x02")
    offset, width = choice.choice(((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (42, 4)))
    number = choice.choice((1, 9, 14, 97, 99, 2**16 - 1, 2**32 - 1)) % 2 ** (8 * width)
    changed = content[: table + offset] + number.to_bytes(width, "little") + content[table + offset + width :]
    end = changed.rfind(b"PK\x05\x06")
    if choice.random() < 0.2:
        changed = changed[: end + 8] + choice.randbytes(10) + changed[end + 18 :]
    return changed


def npy(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, values, allow_pickle=values.dtype.hasobject)
    return buffer.getvalue()


def change_hdf5(path: Path, choice: random.Random) -> None:
    """Something in an HDF5 file in the place of a dataset, a group or an attribute."""
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        attributes = list(file.attrs)
        if attributes and choice.random() < 0.3:
            name = choice.choice(attributes)
            del file.attrs[name]
            new = (
                None,
                5,
                -1,
                2**62,
                1.5,
                float("nan"),
                "text",
                '{"a": "b"}',
                "[" * 3000,
                b"\xff\xfe",
                [1, 2],
                np.zeros((2, 2)),
                "finished",
            )
            replacement = choice.choice(new)
            if replacement is not None:
                file.attrs[name] = replacement
            return
        name = choice.choice(names)
        old = file[name]
        values = old[()] if isinstance(old, h5py.Dataset) else None
        del file[name]
        action = choice.randrange(8)
        if action < 3 and isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
            with contextlib.suppress(TypeError, ValueError):
                file.create_dataset(name, data=change_array(values, choice))
        elif action == 3:
            file.create_dataset(name, shape=(10**12, 3), dtype="f8", chunks=(1000, 3))
        elif action == 4:
            file[name] = choice.choice((h5py.ExternalLink("/dev/zero", "/x"), h5py.SoftLink("/" + name), h5py.SoftLink("/nothing")))
        elif action == 5:
            file.create_dataset(name, data=choice.choice(("text", b"bytes", 0.5, h5py.Empty("f8"))))
        elif action == 6:
            file.create_group(name)
        elif action == 7:
            layout = h5py.VirtualLayout(shape=(10**9, 3), dtype="f8")
            file.create_virtual_dataset(name, layout)


def special_file(path: Path, choice: random.Random) -> None:
    """Something in the place of a file that is none, or is one without end."""
    path.unlink(missing_ok=True)
    kind = choice.randrange(6)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to("/dev/zero")
    elif kind == 2:
        path.symlink_to(path)
    elif kind == 3:
        path.mkdir()
    elif kind == 4:
        path.write_bytes(b"")
    else:
        path.write_bytes(choice.choice((b"ply\nformat ascii 1.0\n", b"text", choice.randbytes(500), b"PK\x05\x06" + bytes(18))))


def bomb(choice: random.Random) -> str:
    """A short YAML text that stands for a very large one, or none at all."""
    merge = choice.random() < 0.5
    lines = ["a0: &a0 {k: 1}" if merge else "a0: &a0 [x]"]
    for index in range(1, 12):
        again = ", ".join([f"*a{index - 1}"] * 9)
        lines.append(f"a{index}: &a{index} {{<<: [{again}]}}" if merge else f"a{index}: &a{index} [{again}]")
    texts = ("&a [*a]", "&a {a: *a}", "&a {<<: *a}", "[" * 500, "{a: " * 500, "- " * 2000, "!!python/object/apply:os.system [x]")
    return choice.choice(
        ("\n".join(lines), *texts, "!!binary x", "2020-13-45", "0x" + "f" * 5000, "9" * 5000, HUGE_TEXT, "a: b: c")
    )


def text_of(value: Any, choice: random.Random) -> str:
    """A value as YAML, JSON or Python writes it."""
    with contextlib.suppress(ValueError, RecursionError):
        return json.dumps(value) if choice.random() < 0.7 else str(value)
    return str(value)[:1000]
