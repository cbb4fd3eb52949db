"""Damage: one valid file in, one that is broken in some way out. Every mutation is a pure function of its seed."""

import io
import json
import re
import zipfile

import h5py
import hdf5plugin  # noqa: F401  (registers the filters of events.h5)
import numpy as np

#: Values that stand where others are expected.
ODD = [
    None, True, "x", "", "1", -1, 0, 1e300, -1e300, 1e-300, float("nan"), float("inf"), 2**62, 2**64, -(2**70), 0.5, [],
    {}, [[]], [1, "a"], {"a": 1}, "../../etc/passwd", "/dev/zero", "\x1b[31m", "<script>", "\ud800", 10**400,
]  # fmt: skip
ODD_TEXT = [
    "null", "true", "x", "''", "-1", "0", "1e300", "-1e300", "1.0e-300", ".nan", ".inf", "4611686018427387904",
    "[]", "{}",
    "[1, a]", "../x", "/dev/zero", "'\\x1b[31m'", "<script>", "&a [*a]", "*a", "!!binary x", "2001-99-99", "? x", "- -",
    "{a: {b: c}}", "'", '"', "\t", "!!python/object:os.system x", "%", "@", "1" * 400,
]  # fmt: skip


def damaged_bytes(data, rng):
    """Cut short, bits turned, parts removed, doubled, exchanged, overwritten or added."""
    data = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2, 5]))):
        size = max(1, len(data))
        # headers, ends and middles alike
        at = int(
            rng.choice([rng.integers(size), min(size - 1, rng.integers(512)), max(0, size - 1 - rng.integers(256))])
        )
        length = int(rng.choice([1, 4, 32, 500]))
        kind = rng.integers(8)
        if kind == 0:
            del data[at:]
        elif kind == 1 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = data[at : at + length]
        elif kind == 4:
            data[at : at + length] = bytes(rng.integers(0, 256, min(length, size - at), dtype=np.uint8))
        elif kind == 5:
            data[at : at + length] = b"\xff" * min(length, size - at)
        elif kind == 6:
            data[at : at + length] = bytes(min(length, size - at))
        else:
            data += bytes(rng.integers(0, 256, length, dtype=np.uint8))
    return bytes(data)


def damaged_text(data, rng):
    """A value exchanged, a line removed, doubled, moved in or renamed."""
    lines = data.decode().split("\n")
    at, kind = int(rng.integers(len(lines))), rng.integers(7)
    odd = ODD_TEXT[rng.integers(len(ODD_TEXT))]
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[at])
    elif kind == 2:
        lines[at] = "  " + lines[at]
    elif kind == 3:
        lines[at] = re.sub(r"(\w+):", r"\1x:", lines[at], count=1)
    elif kind == 4:
        lines[at] = re.sub(r":\s.*", lambda _: f": {odd}", lines[at], count=1)
    else:
        tokens = list(re.finditer(r"[-+.\w]+", data.decode()))
        token = tokens[rng.integers(len(tokens))]
        text = data.decode()
        return (text[: token.start()] + odd + text[token.end() :]).encode("utf-8", "surrogatepass")
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _leaves(node, path=()):
    yield path
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, (*path, key))
    elif isinstance(node, list):
        for key, value in enumerate(node[:40]):
            yield from _leaves(value, (*path, key))


def damaged_json(data, rng):
    """One value of it, at any depth, exchanged or removed."""
    tree = json.loads(data)
    places = list(_leaves(tree))[1:]
    by_top = sorted({path[0] for path in places})
    top = by_top[rng.integers(len(by_top))]  # long lists are not all there is
    inside = [path for path in places if path[0] == top]
    path = inside[rng.integers(len(inside))]
    node = tree
    for key in path[:-1]:
        node = node[key]
    if rng.random() < 0.2:
        del node[path[-1]]
    elif rng.random() < 0.15 and isinstance(node, dict):
        node["surplus"] = 1
    else:
        node[path[-1]] = ODD[rng.integers(len(ODD))]
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def damaged_array(array, rng):
    """Another size, type or content."""
    kind = rng.integers(12)
    if kind == 0:
        return array.ravel()[: array.size // 2]
    if kind == 1:
        return array[..., None]
    if kind == 2:
        return array.astype(str)
    if kind == 3:
        return np.array([None, {"a": 1}], dtype=object)
    if kind == 4:
        return np.full_like(array, np.nan if array.dtype.kind == "f" else 0)
    if kind == 5:
        return np.zeros(0, array.dtype)
    if kind == 6:
        return np.array(5)
    if kind == 7:
        return array.astype(np.complex128)
    if kind == 8:
        return -array.astype(np.float64) - 5
    if kind == 9:
        return array.astype(np.float64) * 1e300
    if kind == 10:
        return np.zeros(array.shape, dtype=[("a", "u2"), ("b", "f4")])
    out = array.astype(np.float64)
    out.ravel()[rng.integers(max(1, out.size)) :][:3] = [np.nan, np.inf, -np.inf][: out.ravel()[:3].size][:1]
    return out


def damaged_npz(data, rng):
    with np.load(io.BytesIO(data), allow_pickle=True) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = sorted(arrays)[rng.integers(len(arrays))]
    kind = rng.integers(10)
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays["surplus"] = arrays[name]
    elif kind > 1:
        arrays[name] = damaged_array(arrays[name], rng)
    out = io.BytesIO()
    (np.savez if rng.random() < 0.5 else np.savez_compressed)(out, **arrays)
    return out.getvalue() if kind < 9 else _lying_npz(arrays, name, rng)


def _lying_npz(arrays, name, rng):
    """Headers that promise more than there is, or ask for more than any machine has."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, array in arrays.items():
            part = io.BytesIO()
            shape = (int(rng.choice([10**6, 2**40, 2**62])),) * array.ndim if key == name else array.shape
            header = {"descr": array.dtype.str, "fortran_order": bool(rng.integers(2)), "shape": shape}
            np.lib.format.write_array_header_2_0(part, header)
            part.write(array.tobytes() if array.dtype.kind != "O" else b"")
            archive.writestr(f"{key}.npy", part.getvalue())
    return out.getvalue()


def damaged_npy(data, rng):
    out = io.BytesIO()
    np.save(out, damaged_array(np.load(io.BytesIO(data)), rng), allow_pickle=True)
    return out.getvalue()


def damaged_hdf5(data, rng):
    """Data sets and links exchanged for others."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        names = ["events/t", "events/x", "events/y", "events/p", "ms_to_idx", "t_offset", "events"]
        name = names[rng.integers(len(names))]
        values = file[name][()] if name != "events" else None
        kind = rng.integers(12)
        del file[name]
        if kind == 0 or values is None:
            file[name] = np.arange(5)
        elif kind == 1:
            file.create_group(name)
        elif kind == 2:
            file[name] = h5py.SoftLink("/events" if name != "events/t" else "/events/x")
        elif kind == 3:
            file[name] = h5py.ExternalLink("/etc/passwd", "/t")
        elif kind == 4:
            layout = h5py.VirtualLayout(shape=np.shape(values) or (1,), dtype=values.dtype)
            layout[:] = h5py.VirtualSource("other.h5", "t", shape=np.shape(values) or (1,))
            file.create_virtual_dataset(name, layout)
        elif kind == 5:
            file.create_dataset(name, (8,), "u4", external=[("/etc/hosts", 0, 32)])
        elif kind == 6:
            file.create_dataset(name, (2**40,), "u4", chunks=(1 << 20,), compression="gzip")
        elif kind == 7:
            file.create_dataset(name, (np.size(values),), "u1", data=np.zeros(np.size(values)), compression="szip"
                                if h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP) else "lzf")  # fmt: skip
        elif kind == 8:
            file[name] = np.full(np.shape(values), np.nan)
        elif kind == 9:
            file[name] = np.array([2**62, 2**63 - 1])
        elif kind == 10:
            file[name] = np.atleast_1d(values)[::-1]
        elif kind == 11 and rng.random() < 0.5:
            file[name] = np.atleast_1d(values)[: np.size(values) // 2]
    return buffer.getvalue()


#: Mutations by the ending of a file: damage of the bytes is possible for all of them.
BY_ENDING = {
    ".json": (damaged_json, damaged_text), ".yaml": (damaged_text,), ".xml": (damaged_text,), ".csv": (damaged_text,),
    ".npz": (damaged_npz,), ".npy": (damaged_npy,), ".h5": (damaged_hdf5,), ".obj": (damaged_text,),
}  # fmt: skip


def mutate(name, data, seed):
    """A damaged copy of a file's bytes."""
    rng = np.random.default_rng(seed)
    ending = name[name.rfind(".") :]
    choices = BY_ENDING.get(ending, ())
    if not choices or rng.random() < 0.35:
        return damaged_bytes(data, rng)
    try:
        return choices[rng.integers(len(choices))](data, rng)
    except (ValueError, TypeError, OverflowError, IndexError, KeyError):
        return damaged_bytes(data, rng)  # that damage does not fit this content
