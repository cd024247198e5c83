#!/usr/bin/env python3
"""make-metric-fixtures.py: write tests/fixtures/metric.json and metric.safetensors, what tests/test_metric.c compares
with.

PSNR and SSIM are those of scikit-image.  FLIP is written here from its published formulas in float64 and checked
against the authors' package, which computes in float32.

    pip install scikit-image==0.26.0 flip-evaluator==1.7 safetensors

    metric.safetensors   found, truth [T, H, W, 3] u8, mask [T, H, W] u8 (0 or 255), map: FLIP of the last frame, f32
    metric.json          values per frame, of the frame and of the mask

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import json

import flip_evaluator
import numpy as np
from safetensors.numpy import save_file
from scipy.ndimage import correlate, gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

FRAMES, ROWS, COLUMNS = 3, 31, 43
PPD = 0.7 * 3840 / 0.7 * np.pi / 180

rng = np.random.default_rng(3)


def film():
    """Soft shapes, an edge and some noise, so that every filter has something to see."""
    x = gaussian_filter(rng.normal(size=(FRAMES, ROWS, COLUMNS, 3)), (1, 3, 3, 0))
    x = 128 + 90 * x / np.abs(x).max()
    x[:, :, 20:24] += 60
    return x


def as_bytes(x):
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- FLIP

TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
WHITE = TO_XYZ.sum(1)


def hunt(rgb):
    t = rgb @ TO_XYZ.T / WHITE
    d = 6 / 29
    t = np.where(t > d**3, np.cbrt(t), t / (3 * d * d) + 4 / 29)
    light = 116 * t[..., 1] - 16
    return np.stack(
        [light, 0.01 * light * 500 * (t[..., 0] - t[..., 1]), 0.01 * light * 200 * (t[..., 1] - t[..., 2])], -1
    )


def grid(radius):
    return np.meshgrid(np.arange(-radius, radius + 1.0), np.arange(-radius, radius + 1.0))


def eye(x):
    radius = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * PPD))
    u, v = grid(radius)
    z = (u * u + v * v) / PPD**2
    seen = []
    for c, terms in enumerate([[(1, 0.0047)], [(1, 0.0053)], [(34.1, 0.04), (13.5, 0.025)]]):
        k = sum(a * np.sqrt(np.pi / b) * np.exp(-np.pi**2 * z / b) for a, b in terms)
        seen.append(correlate(x[..., c], k / k.sum(), mode="nearest"))
    return np.stack(seen, -1)


def features(y):
    s = 0.5 * 0.082 * PPD
    u, v = grid(int(np.ceil(3 * s)))
    g = np.exp(-(u * u + v * v) / (2 * s * s))
    out = []
    for k in (-u * g, (u * u / (s * s) - 1) * g):
        k = np.where(k > 0, k / k[k > 0].sum(), k / -k[k < 0].sum())
        out.append(np.hypot(correlate(y, k, mode="nearest"), correlate(y, k.T, mode="nearest")))
    return out


def flip(found, truth):
    labs, marks = [], []
    for p in (found, truth):
        s = p / 255
        light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
        t = light @ TO_XYZ.T / WHITE
        ycc = eye(np.stack([116 * t[..., 1] - 16, 500 * (t[..., 0] - t[..., 1]), 200 * (t[..., 1] - t[..., 2])], -1))
        y = (ycc[..., 0] + 16) / 116
        xyz = np.stack([y + ycc[..., 1] / 500, y, y - ycc[..., 2] / 200], -1) * WHITE
        labs.append(hunt(np.clip(xyz @ np.linalg.inv(TO_XYZ).T, 0, 1)))
        marks.append(features(t[..., 1]))

    def distance(a, b):
        d = a - b
        return (np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2])) ** 0.7

    cmax = distance(hunt(np.array([0, 1.0, 0])), hunt(np.array([0, 0, 1.0])))
    c, knee = distance(*labs), 0.4 * cmax
    c = np.where(c < knee, 0.95 / knee * c, 0.95 + (c - knee) / (cmax - knee) * 0.05)
    f = np.maximum(np.abs(marks[0][0] - marks[1][0]), np.abs(marks[0][1] - marks[1][1])) / np.sqrt(2)
    return c ** (1 - np.sqrt(f))


# ---------------------------------------------------------------- sharpness


def slope(x, where):
    s = np.hypot(np.diff(x, axis=1)[:-1], np.diff(x, axis=0)[:, :-1])
    return s[where[:-1, :-1]].sum()


def main():
    truth = film()
    found = as_bytes(np.roll(truth, 1, 2) + rng.normal(size=truth.shape) * 6)
    truth = as_bytes(truth)
    mask = (gaussian_filter(rng.normal(size=(FRAMES, ROWS, COLUMNS)), (0, 4, 4)) > 0).astype(np.uint8) * 255
    inner = np.zeros((ROWS, COLUMNS), bool)
    inner[5:-5, 5:-5] = True
    rows, worst = [], 0
    for t in range(FRAMES):
        p, g, m = found[t].astype(float), truth[t].astype(float), mask[t] > 0
        wang = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        _, s = structural_similarity(g, p, data_range=255, channel_axis=2, full=True, **wang)
        e = flip(p, g)
        theirs, _, _ = flip_evaluator.evaluate(
            (g / 255).astype(np.float32), (p / 255).astype(np.float32), "LDR", applyMagma=False, parameters={"ppd": PPD}
        )
        worst = max(worst, np.abs(theirs[..., 0] - e).max())
        row = {"psnr": [peak_signal_noise_ratio(a, b, data_range=255) for a, b in ((g, p), (g[m], p[m]))]}
        row["ssim"] = [s[inner].mean(), s[inner & m].mean()]
        row["flip"] = [e.mean(), e[m].mean()]
        row["sharpness"] = [slope(p, a) / slope(g, a) for a in (np.ones_like(m), m)]
        row["refl1"] = [np.abs(p - truth[0]).mean(), np.abs(p - truth[0])[m].mean()]
        if t:
            d, dg = p - found[t - 1], g - truth[t - 1]
            row["templ1"] = [np.abs(d).mean(), np.abs(d)[m].mean()]
            row["templ1_truth"] = [np.abs(d - dg).mean(), np.abs(d - dg)[m].mean()]
        rows.append(row)
    print("FLIP: farthest from the authors' package:", worst)
    save_file(
        {"found": found, "truth": truth, "mask": mask, "map": e.astype(np.float32)}, "tests/fixtures/metric.safetensors"
    )
    with open("tests/fixtures/metric.json", "w", encoding="utf-8") as f:
        json.dump({"frames": rows}, f, indent=1)
        f.write("\n")


main()
