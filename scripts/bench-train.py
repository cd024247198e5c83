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
BATCH, FRAMES, ROWS, COLUMNS, LATENT, CHANNELS, R = 4, 5, 8, 14, 24, 33, 8
LAYERS, D, HEADS, FFN, TEXT, WORDS, RANK = 8, 192, 6, 768, 64, 16, 32
TOKENS = FRAMES * ROWS * COLUMNS
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
    angle = torch.rand(TOKENS, 1, D // HEADS // 2)
    net = nn.ModuleList(torch_dit.Block(D, HEADS, FFN, storage, RANK, angle) for _ in range(LAYERS))

    def frozen(module):
        return module.to(storage).requires_grad_(False)

    patch = frozen(nn.Linear(4 * (2 * LATENT + 4), D))
    head = frozen(nn.Linear(D, 4 * LATENT))
    text = frozen(nn.Sequential(nn.Linear(TEXT, D), nn.GELU("tanh"), nn.Linear(D, D)))
    times = frozen(nn.Sequential(nn.Linear(128, D), nn.SiLU(), nn.Linear(D, D), nn.SiLU(), nn.Linear(D, 6 * D)))
    unshuffle = nn.Conv2d(CHANNELS * R * R, D, 2, stride=2).to(storage)
    conv = nn.ModuleList(nn.Conv2d(D, D, 3, padding=1) for _ in range(2)).to(storage)
    trained = [p for m in (net, unshuffle, conv) for p in m.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=1e-4, fused=True)
    z0 = torch.randn(BATCH, LATENT, FRAMES, 2 * ROWS, 2 * COLUMNS)
    known = torch.randn(BATCH, LATENT + 4, FRAMES, 2 * ROWS, 2 * COLUMNS)
    cond = torch.randn(BATCH * FRAMES, CHANNELS, 2 * R * ROWS, 2 * R * COLUMNS).to(storage)
    words = torch.zeros(BATCH, WORDS, TEXT).to(storage)
    first = torch.arange(TOKENS) < ROWS * COLUMNS

    def tokens(x):  # [B, C, F, 2 h, 2 w] -> [B, L, 4 C]
        x = x.unflatten(-1, (COLUMNS, 2)).unflatten(-3, (ROWS, 2))  # [B, C, F, h, 2, w, 2]
        return x.permute(0, 2, 3, 5, 1, 4, 6).reshape(BATCH, TOKENS, -1)

    def velocity(z, t):
        x = unshuffle(F.pixel_unshuffle(cond, R))
        x = x + conv[1](F.relu(conv[0](x)))
        control = x.unflatten(0, (BATCH, FRAMES)).permute(0, 1, 3, 4, 2).reshape(BATCH, TOKENS, D)
        x = (patch(tokens(torch.cat([z, known], 1)).to(storage)) + control).float()
        angle = torch.stack([0 * t, t], 1)[..., None] * 10000.0 ** (-torch.arange(64) / 64)
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
        F.mse_loss(v[:, ROWS * COLUMNS :], tokens(eps - z0)[:, ROWS * COLUMNS :]).backward()
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
