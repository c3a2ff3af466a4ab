"""Ways to damage a file, each a pure function of (rng, bytes): blindly, in its numbers,
and in what its format keeps where.

Every mutator returns the damaged bytes. Those that know a format undo what would hide the damage (a PNG's checksums, a
GLB's lengths), so that the reader's later stages are reached. Used by :mod:`blinkgl.tools.fuzz_files`.
"""

from __future__ import annotations

import ast
import io
import json
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

Mutator = Callable[[np.random.Generator, bytes], bytes]
Layout = Callable[[bytes], list[tuple[int, str]]]
"""Where a format keeps counts, sizes and offsets: (byte, struct format)."""

_INTEGERS = (
    0,
    1,
    2,
    3,
    7,
    100,
    127,
    128,
    255,
    256,
    4096,
    32767,
    32768,
    65535,
    65536,
    60000,
    10**6,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53,
    2**62,
    2**63 - 1,
    2**63,
    2**64 - 1,
    -1,
    -2,
    -32768,
    -(2**31),
    -(2**63),
)
_FLOATS = (
    float("nan"),
    float("inf"),
    float("-inf"),
    -1.0,
    0.0,
    -0.0,
    1e-320,
    1e30,
    -1e30,
    3e38,
    1e308,
    0.5,
    1e9,
    2.0**31,
    2.0**63,
)
_TOKENS = (
    b"-1",
    b"0",
    b"nan",
    b"inf",
    b"-inf",
    b"1e999",
    b"-1e999",
    b"1e-999",
    b"99999999999999999999",
    b"65536",
    b"70000",
    b"4294967296",
    b"--",
    b"",
    b"1.5",
    b"0x10",
    b"true",
    b"null",
    "²".encode(),
    "٣".encode(),
    b"1_000",
    b"+",
    b".",
    b"e",
    b'"',
    b"{}",
    b"[]",
    b"9" * 5000,
    b"0." + b"0" * 400 + b"1",
    b"a" * 300,
    b"\x00",
    b"\xff\xfe",
    b"#",
    b"%",
    b"../../../etc/passwd",
    b"/etc/passwd",
    b"!!python/object/apply:os.system",
    b"&a",
    b"*a",
)


def _at(rng: np.random.Generator, data: bytes, width: int = 1) -> int:
    """A place for ``width`` bytes; half of the time in the first kilobyte, where headers are."""
    room = len(data) - width + 1
    return int(rng.integers(0, max(min(room, 1024) if rng.random() < 0.5 else room, 1)))


def _put(data: bytes, at: int, new: bytes) -> bytes:
    return data[:at] + new + data[at + len(new) :]


def flip_bits(rng, data):
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 8, 32]))):
        if out:
            out[_at(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def truncate(rng, data):
    return data[: _at(rng, data)] if rng.random() < 0.7 else data[: max(len(data) - int(rng.integers(1, 20)), 0)]


def extend(rng, data):
    return data + (
        rng.bytes(int(rng.choice([1, 4, 64, 5000]))) if rng.random() < 0.5 else data[-int(rng.integers(1, 200)) :]
    )


def overwrite(rng, data):
    n = int(rng.choice([1, 2, 4, 16, 256]))
    return _put(data, _at(rng, data, n), [b"\0" * n, b"\xff" * n, rng.bytes(n)][int(rng.integers(3))])[: len(data)]


def move_block(rng, data):
    a, b = sorted((_at(rng, data), _at(rng, data)))
    b = min(b, a + int(rng.choice([1, 8, 64, 4096])))
    to = _at(rng, data)
    return [data[:a] + data[b:], data[:b] + data[a:b] + data[b:], data[:to] + data[a:b] + data[to:]][
        int(rng.integers(3))
    ]


def integer(rng, data):
    """An interesting integer of any width and byte order somewhere."""
    fmt = str(rng.choice(["<B", "<H", ">H", "<I", ">I", "<Q", ">Q"]))
    return _field(rng, data, _at(rng, data, struct.calcsize(fmt)), fmt)


def floating(rng, data):
    fmt = str(rng.choice(["<f", "<d", ">f"]))
    at = _at(rng, data, struct.calcsize(fmt)) // 4 * 4
    return _field(rng, data, at, fmt)


def _field(rng, data, at, fmt):
    size = struct.calcsize(fmt)
    if at + size > len(data):
        return data
    if fmt[-1] in "fd":
        with np.errstate(over="ignore"):
            value = rng.choice(_FLOATS)
            return _put(
                data,
                at,
                np.array(value, ("<" if fmt[0] == "<" else ">") + ("f4" if fmt[-1] == "f" else "f8")).tobytes(),
            )
    old = struct.unpack_from(fmt, data, at)[0]
    value = [
        int(_INTEGERS[int(rng.integers(len(_INTEGERS)))]),
        old + 1,
        old - 1,
        old * 2,
        old // 2,
        old + int(rng.integers(-300, 300)),
    ][int(rng.integers(6)) if rng.random() < 0.6 else 0]
    return _put(data, at, (value % (1 << 8 * size)).to_bytes(size, "little" if fmt[0] == "<" else "big"))


def token(rng, data):
    """A number in text becomes something else."""
    found = list(re.finditer(rb"[-+]?\d[\d.eE+-]*", data[:200_000]))
    if not found:
        return overwrite(rng, data)
    m = found[int(rng.integers(len(found)))]
    return data[: m.start()] + _TOKENS[int(rng.integers(len(_TOKENS)))] + data[m.end() :]


def word(rng, data):
    """A word, line or separator in text is lost, doubled, or another."""
    found = list(re.finditer([rb"[A-Za-z_@]+", rb"[^\n]*\n", rb"[:,{}\[\]\s]"][int(rng.integers(3))], data[:200_000]))
    if not found:
        return overwrite(rng, data)
    m, other = (found[int(rng.integers(len(found)))] for _ in range(2))
    new = [b"", m[0] * 2, m[0] * 1000, other[0], _TOKENS[int(rng.integers(len(_TOKENS)))]][int(rng.integers(5))]
    return data[: m.start()] + new + data[m.end() :]


def other_kind(rng, data):
    """The beginning of a file of quite another kind, or nothing."""
    heads = (
        b"",
        b"\x89PNG\r\n\x1a\n",
        b"PK\x03\x04",
        b"\x89HDF\r\n\x1a\n",
        b"glTF\x02\0\0\0",
        b"\x93NUMPY\x01\0",
        b"% evt 3.0\n% end\n",
        b"#!AER-DAT4.0\r\n",
        b'{"a": 1}',
        b"solid\n",
        b"ply\n",
        b"#?RADIANCE\n",
        b"PF\n4 4\n-1\n",
        b"\x80\x05\x95",
        b"the quick brown fox\n",
        b"\0" * 100,
    )
    head = heads[int(rng.integers(len(heads)))]
    return head + (data[len(head) :] if rng.random() < 0.5 else b"")


BLIND: tuple[Mutator, ...] = (
    flip_bits,
    flip_bits,
    truncate,
    extend,
    overwrite,
    move_block,
    integer,
    integer,
    floating,
    other_kind,
)
TEXT: tuple[Mutator, ...] = (flip_bits, truncate, move_block, token, token, token, word, word, other_kind)


def fields(layout: Layout) -> Mutator:
    """Damages one of the numbers that ``layout`` finds."""

    def mutate(rng, data):
        places = layout(data)
        return _field(rng, data, *places[int(rng.integers(len(places)))]) if places else overwrite(rng, data)

    return mutate


def fixed(*places: tuple[int, str]) -> Mutator:
    """Damages one of the numbers at places that are always the same."""
    return fields(lambda _: list(places))


# ---- trees -----------------------------------------------------------------------------------------------------------


def _leaf(rng) -> Any:
    return [
        None,
        True,
        -1,
        0,
        1,
        5,
        0.5,
        1e308,
        -1e308,
        float("nan"),
        float("inf"),
        10**9,
        2**63,
        2**64,
        10**400,
        "",
        "a",
        "nan",
        "a" * 5000,
        "\0",
        "../..",
        "²",
        [],
        {},
        [[]],
        [1, 2, 3],
        {"a": {}},
        [None] * 4,
        ["a"] * 3,
        [1e308] * 3,
        [0] * 3,
        [0] * 4,
        [float("nan")] * 3,
        _nested(rng),
    ][int(rng.integers(34))]


def _nested(rng) -> Any:
    tree: Any = 0
    for _ in range(int(rng.choice([10, 200, 900]))):
        tree = [tree] if rng.random() < 0.5 else {"a": tree}
    return tree


def tree(rng, value: Any) -> Any:
    """Plain data with one place replaced, lost, renamed or doubled."""
    places: list[tuple[Any, Any]] = []

    def walk(node):
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    root = [value]
    walk(root)
    parent, key = places[int(rng.integers(len(places)))]
    how = rng.random()
    if how < 0.55:
        parent[key] = _leaf(rng)
    elif how < 0.7:
        source, name = places[int(rng.integers(len(places)))]
        parent[key] = json.loads(json.dumps(source[name]))
    elif how < 0.85 and parent is not root:
        del parent[key]
    elif isinstance(parent, dict):
        parent[str(_leaf(rng))[:9]] = parent.pop(key)
    else:
        parent.append(parent[key]) if parent is not root else None
    return root[0]


def _dump(value: Any) -> bytes:
    try:
        return json.dumps(value).encode()
    except (ValueError, RecursionError):
        return b"{}"


def json_tree(rng, data):
    return _dump(tree(rng, json.loads(data)))


def json_lines(rng, data):
    lines = data.splitlines()
    k = int(rng.integers(len(lines)))
    lines[k] = json_tree(rng, lines[k])
    return b"\n".join(lines) + b"\n"


def yaml_tree(rng, data):
    from blinkgl.config.reader import parse_yaml, to_yaml

    return to_yaml(tree(rng, parse_yaml(data.decode(), "seed"))).encode("utf-8", "surrogatepass")


def glb_tree(rng, data):
    """The JSON of a GLB, lengths right again."""
    length = struct.unpack_from("<I", data, 12)[0]
    text = _dump(tree(rng, json.loads(data[20 : 20 + length])))
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def safetensors_tree(rng, data):
    """The header of a safetensors file, its length right again; now and then the metadata inside."""
    length = struct.unpack_from("<Q", data)[0]
    header = json.loads(data[8 : 8 + length])
    if rng.random() < 0.4 and "model" in header.get("__metadata__", {}):
        header["__metadata__"]["model"] = _dump(tree(rng, json.loads(header["__metadata__"]["model"]))).decode()
    else:
        header = tree(rng, header)
    text = _dump(header)
    return struct.pack("<Q", len(text)) + text + data[8 + length :]


def safetensors_values(rng, data):
    """NaN and infinity among the weights."""
    start = 8 + struct.unpack_from("<Q", data)[0]
    at = start + int(rng.integers(0, (len(data) - start) // 4)) * 4
    return _field(rng, data, at, "<f")


# ---- images ----------------------------------------------------------------------------------------------------------


def png_chunks(rng, data):
    """A chunk lost, doubled, moved or changed, checksums right again."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = int(rng.integers(len(chunks)))
    kind, body = chunks[k]
    how = int(rng.integers(6))
    if how == 0:
        kind, body = chunks[0]
        k = 0
        body = _field(
            rng,
            body,
            *[(0, ">I"), (4, ">I"), (8, "<B"), (9, "<B"), (10, "<B"), (11, "<B"), (12, "<B")][int(rng.integers(7))],
        )
    elif how == 1 and body:
        body = flip_bits(rng, body)
    elif how == 2:
        body = body[: int(rng.integers(0, len(body) + 1))]
    elif how == 3 and kind == b"IDAT":
        body = zlib.compress(zlib.decompress(body)[: int(rng.integers(0, 200))])
    elif how == 4:
        kind = bytes(rng.choice(list(b"IHDRPLTEtRNSacTLfdAT"), 4).astype(np.uint8))
    chunks[k] = (kind, body)
    if how == 5:
        chunks.insert(int(rng.integers(len(chunks))), chunks[k]) if rng.random() < 0.5 else chunks.pop(k)
    return data[:8] + b"".join(
        struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks
    )


# ---- NumPy -----------------------------------------------------------------------------------------------------------


def npy_header(rng, data):
    """Another shape, type or order in the header, padded as it should be."""
    start = 10 + struct.unpack_from("<H", data, 8)[0]
    old = ast.literal_eval(data[10:start].decode())
    n = [0, 1, 5, -1, 10**5, 10**9, 10**12, 2**63 - 1, 2**64][int(rng.integers(9))]
    shape = [(n,), (n, *old["shape"][1:]), (*old["shape"], n), (), old["shape"][::-1], (n, n, n), (2,) * 40][
        int(rng.integers(7))
    ]
    descr = [
        "<f8",
        "<i4",
        "|O",
        "|b1",
        "<c16",
        "<U5",
        "|S3",
        "|V7",
        "<M8[us]",
        ">f4",
        "<f2",
        "|u1",
        [("t", "<f8"), ("x", "<i8"), ("y", "<f4"), ("p", "|b1")],
        [("t", "<i8"), ("x", "<u2", (3,)), ("y", "<u2"), ("p", "|u1")],
        "nonsense",
        5,
    ][int(rng.integers(16))]
    new = {
        **old,
        **[{"shape": shape}, {"descr": descr}, {"fortran_order": True}, {"shape": shape, "descr": descr}, {"extra": 1}][
            int(rng.integers(5))
        ],
    }
    if rng.random() < 0.3:  # a body of the length that the header claims
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                count = (
                    int(np.prod([float(v) for v in new["shape"]]))
                    * np.dtype(
                        [tuple(f) for f in new["descr"]] if isinstance(new["descr"], list) else new["descr"]
                    ).itemsize
                )
                data = data[:start] + (data[start:] * 50)[:count] if 0 < count < 10**6 else data
            except (TypeError, ValueError, OverflowError):
                pass
    text = (repr(new) + "\n").encode()
    return data[:8] + struct.pack("<H", len(text)) + text + data[start:]


def arrays(rng, data):
    """An .npz with one entry of another type, shape or kind, or none."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    name = str(rng.choice(list(members)))
    a = np.lib.format.read_array(io.BytesIO(members[name]))
    how = int(rng.integers(8))
    if how == 0:
        members[name] = npy_header(rng, members[name])
    elif how == 1:
        members.pop(name)
    elif how == 2:
        members[name] = b"no array at all" if rng.random() < 0.5 else rng.bytes(50)
    elif how == 3:
        members[f"{name.removesuffix('.npy')}.txt"] = members.pop(name)
    else:
        stream = io.BytesIO()
        np.save(stream, values(rng, a), allow_pickle=True)
        members[name] = stream.getvalue()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED) as archive:
        for n, b in members.items():
            archive.writestr(n, b)
    return out.getvalue()


def values(rng, a: np.ndarray) -> np.ndarray:
    """Another array in place of ``a``: type, shape, order, or some of its values."""
    how = int(rng.integers(9))
    with np.errstate(all="ignore"):
        if how == 0 and a.dtype.names is None:
            return a.astype(str(rng.choice(["f8", "f4", "i8", "i2", "u1", "u8", "?", "c8", "S4", "U3", "O"])))
        if how == 1:
            return (
                [
                    a[:-1],
                    a[:0],
                    np.concatenate([a, a]) if a.ndim else np.stack([a, a]),
                    a[None],
                    a[..., None],
                    np.asarray(5),
                    a.T,
                ][int(rng.integers(7))]
                if a.ndim
                else np.zeros(3)
            )
        if how == 2:
            return a[::-1] if a.ndim else a - 1
        if how == 3:
            return np.zeros_like(a)
        if a.dtype.names is not None:
            a = a.copy()
            name = str(rng.choice(a.dtype.names))
            a[name] = values_in(rng, a[name])
            return a
        wide = a.astype(np.float64 if rng.random() < 0.5 else np.int64)
        return values_in(rng, np.atleast_1d(wide)).reshape(a.shape)


def values_in(rng, a: np.ndarray) -> np.ndarray:
    """A few extreme values among those of ``a``."""
    a = np.array(a)
    flat = a.reshape(-1)
    for _ in range(int(rng.integers(1, 4))):
        if len(flat):
            with np.errstate(all="ignore"):
                value = rng.choice(_FLOATS) if a.dtype.kind == "f" else _INTEGERS[int(rng.integers(len(_INTEGERS)))]
                flat[int(rng.integers(len(flat)))] = np.array(value % 2**63 if a.dtype.kind in "iu" else value).astype(
                    a.dtype
                )
    return a


def zip_layout(data):
    """Sizes, offsets and methods of a zip's headers."""
    places = []
    for magic, found in (
        (b"PK\x03\x04", ((4, "<H"), (6, "<H"), (8, "<H"), (14, "<I"), (18, "<I"), (22, "<I"), (26, "<H"), (28, "<H"))),
        (
            b"PK\x01\x02",
            ((8, "<H"), (10, "<H"), (16, "<I"), (20, "<I"), (24, "<I"), (28, "<H"), (30, "<H"), (42, "<I")),
        ),
        (b"PK\x05\x06", ((8, "<H"), (10, "<H"), (12, "<I"), (16, "<I"), (20, "<H"))),
    ):
        at = data.find(magic)
        while at >= 0:
            places += [(at + o, f) for o, f in found]
            at = data.find(magic, at + 1)
    return places


# ---- HDF5 ------------------------------------------------------------------------------------------------------------


def hdf5_layout(data):
    """Every eight bytes that may be an offset, size or count of the file's own structures."""
    words = np.frombuffer(data[: len(data) // 8 * 8], "<u8")
    return [
        (int(i) * 8, "<Q") for i in np.flatnonzero((words > 0) & (words <= 4 * len(data)) | (words == 2**64 - 1))[:4000]
    ]


def hdf5_objects(rng, data):
    """One data set replaced: type, shape, group, a link elsewhere, external storage, virtual,
    claims without data; or an attribute."""
    import h5py

    stream = io.BytesIO(data)
    with h5py.File(stream, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        name = str(rng.choice(names))
        if file.attrs and rng.random() < 0.15:
            key = str(rng.choice(list(file.attrs)))
            file.attrs[key] = [0, -1, 2**40, 1.5, "a", [1, 2], np.nan, h5py.Empty("i8"), 65537, 1][
                int(rng.integers(10))
            ]
            return _closed(file, stream)
        old = file[name][()] if file[name].size < 10**6 else np.zeros(3)
        del file[name]
        how = int(rng.integers(13))
        if how == 0:
            file.create_group(name)
        elif how == 1:
            file[name] = h5py.SoftLink(str(rng.choice([f"/{name}", "/nowhere", f"/{names[0]}", "/"])))
        elif how == 2:
            file[name] = h5py.ExternalLink("/etc/passwd" if rng.random() < 0.5 else "other.h5", "/x")
        elif how == 3:
            file.create_dataset(
                name, np.shape(old), np.asarray(old).dtype, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
            )
        elif how == 4:
            layout = h5py.VirtualLayout(np.shape(old) or (1,), np.asarray(old).dtype)
            layout[...] = h5py.VirtualSource("/etc/passwd", "x", np.shape(old) or (1,))
            file.create_virtual_dataset(name, layout)
        elif how == 5:
            n = int(rng.choice([10**6, 10**9, 10**15]))
            file.create_dataset(
                name,
                (n, *np.shape(old)[1:]),
                np.asarray(old).dtype,
                chunks=(min(n, 10**5), *np.shape(old)[1:]),
                compression="gzip",
            )
        elif how == 6:
            file[name] = h5py.Empty("i8")
        elif how == 7:
            file.create_dataset(name, data=["a", "b"], dtype=h5py.string_dtype())
        else:
            new = values(rng, np.asarray(old))
            file[name] = new.astype("S4") if new.dtype.kind in "UO" else new
        return _closed(file, stream)


def _closed(file, stream: io.BytesIO) -> bytes:
    file.close()
    return stream.getvalue()


# ---- binary layouts that move ----------------------------------------------------------------------------------------


def box_layout(data):
    """Sizes of an MP4's boxes, and the words after them."""
    return [
        (m.start() - 4 + o, ">I")
        for m in re.finditer(rb"moov|mdat|trak|mdia|minf|stbl|stsd|stts|stsz|stco|stsc|mvhd|tkhd|mdhd|avc1|ftyp", data)
        if m.start() >= 4
        for o in (0, 8, 12, 16, 20, 24)
    ]


def words_layout(width: int, start: bytes = b"% end\n") -> Layout:
    """Words of ``width`` bytes after a header that ends with ``start``."""

    def layout(data):
        begin = data.find(start) + len(start)
        return [(i, {2: "<H", 4: "<I"}[width]) for i in range(begin, len(data) - width, width)]

    return layout
