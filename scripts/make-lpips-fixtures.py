#!/usr/bin/env python3
"""make-lpips-fixtures.py: write tests/fixtures/lpips_*.safetensors, what tests/test_lpips.c compares with.

LPIPS written from its published layers in float64, with random weights and small widths, all different.

    pip install torch==2.13.0 safetensors

    lpips_alex.safetensors       trunk, under torchvision's names
    lpips_alex_lin.safetensors   w_k
    lpips_vgg.safetensors        both, under the names of the lpips package
    lpips_pairs.safetensors      a, b [H, W, 3] u8, mask [H, W] u8; alex, vgg: distance, the same within the mask: f64

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import torch
import torch.nn.functional as f
from safetensors.torch import save_file

ROWS, COLUMNS = 67, 75
ALEX = [(0, 5, 11, 4, 2), (3, 7, 5, 1, 2), (6, 6, 3, 1, 1), (8, 4, 3, 1, 1), (10, 8, 3, 1, 1)]
VGG = [[(0, 4), (2, 5)], [(5, 6), (7, 3)], [(10, 4), (12, 7), (14, 5)], [(17, 3), (19, 6), (21, 4)],
       [(24, 5), (26, 3), (28, 7)]]

torch.manual_seed(11)
trunk, full, lin = {}, {}, {}


def conv(store, name, x, out, k, stride, pad):
    w = torch.randn(out, x.shape[1], k, k) / (x.shape[1] * k * k) ** 0.5
    b = 0.2 * torch.randn(out)
    store[name + ".weight"], store[name + ".bias"] = w, b
    return f.relu(f.conv2d(x, w.double(), b.double(), stride=stride, padding=pad))


def alex(x):
    maps = []
    for stage, (i, out, k, stride, pad) in enumerate(ALEX):
        if stage in (1, 2):
            x = f.max_pool2d(x, 3, 2)
        x = conv(trunk, f"features.{i}", x, out, k, stride, pad)
        maps.append(x)
    return maps


def vgg(x):
    maps = []
    for stage, layers in enumerate(VGG):
        if stage:
            x = f.max_pool2d(x, 2, 2)
        for i, out in layers:
            x = conv(full, f"net.slice{stage + 1}.{i}", x, out, 3, 1, 1)
        maps.append(x)
    return maps


def cells(mask, h, w):
    """Share of the mask in each cell of a coarser grid."""
    rows = [i * ROWS // h for i in range(h + 1)]
    columns = [j * COLUMNS // w for j in range(w + 1)]
    return torch.stack([torch.stack([mask[rows[i]:rows[i + 1], columns[j]:columns[j + 1]].mean() for j in range(w)])
                        for i in range(h)])


def distance(maps, store, mask):
    whole = within = 0
    for k, x in enumerate(maps):
        w = torch.rand(1, x.shape[1], 1, 1) * (torch.rand(1, x.shape[1], 1, 1) > 0.3)
        store[f"lin{k}.model.1.weight"] = w
        x = x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
        d = (w.double() * (x[:1] - x[1:]) ** 2).sum(1)[0]
        m = cells(mask, *d.shape)
        whole += d.mean()
        within += (m * d).sum() / m.sum()
    return torch.stack([whole, within])


def main():
    a = f.interpolate(torch.rand(1, 3, 9, 10), size=(ROWS, COLUMNS), mode="bicubic").clamp(0, 1)
    b = (a.roll(2, 3) + 0.05 * torch.randn(a.shape)).clamp(0, 1)
    pictures = (torch.cat([a, b]) * 255).round()
    mask = torch.zeros(ROWS, COLUMNS)
    mask[13:50, 22:61] = 1
    shift, scale = torch.tensor([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]], dtype=torch.float64)
    x = (pictures.double() / 127.5 - 1 - shift.view(3, 1, 1)) / scale.view(3, 1, 1)
    pairs = {"alex": distance(alex(x), lin, mask.double()), "vgg": distance(vgg(x), full, mask.double())}
    print(pairs)
    for i, name in enumerate("ab"):
        pairs[name] = pictures[i].permute(1, 2, 0).contiguous().byte()
    pairs["mask"] = (mask * 255).byte()
    for name, store in (("alex", trunk), ("alex_lin", lin), ("vgg", full), ("pairs", pairs)):
        save_file(store, f"tests/fixtures/lpips_{name}.safetensors")


main()
