#!/usr/bin/env python3
"""make-fixtures.py NAME...: write tests/fixtures/, the reference values that the tests compare with.

    safetensors    reference.safetensors   pip install torch==2.13.0 safetensors numpy

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


if __name__ == "__main__":
    known = {f.__name__: f for f in (safetensors,)}
    if not sys.argv[1:] or any(name not in known for name in sys.argv[1:]):
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        known[name]()
