#!/usr/bin/env python3
"""make-dit-fixtures.py: write tests/fixtures/dit_*.safetensors, what tests/test_dit.c and others compare with.

The transformer is that of diffusers, LoRA that of peft, the adapter a few lines from its published formula; all of it
in float64.  Sizes come from models/presets/dar-test.json.

    pip install torch==2.13.0 diffusers==0.42.1 peft==0.21.2 transformers==5.23.0 safetensors

    dit_weights.safetensors   network and adapter under the public names, inputs: bf16
    dit_lora.safetensors      LoRA in the PEFT form, which does not say alpha: bf16
    dit_stages.safetensors    stages, velocity, loss, gradients: float64
    dit_steps.safetensors     the first clip after each of five steps of Euler with guidance: float64
    dit_train.safetensors     ten steps of AdamW on LoRA and adapter: losses, norms, what they end with: float64

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import json
import math
import re

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import WanTransformer3DModel
from diffusers.models.embeddings import get_1d_rotary_pos_embed
from diffusers.models.transformers import transformer_wan
from peft import LoraConfig, get_peft_model_state_dict, inject_adapter_in_model
from safetensors.torch import save_file

CLIPS, FRAMES, ROWS, COLUMNS = 2, 3, 2, 3  # tokens
TOKENS = [4, 7]  # of the text, per clip
TIMES = [[0.0, 731.25], [0.0, 38.5]]  # first frame, the rest

# Diffusers rounds to float32 wherever it is careful with bfloat16; here nothing may be rounded.
to_float = torch.Tensor.float
torch.Tensor.float = lambda x: x if x.dtype == torch.float64 else to_float(x)

NAMES = [
    (r"^condition_embedder\.text_embedder\.linear_1", "text_embedding.0"),
    (r"^condition_embedder\.text_embedder\.linear_2", "text_embedding.2"),
    (r"^condition_embedder\.time_embedder\.linear_1", "time_embedding.0"),
    (r"^condition_embedder\.time_embedder\.linear_2", "time_embedding.2"),
    (r"^condition_embedder\.time_proj", "time_projection.1"),
    (r"^scale_shift_table$", "head.modulation"),
    (r"^proj_out", "head.head"),
    (r"\.scale_shift_table$", ".modulation"),
    (r"\.attn1\.", ".self_attn."),
    (r"\.attn2\.", ".cross_attn."),
    (r"\.to_([qkv])\b", r".\1"),
    (r"\.to_out\.0", ".o"),
    (r"\.ffn\.net\.0\.proj", ".ffn.0"),
    (r"\.ffn\.net\.2", ".ffn.2"),
    (r"(blocks\.\d+)\.norm2\.", r"\1.norm3."),
]


def public(name):
    for pattern, to in NAMES:
        name = re.sub(pattern, to, name)
    return name


def random(generator, shape, spread, mean=0.0):
    """Uniform, and the same in bfloat16."""
    x = (torch.rand(shape, generator=generator, dtype=torch.float64) * 2 - 1) * spread + mean
    return x.bfloat16().double()


class TimeCode(torch.nn.Module):
    def __init__(self, n):
        super().__init__()
        self.n = n // 2

    def forward(self, t):
        a = t[:, None].double() * 10000.0 ** (-torch.arange(self.n, dtype=torch.float64) / self.n)
        return torch.cat([a.cos(), a.sin()], dim=1)


def exact_rope(rope, width):
    """The tables before diffusers rounds them."""
    h = 2 * (width // 6)
    angles = [
        torch.outer(torch.arange(1024).double(), 10000.0 ** (-torch.arange(0, d, 2).double() / d))
        for d in (width - 2 * h, h, h)
    ]
    for name, f in (("freqs_cos", torch.cos), ("freqs_sin", torch.sin)):
        table = torch.cat([f(a).repeat_interleave(2, dim=1) for a in angles], dim=1)
        assert (table - getattr(rope, name)).abs().max() < 1e-6
        setattr(rope, name, table)


class Adapter(torch.nn.Module):
    """SimpleAdapter: unshuffle, 2 x 2 convolution with stride 2, one residual block; frames are a batch."""

    def __init__(self, channels, r, width):
        super().__init__()
        self.r = r
        self.conv = torch.nn.Conv2d(channels * r * r, width, 2, stride=2)
        block = torch.nn.Module()
        block.conv1 = torch.nn.Conv2d(width, width, 3, padding=1)
        block.conv2 = torch.nn.Conv2d(width, width, 3, padding=1)
        self.residual_blocks = torch.nn.ModuleList([block])

    def forward(self, cond):
        b, c, f, h, w = cond.shape
        x = self.conv(F.pixel_unshuffle(cond.transpose(1, 2).reshape(b * f, c, h, w), self.r))
        for block in self.residual_blocks:
            x = x + block.conv2(F.relu(block.conv1(x)))
        return x.unflatten(0, (b, f)).transpose(1, 2)


@torch.no_grad()
def steps(net, control, z, known, words):
    """Five steps with guidance 3 from noise z; the second clip's text is the negative one.  The first latent frame is
    that of the known video, at time 0.  The grid bends the ends of the training table, which is bent already."""
    bend = lambda s: 5 * s / (1 + 4 * s)
    sigma = [bend(1 + (bend(0.001) - 1) * i / 4) for i in range(5)] + [0.0]
    first = known[:, known.shape[1] - z.shape[1] :, :1]
    add = net.patch_embedding.register_forward_hook(lambda m, args, y: y + control)
    z = torch.cat([first, z[:, :, 1:]], dim=2)
    out = {}
    for i in range(5):
        times = torch.full((1, FRAMES * ROWS * COLUMNS), 1000 * sigma[i], dtype=torch.float64)
        times[:, : ROWS * COLUMNS] = 0
        c, u = (net(torch.cat([z, known], dim=1), times, w, return_dict=False)[0] for w in words)
        z = z + (sigma[i + 1] - sigma[i]) * (u + 3 * (c - u))
        z = torch.cat([first, z[:, :, 1:]], dim=2)
        out[f"step.{i + 1}"] = z
    add.remove()
    return out


def philox(seed, stream, n):
    """Random 64 bits, n of them: lib/rng.h."""
    i = np.arange((n + 1) // 2, dtype=np.uint64)
    low = np.uint64(0xFFFFFFFF)
    c = [i & low, i >> np.uint64(32), np.full_like(i, stream & 0xFFFFFFFF), np.full_like(i, stream >> 32)]
    k = [seed & 0xFFFFFFFF, seed >> 32]
    for _ in range(10):
        p, q = c[0] * np.uint64(0xD2511F53), c[2] * np.uint64(0xCD9E8D57)
        c = [q >> np.uint64(32) ^ c[1] ^ np.uint64(k[0]), q & low, p >> np.uint64(32) ^ c[3] ^ np.uint64(k[1]), p & low]
        k = [(k[0] + 0x9E3779B9) & 0xFFFFFFFF, (k[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return np.stack([c[1] << np.uint64(32) | c[0], c[3] << np.uint64(32) | c[2]], axis=1).reshape(-1)[:n]


def stream(name):
    h = 0xCBF29CE484222325
    for c in name.encode():
        h = (h ^ c) * 0x100000001B3 % 2**64
    return h


def normal(seed, at, shape):
    x = (philox(seed, at, math.prod(shape)) >> np.uint64(11)).reshape(-1, 2).astype(np.float64)
    r, a = np.sqrt(-2 * np.log((x[:, 0] + 1) * 2.0**-53)), 2 * math.pi * x[:, 1] * 2.0**-53
    return torch.from_numpy(np.stack([r * np.cos(a), r * np.sin(a)], axis=1).reshape(shape))


def learn(net, adapter, z0, known, cond, words, seed=5):
    """Ten steps, of which the first three warm up; noise and times as dar-train draws them.  The first frame is clean,
    at time 0, and not counted."""
    named = list(net.named_parameters()) + [("control_adapter." + n, q) for n, q in adapter.named_parameters()]
    named = {public(name.replace(".default", "")): q for name, q in named if q.requires_grad}
    optimizer = torch.optim.AdamW(named.values(), lr=1e-3, betas=(0.9, 0.999), eps=1e-8, weight_decay=0.03)
    warmup = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda k: min(1, k / 3))
    control = {}
    net.patch_embedding.register_forward_hook(lambda m, args, y: y + control["is"])
    u = (philox(seed, stream("train.sigma"), 10 * CLIPS) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    noise = philox(seed, stream("train.noise"), 10 * CLIPS)
    losses, norms = [], []
    for k in range(10):
        s = torch.tensor([1 - math.floor(1000 * u[k * CLIPS + b]) / 1000 for b in range(CLIPS)], dtype=torch.float64)
        sigma = 5 * s / (1 + 4 * s)
        eps = torch.cat([normal(seed, int(noise[k * CLIPS + b]), (1, *z0.shape[1:])) for b in range(CLIPS)])
        mix = sigma.view(-1, 1, 1, 1, 1)
        z = torch.cat([z0[:, :, :1], ((1 - mix) * z0 + mix * eps)[:, :, 1:]], dim=2)
        times = (1000 * sigma)[:, None].repeat(1, FRAMES * ROWS * COLUMNS)
        times[:, : ROWS * COLUMNS] = 0
        control["is"] = adapter(cond)
        v = net(torch.cat([z, known], dim=1), times, words, return_dict=False)[0]
        loss = F.mse_loss(v[:, :, 1:], (eps - z0)[:, :, 1:])
        optimizer.zero_grad()
        loss.backward()
        losses.append(loss.item())
        norms.append(torch.nn.utils.clip_grad_norm_(named.values(), 1.0).item())
        optimizer.step()
        warmup.step()
    print("losses", losses, "norms", norms)
    out = {"after." + name: q.detach() for name, q in named.items()}
    for name, x in (("loss", losses), ("norm", norms)):
        out[name] = torch.tensor(x, dtype=torch.float64)
    return out


def network(d):
    return WanTransformer3DModel(
        patch_size=(1, d["patch"], d["patch"]),
        num_attention_heads=d["heads"],
        attention_head_dim=d["width"] // d["heads"],
        in_channels=2 * d["latent"] + d["mask"],
        out_channels=d["latent"],
        text_dim=d["text_width"],
        freq_dim=d["frequencies"],
        ffn_dim=d["ffn"],
        num_layers=d["layers"],
        eps=d.get("eps", 1e-6),
    ).double()


def main():
    text = open("models/presets/dar-test.json").read()
    config = json.loads(re.sub(r"^\s*//.*$", "", text, flags=re.M))
    d, a, lora = config["dit"], config["adapter"], config["lora"]
    g = torch.Generator().manual_seed(1)
    torch.manual_seed(1)

    net = network(d)
    net.condition_embedder.timesteps_proj = TimeCode(d["frequencies"])
    exact_rope(net.rope, d["width"] // d["heads"])
    adapter = Adapter(a["rays"] + a["geometry"], a["unshuffle"], d["width"]).double()
    targets = ["to_q", "to_k", "to_v", "to_out.0", "net.0.proj", "net.2"]
    inject_adapter_in_model(LoraConfig(r=lora["rank"], lora_alpha=lora["alpha"], target_modules=targets), net)

    weights = {}
    for name, p in list(net.named_parameters()) + [("control_adapter." + n, p) for n, p in adapter.named_parameters()]:
        norm = name.endswith(("norm_q.weight", "norm_k.weight", "norm2.weight"))
        fan = p[0].numel() if p.dim() > 1 else 25
        table = name.endswith("scale_shift_table")
        p.data = random(g, p.shape, 0.3 if norm or table else (3.0 / fan) ** 0.5, 1.0 if norm else 0.0)
        if "lora_" not in name:
            weights[public(name.replace(".base_layer", ""))] = p
        p.requires_grad_("lora_" in name or "control_adapter" in name)
    factors = {public(k): v for k, v in get_peft_model_state_dict(net).items()}
    assert len(factors) == 2 * 10 * d["layers"] and all("lora_" in k for k in factors)

    p, r = d["patch"], a["unshuffle"]
    latent = (FRAMES, ROWS * p, COLUMNS * p)
    z = random(g, (CLIPS, d["latent"], *latent), 2)
    known = random(g, (CLIPS, d["latent"] + d["mask"], *latent), 1)
    cond = random(g, (CLIPS, a["rays"] + a["geometry"], FRAMES, ROWS * 2 * r, COLUMNS * 2 * r), 1)
    words = random(g, (CLIPS, max(TOKENS), d["text_width"]), 1)
    target = random(g, z.shape, 2)
    weights.update({"in.z": z, "in.known": known, "in.cond": cond, "in.text": words, "in.target": target})

    padded = torch.zeros(CLIPS, d["text_keys"], d["text_width"], dtype=torch.float64)
    for b, n in enumerate(TOKENS):
        padded[b, :n] = words[b, :n]
    first = torch.arange(FRAMES * ROWS * COLUMNS) < ROWS * COLUMNS
    times = torch.stack([torch.where(first, *torch.tensor(t, dtype=torch.float64)) for t in TIMES])

    stages = {}

    def keep(name, pick=lambda y: y):
        def hook(module, args, y):
            stages[name] = pick(y)

        return hook

    control = adapter(cond)
    stages["adapter"] = control.flatten(2).transpose(1, 2)
    add = net.patch_embedding.register_forward_hook(lambda m, args, y: y + control)
    net.patch_embedding.register_forward_hook(keep("embed", lambda y: y.flatten(2).transpose(1, 2)))
    rows = [0, ROWS * COLUMNS]
    net.condition_embedder.register_forward_hook(keep("e", lambda y: y[0][:, rows]))
    net.condition_embedder.register_forward_hook(keep("e0", lambda y: y[1][:, rows]))
    for i, block in enumerate(net.blocks):
        block.register_forward_hook(keep(f"block.{i}"))
        block.attn2.norm_k.register_forward_hook(keep(f"key.{i}"))
        block.attn2.to_v.register_forward_hook(keep(f"value.{i}"))
    v = net(torch.cat([z, known], dim=1), times, padded, return_dict=False)[0]
    loss = F.mse_loss(v, target)
    loss.backward()
    stages.update({"velocity": v, "loss": loss})
    for name, q in list(net.named_parameters()) + [("control_adapter." + n, q) for n, q in adapter.named_parameters()]:
        if q.grad is not None:
            stages["gradient." + public(name.replace(".default", ""))] = q.grad

    seen = dict(stages)  # the hooks go on
    add.remove()
    walk = steps(net, control[:1], z[:1], known[:1], [padded[:1], padded[1:]])

    for name, tensors, dtype in (
        ("weights", weights, torch.bfloat16),
        ("lora", factors, torch.bfloat16),
        ("stages", seen, torch.float64),
        ("steps", walk, torch.float64),
    ):
        save_file(
            {k: x.detach().to(dtype).contiguous() for k, x in tensors.items()},
            f"tests/fixtures/dit_{name}.safetensors",
            metadata={"made by": "scripts/make-dit-fixtures.py"},
        )

    save_file(
        {k: x.contiguous() for k, x in learn(net, adapter, z, known, cond, padded).items()},
        "tests/fixtures/dit_train.safetensors",
        metadata={"made by": "scripts/make-dit-fixtures.py"},
    )


if __name__ == "__main__":
    main()
