#!/usr/bin/env python3
"""make-vae-fixtures.py: write tests/fixtures/vae_*.safetensors, what tests/test_vae.c compares with.

The autoencoder is that of diffusers in its Wan2.2 form, in float64, piece by piece as it comes.  Sizes are those of
models/presets/dar-test.json.

    pip install torch==2.13.0 diffusers==0.42.1 safetensors

    vae_weights.safetensors   under the public names: bf16
    vae_names.json            the names of diffusers, and what they are called there
    vae_stages.safetensors    clip, moments, latent, pixels, loss, gradients: float64

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import json
import re

import torch
from diffusers import AutoencoderKLWan
from safetensors.torch import save_file

FRAMES, ROWS, COLUMNS = 9, 32, 16

# Diffusers rounds to float32 wherever it is careful with 16 bits; here nothing may be rounded.
to_float = torch.Tensor.float
torch.Tensor.float = lambda x: x if x.dtype == torch.float64 else to_float(x)

NAMES = [
    (r"^quant_conv", "conv1"),
    (r"^post_quant_conv", "conv2"),
    (r"coder\.conv_in", "coder.conv1"),
    (r"coder\.norm_out", "coder.head.0"),
    (r"coder\.conv_out", "coder.head.2"),
    (r"mid_block\.resnets\.0\.", "middle.0."),
    (r"mid_block\.attentions\.0\.", "middle.1."),
    (r"mid_block\.resnets\.1\.", "middle.2."),
    (r"down_blocks\.(\d+)\.resnets\.(\d+)\.", r"downsamples.\1.downsamples.\2."),
    (r"up_blocks\.(\d+)\.resnets\.(\d+)\.", r"upsamples.\1.upsamples.\2."),
    (r"down_blocks\.(\d+)\.downsampler\.", r"downsamples.\1.downsamples.DOWN."),
    (r"up_blocks\.(\d+)\.upsampler\.", r"upsamples.\1.upsamples.UP."),
    (r"\.norm1\.", ".residual.0."),
    (r"\.conv1\.(?=weight|bias)", ".residual.2."),
    (r"\.norm2\.", ".residual.3."),
    (r"\.conv2\.(?=weight|bias)", ".residual.6."),
    (r"\.conv_shortcut\.", ".shortcut."),
]


def public(name, config):
    name = name.replace("encoder.conv_in", "encoder.FIRST").replace("decoder.conv_in", "decoder.FIRST")
    for pattern, to in NAMES:
        name = re.sub(pattern, to, name)
    name = name.replace("FIRST", "conv1")
    return name.replace("DOWN", str(config["encoder_blocks"])).replace("UP", str(config["decoder_blocks"]))


def main():
    with open("models/presets/dar-test.json") as f:
        preset = json.loads("".join(line for line in f if not line.startswith("//")))
    c, latent = preset["vae"], preset["dit"]["latent"]
    torch.manual_seed(5)
    model = AutoencoderKLWan(
        base_dim=c["encoder_width"], decoder_base_dim=c["decoder_width"], z_dim=latent, dim_mult=c["multipliers"],
        num_res_blocks=c["encoder_blocks"], temperal_downsample=c["halve_time"], is_residual=True,
        in_channels=3 * c["patch"] ** 2, out_channels=3 * c["patch"] ** 2, patch_size=c["patch"],
        latents_mean=c["mean"], latents_std=c["std"],
        scale_factor_temporal=2 ** sum(c["halve_time"]), scale_factor_spatial=c["patch"] * 2 ** len(c["halve_time"]),
    )
    state = model.state_dict()
    for name, w in state.items():  # norms other than one, so that they show
        if name.endswith("gamma"):
            w.copy_(1 + 0.25 * torch.randn_like(w))
        w.copy_(w.bfloat16())
    model = model.double()
    with open("tests/fixtures/vae_names.json", "w") as f:
        json.dump({k: public(k, c) for k in sorted(state)}, f, indent=0)
    save_file({public(k, c): v.bfloat16().contiguous() for k, v in state.items()},
              "tests/fixtures/vae_weights.safetensors")

    rows = torch.linspace(0, 3, ROWS)[:, None]
    columns = torch.linspace(0, 4, COLUMNS)[None]
    x = torch.stack([
        torch.stack([torch.sin(rows * (1 + k) + columns + f / 3) * 0.8 for f in range(FRAMES)]) for k in range(3)
    ])[None].bfloat16().double()

    moments = model._encode(x)
    mean = torch.tensor(c["mean"], dtype=torch.float64).view(1, -1, 1, 1, 1)
    std = torch.tensor(c["std"], dtype=torch.float64).view(1, -1, 1, 1, 1)
    z = ((moments[:, :latent] - mean) / std).detach()
    torch.clamp = lambda y, min, max: y  # pixels before they are cut
    pixels = model._decode(z * std + mean, return_dict=False)[0]
    assert pixels.abs().max() < 1.5

    # A loss through both halves, and its gradients.
    mu = model._encode(x)[:, :latent]
    out = model._decode(mu, return_dict=False)[0]
    loss = (out - x).square().mean()
    loss.backward()
    stages = {"x": x.float(), "moments": moments, "z": z, "pixels": pixels, "loss": loss[None]}
    for name, p in model.named_parameters():
        stages["grad." + public(name, c)] = p.grad
    save_file({k: v.detach().contiguous() for k, v in stages.items()}, "tests/fixtures/vae_stages.safetensors")
    print({k: tuple(v.shape) for k, v in stages.items() if not k.startswith("grad.")}, loss.item(),
          sum(p.numel() for p in model.parameters()))


main()
