#!/usr/bin/env python3
"""bench-train.py: a training step of dar-tiny's additions and adapter side by side with PyTorch on this processor.

    pip install torch==2.13.0
    make build/release/speed_train

Four clips of 128 x 224 pixels and 17 frames: noise, forward, loss, backward, clipping, AdamW.  In PyTorch everything
is stored in the type of the row, here trained weights are f32.  Both get all processors and huge pages.  PyTorch runs
eagerly: torch.compile takes minutes and is slower here.  Prints medians, memory above that of the libraries, and
ratios as a Markdown table.
"""
import json
import os
import statistics
import subprocess
import sys
import time

WAYS = ("none", "cheap")
BATCH, FRAMES, HEIGHT, WIDTH, RANK = 4, 5, 128, 224, 32  # latent frames, pixels
THREADS = os.cpu_count()


def torch_step(dtype):
    """Median seconds of a step, peak memory [bytes] above that of the libraries."""
    import resource

    import torch
    import torch.nn as nn
    import torch.nn.functional as F

    import torch_dit

    start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    storage = {"f32": torch.float32, "bf16": torch.bfloat16}[dtype]
    c = torch_dit.preset("dar-tiny")
    d, a = c["dit"], c["adapter"]
    D, C, P, R, channels = d["width"], d["latent"], d["patch"], a["unshuffle"], a["rays"] + a["geometry"]
    h, w = HEIGHT // (2 * R), WIDTH // (2 * R)  # tokens
    TOKENS = FRAMES * h * w
    angle = torch.rand(TOKENS, 1, D // d["heads"] // 2)
    net = nn.ModuleList(torch_dit.Block(D, d["heads"], d["ffn"], storage, RANK, angle) for _ in range(d["layers"]))

    def frozen(module):
        return module.to(storage).requires_grad_(False)

    patch = frozen(nn.Linear(P * P * (2 * C + d["mask"]), D))
    head = frozen(nn.Linear(D, P * P * C))
    text = frozen(nn.Sequential(nn.Linear(d["text_width"], D), nn.GELU("tanh"), nn.Linear(D, D)))
    times = frozen(nn.Sequential(nn.Linear(d["frequencies"], D), nn.SiLU(), nn.Linear(D, D),
                                 nn.SiLU(), nn.Linear(D, 6 * D)))
    unshuffle = nn.Conv2d(channels * R * R, D, 2, stride=2).to(storage)
    conv = nn.ModuleList(nn.Conv2d(D, D, 3, padding=1) for _ in range(2)).to(storage)
    trained = [p for m in (net, unshuffle, conv) for p in m.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=1e-4, fused=True)
    z0 = torch.randn(BATCH, C, FRAMES, P * h, P * w)
    known = torch.randn(BATCH, C + d["mask"], FRAMES, P * h, P * w)
    cond = torch.randn(BATCH * FRAMES, channels, HEIGHT, WIDTH).to(storage)
    words = torch.zeros(BATCH, d["text_keys"], d["text_width"]).to(storage)
    first = torch.arange(TOKENS) < h * w
    n = torch.arange(d["frequencies"] // 2)

    def tokens(x):  # [B, C, F, P h, P w] -> [B, L, P P C]
        x = x.unflatten(-1, (w, P)).unflatten(-3, (h, P))  # [B, C, F, h, P, w, P]
        return x.permute(0, 2, 3, 5, 1, 4, 6).reshape(BATCH, TOKENS, -1)

    def velocity(z, t):
        x = unshuffle(F.pixel_unshuffle(cond, R))
        x = x + conv[1](F.relu(conv[0](x)))
        control = x.unflatten(0, (BATCH, FRAMES)).permute(0, 1, 3, 4, 2).reshape(BATCH, TOKENS, D)
        x = (patch(tokens(torch.cat([z, known], 1)).to(storage)) + control).float()
        angle = torch.stack([0 * t, t], 1)[..., None] * 10000.0 ** (-n / len(n))
        e = times(torch.cat([angle.cos(), angle.sin()], -1).to(storage)).float().unflatten(-1, (6, D))  # [B, 2, 6, D]
        e = torch.where(first[None, None, :, None], e[:, 0, :, None], e[:, 1, :, None])
        context = text(words)
        for b in net:
            x = b(x, context, e)
        return head(F.layer_norm(x, (D,)).to(storage)).float()

    def step():
        sigma, eps = torch.rand(BATCH), torch.randn_like(z0)
        mix = sigma.view(-1, 1, 1, 1, 1)
        v = velocity((1 - mix) * z0 + mix * eps, 1000 * sigma)
        F.mse_loss(v[:, h * w :], tokens(eps - z0)[:, h * w :]).backward()
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        optimizer.zero_grad()

    step()
    seconds, begin = [], time.time()
    while len(seconds) < 2 or (time.time() - begin < 10 and len(seconds) < 9):
        clock = time.perf_counter()
        step()
        seconds.append(time.perf_counter() - clock)
    return [statistics.median(seconds), 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start)]


def run_torch(dtype):
    env = os.environ | {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0", "OMP_PROC_BIND": "true",
                        "OMP_NUM_THREADS": str(THREADS), "OMP_PLACES": "threads"}
    words = [sys.executable, __file__, "--torch", dtype]
    return json.loads(subprocess.run(words, env=env, check=True, capture_output=True, text=True).stdout)


def run_ours(dtype, recompute):
    env = os.environ | {"OMP_PROC_BIND": "true", "OMP_PLACES": "threads"}
    words = ["build/release/speed_train", "--json", f"--precision={dtype}", f"--recompute={recompute}"]
    return json.loads(subprocess.run(words, env=env, check=True, capture_output=True, text=True).stdout)


def main():
    if sys.argv[1:2] == ["--torch"]:
        print(json.dumps(torch_step(sys.argv[2])))
        return
    print("| type | recompute | here [s] | of peak | memory [GB] | PyTorch [s] | memory [GB] | as fast | memory |")
    print("|---|---|---|---|---|---|---|---|---|")
    for dtype in ("f32", "bf16"):
        seconds, memory = run_torch(dtype)
        for recompute in WAYS:
            ours = run_ours(dtype, recompute)
            print(f"| {dtype} | {recompute} | {ours['seconds']:.3f} | {ours['fraction_of_peak']:.2f} | "
                  f"{ours['taken_bytes'] / 1e9:.2f} | {seconds:.3f} | {memory / 1e9:.2f} | "
                  f"{seconds / ours['seconds']:.2f} | {ours['taken_bytes'] / memory:.2f} |", flush=True)


main()
