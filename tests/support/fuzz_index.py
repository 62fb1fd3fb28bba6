"""Mutate an index file in every way we know; each mutant must be refused or read as written.

    python tests/support/fuzz_index.py [--count 100000] [--seed 0] [--index REF.index]

Prints one JSON object: mutants by kind, how many were refused, and the peak of memory above the file's size. Without
`--index` a small file of its own is mutated. A crash of the interpreter is, of course, a failure too.
"""

import argparse
import json
import pickle
import resource
import struct
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo.errors import IndexFormatError
from roadgeo.reference import index_file, plain_values
from roadgeo.reference.index_file import read_index, write_index

Rng = np.random.Generator
HEAD = b"\x80\x05"
SCALARS = [b"K\x01", b"J\xff\xff\xff\xff", b"N", b"\x88", b"G" + b"\x7f\xf0" + bytes(6), b"\x8c\x01a", b"]", b"}", b"("]
OPCODES = [bytes([code]) for code in range(256)]
NUMBERS: list[Any] = [-1, 0, 1, 63, 64, 2**31, 2**62, 2**64, 1e400, 0.5, None, True, "8", [], {}, [[]], "\ud800"]


class Call:
    """Runs `eval` where it is unpickled carelessly."""

    def __reduce__(self) -> Any:
        return eval, ("1/0",)


# --- damage: the digests stay as they were ----------------------------------------------------------------------------


def flip_bits(raw: bytearray, rng: Rng) -> None:
    for at in rng.integers(0, len(raw), rng.integers(1, 9)):
        raw[at] ^= 1 << int(rng.integers(8))


def flip_header_bits(raw: bytearray, rng: Rng) -> None:
    raw[int(rng.integers(0, min(len(raw), 4096)))] ^= 1 << int(rng.integers(8))


def overwrite(raw: bytearray, rng: Rng) -> None:
    size = int(rng.integers(1, 300))
    at = int(rng.integers(0, len(raw)))
    raw[at : at + size] = rng.bytes(size) if rng.random() < 0.5 else bytes(size)


def truncate(raw: bytearray, rng: Rng) -> None:
    del raw[int(rng.integers(0, len(raw))) :]


def extend(raw: bytearray, rng: Rng) -> None:
    raw += rng.bytes(int(rng.integers(1, 5000)))


def cut_out(raw: bytearray, rng: Rng) -> None:
    at = int(rng.integers(0, len(raw)))
    del raw[at : at + int(rng.integers(1, 500))]


def swap_ranges(raw: bytearray, rng: Rng) -> None:
    size = 64 * int(rng.integers(1, 64))
    a, b = (64 * int(rng.integers(0, len(raw) // 64)) for _ in range(2))
    raw[a : a + size], raw[b : b + size] = raw[b : b + size], raw[a : a + size]


def swap_buffers(raw: bytearray, rng: Rng) -> None:
    manifest, start = parse(raw)
    a, b = (manifest["arrays"][i] for i in rng.choice(len(manifest["arrays"]), 2, replace=False))
    size = min(nbytes(a), nbytes(b))
    a, b = start + a["offset"], start + b["offset"]
    raw[a : a + size], raw[b : b + size] = raw[b : b + size], raw[a : a + size]


# --- forgery: the header's and the pickle's digests are made to agree -------------------------------------------------


def parse(raw: bytes | bytearray) -> tuple[dict[str, Any], int]:
    size = struct.unpack_from("<I", raw, 20)[0]
    return json.loads(bytes(raw[64 : 64 + size])), index_file._aligned(64 + size)


def nbytes(entry: dict[str, Any]) -> int:
    return int(np.prod(entry["shape"], dtype=int)) * np.dtype(entry["dtype"]).itemsize


def rebuild(raw: bytearray, manifest: Any, data: bytes) -> None:
    header = index_file._header(manifest if isinstance(manifest, bytes) else json.dumps(manifest).encode())
    raw[:] = header + bytes(-len(header) % 64) + data


def forge_manifest(raw: bytearray, rng: Rng) -> None:
    """Give some value anywhere in the manifest another one of any kind, or take it away."""
    manifest, start = parse(raw)
    data = bytes(raw[start:])
    parent, key = manifest, str(rng.choice(["format", "size", "pickle", "arrays", "arrays", "arrays", "arrays"]))
    while isinstance(parent[key], (dict, list)) and parent[key] and rng.random() < 0.9:
        parent = parent[key]
        key = rng.choice(list(parent)).item() if isinstance(parent, dict) else int(rng.integers(len(parent)))
    if rng.random() < 0.1:
        del parent[key]
    elif isinstance(parent[key], int) and rng.random() < 0.5:
        parent[key] += int(rng.choice([-64, -1, 1, 64, 1 << 40]))
    else:
        parent[key] = NUMBERS[int(rng.integers(len(NUMBERS)))]
    rebuild(raw, manifest, data)


def forge_manifest_text(raw: bytearray, rng: Rng) -> None:
    """Break the manifest as text, its digest agreeing."""
    manifest, start = parse(raw)
    text = bytearray(json.dumps(manifest).encode())
    for mutate in rng.choice([flip_bits, overwrite, cut_out, truncate], int(rng.integers(1, 3))):
        mutate(text, rng)
        text += b" " * (not text)
    rebuild(raw, bytes(text), bytes(raw[start:]))


def swap_entries(raw: bytearray, rng: Rng) -> None:
    """Give two arrays each other's name, type, shape or place."""
    manifest, start = parse(raw)
    a, b = (manifest["arrays"][i] for i in rng.choice(len(manifest["arrays"]), 2, replace=False))
    for key in rng.choice(list(a), int(rng.integers(1, 3)), replace=False):
        a[key], b[key] = b[key], a[key]
    rebuild(raw, manifest, bytes(raw[start:]))


def put_pickle(raw: bytearray, pickled: bytes) -> None:
    """Replace the pickle by another of any size; the arrays move."""
    manifest, start = parse(raw)
    old, new = (index_file._aligned(size) for size in (manifest["pickle"]["size"], len(pickled)))
    for entry in manifest["arrays"]:
        entry["offset"] += new - old
    manifest["size"] += new - old
    manifest["pickle"] = {"size": len(pickled), "digest": index_file._digest(pickled)}
    rebuild(raw, manifest, pickled + bytes(-len(pickled) % 64) + bytes(raw[start + old :]))


def get_pickle(raw: bytearray) -> bytes:
    manifest, start = parse(raw)
    return bytes(raw[start : start + manifest["pickle"]["size"]])


def forge_pickle_bytes(raw: bytearray, rng: Rng) -> None:
    pickled = bytearray(get_pickle(raw))
    for mutate in rng.choice([flip_bits, overwrite, cut_out], int(rng.integers(1, 3))):
        mutate(pickled, rng)
        pickled += b"." * (not pickled)
    put_pickle(raw, bytes(pickled))


def forge_pickle_opcodes(raw: bytearray, rng: Rng) -> None:
    """Put random opcodes in a row."""
    parts = [SCALARS, OPCODES, [b"u", b"s", b"a", b"e", b"0", b"2", b"h\x00", b"\x94", b"R", b"b", b"\x85"]]
    body = b"".join(str_choice(parts[int(rng.integers(3))], rng) for _ in range(rng.integers(1, 30)))
    put_pickle(raw, HEAD + b"}" + body + b".")


def str_choice(options: list[bytes], rng: Rng) -> bytes:
    return options[int(rng.integers(len(options)))]


def forge_pickle_bombs(raw: bytearray, rng: Rng) -> None:
    """Hand-made pickles: calls, names, huge shapes, object arrays, deep nesting, memory bombs."""
    huge = struct.pack("<Q", 1 << int(rng.integers(20, 63)))
    many = int(rng.integers(1, 400_000))
    bombs = [
        pickle.dumps(Call(), int(rng.integers(0, 6))),
        pickle.dumps({"a": [Call()]}, 5),
        pickle.dumps(np.array([{}, object], object), int(rng.integers(2, 6))),
        pickle.dumps({"a": np.zeros((3, 3))}, int(rng.integers(2, 6))),
        pickle.dumps(np.dtype("O"), 4),
        HEAD + b"cbuiltins\neval\n(V1/0\ntR.",
        HEAD + b"\x8c\x08builtins\x8c\x04exec\x93.",
        HEAD + b"\x8e" + huge + b".",
        HEAD + b"\x96" + huge + b".",
        HEAD + b"\x8d" + huge + b".",
        HEAD + b"\x95" + huge + b"}.",
        HEAD + b"}r" + huge[:4] + b".",
        HEAD + b"}X\xff\xff\xff\xff.",
        HEAD + b"}\x8b\xff\xff\xff\x7f.",
        HEAD + b"]" * many + b"a" * (many - 1) + b".",
        HEAD + b"}" * many + b".",
        HEAD + b"(" * many + b"e.",
        HEAD + b"]\x94" + b"(h\x00h\x00e" * (many // 8) + b".",
        HEAD + b"}" + b"\x8c\x01a}" * (many // 4) + b"s" * (many // 4) + b".",
        b"",
    ]
    put_pickle(raw, str_choice(bombs, rng))


MUTATIONS: list[Callable[[bytearray, Rng], None]] = [
    flip_bits, flip_header_bits, overwrite, truncate, extend, cut_out, swap_ranges, swap_buffers,
    forge_manifest, forge_manifest_text, swap_entries,
    forge_pickle_bytes, forge_pickle_opcodes, forge_pickle_bombs,
]  # fmt: skip


# --- the judge --------------------------------------------------------------------------------------------------------


def is_refused(path: Path, meta: dict[str, Any], arrays: dict[str, np.ndarray], kind: str) -> bool:
    """Whether a mutant is refused; one that is not must read as written (a forged pickle: as plain values)."""
    try:
        found_meta, found = read_index(path)
    except IndexFormatError:
        return True
    if "pickle" in kind:
        plain_values.require_plain(found_meta)
    else:
        assert found_meta == meta, kind
    if not arrays.keys() <= found.keys():
        return True  # by `ReferenceIndex.from_parts`, which misses an array
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype, kind
        np.testing.assert_array_equal(found[name], array, kind)
    return False


def own_index(path: Path) -> None:
    """Write a small index that has what real ones have."""
    rng = np.random.default_rng(0)
    meta = {"name": "town", "origin": [1.5, 2e6], "shape": [3, 4], "options": {"n": 8, "deep": [[1, None, True]]}}
    arrays = {
        "xy": rng.normal(size=(100, 2)),
        "rays": rng.normal(size=(100, 8)).astype(np.float32),
        "tangents": rng.normal(size=(100, 8)).astype(np.float32),
        "neighbours": rng.integers(-1, 100, (100, 8)).astype(np.int32),
        "starts": np.arange(3000, dtype=np.int32),
        "entries": rng.integers(0, 2**63, 4000).astype(np.uint64),
    }
    write_index(path, meta, arrays, {"name": "town"})


def fuzz(source: Path, count: int, seed: int) -> dict[str, Any]:
    """Read `count` mutants of an index; statistics."""
    raw = source.read_bytes()
    meta, mapped = read_index(source)
    arrays = {name: array.copy() for name, array in mapped.items()}
    made, refused = Counter[str](), Counter[str]()
    start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutant.index"
        for i in range(count):
            mutate = MUTATIONS[i % len(MUTATIONS)]
            mutant = bytearray(raw)
            mutate(mutant, np.random.default_rng([seed, i]))
            path.unlink(missing_ok=True)
            path.write_bytes(mutant)
            kind = mutate.__name__
            made[kind] += 1
            refused[kind] += is_refused(path, meta, arrays, kind)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "mutants": count,
        "refused": refused.total(),
        "by_kind": {kind: [refused[kind], n] for kind, n in made.items()},
        "peak_above_start_mb": (peak - start) / 1024,
        "file_mb": len(raw) / 1e6,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--index", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        source = options.index or Path(folder) / "town.index"
        if options.index is None:
            own_index(source)
        print(json.dumps(fuzz(source, options.count, options.seed)))


if __name__ == "__main__":
    main()
