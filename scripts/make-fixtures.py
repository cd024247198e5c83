#!/usr/bin/env python3
"""make-fixtures.py NAME...: write tests/fixtures/, the reference values that the tests compare with.

    safetensors    reference.safetensors   pip install torch==2.13.0 safetensors numpy
    torch_rng      torch_rng.json          pip install torch==2.13.0 numpy; on a processor with AVX2
    corpus         ../corpus/              nothing

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import sys


def safetensors():
    import torch
    from safetensors.torch import save_file

    x = torch.arange(6).reshape(2, 3) / 4 - 0.5
    save_file(
        {
            "f64": x.double(),
            "f32": x,
            "bf16": x.bfloat16(),
            "f16": x.half(),
            "scalar": torch.tensor(7.0),
            "steps": torch.arange(3),
        },
        "tests/fixtures/reference.safetensors",
        metadata={"made by": "the reference writer"},
    )


def torch_rng():
    """Calls of torch.randn after a seed: the values, or of a long one the FNV-1a hash of its bytes."""
    import json

    import torch

    runs = [
        (42, [("f32", 16), ("f32", 5), ("f32", 2), ("f32", 37), ("f64", 3), ("f64", 20), ("f32", 15), ("f64", 32)]),
        (0, [("f32", 1), ("f32", 17), ("f32", 1), ("f32", 1)]),
        (5000000007, [("f64", 17), ("f32", 24)]),
        (1, [("f32", 100003), ("f32", 9)]),
    ]
    out = []
    for seed, calls in runs:
        torch.manual_seed(seed)
        done = []
        for dtype, n in calls:
            x = torch.randn(n, dtype=torch.float64 if dtype == "f64" else torch.float32)
            call = {"dtype": dtype, "n": n}
            if n < 1000:
                call["values"] = [v.hex() for v in x.tolist()]
            else:
                h = 0xCBF29CE484222325
                for byte in x.numpy().tobytes():
                    h = (h ^ byte) * 0x100000001B3 % 2**64
                call["hash"] = f"{h:016x}"
            done.append(call)
        out.append({"seed": seed, "calls": done})
    with open("tests/fixtures/torch_rng.json", "w") as f:
        f.write(f"// torch {torch.__version__}: scripts/make-fixtures.py torch_rng\n")
        f.write(json.dumps(out, separators=(",", ":")).replace('{"dtype"', '\n{"dtype"') + "\n")


def corpus():
    """What the fuzzers start from: one small file of every kind, sound and damaged."""
    import os
    import struct

    def put(folder, files):
        os.makedirs(f"tests/corpus/{folder}", exist_ok=True)
        for name, data in files.items():
            with open(f"tests/corpus/{folder}/{name}", "wb") as f:
                f.write(data)

    put("json", {
        "empty": b"",
        "object": b'{"a": {"b": [1, -2.5e-3, true, null]}, "c": "d"}',
        "comments": b'// one\n{/* two */"a": 1} // three',
        "escapes": rb'["\"\\\/\b\f\n\r\t\u00e9\ud83d\ude00", "\u0000", "\ud800"]',
        "utf8": '["\u00e9\u20ac\U0001f600"]'.encode(),
        "not_utf8": b'["\xc0\x80\xff"]',
        "deep": b"[" * 65 + b"]" * 65,
        "deepest": b"[" * 64 + b"]" * 64,
        "twice": rb'{"a": 1, "\u0061": 2}',
        "numbers": b"[0, -0, 1e308, 1e309, 5e-324, 9007199254740993, 01]",
        "long_number": b"[" + b"1" * 64 + b"]",
        "cut": b'{"a": [1, {"b": "c',
        "set": b'{"a": {"b": 1}, "l": [0]}\0a.b=[1, {"x": null}]\0l.0=text\0n.e.w=1',
    })

    def file(header, data=0):
        return struct.pack("<Q", len(header)) + header.encode() + bytes(data)

    def record(dtype, shape, begin, end):
        return f'{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{begin},{end}]}}'

    f32 = record("F32", [2], 0, 8)
    put("safetensors", {
        "empty": file("{}"),
        "padded": file('{"a":' + f32 + "}   ", 8),
        "several": file('{"__metadata__":{"k":"v"},"a":' + f32 + ',"b":' + record("BF16", [3, 1], 8, 14)
                        + ',"c":' + record("I64", [], 14, 22) + "}", 22),
        "askew": file('{"a":' + record("U8", [1], 0, 1) + ',"b":' + record("F64", [1], 1, 9) + "}", 9),
        "hole": file('{"a":' + f32 + ',"b":' + record("U8", [1], 9, 10) + "}", 10),
        "overlap": file('{"a":' + f32 + ',"b":' + f32 + "}", 8),
        "trailing": file('{"a":' + f32 + "}", 9),
        "short": file('{"a":' + f32 + "}", 7),
        "huge_length": b"\xff" * 8 + b"{}",
        "product": file('{"a":' + record("F32", [2**32, 2**32], 0, 8) + "}", 8),
        "three_factors": file('{"a":' + record("U8", [2**22, 2**22, 2**21], 0, 8) + "}", 8),
        "zero": file('{"a":' + record("F32", [0], 0, 0) + "}"),
        "nine_dims": file('{"a":' + record("F32", [1] * 9, 0, 4) + "}", 4),
        "sign": file('{"a":' + record("F32", [-2], 0, 8) + "}", 8),
        "twice": file('{"a":' + f32 + ',"a":' + f32 + "}", 8),
        "deep": file('{"a":' + "[" * 70 + "}"),
        "name": file('{"a\\nb":' + f32 + "}", 8),
    })


if __name__ == "__main__":
    known = {f.__name__: f for f in (safetensors, torch_rng, corpus)}
    if not sys.argv[1:] or any(name not in known for name in sys.argv[1:]):
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        known[name]()
