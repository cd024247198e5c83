#!/usr/bin/env python3
"""bench-torch.py [--only WIDTH:TYPE:TOKENS]: whole blocks of the transformer beside PyTorch on this processor.

    pip install torch==2.13.0
    make build/release/bench_kernels

Each case runs in turn as `bench_kernels --filter=...` and in PyTorch, eager and compiled, with as many threads: forward
alone, and a training step of rank-32 LoRA (forward, mean square, backward; no product is computed twice; no optimiser).
PyTorch gets what it likes best: fused attention, huge pages for its memory, the instructions that it finds by itself.
Prints medians, ratios and the peak of memory, above what the programs take before they begin, as a Markdown table.
--only 3072:bf16:8192 runs one case; parts that are left out (:bf16:) fit all.
"""
import csv
import json
import os
import statistics
import subprocess
import sys
import time

# name: blocks, tokens (frames of 16 x 16), text tokens, width, heads, feed-forward width
CASES = {
    "8 x 384": (8, 1536, 64, 384, 6, 1536),
    "2 x 1536": (2, 2048, 512, 1536, 12, 8960),
    "1 x 3072": (1, 2048, 512, 3072, 24, 14336),
    "1 x 3072 long": (1, 8192, 512, 3072, 24, 14336),
}
RANK = 32
THREADS = os.cpu_count()


def torch_case(size, dtype, compiled):
    """Median seconds of forward and step, peak memory [bytes] above that of the libraries."""
    import resource

    import torch
    import torch.nn as nn
    import torch.nn.functional as F

    import torch_dit

    start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    blocks, tokens, text, D, heads, ffn = size
    storage = {"f32": torch.float32, "bf16": torch.bfloat16}[dtype]
    angle = torch.rand(tokens, 1, D // heads // 2)
    net = nn.ModuleList(torch_dit.Block(D, heads, ffn, storage, RANK, angle) for _ in range(blocks))
    x, target = torch.randn(1, tokens, D), torch.randn(1, tokens, D)
    context, e = torch.randn(1, text, D).to(storage), torch.randn(1, 6, 1, D) * 0.1

    def run(h):
        for b in net:
            h = b(h, context, e)
        return h

    if compiled:
        run = torch.compile(run)

    def forward():
        with torch.no_grad():
            run(x)

    def step():
        F.mse_loss(run(x), target).backward()
        for p in net.parameters():
            p.grad = None

    out = []
    for fn in (forward, step):
        fn()
        seconds, begin = [], time.time()
        while len(seconds) < 2 or (time.time() - begin < 10 and len(seconds) < 9):
            t = time.perf_counter()
            fn()
            seconds.append(time.perf_counter() - t)
        out.append(statistics.median(seconds))
    return out + [1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start)]


def run_torch(size, dtype, compiled):
    env = dict(os.environ, GLIBC_TUNABLES="glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0",
               OMP_NUM_THREADS=str(THREADS), OMP_PROC_BIND="true", OMP_PLACES="threads")
    code = subprocess.run([sys.executable, __file__, "--torch", json.dumps([size, dtype, compiled])], env=env,
                          capture_output=True, text=True)
    if code.returncode:
        return None
    return json.loads(code.stdout.splitlines()[-1])


def run_ours(what):
    """Rows of bench_kernels by name, and its peak memory [bytes]."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("OPENBLAS_")}
    env |= {"OMP_PROC_BIND": "true", "OMP_PLACES": "threads"}
    path = "build/bench/torch.csv"
    os.makedirs("build/bench", exist_ok=True)
    ours = subprocess.Popen(["build/release/bench_kernels", f"--output={path}", f"--filter={what}"], env=env,
                            stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(ours.pid, 0)
    if status:
        sys.exit("bench_kernels failed")
    found = {}
    with open(path) as f:
        for row in csv.DictReader(f):
            if row["kernel"].startswith("blocks") and int(row["threads"]) == THREADS:
                found[row["kernel"]] = (float(row["median_s"]), float(row["fraction_of_peak"]))
    return found, 1024 * used.ru_maxrss


def wanted(size, dtype):
    """Whether --only asks for this case, or for none."""
    only = sys.argv[2].split(":") if sys.argv[1:2] == ["--only"] else []
    return all(a in ("", b) for a, b in zip(only, (str(size[3]), dtype, str(size[1]))))


def main():
    if sys.argv[1:2] == ["--torch"]:
        print(json.dumps(torch_case(*json.loads(sys.argv[2]))))
        return
    print("| blocks x width, tokens | type | pass | here [s] | of peak | PyTorch eager [s] | compiled [s] | ratio "
          "| memory here [GB] | PyTorch [GB] | ratio |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    _, empty = run_ours("nothing")
    for name, size in CASES.items():
        for dtype in ("f32", "bf16"):
            if not wanted(size, dtype):
                continue
            rows, memory = run_ours(f"blocks {dtype} {'x'.join(map(str, size))}")
            ours = rows["blocks"], rows["blocks_step"], memory - empty
            eager, fused = run_torch(size, dtype, False), run_torch(size, dtype, True)
            for i, what in enumerate(("forward", "LoRA step")):
                theirs = [t[i] if t else float("nan") for t in (eager, fused)]
                best = min(t for t in theirs if t == t)
                memory = min(t[2] for t in (eager, fused) if t)
                print(f"| {name.replace(' long', '')}, {size[1]} | {dtype} | {what} | "
                      f"{ours[i][0]:.3f} | {ours[i][1]:.2f} | {theirs[0]:.3f} | {theirs[1]:.3f} | "
                      f"{best / ours[i][0]:.2f} | {ours[2] / 1e9:.2f} | {memory / 1e9:.2f} | "
                      f"{ours[2] / memory:.2f} |", flush=True)


main()
