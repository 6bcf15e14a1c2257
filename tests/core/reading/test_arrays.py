"""Arrays of unknown origin: what is refused before memory is taken for it."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pytest

from cpdeform.core.errors import MESSAGE_LENGTH, InputError
from cpdeform.core.reading.arrays import open_arrays
from cpdeform.core.reading.arrays_hdf5 import read_attribute, read_texts
from cpdeform.core.reading.limits import ReadingLimits, default_limits


def npy(values) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=True)
    return buffer.getvalue()


def header(shape: str, kind: str = "'<f8'", *, version: int = 1, length: int | None = None) -> bytes:
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    width = 2 if version == 1 else 4
    return b"\x93NUMPY" + bytes([version, 0]) + (len(text) if length is None else length).to_bytes(width, "little") + text


def archive(content: bytes, *, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        file.writestr("x.npy", content)
    return buffer.getvalue()


def patched(content: bytes, offset: int, value: int, width: int = 2) -> bytes:
    """An archive with a field of its first entry in the table of contents changed."""
    place = content.find(b"PK\x01\x02") + offset
    return content[:place] + value.to_bytes(width, "little") + content[place + width :]


def read(path, **options):
    with open_arrays(path, argument="file", expected="numbers") as file:
        return file.read("x", **{"shape": ("M", 3), **options})


SOUND = np.arange(12.0).reshape(4, 3)


@pytest.mark.parametrize("suffix", ["npz", "npy", "h5"])
@pytest.mark.parametrize("values", [SOUND, SOUND.astype(">f4"), np.asfortranarray(SOUND), SOUND.astype(np.uint16), SOUND[:0]])
def test_sound_arrays_are_read_as_they_are(tmp_path, suffix, values):
    path = tmp_path / f"a.{suffix}"
    if suffix == "npz":
        np.savez_compressed(path, x=values)
    elif suffix == "npy":
        np.save(path, values)
    else:
        with h5py.File(path, "w") as file:
            file["x"] = values
    found = read(path)
    np.testing.assert_array_equal(found, values)
    assert found.dtype == values.dtype
    found[...] = 0


BAD = {
    "empty": (b"", "an empty file"),
    "another format": (b"ply\nformat ascii 1.0\n", r"begins with b.ply"),
    "cut": (npy(SOUND)[:-1], "95 bytes for float64"),
    "too long": (npy(SOUND) + b"x", "97 bytes for"),
    "two axes": (npy(SOUND[:, :2]), r"float64 of shape \(4, 2\), expected numbers of shape \(M, 3\)"),
    "complex": (npy(SOUND * 1j), "complex128"),
    "texts": (npy(SOUND.astype("U8")), "U8"),
    "truth values": (npy(SOUND > 0), "bool"),
    "structure": (npy(np.zeros((4, 3), dtype=[("a", "f8")])), "'a'"),
    "objects": (npy(SOUND.astype(object)), "an array of numbers"),
    "not finite": (npy(np.full((4, 3), np.nan)), "12 values that are nan"),
    "huge": (npy(np.full((4, 3), 1e308)), "12 values that are nan, infinite or huge"),
    "huge shape": (header("(1000000000000, 3)"), "0 bytes for"),
    "negative shape": (header("(-1, 3)"), "an array of numbers"),
    "no shape": (header("7"), "unreadable"),
    "deep header": (header("(" * 3000), "unreadable"),
    "long header": (header("(4, 3)", version=2, length=2**32 - 1), "a header of 4294967295 bytes"),
    "format 3": (header("(4, 3)", version=3), "format 3.0"),
    "not an array": (archive(b"text"), "no array"),
    "cut archive": (archive(npy(SOUND))[:-30], "unreadable"),
    "encrypted": (patched(archive(npy(SOUND)), 8, 1), "encrypted"),
    "unknown method": (patched(archive(npy(SOUND)), 10, 97), "method 97"),
    "lzma": (archive(npy(SOUND), method=zipfile.ZIP_LZMA), "method 14"),
    "check sum": (patched(archive(npy(SOUND)), 16, 5, 4), "CRC"),
    "bomb": (archive(header("(16000000, 3)") + bytes(384_000_000)), "366.2 MiB, expected at most 256 MiB"),
    "long table": (patched(archive(npy(SOUND)), 0, 0)[:-10] + b"\xff" * 4 + b"\0" * 6, "table of contents"),
}


@pytest.mark.parametrize("name", BAD)
def test_refused(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / "a"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert len(str(caught.value)) <= MESSAGE_LENGTH


def test_two_members_of_a_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("x.npy", npy(SOUND))
        file.writestr("x", npy(SOUND))
    with pytest.raises(InputError, match="two arrays of that name"):
        read(tmp_path / "a.npz")


def test_a_size_by_name_is_one_size(tmp_path):
    np.savez(tmp_path / "a.npz", x=SOUND, y=np.zeros(4), z=np.zeros(5))
    with open_arrays(tmp_path / "a.npz", argument="file", expected="numbers") as file:
        file.read("x", shape=("M", 3))
        file.read("y", shape=("M",))
        with pytest.raises(InputError, match=r"file: z: got float64 of shape \(5,\), expected numbers of shape \(M = 4,\)"):
            file.read("z", shape=("M",))
        with pytest.raises(InputError, match="no array of that name"):
            file.read("w", shape=None)
    sizes = {"M": 7}
    with (
        open_arrays(tmp_path / "a.npz", argument="file", expected="numbers", sizes=sizes) as file,
        pytest.raises(InputError, match="M = 7"),
    ):
        file.read("x", shape=("M", 3))


def test_the_limit_is_for_all_arrays_and_can_be_raised(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", x=np.zeros((1000, 3)), y=np.zeros((1000, 3)))

    def both(**options):
        with open_arrays(tmp_path / "a.npz", argument="file", expected="numbers", **options) as file:
            return [file.read(name, shape=None) for name in ("x", "y")]

    with pytest.raises(InputError, match=r"file: y: got .* CPDEFORM_READ_LIMIT_MB"):
        both(limits=ReadingLimits(array_bytes=40_000))
    assert len(both(limits=ReadingLimits(array_bytes=48_000))) == 2
    monkeypatch.setenv("CPDEFORM_READ_LIMIT_MB", "0")
    with pytest.raises(InputError, match="at most 0 MiB"):
        both()
    for text, limit in (("2", 2 * 2**20), ("many", 2**28), ("", 2**28)):
        monkeypatch.setenv("CPDEFORM_READ_LIMIT_MB", text)
        assert default_limits().array_bytes == limit


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name, message in (("pipe", "a named pipe"), ("zero", "a device"), (".", "a directory"), ("none", "no such file")):
        with pytest.raises(InputError, match=message):
            read(tmp_path / name)


def fill_virtual(file):
    file.create_virtual_dataset("x", h5py.VirtualLayout(shape=(4, 3), dtype="f8"))


def fill_external(file):
    file.create_dataset("x", shape=(4, 3), dtype="f8", external=[("/etc/hostname", 0, 96)])


HDF5 = {
    "group": (lambda file: file.create_group("x"), "a group"),
    "link": (lambda file: file.__setitem__("x", h5py.SoftLink("/x")), "no array of that name"),
    "other file": (lambda file: file.__setitem__("x", h5py.ExternalLink("other.h5", "/x")), "no array of that name"),
    "virtual": (fill_virtual, "another file"),
    "external": (fill_external, "another file"),
    "nothing stored": (lambda file: file.create_dataset("x", shape=(10**12, 3), dtype="f8", chunks=(100, 3)), "in 0 bytes"),
    "large pieces": (
        lambda file: file.create_dataset("x", shape=(10**8, 3), dtype="f8", chunks=(10**8, 3)),
        "pieces of 2400000000",
    ),
    "text": (lambda file: file.create_dataset("x", data="text"), "object of shape"),
    "no value": (lambda file: file.create_dataset("x", data=h5py.Empty("f8")), "no array"),
    "complex": (lambda file: file.create_dataset("x", data=SOUND * 1j), "complex128"),
}


@pytest.mark.parametrize("name", HDF5)
def test_hdf5_refused(tmp_path, name):
    fill, message = HDF5[name]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        fill(file)
    with pytest.raises(InputError, match=message):
        read(tmp_path / "a.h5")


def test_attributes_and_texts_of_hdf5(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs.update({"n": 3, "f": 1.5, "s": "text", "many": np.zeros(3)})
        file.create_dataset("names", data=["a", "ä"], dtype=h5py.string_dtype())
        file["numbers"] = np.zeros(2)
    with open_arrays(tmp_path / "a.h5", argument="file", expected="x") as file:
        assert [read_attribute(file, *pair) for pair in (("n", int), ("f", float), ("n", float), ("s", str))] == [
            3,
            1.5,
            3.0,
            "text",
        ]
        assert read_texts(file, "names", count=2) == ["a", "ä"]
        for name, kind in (("f", int), ("s", float), ("n", str), ("many", float), ("none", int)):
            with pytest.raises(InputError, match=f"file: {name}"):
                read_attribute(file, name, kind)
        for name, count in (("names", 3), ("numbers", 2), ("none", 0)):
            with pytest.raises(InputError, match=f"file: {name}"):
                read_texts(file, name, count=count)


def test_a_bomb_takes_no_memory(tmp_path):
    """Twelve gigabytes in twelve megabytes: refused by its header, with less than 50 MB more than before."""
    path = tmp_path / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("position.npy", "w", force_zip64=True) as out,
    ):
        out.write(header("(134217728, 3)"))
        for _ in range(64):
            out.write(bytes(2**20))
    script = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from cpdeform.core.errors import InputError\n"
        "from cpdeform.core.reading.arrays import open_arrays\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n"
        "    with open_arrays(Path(sys.argv[1]), argument='a', expected='b') as file:\n"
        "        file.read('position', shape=('M', 3))\n"
        "except InputError as error:\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    finished = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert int(finished.stdout) < 50_000
