#!/usr/bin/env python3
"""make-taew-fixtures.py: write tests/fixtures/taew_*.safetensors, what tests/test_taew.c compares with.

The tiny autoencoder written from its published layout (models/taew.h), in float64, layer by layer over whole clips.
Names are those of the public checkpoint, widths are small and all different.

    pip install torch==2.13.0 safetensors

    taew_weights.safetensors   bf16
    taew_stages.safetensors    clip in [-1, 1], latent, pixels: float64, the clip bf16

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import torch
import torch.nn.functional as f
from safetensors.torch import save_file

LATENT, ENCODER, DECODER = 5, 6, [8, 7, 6, 4]
FRAMES, ROWS, COLUMNS = 6, 48, 32

torch.manual_seed(7)
weights = {}


def conv(name, x, out, k=3, stride=1, bias=False):
    """x [T, C, H, W]"""
    if name + ".weight" not in weights:
        weights[name + ".weight"] = (torch.randn(out, x.shape[1], k, k) / (x.shape[1] * k * k) ** 0.5).bfloat16()
        if bias:
            grey = 0.5 if name == "decoder.22" else 0  # most pixels within their range
            weights[name + ".bias"] = (grey + 0.2 * torch.randn(out)).bfloat16()
    b = weights[name + ".bias"].double() if bias else None
    return f.conv2d(x, weights[name + ".weight"].double(), b, stride=stride, padding=k // 2)


def memory(name, x):
    c = x.shape[1]
    before = torch.cat([torch.zeros_like(x[:1]), x[:-1]])
    h = torch.relu(conv(f"{name}.conv.0", torch.cat([x, before], 1), c, bias=True))
    h = torch.relu(conv(f"{name}.conv.2", h, c, bias=True))
    return torch.relu(conv(f"{name}.conv.4", h, c, bias=True) + x)


def pool(name, x, s):
    t, c, h, w = x.shape
    return conv(name + ".conv", x.reshape(t // s, s * c, h, w), c, 1)


def grow(name, x, s):
    t, c, h, w = x.shape
    return conv(name + ".conv", x, s * c, 1).reshape(t * s, c, h, w)


def encode(x):
    x = torch.cat([x] + [x[-1:]] * (-len(x) % 4))
    x = torch.relu(conv("encoder.0", f.pixel_unshuffle(x, 2), ENCODER, bias=True))
    for i, s in ((2, 2), (7, 2), (12, 1)):
        x = conv(f"encoder.{i + 1}", pool(f"encoder.{i}", x, s), ENCODER, stride=2)
        for k in range(3):
            x = memory(f"encoder.{i + 2 + k}", x)
    return conv("encoder.17", x, LATENT, bias=True)


def decode(z):
    x = torch.relu(conv("decoder.1", 3 * torch.tanh(z / 3), DECODER[0], bias=True))
    for level, (i, s) in enumerate(((3, 1), (9, 2), (15, 2))):
        for k in range(3):
            x = memory(f"decoder.{i + k}", x)
        x = grow(f"decoder.{i + 4}", f.interpolate(x, scale_factor=2, mode="nearest"), s)
        x = conv(f"decoder.{i + 5}", x, DECODER[level + 1])
    x = conv("decoder.22", torch.relu(x), 12, bias=True)
    return f.pixel_shuffle(x, 2)[3:].clamp(0, 1)


def main():
    x = torch.rand(FRAMES, 3, ROWS, COLUMNS).mul(2).sub(1).bfloat16()
    latent = encode((x.double() + 1) / 2)
    z = 4 * latent / latent.abs().max()  # so that the clamp shows
    pixels = 2 * decode(z) - 1
    inside = (pixels.abs() < 1).double().mean().item()
    assert 0.7 < inside < 0.99, inside
    clip = lambda v: v.transpose(0, 1)[None].contiguous()
    save_file(weights, "tests/fixtures/taew_weights.safetensors")
    save_file({"x": clip(x), "latent": clip(latent), "z": clip(z), "pixels": clip(pixels)},
              "tests/fixtures/taew_stages.safetensors")
    print(z.shape, pixels.shape, inside, sum(w.numel() for w in weights.values()))


main()
