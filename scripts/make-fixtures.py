#!/usr/bin/env python3
"""make-fixtures.py NAME...: write tests/fixtures/, the reference values that the tests compare with.

    safetensors    reference.safetensors   pip install torch==2.13.0 safetensors numpy
    torch_rng      torch_rng.json          pip install torch==2.13.0 numpy; on a processor with AVX2

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


if __name__ == "__main__":
    known = {f.__name__: f for f in (safetensors, torch_rng)}
    if not sys.argv[1:] or any(name not in known for name in sys.argv[1:]):
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        known[name]()
