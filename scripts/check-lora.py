#!/usr/bin/env python3
"""check-lora.py RUN/checkpoint-N RUN/merged [BACK.safetensors]: additions trained here, in diffusers and peft.

    pip install torch==2.13.0 diffusers==0.42.1 peft==0.21.2 transformers==5.23.0 safetensors

RUN was trained with mixed_precision f32 and save_merged.  The network of diffusers gets the frozen weights, and the
additions through diffusers' own reader of kohya's form, which writes one underscore where VideoX-Fun and we write two;
its velocity must be that with the weights that dar-train merged.  With BACK the additions are written in the form of
peft, for `dar-train ... --set parts.lora=BACK` to read.  Prints the distances; fails above 1e-5.
"""
import importlib.util
import json
import os
import sys

import torch
from diffusers.loaders.lora_conversion_utils import _convert_musubi_wan_lora_to_diffusers
from peft import get_peft_model_state_dict
from safetensors.torch import load_file, save_file

here = importlib.util.spec_from_file_location("f", os.path.join(os.path.dirname(__file__), "make-dit-fixtures.py"))
fixtures = importlib.util.module_from_spec(here)
here.loader.exec_module(fixtures)


def network(d, weights):
    net = fixtures.network(d)
    names = {fixtures.public(name): name for name in net.state_dict()}
    net.load_state_dict({names[k]: x.float() for k, x in weights.items() if k in names}, strict=True)
    return net.eval()


@torch.no_grad()
def velocity(net, d):
    g = torch.Generator().manual_seed(1)
    z = torch.randn(1, 2 * d["latent"] + d["mask"], 3, 8, 8, generator=g, dtype=torch.float64)
    words = torch.randn(1, d["text_keys"], d["text_width"], generator=g, dtype=torch.float64)
    return net(z, torch.tensor([700.0]), words, return_dict=False)[0]


def distance(a, b):
    return ((a - b).norm() / b.norm()).item()


def main():
    checkpoint, merged = sys.argv[1:3]
    model = json.load(open(f"{checkpoint}/model.json"))
    frozen = load_file(os.path.join(checkpoint, model["weights"]["dit"]))
    plain, truth = (network(model["dit"], w) for w in (frozen, load_file(f"{merged}/dit.safetensors")))
    expected = velocity(truth, model["dit"])
    without = distance(velocity(plain, model["dit"]), expected)
    ours = load_file(f"{checkpoint}/lora.safetensors")
    kohya = {k.replace("lora_unet__", "lora_unet_"): x.double() for k, x in ours.items()}
    additions = _convert_musubi_wan_lora_to_diffusers(kohya)
    plain.load_lora_adapter(additions, prefix="transformer", adapter_name="default")
    found = distance(velocity(plain, model["dit"]), expected)
    print(f"velocity against that of merged weights: {found:.1e}; without additions {without:.1e}")
    if len(sys.argv) > 3:
        save_file({k: x.float().contiguous() for k, x in get_peft_model_state_dict(plain).items()}, sys.argv[3])
    sys.exit(not (found < 1e-5 < without))


main()
