"""torch_dit.py: blocks of the transformer in PyTorch, as the public code writes them, for side-by-side measurements.

What PyTorch likes best: fused attention; products in the storage type, the residual stream, norms and gates in f32.
"""
import json

import torch
import torch.nn as nn
import torch.nn.functional as F


def preset(name):
    """The sizes of models/presets/NAME.json."""
    with open(f"models/presets/{name}.json") as f:
        return json.loads("".join(line for line in f if not line.lstrip().startswith("//")))


def rms(x, w):
    f = x.float()
    return (f * torch.rsqrt(f.square().mean(-1, keepdim=True) + 1e-6)).to(x.dtype) * w


class Product(nn.Module):
    """A linear layer, with low-rank additions that count where gradients are taken (elsewhere they are merged)."""

    def __init__(self, n_in, n_out, storage, rank=0):
        super().__init__()
        self.base = nn.Linear(n_in, n_out).to(storage).requires_grad_(False)
        if rank:
            self.down = nn.Parameter(torch.randn(rank, n_in).mul(0.02).to(storage))
            self.up = nn.Parameter(torch.randn(n_out, rank).mul(0.02).to(storage))

    def forward(self, x):
        y = self.base(x)
        return y + F.linear(F.linear(x, self.down), self.up) if torch.is_grad_enabled() else y


class Attention(nn.Module):
    def __init__(self, D, heads, storage, rank, angle):
        super().__init__()
        self.q, self.k, self.v, self.o = (Product(D, D, storage, rank) for _ in range(4))
        self.w = nn.ParameterList([nn.Parameter(torch.ones(D, dtype=storage), requires_grad=False)] * 2)
        self.heads, self.angle = heads, angle
        if angle is not None:
            self.cos, self.sin = angle.cos(), angle.sin()

    def rope(self, x):  # [B, N, A, E]
        a, b = x.float().unflatten(-1, (-1, 2)).unbind(-1)
        return torch.stack((a * self.cos - b * self.sin, a * self.sin + b * self.cos), -1).flatten(-2).to(x.dtype)

    def forward(self, x, context):
        q, k = rms(self.q(x), self.w[0]), rms(self.k(context), self.w[1])
        q, k, v = (y.unflatten(-1, (self.heads, -1)) for y in (q, k, self.v(context)))
        if self.angle is not None:
            q, k = self.rope(q), self.rope(k)
        y = F.scaled_dot_product_attention(*(y.transpose(1, 2) for y in (q, k, v)))
        return self.o(y.transpose(1, 2).flatten(2))


class Block(nn.Module):
    """x [B, N, D] f32, context [B, n, D], e [B, 6, 1 or N, D]; angle [N, 1, E / 2] of the tokens' positions"""

    def __init__(self, D, heads, ffn, storage, rank, angle):
        super().__init__()
        self.own, self.cross = Attention(D, heads, storage, rank, angle), Attention(D, heads, storage, rank, None)
        self.up, self.down = Product(D, ffn, storage, rank), Product(ffn, D, storage, rank)
        self.modulation = nn.Parameter(torch.randn(1, 6, 1, D) / D**0.5, requires_grad=False)
        self.D, self.storage = D, storage

    def norm(self, x):
        return F.layer_norm(x, (self.D,), eps=1e-6)

    def forward(self, x, context, e):
        shift, scale, gate, shift2, scale2, gate2 = (self.modulation + e).unbind(1)
        h = (self.norm(x) * (1 + scale) + shift).to(self.storage)
        x = x + self.own(h, h).float() * gate
        x = x + self.cross(self.norm(x).to(self.storage), context).float()
        h = (self.norm(x) * (1 + scale2) + shift2).to(self.storage)
        return x + self.down(F.gelu(self.up(h), approximate="tanh")).float() * gate2
