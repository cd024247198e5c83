#!/usr/bin/env python3
"""bench-sample.py [f32] [bf16]: sampling at the sizes of dar-tiny side by side with PyTorch on this processor.

    pip install torch==2.13.0
    make

The same work: every call of the network with adapter, text and times, nothing kept (`--skip none`), against the network
in PyTorch as the public code calls it: adapter in every call, a time for every token, 16 text tokens, both prompts in
one batch or one after the other, eager and compiled, whichever is quickest.  Then a clip with two different prompts, as
a program does it here, all exact skips and preparation of the clip included, against those calls.  Weights are drawn.
Prints medians and ratios as a Markdown table.  The bundle is made from ../shared/assets/robot.glb: 17 frames of
224 x 128.
"""
import json
import os
import statistics
import struct
import subprocess
import sys
import time

STEPS = 20
THREADS = os.cpu_count()
OUT = "build/bench/sample"


def torch_case(dtype, compiled, batched):
    """Median seconds of the calls of one step."""
    import torch
    import torch.nn as nn
    import torch.nn.functional as F

    import torch_dit

    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    c = torch_dit.preset("dar-tiny")
    d, a = c["dit"], c["adapter"]
    D, r, patch = d["width"], a["unshuffle"], d["patch"]
    frames, H, W = 5, 128, 224
    h, w = H // (2 * r), W // (2 * r)
    tokens, storage = frames * h * w, {"f32": torch.float32, "bf16": torch.bfloat16}[dtype]
    angle = torch.rand(tokens, 1, D // d["heads"] // 2)

    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.first = nn.Conv2d((a["rays"] + a["geometry"]) * r * r, D, 2, 2)
            self.inner, self.outer = (nn.Conv2d(D, D, 3, padding=1).to(storage) for _ in range(2))
            self.patch = nn.Conv3d(2 * d["latent"] + d["mask"], D, (1, patch, patch), (1, patch, patch))
            self.text = nn.Sequential(nn.Linear(d["text_width"], D), nn.GELU("tanh"), nn.Linear(D, D)).to(storage)
            self.time = nn.Sequential(nn.Linear(d["frequencies"], D), nn.SiLU(), nn.Linear(D, D))
            self.project = nn.Sequential(nn.SiLU(), nn.Linear(D, 6 * D))
            self.blocks = nn.ModuleList(
                torch_dit.Block(D, d["heads"], d["ffn"], storage, 0, angle) for _ in range(d["layers"]))
            self.head = nn.Linear(D, d["latent"] * patch * patch)
            self.modulation = nn.Parameter(torch.zeros(1, 2, 1, D))

        def forward(self, z, known, cond, t, text):
            y = F.pixel_unshuffle(cond.transpose(1, 2).flatten(0, 1), r)
            y = self.first(y)
            y = y + self.outer(F.relu(self.inner(y.to(storage)))).float()
            y = y.unflatten(0, (-1, frames)).transpose(1, 2)
            x = (self.patch(torch.cat((z, known), 1)) + y).flatten(2).transpose(1, 2)
            n = torch.arange(d["frequencies"] // 2, dtype=torch.float64)
            s = t.double()[..., None] * 10000 ** (-n / len(n))
            e = self.time(torch.cat((s.cos(), s.sin()), -1).float())  # [B, L, D]: a time for every token
            e6 = self.project(e).unflatten(-1, (6, D)).transpose(1, 2)
            context = self.text(text)
            for b in self.blocks:
                x = b(x, context, e6)
            shift, scale = (self.modulation + e[:, None]).unbind(1)
            x = self.head(F.layer_norm(x, (D,), eps=1e-6) * (1 + scale) + shift)
            x = x.unflatten(1, (frames, h, w)).unflatten(-1, (patch, patch, d["latent"]))
            return x.permute(0, 6, 1, 2, 4, 3, 5).flatten(5).flatten(3, 4)

    net = Network()
    run = torch.compile(net) if compiled else net
    B = 2 if batched else 1
    z = torch.randn(1, d["latent"], frames, patch * h, patch * w)
    known = torch.randn(1, d["latent"] + d["mask"], frames, patch * h, patch * w)
    cond = torch.rand(1, a["rays"] + a["geometry"], frames, H, W)
    text = torch.randn(2, d["text_keys"], d["text_width"]).to(storage)
    t = torch.full((B, tokens), 750.0)
    t[:, : h * w] = 0

    def step():
        with torch.no_grad():
            if batched:
                c, u = run(*(x.expand(2, *x.shape[1:]) for x in (z, known, cond)), t, text).chunk(2)
            else:
                c, u = (run(z, known, cond, t, text[i : i + 1]) for i in range(2))
            return z - 0.02 * (c + 2 * (c - u))

    step()
    seconds, begin = [], time.time()
    while len(seconds) < 5 or (time.time() - begin < 4 and len(seconds) < 40):
        at = time.perf_counter()
        step()
        seconds.append(time.perf_counter() - at)
    return statistics.median(seconds)


def run_torch(dtype, compiled, batched):
    env = dict(os.environ, OMP_NUM_THREADS=str(THREADS), OMP_PROC_BIND="true", OMP_PLACES="threads")
    code = subprocess.run([sys.executable, __file__, "--torch", json.dumps([dtype, compiled, batched])], env=env,
                          capture_output=True, text=True)
    if code.returncode:
        print(code.stderr.splitlines()[-1], file=sys.stderr)
        return float("nan")
    return json.loads(code.stdout.splitlines()[-1])


def write_text(path):
    """Two prompts of 16 tokens, of width 64, that differ: safetensors."""
    rows = {name: [((i * k) % 97) / 48 - 1 for i in range(16 * 64)] for name, k in (("text", 31), ("negative", 43))}
    header, data = {}, b""
    for name, x in rows.items():
        header[name] = {"dtype": "F32", "shape": [16, 64], "data_offsets": [len(data), len(data) + 4 * len(x)]}
        data += struct.pack(f"<{len(x)}f", *x)
    head = json.dumps(header).encode()
    head += b" " * (-len(head) % 8)
    with open(path, "wb") as f:
        f.write(struct.pack("<Q", len(head)) + head + data)


def run_ours(bundle, dtype, skip):
    """Median seconds of preparing a clip and of a video's steps; of three runs."""
    env = dict(os.environ, OMP_PROC_BIND="true", OMP_PLACES="threads")
    found = []
    for _ in range(3):
        code = subprocess.run(
            ["build/release/dar-sample", bundle, "-o", f"{OUT}/video", "--model", "dar-tiny", "--random", "--overwrite",
             "--steps", str(STEPS), "--skip", skip, "--precision", dtype, "--text", f"{OUT}/text.safetensors", "--seed",
             str(time.time_ns()), "--no-png", "--no-mp4", "--no-sheet", "--json", "--quiet"], env=env,
            capture_output=True, text=True)
        if code.returncode:
            sys.exit(code.stderr)
        b = json.loads(code.stdout)["bundles"][0]
        found.append((b["seconds_prepare"], b["videos"][0]["seconds"]["sample"]))
    return [statistics.median(x) for x in zip(*found)]


def main():
    if sys.argv[1:2] == ["--torch"]:
        print(json.dumps(torch_case(*json.loads(sys.argv[2]))))
        return
    os.makedirs(OUT, exist_ok=True)
    bundle = f"{OUT}/robot"
    if not os.path.exists(bundle):
        subprocess.run(["build/release/dar-bundle", "render", "../shared/assets/robot.glb", "-o", bundle, "--size",
                        "224x128", "--frames", "17", "--trajectory", "orbit-60", "--shade", "day", "--quiet"],
                       check=True)
    write_text(f"{OUT}/text.safetensors")
    print(f"| type | here, call [ms] | PyTorch, call: eager, compiled [ms] | ratio | here, clip of {STEPS} steps [s] | "
          "PyTorch [s] | ratio |")
    print("|---|---|---|---|---|---|---|")
    for dtype in sys.argv[1:] or ("f32", "bf16"):
        _, plain = run_ours(bundle, dtype, "none")
        prepare, steps = run_ours(bundle, dtype, "exact")
        eager, fused = (min(run_torch(dtype, compiled, batched) for batched in (False, True))
                        for compiled in (False, True))
        best = min(t for t in (eager, fused) if t == t)
        print(f"| {dtype} | {500 * plain / STEPS:.2f} | {500 * eager:.2f}, {500 * fused:.2f} | "
              f"{best / (plain / STEPS):.2f} | {prepare + steps:.3f} | {best * STEPS:.3f} | "
              f"{best * STEPS / (prepare + steps):.2f} |", flush=True)


main()
